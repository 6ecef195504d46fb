"""How much each idea of the vertical jump's training helps: success over training time without it.

    python experiments/ablations.py --seconds 120 --envs 8192 --out outputs/ablations

Every variant trains from nothing for the same time. Every few seconds, off the clock, its policy makes the same nominal
jumps to heights of 0.5 to 1.1 m from standing; a jump counts if it meets its height within 0.1 m and is landed.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import torch
import tyro

from jumper_warp.cli.main import run_command
from jumper_warp.envs.env import Env
from jumper_warp.registry import make_task
from jumper_warp.rl.cfg import PpoCfg
from jumper_warp.rl.ppo import Ppo
from jumper_warp.tasks.cfg import TaskCfg
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.output import output_dir, write_metrics
from jumper_warp.utils.runtime import announce
from support.ablations import ABLATIONS
from support.learning import Curve, curve_metrics, draw_curves, learning_curve, make_judge

FULL = "full"
"""Name of the training that lacks nothing."""


@dataclass(frozen=True)
class Args:
    """Flags."""

    seconds: float = 60.0
    """[s] Training time of each variant, its evaluations not counted."""
    every: float = 5.0
    """[s] Training time between two evaluations."""
    variants: list[str] = field(default_factory=lambda: [FULL, *ABLATIONS])
    """Which variants to train."""
    envs: int = 8192
    """Number of environments."""
    jumps: int = 200
    """Jumps of an evaluation."""
    randomize: bool = True
    """Train with randomisation and noise."""
    seed: int = 1
    """Of weights, noise and worlds."""
    ppo: PpoCfg = field(default_factory=PpoCfg)
    """Settings of the algorithm."""
    out: Path | None = None
    """Folder for metrics.json and the plot (default: outputs/ablations/<time>)."""
    device: str | None = None
    """Warp device."""
    threads: int | None = None
    """CPU threads that share the worlds (default: all cores); they change no result."""

    def __post_init__(self) -> None:
        """Check the values."""
        unknown = set(self.variants) - {FULL, *ABLATIONS}
        if unknown or not self.variants:
            raise InputError(f"variants are {', '.join((FULL, *ABLATIONS))}, got {self.variants}")


def train(task: TaskCfg, judge: Env, args: Args) -> Curve:
    """Train from nothing for the given time and return the curve."""
    torch.manual_seed(args.seed)
    env = Env(task, args.envs, seed=args.seed, device=args.device, randomize=args.randomize, noise=args.randomize)
    return learning_curve(env, Ppo(env, args.ppo), judge, args.seconds, args.every)


def main(args: Args) -> dict:
    """Train all variants and return the metrics."""
    announce(args.device, args.threads)
    folder = output_dir("ablations", args.out)
    task = make_task("vertical-jump")
    judge = make_judge(task, args.jumps, args.device)
    curves: dict[str, list[Curve]] = {}
    values: dict = {"seconds": args.seconds, "envs": args.envs, "randomize": args.randomize, "seed": args.seed}
    for name in args.variants:
        curve = train(ABLATIONS.get(name, lambda same: same)(task), judge, args)
        curves[name] = [curve]
        values |= curve_metrics(curve, name) | {f"iterations_{name}": curve.iterations}
        write_metrics(folder, values)
        draw_curves(curves, folder / "ablations.png")
    print(f"metrics and plot in {folder}")
    return values


if __name__ == "__main__":
    run_command(lambda: main(tyro.cli(Args)))
