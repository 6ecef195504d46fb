"""The end of a policy step: phases, rewards, terminations and curriculum, in one kernel compiled from two tables."""

import warp as wp

from ..collision.robot import world_collisions
from ..jump.phase import advance_jump
from ..jump.task import JumpTask, ViewArrays, load_view, speed_limit_broken
from ..jump.terminations import came_apart
from ..kinematics.geometry import LegGeometry
from ..layout import COORDS
from ..scalar import real
from ..terrain.ground import Ground

NO_RULE = -1


@wp.struct
class EpisodeSettings:
    """Numbers of the episode that do not change."""

    step_dt: float  # [s]
    contact_force: float  # [N] above which a paw counts as in contact
    takeoff_speed: float  # [m/s] upward, that begins a flight
    near: float  # [m] error up to which a landed jump is a success
    games: int  # successes in a row that raise the level
    num_levels: int
    counting_schemes: int  # reset schemes below this number count for curriculum and success


@wp.struct
class EpisodeArrays:
    """Per-world results; counters grow until the host clears them."""

    reward: wp.array(dtype=float)
    done: wp.array(dtype=float)  # 1: the episode ended
    timeout: wp.array(dtype=float)  # 1: it ended without failure
    rule: wp.array(dtype=int)  # index of the termination, -1: none
    term_value: wp.array2d(dtype=float)  # (terms, worlds), of this step, weight applied
    term_sum: wp.array2d(dtype=float)  # (terms, worlds), counter
    rule_count: wp.array2d(dtype=int)  # (rules, worlds), counter
    counted: wp.array(dtype=int)  # ended episodes of counting schemes, counter
    succeeded: wp.array(dtype=int)  # of these, successful, counter
    error_sum: wp.array(dtype=float)  # [m] of the successful ones, counter


@wp.func
def next_level(task: JumpTask, success: bool, settings: EpisodeSettings) -> JumpTask:
    """Return the episode with streak and level moved on; level = num_levels means that all were passed."""
    t = task
    t.streak = wp.where(success, task.streak + 1, 0)
    if t.streak >= settings.games:
        t.streak = 0
        t.level = wp.min(task.level + 1, settings.num_levels)
    return t


def make_episode_kernel(terms: tuple, rules: tuple, task_error: wp.Function) -> wp.Kernel:
    """Return the kernel of a task.

    terms: objects with `func` (view, task, p) -> float and `once`; rules: objects with `func` (view, task, p) -> bool
    and `success`, in order of precedence; task_error: (view, task) -> distance from the goal [m].
    """
    term_funcs = [term.func for term in terms]
    term_once = [bool(term.once) for term in terms]
    rule_funcs = [rule.func for rule in rules]
    rule_success = [bool(rule.success) for rule in rules]
    num_terms, num_rules = len(terms), len(rules)
    broken_rule = rule_funcs.index(came_apart)

    @wp.kernel(module="unique", enable_backward=False)
    def episode_kernel(
        # in
        arrays: ViewArrays,
        geometry: wp.array(dtype=LegGeometry),
        ground: Ground,
        invalid: wp.array(dtype=int),
        settings: EpisodeSettings,
        weight: wp.array(dtype=float),
        term_params: wp.array(dtype=wp.vec4),
        rule_params: wp.array(dtype=wp.vec4),
        # in, out
        tasks: wp.array(dtype=JumpTask),
        out: EpisodeArrays,
    ):
        """Move every world's episode on by one policy step; one thread per world."""
        world = wp.tid()
        view = load_view(arrays, ground, world, settings.contact_force)
        view.collisions = world_collisions(geometry, ground, arrays.joint_q, world * COORDS, real(0.0)).flags
        task = advance_jump(tasks[world], view, arrays.old_lin_vel[world], settings.takeoff_speed)

        rule = int(NO_RULE)
        timeout = float(0.0)
        broken = invalid[world] != 0 or speed_limit_broken(view)
        if broken:
            rule = wp.static(broken_rule)
        for i in range(wp.static(num_rules)):
            if rule == NO_RULE and wp.static(rule_funcs[i])(view, task, rule_params[i]):
                rule = i
                timeout = wp.where(wp.static(rule_success[i]), 1.0, 0.0)

        total = float(0.0)
        for i in range(wp.static(num_terms)):
            value = weight[i] * wp.static(term_funcs[i])(view, task, term_params[i])
            if wp.static(not term_once[i]):
                value = value * settings.step_dt
            if broken:
                value = float(0.0)
            out.term_value[i, world] = value
            out.term_sum[i, world] = out.term_sum[i, world] + value
            total += value
        if not wp.isfinite(total):
            total = float(0.0)
        out.reward[world] = wp.max(total, 0.0)
        out.rule[world] = rule
        out.done[world] = wp.where(rule == NO_RULE, 0.0, 1.0)
        out.timeout[world] = timeout
        if rule != NO_RULE:
            out.rule_count[rule, world] = out.rule_count[rule, world] + 1
            if task.scheme < settings.counting_schemes:
                error = task_error(view, task)
                success = rule == 0 and error <= settings.near
                task = next_level(task, success, settings)
                out.counted[world] = out.counted[world] + 1
                if success:
                    out.succeeded[world] = out.succeeded[world] + 1
                    out.error_sum[world] = out.error_sum[world] + error
        tasks[world] = task

    return episode_kernel
