"""Measure how far a policy walks on slopes, stairs, uneven ground and under kicks, and write metrics and recordings.

    python experiments/walking_terrain.py --policy walking --num-robots 500 --out outputs/terrain
    python experiments/walking_terrain.py --policy walking --terrains flat --kick 0.5 --randomize

Robots start in the middle of a tile with random headings and are commanded to walk straight ahead at 0.5 m/s for 10 s.
They do not observe the terrain. The metric of a terrain is the mean fraction of the commanded distance that they walk
before they fall. Slopes and stairs descend from the start, bowls and pits ascend. `--kick` changes the velocity of each
base in a random direction every 3 s. `--randomize` adds the randomisation, noise and latency of the training.
`--solver mujoco` evaluates on physics that the policy was not trained on.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from jumper_warp.envs.env import Env
from jumper_warp.evaluation.jumps import random_headings
from jumper_warp.evaluation.run import EvaluationArgs, EvaluationRun
from jumper_warp.evaluation.velocities import SETTLING_TIME, VelocityLog, check_velocity_settings
from jumper_warp.robot.terrain import KINDS, TerrainCfg, single_tile
from jumper_warp.tasks.velocity.cfg import VelocityEvaluation
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.metrics import mean, rate
from support.scripts import run_script

SECONDS = 10.0  # [s] Time of each walk
KICK_INTERVAL = 3.0  # [s] Time from one kick to the next


@dataclass
class KickedWalks(VelocityLog):
    """Log of walks whose bases are kicked every KICK_INTERVAL: their velocities change abruptly by `kick`."""

    kick: float = 0.0  # [m/s] Size of the change, in a random horizontal direction
    seed: int = 0  # Seed of the directions

    def begin(self, env: Env) -> None:
        """Reset every robot, as `VelocityLog.begin`."""
        self.rng = np.random.default_rng(self.seed)
        super().begin(env)

    def read_env(self, env: Env) -> dict[str, np.ndarray]:
        """Return the arrays of `VelocityLog.read_env`, and add due kicks to the bases' velocities."""
        arrays = super().read_env(env)
        if self.kick and (len(self.velocity) + 1) % round(KICK_INTERVAL / env.step_dt) == 0:
            angle = self.rng.uniform(0.0, 2.0 * np.pi, env.num_envs)
            rates = env.sim.joint_qd().copy()
            rates[:, :2] += self.kick * np.stack([np.cos(angle), np.sin(angle)], axis=1)
            env.sim.state.joint_qd.assign(rates.ravel())
        return arrays


@dataclass(frozen=True)
class Args(EvaluationArgs):
    """Flags of the test of walking on terrains."""

    policy: str = "walking"
    num_robots: int = 500  # Robots on each terrain
    terrains: tuple[str, ...] = KINDS  # Terrains to walk on
    speed: float = 0.5  # [m/s] Commanded velocity straight ahead
    uneven: float = 0.05  # [m] Largest height or depth of random ground
    slope: float = 10.0  # [deg] Inclination of slopes
    step_height: float = 0.06  # [m] Height of steps
    kick: float = 0.0  # [m/s] Change of the base's velocity every 3 s
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
    """Run the walks on every terrain and return the metrics."""
    run = EvaluationRun.from_args("walking_terrain", args, VelocityEvaluation)
    commands = np.tile([args.speed, 0.0, 0.0], (args.num_robots, 1, 1))
    metrics = {}
    steps = (args.step_height, args.step_height)
    terrain = TerrainCfg(tile=14.0, uneven=args.uneven, slope=args.slope, step=steps, seed=args.stream_seed)
    for kind in args.terrains:
        ground = single_tile(terrain, kind)
        env = run.env(args.num_robots, ground=ground)
        headings = random_headings(args.num_robots, args.stream_seed)
        log = KickedWalks(commands, env.task, SECONDS, headings=headings, kick=args.kick, seed=args.stream_seed)
        walks = run.run_episodes(env, log, film=kind, film_scene={"ground": ground})
        metrics[f"{kind}_walked_fraction_mean"] = mean(walked_fraction(walks), f"robots on {kind}")
        metrics[f"{kind}_fall_rate"] = rate(walks.fallen, f"robots on {kind}")
    run.settings |= {"speed_m_s": args.speed} | ({"kick_m_s": args.kick} if args.kick else {})
    return run.report(metrics, {}, [*metrics])


if __name__ == "__main__":
    run_script(main, Args)
