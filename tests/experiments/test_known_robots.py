"""Known robots of the identification experiment: their sampling, and predictions of their motions."""

import numpy as np
import pytest

from jumper_warp.identification.parameters import jumper_parameters
from jumper_warp.identification.recording import replay_plan
from jumper_warp.identification.replay import MotionReplay
from support.identification_methods import chi2_at, problem_of
from support.known_robots import MOST, make_case, prediction_errors


@pytest.fixture(scope="module")
def known_robot():
    """Return parameters, one known robot, its replay worlds, and the function that carries out a plan."""
    parameters, one = jumper_parameters(), MotionReplay(device="cpu", threads=1)
    many = MotionReplay(device="cpu", threads=1)

    def carry(plan, robots):
        return replay_plan(one, plan, robots)

    return parameters, make_case(parameters, 3, carry, many), many, carry


def test_robot_is_sampled_from_the_priors_with_latency(known_robot):
    parameters, case, _, _ = known_robot
    assert np.abs(case.truth).max() <= 0.2 + MOST and case.truth.std() > 0.4
    assert case.truth[parameters.names.index("latency")] >= 0.2
    assert len(case.motions) == 4 and case.held_out.torque_limit == 16.0


def test_only_the_true_robot_predicts_its_motion(known_robot):
    parameters, case, _, carry = known_robot
    assert max(prediction_errors(case, case.robots, carry)) < 1.0e-12
    angle, height = prediction_errors(case, parameters.robots(np.zeros((1, len(parameters)))), carry)
    assert angle > 0.5 and height > 1.0


def test_true_parameters_fit_the_measurements(known_robot):
    """The initial states are nominal, so that a small misfit remains."""
    parameters, case, many, _ = known_robot
    problem = problem_of(parameters, case, many)
    point = problem.nominal_point()
    described = chi2_at(problem, point)
    point.z[:] = case.truth
    assert chi2_at(problem, point) < 0.02 * described
