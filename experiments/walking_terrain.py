"""Measure how far a policy walks on slopes, stairs and uneven ground, and write metrics, a plot and recordings.

    python experiments/walking_terrain.py --policy walking_rough --num-robots 500 --out outputs/terrain

Robots start in the middle of a tile with random headings and are commanded to walk straight ahead at 0.5 m/s for 10 s.
They do not observe the terrain. The metric of a terrain is the mean fraction of the commanded distance that they walk
before they fall. Slopes and stairs descend from the start, bowls and pits ascend. `--randomize` adds the randomisation,
noise and latency of the training. `--solver mujoco` evaluates on physics that the policy was not trained on.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from jumper_warp.evaluation.jumps import random_headings
from jumper_warp.evaluation.run import EvaluationArgs, EvaluationRun
from jumper_warp.evaluation.velocities import SETTLING_TIME, VelocityLog, check_velocity_settings
from jumper_warp.robot.terrain import KINDS, TerrainCfg, single_tile
from jumper_warp.tasks.velocity.cfg import VelocityEvaluation
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.metrics import mean, rate
from jumper_warp.viz.plots import figure
from support.scripts import run_script

SECONDS = 10.0  # [s] Time of each walk


@dataclass(frozen=True)
class Args(EvaluationArgs):
    """Flags of the test of walking on terrains."""

    policy: str = "walking_rough"
    num_robots: int = 500  # Robots on each terrain
    terrains: tuple[str, ...] = KINDS  # Terrains to walk on
    speed: float = 0.5  # [m/s] Commanded velocity straight ahead
    uneven: float = 0.05  # [m] Largest height or depth of random ground
    slope: float = 10.0  # [deg] Inclination of slopes
    step_height: float = 0.06  # [m] Height of steps
    num_recorded: int = 1  # Number of robots to record on each terrain for the Rerun viewer; 0: none

    def __post_init__(self) -> None:
        """Raise InputError for a speed [m/s] at which the walk would leave its tile."""
        super().__post_init__()
        check_velocity_settings(self.num_robots, SECONDS, self.speed)
        if not 0.0 < self.speed <= 0.6:
            raise InputError(f"speed must be in (0, 0.6] m/s, so that the walk ends on the tile, got {self.speed}")


def walked_fraction(walks: VelocityLog) -> np.ndarray:
    """Return the fraction, (robots,), of the commanded distance ahead that each robot walked until its fall, at most 1.

    Distance is along the robot's present heading; SETTLING_TIME at the start is not part of the commanded distance.
    """
    distance = np.nansum(walks.velocity_history()[..., 0], axis=0) * walks.step_dt
    return np.clip(distance / (walks.commands[:, 0, 0] * (walks.seconds - SETTLING_TIME)), 0.0, 1.0)


def main(args: Args) -> dict:
    """Run the walks on every terrain, plot the walked fractions, and return the metrics."""
    run = EvaluationRun.from_args("walking_terrain", args, VelocityEvaluation)
    commands = np.tile([args.speed, 0.0, 0.0], (args.num_robots, 1, 1))
    metrics = {}
    fractions = {}
    steps = (args.step_height, args.step_height)
    terrain = TerrainCfg(tile=14.0, uneven=args.uneven, slope=args.slope, step=steps, seed=args.stream_seed)
    for kind in args.terrains:
        ground = single_tile(terrain, kind)
        env = run.env(args.num_robots, ground=ground)
        log = VelocityLog(commands, env.task, SECONDS, headings=random_headings(args.num_robots, args.stream_seed))
        walks = run.run_episodes(env, log, film=kind, film_scene={"ground": ground})
        fractions[kind] = walked_fraction(walks)
        metrics[f"{kind}_walked_fraction_mean"] = mean(fractions[kind], f"robots on {kind}")
        metrics[f"{kind}_fall_rate"] = rate(walks.fallen, f"robots on {kind}")
    settings = {"title": f"Walks at {args.speed:g} m/s", "conditions": f"{run.title}, {args.num_robots} robots each"}
    with figure(run.folder / "terrain.png", figsize=(7, 4), **settings) as axis:
        axis.boxplot([fractions[kind] for kind in args.terrains], tick_labels=list(args.terrains), whis=(5, 95))
        axis.set(ylabel="share of the way [1]", ylim=(0.0, 1.05))
    run.settings["speed_m_s"] = args.speed
    return run.report(metrics, {}, [*metrics])


if __name__ == "__main__":
    run_script(main, Args)
