"""Identification of simulated robots with parameters far from the nominal ones, and comparison with the truth."""

from __future__ import annotations

from functools import partial
from typing import Any, Literal

import numpy as np

from jumper_warp.identification.excitation import unsafe_reason
from jumper_warp.identification.identify import identify
from jumper_warp.identification.parameters import ParameterSet, jumper_parameters, total_mass, weighed_mass
from jumper_warp.identification.recording import KINDS, measure, replay_plan, sample_plan
from jumper_warp.identification.replay import MotionReplay
from jumper_warp.identification.results import CONFIDENCE, Identification
from jumper_warp.utils.runtime import configure_device

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
    """Sample normalised parameters (P,) of a robot with masses, gains, friction and latency far from nominal."""
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


def identify_far_robot(stream: Stream, robot: int, noise: int) -> dict[str, Any]:
    """Sample a robot, record its motions, identify it on one CPU thread, and return the result as JSON data.

    robot, noise: indices of the robot with its motions, and of the noise of its sensors and scale.
    """
    configure_device("cpu", 1)
    parameters, replay = jumper_parameters(), MotionReplay(device="cpu", threads=1)
    rng, noise_rng = (
        np.random.default_rng(seed) for seed in ([STREAMS[stream], robot], [STREAMS[stream], robot, 1 + noise])
    )
    truth = far_robot(parameters, rng)
    robots, described = parameters.robots(truth), parameters.robots(np.zeros_like(truth))
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
    outside, worst = int((error > CONFIDENCE).sum()), float(error.max())
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
