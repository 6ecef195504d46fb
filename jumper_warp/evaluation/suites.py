"""Suites of jumps to landing positions other than the sweep, and the table of all suites.

`jumper evaluate POLICY --suite NAME` runs one. Headings are sampled from the full circle; error and success are defined
as in the sweep.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from jumper_warp.evaluation.film import block_positions
from jumper_warp.evaluation.heights import SUCCESS_TOLERANCE
from jumper_warp.evaluation.landings import AT_REST_AT_END, FALLS, MISSED, LandingLog, landing_metrics, trained_range
from jumper_warp.evaluation.log import largest, mean, within
from jumper_warp.evaluation.plots import BasePaths, plot_distances, plot_landings, plot_paths, regular_polygons
from jumper_warp.evaluation.run import EvaluationRun
from jumper_warp.evaluation.sweeps import DistanceSweep, HeightSweep, Suite, check
from jumper_warp.robot.grounds import SIZE, BlockCfg, platform, uneven

AHEAD, ASIDE = (0.35, 1.4), (-0.35, 0.35)  # [m] Ranges of the grid's goals ahead and to the left
SECTORS = ("ahead", "left", "back", "right")  # Quarters of a ring, each centred on its direction
PAIRS = {"diagonal": ((0.8, 0.2), (0.75, -0.2)), "straight": ((0.8, 0.0), (0.8, 0.0))}
"""[m] Goals of the paper's two jumps in a row, each relative to the one before."""
ROW_LOWER, ROW_UPPER, DELAYS = (0.4, -0.2), (0.9, 0.2), (0.3, 1.0)
"""[m] Range of goals in a long row; [s] range of the time until the first command of any row."""
ROW_METRICS = (
    "success_rate", "fall_rate", "miss_rate", "step_rate", "still_landing_rate", "second_takeoff_rate",
    "max_landing_tilt_deg", AT_REST_AT_END,
)  # fmt: skip
"""Metrics that are also reported for the long rows of jumps, with the suffix `_ten`."""
GROUND_LOWER, GROUND_UPPER = (0.8, -0.15), (1.4, 0.15)
"""[m] Range of goals off the platform or on the block; the paper's simulation always succeeds in it."""
DROP, AMPLITUDE, FLAT_RADIUS = 0.15, 0.05, 0.35
"""[m] Height of the platform; amplitude of the uneven ground; radius of level ground around its start."""
BLOCK_HEIGHT, BLOCK_MASS, BLOCK_FRICTION, BLOCK_BEYOND, BLOCK_WIDTH = 0.05, 10.0, 0.4, 0.40, 0.8
"""[m], [kg], [1] Height, mass, friction with the floor; [m] distance from goal to far side; [m] width along y."""
BIN, IN_RANGE, LIMIT = 0.1, (1.0, 1.4), 9.0
"""[m] Width of a bin of distances; range of distances of `success_rate_in_range`; largest `max_distance`."""
GIVEN_UP, RELIABLE = 0.5, 0.95  # [1] Success rate below which no farther bin is tried; that of a reliable distance
RATES = {"": "success_rate", "_without_hop": "single_jump_success_rate", "_without_step": "step_free_success_rate"}
"""Success rate that defines each reliable distance, by the suffix of the distance's metric."""
BIN_METRICS = (
    *RATES.values(), "mean_error_m", "mean_error_of_successes_m", "mean_error_at_touchdown_m",
    "mean_error_0_3_s_after_touchdown_m", "fall_rate", "miss_rate", "still_landing_rate", "max_landing_tilt_deg",
)  # fmt: skip
"""Metrics of each bin of distances, reported as lists `bin_<name>`."""
PUBLISHED = {
    "Barkour (Caluwaerts et al. 2023)": 0.5, "Margolis et al. 2021": 0.66, "Liu et al. 2023": 0.8,
    "Cheng et al. 2024": 0.8, "Atanassov et al. 2024": 0.9, "Jumper, the paper's robot": 1.25,
}  # fmt: skip
"""[m] Jump distances of robots, from the paper's table."""


@dataclass(frozen=True)
class Grid(Suite):
    """Jumps to goals on a grid 0.35 to 1.4 m ahead and 0.35 m to either side, two each.

    In range are goals less than 1.4 m ahead, where the paper's jumps all succeed.
    """

    num_jumps: int = 2
    columns: int = 22  # Number of distances ahead
    rows: int = 5  # Number of distances to the side

    name: ClassVar = "grid"
    paper: ClassVar = {"mean_error_m": 0.025, "success_rate": 0.968, "success_rate_in_range": 1.0}

    def __post_init__(self) -> None:
        super().__post_init__()
        check(min(self.columns, self.rows) >= 1, f"need at least one column and row, got {self.columns}, {self.rows}")

    @property
    def goals(self) -> np.ndarray:
        """[m] Goals ahead and to the left, (columns * rows * jumps, 1, 2)."""
        x, y = np.meshgrid(np.linspace(*AHEAD, self.columns), np.linspace(*ASIDE, self.rows), indexing="ij")
        return np.repeat(np.stack([x.ravel(), y.ravel()], axis=1), self.num_jumps, axis=0)[:, None]

    def measure(self, run: EvaluationRun) -> dict[str, Any]:
        """Run the jumps, plot the landing positions, and return the metrics."""
        landings = self.run_landings(run, self.goals, film="jumps")
        plot_landings(
            run.folder / "grid.png", {"": landed_at(landings)}, tolerance=SUCCESS_TOLERANCE,
            title="Jumps to a grid of goals", conditions=f"{run.title}, {len(landings.end)} jumps",
        )  # fmt: skip
        inside = landings.goal_positions[..., 0] < AHEAD[1] - 1.0e-6
        return {"goals": self.columns * self.rows, **landing_metrics(landings, inside)}


@dataclass(frozen=True)
class Ring(Suite):
    """Jumps to goals spread evenly over a ring around the start."""

    policy: str = "omnidirectional_jump"
    radius: float = 0.5  # [m] Radius of the ring

    name: ClassVar = "ring"
    least: ClassVar = (len(SECTORS), 0.1)

    def __post_init__(self) -> None:
        super().__post_init__()
        check(0.0 < self.radius < 3.0, f"radius must be in (0, 3) m, got {self.radius}")

    def measure(self, run: EvaluationRun) -> dict[str, Any]:
        """Run the jumps, plot landing positions, return the metrics, with three rates per quarter of the ring."""
        angle = np.linspace(0.0, 2.0 * np.pi, self.num_jumps, endpoint=False)
        goals = self.radius * np.stack([np.cos(angle), np.sin(angle)], axis=-1)[:, None]
        landings = self.run_landings(run, goals, film="jumps")
        plot_landings(
            run.folder / "landings.png", {"": landed_at(landings)}, tolerance=SUCCESS_TOLERANCE,
            title=f"Jumps over {self.radius:g} m", conditions=f"{run.title}, {self.num_jumps} jumps",
        )  # fmt: skip
        sector = np.round(np.arctan2(goals[..., 1], goals[..., 0]) / (0.5 * np.pi)).astype(int) % len(SECTORS)
        fell, missed = np.isin(landings.ends, FALLS), landings.outcomes == MISSED
        values = landing_metrics(landings)
        for i, name in enumerate(SECTORS):
            for rate, counts in (("success", landings.success), ("fall", fell), ("miss", missed)):
                values[f"{rate}_rate_{name}"] = mean(counts[sector == i])
        return values


@dataclass(frozen=True)
class Consecutive(Suite):
    """Jumps in a row: the paper's pairs, and ten to random goals; the next is commanded a second after touchdown.

    A goal is relative to the robot's position and heading when the jump is commanded. Robots differ in heading and in
    the delay of the first command. The error of a jump is the distance of the base from its goal when the next one is
    commanded; after a fall or a collision no further jump counts. `ten_in_a_row_rate` is the fraction of rows without a
    fall or collision, `row_all_on_goal_rate` the fraction in which every jump succeeded. `success_rate_in_range`
    includes all goals.
    """

    num_jumps: int = 20  # Number of trials of each pair
    num_trials: int = 100  # Number of trials with many jumps in a row
    jumps_per_trial: int = 10  # Number of jumps in each of these trials

    name: ClassVar = "consecutive"
    paper: ClassVar = {"mean_error_m": 0.0054}

    def __post_init__(self) -> None:
        super().__post_init__()
        trials, jumps = self.num_trials, self.jumps_per_trial
        check(min(trials, jumps) >= 1, f"need at least one trial and one jump in it, got {trials}, {jumps}")

    def measure(self, run: EvaluationRun) -> dict[str, Any]:
        """Run pairs and long rows, plot the paths of the bases, and return the metrics."""
        rng = np.random.default_rng(self.seed)
        pairs = np.repeat(np.array(list(PAIRS.values())), self.num_jumps, axis=0)
        rows = rng.uniform(ROW_LOWER, ROW_UPPER, (self.num_trials, self.jumps_per_trial, 2))
        logs, paths = [], []
        for name, goals in (("pairs", pairs), ("row", rows)):
            base_paths, delay = BasePaths(), rng.uniform(*DELAYS, len(goals))
            logs.append(self.run_landings(run, goals, delay=delay, film=name, on_step=base_paths))
            paths.append(base_paths.in_start_frame(logs[-1].headings))
        parts = dict(zip((*PAIRS, f"{self.jumps_per_trial} in a row"), (*np.split(paths[0], 2), paths[1]), strict=True))
        words = f"{run.title}, {self.num_jumps} pairs of each kind, {self.num_trials} long rows"
        plot_paths(run.folder / "paths.png", parts, PAIRS, words)
        return {"rest_s": self.rest_time} | consecutive_metrics(*logs)


def consecutive_metrics(pairs: LandingLog, row: LandingLog) -> dict[str, Any]:
    """Return `landing_metrics` of pairs, and metrics of long rows; pairs: first half diagonal, second half straight."""
    values, ten = (landing_metrics(landings) for landings in (pairs, row))
    for metrics in (values, ten):
        if "at_rest_within_1_s_rate" in metrics:
            metrics[AT_REST_AT_END] = metrics.pop("at_rest_within_1_s_rate")
    halves = zip(PAIRS, np.split(pairs.error, 2), strict=True)
    return values | {
        "success_rate_in_range": values["success_rate"],
        **{f"mean_error_{name}_m": mean(error) for name, error in halves},
        **{f"mean_error_jump_{i + 1}_m": mean(pairs.error[:, i]) for i in range(2)},
        "both_landed_rate": mean(pairs.landed.all(axis=1)),
        "row": row.goals.shape[1],
        "trials": len(row.goals),
        "ten_in_a_row_rate": mean(row.landed.all(axis=1)),
        "row_all_on_goal_rate": mean(row.success.all(axis=1)),
        "mean_jumps_until_the_end": mean(row.landed.sum(axis=1)),
        "mean_error_ten_m": ten["mean_error_m"],
        **{f"{name}_ten": ten[name] for name in ROW_METRICS},
        "mean_error_by_number_m": [mean(error) for error in row.error.T],
    }


@dataclass(frozen=True)
class Platform(Suite):
    """Jumps off a platform of 0.15 m, onto uneven ground, and onto a sliding block.

    Most policies observe nothing of the ground but the base's height above the spot below it. Uneven ground has bumps
    of up to 0.05 m around a level start, and every robot jumps in a random direction. The block, 10 kg and 0.05 m
    high, reaches from before the goal to beyond it and slides when the robot lands on it; the goal stays. The range of
    `success_rate_in_range` is all goals. SolverMuJoCo has no sliding block: with it that scene is left out.
    """

    num_jumps: int = 100
    edge: float = 0.40
    """[m] From the start to the platform's edge, moved back to a multiple of 0.02 m, and to the block's near side."""

    name: ClassVar = "platform"

    def __post_init__(self) -> None:
        super().__post_init__()
        low, high = 0.3, GROUND_LOWER[0]
        check(low <= self.edge < high, f"edge must be from {low} m to below {high} m, got {self.edge}")

    def scenes(self, goals: np.ndarray, rng: np.random.Generator) -> Iterator[tuple[str, dict[str, Any], np.ndarray]]:
        """Yield name, keywords of `Env`, and headings [rad], (num_envs,), of each scene; goals [m]: (num_envs, 2)."""
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
        """Return the argument `outlines` of `plot_landings`: platform, median block, and level ground of the bumps."""
        x, y = np.median(goals, axis=0)
        block = rectangle(self.edge, x + BLOCK_BEYOND, y - 0.5 * BLOCK_WIDTH, y + 0.5 * BLOCK_WIDTH)
        level = regular_polygons(np.zeros((1, 2)), FLAT_RADIUS)
        return {
            "platform": (f"platform, {DROP:g} m high", rectangle(-SIZE, self.edge, -SIZE, SIZE)),
            "uneven": (f"level circle, then bumps up to ±{AMPLITUDE:g} m", level),
            "block": (f"block of the median goal, {BLOCK_HEIGHT:g} m high", block),
        }

    def measure(self, run: EvaluationRun) -> dict[str, Any]:
        """Run the jumps of all scenes, plot them, return `<scene>_<metric>` and the means of metrics over scenes."""
        rng = np.random.default_rng(self.seed)
        goals, values = rng.uniform(GROUND_LOWER, GROUND_UPPER, (self.num_jumps, 2)), {}
        done: dict[str, LandingLog] = {}
        for name, scene, headings in self.scenes(goals, rng):
            env = run.env(self.num_jumps, **scene)
            done[name] = self.run_landings(run, goals[:, None], env, headings=headings, film=name, film_scene=scene)
            values |= {f"{name}_{metric}": value for metric, value in landing_metrics(done[name]).items()}
            if "block" in scene:
                slide = np.linalg.norm(block_positions(env.sim) - scene["block"].center, axis=1)
                values |= {"block_mean_slide_m": float(slide.mean()), "block_max_slide_m": float(slide.max())}
        plot_landings(
            run.folder / "landings.png", {name: landed_at(landings) for name, landings in done.items()},
            tolerance=SUCCESS_TOLERANCE, outlines=self.outlines(goals), title="Jumps to other grounds",
            conditions=f"{run.title}, {self.num_jumps} jumps each",
        )  # fmt: skip
        names = ("mean_error_m", "success_rate", "fall_rate", "miss_rate", "still_landing_rate")
        summary = {name: mean([values[f"{scene}_{name}"] for scene in done]) for name in names}
        tilts = [values[f"{scene}_max_landing_tilt_deg"] for scene in done]
        summary["success_rate_in_range"] = summary["success_rate"]
        summary["max_landing_tilt_deg"] = max((tilt for tilt in tilts if tilt is not None), default=None)
        return {"jumps": self.num_jumps * len(done), "edge_m": self.edge, **summary, **values}


@dataclass(frozen=True)
class Farthest(Suite):
    """Jumps to bins of goals 0.1 m wide, from 1 m on, until fewer than half of the jumps of a bin succeed.

    Goals of a bin lie in one direction, within 0.05 m of its middle. A far goal may be reached by steps or a second hop
    after the landing, so three distances are reported, each the largest middle of a bin up to which at least 95 % of
    the jumps succeed: at all; without a second hop, in which all paws are off the ground again for more than 0.05 s;
    without a step, in which any paw that had come down is off it again for 0.05 s. `base_at_touchdown` is the distance
    of the base from its start at touchdown, the mean of a bin's successes. Published distances were jumped by robots;
    the paper's 1.25 m compares with `hop_free_distance_m`.
    """

    num_jumps: int = 100
    min_distance: float = 1.0  # [m] Distance at the middle of the first bin
    max_distance: float = 2.5  # [m] Distance at the middle of the last bin
    direction: float = 0.0  # [deg] Direction of the goals from the robot: 0 ahead, 90 to the left, 180 back

    name: ClassVar = "max"
    paper: ClassVar = {"hop_free_distance_m": 1.25}

    def __post_init__(self) -> None:
        super().__post_init__()
        near, far, limits = self.min_distance, self.max_distance, f"0.1 <= min_distance <= max_distance <= {LIMIT:g} m"
        check(0.1 <= near <= far <= LIMIT, f"need {limits}, got {near} and {far}")
        check(-180.0 <= self.direction <= 180.0, f"direction must be in -180..180 deg, got {self.direction}")

    def goals(self, middle: float) -> np.ndarray:
        """Return the goals [m], (num_jumps, 1, 2), ahead and left, of the bin around the distance `middle` [m]."""
        distance = middle + BIN * (np.linspace(0.0, 1.0, self.num_jumps) - 0.5 if self.num_jumps > 1 else np.zeros(1))
        angle = math.radians(self.direction)
        return distance[:, None, None] * np.array([math.cos(angle), math.sin(angle)])

    def measure(self, run: EvaluationRun) -> dict[str, Any]:
        """Run bins of growing distance until success is below GIVEN_UP, plot them, and return the metrics."""
        env, bins = run.env(self.num_jumps), {}
        for number in range(round((self.max_distance - self.min_distance) / BIN) + 1):
            middle = round(self.min_distance + number * BIN, 6)
            bins[middle] = self.run_landings(run, self.goals(middle), env, film=f"jump_{middle:.1f}_m")
            success = bins[middle].success.mean()
            print(f"{middle:.1f} m: {success:.1%} success", flush=True)
            if success < GIVEN_UP:
                break
        values = distance_metrics(bins) | trained_range(env.task) | {"direction_deg": self.direction}
        logs = bins.values()
        successes = {
            "success": np.array([log.success[:, 0] for log in logs]),
            "success without a second hop": np.array([(log.success & ~log.hopped)[:, 0] for log in logs]),
            "success without a step": np.array([(log.success & ~log.stepped)[:, 0] for log in logs]),
        }
        errors = np.array([np.where(log.success, log.error, np.nan)[:, 0] for log in logs])
        conditions = f"{run.title}, {self.num_jumps} jumps each"
        plot_distances(run.folder / "max_jump.png", [*bins], successes, errors, reliable=RELIABLE, published=PUBLISHED,
                       conditions=conditions)  # fmt: skip
        return values


def landed_at(landings: LandingLog) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return goals [m], landing positions [m], (worlds, 2), and success (worlds,) of first jumps, to be plotted."""
    return landings.goal_positions[:, 0], landings.landing[:, 0], landings.success[:, 0]


def rectangle(x0: float, x1: float, y0: float, y1: float) -> np.ndarray:
    """Return the corners [m] of an axis-aligned rectangle, (1, 4, 2)."""
    return np.array([[(x0, y0), (x1, y0), (x1, y1), (x0, y1)]])


def distance_metrics(bins: dict[float, LandingLog]) -> dict[str, Any]:
    """Return means over all bins, reliable distances [m], and `bin_<metric>` lists with one entry per bin.

    bins: log by distance at the bin's middle [m], ascending.
    """
    by_bin = [landing_metrics(landings) for landings in bins.values()]
    lists: dict[str, list[Any]] = {name: [values[name] for values in by_bin] for name in BIN_METRICS}
    flown = [mean(np.linalg.norm(log.touchdown[log.success], axis=-1)) for log in bins.values()]
    landed = [landings.landing[landings.success][:, 0] for landings in bins.values()]
    inside = [landings.success[within(landings.goal_positions[..., 0], IN_RANGE)] for landings in bins.values()]
    values: dict[str, Any] = {
        "jumps": sum(int(landings.begun.sum()) for landings in bins.values()),
        "mean_error_m": mean(lists["mean_error_m"]),
        "success_rate_in_range": mean(np.concatenate(inside)),
        **{rate: mean(lists[rate]) for rate in (*RATES.values(), "fall_rate", "miss_rate", "still_landing_rate")},
        "max_landing_tilt_deg": max((tilt for tilt in lists["max_landing_tilt_deg"] if tilt is not None), default=None),
    }
    for suffix, rate in RATES.items():
        first_bad = next((i for i, success in enumerate(lists[rate]) if success < RELIABLE), len(bins))
        values[f"largest_reliable{suffix}_m"] = list(bins)[first_bad - 1] if first_bad else None
        values[f"base_at_touchdown{suffix}_m"] = flown[first_bad - 1] if first_bad else None
    values["hop_free_distance_m"] = values["largest_reliable_without_hop_m"]
    values["farthest_success_m"] = largest(np.concatenate(landed))
    values |= {"bin_m": list(bins), "bin_base_at_touchdown_m": flown}
    return values | {f"bin_{name}": column for name, column in lists.items()}


SUITES: tuple[type[Suite], ...] = (HeightSweep, DistanceSweep, Grid, Ring, Consecutive, Platform, Farthest)


def suites_for(evaluation: str) -> dict[str, type[Suite]]:
    """Return the suites, by name, that accept policies whose `evaluation_suite` is `evaluation`."""
    return {suite.name: suite for suite in SUITES if evaluation in suite.evaluations}
