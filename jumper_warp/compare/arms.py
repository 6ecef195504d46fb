"""Arms of a comparison: groups of runs, one per seed, or policies, with their settings and logged metrics."""

from __future__ import annotations

import fnmatch
import math
import re
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from jumper_warp.policies.catalog import CONFIG, find_policy
from jumper_warp.rl.metrics_file import METRICS_FILE, logged_line
from jumper_warp.rl.run_folder import SOURCES, flat_settings
from jumper_warp.rl.run_names import FROZEN, SEED, seed_folders, split_seed, start_time, title
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.files import Json, read_file, read_json

OF_A_SEED = ("seed", "seeds", "run-name", "tags")  # Settings in which the runs of an arm may differ
TERMS = ("Episode_Reward/", "Episode_Sum/")  # Begins of the logged names of reward terms
TIME = "Perf/elapsed_s"
STEPS_TO = re.compile(r"steps_to_(\d+)_percent")  # Metric: policy steps until the share that selects checkpoints


@dataclass(frozen=True)
class Member:
    """One seed of an arm: the folder of a run or of a policy."""

    folder: Path
    until: float = math.inf  # Last iteration that counts
    horizon: float = math.inf  # [policy steps of all worlds] Largest result of `steps_to`

    @cached_property
    def config(self) -> Json:
        """Saved configuration of the training. Raises InputError: it is unreadable."""
        path = self.folder / CONFIG
        config = read_json(path, "settings of a run or policy")
        with suppress(TypeError, ValueError, LookupError, AttributeError):
            numbers = (config["train"]["seed"], config["train"]["ppo"]["num_steps"] * config["train"]["num_envs"])
            if flat_settings(config) and all(isinstance(number, int) for number in numbers):
                return config
        raise InputError(f"{path}: no settings of a training")

    @property
    def seed(self) -> int:
        """Seed of the training."""
        return int(self.config["train"]["seed"])

    @cached_property
    def settings(self) -> Json:
        """Settings by flag name, without those that differ between seeds."""
        return {name: value for name, value in flat_settings(self.config).items() if name not in OF_A_SEED}

    @cached_property
    def log(self) -> list[Json]:
        """Logged iterations; empty: a policy. Raises InputError: a line is malformed, other than an unfinished last."""
        path = self.folder / METRICS_FILE
        lines = read_file(path, "metrics").split(b"\n")[:-1] if path.exists() else []
        rows = [logged_line(line) for line in lines]
        if {} in rows:
            raise InputError(f"{path} line {rows.index({}) + 1}: malformed")
        return rows

    @property
    def steps(self) -> int:
        """Policy steps of all worlds in an iteration."""
        return self.config["train"]["ppo"]["num_steps"] * self.config["train"]["num_envs"]

    @property
    def last(self) -> dict[str, float]:
        """Last logged metrics by name up to `until`, without undefined ones."""
        values = next((line for line in reversed(self.log) if line["iteration"] <= self.until), {})
        return {name: float(value) for name, value in values.items() if value is not None}

    def curve(self, metric: str) -> np.ndarray:
        """Return policy steps of all worlds, training time [s] and value of a metric, (3, logged iterations).

        It is of the whole log: `until` limits `last` alone.
        """
        logged = [line for line in self.log if line.get(metric) is not None]
        rows = [(self.steps * line["iteration"], line.get(TIME), line[metric]) for line in logged]
        return np.array(rows, dtype=float).reshape(-1, 3).T

    def steps_to(self, metric: str, share: float) -> float:
        """Return the policy steps of all worlds until a metric is at least `share`, at most `horizon`."""
        steps, _, values = self.curve(metric)
        return float(min([self.horizon, *steps[values >= share]]))


@dataclass(frozen=True)
class Arm:
    """Trainings with the same settings and different seeds, or a policy."""

    name: str
    members: tuple[Member, ...]  # by seed

    @property
    def seeds(self) -> list[int]:
        """Seeds of the trainings."""
        return [member.seed for member in self.members]

    @property
    def settings(self) -> Json:
        """Settings by flag name."""
        return self.members[0].settings

    @property
    def best_metric(self) -> str:
        """Logged metric that selects the best checkpoint."""
        return self.members[0].config["train"].get("best_metric", "")

    @property
    def terms(self) -> dict[str, np.ndarray]:
        """Last logged value of each reward term, (seeds,), by name of the log."""
        return {name: self.last(name) for name in self.members[0].last if name.startswith(TERMS)}

    @property
    def sources(self) -> dict[str, str]:
        """Text of each of the user's files, as saved with the run, by name."""
        return {path.name: path.read_text("utf-8") for path in sorted((self.members[0].folder / SOURCES).glob("*.py"))}

    def last(self, metric: str) -> np.ndarray:
        """Return the last logged value of a metric of every seed, (seeds,), without seeds that lack it.

        `steps_to_95_percent`: policy steps of all worlds to 95 % of the metric that selects checkpoints; at
        most the `horizon`, also of a seed that does not reach it.
        """
        if share := STEPS_TO.fullmatch(metric):
            logged = (each for each in self.members if each.curve(self.best_metric).size)
            return np.array([each.steps_to(self.best_metric, 0.01 * int(share[1])) for each in logged])
        return np.array([member.last[metric] for member in self.members if metric in member.last])

    def curves(self, metric: str, axis: int, points: int = 100) -> tuple[np.ndarray, np.ndarray]:
        """Return points of a metric's learning curves up to the end of the shortest, and values (seeds, points).

        axis: 0 for policy steps, 1 for training time [s]. Empty: no log has the metric.
        """
        curves = [curve for member in self.members if (curve := member.curve(metric)).size]
        if not curves:
            return np.zeros(0), np.zeros((0, 0))
        x = np.linspace(max(curve[axis, 0] for curve in curves), min(curve[axis, -1] for curve in curves), points)
        return x, np.stack([np.interp(x, curve[axis], curve[2]) for curve in curves])


def find_arms(sources: Sequence[str | Path]) -> tuple[Arm, ...]:
    """Return the arms that sources name, in their order.

    A source is a run's folder, RUN:SEED, a folder of runs, a pattern of such folders' names or of the runs' names
    (`logs/vertical-jump/base*`), or a policy. Runs of one name are an arm, whose newest run of each seed counts;
    `NAME=SOURCE` gives all runs of a source one name.
    Raises InputError: there is no such run or policy, or runs of one arm have different settings.
    """
    arms: dict[str, dict[tuple[int, str], Member]] = {}
    for source in map(str, sources):
        label, equals, pattern = source.partition("=")
        if equals and not (label and pattern):
            raise InputError(f"{source}: expected NAME=SOURCE")
        found = sorted(_folders(pattern if equals else source), key=start_time)
        for folder in found:
            own = folder.parent if folder.name.startswith(SEED) else folder
            name = label if equals else title(own)
            member = Member(folder)
            arms.setdefault(name, {})[member.seed, "" if member.log else str(folder)] = member
    return tuple(_arm(name, [members[key] for key in sorted(members)]) for name, members in arms.items())


def of_equal_length(arms: Sequence[Arm]) -> tuple[Arm, ...]:
    """Return arms whose last logged metrics are those of the last iteration that all runs have, without frozen seeds.

    Their `horizon` is this iteration, in the policy steps of the run with the fewest per iteration.
    """
    logged = [each for arm in arms for each in arm.members if each.log and not (each.folder / FROZEN).exists()]
    until = min((member.last["iteration"] for member in logged), default=math.inf)
    horizon = until * min((member.steps for member in logged), default=1)
    return tuple(Arm(arm.name, tuple(replace(m, until=until, horizon=horizon) for m in arm.members)) for arm in arms)


def _arm(name: str, members: list[Member]) -> Arm:
    """Return an arm. Raises InputError: its members have different settings."""
    first, *others = members
    for other in others:
        if differing := differences([first.settings, other.settings]):
            setting = next(iter(differing))
            raise InputError(
                f"runs named {name} differ in {setting}: {first.folder} and {other.folder}; name arms with NAME=RUN"
            )
    return Arm(name, tuple(members))


def _folders(source: str) -> Iterator[Path]:
    """Yield the folders of runs of single seeds, or of a policy, that a source names. Raises InputError: none."""
    path, seed = split_seed(source)
    if not path.exists() and path.parent.is_dir() and len(path.parts) > 1:
        near = path.parent.glob("*/")
        runs = [run for run in near if any(fnmatch.fnmatch(name, path.name) for name in (run.name, title(run)))]
        if not runs:
            raise InputError(f"{source}: no such run")
    elif (path / CONFIG).exists() or seed_folders(path) or not path.is_dir():
        runs = [path if seed_folders(path) else find_policy(path)]
    else:
        runs = [run for run in path.glob("*/") if (run / CONFIG).exists() or seed_folders(run)]
    if not runs:
        raise InputError(f"{source}: no run in this folder")
    for run in runs:
        seeds = seed_folders(run)
        if seeds and seed is not None and seed not in seeds:
            raise InputError(f"{run}: no seed {seed}; seeds: {', '.join(map(str, seeds))}")
        yield from [run] if not seeds else seeds.values() if seed is None else [seeds[seed]]


def differences(settings: Sequence[Json]) -> dict[str, list[Any]]:
    """Return the values of the settings that are not the same in all, by name; None: a setting is absent."""
    names = dict.fromkeys(name for each in settings for name in each)
    values = {name: [each.get(name) for each in settings] for name in names}
    return {name: each for name, each in values.items() if any(value != each[0] for value in each)}
