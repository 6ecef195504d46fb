"""Definition of a task as data: state, terms, reset, command, curriculum and randomisation."""

from __future__ import annotations

import functools
import operator
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import newton
import numpy as np
import warp as wp

from jumper_warp.kernels.mdp.durations import NEVER
from jumper_warp.kernels.mdp.env import NoSettings, Scene, SkillSettings
from jumper_warp.kernels.mdp.random import RngStream
from jumper_warp.kernels.mdp.starts import MIN_LINK_DISTANCE
from jumper_warp.kernels.mdp.terminations import diverged, too_long
from jumper_warp.kernels.mdp.view import RobotArrays, RobotView
from jumper_warp.robot.gravity import EARTH, check_gravity
from jumper_warp.robot.motors import FilterCfg, MotorCfg
from jumper_warp.tasks import terms
from jumper_warp.tasks.copying import Copyable, Struct
from jumper_warp.tasks.evaluation import EpisodeEvaluation, Evaluation
from jumper_warp.tasks.functions import check_result, check_values, place_of, shown_type
from jumper_warp.tasks.randomization import RandomizationCfg
from jumper_warp.tasks.ranges import Pair
from jumper_warp.utils.checks import MOST_SETTING, NAME, check_bounds, check_types
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.kernels import Function

TASK_BOUNDS = {
    "action_scale": (0.01, 360.0, "deg"), "eval_height_offset": (0.0, 10.0, "m"), "contact_force": (0.0, 1.0e4, "N"),
    "obstacle_margin": (0.0, 1.0, "m"), "self_collision_margin": (0.0, MIN_LINK_DISTANCE, "m"),
    "reward_floor": (-MOST_SETTING, MOST_SETTING, ""),
}  # fmt: skip
"""Smallest and largest value of settings of a task, and unit."""
LABEL = re.compile(r"[^/\[\]]+ \[[^\[\]]+\]")  # Name of a command's value, with its unit
OF_EPISODE = ("done", "termination", "level")
OF_BASE = ("base_pos", "base_vel", "base_quat")
"""Names in `Env.task_arrays` that are no fields of the task's state, and that no field may have."""


@dataclass(frozen=True)
class Reset(Copyable):
    """Function that samples the state at the start of an episode, with its settings."""

    func: Function
    """Function that resets world `rng.world`: @wp.func (arrays: RobotArrays, scene: Scene, skill: SkillSettings, state,
    settings, level, rng: RngStream) -> new state. It writes the world's joint coordinates and velocities."""
    settings: Any = None
    """Settings of `func`: a frozen dataclass with `struct`, a `@wp.struct`, and `values(step_dt)` [s], which returns an
    instance; or None. A property `max_episode_length_s` is the time limit [s] of episodes that it ends (0: none)."""
    parallel: bool = False
    """Whether GPU threads share the attempts of `func`: each makes `range(rng.lane, number, rng.lanes)`. The threads
    differ in `rng.lane` only; apart from the attempts they must write equal values."""


@dataclass(frozen=True)
class Command(Copyable):
    """Functions that set a task's command to given values and resample it within an episode."""

    set: Function
    """Function that sets a command: @wp.func (robot, scene: Scene, state, values: wp.vec4, heading) -> state.

    heading: yaw of the robot [rad], from which directions in `values` count.
    """
    resample_due: Function | None = None
    """Condition to sample a new command in this step: @wp.func (state) -> bool; None: never."""
    resample: Function | None = None
    """Function that samples a command: @wp.func (robot, scene: Scene, state, level, rng: RngStream) -> state."""
    labels: tuple[str, ...] = ()
    """Names of the one to four values, with units, as `x [m]`; empty: one to four values without names.

    A value whose name begins with `policy step` is a whole number; 2^31 or more, as infinity, means never.
    """
    optional: int = 0
    """Number of values at the end of `labels` that may be omitted, which means 0."""
    least: tuple[float | None, ...] = ()
    """Smallest allowed values, in the order of `labels`; None or omitted: unbounded."""
    nonzero: bool = False
    """Whether at least one value must differ from 0."""

    def __post_init__(self) -> None:
        """Raise InputError for one of resample_due and resample alone, or a wrong number of labels or bounds."""
        check_types("command", self)
        if (self.resample_due is None) != (self.resample is None):
            raise InputError("a command needs both resample_due and resample, or neither")
        labelled = all(LABEL.fullmatch(label) for label in self.labels) and len(set(self.labels)) == len(self.labels)
        fits = self.optional >= 0 and max(len(self.least), self.optional + 1) <= (len(self.labels) or 1) <= 4
        if not labelled or not fits:
            wanted = "1 to 4 distinct labels with units, as 'x [m]', the first not optional"
            raise InputError(f"a command has {wanted}, got {self.labels!r:.200}")

    @property
    def counts(self) -> range:
        """Allowed numbers of values: with all, some or none of the optional ones."""
        return range(len(self.labels) - self.optional, len(self.labels) + 1) if self.labels else range(1, 5)

    def check(self, commands: np.ndarray, task: str, worlds: np.ndarray) -> None:
        """Raise InputError unless commands have the number of values, and the values the bounds, of this command.

        commands: (num_envs, n), or (n,) for all worlds; task: its name; worlds: (num_envs,) bool, to check bounds in.
        """
        subject = f"commands of {task} are {self}"
        num_envs = len(worlds)
        if commands.shape[:-1] not in ((num_envs,), ()) or commands.shape[-1:] not in [(n,) for n in self.counts]:
            raise InputError(f"{subject}, {num_envs} rows or one for all, got shape {commands.shape}")
        steps = np.array([label.startswith("policy step") for label in self.labels] + 4 * [False])
        if not (np.isfinite(commands) | (steps[: commands.shape[-1]] & np.isinf(commands))).all():
            raise InputError("commands must be finite")
        rows = np.broadcast_to(commands, (num_envs, commands.shape[-1]))[worlds]
        for i in np.flatnonzero(steps[: rows.shape[1]]):
            if (fraction := rows[:, i][np.trunc(rows[:, i]) != rows[:, i]]).size:
                raise InputError(f"{subject}: {self.labels[i]} must be a whole number, got {fraction[0]:g}")
        for label, least, column in zip(self.labels, self.least, rows.T, strict=False):
            if least is not None and (column < least).any():
                raise InputError(f"{subject}: {label} must be at least {least:g}, got {column.min():g}")
        if self.nonzero and (rows == 0.0).all(axis=1).any():
            raise InputError(f"{subject}: not all may be 0")

    def __str__(self) -> str:
        """Return the names of the command's values with units, for messages."""
        first = len(self.labels) - self.optional
        return ", ".join(label + " (optional)" * (i >= first) for i, label in enumerate(self.labels)) or "1 to 4 values"


@dataclass(frozen=True)
class ObservationsCfg:
    """Observation terms of the policy (actor) and of the value network (critic), in the order of their columns."""

    actor: tuple[terms.ObservationTerm, ...]
    critic: tuple[terms.ObservationTerm, ...]


@dataclass(frozen=True)
class TaskCfg(Copyable):
    """Definition of a reinforcement-learning task: everything that an environment needs, as data."""

    name: str
    state: Any
    """The `@wp.struct` of one world's state, whose field `steps` counts the policy steps of the episode."""
    advance: terms.Advance
    reset: Reset
    command: Command
    curriculum: terms.Curriculum
    rewards: tuple[terms.RewardTerm, ...]
    terminations: tuple[terms.TerminationTerm, ...]
    """Terminations in order of priority; the first that is true ends the episode and is logged."""
    observations: ObservationsCfg
    motors: MotorCfg
    command_filter: FilterCfg
    action_scale: Pair
    """[deg] Change of the motor target per unit of action, for (lateral, transversal) motors."""
    levels: tuple[Any, ...] = ()
    """Levels of the curriculum, easiest first: frozen dataclasses of one type with `struct` and `values()`."""
    events: tuple[terms.EventTerm, ...] = ()
    """Events in addition to those of `randomization`."""
    randomization: RandomizationCfg = field(default_factory=RandomizationCfg)
    gravity: float = EARTH
    """[m/s^2] Downward gravitational acceleration of every world, also used to estimate flights."""
    keep_momentum: bool = False
    """Whether gravity alone changes the momentum of robots in free flight; see `Simulation`."""
    eval_height_offset: float = 0.0
    """[m] Height of the base above standing at the start of evaluation episodes."""
    contact_force: float = 0.1
    """[N] Force above which a paw is in contact."""
    self_collision_margin: float = 0.0
    """[m] Distance below which links collide in training; in evaluation it is 0."""
    obstacle_margin: float = 0.0
    """[m] Margin added to width and height of blocks for collisions with links in training; in evaluation it is 0."""
    reward_floor: float | None = 0.0
    """Least total reward of a step; None: no floor."""
    metrics: tuple[terms.StateMetric, ...] = ()
    """Logged metrics of the task's state, in addition to the means of all terms."""
    evaluation: Evaluation = field(default_factory=EpisodeEvaluation)
    """Evaluation of the task's policies, by `jumper evaluate` and `play`."""

    groups = ("actor", "critic")
    """Names of the observation groups."""

    def __post_init__(self) -> None:
        """Raise InputError for a setting of a wrong type or size, or a function or struct that does not fit the task.

        Own functions are compiled as far as file and line of an error need it.
        """
        check_types(f"{self.name}:", self)
        if not NAME.fullmatch(self.name):
            raise InputError(f"a task's name may contain letters, digits, _ . - and spaces, got {self.name!r:.60}")
        self._check_structs()
        for section in ("rewards", "terminations", "observations.actor", "observations.critic", "events"):
            names = [term.name for term in operator.attrgetter(section)(self)]
            if len(set(names)) < len(names):
                raise InputError(f"{self.name} {section}: names of terms must be unique, got {names}")
        for slots in self.params.slots.values():
            for slot in slots:
                slot.term.check(self.state)
        self._check_functions()
        if diverged not in [term.func for term in self.terminations]:
            raise InputError(f"{self.name} needs the termination diverged, which ends diverged simulations")
        for metric in self.metrics:
            for field_name in {metric.field, metric.per or metric.field} - set(self.state.vars):
                raise InputError(f"{self.name}: metric {metric.name} needs a field {field_name!r} of the state")
        self.evaluation.check(self.name, self.state)
        check_gravity(self.gravity)
        check_bounds(f"{self.name}:", self, TASK_BOUNDS)

    def _check_structs(self) -> None:
        """Raise InputError unless state, reset settings and levels have Warp structs for kernels."""
        if not isinstance(self.state, Struct):
            raise InputError(f"{self.name}: state must be a @wp.struct, got {self.state!r:.60}")
        steps = self.state.vars.get("steps")
        if steps is None or steps.type not in (int, wp.int32):
            missing = f"the state {shown_type(self.state)} of {self.name} needs a field steps: int"
            raise InputError(f"{place_of(self.state)}: {missing}, the policy steps of the episode")
        if reserved := [name for name in (*OF_EPISODE, *OF_BASE) if name in self.state.vars]:
            also = f"`Env.task_arrays` has other values of this name, so {shown_type(self.state)} must not"
            raise InputError(f"{place_of(self.state)}: field {reserved[0]!r}: {also}")
        if self.reset.settings is not None:
            check_values(f"{self.name} reset.settings", self.reset.settings, 1.0 / 60.0)  # [s]
        for i, level in enumerate(self.levels):
            check_values(f"{self.name} levels[{i}]", level)
        if len({level.struct for level in self.levels}) > 1:
            raise InputError(f"{self.name}: all levels must be of one type")

    def _check_functions(self) -> None:
        """Raise InputError if a function of reset, command or curriculum does not fit the task."""
        state = self.state
        level = self.level_type
        command = self.command
        reset = (RobotArrays, Scene, SkillSettings, state, self.settings_type, level, RngStream)
        robot = (RobotView, Scene, state)
        for where, func, takes, returns in (
            ("reset", self.reset.func, reset, state),
            ("command.set", command.set, (*robot, wp.vec4, wp.float32), state),
            ("command.resample_due", command.resample_due, (state,), wp.bool),
            ("command.resample", command.resample, (*robot, level, RngStream), state),
            ("curriculum.counts", self.curriculum.options["counts"], (state,), wp.bool),
        ):
            if func is not None:
                check_result(f"{self.name} {where}", func, takes, returns)

    @functools.cached_property
    def params(self) -> terms.TaskParams:
        """Parameters of all terms by section: "advance", "curriculum", "rewards", "observations.actor" and so on."""
        sections = {"advance": (self.advance,), "curriculum": (self.curriculum,), "rewards": self.rewards,
                    "terminations": self.terminations, "observations.actor": self.observations.actor,
                    "observations.critic": self.observations.critic,
                    "events": (*self.randomization.events(), *self.events)}  # fmt: skip
        return terms.TaskParams(self.name, sections)

    def layout(self, group: str) -> dict[str, tuple[int, int]]:
        """Return the columns of each term in the actor's or critic's observation as half-open ranges (first, end).

        group: "actor" or "critic".
        """
        columns = {}
        first = 0
        for term in getattr(self.observations, group):
            end = first + term.width * term.options["history"]
            columns[term.name], first = (first, end), end
        return columns

    def max_episode_length_s(self, step_dt: float) -> float:
        """Return the time limit of episodes [s], set by the reset or the termination `too_long`; 0: no limit.

        step_dt [s]: policy step.
        """
        steps = [term.numbers["steps"] for term in self.terminations if term.func is too_long]
        limits = [number * step_dt for number in steps if number < NEVER]
        limits.append(getattr(self.reset.settings, "max_episode_length_s", 0.0))
        return min((limit for limit in limits if limit), default=0.0)

    @property
    def observation_names(self) -> tuple[str, ...]:
        """Names of all columns of the policy's observation, in order."""
        return tuple(column for term in self.observations.actor for column in term.columns)

    @property
    def settings_type(self) -> Struct:
        """Warp struct type of the reset's settings; `NoSettings` if it has none."""
        return NoSettings if self.reset.settings is None else self.reset.settings.struct

    @property
    def level_type(self) -> Struct:
        """Warp struct type of a curriculum level; `NoSettings` if there are no levels."""
        return self.levels[0].struct if self.levels else NoSettings

    def with_terms(self, section: str, **changes: dict[str, object]) -> TaskCfg:
        """Return a copy of the task with changed terms; changes: new numbers and options, by name of the term.

        section: "rewards", "terminations" or "events". Raises InputError: a term or number is unknown.
        """
        present: tuple[terms.Term, ...] = getattr(self, section)
        unknown = set(changes) - {term.name for term in present}
        if unknown:
            raise InputError(f"{self.name} has no {section} term {sorted(unknown)[0]!r}")
        return replace(self, **{section: tuple(term.replace(**changes.get(term.name, {})) for term in present)})

    def without_noise(self) -> TaskCfg:
        """Return a copy of the task with observation noise 0 for actor and critic; delays stay."""
        exact = {g: tuple(term.replace(noise=0.0) for term in getattr(self.observations, g)) for g in self.groups}
        return replace(self, observations=ObservationsCfg(**exact))

    @property
    def draws_ground(self) -> bool:
        """Whether resets sample ground other than a plane, such as platforms."""
        return bool(getattr(self.reset.settings, "draws_ground", False))

    @property
    def terrain(self) -> newton.Heightfield | None:
        """Heightfield of the task for `Simulation(ground=...)`; None: a plane."""
        make = getattr(self.reset.settings, "heightfield", None)
        return None if make is None else make()

    @property
    def termination_names(self) -> tuple[str, ...]:
        """Names of the task's termination terms, in the order in which they are checked."""
        return tuple(term.name for term in self.terminations)

    def on_level_ground(self) -> TaskCfg:
        """Return the task on a plane: without terrain, and without platforms and blocks that resets sample."""
        if not hasattr(self.reset.settings, "on_level_ground"):
            return self
        return replace(self, reset=replace(self.reset, settings=self.reset.settings.on_level_ground()))

    def in_conditions(self, *, randomize: bool, noise: bool, ground_may_vary: bool) -> TaskCfg:
        """Return the task as an environment with these options runs it.

        Without randomize it is nominal and on level ground, without noise its observations are exact. Resets sample
        ground only with ground_may_vary.
        """
        task = self if randomize and ground_may_vary else self.on_level_ground()
        task = task if randomize else task.nominal()
        return task if noise else task.without_noise()

    def nominal(self) -> TaskCfg:
        """Return a copy of the task with nominal robot parameters: without randomisation and events."""
        return replace(self, randomization=RandomizationCfg.off(), events=())


@dataclass(frozen=True)
class Handover(Copyable):
    """Rule that switches a world from a source to a target task on a condition; the robot's physical state is kept."""

    source: TaskCfg
    target: TaskCfg
    when: Function  # @wp.func (robot, state of source, requested: bool) -> bool, whether to switch in this step
    begin: Function
    """Function that begins the target task: @wp.func (robot, state of source) -> state of target; then `Command.set`
    if the request has a command."""

    def __post_init__(self) -> None:
        """Raise InputError if a field has a wrong type, or a function does not fit the states of the tasks."""
        check_types("handover:", self)
        source = self.source.state
        where = f"handover from {self.source.name} to {self.target.name},"
        check_result(f"{where} when", self.when, (RobotView, source, wp.bool), wp.bool)
        check_result(f"{where} begin", self.begin, (RobotView, source), self.target.state)


def checked_tasks(task: Any, handovers: Sequence[Handover]) -> tuple[TaskCfg, ...]:
    """Check the tasks and handovers (switches between tasks) of one environment, and return the tasks as a tuple.

    task: a `TaskCfg` or several.
    Raises InputError (a ValueError): `task` is no task or empty; two tasks have the same name, or differ in peak
    torque, over-speed protection or gravity; or a handover is none, or refers to another task.
    """
    is_sequence = isinstance(task, Iterable) and not isinstance(task, str)
    tasks: tuple[Any, ...] = tuple(task) if is_sequence else (task,)
    for each in tasks:
        if not isinstance(each, TaskCfg):
            raise InputError(f"a task must be a TaskCfg, as make_task returns for a name, got {each!r:.60}")
    names = [each.name for each in tasks]
    if not tasks or len(set(names)) < len(names):
        raise InputError(f"an environment needs at least one task, and unique names, got {names}")
    first = tasks[0].motors
    limits = (first.fade_start, first.fade_end, first.lateral.peak, first.transversal.peak)
    for each in tasks[1:]:
        motors = each.motors
        if (motors.fade_start, motors.fade_end, motors.lateral.peak, motors.transversal.peak) != limits:
            raise InputError(f"{each.name} and {names[0]} must have equal peak torque and over-speed protection")
        if each.gravity != tasks[0].gravity:
            raise InputError(f"gravity of {each.name} must be {tasks[0].gravity} m/s^2, got {each.gravity}")
    for each in handovers if isinstance(handovers, Iterable) else (handovers,):
        if not isinstance(each, Handover):
            raise InputError(f"handovers must be a sequence of Handover, got {handovers!r:.60}")
        if each.source not in tasks or each.target not in tasks:
            raise InputError(f"a handover needs two of the tasks {names}, got {each.source.name} to {each.target.name}")
    return tasks
