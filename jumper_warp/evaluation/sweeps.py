"""Base class of the test suites of jumps, and the paper's two sweeps, over heights and over distances."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from types import ModuleType
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from jumper_warp.evaluation.jump_flags import HEIGHT_PAPER, PLACE_PAPER, HeightFlags, LandingFlags
from jumper_warp.evaluation.jump_metrics import PLACE_METRICS
from jumper_warp.evaluation.jumps import (
    DELAY,
    REST_TIME,
    TOLERANCE,
    JumpLog,
    random_headings,
    with_jump_terminations,
    with_second_takeoff,
)
from jumper_warp.evaluation.limits import limit_metrics, open_loop_limits
from jumper_warp.evaluation.log import termination_names, within
from jumper_warp.evaluation.run import HEADLINES, HEIGHTS, PLACES, EvaluationArgs, EvaluationRun
from jumper_warp.evaluation.trained import trained_range
from jumper_warp.policies.conditions import Conditions
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.metrics import Metrics, chosen, measure
from jumper_warp.viz.plots import Published, plot_sweep

if TYPE_CHECKING:
    from jumper_warp.envs.env import Env

PAPER_HEIGHTS = Published(mean_error=0.04, robot=((0.75, 0.0, 0.023), (1.0, 0.01, 0.0)), open_loop=1.075)
PAPER_DISTANCES = Published(mean_error=0.026, robot=((1.25, 0.0, 0.004),))
PAPER_TRAINED = (0.4, 1.0)  # [m] Range of goal distances in the paper's training


def check(condition: bool, message: str) -> None:
    """Raise InputError with the message unless the condition holds."""
    if not condition:
        raise InputError(message)


@dataclass(frozen=True)
class Suite(EvaluationArgs, ABC):
    """Test suite of jumping policies: its flags (also those of `EvaluationArgs`), runs and metrics."""

    num_jumps: int = 200  # Number of jumps (per scene, bin or goal of a grid, where there are several)
    rest_time: float = REST_TIME  # [s] Time from touchdown to the end of a jump

    name: ClassVar[str]  # Value of `jumper evaluate --suite`, and name of the output folder
    evaluations: ClassVar[tuple[str, ...]] = PLACES  # Keys of `EVALUATIONS` of the policies that the suite accepts
    paper: ClassVar[dict[str, float]] = {}  # Values in the paper of metrics with the same names
    summary: ClassVar[tuple[str, ...]] = HEADLINES  # Keys of the metrics in the summary
    least: ClassVar[tuple[int, float]] = (1, 0.1)  # Minimum number of jumps and minimum rest [s]

    def __post_init__(self) -> None:
        super().__post_init__()
        jumps, rest = self.least
        check(self.num_jumps >= jumps, f"need at least {jumps} jump{'s' * (jumps > 1)}, got {self.num_jumps}")
        check(rest <= self.rest_time <= 10.0, f"rest_time must be in [{rest:g}, 10] s, got {self.rest_time}")

    @abstractmethod
    def measure(self, run: EvaluationRun) -> Metrics:
        """Run the jumps, write plots into `run.folder`, and return the metrics by key."""

    def run(self, modules: Iterable[ModuleType] = ()) -> dict[str, Any]:
        """Evaluate the policy, report and return the metrics; modules: the user's task modules.

        Raises PolicyError, CheckpointError or InputError, see `EvaluationRun.from_args`.
        """
        run, metrics = self.evaluate(modules)
        return run.report(metrics, self.paper, self.summary)

    def evaluate(self, modules: Iterable[ModuleType] = ()) -> tuple[EvaluationRun, Metrics]:
        """Return the finished evaluation and its metrics, which are neither written nor printed; as `run`."""
        run = EvaluationRun.from_args(self.name, self, self.evaluations, modules)
        run.settings["rest_s"] = self.rest_time
        return run, self.measure(run)

    def run_flags(self, run: EvaluationRun, flags: Any, env: Env, film: str = "") -> Any:
        """Run the jumps that flags of `jumper evaluate` define, and return their log; film: name of the recording."""
        log = flags.log(env.task, self.stream_seed)
        log.rest = self.rest_time
        return run.run_episodes(env, log, film=film)

    def run_landings(
        self, run: EvaluationRun, goals: np.ndarray, env: Env | None = None, *, headings: np.ndarray | None = None,
        delay: np.ndarray | float = DELAY, **options: Any,
    ) -> JumpLog:  # fmt: skip
        """Run jumps to goals [m], (num_envs, jumps in a row, 2), ahead and to the left, and return their log.

        env: default: `run.env`; headings [rad]: (num_envs,), default: random; delay [s]: see `JumpLog`; options:
        keywords of `EvaluationRun.run_episodes`.
        """
        env = run.env(len(goals)) if env is None else env
        headings = random_headings(len(goals), self.stream_seed) if headings is None else headings
        log = JumpLog(goals, termination_names(env.task), headings, delay, self.rest_time)
        return run.run_episodes(env, log, **options)

    def pushed_in_flight(self, run: EvaluationRun, metrics: Callable[[Conditions], Metrics], *names: str) -> Metrics:
        """Repeat a test with pushes in flight; return the named metrics as `pushed_in_flight_<name>`.

        Empty for nominal robots, and if the test itself pushes in flight. metrics: runs the test under conditions and
        returns its metrics.
        """
        if not self.randomize or self.push_in_flight:
            return {}
        values = metrics(replace(run.conditions, push_in_flight=True))
        pushed = {name: values[name]._replace(over=f"{values[name].over} of robots pushed in flight") for name in names}
        return {f"pushed_in_flight_{name}": value for name, value in pushed.items()}


@dataclass(frozen=True)
class HeightSweep(Suite):
    """Sweep of jumps to evenly spaced heights from 0.5 to 1.2 m, one each.

    Every robot stands in the default pose and is commanded to jump after half a second. A jump reaches its height if
    the largest base height is within 0.1 m of the commanded height. It succeeds if it also starts on command, no other
    part than the paws touches anything, and the base is at rest a second after touchdown. A fall or a collision ends a
    jump, whose apex until then is evaluated. Randomised robots are pushed while a paw is down; a second test pushes
    them in flight too. The open-loop jump of each robot (squat, hold, full extension) gives the height it can reach.
    """

    policy: str = "vertical_jump"
    height_range: tuple[float, float] = (0.5, 1.2)  # [m] Lowest and highest commanded base height
    num_recorded: int = 5

    name: ClassVar = "sweep"
    evaluations: ClassVar = HEIGHTS
    paper: ClassVar = HEIGHT_PAPER
    summary: ClassVar = ("goal_reached_rate", "in_range_goal_reached_rate", "apex_error_abs_mean_m", "success_rate",
                         "open_loop_apex_mean_m")  # fmt: skip
    least: ClassVar = (3, 0.1)

    def __post_init__(self) -> None:
        super().__post_init__()
        low, high = self.height_range
        check(0.0 < low <= high < 10.0, f"height_range must be in (0, 10) m, got {self.height_range}")

    @property
    def flags(self) -> HeightFlags:
        """Flags of `jumper evaluate` that define the jumps of this suite."""
        return HeightFlags(self.num_jumps, height_range=self.height_range)

    def measure(self, run: EvaluationRun) -> Metrics:
        """Run the jumps and the open-loop jumps of the same robots, plot both, and return the metrics."""
        env, flags = run.env(self.num_jumps), self.flags
        initial_state = env.state_dict()
        jumps = self.run_flags(run, flags, env, "jumps")
        limit = open_loop_limits(env, initial_state)
        plot_sweep(
            run.folder / "sweep.png", jumps.goals[:, 0, 2], jumps.apex[:, 0], jumps.outcome.reached[:, 0], limit=limit,
            tolerance=TOLERANCE, paper=PAPER_HEIGHTS, marks=("reached", "missed"), title="Jumps to heights",
            labels=("commanded base height [m]", "highest base height [m]"),
            conditions=f"{run.title}, {self.num_jumps} jumps",
        )  # fmt: skip

        def pushed(conditions: Conditions) -> Metrics:
            return flags.metrics(self.run_flags(run, flags, run.env(self.num_jumps, None, conditions)))

        inside = within(jumps.goals[..., 2], flags.success_range)
        values = flags.metrics(jumps) | limit_metrics(jumps.outcome, jumps.goals[..., 2], limit[:, None], inside)
        names = ("success_rate", "goal_reached_rate", "in_range_goal_reached_rate", "landed_rate", "fall_rate",
                 "miss_rate", "apex_error_abs_mean_m")  # fmt: skip
        return values | self.pushed_in_flight(run, pushed, *names)


@dataclass(frozen=True)
class DistanceSweep(Suite):
    """Sweep of jumps to evenly spaced goals 0.3 to 1.5 m straight ahead, one each.

    Every robot stands in the default pose, with a heading sampled from the full circle, and is commanded to jump after
    half a second. A jump reaches its goal if the base is within 0.1 m of it in the plane a second after touchdown. It
    succeeds if it also starts on command, no other part than the paws touches anything, and the base is at rest. Paws
    lifted again, second hops and second takeoffs (upward at 0.25 m/s with no paw down) are reported separately.
    Randomised robots are pushed while a paw is down; a second test pushes them in flight too.
    """

    distance_range: tuple[float, float] = (0.3, 1.5)  # [m] Distance of the nearest and of the farthest goal
    max_lateral_offset: float = 0.0  # [m] Largest offset of a goal to either side; offsets are sampled
    end_at_second_takeoff: bool = False
    """Whether a second takeoff after landing ends a jump as a failure, as in the authors' configuration."""
    num_recorded: int = 5

    name: ClassVar = "sweep"
    paper: ClassVar = PLACE_PAPER
    summary: ClassVar = ("success_rate", "in_range_success_rate", "goal_distance_at_rest_mean_m", "fall_rate")
    least: ClassVar = (3, 0.1)

    def __post_init__(self) -> None:
        super().__post_init__()
        (near, far), side = self.distance_range, self.max_lateral_offset
        valid = 0.0 < near < far < 10.0 and 0.0 <= side < 10.0
        check(valid, f"goals must be within 10 m and rise, got {self.distance_range}, {side} to either side")

    @property
    def flags(self) -> LandingFlags:
        """Flags of `jumper evaluate` that define the jumps of this suite."""
        side = self.max_lateral_offset
        return LandingFlags(self.num_jumps, goal_x=self.distance_range, goal_y=(-side, side))

    def run_jumps(self, run: EvaluationRun, conditions: Conditions, film: str = "") -> JumpLog:
        """Run one jump per distance in given conditions, return the log; film: name of the recording, or empty."""
        change = with_second_takeoff if self.end_at_second_takeoff else with_jump_terminations
        return self.run_flags(run, self.flags, run.env(self.num_jumps, change, conditions), film)

    def metrics(self, log: JumpLog) -> Metrics:
        """Return the metrics of `jumper evaluate`, and the success rate over the paper's range of training."""
        inside, note = within(log.goals[..., 0], PAPER_TRAINED), "over 0.4 to 1 m"
        success = chosen(PLACE_METRICS, "success_rate")
        return self.flags.metrics(log) | measure(success, log.outcome, inside, "paper_training_range_", note)

    def measure(self, run: EvaluationRun) -> Metrics:
        """Run the jumps, plot reached over commanded distance, and return the metrics."""
        run.settings["end_at_second_takeoff"] = self.end_at_second_takeoff
        landings, trained = self.run_jumps(run, run.conditions, "jumps"), trained_range(run.task)["trained_range_m"]
        plot_sweep(
            run.folder / "sweep.png", landings.goals[:, 0, 0], landings.landing[:, 0, 0],
            landings.success[:, 0], tolerance=TOLERANCE, paper=PAPER_DISTANCES, marks=("on goal", "failed"),
            trained={"paper: range of training": PAPER_TRAINED, "range of training": tuple(trained)},
            labels=("commanded distance [m]", "distance of the base at the end [m]"), title="Jumps ahead",
            conditions=f"{run.title}, {self.num_jumps} jumps",
        )  # fmt: skip
        pushed = self.pushed_in_flight(
            run, lambda conditions: self.metrics(self.run_jumps(run, conditions)), "success_rate",
            "in_range_success_rate", "fall_rate", "miss_rate", "no_paw_lift_rate", "landing_tilt_max_deg",
            "goal_distance_at_rest_mean_m",
        )  # fmt: skip
        return self.metrics(landings) | pushed
