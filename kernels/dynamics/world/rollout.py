"""Rollouts: policy steps of command filter, latency, motors and physics in one launch, with one thread per world.

A rollout has T policy steps of S physics steps. For the reverse pass it records the state every `every` physics steps
(a row), and torques, paw impulses and pressed stops of every physics step. With these, the reverse pass can recompute
the steps between two rows without solving for contact again. Each row's rounded state is also loaded again in the
forward pass, so that both passes start from the same numbers.
"""

import warp as wp

from ...layout import DOFS
from ...scalar import real
from ...state import BaseState, base_com, leg_dof, store_motors
from .. import trajectory as rows
from ..contact import PawContact
from ..drive import Drive, Workspace
from ..step import RobotModel, StepSettings
from .advance import advance_once
from .world_step import LegStep

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": rows.CPU_FLAGS})


@wp.kernel
def rollout_kernel(
    # in
    model: RobotModel,
    settings: StepSettings,
    timing: rows.Timing,
    actuation: rows.Actuation,
    commands: rows.Commands,
    drive: Drive,
    # in, out
    work: Workspace,
    # out
    filtered_target: wp.array3d(dtype=real),
    trajectory: rows.TrajectoryArrays,
):
    """Run a rollout of policy and physics steps in every world, with one thread per world.

    It starts from the state in row 0 of `trajectory`. Worlds count from `settings.first`. settings.substeps must be 1;
    drive.joint_f is overwritten. filtered_target [rad]: (T, 12, num_worlds).
    """
    world = settings.first + wp.tid()
    com = base_com(model.table, world)
    legs = wp.zeros(shape=(4,), dtype=LegStep)
    contacts = wp.zeros(shape=(4,), dtype=PawContact)
    delay = actuation.latency[world] / settings.dt
    for k in range(legs.shape[0]):
        work.impulse[k, world] = commands.impulse[k, world]
    base = BaseState()
    for step in range(timing.steps * timing.substeps):
        t = step / timing.substeps
        row = step / timing.every
        if step == row * timing.every:
            base = rows.load_row_base(trajectory, row, world, com)
            for k in range(legs.shape[0]):
                legs[k].angles = rows.row_vec3(trajectory.q, row, 7 + 3 * k, world)
                legs[k].rates = rows.row_vec3(trajectory.qd, row, 6 + 3 * k, world)
        if step == t * timing.substeps:
            for k in range(legs.shape[0]):
                rows.filter_commands(commands, actuation, t, k, world, legs[k].angles, legs[k].rates, filtered_target)
            for i in range(6):
                drive.joint_f[world * DOFS + i] = commands.wrench[t, i, world]
        arrived = rows.arrival(step, timing.substeps, delay)
        for k in range(legs.shape[0]):
            torque = rows.leg_torque(
                commands, actuation, filtered_target, arrived, k, world, legs[k].angles, legs[k].rates
            )
            rows.store_row_vec3(trajectory.torque, step, 3 * k, world, torque)
            store_motors(drive.joint_f, leg_dof(world, k), torque)
        base = advance_once(model, settings, drive, work, world, 0, base, legs, contacts)
        for k in range(legs.shape[0]):
            trajectory.impulse[step, k, world] = work.impulse[k, world]
            trajectory.pressed[step, k, world] = wp.uint8(legs[k].pressed)
        if step + 1 == (row + 1) * timing.every:
            rows.store_row_base(trajectory, row + 1, world, com, base)
            for k in range(legs.shape[0]):
                rows.store_row_vec3(trajectory.q, row + 1, 7 + 3 * k, world, legs[k].angles)
                rows.store_row_vec3(trajectory.qd, row + 1, 6 + 3 * k, world, legs[k].rates)
