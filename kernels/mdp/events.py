"""Kernel that runs a task's events (changes of robot parameters): at startup, at resets and at intervals.

Events are domain randomisation: masses, friction, gains, latency, pushes. `TermSlot`s (`jumper_warp.tasks.terms`) name
an event's function and the places of its numbers in `p`, so that a number can change without another kernel.
"""

import warp as wp

from .durations import whole_steps
from .env import EpisodeArrays
from .factory import unrolled_kernel
from .parameters import RobotParameters
from .random import EVENT, INTERVAL, RngStream, make_stream, uniform

STARTUP, AT_RESET, AT_STEP = 0, 1, 2  # stages at which `event_kernel` is launched
LANES = 8  # Threads of a GPU that share the loops of an event
MODES = {"startup": STARTUP, "reset": AT_RESET, "interval": AT_STEP}  # Stage of each mode of an event term


@wp.func
def steps_until(rng: RngStream, least: float, most: float, step_dt: float) -> int:
    """Return a random number of policy steps, at least 1, until an interval event is due again.

    The interval is uniform from least to most [s]. step_dt: duration of a policy step [s].
    """
    return wp.max(whole_steps(wp.round(uniform(rng, INTERVAL, least, most) / step_dt)), 1)


def make_event_kernel(slots: list) -> wp.Kernel:
    """Return the kernel that runs a task's events, which change robot parameters; slots: `TermSlot`s of events."""
    modes = [MODES[slot.mode] for slot in slots]

    def event_kernel(
        # in
        skill: int,
        stage: int,
        first: int,
        lanes: int,
        mask: wp.array(dtype=float),
        step_dt: float,
        episode: EpisodeArrays,
        p: wp.array(dtype=float),
        # in, out
        timer: wp.array2d(dtype=int),
        robot: RobotParameters,
    ):
        """Run the events (changes of robot parameters) that are due, in worlds of `skill` with mask != 0.

        stage: STARTUP, AT_RESET or AT_STEP, when the kernel is launched: at startup, at resets, in each policy step.
        Launch over (events, lanes, num_worlds). first: event of the first thread. The lanes share the loops of
        `parallel` events; lane 0 runs all others. mask: (num_worlds,). p: numbers of the task's terms. timer: (events,
        num_worlds), policy steps until an interval event is due, 0: not set, as after a handover. An interval event is
        also due at a reset.
        """
        row, lane, world = wp.tid()
        row += first
        world += episode.first
        if episode.skill[world] != skill or mask[world] == 0.0:
            return
        for i in range(wp.static(len(slots))):
            if row == i and (wp.static(bool(slots[i].parallel)) or lane == 0):
                stream = EVENT + 100 * stage + i
                rng = make_stream(episode.seed, episode.purpose, world, episode.step_count[world], stream)
                if wp.static(bool(slots[i].parallel)):
                    rng.lane = lane
                    rng.lanes = lanes
                due = stage == wp.static(modes[i])
                if wp.static(modes[i] == AT_STEP):
                    left = timer[i, world] - 1
                    due = stage == wp.static(AT_RESET) or (stage == wp.static(AT_STEP) and left == 0)
                    if due or left < 0:
                        left = steps_until(
                            rng,
                            p[wp.static(slots[i].interval_range_s)],
                            p[wp.static(slots[i].interval_range_s + 1)],
                            step_dt,
                        )
                    if stage != wp.static(STARTUP):
                        timer[i, world] = left
                if due:
                    wp.static(slots[i].func)(robot, rng, *p[wp.static(slots[i].start) : wp.static(slots[i].stop)])

    return unrolled_kernel(event_kernel)
