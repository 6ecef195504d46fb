"""Known robots of the identification experiment: sampling, prediction errors and χ²."""

import numpy as np
import pytest

from jumper_warp.identification.parameters import jumper_parameters
from jumper_warp.identification.recording import replay_plan
from jumper_warp.identification.replay import MotionReplay
from support.identification_methods import chi2_at, make_problem
from support.known_robots import MOST, make_case, prediction_errors


@pytest.fixture(scope="module")
def sampled_case():
    """Parameters, a case of one known robot, a replay, and the function that simulates a plan on a robot."""
    parameters, one = jumper_parameters(), MotionReplay(device="cpu", threads=1)
    many = MotionReplay(device="cpu", threads=1)

    def simulate(plan, robots):
        return replay_plan(one, plan, robots)

    return parameters, make_case(parameters, 3, simulate, many), many, simulate


def test_sampled_robot_is_within_priors_with_latency_motions_and_held_out_jump(sampled_case):
    parameters, case, _, _ = sampled_case
    assert np.abs(case.truth).max() <= 0.2 + MOST and case.truth.std() > 0.4
    assert case.truth[parameters.names.index("latency")] >= 0.2
    assert len(case.motions) == 4 and case.held_out.torque_limit == 16.0


def test_true_robot_predicts_held_out_jump_exactly_and_nominal_robot_does_not(sampled_case):
    parameters, case, _, simulate = sampled_case
    assert max(prediction_errors(case, case.robots, simulate)) < 1.0e-12
    angle, height = prediction_errors(case, parameters.robots(np.zeros((1, len(parameters)))), simulate)
    assert angle > 0.5 and height > 1.0  # [deg], [mm] error of the nominal robot


def test_true_parameters_lower_chi2_of_measurements(sampled_case):
    """Initial states are at their expected values in both cases, not at the true ones."""
    parameters, case, many, _ = sampled_case
    problem = make_problem(parameters, case, many)
    point = problem.nominal_point()
    described = chi2_at(problem, point)
    point.z[:] = case.truth
    assert chi2_at(problem, point) < 0.02 * described
