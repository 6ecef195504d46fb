"""The paper's tests of the ground: off a platform of 0.15 m, onto uneven ground, and onto a block that moves.

    python experiments/platform_jump.py --policy horizontal_jump --out outputs/platform

The policy knows nothing of the ground but the base's height above the spot below it. Uneven ground has
bumps of up to 0.05 m around a level start, and every robot jumps in a direction of its own. The block, 10 kg and 0.05 m
high, reaches from before the goal to beyond it and slides when the robot lands on it; the goal stays. Errors and
success are those of `horizontal_jump_sweep.py`; the range of `success_rate_in_range` is all goals. The platform ends,
and the block begins, 0.40 m from the start, 0.13 m beyond the paws of a robot that stands there; at the nearest goal,
0.8 m, its paws stand as far beyond that edge. `--edge` moves it. SolverMuJoCo has no sliding block: with it that scene
is left out.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import tyro

from jumper_warp.cli.main import run_command
from jumper_warp.evaluation.landings import Landings
from jumper_warp.evaluation.log import mean, termination_names
from jumper_warp.evaluation.places import landing_metrics
from jumper_warp.evaluation.plots import draw_landings, drawn
from jumper_warp.evaluation.run import EvaluationArgs, EvaluationRun
from jumper_warp.robot.grounds import BlockCfg, platform, uneven
from jumper_warp.utils.errors import InputError

DROP = 0.15
"""[m] Height of the platform."""
EDGE = 0.40
"""[m] From the start to the platform's edge, and to the block's near side."""
AMPLITUDE = 0.05
"""[m] Of the uneven ground."""
FLAT_RADIUS = 0.35
"""[m] Level ground around the start."""
BLOCK_HEIGHT, BLOCK_MASS, BLOCK_FRICTION = 0.05, 10.0, 0.4
"""[m], [kg], [1] with the floor."""
BLOCK_BEYOND, BLOCK_WIDTH = 0.40, 0.8
"""[m] From the goal to the block's far side; along y."""
AHEAD, ASIDE = (0.8, 1.4), (-0.15, 0.15)
"""[m] Goals: off the platform, or on the block, with all paws; as far as the paper's simulation always succeeds."""
SCENES = ("platform", "uneven", "block")
MEANS = ("mean_error_m", "success_rate", "fall_rate", "miss_rate", "still_landing_rate")
"""Figures of which the mean of all scenes is told."""


@dataclass(frozen=True)
class Args(EvaluationArgs):
    """Flags."""

    jumps: int = 100
    """Number of jumps in each scene."""
    scenes: tuple[str, ...] = SCENES
    """Which of platform, uneven, block."""
    edge: float = EDGE
    """[m] From the start to the platform's edge, moved back to a multiple of 0.02 m, and to the block's near side."""

    def __post_init__(self) -> None:
        """Check the values."""
        super().__post_init__()
        if self.jumps < 1:
            raise InputError(f"need at least one jump, got {self.jumps}")
        if not 0.3 <= self.edge < AHEAD[0]:
            raise InputError(f"edge must be from 0.3 m to below {AHEAD[0]} m, got {self.edge}")
        if not self.scenes or set(self.scenes) - set(SCENES):
            raise InputError(f"scenes are {', '.join(SCENES)}, got {self.scenes}")
        if self.solver == "mujoco" and set(self.scenes) == {"block"}:
            raise InputError("the scene block needs --solver jumper: SolverMuJoCo has no sliding block")


def scene(name: str, goals: np.ndarray, edge: float, rng: np.random.Generator) -> tuple[dict[str, Any], np.ndarray]:
    """Return what is special about a scene's environment, and the headings; goals [m], (num_envs, 2); edge [m]."""
    straight = np.zeros(len(goals))
    if name == "platform":
        return {"ground": platform(-DROP, edge=edge)}, straight
    if name == "uneven":
        ground = uneven(AMPLITUDE, int(rng.integers(2**31)), flat_radius=FLAT_RADIUS)
        return {"ground": ground}, rng.uniform(-math.pi, math.pi, len(goals))
    far = goals[:, 0] + BLOCK_BEYOND
    center = np.stack([0.5 * (edge + far), goals[:, 1]], axis=1)
    half = np.stack([0.5 * (far - edge), np.full(len(goals), 0.5 * BLOCK_WIDTH)], axis=1)
    return {"block": BlockCfg(center, half, BLOCK_HEIGHT, BLOCK_MASS, BLOCK_FRICTION)}, straight


def main(args: Args) -> dict:
    """Run the scenes and return the figures, each scene's under its name, and the mean of all."""
    run = EvaluationRun.of("platform_jump", args)
    rng = np.random.default_rng(args.seed)
    goals = rng.uniform((AHEAD[0], ASIDE[0]), (AHEAD[1], ASIDE[1]), (args.jumps, 2))
    done: dict[str, Landings] = {}
    values: dict[str, Any] = {}
    for name in args.scenes:
        if name == "block" and args.solver == "mujoco":
            print("scene block left out: SolverMuJoCo has no sliding block")
            continue
        special, headings = scene(name, goals, args.edge, rng)
        env = run.env(args.jumps, **special)
        asked = Landings(goals[:, None], termination_names(env.task), headings)
        done[name] = run.follow(env, asked, film=name, drawn=special)
        values |= {f"{name}_{figure}": value for figure, value in landing_metrics(done[name]).items()}
        if name == "block":
            moved = np.linalg.norm(env.sim.solver.block_position() - special["block"].center, axis=1)
            values |= {"block_mean_slide_m": float(moved.mean()), "block_max_slide_m": float(moved.max())}
    with drawn(run.folder / "landings.png", 1, len(done), figsize=(5.0 * len(done), 4.0), squeeze=False) as axes:
        for axis, (name, landings) in zip(axes[0], done.items(), strict=True):
            draw_landings(axis, landings, f"{name}, {run.title}")
    summary = {name: mean([values[f"{scene}_{name}"] for scene in done]) for name in MEANS}
    summary["success_rate_in_range"] = summary["success_rate"]
    tilts = [values[f"{scene}_max_landing_tilt_deg"] for scene in done]
    summary["max_landing_tilt_deg"] = max((tilt for tilt in tilts if tilt is not None), default=None)
    return run.report({"jumps": args.jumps * len(done), "edge_m": args.edge, **summary, **values}, {})


if __name__ == "__main__":
    run_command(lambda: main(tyro.cli(Args)))
