"""How far a walking policy comes on uneven ground, slopes and steps that it does not see.

    python experiments/walking_terrain.py --policy walking_rough --num-robots 500 --out outputs/terrain

Robots start in the middle of a tile with headings of their own and are commanded to go straight ahead at 0.5 m/s for
10 s. The success rate of a terrain is the share of the way that they walk before they fall, on average. Slopes and
stairs go down from the start, bowls and pits up. `--randomize` adds the randomisation, noise and latency of the
training; `--solver mujoco` is a check against physics that the policy was not trained on.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from jumper_warp.cli.main import run_command
from jumper_warp.evaluation.places import random_headings
from jumper_warp.evaluation.plots import drawn
from jumper_warp.evaluation.run import EvaluationArgs, EvaluationRun
from jumper_warp.evaluation.velocities import Walks, check_walks
from jumper_warp.robot.terrain import KINDS, TerrainCfg, single_tile
from jumper_warp.utils.errors import InputError
from support.scripts import parse_flags
from support.walks import walked

SECONDS = 10.0
"""[s] Of each walk."""


@dataclass(frozen=True)
class Args(EvaluationArgs):
    """Flags."""

    policy: str = "walking_rough"
    num_robots: int = 500
    """Robots on each terrain."""
    terrains: tuple[str, ...] = KINDS
    """Terrains to walk on."""
    speed: float = 0.5
    """[m/s] Commanded, straight ahead."""
    uneven: float = 0.05
    """[m] Largest height or depth of random ground."""
    slope: float = 10.0
    """[deg] Inclination of slopes."""
    step_height: float = 0.06
    """[m] Height of steps."""
    num_recorded: int = 1
    """Number of robots to record on each terrain for the Rerun viewer; 0: none."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_walks(self.num_robots, SECONDS, self.speed)
        if not 0.0 < self.speed <= 0.6:
            raise InputError(f"speed must be in (0, 0.6] m/s, so that the walk ends on the tile, got {self.speed}")


def main(args: Args) -> dict:
    """Walk on every terrain and return the figures."""
    run = EvaluationRun.of("walking_terrain", args, ("velocity",))
    commands, figures, shares = np.tile([args.speed, 0.0, 0.0], (args.num_robots, 1, 1)), {}, {}
    terrain = TerrainCfg(tile=14.0, uneven=args.uneven, slope=args.slope, step=(args.step_height, args.step_height))
    for kind in args.terrains:
        ground = single_tile(terrain, kind)
        env = run.env(args.num_robots, ground=ground)
        asked = Walks(commands, env.task, SECONDS, headings=random_headings(args.num_robots, args.seed))
        walks = run.follow(env, asked, film=kind, drawn={"ground": ground})
        shares[kind] = walked(walks)
        figures[f"success_rate_{kind}"] = float(shares[kind].mean())
        figures[f"fall_rate_{kind}"] = float(walks.fallen.mean())
    with drawn(run.folder / "terrain.png", figsize=(7, 4)) as axis:
        axis.boxplot([shares[kind] for kind in args.terrains], tick_labels=list(args.terrains), whis=(5, 95))
        axis.set(ylabel="share of the way", title=f"{args.num_robots} robots each, {run.title}", ylim=(0.0, 1.05))
    return run.report({"robots": args.num_robots, "speed_m_s": args.speed} | figures, {})


if __name__ == "__main__":
    run_command(lambda: main(parse_flags(Args)))
