"""Base class of the test suites of jumps, and the paper's two sweeps, over heights and over distances."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from types import ModuleType
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from jumper_warp.evaluation.jump_metrics import HeightFlags, LandingFlags
from jumper_warp.evaluation.jumps import DELAY, REST_TIME, TOLERANCE, JumpLog, random_headings
from jumper_warp.evaluation.limits import limit_metrics, open_loop_limits
from jumper_warp.evaluation.log import check, within
from jumper_warp.evaluation.run import HEADLINES, EvaluationArgs, EvaluationRun
from jumper_warp.evaluation.trained import trained_range
from jumper_warp.tasks.jump.evaluation import HeightEvaluation, JumpEvaluation, PlaceEvaluation
from jumper_warp.utils.files import Json
from jumper_warp.utils.metrics import Metrics
from jumper_warp.viz.plots import Published, plot_sweep

if TYPE_CHECKING:
    from jumper_warp.envs.env import Env

PAPER_HEIGHTS = Published(mean_error=0.04, robot=((0.75, 0.0, 0.023), (1.0, 0.01, 0.0)), open_loop=1.075)
PAPER_DISTANCES = Published(mean_error=0.026, robot=((1.25, 0.0, 0.004),))
PAPER_TRAINED = (0.4, 1.0)  # [m] Range of goal distances in the paper's training


@dataclass(frozen=True)
class Suite(EvaluationArgs, ABC):
    """Base class of the test suites of jumping policies; the fields, also of `EvaluationArgs`, are their flags."""

    num_jumps: int = 200  # Number of jumps (per scene, bin or goal of a grid, where there are several)
    rest_time: float = REST_TIME  # [s] Time from touchdown to the end of a jump

    name: ClassVar[str]  # Value of `jumper evaluate --suite`, and name of the output folder
    kind: ClassVar[type[JumpEvaluation]] = PlaceEvaluation  # Evaluation of the tasks whose policies the suite accepts
    paper: ClassVar[Mapping[str, float]] = {}  # Values in the paper of metrics with the same names
    summary: ClassVar[tuple[str, ...]] = HEADLINES  # Keys of the metrics in the summary
    least: ClassVar[int] = 1  # Minimum number of jumps

    def __post_init__(self) -> None:
        """Raise InputError for fewer jumps than the suite needs, or a rest time [s] out of range."""
        super().__post_init__()
        jumps = self.least
        check(self.num_jumps >= jumps, f"need at least {jumps} jump{'s' * (jumps > 1)}, got {self.num_jumps}")
        check(0.1 <= self.rest_time <= 10.0, f"rest_time must be in [0.1, 10] s, got {self.rest_time}")

    @abstractmethod
    def measure(self, run: EvaluationRun) -> Metrics:
        """Run the jumps, write plots into `run.folder`, and return the metrics by key."""

    def run(self, modules: Iterable[ModuleType] = ()) -> Json:
        """Run the suite on its policy, write and print the metrics, and return them; modules: the user's task modules.

        Raises PolicyError, CheckpointError or InputError, see `EvaluationRun.from_args`.
        """
        run, metrics = self.evaluate(modules)
        return run.report(metrics, self.paper, self.summary)

    def evaluate(self, modules: Iterable[ModuleType] = ()) -> tuple[EvaluationRun, Metrics]:
        """Run the suite on its policy; return the evaluation and the metrics, without writing or printing them."""
        run = EvaluationRun.from_args(self.name, self, self.kind, modules)
        run.settings["rest_s"] = self.rest_time
        return run, self.measure(run)

    def run_landings(
        self,
        run: EvaluationRun,
        goals: np.ndarray,
        env: Env | None = None,
        *,
        headings: np.ndarray | None = None,
        delay: np.ndarray | float = DELAY,
        **options: Any,
    ) -> JumpLog:
        """Run jumps to goals [m], (num_envs, jumps in a row, 2), ahead and to the left, and return their log.

        env: default: `run.env`; headings [rad]: (num_envs,), default: random; delay [s]: see `JumpLog`; options:
        keywords of `EvaluationRun.run_episodes`.
        """
        env = run.env(len(goals)) if env is None else env
        headings = random_headings(len(goals), self.stream_seed) if headings is None else headings
        log = JumpLog(goals, env.task.termination_names, headings, delay, self.rest_time)
        return run.run_episodes(env, log, **options)


class Sweep(Suite):
    """Base class of suites with one jump to each of evenly spaced goals, which flags of `jumper evaluate` define."""

    @property
    @abstractmethod
    def flags(self) -> HeightFlags | LandingFlags:
        """Flags with which `jumper evaluate` runs the same jumps as this sweep."""

    def run_sweep(self, run: EvaluationRun, env: Env, film: str = "") -> JumpLog:
        """Simulate one jump to each goal of the sweep, and return the log; film: name of the recording."""
        log = self.flags.log(env.task, self.stream_seed)
        log.rest = self.rest_time
        return run.run_episodes(env, log, film=film)


@dataclass(frozen=True)
class HeightSweep(Sweep):
    """Sweep of jumps to evenly spaced heights from 0.5 to 1.2 m, one each.

    Every robot stands in the default pose and is commanded to jump after half a second. A jump reaches its height if
    the largest base height is within 0.1 m of the commanded height. It succeeds if it also starts on command, no other
    part than the paws touches anything, and the base is at rest a second after touchdown. A fall or a collision ends a
    jump, whose apex until then is evaluated. Randomised robots are pushed while a paw is down. The open-loop jump of
    each robot (squat, hold, full extension) gives the height it can reach.
    """

    policy: str = "vertical_jump"
    height_range: tuple[float, float] = (0.5, 1.2)  # [m] Lowest and highest commanded base height
    num_recorded: int = 5

    name: ClassVar = "range"
    kind: ClassVar = HeightEvaluation
    paper: ClassVar = HeightEvaluation.published
    summary: ClassVar = ("goal_reached_rate", "in_range_goal_reached_rate", "apex_error_abs_mean_m", "success_rate",
                         "open_loop_apex_mean_m")  # fmt: skip
    least: ClassVar = 3

    def __post_init__(self) -> None:
        """Raise InputError for heights [m] out of range, and as `Suite`."""
        super().__post_init__()
        low, high = self.height_range
        check(0.0 < low <= high < 10.0, f"height_range must be in (0, 10) m, got {self.height_range}")

    @property
    def flags(self) -> HeightFlags:
        """Flags with which `jumper evaluate` runs the same jumps as this sweep."""
        return HeightFlags(self.num_jumps, height_range=self.height_range)

    def measure(self, run: EvaluationRun) -> Metrics:
        """Run the jumps and the open-loop jumps of the same robots, plot both, and return the metrics."""
        env = run.env(self.num_jumps)
        initial_state = env.state_dict()
        jumps = self.run_sweep(run, env, "jumps")
        limit = open_loop_limits(env, initial_state)
        plot_sweep(
            run.folder / "sweep.png",
            jumps.goals[:, 0, 2],
            jumps.apex[:, 0],
            jumps.outcome.reached[:, 0],
            limit=limit,
            tolerance=TOLERANCE,
            paper=PAPER_HEIGHTS,
            marks=("reached", "missed"),
            title="Jumps to heights",
            labels=("commanded base height [m]", "error of the highest base height [m]"),
            conditions=f"{run.title}, {self.num_jumps} jumps",
        )
        inside = within(jumps.goals[..., 2], self.flags.success_range)
        values = limit_metrics(jumps.outcome, jumps.goals[..., 2], limit[:, None], inside)
        return self.flags.metrics(jumps) | values


@dataclass(frozen=True)
class DistanceSweep(Sweep):
    """Sweep of jumps to evenly spaced goals 0.3 to 1.5 m straight ahead, one each.

    Every robot stands in the default pose, with a heading sampled from the full circle, and is commanded to jump after
    half a second. A jump reaches its goal if the base is within 0.1 m of it in the plane a second after touchdown. It
    succeeds if it also starts on command, no other part than the paws touches anything, and the base is at rest. Paws
    lifted again, second hops and second takeoffs (upward at 0.25 m/s with no paw down) are reported separately.
    Randomised robots are pushed while a paw is down.
    """

    distance_range: tuple[float, float] = (0.3, 1.5)  # [m] Distance of the nearest and of the farthest goal
    max_lateral_offset: float = 0.0  # [m] Largest offset of a goal to either side; offsets are sampled
    num_recorded: int = 5

    name: ClassVar = "range"
    paper: ClassVar = PlaceEvaluation.published
    summary: ClassVar = ("success_rate", "in_range_success_rate", "goal_distance_at_rest_mean_m", "fall_rate")
    least: ClassVar = 3

    def __post_init__(self) -> None:
        """Raise InputError for distances [m] out of range, and as `Suite`."""
        super().__post_init__()
        (near, far), side = self.distance_range, self.max_lateral_offset
        valid = 0.0 < near < far < 10.0 and 0.0 <= side < 10.0
        check(valid, f"goals must be within 10 m and rise, got {self.distance_range}, {side} to either side")

    @property
    def flags(self) -> LandingFlags:
        """Flags with which `jumper evaluate` runs the same jumps as this sweep."""
        side = self.max_lateral_offset
        return LandingFlags(self.num_jumps, goal_x=self.distance_range, goal_y=(-side, side))

    def measure(self, run: EvaluationRun) -> Metrics:
        """Run the jumps, plot the errors, and return the metrics."""
        landings = self.run_sweep(run, run.env(self.num_jumps), "jumps")
        trained = trained_range(run.task)["trained_range_m"]
        plot_sweep(
            run.folder / "sweep.png",
            landings.goals[:, 0, 0],
            landings.landing[:, 0, 0],
            landings.success[:, 0],
            tolerance=TOLERANCE,
            paper=PAPER_DISTANCES,
            marks=("on goal", "failed"),
            trained={"paper: range of training": PAPER_TRAINED, "range of training": tuple(trained)},
            labels=("commanded distance [m]", "error of the base at the end [m]"),
            title="Jumps ahead",
            conditions=f"{run.title}, {self.num_jumps} jumps",
        )
        return self.flags.metrics(landings)
