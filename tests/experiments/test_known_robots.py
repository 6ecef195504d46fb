"""Known robots of the identification experiment: as drawn, and how well robots predict what they did."""

import numpy as np
import pytest

from jumper_warp.identification.parameters import jumper_parameters
from jumper_warp.identification.recording import replay_plan
from jumper_warp.identification.replay import MotionReplay
from support.identification_methods import chi2_at, problem_of
from support.known_robots import MOST, make_case, prediction_errors


@pytest.fixture(scope="module")
def figure():
    """Parameters, one known robot, what replays, and what carries a plan out."""
    parameters, one = jumper_parameters(), MotionReplay(device="cpu", threads=1)
    many = MotionReplay(device="cpu", threads=1)

    def carry(plan, robots):
        return replay_plan(one, plan, robots)

    return parameters, make_case(parameters, 3, carry, many), many, carry


def test_a_robot_is_drawn_from_the_priors_and_always_late(figure):
    parameters, case, _, _ = figure
    assert np.abs(case.truth).max() <= 0.2 + MOST and case.truth.std() > 0.4
    assert case.truth[parameters.names.index("latency")] >= 0.2
    assert len(case.motions) == 4 and case.held_out.torque_limit == 16.0


def test_a_robot_predicts_itself_exactly_and_another_one_does_not(figure):
    parameters, case, _, carry = figure
    assert max(prediction_errors(case, case.robots, carry)) < 1.0e-12
    angle, height = prediction_errors(case, parameters.robots(np.zeros((1, len(parameters)))), carry)
    assert angle > 0.5 and height > 1.0


def test_the_truth_explains_what_was_measured_to_its_noise(figure):
    """But for where the motions started, which is expected and not known here."""
    parameters, case, many, _ = figure
    problem = problem_of(parameters, case, many)
    point = problem.expected()
    described = chi2_at(problem, point)
    point.z[:] = case.truth
    assert chi2_at(problem, point) < 0.02 * described
