"""Episode bookkeeping of all worlds, and the settings of each skill.

A world is one robot with its ground. Worlds may run different skills (tasks, such as walking or jumping) at a time;
kernels of a skill return at once in worlds of another one. A policy step lasts 1/60 s and has several physics steps.
Host and device exchange flags as arrays, so that a policy step is one captured graph without waiting.
"""

import warp as wp

from ..actuation.command_filter import FilterParams
from ..kinematics.geometry import LegGeometry
from ..terrain.ground import Ground
from .view import vec12

BEGUN = wp.constant(1)  # `history_reset`: an episode or skill began in this step, so observations have no history
COMMANDED = wp.constant(2)  # `history_reset`: a new command was set within an episode
RING = wp.constant(8)
"""Length [policy steps] of the ring buffers of targets and observations; a constant, since kernels divide by it."""


@wp.struct
class Scene:
    """Scene that all worlds share: leg geometry, ground and default pose.

    `reference_q` holds COORDS (43) numbers for each world: position of the base's origin [m], its orientation (xyzw,
    body to world), five joint angles of each leg [rad], and a quaternion of each leg's loop joint; see `layout`.
    """

    geometry: wp.array(dtype=LegGeometry)  # (4 num_robots,) FL, FR, BL, BR of each described robot; see `leg_of`
    ground: Ground
    reference_q: wp.array(dtype=float)  # (COORDS num_worlds,) default pose in the layout of `joint_q`, world by world


@wp.struct
class NoSettings:
    """Struct without content: the settings of a reset, or level of a task, that has none."""

    unused: float


@wp.struct
class EpisodeArrays:
    """Episode state of all worlds (step counts, active tasks, rewards, end flags, levels), arrays (num_worlds,)."""

    seed: int  # of all random streams, as is `purpose`
    purpose: int  # index in `jumper_warp.utils.streams.PURPOSES`
    first: int  # world of the first thread of a launch
    slice: int  # index of the launch's slice of worlds
    listed_only: int  # 1: a launch's threads take the worlds of `listed`, see `launched_world`
    listed: wp.array(dtype=int)  # from `first` on: worlds whose episode ended, or whose command is due, in this step
    num_listed: wp.array(dtype=int)  # by slice, the number of its worlds in `listed`
    step_count: wp.array(dtype=int)  # policy steps made; with seed and purpose, the whole state of the random streams
    skill: wp.array(dtype=int)  # index of a world's active task
    requested_task: wp.array(dtype=int)  # index of the requested task (`Env.request`), -1: none
    pending_command: wp.array(dtype=wp.vec4)  # command of the requested skill, set when it takes over
    has_command: wp.array(dtype=int)  # 1: `pending_command` is set
    history_reset: wp.array(dtype=int)  # BEGUN, COMMANDED, else 0
    reward: wp.array(dtype=float)  # of the last policy step
    done: wp.array(dtype=float)  # 1: the episode ended
    timeout: wp.array(dtype=float)  # 1: it ended without failure, as `truncated`
    terminated: wp.array(dtype=wp.bool)  # it ended with failure
    truncated: wp.array(dtype=wp.bool)  # it ended without failure (by a termination with `time_out`)
    termination: wp.array(dtype=int)  # index of the termination term that ended it, -1: none
    diverged: wp.array(dtype=int)  # 1: the state is not finite or too fast; observations are 0
    bad_action: wp.array(dtype=int)  # 1: the action was not finite; the world counts as diverged at the end of the step
    level: wp.array(dtype=int)  # curriculum level; num_levels: all were passed
    streak: wp.array(dtype=int)  # consecutive successes


@wp.func
def launched_world(episode: EpisodeArrays, index: int) -> int:
    """Return the world of a launch's thread `index`, or -1 if it has none.

    With `listed_only` few worlds are left, which the first threads take, so that no block starts late.
    """
    if episode.listed_only == 0:
        return episode.first + index
    if index < episode.num_listed[episode.slice]:
        return episode.listed[episode.first + index]
    return -1


@wp.struct
class Counters:
    """Statistics of episodes that accumulate on the device until the host reads and clears them."""

    term_sum: wp.array2d(dtype=wp.float64)  # (rewards, num_worlds) `episode_sum`, summed over ended episodes
    termination_count: wp.array2d(dtype=int)  # (terminations, num_worlds) ended episodes by termination term
    curriculum_episodes: wp.array(dtype=int)  # (num_worlds,) ended episodes that count for the curriculum
    curriculum_successes: wp.array(dtype=int)  # of these, successful
    error_sum: wp.array(dtype=wp.float64)  # (num_worlds,) sum of curriculum errors of these, unit of the task
    bad_actions: wp.array(dtype=int)  # (num_worlds,) policy steps with a non-finite action


@wp.struct
class SkillSettings:
    """Constants of a skill (task), such as scale and filter of actions and margins of collision checks."""

    action_scale: vec12  # [rad] offset from the default pose at an action of 1
    command_filter: FilterParams
    contact_force: float  # [N] a paw with more is in contact
    push_in_flight: int  # 1: pushes act in the air too
    eval_height_offset: float  # [m] height above standing at which evaluations begin
    self_collision_margin: float  # [m] links closer to one another than this count as touching
    obstacle_margin: float  # [m] blocks count as wider and higher by this in collision checks


@wp.struct
class Delays:
    """Actuation latency: the last motor targets, and the two targets that motors follow within a policy step."""

    target_history: wp.array3d(dtype=float)  # [rad] (RING, 12, num_worlds) filtered targets by policy step % RING
    steps: wp.array(dtype=int)  # [physics steps] (num_worlds,) latency from action to motor
    substeps: int  # physics steps in a policy step
    switch_step: wp.array(dtype=int)  # (num_worlds,) physics step in the policy step, first with `current_target`
    current_target: wp.array2d(dtype=float)  # [rad] (12, num_worlds) target from `switch_step` on
    prev_target: wp.array2d(dtype=float)  # [rad] (12, num_worlds) target before `switch_step`
