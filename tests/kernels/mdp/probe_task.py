"""Probe task: its terms return values that a test writes into its state."""

import dataclasses
from typing import Any

import numpy as np
import warp as wp

from jumper_warp.envs.skill import TaskRuntime
from jumper_warp.kernels.mdp import terminations
from jumper_warp.kernels.mdp.env import Scene, SkillSettings
from jumper_warp.kernels.mdp.parameters import RobotParameters
from jumper_warp.kernels.mdp.random import RngStream, uniform
from jumper_warp.kernels.mdp.reset import write_default_pose
from jumper_warp.kernels.mdp.view import RobotArrays, RobotView
from jumper_warp.kernels.terrain.ground import Ground
from jumper_warp.robot.motors import jumping_motors, vertical_jump_filter
from jumper_warp.tasks.cfg import Command, ObservationsCfg, Reset, TaskCfg
from jumper_warp.tasks.randomization import RandomizationCfg
from jumper_warp.tasks.terms import Advance, Curriculum, ObservationTerm, RewardTerm, TerminationTerm
from mdp_helpers import STEP_DT, SUBSTEPS, array, new_worlds, no_delays, observe, standing_robots


@wp.struct
class ProbeState:
    """State of one world's episode."""

    steps: int
    value: float
    other: float
    counts: int


@wp.struct
class ProbeSettings:
    """Settings of the reset, as the kernels read them."""

    value: float


@wp.struct
class ProbeLevel:
    """Level of the curriculum, as the kernels read it."""

    number: int


@dataclasses.dataclass(frozen=True)
class ProbeReset:
    """Settings of the reset."""

    value: float = 2.5

    struct = ProbeSettings

    def values(self, step_dt: float) -> Any:
        """Return the kernels' `ProbeSettings`."""
        settings = ProbeSettings()
        settings.value = self.value
        return settings


@dataclasses.dataclass(frozen=True)
class ProbeLevelCfg:
    """Level of the curriculum."""

    number: int

    struct = ProbeLevel

    def values(self) -> Any:
        """Return the kernels' `ProbeLevel`."""
        level = ProbeLevel()
        level.number = self.number
        return level


@wp.func
def advance_probe(robot: RobotView, state: ProbeState, growth: float) -> ProbeState:
    """Count the policy step, and add `growth` to the value."""
    new = state
    new.steps = state.steps + 1
    new.value = state.value + growth
    return new


@wp.func
def reset_probe(
    arrays: RobotArrays, scene: Scene, skill: SkillSettings, old: ProbeState, settings: ProbeSettings,
    level: ProbeLevel, rng: RngStream,
) -> ProbeState:  # fmt: skip
    """Reset the robot to the default pose; store a random number in `other` and the level in `counts`."""
    write_default_pose(arrays, scene, rng.world, 0.5, 0.25)
    new = ProbeState()
    new.value = settings.value
    new.other = uniform(rng, 0, 0.0, 1.0)
    new.counts = level.number
    return new


@wp.func
def give_probe(robot: RobotView, scene: Scene, state: ProbeState, values: wp.vec4, heading: float) -> ProbeState:
    """Store the first value in `value` and the heading in `other`."""
    new = state
    new.value = values[0]
    new.other = heading
    return new


@wp.func
def command_due(state: ProbeState) -> bool:
    """Return whether a command is due, which it is at a value of 7."""
    return state.value == 7.0


@wp.func
def draw_command(robot: RobotView, scene: Scene, state: ProbeState, level: ProbeLevel, rng: RngStream) -> ProbeState:
    """Store a random number in `other` and the level in `counts`."""
    new = state
    new.other = uniform(rng, 0, 0.0, 1.0)
    new.counts = level.number
    return new


@wp.func
def value(robot: RobotView, state: ProbeState) -> float:
    """Return the field `value`."""
    return state.value


@wp.func
def offset_square(robot: RobotView, state: ProbeState, offset: float, scale: float) -> float:
    """Return scale * (value - offset)^2."""
    return scale * (state.value - offset) * (state.value - offset)


@wp.func
def other(robot: RobotView, state: ProbeState) -> float:
    """Return the field `other`."""
    return state.other


@wp.func
def base_height(robot: RobotView, state: Any) -> float:
    """Return the height of the base [m]."""
    return robot.height


@wp.func
def other_above(robot: RobotView, state: ProbeState, limit: float) -> bool:
    """Return whether the field `other` is above a limit."""
    return state.other > limit


@wp.func
def counts(state: ProbeState) -> bool:
    """Return whether the episode counts for the curriculum."""
    return state.counts != 0


@wp.func
def both(robot: RobotView, state: ProbeState) -> wp.vec2:
    """Return the fields `value` and `other`."""
    return wp.vec2(state.value, state.other)


@wp.func
def latency_of(robot: RobotParameters, world: int) -> float:
    """Return the latency of a world's actions [physics steps]."""
    return float(robot.latency[world])


def probe_task(**changes) -> TaskCfg:
    """Return the probe task; changes: new values of its fields."""
    task = TaskCfg(
        name="probe",
        state=ProbeState,
        advance=Advance(advance_probe, growth=0.25),
        reset=Reset(reset_probe, ProbeReset()),
        command=Command(give_probe, command_due, draw_command),
        curriculum=Curriculum(value, tolerance=2.0, promote_after=3, counts=counts),
        rewards=(
            RewardTerm(value, 3.0),
            RewardTerm(offset_square, -0.5, offset=1.5, scale=2.0),
            RewardTerm(other, 4.0, scale_by_dt=False),
            RewardTerm(base_height, 10.0),
        ),
        terminations=(
            TerminationTerm(other_above, limit=1.0e3, name="first"),
            TerminationTerm(other_above, limit=1.0e2, name="second", time_out=True),
            TerminationTerm(other_above, limit=1.0e1, name="third", time_out=True, success=True),
            TerminationTerm(terminations.diverged),
            TerminationTerm(terminations.too_long, steps=100.0),
        ),
        observations=ObservationsCfg(
            actor=(
                ObservationTerm(value, noise=0.5, scale=10.0, clip=4.0),
                ObservationTerm(both, history=3),
                ObservationTerm(both, name="late", delayed=True),
            ),
            critic=(
                ObservationTerm(other),
                ObservationTerm(latency_of),
                ObservationTerm(value, name="late", delayed=True, history=2),
            ),
        ),
        motors=jumping_motors(18.0),
        command_filter=vertical_jump_filter(),
        action_scale=(15.0, 90.0),
        levels=tuple(ProbeLevelCfg(i) for i in (11, 12)),
        randomization=RandomizationCfg.off(),
        reward_floor=None,
    )
    return dataclasses.replace(task, **changes)


class Probe:
    """Worlds of the task with all their arrays, the robots at rest, and launches of its stages."""

    def __init__(self, n: int, task: TaskCfg | None = None, index: int = 0, seed: int = 0):
        """n: number of worlds; index: index of the skill."""
        self.n, self.task = n, probe_task() if task is None else task
        self.skill = TaskRuntime(self.task, index, n, STEP_DT, SUBSTEPS, "cpu")
        self.robot, self.episodes, self.delays = standing_robots(n), new_worlds(n, seed), no_delays(n)
        self.parameters, self.ground = RobotParameters(), Ground()
        self.ground.heights = array(np.zeros((1, 1)))
        self.parameters.latency = array(np.zeros(n), int)
        self.parameters.skill = self.episodes.skill
        self.latency = array(np.zeros(n), int)
        self.skill.observations.latency = self.latency

    def write(self, **fields) -> None:
        """Overwrite fields of all worlds' states."""
        records = self.skill.states.numpy().copy()
        for name, values in fields.items():
            records[name] = values
        self.skill.states.assign(wp.array(records, dtype=ProbeState, device="cpu"))

    def read(self, name: str) -> np.ndarray:
        """Return a field of all worlds' states."""
        return self.skill.states.numpy()[name].copy()

    def world(self, name: str) -> np.ndarray:
        """Return an array of `EpisodeArrays`."""
        return getattr(self.episodes, name).numpy().copy()

    def step(self) -> None:
        """Launch the end of a step."""
        skill = self.skill
        inputs = [skill.index, self.robot, self.ground, len(self.task.levels), skill.params.values,
                  skill.observations.raw, self.episodes, skill.states, skill.episode_sum, skill.found,
                  skill.found_states, skill.term_value, skill.counters]  # fmt: skip
        wp.launch(skill.kernels["step"], self.n, inputs, device="cpu")

    def observe(self, after_reset: int = 0) -> None:
        """Launch the observation."""
        states, numbers = self.skill.states, self.skill.params.values
        observe(self.skill, self.robot, self.parameters, self.ground, self.episodes, states, numbers, after_reset)

    def next_clock(self) -> None:
        """Increment the step count of all worlds, and clear their `history_reset`."""
        self.episodes.step_count.assign(self.episodes.step_count.numpy() + 1)
        self.episodes.history_reset.zero_()

    def obs(self, group: str, final: bool = False) -> np.ndarray:
        """Return an observation group, (n, columns)."""
        return (self.skill.final_obs if final else self.skill.obs)[group].numpy().copy()
