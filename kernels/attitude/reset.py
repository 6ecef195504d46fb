"""Reset of the attitude task: sampled goal and episode length; `start_states` samples the state of the robot."""

import warp as wp

from ..mdp.attempts import sync_attempts
from ..mdp.durations import whole_steps
from ..mdp.env import Scene, SkillSettings
from ..mdp.random import RngStream, fold_in, uniform_range
from ..mdp.view import RobotArrays
from ..terrain.ground import rest_block
from . import streams
from .commands import TurnRanges, sample_rotation, sample_unit_quat
from .start_states import AttitudeSettings, write_start
from .state import AttitudeState, carried_over, with_goal

wp.set_module_options({"enable_backward": False})


@wp.func
def reset_attitude(
    arrays: RobotArrays, scene: Scene, skill: SkillSettings, old: AttitudeState, settings: AttitudeSettings,
    level: TurnRanges, rng: RngStream,
) -> AttitudeState:  # fmt: skip
    """Write a sampled start state to world `rng.world`, and return the task state of its new episode.

    On a GPU all threads of a world run it: they draw the same numbers, and share the attempts of `write_start`. old:
    state of the previous episode, whose statistics carry over. level: ranges of the rotation to the goal, which is
    relative to the sampled orientation. episode_steps is rounded to the nearest number of policy steps.
    """
    new = carried_over(old)
    rest_block(scene.ground, rng.world)
    quat = sample_unit_quat(fold_in(rng, streams.ORIENTATION_BRANCH))
    sync_attempts(rng)  # all threads have put the block back before any reads the ground
    write_start(arrays, scene, skill, settings, quat, rng)
    new.episode_steps = wp.max(whole_steps(uniform_range(rng, streams.EPISODE_STEPS, settings.episode_steps) + 0.5), 1)
    return with_goal(new, quat, quat * sample_rotation(fold_in(rng, streams.TURN_BRANCH), level))
