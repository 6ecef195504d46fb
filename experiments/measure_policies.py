"""Measure the shipped policies in all conditions and tests, and write their metrics.json.

    python experiments/measure_policies.py --out outputs/policies
    python experiments/measure_policies.py --out outputs/policies --save-to-policies

The first command evaluates policies as `jumper evaluate` does, once per condition and seed (a row), and runs the
further tests (`policy_pages.toml`) with the first seed. It writes `OUT/POLICY/CONDITION-SEED/metrics.json` after each
row, and skips existing rows. Work can be interrupted, split by --policies and --conditions, and shared by processes.
The second command saves these rows in the policies' folders, from which `docs/policy_tables.py` makes tables.
"""

from __future__ import annotations

import contextlib
import gc
import io
import shlex
import subprocess
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro

from jumper_warp.evaluation.attitude import AttitudeFlags
from jumper_warp.evaluation.conditions import Conditions
from jumper_warp.evaluation.jump_metrics import JumpFlags
from jumper_warp.evaluation.run import EvaluateCfg, EvaluationRun, evaluate
from jumper_warp.evaluation.velocities import STANDING, VelocityFlags
from jumper_warp.robot.overlay import RobotOverlay
from jumper_warp.utils.assets import policy_tasks
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.files import Json
from jumper_warp.utils.output import read_values
from jumper_warp.utils.progress import phase
from support.policy_results import (
    COMBINED,
    CONDITIONS,
    METRICS,
    TESTS,
    read_rows,
    save_to_policies,
    tasks_of,
    undefined,
)
from support.scripts import ThreadArgs, announce, run_script


def with_trials(flags: Any, trials: int) -> Any:
    """Return a copy of the flags of `jumper evaluate` with at least this number of trials.

    A test of velocities has n^3 combinations of commands, each at once and slewed, and STANDING robots that stand.
    """
    if isinstance(flags, JumpFlags):
        return replace(flags, num_jumps=trials)
    if isinstance(flags, AttitudeFlags):
        return replace(flags, num_turns=max(trials, 6))
    assert isinstance(flags, VelocityFlags)
    per_axis = next(n for n in range(2, trials + 2) if 2 * n**3 + STANDING >= trials)
    return replace(flags, commands_per_axis=per_axis)


def commands_of(flags: Any) -> str:
    """Return the ranges of an evaluation's goals or velocity commands as text; flags: of `jumper evaluate`."""
    if isinstance(flags, AttitudeFlags):
        return f"turns by {flags.angle:g}°"
    if isinstance(flags, VelocityFlags):
        return "up to ±{:g} m/s, ±{:g} m/s, ±{:g} rad/s".format(*flags.max_velocity)
    if hasattr(flags, "height_range"):
        return "{:g} to {:g} m".format(*flags.height_range)
    sides = "" if flags.goal_y == (0.0, 0.0) else ", to the left {:g} to {:g} m".format(*flags.goal_y)
    return "{:g} to {:g} m".format(*flags.goal_x) + sides


def payload_overlay(overlay: RobotOverlay | None, mass: float) -> RobotOverlay:
    """Return a robot overlay with a point mass [kg] added at the origin of the base's frame.

    overlay: robot without payload, None: the described one. The inertia about the centre of mass stays: the part that
    the payload adds there is below 1 %. Since it scales with `base_mass`, the factor `base_inertia` falls.
    """
    overlay = overlay or RobotOverlay({})
    robot = overlay.robots()
    ratio = float(robot.base_mass[0, 0]) / (float(robot.base_mass[0, 0]) + mass)
    values = {
        "base_mass": (float(robot.base_mass[0, 0]) + mass,),
        "base_com": tuple(float(x) for x in ratio * np.asarray(robot.base_com[0])),
        "base_inertia": (ratio * float(robot.base_inertia[0, 0]),),
    }
    return RobotOverlay({**overlay.values, **values}, overlay.randomization, f"payload of {mass:g} kg")


def run_test(policy: str, name: str, out: Path, flags: list[str]) -> None:
    """Run the command of a test for a policy, which writes `out`/metrics.json; flags: added to the command.

    Raises subprocess.CalledProcessError: the command failed; its errors are on standard error.
    """
    program, *args = shlex.split(TESTS[name]["command"].format(policy=policy))
    start = ["-P", "-m", "jumper_warp"] if program == "jumper" else [program]
    command = [sys.executable, *start, *args, *flags, "--out", str(out)]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)


SHOWN = ("success_rate", "settled_without_collision_rate", "fall_rate")  # Metrics in the lines of progress


@dataclass(frozen=True)
class Args(ThreadArgs):
    """Flags of the measurement of the shipped policies."""

    out: Path = Path("outputs/policies")  # Folder of all rows
    policies: tuple[str, ...] = (*policy_tasks(), COMBINED)
    """Names of the policies; combined: the three policies that walk and jump in turns."""
    conditions: tuple[str, ...] = (*CONDITIONS, *(name for name, test in TESTS.items() if "command" in test))
    """Names of the conditions and further tests."""
    seeds: tuple[int, ...] = (0, 1)  # Seeds of sampled commands, robots and noise
    trials: int = 4096  # Least number of trials in a row
    save_to_policies: tyro.conf.FlagCreatePairsOff[bool] = False
    """Write the rows in `out` into metrics.json of the policies' folders; nothing is measured."""

    def row(self, policy: str, condition: str, seed: int) -> Path:
        """Return the folder with the results of a policy in one condition with one seed (a row)."""
        return self.out / policy / f"{condition}-{seed}"


def missing_rows(args: Args) -> list[tuple[str, str, int]]:
    """Return the evaluations that are still to be done: policy, condition and seed.

    These have no metrics.json, and the condition is defined for the policy.
    """
    tasks = tasks_of(args.policies)
    defined = [
        (policy, condition, seed)
        for policy in args.policies
        for condition in args.conditions
        for seed in (args.seeds[:1] if condition in TESTS else args.seeds)
        if (
            policy in TESTS[condition]["policies"]
            if condition in TESTS
            else policy in tasks and undefined(tasks[policy], condition) is None
        )
    ]
    return [row for row in defined if not (args.row(*row) / METRICS).is_file()]


def measure_row(args: Args, policy: str, condition: str, seed: int) -> Json:
    """Evaluate a policy in one condition, write its metrics.json, and return conditions and metrics by name."""
    if condition in TESTS:
        flags = ["--seed", str(seed), *(["--device", args.device] if args.device else [])]
        run_test(policy, condition, args.row(policy, condition, seed), flags)
        return read_values(args.row(policy, condition, seed))
    run = EvaluationRun(policy)
    folder = args.row(policy, condition, seed)
    values = dict(CONDITIONS[condition][1])
    if payload := values.pop("payload", None):
        run.settings["payload_kg"] = payload
        values["robot"] = folder / "payload.json"
        folder.mkdir(parents=True, exist_ok=True)
        payload_overlay(run.recipe.robot, payload).save(values["robot"])
    conditions = Conditions(**values, seed=seed, device=args.device, threads=args.threads)
    flags = with_trials(run.evaluation.default_flags("evaluate"), args.trials)
    run.settings["commands"] = commands_of(flags)
    with contextlib.redirect_stdout(io.StringIO()):
        return evaluate(run, EvaluateCfg(flags, conditions, folder))


def main(args: Args) -> int:
    """Evaluate policies in missing conditions, or save existing results to the policies; return the number of rows."""
    if not args.save_to_policies:
        return measure(args)
    rows = read_rows(args.out, args.policies)
    if not rows:
        raise InputError(f"{args.out} has no rows of these policies")
    save_to_policies(rows, tasks_of(args.policies))
    return len(rows)


def measure(args: Args) -> int:
    """Evaluate policies in all missing conditions, print the results, and return the number of evaluations."""
    rows = missing_rows(args)
    with phase("evaluations", len(rows)) as advance:
        for row in rows:
            values = measure_row(args, *row)
            gc.collect()  # frees the device memory of the environment
            if torch.cuda.is_available():
                torch.cuda.empty_cache()
            shown = ", ".join(f"{key} {values[key]:.4g}" for key in SHOWN if key in values)
            announce(f"{' '.join(map(str, row))}: {shown}")
            advance()
    announce(f"{len(rows)} rows measured, in {args.out}; --save-to-policies saves them")
    return len(rows)


if __name__ == "__main__":
    run_script(main, Args)
