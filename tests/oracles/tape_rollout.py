"""Rollouts on Warp's tape, kernel by kernel: the gradients that Warp's own reverse mode gives."""

import numpy as np
import warp as wp

from jumper_warp.diff.rollout import MAX_SWEEPS, TOLERANCE_DOUBLE
from jumper_warp.robot.motors import filter_params, motor_arrays
from jumper_warp.sim.dynamics import JumperDynamics
from jumper_warp.sim.tape import DifferentiableStep


def tape_gradients(model, motors, command_filter, dt, substeps, targets, joint_q, joint_qd, weights):
    """Return gradients of sum(weights * last joint_q) in float64, one world, by name; Newton's layout.

    model: built with `requires_grad`. targets (T, 12). weights (43,).
    """
    dynamics = JumperDynamics(model, double=True)
    modules, real = dynamics.modules, wp.float64
    step = DifferentiableStep(dynamics, MAX_SWEEPS, TOLERANCE_DOUBLE)
    arrays = motor_arrays(motors, 1, module=modules.motors, requires_grad=True)
    limits = filter_params(command_filter, module=modules.command_filter)
    no_body_f = wp.zeros(model.body_count, dtype=wp.spatial_vector, requires_grad=True)
    commands = wp.array(targets[:, :, None], dtype=real, requires_grad=True)
    first_q, first_qd = (wp.array(values, dtype=real, requires_grad=True) for values in (joint_q, joint_qd))
    q, qd = first_q, first_qd

    def zeros(shape):
        return wp.zeros(shape, dtype=real, requires_grad=True)

    with wp.Tape() as tape:
        for t in range(len(targets)):
            safe = zeros((12, 1))
            inputs = [0, commands[t], q, qd, 43, 38, arrays.offset, limits]
            wp.launch(modules.command_filter.command_filter_kernel, dim=(4, 1), inputs=inputs, outputs=[safe])
            for _ in range(substeps):
                force, next_q, next_qd = zeros(38), zeros(43), zeros(38)
                inputs = [safe, q, qd, 43, 38, arrays]
                wp.launch(modules.motors.motor_torque_kernel, dim=(12, 1), inputs=inputs, outputs=[force])
                step.step(q, qd, force, no_body_f, next_q, next_qd, dt)
                q, qd = next_q, next_qd
    tape.backward(grads={q: wp.array(np.asarray(weights), dtype=real)})
    found = {"targets": commands, "q": first_q, "qd": first_qd, "table": dynamics.robot.table}
    found |= {name: getattr(arrays, name) for name in ("kp", "kd", "saturation", "offset")}
    return {name: array.grad.numpy().squeeze() for name, array in found.items()}, q.numpy()
