"""End of a policy step: advance the task's state, then terminations, rewards and the curriculum.

A task's terms are compiled into one kernel, which loads the robot once. Their numbers (weights, widths) are read from
the array `p`, so that they can change without another kernel. An episode ends by failure (`terminated`: no reward
follows) or otherwise (`truncated`, as at a time limit: the training estimates the value of the steps that would
follow).
"""

from typing import Any

import warp as wp

from ..terrain.ground import Ground
from . import terminations
from .env import BEGUN, Counters, EpisodeArrays
from .factory import unrolled_kernel
from .non_finite import NonFinite, record_non_finite
from .view import RobotArrays, has_diverged, is_finite, load_view

NOT_TERMINATED = wp.constant(-1)  # `EpisodeArrays.termination` of an episode that has not ended


@wp.func
def every_episode(state: Any) -> bool:
    """Return True: the curriculum counts every episode."""
    return True


@wp.func
def update_curriculum(
    episode: EpisodeArrays, counters: Counters, world: int, success: bool, error: float, promote_after: float,
    num_levels: int,
):  # fmt: skip
    """Count an ended episode for the curriculum: `promote_after` successes in a row raise the world's level.

    Each world has a level of its own, so goals become harder where the policy succeeds.
    error: curriculum error of the episode in the task's unit, summed over successes. num_levels: level past the last.
    """
    streak = wp.where(success, episode.streak[world] + 1, 0)
    if streak >= int(promote_after):
        streak = int(0)
        episode.level[world] = wp.min(episode.level[world] + 1, num_levels)
    episode.streak[world] = streak
    counters.curriculum_episodes[world] = counters.curriculum_episodes[world] + 1
    if success:
        counters.curriculum_successes[world] = counters.curriculum_successes[world] + 1
        counters.error_sum[world] = counters.error_sum[world] + wp.float64(error)


@wp.func
def write_step_result(
    episode: EpisodeArrays, counters: Counters, world: int, total: float, termination: int, timeout: float,
    diverged: bool,
):  # fmt: skip
    """Write reward, done flags and termination of a world's policy step, and advance its step count.

    total: sum of rewards. termination: index of the termination term, NOT_TERMINATED if none. timeout: 1 if this
    termination is no failure, else 0. diverged: whether the state is invalid.
    """
    episode.reward[world] = total
    episode.termination[world] = termination
    episode.done[world] = wp.where(termination == NOT_TERMINATED, 0.0, 1.0)
    episode.timeout[world] = timeout
    episode.terminated[world] = termination != NOT_TERMINATED and timeout == 0.0
    episode.truncated[world] = timeout != 0.0
    episode.diverged[world] = wp.where(diverged, 1, 0)
    counters.bad_actions[world] = counters.bad_actions[world] + episode.bad_action[world]
    episode.bad_action[world] = 0
    episode.step_count[world] = episode.step_count[world] + 1
    episode.history_reset[world] = 0


def make_step_kernel(task: Any) -> wp.Kernel:
    """Return the kernel that ends a policy step of a task: state update, terminations, rewards and curriculum.

    task: see `jumper_warp.tasks.cfg.TaskCfg`.
    """
    (advance,), endings, rewards = (task.params.slots[name] for name in ("advance", "terminations", "rewards"))
    (curriculum,) = task.params.slots["curriculum"]
    diverged_ending = [slot.func for slot in endings].index(terminations.diverged)
    floor, due = task.reward_floor, task.command.resample_due

    def step_kernel(
        # in
        skill: int,
        arrays: RobotArrays,
        ground: Ground,
        num_levels: int,
        p: wp.array(dtype=float),
        observed: wp.array2d(dtype=float),
        # in, out
        episode: EpisodeArrays,
        states: wp.array(dtype=task.state),
        episode_sum: wp.array2d(dtype=float),
        found: NonFinite,
        found_states: wp.array(dtype=task.state),
        # out
        term_value: wp.array2d(dtype=float),
        counters: Counters,
    ):
        """Advance the task state of every world of `skill`, then evaluate terminations, rewards and curriculum.

        One thread per world. p: numbers of the task's terms. The first termination that holds ends the episode.
        episode_sum: (rewards, num_worlds), sums of `term_value` since the episode, or this skill in it, began.
        term_value: (rewards, num_worlds), rewards of this step, weights applied; non-finite ones add 0 to all sums.
        A reward of weight 0 is not evaluated.
        observed: observation terms before this step; found, found_states: see `record_non_finite`.
        """
        world = episode.first + wp.tid()
        if episode.skill[world] != skill:
            return
        robot = load_view(arrays, ground, world)
        state = wp.static(advance.func)(robot, states[world], *p[wp.static(advance.start) : wp.static(advance.stop)])

        termination = int(NOT_TERMINATED)
        timeout = float(0.0)
        success = bool(False)
        diverged = arrays.diverged[world] != 0 or episode.bad_action[world] != 0 or has_diverged(robot)
        faulty = int(-1)  # term with a non-finite value, other than a reward: curriculum or state
        if diverged:
            termination = wp.static(diverged_ending)
            if arrays.diverged[world] != 0 or episode.bad_action[world] != 0 or not is_finite(robot):
                faulty = wp.static(len(rewards) + 1)
        for i in range(wp.static(len(endings))):
            if termination == NOT_TERMINATED:
                if wp.static(endings[i].func)(
                    robot, state, *p[wp.static(endings[i].start) : wp.static(endings[i].stop)]
                ):
                    termination = i
                    timeout = wp.where(wp.static(bool(endings[i].time_out)), 1.0, 0.0)
                    success = wp.static(bool(endings[i].success))

        begun = episode.history_reset[world] == BEGUN
        counted = begun or episode.done[world] == 0.0  # an ended episode that continues counts once
        ended = termination != NOT_TERMINATED
        total = float(0.0)
        finite = bool(True)
        for i in range(wp.static(len(rewards))):
            weight = p[wp.static(rewards[i].weight)]
            value = float(0.0)
            if weight != 0.0 and not diverged:
                value = weight * wp.static(rewards[i].func)(
                    robot, state, *p[wp.static(rewards[i].start) : wp.static(rewards[i].stop)]
                )
                if wp.static(bool(rewards[i].scale_by_dt)):
                    value = value * arrays.step_dt
            term_value[i, world] = value
            if not wp.isfinite(value):
                finite = False
                value = float(0.0)
            total += value
        if not wp.isfinite(total):
            total = float(0.0)
        if wp.static(floor is not None):
            total = wp.max(total, wp.static(0.0 if floor is None else float(floor)))
        write_step_result(episode, counters, world, total, termination, timeout, diverged)
        states[world] = state
        running = wp.vector(length=wp.static(max(len(rewards), 1)), dtype=float)
        totals = wp.vector(length=wp.static(max(len(rewards), 1)), dtype=wp.float64)
        # Loads of all terms, then stores: a GPU waits once. Rewards are loaded again, since registers are full.
        for i in range(wp.static(len(rewards))):
            value = term_value[wp.static(i), world]
            value = wp.where(wp.isfinite(value), value, 0.0)
            running[i] = wp.where(begun, value, episode_sum[i, world] + value)
        for i in range(wp.static(len(rewards))):
            episode_sum[wp.static(i), world] = wp.where(ended, 0.0, running[i])
        listed = ended
        if wp.static(due is not None):
            listed = ended or wp.static(due)(state)
        if listed:
            place = episode.first + wp.atomic_add(episode.num_listed, episode.slice, 1)
            if place < episode.listed.shape[0]:  # a stage that is timed alone lists its worlds again
                episode.listed[place] = world
        if ended and counted:
            for i in range(wp.static(len(rewards))):
                totals[i] = counters.term_sum[wp.static(i), world] + wp.float64(running[i])
            for i in range(wp.static(len(rewards))):
                counters.term_sum[wp.static(i), world] = totals[i]
            counters.termination_count[termination, world] = counters.termination_count[termination, world] + 1
            if wp.static(curriculum.counts)(state):
                error = wp.static(curriculum.func)(robot, state)
                if not wp.isfinite(error) and faulty < 0:
                    faulty = wp.static(len(rewards))
                success = success and error <= p[wp.static(curriculum.tolerance)]
                update_curriculum(
                    episode, counters, world, success, error, p[wp.static(curriculum.promote_after)], num_levels
                )
        if not finite or faulty >= 0:
            for i in range(found.num_rewards + 2):
                value = float(wp.NAN)
                if i < found.num_rewards:
                    value = term_value[i, world]
                if i == faulty or (i < found.num_rewards and not wp.isfinite(value)):
                    record_non_finite(
                        found, i, value, world, episode, arrays, observed, term_value, states, found_states
                    )

    return unrolled_kernel(step_kernel, task.state)
