"""What an environment keeps of every world besides the robot, and the settings of each skill."""

import warp as wp

from ..actuation.command_filter import FilterParams
from ..kinematics.geometry import LegGeometry
from ..terrain.ground import Ground
from .view import vec12

BEGUN = wp.constant(1)
COMMANDED = wp.constant(2)
RING = wp.constant(8)
"""Policy steps that the rings of past targets and observations hold; known to the compiler, which divides by it."""


@wp.struct
class Scene:
    """What all worlds have in common."""

    geometry: wp.array(dtype=LegGeometry)  # (4,)
    ground: Ground
    reference_q: wp.array(dtype=float)  # joint_q of the default pose, all worlds


@wp.struct
class NoSettings:
    """Stands for the settings of a reset, or a level, that has none."""

    unused: float


@wp.struct
class EpisodeArrays:
    """Bookkeeping of all worlds, arrays of shape (num_worlds,)."""

    seed: int
    first: int  # world of the first thread of a launch
    step_count: wp.array(dtype=int)  # policy steps made; with the seed, all state of the random numbers
    skill: wp.array(dtype=int)  # index of the task that a world is in
    requested_task: wp.array(dtype=int)  # skill that is asked for, -1: none
    pending_command: wp.array(dtype=wp.vec4)  # command that the skill is given when it takes over
    has_command: wp.array(dtype=int)  # 1: there is one
    history_reset: wp.array(
        dtype=int
    )  # BEGUN: an episode or a skill, observations have no past; COMMANDED: within an episode
    reward: wp.array(dtype=float)
    done: wp.array(dtype=float)  # 1: the episode ended
    timeout: wp.array(dtype=float)  # 1: it ended without failure
    terminated: wp.array(dtype=wp.bool)  # it ended with failure
    truncated: wp.array(dtype=wp.bool)  # it ended without
    termination: wp.array(dtype=int)  # index of the termination, -1: none
    diverged: wp.array(dtype=int)  # 1: the state is not one of a robot; observations are 0
    bad_action: wp.array(dtype=int)  # 1: the action was not finite; the world is broken at the end of the step
    level: wp.array(dtype=int)  # curriculum; the number of levels means that all were passed
    streak: wp.array(dtype=int)  # successes in a row


@wp.struct
class Counters:
    """Results that grow until the host clears them."""

    term_sum: wp.array2d(dtype=wp.float64)  # (rewards, num_worlds)
    termination_count: wp.array2d(dtype=int)  # (terminations, num_worlds)
    curriculum_episodes: wp.array(dtype=int)  # (num_worlds,) ended episodes that count for the curriculum
    curriculum_successes: wp.array(dtype=int)  # of these, successful
    error_sum: wp.array(dtype=wp.float64)  # of the successful ones
    bad_actions: wp.array(dtype=int)  # actions that were not finite


@wp.struct
class SkillSettings:
    """How a skill drives the robot."""

    action_scale: vec12  # [rad]
    command_filter: FilterParams
    contact_force: float  # [N] above it a paw is in contact
    push_in_flight: int  # 1: pushes act in the air too
    lift: float  # [m] above standing, at which robots begin whose policy is measured
    link_margin: float  # [m] links closer to one another than this count as touching
    block_margin: float  # [m] by which blocks are wider and higher for what must not touch them


@wp.struct
class Delays:
    """Latency: what was commanded lately, and which of it the motors follow."""

    target_history: wp.array3d(dtype=float)  # [rad] (RING, 12, num_worlds) filtered targets, a ring over policy steps
    steps: wp.array(dtype=int)  # [physics steps] (num_worlds,) from action to motor
    substeps: int  # physics steps in a policy step
    switch_step: wp.array(dtype=int)  # [physics steps] (num_worlds,) what is left of the latency in a policy step
    current_target: wp.array2d(dtype=float)  # [rad] (12, num_worlds) what the motors follow after `late_steps`
    prev_target: wp.array2d(dtype=float)  # [rad] (12, num_worlds) what they follow before
