"""Test suites of jumps: grid, ring, jumps in a row, other grounds, farthest distance; and the table of all suites.

`jumper evaluate POLICY --suite NAME` runs a suite. Headings are sampled from the full circle; `jump_metrics` defines
the metrics.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator
from dataclasses import dataclass, fields
from typing import Any, ClassVar

import numpy as np

from jumper_warp.evaluation.jump_metrics import PLACE_METRICS, jump_metrics, range_metrics
from jumper_warp.evaluation.jumps import TOLERANCE, JumpLog, JumpOutcome
from jumper_warp.evaluation.log import check, within
from jumper_warp.evaluation.recorder import block_positions
from jumper_warp.evaluation.run import EvaluationRun
from jumper_warp.evaluation.sweeps import DistanceSweep, HeightSweep, Suite
from jumper_warp.robot.grounds import SIZE, BlockCfg, platform, uneven
from jumper_warp.tasks.cfg import TaskCfg
from jumper_warp.utils.files import Json
from jumper_warp.utils.metrics import Metrics, MetricValue, chosen, largest, mean, measure, rate
from jumper_warp.utils.rotations import turn_plane
from jumper_warp.viz.plots import plot_distances, plot_landings, plot_paths, regular_polygons

MOST_JUMPS = 100_000  # Largest number of jumps of a suite
AHEAD, ASIDE = (0.35, 1.4), (-0.35, 0.35)  # [m] Ranges of the grid's goals ahead and to the left
SECTORS = ("ahead", "left", "back", "right")  # Quarters of a ring, each centred on its direction
PAIRS = {"diagonal": ((0.8, 0.2), (0.75, -0.2)), "straight": ((0.8, 0.0), (0.8, 0.0))}
"""[m] Goals of the paper's pairs of jumps in a row, each relative to the previous one."""
ROW_LOWER, ROW_UPPER, DELAYS = (0.4, -0.2), (0.9, 0.2), (0.3, 1.0)
"""[m] Range of goals in a long row; [s] range of the time until the first command of any row."""
GROUND_LOWER, GROUND_UPPER = (0.8, -0.15), (1.4, 0.15)
"""[m] Range of goals off the platform or on the block, in which all jumps of the paper's simulation succeed."""
DROP, AMPLITUDE, FLAT_RADIUS = 0.15, 0.05, 0.35
"""[m] Height of the platform; amplitude of the uneven ground; radius of level ground around its start."""
BLOCK_HEIGHT, BLOCK_MASS, BLOCK_FRICTION, BLOCK_BEYOND, BLOCK_WIDTH = 0.05, 10.0, 0.4, 0.40, 0.8
"""[m], [kg], [1] Height, mass, friction with the floor; [m] distance from goal to far side; [m] width along y."""
BIN, IN_RANGE, LIMIT = 0.1, (1.0, 1.4), 9.0
"""[m] Width of a bin of distances; range of distances of the `in_range` metrics; largest `max_distance`."""
GIVEN_UP, RELIABLE = 0.5, 0.95  # [1] Success rate that ends the search for farther bins; rate of a reliable distance
RATES = {
    "": "success_rate", "_without_hop": "success_without_hop_rate",
    "_without_paw_lift": "success_without_paw_lift_rate",
}  # fmt: skip
"""Success rate that defines each reliable distance, by the suffix of the distance's name."""
MEANS = (
    *RATES.values(), "fall_rate", "miss_rate", "no_paw_lift_rate", "goal_distance_at_rest_mean_m",
    "goal_distance_at_touchdown_mean_m", "distance_flown_mean_m", "paw_to_paw_distance_mean_m", "landing_tilt_max_deg",
)  # fmt: skip
"""Keys of the metrics that are reported for each bin of distances, as lists `bin_<key>`."""
PUBLISHED = {
    "Barkour (Caluwaerts et al. 2023)": 0.5, "Margolis et al. 2021": 0.66, "Liu et al. 2023": 0.8,
    "Cheng et al. 2024": 0.8, "Atanassov et al. 2024": 0.9, "Jumper, the paper's robot": 1.25,
}  # fmt: skip
"""[m] Published jump distances of robots, from the paper's table."""


@dataclass(frozen=True)
class Grid(Suite):
    """Jumps to goals on a grid 0.35 to 1.4 m ahead and up to 0.35 m to either side, two per goal.

    Goals less than 1.4 m ahead, where all jumps of the paper succeed, are in range.
    """

    num_jumps: int = 2
    columns: int = 22  # Number of distances ahead
    rows: int = 5  # Number of distances to the side

    name: ClassVar = "grid"
    paper: ClassVar = {"goal_distance_at_rest_mean_m": 0.025, "goal_distance_at_end_mean_m": 0.025,
                       "success_rate": 0.968, "in_range_success_rate": 1.0}  # fmt: skip
    summary: ClassVar = DistanceSweep.summary

    def __post_init__(self) -> None:
        """Raise InputError for an empty grid or too many jumps, and as `Suite`."""
        super().__post_init__()
        check(min(self.columns, self.rows) >= 1, f"need at least one column and row, got {self.columns}, {self.rows}")
        check_jumps(self.columns * self.rows * self.num_jumps, "columns, rows and num_jumps")

    @property
    def goals(self) -> np.ndarray:
        """Goals of the grid ahead and to the left [m], (columns * rows * jumps, 1, 2)."""
        x, y = np.meshgrid(np.linspace(*AHEAD, self.columns), np.linspace(*ASIDE, self.rows), indexing="ij")
        return np.repeat(np.stack([x.ravel(), y.ravel()], axis=1), self.num_jumps, axis=0)[:, None]

    def measure(self, run: EvaluationRun) -> Metrics:
        """Run the jumps, plot the landing positions, and return the metrics."""
        landings = self.run_landings(run, self.goals, film="jumps")
        plot(run, "grid", "Jumps to a grid of goals", {"": landings}, f"{len(landings.end)} jumps")
        inside = landings.goals[..., 0] < AHEAD[1] - 1.0e-6
        outcome = landings.outcome
        return jump_metrics(outcome) | range_metrics(outcome, inside, "less than 1.4 m ahead")


@dataclass(frozen=True)
class Ring(Suite):
    """Jumps to goals spread evenly over a ring around the start."""

    policy: str = "horizontal_jump"
    radius: float = 0.5  # [m] Radius of the ring

    name: ClassVar = "ring"
    summary: ClassVar = ("success_rate", "goal_distance_at_rest_mean_m", *(f"{name}_success_rate" for name in SECTORS))
    least: ClassVar = len(SECTORS)

    def __post_init__(self) -> None:
        """Raise InputError for a radius [m] out of range, and as `Suite`."""
        super().__post_init__()
        check(0.0 < self.radius < 3.0, f"radius must be in (0, 3) m, got {self.radius}")

    def measure(self, run: EvaluationRun) -> Metrics:
        """Run the jumps, plot landing positions, return metrics, with success, fall and miss rates by quarter."""
        angle = np.linspace(0.0, 2.0 * np.pi, self.num_jumps, endpoint=False)
        goals = self.radius * np.stack([np.cos(angle), np.sin(angle)], axis=-1)[:, None]
        landings = self.run_landings(run, goals, film="jumps")
        words = f"{self.num_jumps} jumps"
        plot(run, "landings", f"Jumps over {self.radius:g} m", {"": landings}, words, magnify=10.0)
        sector = np.round(np.arctan2(goals[..., 1], goals[..., 0]) / (0.5 * np.pi)).astype(int) % len(SECTORS)
        rows = chosen(PLACE_METRICS, "success_rate", "fall_rate", "miss_rate")
        values = jump_metrics(landings.outcome)
        for i, name in enumerate(SECTORS):
            values |= measure(rows, landings.outcome, sector == i, f"{name}_", name)
        return values


@dataclass(frozen=True)
class Consecutive(Suite):
    """Jumps in a row, each commanded 1 s after the previous touchdown: two to the paper's goals, ten to random goals.

    A goal is relative to the robot's position and heading when the jump is commanded. Robots differ in heading and in
    the delay of the first command. After a fall or a collision no further jump counts. `row_all_landed_rate` is the
    fraction of long rows without a fall or collision, `row_all_success_rate` the fraction with successful jumps only.
    """

    num_jumps: int = 20  # Number of trials of each pair
    num_trials: int = 100  # Number of trials with many jumps in a row
    jumps_per_trial: int = 10  # Number of jumps in each of these trials

    name: ClassVar = "consecutive"
    paper: ClassVar = {"goal_distance_at_rest_mean_m": 0.0054}
    summary: ClassVar = ("both_landed_rate", "goal_distance_at_rest_mean_m", "row_all_success_rate", "row_fall_rate",
                         "row_goal_distance_at_rest_mean_m")  # fmt: skip

    def __post_init__(self) -> None:
        """Raise InputError for no trials or too many jumps, and as `Suite`."""
        super().__post_init__()
        trials, jumps = self.num_trials, self.jumps_per_trial
        check(min(trials, jumps) >= 1, f"need at least one trial and one jump in it, got {trials}, {jumps}")
        check_jumps(trials * jumps, "num_trials and jumps_per_trial")

    def measure(self, run: EvaluationRun) -> Metrics:
        """Run pairs and long sequences of jumps, plot the paths of the bases, and return the metrics."""
        rng = np.random.default_rng(self.stream_seed)
        pairs = np.repeat(np.array(list(PAIRS.values())), self.num_jumps, axis=0)
        rows = rng.uniform(ROW_LOWER, ROW_UPPER, (self.num_trials, self.jumps_per_trial, 2))
        logs = []
        paths = []
        for name, goals in (("pairs", pairs), ("row", rows)):
            positions: list[np.ndarray] = []
            logs.append(
                self.run_landings(
                    run,
                    goals,
                    delay=rng.uniform(*DELAYS, len(goals)),
                    film=name,
                    on_step=lambda log, to=positions: to.append(running_positions(log)),
                )
            )
            paths.append(turn_plane(np.stack(positions, axis=1), -logs[-1].headings[:, None]))
        parts = dict(zip((*PAIRS, f"{self.jumps_per_trial} in a row"), (*np.split(paths[0], 2), paths[1]), strict=True))
        words = f"{run.title}, {self.num_jumps} pairs of each kind, {self.num_trials} long rows"
        plot_paths(run.folder / "paths.png", parts, PAIRS, words)
        run.settings["jumps_in_a_row"] = self.jumps_per_trial
        return consecutive_metrics(*logs)


def check_jumps(count: int, factors: str) -> None:
    """Raise InputError if a suite would have more than MOST_JUMPS jumps; count: product of the settings `factors`."""
    check(count <= MOST_JUMPS, f"the product of {factors} must be at most {MOST_JUMPS}, got {count}")


def running_positions(jumps: JumpLog) -> np.ndarray:
    """Return the current base positions x, y [m], (worlds, 2), world frame; NaN if a robot's last jump has ended."""
    running = jumps.current < jumps.goals.shape[1]
    return np.where(running[:, None], jumps.arrays["base_pos"][:, :2], np.nan)


def consecutive_metrics(pairs: JumpLog, row: JumpLog) -> Metrics:
    """Return the metrics of pairs of jumps, and of long sequences of jumps as `row_<key>`.

    pairs: the first half diagonal, the second half straight.
    """
    first, rows = pairs.outcome, row.outcome
    errors = chosen(PLACE_METRICS, "goal_distance_at_rest_mean_m")
    halves = np.arange(2).repeat(len(first.landed) // 2)[:, None]
    numbers = np.arange(2)
    return {
        **jump_metrics(first),
        **{key: value for i, name in enumerate(PAIRS)
           for key, value in measure(errors, first, halves == i, f"{name}_", f"of {name} pairs").items()},
        **{key: value for i in numbers
           for key, value in measure(errors, first, numbers == i, f"jump_{i + 1}_", f"{i + 1} of 2").items()},
        "both_landed_rate": rate(first.landed.all(axis=1), "pairs"),
        "row_all_landed_rate": rate(rows.landed.all(axis=1), "rows"),
        "row_all_success_rate": rate(rows.success.all(axis=1), "rows"),
        "row_landed_jumps_mean": mean(rows.landed.sum(axis=1), "rows"),
        **jump_metrics(rows, prefix="row_", note="of rows"),
    }  # fmt: skip


@dataclass(frozen=True)
class Platform(Suite):
    """Jumps off a platform of 0.15 m, onto uneven ground, and onto a sliding block.

    Most policies observe only the base's height above the ground below it. Uneven ground has bumps of up to 0.05 m
    around a level start, and every robot jumps in a random direction. The block, 10 kg and 0.05 m high, lies under the
    goal and slides when the robot lands on it; the goal does not move. With SolverMuJoCo, which has no sliding block,
    that scene is omitted.
    """

    num_jumps: int = 100
    edge: float = 0.40
    """[m] Distance from the start to the platform's edge, rounded down to 0.02 m, and to the block's near edge."""

    name: ClassVar = "platform"
    summary: ClassVar = tuple(f"{scene}_{key}" for scene in ("platform", "uneven", "block")
                              for key in ("success_rate", "goal_distance_at_rest_mean_m", "fall_rate"))  # fmt: skip

    def __post_init__(self) -> None:
        """Raise InputError for an edge [m] under the start or beyond the nearest goal, and as `Suite`."""
        super().__post_init__()
        low = 0.3
        high = GROUND_LOWER[0]
        check(low <= self.edge < high, f"edge must be from {low} m to below {high} m, got {self.edge}")

    def scenes(self, goals: np.ndarray, rng: np.random.Generator) -> Iterator[tuple[str, Json, np.ndarray]]:
        """Yield the test grounds: name, arguments for `Env`, headings [rad] (num_envs,); goals [m]: (num_envs, 2)."""
        straight = np.zeros(len(goals))
        yield "platform", {"ground": platform(-DROP, edge=self.edge)}, straight
        bumps = uneven(AMPLITUDE, int(rng.integers(2**31)), flat_radius=FLAT_RADIUS)
        yield "uneven", {"ground": bumps}, rng.uniform(-math.pi, math.pi, len(goals))
        if self.solver != "mujoco":
            far = goals[:, 0] + BLOCK_BEYOND
            center = np.stack([0.5 * (self.edge + far), goals[:, 1]], axis=1)
            half = np.stack([0.5 * (far - self.edge), np.full(len(goals), 0.5 * BLOCK_WIDTH)], axis=1)
            yield "block", {"block": BlockCfg(center, half, BLOCK_HEIGHT, BLOCK_MASS, BLOCK_FRICTION)}, straight

    def outlines(self, goals: np.ndarray) -> dict[str, tuple[str, np.ndarray]]:
        """Return the outline that each scene's plot shows, (title, corners [m]): platform, level circle or block."""
        x, y = np.median(goals, axis=0)
        block = rectangle(self.edge, x + BLOCK_BEYOND, y - 0.5 * BLOCK_WIDTH, y + 0.5 * BLOCK_WIDTH)
        level = regular_polygons(np.zeros((1, 2)), FLAT_RADIUS)
        return {
            "platform": (f"platform, {DROP:g} m high", rectangle(-SIZE, self.edge, -SIZE, SIZE)),
            "uneven": (f"level circle, then bumps up to ±{AMPLITUDE:g} m", level),
            "block": (f"block of the median goal, {BLOCK_HEIGHT:g} m high", block),
        }

    def measure(self, run: EvaluationRun) -> Metrics:
        """Run the jumps of all scenes, plot them, and return the metrics as `<scene>_<key>`."""
        rng = np.random.default_rng(self.stream_seed)
        goals = rng.uniform(GROUND_LOWER, GROUND_UPPER, (self.num_jumps, 2))
        run.settings["edge_m"] = self.edge
        values = {}
        done: dict[str, JumpLog] = {}
        for name, scene, headings in self.scenes(goals, rng):
            env = run.env(self.num_jumps, **scene)
            done[name] = self.run_landings(run, goals[:, None], env, headings=headings, film=name, film_scene=scene)
            values |= jump_metrics(done[name].outcome, prefix=f"{name}_", note=f"({name})")
            if "block" in scene:
                slide = np.linalg.norm(block_positions(env.sim) - scene["block"].center, axis=1)
                values |= {"block_slide_mean_m": mean(slide, "jumps"), "block_slide_max_m": largest(slide, "jumps")}
        words = f"{self.num_jumps} jumps each"
        outlines = self.outlines(goals)
        plot(run, "landings", "Jumps to other grounds", done, words, outlines=outlines)
        return values


@dataclass(frozen=True)
class Farthest(Suite):
    """Jumps to ever farther goals, in bins 0.1 m wide from 1 m on, until fewer than half of a bin's jumps succeed.

    Goals of a bin lie in one direction, within 0.05 m of its middle. A far goal may be reached by steps or a second hop
    after the landing. Therefore three reliable distances are reported, the largest middle of a bin up to which at least
    95 % of the jumps succeed: by any means; without a second hop (all paws off the ground again for more than 0.05 s);
    without lifting a paw again (for 0.05 s). For each, the bin's mean distance flown by the base, and mean distance
    from paws to paws, are reported too. `measure` writes the plot `max_jump.png`. It shows distances published for real
    robots too. `Suite` explains `paper`, `summary` and `run_landings`.
    """

    num_jumps: int = 100
    min_distance: float = 1.0  # [m] Distance at the middle of the first bin
    max_distance: float = 2.5  # [m] Distance at the middle of the last bin
    direction: float = 0.0  # [deg] Direction of the goals from the robot: 0 ahead, 90 to the left, 180 back

    name: ClassVar = "max"
    paper: ClassVar = {"reliable_distance_without_hop_m": 1.25}
    summary: ClassVar = tuple(f"reliable_{name}{suffix}_m" for suffix in RATES
                              for name in ("distance", "distance_flown"))  # fmt: skip

    def __post_init__(self) -> None:
        """Raise InputError for distances [m] or a direction [deg] out of range, and as `Suite`."""
        super().__post_init__()
        near = self.min_distance
        far = self.max_distance
        limits = f"0.1 <= min_distance <= max_distance <= {LIMIT:g} m"
        check(0.1 <= near <= far <= LIMIT, f"need {limits}, got {near} and {far}")
        check(-180.0 <= self.direction <= 180.0, f"direction must be in -180..180 deg, got {self.direction}")

    def goals(self, middle: float) -> np.ndarray:
        """Return the goals of a bin ahead and to the left [m], (num_jumps, 1, 2); middle: distance of the bin [m]."""
        distance = middle + BIN * (np.linspace(0.0, 1.0, self.num_jumps) - 0.5 if self.num_jumps > 1 else np.zeros(1))
        angle = math.radians(self.direction)
        return distance[:, None, None] * np.array([math.cos(angle), math.sin(angle)])

    def measure(self, run: EvaluationRun) -> Metrics:
        """Run jumps to ever farther goals until success is below GIVEN_UP, plot them, and return the metrics."""
        env = run.env(self.num_jumps)
        bins = {}
        for number in range(round((self.max_distance - self.min_distance) / BIN) + 1):
            middle = round(self.min_distance + number * BIN, 6)
            bins[middle] = self.run_landings(run, self.goals(middle), env, film=f"jump_{middle:.1f}_m")
            success = bins[middle].success.mean()
            print(f"{middle:.1f} m: {success:.1%} success", file=sys.stderr, flush=True)
            if success < GIVEN_UP:
                break
        run.settings["direction_deg"] = self.direction
        outcomes = [log.outcome for log in bins.values()]
        successes = {
            "success": np.array([outcome.success[:, 0] for outcome in outcomes]),
            "success without a second hop": np.array([(o.success & ~o.hopped)[:, 0] for o in outcomes]),
            "success without lifting a paw": np.array([(o.success & o.still)[:, 0] for o in outcomes]),
        }
        errors = np.array([np.where(o.success, o.distance_at_rest_m, np.nan)[:, 0] for o in outcomes])
        conditions = f"{run.title}, {self.num_jumps} jumps each"
        values = distance_metrics(bins)
        covered: dict[str, Any] = {
            "from paws to paws": values["bin_paw_to_paw_distance_mean_m"].value,
            "flown by the base": values["bin_distance_flown_mean_m"].value,
        }
        plot_distances(
            run.folder / "max_jump.png", [*bins], successes, errors, covered=covered, reliable=RELIABLE,
            published=PUBLISHED, conditions=conditions,
        )  # fmt: skip
        return values


def plot(run: EvaluationRun, file: str, title: str, logs: dict[str, JumpLog], words: str, **options: Any) -> None:
    """Plot goals and landings of each robot's first jump; logs: by scene; words: caption; options: `plot_landings`."""
    points = {name: (log.goals[:, 0, :2], log.landing[:, 0], log.success[:, 0]) for name, log in logs.items()}
    conditions = f"{run.title}, {words}"
    plot_landings(
        run.folder / f"{file}.png", points, tolerance=TOLERANCE, title=title, conditions=conditions, **options
    )


def rectangle(x0: float, x1: float, y0: float, y1: float) -> np.ndarray:
    """Return the corners [m] of an axis-aligned rectangle, (1, 4, 2)."""
    return np.array([[(x0, y0), (x1, y0), (x1, y1), (x0, y1)]])


def distance_metrics(bins: dict[float, JumpLog]) -> Metrics:
    """Return the largest distances with reliable jumps, metrics of all jumps, and lists `bin_<key>` over distance bins.

    bins: logs by distance at the bin's middle [m], ascending.
    """
    outcomes = [landings.outcome for landings in bins.values()]
    names = [field.name for field in fields(JumpOutcome)]
    together = JumpOutcome(**{name: np.concatenate([getattr(o, name) for o in outcomes]) for name in names})
    goals = np.concatenate([landings.goals for landings in bins.values()])
    inside = within(np.linalg.norm(goals, axis=-1), IN_RANGE)
    by_bin = [measure(chosen(PLACE_METRICS, *MEANS), outcome) for outcome in outcomes]
    lists: dict[str, list[Any]] = {key: [metrics[key].value for metrics in by_bin] for key in MEANS}
    values = jump_metrics(together) | range_metrics(together, inside, "over 1 to 1.4 m")
    for suffix, key in RATES.items():
        first_bad = next((i for i, success in enumerate(lists[key]) if success < RELIABLE), len(bins))
        for name, column in (
            ("reliable_distance", list(bins)),
            ("reliable_distance_flown", lists["distance_flown_mean_m"]),
            ("reliable_paw_to_paw_distance", lists["paw_to_paw_distance_mean_m"]),
        ):
            values[f"{name}{suffix}_m"] = MetricValue(column[first_bad - 1] if first_bad else None)
    values["bin_m"] = MetricValue(list(bins))
    return values | {f"bin_{key}": MetricValue(column) for key, column in lists.items()}


SUITES: tuple[type[Suite], ...] = (HeightSweep, DistanceSweep, Grid, Ring, Consecutive, Platform, Farthest)


def suites_for(task: TaskCfg) -> dict[str, type[Suite]]:
    """Return the suites, by name, that accept policies of a task."""
    return {suite.name: suite for suite in SUITES if isinstance(task.evaluation, suite.kind)}
