"""Renamed flags: for one release the old names still work, and a message gives the new ones (CHANGELOG.md)."""

from __future__ import annotations

import argparse
import itertools
import re
import sys
from collections.abc import Sequence
from typing import Any

from jumper_warp.cli.flags import list_flags
from jumper_warp.utils.errors import InputError

RENAMED = {
    "aside": "max-lateral-offset", "best-by": "best-metric", "candidates": "num-candidates",
    "distances": "distance-range", "each": "command-interval", "envs": "num-envs", "episode": "episode-steps",
    "episodes": "num-episodes", "every": "eval-interval", "exact": "no-noise", "filter": "command-filter",
    "first": "min-distance", "flights": "num-flights", "gains": "gain-scale gain-preset", "goals": "num-goals",
    "heights": "height-range", "hold": "hold-time hold-steps", "in-range": "success-range",
    "iterations": "max-iterations", "jump": "jump-task", "jumps": "num-jumps",
    "keep": "max-checkpoints save-to-policy", "kept-seeds": "baseline-seeds", "landing": "landing-policy",
    "last": "max-distance", "late": "num-delayed max-leg-delay", "late-std": "delayed-std", "length": "rest-length",
    "mass-deviation": "mass-std", "others": "num-mismatched", "per-axis": "commands-per-axis",
    "polish": "final-iterations", "ppo.asymmetric": "ppo.asymmetric-critic",
    "ppo.final-entropy": "ppo.final-entropy-coef", "ppo.final-kl": "ppo.final-desired-kl",
    "randomized": "num-randomized", "reach": "max-velocity", "record": "num-recorded", "rest": "rest-time",
    "robots": "num-robots", "row": "jumps-per-trial", "seeds": "num-matched", "sets": "num-sets",
    "squat": "squat-angle", "squats": "num-squats squat-angles", "start-from": "init-policy", "step": "step-height",
    "steps": "num-steps", "then": "next-goals", "torque": "torque-limit record-torque", "train": "train-flags",
    "trials": "num-trials", "turns": "num-turns", "without": "exclude", "worlds": "num-gradient-envs num-envs",
    "x": "goal-x", "y": "goal-y",
}  # fmt: skip
"""Old name to new name, or names for different commands with a space between; the first that a command has counts."""
RENAMED_ENV_PARTS = {
    "again-delay": "next-jump-delay", "axis-share": "body-axis-probability", "block-margin": "obstacle-margin",
    "critic": "observations.critic", "default": "start-probability.default",
    "default-share": "default-pose-probability",
    "fine": "std-fine", "fine-share": "fine-weight", "flat": "flat-orientation-l2", "force": "push-force",
    "free": "threshold", "height": "target-height", "in-flight": "start-probability.in-flight",
    "jerk": "torque-sign-changes", "jump-again": "next-jump-probability", "lasts": "resampling-time-range",
    "lateral": "std-lateral", "lateral-stability": "ang-vel-xy-l2", "least": "threshold",
    "lift": "eval-height-offset max-swing-height", "lifted-share": "swing-probability",
    "link-margin": "self-collision-margin", "long-wait-share": "long-wait-probability", "middle": "std-middle",
    "narrow": "first-range", "narrow-share": "first-range-probability", "no-latency": "zero-latency-probability",
    "policy": "observations.actor", "posture": "std-posture", "push-share": "push-probability",
    "pushing": "start-probability.pushing", "redraw": "resample-at", "rest": "base-at-rest",
    "retract": "post-landing-posture", "round": "elliptical", "share": "waiting-scale", "shares-of": "balance-by",
    "sharp": "scale-sharp", "speed": "std-lin-vel", "spin": "std-ang-vel",
    "stand": "standing-posture standing-probability", "standing": "start-probability.standing",
    "torque": "push-torque", "touchdown": "start-probability.touchdown", "turn": "turn-in-place-probability",
    "variance": "std-variance", "vertical-velocity": "lin-vel-z-l2", "wide": "std-wide last-range",
    "width": "std speed-scale angle",
}  # fmt: skip
"""Old to new parts, between dots, of a task's flags `--env.…`; the first combination that is a flag counts."""


def name_of(arg: str) -> str:
    """Return the name of a flag, as `ppo.init-std` of `--ppo.no-init_std=1`; "" if the argument is no flag."""
    match = re.match(r"--([^=]+)", arg)
    return re.sub(r"(^|\.)no-", r"\1", match[1].replace("_", "-")) if match else ""


def new_name(old: str, current: set[str]) -> str | None:
    """Return the new name of a flag, None if it has none; current: names of all flags of the command."""
    if not old.startswith("env."):
        return next((name for name in RENAMED.get(old, "").split() if name in current), None)
    options = [[part, *RENAMED_ENV_PARTS.get(part, "").split()] for part in old.split(".")]
    return next((name for parts in itertools.product(*options) if (name := ".".join(parts)) in current), None)


def use_new_names(args: Sequence[str], cfg: Any) -> list[str]:
    """Return a copy of the arguments with renamed flags under their new names; prints each renaming on standard error.

    cfg: dataclass of the arguments' settings, or an instance; a flag of it is never renamed.
    Raises InputError: a flag is given under both names.
    """
    arg_names, new_args = [name_of(arg) for arg in args], list(args)
    if not any(name in RENAMED or name.startswith("env.") for name in arg_names):
        return new_args
    current, renamed = {flag.name for flag in list_flags(cfg, described=False)}, {}
    for i, old in enumerate(arg_names):
        new = None if old in current else new_name(old, current)
        if new is None:
            continue
        if name_of(f"--{new}") in arg_names:
            raise InputError(f"--{old} is now --{new}: give only --{new}")
        flag, equals, value = args[i].partition("=")
        negated = re.search(r"(--|\.)no-", flag.replace("_", "-")) is not None
        new_flag = re.sub(r"([^.]+)$", r"no-\1", new) if negated else new
        new_args[i] = f"--{new_flag}{equals}{value}"
        renamed[old] = new
    for old, new in renamed.items():
        print(f"jumper: --{old} is now --{new}", file=sys.stderr)
    return new_args


def join_height_range(args: Sequence[str], default: tuple[float, float]) -> list[str]:
    """Return the arguments with --height-range LOWER UPPER in place of --lower and --upper.

    default: (lower, upper) [m], for a missing one. Raises InputError: --height-range is given too.
    """
    if not any(re.match("--(lower|upper)(=|$)", arg) for arg in args):
        return list(args)
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument("--lower", default=str(default[0]))
    parser.add_argument("--upper", default=str(default[1]))
    ends, new_args = parser.parse_known_args(args)
    if "--height-range" in (arg.replace("_", "-") for arg in new_args):
        raise InputError("--lower and --upper are now --height-range: give only --height-range")
    print("jumper: --lower and --upper are now --height-range LOWER UPPER", file=sys.stderr)
    return [*new_args, "--height-range", ends.lower, ends.upper]
