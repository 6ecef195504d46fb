"""χ² tests of a fit, starts that agree, and a paw that sticks in the simulation and slips on the robot."""

import numpy as np
import pytest

from jumper_warp.identification.consistency import chi2_limit, contradictions, variance_factor, without
from jumper_warp.identification.identify import Descent, identify
from jumper_warp.identification.least_squares import LeastSquares
from jumper_warp.identification.motions import NoiseLevels
from jumper_warp.identification.parameters import ParameterSet, jumper_parameters
from jumper_warp.identification.recording import measure, replay_plan, sample_plan
from jumper_warp.identification.replay import MotionReplay
from jumper_warp.identification.residuals import Linearised, MotionResiduals
from jumper_warp.identification.results import starts_agree


@pytest.mark.parametrize(  # number of residuals, number of fitted parameters, residuals that vary as one, limit of χ²/n
    ("count", "fitted", "correlation", "limit"),
    [
        (100, 0.0, 1.0, 124.342 / 100),  # tables of the χ² distribution at 5 %
        (100, 0.0, 2.0, 67.505 / 50),  # as 50 independent values
        (110, 10.0, 1.0, 124.342 / 110),
        (10, 0.0, 40.0, 3.84146),  # as one value, although they vary as a quarter of one
    ],
)
def test_chi2_limit_is_that_of_chi2_tables(count, fitted, correlation, limit):
    assert chi2_limit(count, fitted, correlation, 0.05) == pytest.approx(limit, rel=1e-5)


def test_variance_factor_of_autoregressive_residuals_is_that_of_bartlett():
    rng, noise, memory = np.random.default_rng(0), np.zeros((12, 4000)), 0.6
    white = rng.normal(size=noise.shape)
    for i in range(1, noise.shape[1]):
        noise[:, i] = memory * noise[:, i - 1] + white[:, i]
    assert variance_factor(white) == pytest.approx(1.0, abs=0.01)
    assert variance_factor(noise) == pytest.approx((1.0 + memory**2) / (1.0 - memory**2), rel=0.05)  # Bartlett


# excess: cost of each start's fit above that of the best, sorted
@pytest.mark.parametrize(("excess", "agree"), [([0.0], False), ([0.0, 1.0], True), ([0.0, 20.0, 21.0], False)])
def test_starts_agree_if_the_second_best_costs_little_more(excess, agree):
    assert starts_agree(excess) is agree


@pytest.fixture(scope="module")
def slipping():
    """Return the paws' friction as the only parameter, a replay, and a motion whose paws slip at 0.6 instead of 0.9."""
    parameters = ParameterSet(tuple(p for p in jumper_parameters() if p.name == "paw_friction"))
    replay, rng = MotionReplay(threads=1), np.random.default_rng(1)
    robots = parameters.robots(parameters.normalised(np.array([[0.6]])))
    plan = sample_plan("standing chirp", rng, seconds=0.6)
    return parameters, replay, measure(plan, "slipping", replay_plan(replay, plan, robots), robots, rng)


def test_friction_of_paws_that_stick_as_described_is_identified(slipping):
    parameters, replay, motion = slipping
    result = identify([motion], parameters, replay=replay)
    assert result.values[0] == pytest.approx(0.6, abs=0.02)
    assert result.consistent and result.starts_agree and result.inconsistency == ""


def test_fit_of_a_robot_with_another_friction_is_not_consistent(slipping):
    _, replay, motion = slipping
    result = identify([motion], jumper_parameters(["latency"]), replay=replay)
    assert not result.consistent and len(result.starts) == 2  # starts end if the residuals of two fail
    assert "slipping rate χ² " in result.inconsistency
    failed = {(test.motion, test.channel) for test in result.tests if not test.passed}
    assert ("slipping", "rate") in failed and ("slipping", "orientation") not in failed


def test_a_motor_whose_gain_changed_between_motions_contradicts_the_others_most():
    parameters = ParameterSet(tuple(p for p in jumper_parameters() if p.quantity == "kp"))
    replay, rng, index = MotionReplay(threads=1), np.random.default_rng(2), parameters.names.index("kp/FL_outer")
    plan, motions = sample_plan("hung chirp", rng, seconds=0.5), []
    for name, z in (("described", 0.0), ("stiffer", 0.2)):  # kp 1 and 1.04
        robots = parameters.robots(z * np.eye(len(parameters))[index : index + 1])
        motion = measure(plan, name, replay_plan(replay, plan, robots), robots, rng)
        motions.append(MotionResiduals(motion, parameters, NoiseLevels(), replay.description))
    problem = LeastSquares(parameters, motions, replay)
    point = problem.nominal_point()
    point, normal = Descent(replay).minimise(problem, point, problem.normal(point))
    assert 0.05 < point.z[index] < 0.15  # between both
    failed = {(each.motion.motion.name, each.name): each for each in contradictions(problem, normal)}
    assert set(list(failed)[:2]) == {("described", "FL_outer"), ("stiffer", "FL_outer")}
    for left_out, other in (("stiffer", 0.0), ("described", 0.2)):
        assert (point.z + without(normal, failed[left_out, "FL_outer"]))[index] == pytest.approx(other, abs=0.04)


def test_final_derivatives_do_not_depend_on_those_of_an_earlier_point():
    parameters = ParameterSet(tuple(p for p in jumper_parameters() if p.quantity in ("kp", "kd")))
    replay, rng = MotionReplay(threads=1), np.random.default_rng(3)
    plan, robots = sample_plan("hung chirp", rng, seconds=0.5), parameters.robots(np.zeros((1, len(parameters))))
    motion = measure(plan, "hung", replay_plan(replay, plan, robots), robots, rng)
    problem = LeastSquares(parameters, [MotionResiduals(motion, parameters, NoiseLevels(), replay.description)], replay)
    point = problem.nominal_point()
    normal = problem.normal(point)
    old = problem.assemble(point, [Linearised(each.residual, 0.5 * each.jacobian) for each in normal.linearised])
    information = problem.without_jumps(point, old).information()
    np.testing.assert_allclose(information, normal.information(), atol=0.01 * np.abs(information).max())


class JumpingResiduals:
    """Residuals (100,) equal to z, with a jump of 0.01 at 0.0005 on either side of 0."""

    start_size, valid = 1, np.ones((100, 1), bool)

    def linearise(self, replay, z, start, change):
        values = np.array([z[0], z[0] + change[0]])
        residual, ahead = values + 0.01 * np.sign(values) * (np.abs(values) > 0.0005)
        slope = np.full(100, (ahead - residual) / change[0])
        return Linearised(np.full(100, residual), np.column_stack([slope, np.zeros(100)]))


def test_final_derivatives_exclude_jumps_on_both_sides():
    problem = LeastSquares(jumper_parameters(["latency"]), [JumpingResiduals()], MotionReplay(threads=1))
    point = problem.nominal_point()
    smooth = problem.normal(point)  # by the first, shortest step; sets the next one to 0.01 / sqrt(1 + 100)
    assert smooth.information()[0, 0] == pytest.approx(100.0)
    assert problem.motions[0].linearise(None, point.z, point.starts[0], problem._change[0]).jacobian[0, 0] > 10.0
    assert problem.without_jumps(point, smooth).information()[0, 0] == pytest.approx(100.0)
