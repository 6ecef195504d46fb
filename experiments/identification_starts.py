"""Measure how reliably `jumper sysid` separates good fits from local minima, on robots whose parameters are unusual.

    python experiments/identification_starts.py --workers 16 --out outputs/identification_starts

Masses, gains, friction, damping and latency of each robot differ from the description by one to two standard deviations
of their priors. Its two hung chirps, standing chirp and small jump are recorded with several noises, and each recording
is identified. A fit is good if at most 20 % of its identified parameters are outside their 95 % intervals and none by
more than 5 standard deviations. `accepted_bad_expected` is the expected number of bad ones among the accepted fits if
all of these ended in the right minimum.

`evaluation.jsonl` in the folder has one line for each fit. A later run with the same `--out` computes only the missing
ones.
"""

from __future__ import annotations

import json
import os
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Literal

import numpy as np

from jumper_warp.identification.excitation import unsafe_reason
from jumper_warp.identification.identify import identify
from jumper_warp.identification.parameters import ParameterSet, jumper_parameters, total_mass, weighed_mass
from jumper_warp.identification.recording import KINDS, measure, replay_plan, sample_plan
from jumper_warp.identification.replay import MotionReplay
from jumper_warp.identification.results import CONFIDENCE, Identification
from jumper_warp.utils.files import Json, write_atomically
from jumper_warp.utils.output import output_dir
from jumper_warp.utils.progress import phase
from jumper_warp.utils.runtime import configure_device
from support.scripts import OutputArgs, report, run_script

Stream = Literal["development", "examined", "evaluation"]
STREAMS: dict[Stream, int] = {"development": 1, "examined": 2, "evaluation": 3}
"""First word of the seeds. Fits of the stream "examined" were looked at when the derivatives were improved."""
FAR = ("base_mass", "link_mass", "kp", "kd", "motor_friction", "knee_damping", "paw_friction")
NEAREST, FARTHEST = 1.0, 2.0  # [1] Range of the distance of each of these quantities, in standard deviations of priors
OWN, MOST = 0.5, 2.5  # [1] Standard deviation of each parameter around it, and limit, in the same unit
LATENCY = (0.4, 2.0)  # [1] Range of the latency, in standard deviations of its prior (5 ms)
SCALE_STD = 0.02  # [kg] Standard deviation of the weighed mass
MOST_OUTSIDE, FARTHEST_OUTSIDE = 0.2, 5.0
"""Limits of a good fit: fraction of identified parameters outside their 95 % intervals, and their largest error in
standard deviations."""
DRAWS = 10_000  # Number of sampled errors of an estimate


def far_robot(parameters: ParameterSet, rng: np.random.Generator) -> np.ndarray:
    """Sample normalised parameters (P,) of a robot with masses, gains, friction and latency far from nominal.

    The description has 0, and the unit is the standard deviation of a parameter's prior. All parameters of a quantity
    in FAR, such as the masses of the links, are off by one common distance, around which they scatter.
    """
    z = OWN * rng.normal(size=len(parameters))
    for quantity in FAR:
        members = [i for i, parameter in enumerate(parameters) if parameter.quantity == quantity]
        far = rng.choice([-1.0, 1.0]) * rng.uniform(NEAREST, FARTHEST)
        z[members] = far + (z[members] if len(members) > 1 else 0.0)
    z[parameters.names.index("latency")] = rng.uniform(*LATENCY)
    return np.clip(z, -MOST, MOST)


def is_good(error: np.ndarray) -> np.ndarray:
    """Return which fits are good, (...) bool: few parameters are outside their 95 % intervals, and none far.

    error: absolute errors of the parameters [standard deviations], (..., P). Limits: MOST_OUTSIDE, FARTHEST_OUTSIDE.
    """
    outside = (error > CONFIDENCE).mean(axis=-1)
    return (outside <= MOST_OUTSIDE) & (error.max(axis=-1) <= FARTHEST_OUTSIDE)


def bad_probability(result: Identification, truth: np.ndarray, rng: np.random.Generator) -> float:
    """Return the probability that a fit which found the right minimum fails `is_good` only because of noise.

    It is estimated from `DRAWS` sampled errors. They are correlated: one cause can move many parameters out of their
    intervals. With the covariance C of the posterior, and the unit prior at 0, the estimate of a robot z has mean
    z - C z and covariance C - C C. truth: z, (P,).
    """
    covariance = result.covariance
    errors = rng.multivariate_normal(-covariance @ truth, covariance - covariance @ covariance, size=DRAWS)
    return float(1.0 - is_good(np.abs(errors / result.std)[:, result.identified]).mean())


def identify_far_robot(stream: Stream, robot: int, noise: int) -> Json:
    """Sample a robot, record its motions, identify it on one CPU thread, and return the result as JSON data.

    robot, noise: indices of the robot with its motions, and of the noise of its sensors and scale.
    """
    configure_device("cpu", 1)
    parameters = jumper_parameters()
    replay = MotionReplay(device="cpu", threads=1)
    rng, noise_rng = (
        np.random.default_rng(seed) for seed in ([STREAMS[stream], robot], [STREAMS[stream], robot, 1 + noise])
    )
    truth = far_robot(parameters, rng)
    robots = parameters.robots(truth)
    described = parameters.robots(np.zeros_like(truth))
    simulate = partial(replay_plan, MotionReplay(device="cpu", threads=1))
    motions = []
    while len(motions) < len(KINDS):
        plan = sample_plan(KINDS[len(motions)], rng)
        record = simulate(plan, robots)
        if not unsafe_reason(plan, simulate(plan, described)) and not unsafe_reason(plan, record):
            motions.append(measure(plan, f"{len(motions)} {plan.kind}", record, robots, noise_rng))
    mass_error = float(noise_rng.normal())
    mass = weighed_mass(float(total_mass(robots)[0]) + SCALE_STD * mass_error, SCALE_STD)
    result = identify(motions, parameters, prior_measurements=[mass], replay=replay)
    error = np.abs(result.z - truth)[result.identified] / result.std[result.identified]
    outside = int((error > CONFIDENCE).sum())
    worst = float(error.max())
    names = np.array(parameters.names)[result.identified]
    return {
        "robot": robot, "noise": noise, "consistent": result.consistent, "inconsistency": result.inconsistency,
        "good": bool(is_good(error)), "bad_probability": bad_probability(result, truth, rng),
        "identified": len(error), "outside": outside, "worst": worst, "worst_parameter": str(names[error.argmax()]),
        "mass_error_std": mass_error,
        "chi2": result.chi2, "mismatch": result.mismatch,
        "largest_test": max(test.chi2 / test.limit for test in result.tests),
        "correlation": max(test.correlation for test in result.tests),
        "starts": [[start.excess, start.difference] for start in result.starts],
        "cpu_s": result.effort.cpu_seconds, "wall_s": result.effort.seconds,
        "million_world_steps": result.effort.world_steps / 1.0e6,
    }  # fmt: skip


SUMMARY = (
    "fits", "accepted", "accepted_bad", "accepted_bad_expected", "good", "good_rejected_rate", "coverage",
    "worst_accepted", "three_starts", "cpu_s_median", "cpu_s_largest",
)  # fmt: skip


@dataclass(frozen=True)
class Args(OutputArgs):
    """Flags of the test of identification on robots with parameters far from the nominal ones."""

    num_robots: int = 40  # Number of robots
    num_noises: int = 3  # Number of recordings of each robot
    stream: Stream = "evaluation"  # Random numbers of robots, motions and noise; streams have none in common
    workers: int = 1  # Number of processes, each on one CPU core


def saved_fits(path: Path) -> dict[tuple[int, int], Json]:
    """Return the fits in a file of JSON lines by (index of robot, index of noise); a last line cut short is dropped."""
    fits = {}
    for line in path.read_text(encoding="utf-8").splitlines() if path.exists() else []:
        try:
            fit = json.loads(line)
            fits[fit["robot"], fit["noise"]] = fit
        except json.JSONDecodeError:
            continue
    return fits


def summary(fits: list[Json]) -> Json:
    """Return metrics of all fits: numbers of accepted (consistent) and good ones, interval coverage, and CPU time."""
    accepted, good = ([fit for fit in fits if fit[name]] for name in ("consistent", "good"))
    bad = [fit for fit in accepted if not fit["good"]]
    cpu = [fit["cpu_s"] for fit in fits]
    return {
        "fits": len(fits), "accepted": len(accepted), "accepted_bad": len(bad), "good": len(good),
        "good_rejected": sum(not fit["consistent"] for fit in good),
        "good_rejected_rate": sum(not fit["consistent"] for fit in good) / max(len(good), 1),
        "coverage": 1.0 - sum(fit["outside"] for fit in accepted) / max(sum(fit["identified"] for fit in accepted), 1),
        "accepted_bad_expected": sum(fit["bad_probability"] for fit in accepted),
        "worst_accepted": max((fit["worst"] for fit in accepted), default=0.0),
        "accepted_bad_fits": [
            f"robot {fit['robot']}, noise {fit['noise']}: {fit['outside']} of {fit['identified']} outside, worst "
            f"{fit['worst']:.1f} sigma, scale {fit['mass_error_std']:+.1f} sigma"
            for fit in bad
        ],
        "rejected_fits": [
            f"robot {fit['robot']}, noise {fit['noise']}: {fit['inconsistency']}"
            for fit in fits
            if not fit["consistent"]
        ],
        "three_starts": sum(len(fit["starts"]) > 2 for fit in fits),
        "cpu_s_median": float(np.median(cpu)), "cpu_s_mean": float(np.mean(cpu)), "cpu_s_largest": max(cpu),
    }  # fmt: skip


def main(args: Args) -> Json:
    """Compute the fits that are missing in the output folder, and write and return the metrics of all fits."""
    folder = output_dir("identification_starts", args.out)
    path = folder / f"{args.stream}.jsonl"
    fits = saved_fits(path)
    write_atomically(path, "".join(json.dumps(fit) + "\n" for fit in fits.values()).encode())
    every = [(robot, noise) for robot in range(args.num_robots) for noise in range(args.num_noises)]
    missing = [key for key in every if key not in fits]
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):  # of the processes, which inherit them
        os.environ[name] = "1"
    with (
        ProcessPoolExecutor(args.workers, get_context("spawn")) as pool,
        path.open("a", encoding="utf-8") as file,
        phase("identifying robots", len(missing)) as advance,
    ):
        for future in as_completed([pool.submit(identify_far_robot, args.stream, *key) for key in missing]):
            fit = future.result()
            fits[fit["robot"], fit["noise"]] = fit
            print(json.dumps(fit), file=file, flush=True)
            advance()
    values = summary([fits[key] for key in every if key in fits])
    return report(args, folder, values, f"Identification of {args.num_robots} robots far from the description", SUMMARY)


if __name__ == "__main__":
    run_script(main, Args)
