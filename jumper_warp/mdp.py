"""Names for defining rewards, observations and tasks, gathered in one module to import.

    from dataclasses import replace
    import warp as wp
    from jumper_warp import make_task, mdp

    @wp.func
    def level(robot: mdp.RobotView, state: mdp.JumpState, scale: float) -> float:
        return wp.where(state.phase == mdp.FLIGHT, mdp.rewards.psi(mdp.tilt(robot), scale), 0.0)

    jump = make_task("vertical-jump")
    jump = replace(jump, rewards=(*jump.rewards, mdp.RewardTerm(level, weight=2.0, scale=0.1)))

Stock terms are in the namespaces `rewards`, `terminations`, `observations` and `events`; `events` also has the
functions with which an event writes a world's parameters. `mirror` has mirror images of common observations. Jumps use
`jumping_motors` and `vertical_jump_filter`, walks `walking_motors` and `walking_filter`; other motors and command
filters are in `jumper_warp.robot.motors`.
"""

import inspect
import re

from jumper_warp.kernels.attitude.state import AttitudeState
from jumper_warp.kernels.jump.state import FLIGHT, LANDED, STANCE, JumpState, commanded, waiting
from jumper_warp.kernels.mdp import mirror, observations, rewards, terminations
from jumper_warp.kernels.mdp import parameters as events
from jumper_warp.kernels.mdp.env import NoSettings, Scene, SkillSettings
from jumper_warp.kernels.mdp.parameters import RobotParameters
from jumper_warp.kernels.mdp.random import RngStream, clamped_normal, fold_in, uniform, uniform_range
from jumper_warp.kernels.mdp.reset import write_default_pose
from jumper_warp.kernels.mdp.view import RobotArrays, RobotView, in_flight, tilt, vec12, yaw_of
from jumper_warp.kernels.terrain.ground import Ground, surface, world_ground
from jumper_warp.kernels.velocity.state import VelocityState
from jumper_warp.robot.motors import jumping_motors, vertical_jump_filter, walking_filter, walking_motors
from jumper_warp.tasks.cfg import Command, Handover, ObservationsCfg, Reset, TaskCfg
from jumper_warp.tasks.evaluation import EpisodeEvaluation, EpisodeMetric
from jumper_warp.tasks.randomization import RandomizationCfg
from jumper_warp.tasks.terms import (
    Advance,
    Curriculum,
    EventTerm,
    ObservationTerm,
    RewardTerm,
    StateMetric,
    TerminationTerm,
)

for struct in (AttitudeState, Ground, JumpState, RobotArrays, RobotParameters, RobotView, Scene, VelocityState):
    source = inspect.getsource(struct.cls)
    fields = [": ".join(field) for field in re.findall(r"^    (\w+): .*?  # (.+)$", source, re.MULTILINE)]
    struct.__doc__ = "\n".join([inspect.getdoc(struct.cls) or "", "", *fields])

del fields, inspect, re, source, struct  # all other names are for authors of tasks
