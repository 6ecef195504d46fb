"""Identify simulated robots that differ from a description, and count the true values inside their 95 % intervals.

    python experiments/identification_robots.py --robot heavy --num-robots 3

Each parameter differs by a random number of standard deviations of its prior: `FAR` times a normal one, at most `MOST`.
"""

from __future__ import annotations

import json
from dataclasses import dataclass

import numpy as np

from jumper_warp.identification.excitation import Scorer, choose
from jumper_warp.identification.identify import identify
from jumper_warp.identification.motions import NoiseLevels
from jumper_warp.identification.parameters import jumper_parameters, total_mass, weighed_mass
from jumper_warp.identification.recording import measure, replay_plan
from jumper_warp.identification.replay import MotionReplay
from jumper_warp.identification.results import CONFIDENCE
from jumper_warp.robot.overlay import load_overlay
from jumper_warp.utils.runtime import configure_device
from support.scripts import run_script

FAR, MOST = 0.7, 1.5
LATENCY = 0.9  # [1] of each robot, in standard deviations of its prior (5 ms)
SCALE_STD = 0.02  # [kg] Standard deviation of the weighed mass


@dataclass(frozen=True)
class Args:
    """Flags of the test of identification."""

    robot: str  # Folder or name of the described robot
    num_robots: int = 3  # Number of robots that differ from it
    first: int = 0  # Seed of the first of them
    threads: int = 2  # CPU threads


def main(args: Args) -> None:
    """Identify the robots and print one line of JSON for each."""
    configure_device("cpu", args.threads)
    robot = load_overlay(args.robot).description
    parameters = jumper_parameters(description=robot)
    replay = MotionReplay(description=robot, device="cpu", threads=args.threads)
    plans = choose(Scorer(parameters, NoiseLevels(), replay)).plans
    for seed in range(args.first, args.first + args.num_robots):
        rng = np.random.default_rng(seed)
        truth = np.clip(FAR * rng.normal(size=len(parameters)), -MOST, MOST)
        truth[parameters.names.index("latency")] = LATENCY
        true = parameters.robots(truth, robot)
        motions = [measure(p, f"{i}_{p.kind}", replay_plan(replay, p, true), true, rng) for i, p in enumerate(plans)]
        weight = float(total_mass(true, robot)[0]) + SCALE_STD * float(rng.normal())
        mass = weighed_mass(weight, SCALE_STD, robot)
        result = identify(motions, parameters, prior_measurements=[mass], replay=replay)
        error = (result.z - truth) / result.std
        inside = np.abs(error) < CONFIDENCE
        known = result.identified
        names = np.array(parameters.names)
        row = {
            "robot": args.robot, "seed": seed, "chi2": result.chi2, "nominal_chi2": result.nominal_chi2,
            "parameters": len(parameters), "identified": int(known.sum()), "inside": int(inside[known].sum()),
            "all_inside": int(inside.sum()), "worst": float(np.abs(error[known]).max()),
            "rms": float(np.sqrt(np.mean(error[known] ** 2))),
            "outside": names[known & ~inside].tolist(),
            "unknown": names[~known].tolist(), "consistent": result.consistent,
            "inconsistency": result.inconsistency, "starts": len(result.starts),
            "mismatch": result.mismatch, "wall_s": result.effort.seconds, "cpu_s": result.effort.cpu_seconds,
        }  # fmt: skip
        print(json.dumps(row), flush=True)


if __name__ == "__main__":
    run_script(main, Args)
