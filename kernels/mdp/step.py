"""The end of a policy step: the task moves on, its terminations and rewards, and the curriculum."""

from typing import Any

import warp as wp

from ..terrain.ground import Ground
from .env import Counters, EnvArrays
from .options import FAST
from .terminations import came_apart
from .view import RobotArrays, has_diverged, load_view

NOT_ENDED = wp.constant(-1)


@wp.func
def count_episode(
    env: EnvArrays, counters: Counters, world: int, success: bool, error: float, promote_after: float, num_levels: int
):
    """Take an ended episode into the curriculum: successes in a row raise the world's level."""
    streak = wp.where(success, env.streak[world] + 1, 0)
    if streak >= int(promote_after):
        streak = int(0)
        env.level[world] = wp.min(env.level[world] + 1, num_levels)
    env.streak[world] = streak
    counters.counted[world] = counters.counted[world] + 1
    if success:
        counters.succeeded[world] = counters.succeeded[world] + 1
        counters.error_sum[world] = counters.error_sum[world] + wp.float64(error)


@wp.func
def write_outcome(
    env: EnvArrays, counters: Counters, world: int, total: float, ending: int, timeout: float, broken: bool
):
    """Write how a policy step of a world ended."""
    env.reward[world] = total
    env.ending[world] = ending
    env.done[world] = wp.where(ending == NOT_ENDED, 0.0, 1.0)
    env.timeout[world] = timeout
    env.terminated[world] = ending != NOT_ENDED and timeout == 0.0
    env.truncated[world] = timeout != 0.0
    env.broken[world] = wp.where(broken, 1, 0)
    counters.bad_actions[world] = counters.bad_actions[world] + env.bad_action[world]
    env.bad_action[world] = 0
    env.clock[world] = env.clock[world] + 1
    env.history_reset[world] = 0


def make_step_kernel(task: Any) -> wp.Kernel:
    """Return the kernel that ends a policy step; task: see `jumper_warp.tasks.cfg.TaskCfg`."""
    (advance,), endings, rewards = (task.params.slots[name] for name in ("advance", "terminations", "rewards"))
    (curriculum,) = task.params.slots["curriculum"]
    broken_ending = [slot.func for slot in endings].index(came_apart)
    floor = task.reward_floor

    @wp.kernel(module="unique", module_options=FAST)
    def step_kernel(
        # in
        skill: int,
        arrays: RobotArrays,
        ground: Ground,
        num_levels: int,
        p: wp.array(dtype=float),
        # in, out
        env: EnvArrays,
        states: wp.array(dtype=task.state),
        # out
        term_value: wp.array2d(dtype=float),
        counters: Counters,
    ):
        """Move every world of the skill on by one policy step; one thread per world.

        term_value: rewards of this step, weights applied, (rewards, num_worlds). Those that are not finite count 0.
        """
        world = env.first + wp.tid()
        if env.skill[world] != skill:
            return
        robot = load_view(arrays, ground, world)
        if wp.static(advance.plain):
            state = wp.static(advance.func)(robot, states[world])
        else:
            state = wp.static(advance.func)(robot, states[world], *p[wp.static(advance.lo) : wp.static(advance.hi)])

        ending = int(NOT_ENDED)
        timeout = float(0.0)
        success = bool(False)
        broken = arrays.diverged[world] != 0 or env.bad_action[world] != 0 or has_diverged(robot)
        if broken:
            ending = wp.static(broken_ending)
        for i in range(wp.static(len(endings))):
            if ending == NOT_ENDED:
                if wp.static(endings[i].plain):
                    holds = wp.static(endings[i].func)(robot, state)
                else:
                    holds = wp.static(endings[i].func)(
                        robot, state, *p[wp.static(endings[i].lo) : wp.static(endings[i].hi)]
                    )
                if holds:
                    ending = i
                    timeout = wp.where(wp.static(bool(endings[i].time_out)), 1.0, 0.0)
                    success = wp.static(bool(endings[i].success))

        total = float(0.0)
        for i in range(wp.static(len(rewards))):
            if wp.static(rewards[i].plain):
                raw = wp.static(rewards[i].func)(robot, state)
            else:
                raw = wp.static(rewards[i].func)(robot, state, *p[wp.static(rewards[i].lo) : wp.static(rewards[i].hi)])
            value = p[wp.static(rewards[i].weight)] * raw
            if wp.static(not rewards[i].once):
                value = value * arrays.step_dt
            if broken:
                value = float(0.0)
            term_value[i, world] = value
            counters.term_sum[i, world] = counters.term_sum[i, world] + wp.float64(value)
            if wp.isfinite(value):
                total += value
        if not wp.isfinite(total):
            total = float(0.0)
        if wp.static(floor is not None):
            total = wp.max(total, wp.static(0.0 if floor is None else float(floor)))
        write_outcome(env, counters, world, total, ending, timeout, broken)
        states[world] = state
        if ending != NOT_ENDED:
            counters.ending_count[ending, world] = counters.ending_count[ending, world] + 1
            if wp.static(curriculum.counts)(state):
                error = wp.static(curriculum.func)(robot, state)
                success = success and error <= p[wp.static(curriculum.tolerance)]
                count_episode(env, counters, world, success, error, p[wp.static(curriculum.promote_after)], num_levels)

    return step_kernel
