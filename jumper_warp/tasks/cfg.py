"""What a task is: its state, tables of terms, resets, commands, curriculum and randomisation, as data."""

from __future__ import annotations

import functools
import math
import operator
from dataclasses import dataclass, field, replace
from typing import Any

from jumper_warp.kernels.mdp.env import NoSettings
from jumper_warp.kernels.mdp.starts import MIN_LINK_DISTANCE
from jumper_warp.kernels.mdp.terminations import came_apart
from jumper_warp.robot.gravity import EARTH, check_gravity
from jumper_warp.robot.motors import FilterCfg, MotorCfg
from jumper_warp.tasks.params import TaskParams
from jumper_warp.tasks.randomization import RandomizationCfg
from jumper_warp.tasks.ranges import Pair
from jumper_warp.tasks.terms import (
    Advance,
    Curriculum,
    EventTerm,
    ObservationTerm,
    RewardTerm,
    StateMetric,
    Term,
    TerminationTerm,
)
from jumper_warp.utils.checks import check_not_negative
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.kernels import Function


@dataclass(frozen=True)
class Reset:
    """How an episode begins."""

    func: Function
    """(arrays: RobotArrays, scene: Scene, skill: SkillSettings, old, settings, level, rng: RngStream) -> state of
    the new episode; writes coordinates and rates of `rng.world`."""
    settings: Any = None
    """Frozen dataclass with `struct`, the type of the kernels' settings, and `values(step_dt)`, which makes them."""
    parallel: bool = False
    """Whether `func` makes attempts `range(rng.lane, number, rng.lanes)`, which threads of a GPU share: they run it
    with the same arguments but for `rng.lane`, and all that they write otherwise must be the same."""


@dataclass(frozen=True)
class Command:
    """Command of a task: set from outside, and resampled within an episode."""

    set: Function
    """(robot, scene: Scene, state, values: wp.vec4, heading: float) -> state with a command from outside."""
    resample_due: Function | None = None
    """(state) -> bool, whether a new command is drawn within the episode."""
    resample: Function | None = None
    """(robot, scene: Scene, state, level, rng: RngStream) -> state with a new command."""

    def __post_init__(self) -> None:
        """Raise InputError: one of resample_due and resample is missing."""
        if (self.resample_due is None) != (self.resample is None):
            raise InputError("a command needs both resample_due and resample, or neither")


@dataclass(frozen=True)
class ObservationsCfg:
    """Observation terms of the two networks."""

    actor: tuple[ObservationTerm, ...]
    critic: tuple[ObservationTerm, ...]


@dataclass(frozen=True)
class TaskCfg:
    """A task on the robot."""

    name: str
    state: Any
    """The `@wp.struct` of one world's state; it counts the episode's policy steps in `steps`."""
    advance: Advance
    reset: Reset
    command: Command
    curriculum: Curriculum
    rewards: tuple[RewardTerm, ...]
    terminations: tuple[TerminationTerm, ...]
    """The first that holds ends the episode."""
    observations: ObservationsCfg
    motors: MotorCfg
    command_filter: FilterCfg
    action_scale: Pair
    """[deg] Lateral and transversal."""
    levels: tuple[Any, ...] = ()
    """Curriculum, easiest first: frozen dataclasses with `struct` and `values()`, as the reset's settings."""
    events: tuple[EventTerm, ...] = ()
    """Besides those of `randomization`."""
    randomization: RandomizationCfg = field(default_factory=RandomizationCfg)
    gravity: float = EARTH
    """[m/s^2] Downward, of every world; all estimates of flights take it from there."""
    keep_momentum: bool = False
    """Whether robots in free flight keep their momentum exactly, as in `Simulation`."""
    eval_height_offset: float = 0.0
    """[m] Above standing, at which robots begin whose policy is measured."""
    contact_force: float = 0.1
    """[N] Above it a paw counts as in contact."""
    self_collision_margin: float = 0.0
    """[m] Links closer to one another than this count as touching, in training; in tests of policies links touch."""
    obstacle_margin: float = 0.0
    """[m] By which blocks are wider and higher for links that must not touch them, in training, not in tests either."""
    reward_floor: float | None = 0.0
    """Least total reward of a step; None: no floor."""
    metrics: tuple[StateMetric, ...] = ()
    """What is logged of the state, besides the means of all terms."""
    evaluation_suite: str = "episode"
    """How policies are measured and played: a key of `jumper_warp.evaluation.evaluations.EVALUATIONS`."""

    groups = ("actor", "critic")
    """Names of the observation groups."""

    def __post_init__(self) -> None:
        """Raise InputError: two terms share a name, one is for another task's state, or a setting is out of range."""
        for section in ("rewards", "terminations", "observations.actor", "observations.critic", "events"):
            names = [term.name for term in operator.attrgetter(section)(self)]
            if len(set(names)) < len(names):
                raise InputError(f"every term of {self.name}'s {section} needs a name of its own, got {names}")
        for section, slots in self.params.slots.items():
            for term in (slot.term for slot in slots):
                if term.of_state not in (Any, self.state):
                    wanted = f"is for {term.of_state.key}, not {self.state.key}"
                    raise InputError(f"{self.name} {section}: {term.name} {wanted}")
        self._check_functions()
        if came_apart not in [term.func for term in self.terminations]:
            raise InputError(f"{self.name} needs the termination came_apart, for worlds whose state is no longer one")
        if not all(0.0 < scale < math.inf for scale in self.action_scale):
            raise InputError(f"{self.name}: action_scale must be positive and finite [deg], got {self.action_scale}")
        for metric in self.metrics:
            for field_name in {metric.field, metric.per or metric.field} - set(self.state.vars):
                raise InputError(f"{self.name}: metric {metric.name} needs {field_name!r}, which its state has not")
        check_gravity(self.gravity)
        for name in ("eval_height_offset", "contact_force", "obstacle_margin"):
            check_not_negative(f"{self.name}: {name}", getattr(self, name))
        if not 0.0 <= self.self_collision_margin <= MIN_LINK_DISTANCE:
            limits = f"[0, {MIN_LINK_DISTANCE:g}], got {self.self_collision_margin}"
            raise InputError(f"{self.name}: self_collision_margin must be in {limits}")
        if self.reward_floor is not None and not math.isfinite(self.reward_floor):
            raise InputError(f"{self.name}: reward_floor must be finite or None, got {self.reward_floor}")

    def without_margins(self) -> TaskCfg:
        """Return the task as policies are tested on it: links touch where they do."""
        return replace(self, self_collision_margin=0.0, obstacle_margin=0.0)

    def _check_functions(self) -> None:
        """Raise InputError: a function outside the tables takes other structs than those of this task."""
        if len({level.struct for level in self.levels}) > 1:
            raise InputError(f"{self.name}: all levels must be of one kind")
        state, level = self.state, self.level_type
        expected = {
            "reset": (self.reset.func, {3: state, 4: self.settings_type, 5: level}),
            "command set": (self.command.set, {2: state}),
            "command resample_due": (self.command.resample_due, {0: state}),
            "command resample": (self.command.resample, {2: state, 3: level}),
            "curriculum counts": (self.curriculum.options["counts"], {0: state}),
        }
        for where, (func, structs) in expected.items():
            if func is None:
                continue
            found = list(func.input_types.values())
            for place, struct in structs.items() if found else ():
                kind = found[place] if len(found) > place else None
                if kind not in (Any, struct):
                    what = f"argument {place + 1} of {func.key} is {getattr(kind, 'key', kind)}"
                    raise InputError(f"{self.name} {where}: {what}, the task has {struct.key}")

    @functools.cached_property
    def params(self) -> TaskParams:
        """Numbers of all terms."""
        sections = {"advance": (self.advance,), "curriculum": (self.curriculum,), "rewards": self.rewards,
                    "terminations": self.terminations, "observations.actor": self.observations.actor,
                    "observations.critic": self.observations.critic,
                    "events": (*self.randomization.events(), *self.events)}  # fmt: skip
        return TaskParams(self.name, sections)

    def layout(self, group: str) -> dict[str, tuple[int, int]]:
        """Return the columns of an observation group, (first, end) by the name of the term."""
        columns, first = {}, 0
        for term in getattr(self.observations, group):
            end = first + term.width * term.options["history"]
            columns[term.name], first = (first, end), end
        return columns

    @property
    def observation_names(self) -> tuple[str, ...]:
        """Names of all columns that the policy sees, in order."""
        return tuple(column for term in self.observations.actor for column in term.columns)

    @property
    def settings_type(self) -> Any:
        """The struct of the reset's settings."""
        return NoSettings if self.reset.settings is None else self.reset.settings.struct

    @property
    def level_type(self) -> Any:
        """The struct of a level."""
        return self.levels[0].struct if self.levels else NoSettings

    def with_terms(self, section: str, **changes: dict[str, Any]) -> TaskCfg:
        """Return the task with other numbers or options in terms of a section, by name.

        Raises InputError for an unknown term or number.
        """
        terms: tuple[Term, ...] = getattr(self, section)
        unknown = set(changes) - {term.name for term in terms}
        if unknown:
            raise InputError(f"{self.name} has no {section} term {sorted(unknown)[0]!r}")
        return replace(self, **{section: tuple(term.replace(**changes.get(term.name, {})) for term in terms)})

    def without_noise(self) -> TaskCfg:
        """Return the task with exact observations."""
        exact = {g: tuple(term.replace(noise=0.0) for term in getattr(self.observations, g)) for g in self.groups}
        return replace(self, observations=ObservationsCfg(**exact))

    @property
    def draws_ground(self) -> bool:
        """Whether its resets draw another ground than a level one."""
        return bool(getattr(self.reset.settings, "draws_ground", False))

    @property
    def terrain(self) -> Any:
        """The heightfield that its episodes begin on, as `Simulation(ground=...)` takes it; None: a plane."""
        make = getattr(self.reset.settings, "heightfield", None)
        return None if make is None else make()

    def on_level_ground(self) -> TaskCfg:
        """Return the task whose resets leave the ground as it is."""
        if not hasattr(self.reset.settings, "on_level_ground"):
            return self
        return replace(self, reset=replace(self.reset, settings=self.reset.settings.on_level_ground()))

    def nominal(self) -> TaskCfg:
        """Return the task without randomisation and other events."""
        return replace(self, randomization=RandomizationCfg.off(), events=())


@dataclass(frozen=True)
class Handover:
    """When and how a world goes from one task to another; the robot is left as it is."""

    source: TaskCfg
    target: TaskCfg
    when: Function
    """(robot, task of the source, requested: bool) -> bool"""
    begin: Function
    """(robot, task of the source) -> task of the target; then the target's `Command.set`, if the request has one."""
