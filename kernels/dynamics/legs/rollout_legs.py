"""Kernel that runs rollouts of policy and physics steps on GPUs, with four threads per world, one per leg."""

import warp as wp

from ...lanes import any_world, sync_lanes
from ...layout import DOFS
from ...scalar import real
from ...state import base_com
from .. import trajectory as rows
from ..drive import Drive, LegDrive
from ..step import RobotModel, StepSettings, load_leg
from .advance_legs import LegState, advance_leg

wp.set_module_options({"enable_backward": False, "fast_math": True})


@wp.kernel
def rollout_legs_kernel(
    # in
    count: int,
    model: RobotModel,
    settings: StepSettings,
    timing: rows.Timing,
    actuation: rows.Actuation,
    commands: rows.Commands,
    drive: Drive,
    # out
    filtered_target: wp.array3d(dtype=real),
    trajectory: rows.TrajectoryArrays,
):
    """Run a rollout of policy and physics steps in every world, like `rollout_kernel`, with a thread per leg.

    Launch over (count rounded up to a multiple of 8, 4); count: number of worlds, from `settings.first` on.
    """
    index, leg = wp.tid()
    world = settings.first + wp.min(index, count - 1)  # threads beyond the last world repeat it
    com = base_com(model.table, world)
    delay = actuation.latency[world] / settings.dt
    params = load_leg(model, world, leg)
    s = LegState()
    s.impulse = commands.impulse[leg, world]
    for step in range(timing.steps * timing.substeps):
        t = step / timing.substeps
        row = step / timing.every
        if step == row * timing.every:
            s.base = rows.load_row_base(trajectory, row, world, com)
            s.angles = rows.row_vec3(trajectory.q, row, 7 + 3 * leg, world)
            s.rates = rows.row_vec3(trajectory.qd, row, 6 + 3 * leg, world)
        if step == t * timing.substeps:
            rows.filter_commands(commands, actuation, t, leg, world, s.angles, s.rates, filtered_target)
            if leg == 0:
                for i in range(6):
                    drive.joint_f[world * DOFS + i] = commands.wrench[t, i, world]
            sync_lanes()
        arrived = rows.arrival(step, timing.substeps, delay)
        motors = LegDrive()
        torque = rows.leg_torque(commands, actuation, filtered_target, arrived, leg, world, s.angles, s.rates)
        motors.extra = torque
        s.step = 0
        s.sets = 0
        while any_world(s.step == 0):
            s = advance_leg(model, settings, drive, params, motors, world, leg, s, False)
        rows.store_row_vec3(trajectory.torque, step, 3 * leg, world, torque)
        trajectory.impulse[step, leg, world] = s.impulse
        trajectory.pressed[step, leg, world] = wp.uint8(s.pressed)
        if step + 1 == (row + 1) * timing.every:
            if leg == 0:
                rows.store_row_base(trajectory, row + 1, world, com, s.base)
            rows.store_row_vec3(trajectory.q, row + 1, 7 + 3 * leg, world, s.angles)
            rows.store_row_vec3(trajectory.qd, row + 1, 6 + 3 * leg, world, s.rates)
            sync_lanes()
