"""Time stamps of real recordings: Unix time, rounded, with jitter or with dropped rows."""

from dataclasses import replace

import numpy as np
import pytest

from jumper_warp.identification.identify import identify
from jumper_warp.identification.motions import NoiseLevels, RecordedMotion
from jumper_warp.identification.parameters import jumper_parameters
from jumper_warp.identification.recording import measure, replay_plan, sample_plan
from jumper_warp.identification.replay import MotionReplay
from jumper_warp.identification.residuals import MotionResiduals, mean_targets, pieces_of
from jumper_warp.robot.description import load_description

UNIX = 1.7e9  # [s] where float64 resolves 0.24 us
LATENCY = 0.004  # [s]


def jitter(time, size):
    """Return time stamps [s] with independent uniform errors of up to `size` [s]."""
    return time + size * np.random.default_rng(0).uniform(-1.0, 1.0, len(time))


def moving(time):
    """Return a motion whose 12 targets differ in every row and whose motors move from the first row on."""
    rows = len(time)
    target = 0.5 + 0.1 * np.random.default_rng(0).normal(size=(rows, 12))
    return RecordedMotion(name="moving", time=time, target=target, angle=target, rate=np.ones((rows, 12)))


@pytest.fixture(scope="module")
def hung():
    """Return the latency as the only parameter, a replay, and a recorded motion of a hung robot with `LATENCY`."""
    parameters = jumper_parameters(["latency"])
    replay, rng = MotionReplay(threads=1), np.random.default_rng(1)
    robots = parameters.robots(parameters.normalised(np.array([[LATENCY]])))
    plan = sample_plan("hung chirp", rng, seconds=0.6)
    return parameters, replay, measure(plan, "hung", replay_plan(replay, plan, robots), robots, rng)


@pytest.mark.parametrize(
    "stamps",
    [
        lambda time: time,
        lambda time: time + UNIX,
        lambda time: np.round(time, 7),
        lambda time: jitter(time, 5.0e-6),
        lambda time: jitter(time + UNIX, 5.0e-6),
    ],
    ids=["exact", "Unix time", "rounded to 0.1 us", "jitter of 5 us", "Unix time with jitter"],
)
def test_latency_is_identified_from_real_time_stamps(hung, stamps):
    parameters, replay, motion = hung
    result = identify([replace(motion, time=stamps(motion.time))], parameters, replay=replay)
    assert result.values[0] == pytest.approx(LATENCY, abs=2.0e-5)  # [s]
    assert result.consistent and 0.9 < result.chi2 < 1.1


def test_latency_is_identified_from_unix_time_with_dropped_rows(hung):
    parameters, replay, motion = hung
    kept = np.delete(np.arange(len(motion.time)), [17, 51, 90])
    rows = {name: values[kept] for name, values in motion.columns().items()}
    result = identify([replace(motion, **rows | {"time": rows["time"] + UNIX})], parameters, replay=replay)
    assert result.values[0] == pytest.approx(LATENCY, abs=2.0e-5)  # [s]
    assert result.consistent


@pytest.mark.parametrize("rate", [10.0, 50.0, 100.0, 240.0, 500.0, 1000.0])  # [Hz]
def test_origin_and_jitter_of_time_change_neither_steps_nor_rows(rate):
    parameters, noise, robot = jumper_parameters(["latency"]), NoiseLevels(), load_description()
    time = np.arange(60) / rate
    exact = MotionResiduals(moving(time), parameters, noise, robot)
    for stamps in (time + UNIX, time + 1.0e6, jitter(time, 1.0e-6)):
        other = MotionResiduals(moving(stamps), parameters, noise, robot)
        assert (other.stride, other.rows, other.lead) == (exact.stride, exact.rows, exact.lead)
        np.testing.assert_array_equal(other.valid, exact.valid)
        np.testing.assert_allclose(other.target, exact.target, atol=0.01)  # [rad]; rows differ by 0.1
        pieces, exact_pieces = (pieces_of(moving(t), parameters, noise, robot, None) for t in (stamps, time))
        assert [piece.stride for piece in pieces] == [piece.stride for piece in exact_pieces]


def test_mean_targets_are_weighted_by_time():
    motion = moving(np.array([0.0, 1.0, 1.5, 4.0]))
    first, second, third, last = motion.target
    means = mean_targets(motion, np.array([-1.0, 0.5, 1.5, 2.0, 5.0, 6.0]))
    expected = [first, 0.5 * first + 0.5 * second, third, (2.0 * third + last) / 3.0, last]
    np.testing.assert_allclose(means, expected, atol=1e-12)
    np.testing.assert_allclose(mean_targets(motion, np.array([7.0, 8.0])), [last], atol=1e-12)
    np.testing.assert_allclose(mean_targets(motion, np.array([-2.0, -1.0])), [first], atol=1e-12)
    np.testing.assert_allclose(mean_targets(motion, np.array([1.1, 1.2])), [second], atol=1e-12)
