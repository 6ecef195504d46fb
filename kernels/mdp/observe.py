"""Observations: evaluate the terms of all groups, then apply latency, noise, clipping, scale and history.

A group is the input of one network (actor, critic). A component is one number of a term. With history a group has the
last values of a component, its frames, oldest first. An episode that ends is observed twice in a step: before its reset
(`final`, from which training estimates the value of a truncated episode) and after it (`now`).
"""

from typing import Any

import warp as wp

from ..terrain.ground import Ground
from .env import BEGUN, COMMANDED, RING, EpisodeArrays
from .factory import FAST, unrolled_kernel
from .non_finite import NonFinite, record_non_finite
from .parameters import RobotParameters
from .random import OBSERVATION, normal, step_key, stream_at
from .view import RobotArrays, load_view

wp.set_module_options(FAST)

CHUNK = 12  # Terms that one thread evaluates; it loads the robot once for all of them
LANES = wp.constant(32)  # Threads that share the components of a world, so that a warp writes neighbouring columns


@wp.struct
class ObservationColumn:
    """Indices of one component of an observation: where it is read, how it is processed, and where it is written."""

    raw: int  # row in `ObservationArrays.raw`
    group: int  # index of the group
    start: int  # index of the group's first element in `now` and `final`
    stride: int  # columns of the group
    noise: int  # index of the noise level in the array of the terms' numbers `p`
    noise_limit: int  # index of the largest noise over its level in `p`
    scale: int  # index of the scale in `p`
    clip: int  # index of the limit in `p`
    oldest: int  # column of the component's oldest frame in the group
    width: int  # columns of a frame (components of the term)
    history: int  # number of frames
    delayed: int  # 1: subject to the observation latency of the world
    past: int  # column in the ring buffer `past`


@wp.struct
class ObservationArrays:
    """Observations of all worlds: values of the terms, and processed observations after and before resets.

    `now` and `final` are flat: they join the arrays (num_worlds, columns) of all groups.
    """

    raw: wp.array2d(dtype=float)  # (components, num_worlds) values of the terms
    now: wp.array(dtype=float)  # observations for the next step, after resets
    final: wp.array(dtype=float)  # observations before resets
    past: wp.array3d(dtype=float)  # (RING, num_worlds, columns) delayed components, ring buffer over policy steps
    latency: wp.array(dtype=int)  # [physics steps] (num_worlds,) from sensor to policy
    substeps: int  # physics steps in a policy step


@wp.func
def load_column(columns: wp.array2d(dtype=int), component: int) -> ObservationColumn:
    """Return the indices of one component of an observation (`ObservationColumn`), read from the table `columns`.

    columns: (fields of `ObservationColumn`, components).
    """
    column = ObservationColumn()
    column.raw = columns[0, component]
    column.group = columns[1, component]
    column.start = columns[2, component]
    column.stride = columns[3, component]
    column.noise = columns[4, component]
    column.noise_limit = columns[5, component]
    column.scale = columns[6, component]
    column.clip = columns[7, component]
    column.oldest = columns[8, component]
    column.width = columns[9, component]
    column.history = columns[10, component]
    column.delayed = columns[11, component]
    column.past = columns[12, component]
    return column


@wp.func
def store(value: float, row: int, world: int, out: wp.array2d(dtype=float)) -> bool:
    """Write the scalar value of an observation term in a world to out[row, world]; return whether it is finite."""
    out[row, world] = value
    return wp.isfinite(value)


@wp.func
def store(value: Any, row: int, world: int, out: wp.array2d(dtype=float)) -> bool:  # noqa: F811
    """Write the vector value of an observation term in a world to rows of `out`; return whether all of it is finite.

    Its element j is written to out[row + j, world].
    """
    for j in range(len(value)):
        out[row + j, world] = value[j]
    return wp.isfinite(value)


def make_observe_kernel(task: Any) -> wp.Kernel:
    """Return the kernel that evaluates all observation terms of a task (a `jumper_warp.tasks.cfg.TaskCfg`)."""
    slots = [slot for group in task.groups for slot in task.params.slots[f"observations.{group}"]]
    input_types = [next(iter(slot.func.input_types.values())) for slot in slots]
    reads_parameters = [kind is RobotParameters for kind in input_types]
    reads_ground = [kind is RobotArrays for kind in input_types]
    rows = [sum(slot.term.width for slot in slots[:i]) for i in range(len(slots))]

    def observe_kernel(
        # in
        skill: int,
        arrays: RobotArrays,
        parameters: RobotParameters,
        ground: Ground,
        episode: EpisodeArrays,
        states: wp.array(dtype=task.state),
        p: wp.array(dtype=float),
        after_reset: int,
        term_value: wp.array2d(dtype=float),
        # out
        raw: wp.array2d(dtype=float),
        found: NonFinite,
        found_states: wp.array(dtype=task.state),
    ):
        """Evaluate a task's observation terms, and write their values to raw (components, num_worlds).

        One thread per (chunk of terms, world of `skill`). after_reset 1: only where an episode or the skill has just
        begun, or a new command was set. term_value, found, found_states: see `record_non_finite`.
        """
        chunk, world = wp.tid()
        world += episode.first
        if episode.skill[world] != skill or (after_reset != 0 and episode.history_reset[world] == 0):
            return
        finite = bool(True)
        for c in range(wp.static((len(slots) + CHUNK - 1) // CHUNK)):
            if chunk == c:
                robot = load_view(arrays, ground, world)
                for i in range(wp.static(c * CHUNK), wp.static(min((c + 1) * CHUNK, len(slots)))):
                    if wp.static(reads_parameters[i]):
                        ok = store(wp.static(slots[i].func)(parameters, world), wp.static(rows[i]), world, raw)
                    elif wp.static(reads_ground[i]):
                        ok = store(wp.static(slots[i].func)(arrays, ground, world), wp.static(rows[i]), world, raw)
                    else:
                        ok = store(
                            wp.static(slots[i].func)(
                                robot, states[world], *p[wp.static(slots[i].start) : wp.static(slots[i].stop)]
                            ),
                            wp.static(rows[i]),
                            world,
                            raw,
                        )
                    finite = finite and ok
        if not finite and episode.diverged[world] == 0:
            for row in range(raw.shape[0]):
                term = found.observation_term[row]
                if term // CHUNK == chunk and not wp.isfinite(raw[row, world]):
                    record_non_finite(
                        found, found.num_rewards + 2 + term, raw[row, world], world, episode, arrays, raw, term_value,
                        states, found_states,
                    )  # fmt: skip

    return unrolled_kernel(observe_kernel, task.state)


LIMIT = wp.constant(100.0)  # largest absolute value of an observation [1]


@wp.func
def finite_or_zero(value: float, diverged: bool) -> float:
    """Return the value of an observation, or 0 if its world diverged or the value is not finite."""
    if diverged or not wp.isfinite(value):
        return 0.0
    return value


@wp.struct
class StepContext:
    """Values of a world in a policy step that are the same for all of its observations."""

    world: int
    step_key: wp.uint32  # see `mdp.random`
    purpose: int  # as in `EpisodeArrays`
    history_reset: int  # as in `EpisodeArrays`
    diverged: bool
    slot: int  # ring buffer slot of this policy step
    newer: int  # slot of the value at the delay rounded down to policy steps
    older: int  # slot one policy step before `newer`
    fraction: float  # [1] weight of `older`, 0 to 1; `newer` has the rest


@wp.func
def step_context(episode: EpisodeArrays, arrays: ObservationArrays, world: int) -> StepContext:
    """Return the values of a world that all its observations share in a policy step: random key, flags, delay.

    The latency is below RING policy steps, and `step_count` starts above, so that no slot is negative.
    """
    step_count = episode.step_count[world]
    steps = arrays.latency[world] // arrays.substeps
    m = StepContext()
    m.world = world
    m.step_key = step_key(episode.seed, world, step_count)
    m.purpose = episode.purpose
    m.history_reset = episode.history_reset[world]
    m.diverged = episode.diverged[world] != 0
    m.slot = step_count % RING
    m.newer = (step_count - steps) % RING
    m.older = (step_count - steps - 1) % RING
    m.fraction = float(arrays.latency[world] - steps * arrays.substeps) / float(arrays.substeps)
    return m


@wp.func
def delay_value(arrays: ObservationArrays, m: StepContext, column: int, value: float) -> float:
    """Store a new observation value, and return an earlier one, delayed by the world's latency.

    column: index in the ring buffer. The delayed value is linear between policy steps. Where an episode or skill
    begins, the ring is filled with value: values of the last episode must not appear in the next one.
    """
    if m.history_reset == BEGUN:
        for i in range(RING):
            arrays.past[i, m.world, column] = value
    arrays.past[m.slot, m.world, column] = value
    newer = arrays.past[m.newer, m.world, column]
    if m.fraction == 0.0:
        return newer
    return newer + m.fraction * (arrays.past[m.older, m.world, column] - newer)


@wp.func
def postprocess(
    arrays: ObservationArrays, column: ObservationColumn, p: wp.array(dtype=float), m: StepContext, after_reset: int
):
    """Write an observation component (delayed, with noise, clipped, then scaled) as newest frame of its history.

    p: numbers of the task's terms. after_reset: as in `postprocess_obs_kernel`.
    """
    value = finite_or_zero(arrays.raw[column.raw, m.world], m.diverged)
    if column.delayed != 0:
        value = delay_value(arrays, m, column.past, value)
    noise = p[column.noise]
    if noise > 0.0:
        rng = stream_at(m.step_key, m.purpose, m.world, OBSERVATION + column.group)
        value += noise * wp.clamp(normal(rng, column.oldest), -p[column.noise_limit], p[column.noise_limit])
    value = finite_or_zero(p[column.scale] * wp.clamp(value, -p[column.clip], p[column.clip]), m.diverged)
    value = wp.clamp(value, -LIMIT, LIMIT)
    i = column.start + m.world * column.stride + column.oldest
    keep_frames = after_reset != 0 and m.history_reset == COMMANDED
    for _ in range(column.history - 1):
        frame = arrays.now[i + wp.where(keep_frames, 0, column.width)]
        if m.diverged or m.history_reset == BEGUN:
            frame = value
        arrays.now[i] = frame
        if after_reset == 0:
            arrays.final[i] = frame
        i += column.width
    arrays.now[i] = value
    if after_reset == 0:
        arrays.final[i] = value


@wp.kernel
def postprocess_obs_kernel(
    # in
    skill: int,
    episode: EpisodeArrays,
    columns: wp.array2d(dtype=int),
    p: wp.array(dtype=float),
    after_reset: int,
    # in, out
    arrays: ObservationArrays,
):
    """Turn values of observation terms into observations: delay, noise, clip, scale; launch over (num_worlds, LANES).

    Non-finite values, and all rows and history of diverged worlds, are 0. after_reset 1: only where an episode or
    skill has just begun, or a new command was set; `final` stays, and so do the older frames after a command.
    """
    world, lane = wp.tid()
    world += episode.first
    if episode.skill[world] != skill or (after_reset != 0 and episode.history_reset[world] == 0):
        return
    m = step_context(episode, arrays, world)
    for component in range(lane, columns.shape[1], LANES):
        postprocess(arrays, load_column(columns, component), p, m, after_reset)
