"""Base class of the suites of jump tests, and the paper's two sweeps: over heights and over distances."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from types import ModuleType
from typing import Any, ClassVar

import numpy as np

from jumper_warp.envs.env import Env
from jumper_warp.evaluation.heights import SUCCESS_TOLERANCE, HeightLog, sweep_metrics, with_sweep_terminations
from jumper_warp.evaluation.jumps import DELAY, REST_TIME
from jumper_warp.evaluation.landings import (
    LandingLog,
    landing_metrics,
    random_headings,
    trained_range,
    with_landing_terminations,
    with_second_takeoff,
)
from jumper_warp.evaluation.limits import limit_metrics, open_loop_limits
from jumper_warp.evaluation.log import Metrics, mean, termination_names, within
from jumper_warp.evaluation.plots import Published, plot_sweep
from jumper_warp.evaluation.run import HEIGHTS, PLACES, EvaluationArgs, EvaluationRun
from jumper_warp.policies.conditions import Conditions
from jumper_warp.utils.errors import InputError

HEIGHTS_IN_RANGE, DISTANCES_IN_RANGE = (0.5, 1.1), (0.3, 1.4)  # [m] Ranges in which all jumps of the paper succeed
PAPER_HEIGHTS = Published(mean_error=0.04, robot=((0.75, 0.0, 0.023), (1.0, 0.01, 0.0)), open_loop=1.075)
PAPER_DISTANCES = Published(mean_error=0.026, robot=((1.25, 0.0, 0.004),))
PAPER_TRAINED = (0.4, 1.0)  # [m] Range of goal distances in the paper's training, also of `success_rate_0_4_1_0`


def check(condition: bool, message: str) -> None:
    """Raise InputError with the message unless the condition holds."""
    if not condition:
        raise InputError(message)


@dataclass(frozen=True)
class Suite(EvaluationArgs, ABC):
    """A test of jumping policies: its flags (also those of `EvaluationArgs`), runs and metrics."""

    num_jumps: int = 200  # Number of jumps (where there are several scenes, bins or goals on a grid, of each)
    rest_time: float = REST_TIME  # [s] Time from touchdown until a jump is over

    name: ClassVar[str]  # Value of `jumper evaluate --suite`, and name of the output folder
    evaluations: ClassVar[tuple[str, ...]] = PLACES  # Keys of `EVALUATIONS` of the policies that the suite accepts
    paper: ClassVar[dict[str, float]] = {}  # Values in the paper of metrics with the same names
    least: ClassVar[tuple[int, float]] = (1, 0.1)  # Minimum number of jumps and minimum rest [s]

    def __post_init__(self) -> None:
        super().__post_init__()
        jumps, rest = self.least
        check(self.num_jumps >= jumps, f"need at least {jumps} jump{'s' * (jumps > 1)}, got {self.num_jumps}")
        check(rest <= self.rest_time <= 10.0, f"rest_time must be in [{rest:g}, 10] s, got {self.rest_time}")

    @abstractmethod
    def measure(self, run: EvaluationRun) -> dict[str, Any]:
        """Run the jumps, write plots into `run.folder`, and return the metrics by name."""

    def run(self, modules: Iterable[ModuleType] = ()) -> dict[str, Any]:
        """Evaluate the policy, report and return the metrics; modules: the user's task modules.

        Raises PolicyError, CheckpointError or InputError as `EvaluationRun.from_args`.
        """
        run = EvaluationRun.from_args(self.name, self, self.evaluations, modules)
        return run.report(self.measure(run), self.paper)

    def run_landings(
        self, run: EvaluationRun, goals: np.ndarray, env: Env | None = None, *, headings: np.ndarray | None = None,
        delay: np.ndarray | float = DELAY, **options: Any,
    ) -> LandingLog:  # fmt: skip
        """Run jumps to goals [m], (num_envs, jumps in a row, 2), ahead and to the left, and return their log.

        env: default: `run.env`; headings [rad]: (num_envs,), default: random; delay [s]: as in `LandingLog`; options:
        keywords of `EvaluationRun.run_episodes`.
        """
        env = run.env(len(goals)) if env is None else env
        headings = random_headings(len(goals), self.seed) if headings is None else headings
        log = LandingLog(goals, termination_names(env.task), headings, delay, self.rest_time)
        return run.run_episodes(env, log, **options)

    def pushed_in_flight(self, run: EvaluationRun, measure: Callable[[Conditions], Metrics], *names: str) -> Metrics:
        """Return the named metrics of the same test with pushes in flight, as `pushed_in_flight_<name>`.

        Empty for nominal robots, and if the test itself pushes in flight. measure: runs the test under conditions and
        returns its metrics.
        """
        if not self.randomize or self.push_in_flight:
            return {}
        values = measure(replace(run.conditions, push_in_flight=True))
        return {f"pushed_in_flight_{name}": values[name] for name in names}


@dataclass(frozen=True)
class HeightSweep(Suite):
    """Jumps to heights spread evenly over 0.5 to 1.2 m, each once.

    Every robot stands in the default pose and is commanded to jump after half a second. A jump succeeds if the highest
    base height is within 0.1 m of the commanded one. A landing is good if nothing but the paws touched anything, the
    base stayed within 10 degrees of level and was at rest a second after touchdown. A fall or a collision ends a jump:
    its apex until then counts. Randomised robots are pushed while a paw is down; a second test pushes them in flight
    too. The open-loop jump of the same robots (squat, hold, full extension) shows the height that each can reach.
    """

    policy: str = "vertical_jump"
    height_range: tuple[float, float] = (0.5, 1.2)  # [m] Lowest and highest commanded base height
    num_recorded: int = 5

    name: ClassVar = "sweep"
    evaluations: ClassVar = HEIGHTS
    paper: ClassVar = {"mean_abs_error_m": 0.04, "success_rate": 0.91, "success_rate_in_range": 1.0}
    least: ClassVar = (3, REST_TIME)

    def __post_init__(self) -> None:
        super().__post_init__()
        low, high = self.height_range
        check(0.0 < low <= high < 10.0, f"height_range must be in (0, 10) m, got {self.height_range}")

    def run_jumps(self, run: EvaluationRun, env: Env, film: str = "") -> HeightLog:
        """Run one jump per height and return the log; film: name of the recording, empty for none."""
        heights = np.linspace(*self.height_range, self.num_jumps)
        return run.run_episodes(env, HeightLog(heights, termination_names(env.task), self.rest_time), film=film)

    def measure(self, run: EvaluationRun) -> dict[str, Any]:
        """Run the jumps and the open-loop jumps of the same robots, plot both, and return the metrics."""
        env = run.env(self.num_jumps, with_sweep_terminations)
        initial_state = env.state_dict()
        jumps = self.run_jumps(run, env, "jumps")
        limit = open_loop_limits(env, initial_state)
        plot_sweep(
            run.folder / "sweep.png", jumps.commanded[:, 0], jumps.apex[:, 0], jumps.reached[:, 0], limit=limit,
            tolerance=SUCCESS_TOLERANCE, paper=PAPER_HEIGHTS, marks=("reached", "missed"), title="Jumps to heights",
            labels=("commanded base height [m]", "highest base height [m]"),
            conditions=f"{run.title}, {self.num_jumps} jumps",
        )  # fmt: skip

        def measure_under(conditions: Conditions) -> Metrics:
            pushed_env = run.env(self.num_jumps, with_sweep_terminations, conditions)
            return sweep_metrics(self.run_jumps(run, pushed_env), HEIGHTS_IN_RANGE)

        names = ("mean_abs_error_m", "success_rate", "success_rate_in_range", "fall_rate", "miss_rate", "landing_rate")
        values = sweep_metrics(jumps, HEIGHTS_IN_RANGE) | limit_metrics(jumps, limit)
        return {"rest_s": self.rest_time} | values | self.pushed_in_flight(run, measure_under, *names)


@dataclass(frozen=True)
class DistanceSweep(Suite):
    """Jumps 0.3 to 1.5 m straight ahead, spread evenly, each once.

    Every robot stands in the default pose, with a heading sampled from the full circle, and is commanded to
    jump after half a second. The error is the distance of the base from its goal in the plane a second after touchdown,
    or where the jump failed before. A jump succeeds if it was begun on command, ends within 0.1 m of its goal, and
    nothing but the paws touched anything. Steps, second hops and second takeoffs (upward at 0.25 m/s with no paw down)
    in a landing are reported separately. Randomised robots are pushed while a paw is down; a second test pushes them in
    flight too.
    """

    distance_range: tuple[float, float] = (0.3, 1.5)  # [m] Distance of the nearest and of the farthest goal
    max_lateral_offset: float = 0.0  # [m] Largest offset of a goal to either side; offsets are sampled
    end_at_second_takeoff: bool = False
    """A second takeoff after landing ends a jump, as a failure, as in the authors' configuration."""
    num_recorded: int = 5

    name: ClassVar = "sweep"
    paper: ClassVar = {"mean_error_m": 0.026, "success_rate": 0.97, "success_rate_in_range": 1.0}
    least: ClassVar = (3, 0.1)

    def __post_init__(self) -> None:
        super().__post_init__()
        (near, far), side = self.distance_range, self.max_lateral_offset
        valid = 0.0 < near < far < 10.0 and 0.0 <= side < 10.0
        check(valid, f"goals must be within 10 m and rise, got {self.distance_range}, {side} to either side")

    def run_jumps(self, run: EvaluationRun, conditions: Conditions, film: str = "") -> LandingLog:
        """Run one jump per distance under some conditions, return the log; film: name of the recording, or empty."""
        side, rng = self.max_lateral_offset, np.random.default_rng(self.seed + 1)
        x, y = np.linspace(*self.distance_range, self.num_jumps), rng.uniform(-side, side, self.num_jumps)
        goals = np.stack([x, y], axis=1)[:, None]
        change = with_second_takeoff if self.end_at_second_takeoff else with_landing_terminations
        return self.run_landings(run, goals, run.env(self.num_jumps, change, conditions), film=film)

    @staticmethod
    def metrics(landings: LandingLog) -> Metrics:
        """Return `landing_metrics` of the sweep, `in_range` over DISTANCES_IN_RANGE, and `success_rate_0_4_1_0`."""
        distance = landings.goal_positions[..., 0]
        values = landing_metrics(landings, within(distance, DISTANCES_IN_RANGE))
        return values | {"success_rate_0_4_1_0": mean(landings.success[within(distance, PAPER_TRAINED)])}

    def measure(self, run: EvaluationRun) -> dict[str, Any]:
        """Run the jumps, plot reached over commanded distance, and return the metrics."""
        landings, trained = self.run_jumps(run, run.conditions, "jumps"), trained_range(run.task)
        plot_sweep(
            run.folder / "sweep.png", landings.goal_positions[:, 0, 0], landings.landing[:, 0, 0],
            landings.success[:, 0], tolerance=SUCCESS_TOLERANCE, paper=PAPER_DISTANCES, marks=("on goal", "failed"),
            trained={"paper: range of training": PAPER_TRAINED, "range of training": tuple(trained.values())},
            labels=("commanded distance [m]", "distance of the base at the end [m]"), title="Jumps ahead",
            conditions=f"{run.title}, {self.num_jumps} jumps",
        )  # fmt: skip
        values = {"rest_s": self.rest_time, "end_at_second_takeoff": self.end_at_second_takeoff}
        values |= self.metrics(landings)
        pushed = self.pushed_in_flight(
            run, lambda conditions: self.metrics(self.run_jumps(run, conditions)), "mean_error_m", "success_rate",
            "success_rate_in_range", "fall_rate", "miss_rate", "still_landing_rate", "max_landing_tilt_deg",
        )  # fmt: skip
        return values | trained | pushed
