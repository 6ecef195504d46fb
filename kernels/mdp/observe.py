"""The stage that observes: terms of all groups, with latency, noise, clipping, scale and history."""

from typing import Any

import warp as wp

from ..terrain.ground import Ground
from .env import EnvArrays
from .parameters import RobotParameters
from .random import OBSERVATION, cut_gaussian, make_draw
from .view import RobotArrays, load_view

wp.set_module_options({"enable_backward": False})


@wp.struct
class Slot:
    """Where an observation term stands in the rows of its group."""

    group: int
    start: int  # of the group's rows
    stride: int  # columns of the group
    first: int  # of noise, scale and clip in the array of numbers
    column: int  # of its oldest frame
    width: int  # of a frame
    history: int  # number of frames
    delayed: int  # 1: comes as late as the world's sensors do
    past: int  # column in the ring of past frames


@wp.struct
class ObservationArrays:
    """Observations of all worlds, one row a world, one group after the other."""

    now: wp.array(dtype=float)  # of the next step; an ended episode has begun anew
    final: wp.array(dtype=float)  # the same before that new beginning
    past: wp.array3d(dtype=float)  # (depth, num_worlds, columns) what sensors gave, a ring over policy steps
    latency: wp.array(dtype=int)  # [physics steps] (num_worlds,)
    substeps: int


@wp.func
def store(value: float, i: int, out: wp.array(dtype=float)):
    """Write a number."""
    out[i] = value


@wp.func
def store(value: Any, i: int, out: wp.array(dtype=float)):  # noqa: F811
    """Write a vector."""
    for j in range(len(value)):
        out[i + j] = value[j]


@wp.func
def late(arrays: ObservationArrays, clock: int, world: int, column: int, value: float, fresh: int) -> float:
    """Return what a sensor gave as long ago as its latency says, between policy steps a straight line."""
    depth = arrays.past.shape[0]
    if fresh != 0:
        for i in range(depth):
            arrays.past[i, world, column] = value
    arrays.past[clock % depth, world, column] = value
    whole = arrays.latency[world] // arrays.substeps
    share = float(arrays.latency[world] - whole * arrays.substeps) / float(arrays.substeps)
    newer = arrays.past[(clock - whole) % depth, world, column]
    if share == 0.0:
        return newer
    return newer + share * (arrays.past[(clock - whole - 1) % depth, world, column] - newer)


def make_observe_kernel(task: Any) -> wp.Kernel:
    """Return the kernel of all observation groups of a task.

    One thread per (term, world): neighbours run the same term. Only the terms are unrolled; what all share is a loop.
    """
    rows = [row for group in task.groups for row in task.rows[group]]
    of_parameters = [row.func.input_types[next(iter(row.func.input_types))] is RobotParameters for row in rows]

    @wp.kernel(module="unique", enable_backward=False)
    def observe_kernel(
        # in
        skill: int,
        robot: RobotArrays,
        parameters: RobotParameters,
        ground: Ground,
        env: EnvArrays,
        states: wp.array(dtype=task.state),
        slots: wp.array(dtype=Slot),
        p: wp.array(dtype=float),
        beginning: int,
        # in, out
        arrays: ObservationArrays,
    ):
        """Write the observations; rows of worlds that came apart are 0.

        beginning 1: only where an episode or the skill has just begun, and `final` stays.
        """
        row, world = wp.tid()
        if env.skill[world] != skill or (beginning != 0 and env.fresh[world] == 0):
            return
        slot = slots[row]
        oldest = slot.start + world * slot.stride + slot.column
        newest = oldest + (slot.history - 1) * slot.width
        for k in range(oldest, newest):
            arrays.now[k] = arrays.now[k + slot.width]
        if env.broken[world] == 0:
            for i in range(wp.static(len(rows))):
                if row == i:
                    if wp.static(of_parameters[i]):
                        store(wp.static(rows[i].func)(parameters, world), newest, arrays.now)
                    else:
                        view = load_view(robot, ground, world)
                        if wp.static(rows[i].plain):
                            store(wp.static(rows[i].func)(view, states[world]), newest, arrays.now)
                        else:
                            store(
                                wp.static(rows[i].func)(
                                    view, states[world], *p[wp.static(rows[i].lo) : wp.static(rows[i].hi)]
                                ),
                                newest,
                                arrays.now,
                            )
        else:
            for j in range(slot.width):
                arrays.now[newest + j] = 0.0
        draw = make_draw(env.seed, world, env.clock[world], OBSERVATION + slot.group)
        for j in range(slot.width):
            value = arrays.now[newest + j]
            if slot.delayed != 0:
                value = late(arrays, env.clock[world], world, slot.past + j, value, env.fresh[world])
            if p[slot.first] > 0.0 and env.broken[world] == 0:
                value += p[slot.first] * cut_gaussian(draw, slot.column + j)
            value = p[slot.first + 1] * wp.clamp(value, -p[slot.first + 2], p[slot.first + 2])
            arrays.now[newest + j] = value
            if env.fresh[world] != 0:
                for k in range(slot.history - 1):
                    arrays.now[oldest + k * slot.width + j] = value
        if beginning == 0:
            for k in range(oldest, newest + slot.width):
                arrays.final[k] = arrays.now[k]

    return observe_kernel
