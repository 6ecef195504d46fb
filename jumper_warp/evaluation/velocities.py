"""Evaluation of velocity tracking: log, metrics, and flags of `jumper evaluate` and `play`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
import tyro
from numpy.typing import ArrayLike

from jumper_warp.evaluation.jumps import wrapped
from jumper_warp.evaluation.log import EvaluationLog, check, listed
from jumper_warp.tasks.cfg import TaskCfg
from jumper_warp.utils.arrays import real_array
from jumper_warp.utils.files import Json
from jumper_warp.utils.metrics import Metric, Metrics, mean, measure, rate, rmse
from jumper_warp.utils.rotations import CONJUGATE, rotate, yaw_of

if TYPE_CHECKING:
    from jumper_warp.envs.env import Env

Velocity = tuple[float, float, float]  # Ahead, to the left [m/s], about z [rad/s]
AXES = ("vx", "vy", "yaw_rate")
UNITS = ("m_s", "m_s", "rad_s")  # Units of AXES, as keys of metrics end
SETTLING_TIME = 1.0  # [s] Time after each command that is excluded from the settled tracking errors
SLEW_RATE = 1.25  # [m/s^2], [rad/s^2] Rate at which the authors' commands change
STANDING = 64  # Number of robots that are commanded to stand
MAX_ROBOTS = 20_000  # Maximum number of robots in a test


@dataclass
class VelocityLog(EvaluationLog):
    """Log of walks with commanded velocities, one robot per world; samples after a robot's fall are ignored."""

    commands: np.ndarray  # (robots, commands, 3) Commands in order: ahead, left [m/s], about z [rad/s], body axes
    task: TaskCfg
    seconds: float = 10.0  # [s] Simulated time
    times: np.ndarray = field(default_factory=lambda: np.zeros(1))  # [s] (commands,) Time of each command, first 0
    headings: np.ndarray | float = 0.0  # [rad] (robots,) Headings at the start, or one for all
    slew: np.ndarray | float = np.inf  # [m/s^2], [rad/s^2] (robots,) Rate at which commands change, from 0 at the start
    velocity: list[np.ndarray] = field(default_factory=list, init=False)
    """Measured velocity in the components of `commands`, one array (robots, 3) per policy step."""
    end: np.ndarray = field(init=False)  # (robots,) Index of the termination of a fall, -1 if not fallen
    fall_step: np.ndarray = field(init=False)  # (robots,) Policy step of the fall, else the number of steps

    row_name = "robot"
    spacing = 2.0

    def __post_init__(self) -> None:
        """Allocate results of one walk per world, before the first policy step."""
        self.count = len(self.commands)
        self.end = np.full(self.count, -1)
        self.fall_step = np.zeros(self.count, dtype=int)
        self.times = real_array(self.times, "times", float)
        self.step_dt = 0.0  # [s] Policy step; `begin` sets it
        self._slew = np.broadcast_to(real_array(self.slew, "slew", float), self.count)
        # (robots,) horizontal distance from the start [m], and yaw relative to the heading [rad]; until the fall
        self.distance = np.zeros(self.count)
        self.yaw = np.zeros(self.count)
        self._start = np.zeros((self.count, 3))
        self._command = np.zeros((self.count, 3))  # commands of the next policy step
        falls = [not term.options["time_out"] for term in self.task.terminations]
        self._is_fall = np.array([*falls, False])  # by index of the termination; the last entry is index -1

    def begin(self, env: Env) -> None:
        """Reset every robot to the default pose, with its first command."""
        self.step_dt = env.step_dt
        self._command = self._slewed(self._command, self.commands[:, 0])
        env.evaluation_reset(self._command, self.headings)
        self._start = env.sim.joint_q()[:, :3].copy()

    def _slewed(self, last: np.ndarray, target: np.ndarray) -> np.ndarray:
        """Return commands (robots, 3) that change from `last` toward `target` by at most a policy step's slew rate."""
        limit = (self._slew * self.step_dt)[:, None]
        return np.where(np.isinf(limit), target, last + np.clip(target - last, -limit, limit))

    def _target(self, steps: ArrayLike) -> np.ndarray:
        """Return the scheduled velocity commands at policy steps (n,), before their rate of change is limited.

        The result is (n, robots, 3).
        """
        index = np.searchsorted(np.round(self.times / self.step_dt), steps, side="left") - 1
        return self.commands[:, np.maximum(index, 0)].transpose(1, 0, 2)

    def read_env(self, env: Env) -> dict[str, np.ndarray]:
        """Return base state and termination of all robots for `update`, and send the commands for the next step.

        Keys: base_pos, base_quat (xyzw), base_vel, base_ang_vel (world axes), termination.
        """
        sim = env.sim
        q = sim.joint_q()
        qd = sim.joint_qd()
        arrays = {"base_pos": q[:, :3].copy(), "base_quat": q[:, 3:7].copy(), "base_vel": sim.base_velocity(),
                  "base_ang_vel": qd[:, 3:6].copy(), "termination": env.task_arrays()["termination"]}  # fmt: skip
        step = len(self.velocity) + 1
        command = self._slewed(self._command, self._target([step + 1])[0])
        if (changed := (command != self._command).any(axis=1)).any():
            env.command(command, changed)
        self._command = command
        return arrays

    def update(self, arrays: dict[str, np.ndarray], step_dt: float) -> bool:
        """Record a policy step from the arrays of `read_env`; return whether all robots have fallen."""
        self.step_dt = step_dt
        standing = self.end < 0
        self.velocity.append(body_velocity(arrays).astype(np.float32))
        fell = standing & self._is_fall[arrays["termination"]]
        self.end[fell] = arrays["termination"][fell]
        self.fall_step[up := self.end < 0] = len(self.velocity)
        self.distance[up] = np.linalg.norm((arrays["base_pos"] - self._start)[up, :2], axis=1)
        self.yaw[up] = wrapped(yaw_of(arrays["base_quat"]) - self.headings)[up]
        return bool((self.end >= 0).all())

    @property
    def fallen(self) -> np.ndarray:
        """Whether each robot fell, (robots,)."""
        return self.end >= 0

    @property
    def outcomes(self) -> np.ndarray:
        """Outcome of each robot, (robots,): name of the termination by which it fell, `walked` if it did not fall."""
        return np.array([*self.task.termination_names, "walked"])[self.end]

    def velocity_history(self) -> np.ndarray:
        """Return the robots' velocities after every policy step, (steps, robots, 3); NaN after a fall."""
        velocity = np.array(self.velocity, dtype=float).reshape(-1, len(self.commands), 3)
        velocity[np.arange(len(velocity))[:, None] >= self.fall_step] = np.nan
        return velocity

    def command_history(self) -> np.ndarray:
        """Return the robots' commands at every policy step, (steps, robots, 3); each applies from the next step."""
        targets = self._target(np.arange(1, len(self.velocity) + 1))
        if np.isinf(self._slew).all():
            return targets
        history = [np.zeros((self.count, 3))]
        for target in targets:
            history.append(self._slewed(history[-1], target))
        return np.array(history[1:])

    def columns(self) -> dict[str, list]:
        """Return one value per robot by name: first command, RMS tracking errors over the walk, outcome.

        Keys: command_<axis>, rms_error_<axis>, end (outcome), for AXES.
        """
        total, count = np.moveaxis(square_sums(self.errors()), -1, 0)
        error = np.sqrt(total / np.where(count > 0, count, np.nan))
        columns = {f"command_{axis}": self.commands[:, 0, i] for i, axis in enumerate(AXES)}
        columns |= {f"rms_error_{axis}": error[:, i] for i, axis in enumerate(AXES)}
        return listed(columns | {"end": self.outcomes})

    @property
    def trials(self) -> dict[str, np.ndarray]:
        """Sets of robots from which metrics are computed: a mask (robots,) by the set's name, such as "robots"."""
        stands = ~self.commands.any(axis=(1, 2))
        slewed = np.isfinite(self._slew)
        return {"robots": np.full(self.count, True), "robots with commands at once": ~stands & ~slewed,
                "robots with slewed commands": ~stands & slewed,
                "robots that stood to the end": stands & ~self.fallen}  # fmt: skip

    def errors(self, *, settled: bool = False) -> np.ndarray:
        """Return the tracking errors, velocity minus command, (steps, robots, 3); NaN after a fall.

        settled: also NaN for SETTLING_TIME after each command.
        """
        error = self.velocity_history() - self.command_history()
        if not settled:
            return error
        steps = np.arange(1, len(error) + 1)
        for time in self.times:
            since = steps - round(time / self.step_dt)
            error[(since > 0) & (since <= round(SETTLING_TIME / self.step_dt))] = np.nan
        return error

    def series(self) -> dict[str, np.ndarray]:
        """Return values to plot: the current velocities and commands of all robots."""
        return velocity_series(self.velocity[-1], self.command_history()[-1])

    def notes(self, worlds: Sequence[int]) -> Json:
        """Return metadata of a recording: commands of some robots and their times, keys `commands`, `times_s`."""
        return {"commands": self.commands[list(worlds)].tolist(), "times_s": self.times.tolist()}

    def all_commands(self) -> np.ndarray:
        """Return all commanded velocities ahead, to the left [m/s] and about z [rad/s], (robots, commands, 3)."""
        return self.commands

    def marks(self) -> dict[str, np.ndarray]:
        """Return the markers of a recording: the current commanded velocities of all robots."""
        return {"commands": self.command_history()[-1]}


def body_velocity(arrays: dict[str, np.ndarray]) -> np.ndarray:
    """Return velocity ahead and to the left [m/s] and yaw rate [rad/s], body axes, (robots, 3).

    arrays: base_quat (robots, 4), xyzw; base_vel [m/s] and base_ang_vel [rad/s], (robots, 3), world axes.
    """
    to_body = arrays["base_quat"].astype(float) * CONJUGATE
    vel = rotate(to_body, arrays["base_vel"].astype(float))
    ang = rotate(to_body, arrays["base_ang_vel"].astype(float))
    return np.stack([vel[:, 0], vel[:, 1], ang[:, 2]], axis=1)


def velocity_series(velocity: np.ndarray, command: np.ndarray) -> dict[str, np.ndarray]:
    """Return velocities and commands, (robots, 3) each, as series to plot, named as by `EvaluationLog.series`."""
    series = {}
    for i, (axis, unit) in enumerate(zip(AXES, ("m/s", "m/s", "rad/s"), strict=True)):
        series |= {f"{axis}/actual, {{}} [{unit}]": velocity[:, i], f"{axis}/command, {{}} [{unit}]": command[:, i]}
    return series


def square_sums(error: np.ndarray) -> np.ndarray:
    """Return the sum over time of squared tracking errors, and their number, both without NaN, (robots, 3, 2).

    error: (steps, robots, 3).
    """
    return np.stack([np.nansum(error**2, axis=0), np.isfinite(error).sum(axis=0)], axis=-1)


RMSE_ROWS = (
    ("", "robots with commands at once", False), ("settled_", "robots with commands at once", True),
    ("slewed_", "robots with slewed commands", False),
)  # fmt: skip
"""Prefix, trials and argument `settled` of `VelocityLog.errors`, of each set of tracking errors."""
VELOCITY_METRICS = (
    *(
        Metric(
            f"{prefix}rmse_{axis}_{unit}", rmse, over, lambda o, i=i, s=settled: square_sums(o.errors(settled=s))[:, i]
        )
        for prefix, over, settled in RMSE_ROWS
        for i, (axis, unit) in enumerate(zip(AXES, UNITS, strict=True))
    ),
    Metric("standing_drift_mean_m", mean, "robots that stood to the end", lambda o: o.distance),
    Metric("standing_turn_abs_mean_deg", mean, "robots that stood to the end", lambda o: abs(np.degrees(o.yaw))),
    Metric("fall_rate", rate, "robots", lambda o: o.fallen),
)
"""Table of the metrics of walks. Errors are velocity minus command until a fall; `settled_`: without SETTLING_TIME
after each command; `slewed_`: of commands that change at SLEW_RATE, like the authors'. Drift is the final distance from
the start of robots commanded to stand."""


def command_grid(per_axis: int, reach: Sequence[float]) -> np.ndarray:
    """Return velocity commands on a grid from -reach to reach, (per_axis^3, 1, 3); reach: [m/s], [m/s], [rad/s]."""
    axes = [np.linspace(-limit, limit, per_axis) for limit in reach]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 1, 3)


@dataclass(frozen=True)
class VelocityFlags:
    """Flags of `jumper evaluate` for walks: each robot receives commands from a grid of velocities at intervals.

    Half of the robots receive steps of the command, half a command slewed at 1.25 m/s^2 and rad/s^2. Additional robots
    are commanded to stand.
    """

    commands_per_axis: int = 8
    """Number of commands along each of the three axes of the grid; two robots per combination."""
    max_velocity: tuple[float, float, float] = (0.8, 0.8, 0.8)
    """[m/s], [m/s], [rad/s] Largest command ahead, to the left and about z, in both directions."""
    seconds: float = 9.0  # [s] Length of each walk
    command_interval: float = 3.0  # [s] Time from one command to the next

    def __post_init__(self) -> None:
        """Raise InputError for a grid of commands, an interval or a duration out of range."""
        interval = self.command_interval
        check(0.1 <= interval <= 600.0, f"command_interval must be in [0.1, 600] s, got {interval}")
        check_velocity_settings(self.commands_per_axis**3, self.seconds, *self.max_velocity)
        check(self.commands_per_axis >= 2, f"commands_per_axis must be at least 2, got {self.commands_per_axis}")

    def log(self, task: TaskCfg, seed: int) -> VelocityLog:
        """Return a new log of walks, one robot per world; seed: for the order of the commands after the first."""
        rng = np.random.default_rng(seed)
        grid = command_grid(self.commands_per_axis, self.max_velocity)
        times = np.arange(0.0, self.seconds - 1.0e-9, self.command_interval)
        commands = np.concatenate([grid, *(rng.permutation(grid) for _ in times[1:])], axis=1)
        slew = np.repeat([np.inf, SLEW_RATE, np.inf], [len(grid), len(grid), STANDING])
        standing = np.zeros((STANDING, len(times), 3))
        return VelocityLog(np.concatenate([commands, commands, standing]), task, self.seconds, times=times, slew=slew)

    def metrics(self, log: VelocityLog) -> Metrics:
        """Return tracking errors, drift and fall rate of a finished log of walks, as in VELOCITY_METRICS."""
        return measure(VELOCITY_METRICS, log)


@dataclass(frozen=True)
class VelocityPlayFlags:
    """Flags of `jumper play` for a walk with a sequence of commands."""

    velocity: tyro.conf.UseAppendAction[tuple[Velocity, ...]] = ()
    """[m/s], [m/s], [rad/s] Velocity ahead, to the left, about z; repeat the flag per command (default: six)."""
    default_velocities: tyro.conf.Suppress[tuple[Velocity, ...]] = (
        (0.8, 0.0, 0.0), (0.0, 0.4, 0.0), (0.0, 0.0, 0.8), (-0.5, 0.0, 0.0), (0.6, 0.3, 0.6), (0.0, 0.0, 0.0),
    )  # fmt: skip
    """Commands if `velocity` is not passed; a default of `velocity` itself would be kept when the flag is passed."""
    command_interval: float = 2.5  # [s] Time from one command to the next

    def __post_init__(self) -> None:
        """Raise InputError for a commanded velocity or length out of range."""
        check_velocity_settings(1, self.length, *(value for command in self.velocity for value in command))

    @property
    def velocities(self) -> tuple[Velocity, ...]:
        """Velocities commanded in sequence: `velocity` if passed, else `default_velocities`."""
        return self.velocity or self.default_velocities

    @property
    def length(self) -> float:
        """Length of the recording [s]."""
        return self.command_interval * len(self.velocities)

    def log(self, task: TaskCfg) -> VelocityLog:
        """Return a new log of one robot's walk with the commands `velocities` in sequence."""
        commands = np.array(self.velocities, dtype=float)[None]
        return VelocityLog(commands, task, self.length, times=self.command_interval * np.arange(commands.shape[1]))


def check_velocity_settings(robots: int, seconds: float, *commands: float) -> None:
    """Raise InputError unless number of robots, time [s] and commanded velocities are within their limits."""
    check(1 <= robots <= MAX_ROBOTS, f"robots must be in 1 to {MAX_ROBOTS}, got {robots}")
    check(0.02 <= seconds <= 600.0, f"seconds must be in [0.02, 600], got {seconds}")
    check(all(abs(value) <= 10.0 for value in commands), f"commands must be within 10 m/s or rad/s, got {commands}")
