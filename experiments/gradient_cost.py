"""Measure how much a jump's gradient costs, in units of the jump's simulation, and write metrics.

    python experiments/gradient_cost.py --out outputs/gradient_cost
    python experiments/gradient_cost.py --device cuda --num-envs 4096

The same jump (squat, push-off, flight; 36 policy steps of 8 physics steps) is simulated twice: by the solver's kernel
with the command filter, and as a rollout with its reverse pass. The reverse pass differentiates with respect to all
parameters, targets and the initial state. Both run in single precision, with the solver's default tolerance, on one
thread of a CPU. The errors of the gradient are relative to double precision.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import warp as wp

from jumper_warp.diff.rollout import Rollout, Trajectory, compact
from jumper_warp.kernels.layout import DOFS
from jumper_warp.robot.description import load_description
from jumper_warp.robot.model import PHYSICS_DT, build_model, standing_configuration
from jumper_warp.robot.motors import filter_params, jumping_motors, vertical_jump_filter
from jumper_warp.sim.dynamics import TOLERANCE
from jumper_warp.sim.simulation import SUBSTEPS
from jumper_warp.utils.output import output_dir
from jumper_warp.utils.runtime import configure_device
from support.scripts import DeviceArgs, report, run_script
from support.timing import device_memory, wall_time

TICKS = 36  # Number of policy steps of 1/60 s of the jump
SQUAT = math.radians(85.0)  # [rad] Transversal angle of the squat
PUSH = (-5.0, -8.0)  # [deg] Outer and inner command of the push-off; the filter binds, the motors saturate at first


def schedule() -> np.ndarray:
    """Return the motor targets [rad], (TICKS, 12), of a jump: squat, then push-off."""
    targets = np.zeros((TICKS, 4, 3))
    targets[:2, :, 1:] = SQUAT
    targets[2:, :, 1:] = np.radians(PUSH)
    return targets.reshape(TICKS, 12)


def start() -> tuple[np.ndarray, np.ndarray]:
    """Return the jump's initial state, a squat: coordinates (43,) and rates (38,)."""
    squat = replace(load_description(), poses={"squat": (0.0, SQUAT)})
    q = standing_configuration(squat, "squat")
    q[2] -= 1.0e-4  # paws 0.1 mm in the ground, so that contacts do not switch
    return q, np.zeros(38)


class PlainJump:
    """Jump without gradients, by the solver's kernel: a captured graph of filter and physics of all policy steps."""

    def __init__(self, rollout: Rollout, targets: np.ndarray):
        """Capture the jump's graph; model and parameters are those of the rollout.

        targets: motor targets [rad], (steps, 12).
        """
        self._rollout = rollout
        n = rollout.num_worlds
        dynamics = rollout.dynamics
        modules = rollout.dynamics.modules
        self._start = [rollout.array(np.tile(values, n)) for values in start()]
        self._q, self._qd = (wp.clone(array) for array in self._start)
        self._targets = rollout.array(np.repeat(targets[:, :, None], n, axis=2))
        filtered = rollout.array(np.zeros((12, n)))
        limits = filter_params(vertical_jump_filter(), module=modules.command_filter)
        wrench = wp.zeros(dynamics.model.body_count, dtype=wp.spatial_vectorf, device=rollout.device)
        motors = rollout.motors
        drive = dynamics.drive(rollout.array(np.zeros(DOFS * n)), wrench, motors, filtered)

        def run() -> None:
            """Simulate the jump from its start: per target one command filter launch and SUBSTEPS physics steps."""
            dynamics.work.impulse.zero_()
            for current, initial in zip((self._q, self._qd), self._start, strict=True):
                wp.copy(current, initial)
            for target in (self._targets[step] for step in range(len(targets))):
                wp.launch(
                    modules.command_filter.command_filter_kernel,
                    dim=(4, n),
                    device=rollout.device,
                    inputs=[0, target, self._q, self._qd, motors.offset, limits],
                    outputs=[filtered],
                )
                dynamics.advance(PHYSICS_DT, SUBSTEPS, drive, self._q, self._qd, self._q, self._qd)

        run()
        with wp.ScopedCapture(device=rollout.device) as capture:
            run()
        assert capture.graph is not None
        self._graph = capture.graph
        self._arrays = (drive, filtered, wrench)  # a graph on a GPU keeps no arrays alive

    def run(self) -> None:
        """Simulate the jump by replaying the graph."""
        wp.capture_launch(self._graph)

    def heights(self) -> np.ndarray:
        """Return the final base heights [m], (num_worlds,)."""
        return self._q.numpy().reshape(self._rollout.num_worlds, -1)[:, 2]


class GradientRun:
    """Jump as a differentiable rollout, with the gradient of its final base height by the reverse pass.

    The reverse pass begins with the derivative of this height w.r.t. the trajectory: 1 for z in the last row, else 0.
    """

    def __init__(self, worlds: int, double: bool, device: str | None):
        """Build the rollout and its inputs for a number of worlds; double: compute in double precision."""
        model = build_model(worlds, visuals=False, device=device)
        self.rollout = Rollout(
            model, jumping_motors(), vertical_jump_filter(), double=double, tolerance=TOLERANCE, threads=1
        )
        self._q, self._qd = (self.rollout.array(np.repeat(row, worlds, axis=1)) for row in compact(*start()))
        self._targets = self.rollout.array(np.repeat(schedule()[:, :, None], worlds, axis=2))
        cotangent = np.zeros(self.forward().q.shape)
        cotangent[-1, 2] = 1.0
        self._cotangent = self.rollout.array(cotangent)

    def forward(self) -> Trajectory:
        """Simulate the jump by the rollout, and return the trajectory."""
        return self.rollout.run(self._targets, self._q, self._qd)

    def run(self) -> dict[str, wp.array]:
        """Simulate the jump, and return the gradients of the final base height with respect to all inputs.

        Keys: as `Rollout.backward`.
        """
        return self.rollout.backward(self.forward(), q=self._cotangent)


@dataclass(frozen=True)
class Args(DeviceArgs):
    """Flags of the timing of a jump's gradient."""

    num_envs: int | None = None  # Number of environments (default: 64 on a CPU, 4096 on a GPU)
    repeats: int = 7
    """Number of timed repetitions; simulation and gradient alternate, and the fastest time of each counts."""
    double: bool = False  # Whether to compute in double precision


def main(args: Args) -> dict:
    """Time a jump's simulation and gradient, compare the gradient with double precision, return the metrics."""
    name = configure_device(args.device, 1).name
    device = wp.get_device(args.device)
    folder = output_dir("gradient_cost", args.out)
    worlds = args.num_envs or (4096 if device.is_cuda else 64)
    exact = GradientRun(1, True, args.device).run()
    before = device_memory(device) if device.is_cuda else 0
    differentiable = GradientRun(worlds, args.double, args.device)
    plain = PlainJump(differentiable.rollout, schedule())
    gradient = differentiable.run()
    errors = {  # largest error in world 0 (worlds last) relative to the largest entry, by input of the rollout
        key: float(np.abs(gradient[key].numpy()[..., 0] - exact[key].numpy()[..., 0]).max())
        / float(np.abs(exact[key].numpy()).max())
        for key in ("targets", "q", "qd", "table", "saturation")
    }
    first = differentiable.forward()
    saved = (first.q, first.qd, first.torque, first.impulse, first.pressed, first.filtered_target)
    times = {"plain": [], "forward": [], "gradient": []}
    for _ in range(args.repeats):
        for kind, run in (("plain", plain.run), ("forward", differentiable.forward), ("gradient", differentiable.run)):
            times[kind].append(wall_time(run, args.device))
    plain.run()
    best = {kind: min(values) for kind, values in times.items()}
    steps = worlds * TICKS * SUBSTEPS
    values = {
        "device": name,
        "worlds": worlds,
        f"{'gpu' if device.is_cuda else 'cpu'}_ratio": best["gradient"] / best["plain"],
        "forward_ratio": best["forward"] / best["plain"],
        **{f"{kind}_us_a_step": 1.0e6 * value / steps for kind, value in best.items()},
        "kept_bytes_a_policy_step": sum(a.size * wp.types.type_size_in_bytes(a.dtype) for a in saved) / worlds / TICKS,
        "height_difference_m": float(np.abs(plain.heights() - first.q.numpy()[-1, 2]).max()),  # final base z
        **{f"error_{key}": error for key, error in errors.items()},
    }
    if device.is_cuda:
        values["memory_kib_a_world"] = (device_memory(device) - before) / worlds / 1024.0
    keys = [key for key in values if key.endswith(("ratio", "us_a_step", "error_targets", "kib_a_world"))]
    return report(args, folder, values, f"Gradient of a jump in {worlds:,} worlds, {name}", keys)


if __name__ == "__main__":
    run_script(main, Args)
