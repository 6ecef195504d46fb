"""Identification against robots whose parameters are known."""

import math
from dataclasses import replace

import numpy as np
import pytest

from jumper_warp.identification.excitation import Scorer
from jumper_warp.identification.identify import identify
from jumper_warp.identification.initial_states import paw_positions, stance, unevenness
from jumper_warp.identification.least_squares import transposed_product
from jumper_warp.identification.motions import NoiseLevels
from jumper_warp.identification.parameters import Parameter, ParameterSet, jumper_parameters, total_mass, weighed_mass
from jumper_warp.identification.recording import KINDS, measure, replay_plan, sample_plan, simulate_plan
from jumper_warp.identification.replay import MotionReplay
from jumper_warp.identification.residuals import MotionResiduals
from jumper_warp.identification.uncertainty import weak_directions
from jumper_warp.robot.description import load_description
from jumper_warp.robot.model import standing_configuration
from jumper_warp.utils.errors import InputError

DEGREE = math.pi / 180.0


@pytest.fixture(scope="module")
def replay():
    return MotionReplay(threads=2)


def sample_z(parameters, seed=0):
    """Return normalised parameters sampled from the priors, (P,)."""
    z = np.clip(0.7 * np.random.default_rng(seed).normal(size=len(parameters)), -1.5, 1.5)
    if "latency" in parameters.names:
        z[parameters.names.index("latency")] = 0.9
    return z


@pytest.mark.parametrize("kind", dict.fromkeys(KINDS))
def test_replay_matches_simulation_of_a_robot_with_all_parameters_changed(replay, kind):
    parameters = jumper_parameters()
    robots = parameters.robots(sample_z(parameters))
    plan = sample_plan(kind, np.random.default_rng(1), seconds=0.6)
    ours, theirs = replay_plan(replay, plan, robots), simulate_plan(plan, robots=robots)
    assert ours.valid.all() and np.ptp(ours.angle[:, 1, 0]) > 2.0 * DEGREE
    np.testing.assert_allclose(ours.angle, theirs.angle, atol=0.01 * DEGREE)
    np.testing.assert_allclose(ours.rate, theirs.rate, atol=0.02)
    np.testing.assert_allclose(ours.position, theirs.position, atol=2.0e-5)
    np.testing.assert_allclose(ours.torque, theirs.torque, atol=0.02)


def test_latency_delays_targets_by_fractions_of_a_step(replay):
    parameters = jumper_parameters(["latency"])
    plan = sample_plan("hung chirp", np.random.default_rng(0), seconds=0.5)
    torques = []  # of the second tick
    for steps in (0.0, 0.25, 0.5, 1.0):
        robots = parameters.robots(parameters.normalised(np.array([[steps / 480.0]])))
        torques.append(replay_plan(replay, plan, robots).torque[4, 1, 0])
    punctual, quarter, half, late = torques
    assert abs(punctual - late) > 0.01
    assert punctual - quarter == pytest.approx(0.25 * (punctual - late), rel=1e-6)
    assert punctual - half == pytest.approx(0.5 * (punctual - late), rel=1e-6)


def test_stance_matches_the_model_and_minimises_paw_velocities():
    robot = load_description()
    height = stance(robot, robot.pose("nominal")[None], np.zeros((1, 12))).height[0]
    assert height == pytest.approx(standing_configuration(robot, "nominal")[2], abs=1e-9)
    angle = robot.pose("nominal")[None] + 0.2 * np.random.default_rng(0).normal(size=(1, 12))
    rate = np.random.default_rng(1).normal(size=(1, 12))
    base = stance(robot, angle, rate)
    # the base's velocity minimises the paws' velocities
    paws = paw_positions(robot, angle) - 0.025 * base.up[:, None]
    speed = (paw_positions(robot, angle + 1e-6 * rate) - paw_positions(robot, angle - 1e-6 * rate)) / 2e-6
    left = base.velocity[:, None] + np.cross(base.spin[:, None], paws) + speed
    assert np.linalg.norm(left) < np.linalg.norm(speed)
    other = base.velocity[:, None] + 0.01 + np.cross(base.spin[:, None], paws) + speed
    assert np.linalg.norm(left) < np.linalg.norm(other)


@pytest.fixture(scope="module")
def standing(replay):
    """Return the residuals of a short chirp on the ground, with offsets as parameters, and the true z (P,)."""
    parameters, rng = jumper_parameters(["offsets"]), np.random.default_rng(4)
    truth = sample_z(parameters)
    robots = parameters.robots(truth)
    plan = sample_plan("standing chirp", rng, seconds=0.5)
    motion = measure(plan, "standing", replay_plan(replay, plan, robots), robots, rng)
    return MotionResiduals(motion, parameters, NoiseLevels(), replay.description), truth


def test_initial_states_of_a_standing_robot_keep_all_paws_on_the_ground(standing, replay):
    problem, truth = standing
    rng = np.random.default_rng(0)
    z = truth + 0.1 * rng.normal(size=(5, len(truth)))
    starts = problem.initial.states(rng.normal(size=(5, problem.start_size)), problem.parameters.robots(z))
    robot = replay.description
    assert problem.initial.resting
    for later in (0.0, 1.0e-4):  # and none of them leaves it at once
        angle = starts.angle + later * starts.rate
        assert np.abs(unevenness(robot, angle)).max() < (1e-12 if not later else 1e-9)
    still = np.zeros((1, 12))
    readings = problem.motion.angle[:1]
    assert np.abs(unevenness(robot, readings)).max() > 1.0e-4
    assert stance(robot, starts.angle, np.repeat(still, 5, axis=0)).gap.max() < 1e-12


def test_residuals_of_a_standing_robot_are_linear_in_its_initial_state(standing, replay):
    problem, truth = standing
    size, start = len(truth), np.zeros(problem.start_size)
    for _ in range(2):  # to the start that fits the measurements
        linear = problem.linearise(replay, truth, start, 1.0e-4)
        slope = linear.jacobian[:, size:]
        square = slope.T @ slope + np.eye(len(start))
        start = start - np.linalg.solve(square, slope.T @ linear.residual + start)
    unknown = sorted({column - size for world in problem.jacobian_worlds for column, _ in world if column >= size})
    move = np.zeros(len(start))  # as far as the noise lets it lie elsewhere
    lower = np.linalg.cholesky(square[np.ix_(unknown, unknown)])
    move[unknown] = np.linalg.solve(lower.T, np.random.default_rng(1).normal(size=len(unknown)))
    both = problem.residuals(replay, np.repeat(truth[None], 2, axis=0), np.stack([start, start + move]))
    change, expected = both[:, 1] - both[:, 0], slope @ move
    assert np.linalg.norm(expected) > 1.0
    assert np.linalg.norm(change - expected) < 0.05 * np.linalg.norm(expected)


def test_first_part_of_a_motion_has_the_residuals_of_the_whole(standing, replay):
    problem, truth = standing
    begun = problem.first_part(0.5)
    zero = np.zeros((1, problem.start_size))
    whole, part = (p.residuals(replay, truth[None], zero)[:, 0] for p in (problem, begun))
    assert len(part) == begun.valid.sum() < 0.6 * len(whole)
    np.testing.assert_array_equal(part, whole[: len(part)])


def test_gram_matches_numpy():
    rng = np.random.default_rng(0)
    left, right = rng.normal(size=(101, 7)), rng.normal(size=(101, 3))
    np.testing.assert_allclose(transposed_product(left, right), left.T @ right, atol=1e-12)


def few_parameters():
    """Return parameters of one leg's motors, and some that all legs share."""
    wanted = {f"{name}/{joint}" for name in ("kp", "kd", "offset") for joint in ("FL_lateral", "FL_outer", "FL_inner")}
    wanted |= {"base_mass", "latency", "knee_damping"}
    return ParameterSet(tuple(p for p in jumper_parameters() if p.name in wanted))


@pytest.fixture(scope="module")
def identified(replay):
    """Return the identification of two short motions, the true z (P,), and the motions."""
    parameters, rng = few_parameters(), np.random.default_rng(5)
    truth = sample_z(parameters, seed=2)
    robots = parameters.robots(truth)
    small = MotionReplay(threads=2)
    plans = [sample_plan(kind, rng, seconds=0.6) for kind in ("hung chirp", "standing chirp")]
    motions = [measure(plan, f"m{i}", replay_plan(small, plan, robots), robots, rng) for i, plan in enumerate(plans)]
    mass = weighed_mass(float(total_mass(robots)[0]))
    return identify(motions, parameters, prior_measurements=[mass], replay=small), truth, motions


def test_known_parameters_are_identified_within_their_intervals(identified):
    result, truth, _ = identified
    assert result.nominal_chi2 > 20.0
    assert 0.93 < result.chi2 < 1.05
    assert result.mismatch == 1.0
    error = np.abs(result.z - truth) / np.sqrt(np.diag(result.covariance))
    assert np.sqrt(np.mean(error**2)) < 1.6 and error.max() < 4.0
    values, true = result.values, result.parameters.values(truth)
    for i, parameter in enumerate(result.parameters):
        if parameter.quantity in ("kp", "kd"):
            assert values[i] == pytest.approx(true[i], rel=0.02)
    assert result.identified.sum() >= len(truth) - 1


def test_jacobian_with_shared_worlds_matches_central_differences(replay):
    parameters, rng = jumper_parameters(["motors"]), np.random.default_rng(3)
    plan = sample_plan("hung chirp", rng, seconds=0.5)
    robots = parameters.robots(sample_z(parameters))
    motion = measure(plan, "hung", replay_plan(replay, plan, robots), robots, rng)
    problem = MotionResiduals(motion, parameters, NoiseLevels(), replay.description)
    assert len(problem.jacobian_worlds) < 0.6 * (len(parameters) + problem.start_size)
    z, start = np.zeros(len(parameters)), np.zeros(problem.start_size)
    linear = problem.linearise(replay, z, start)
    for name in ("kp/FL_outer", "kd/BR_inner", "armature/FR_lateral"):
        column = parameters.names.index(name)
        change = 1.0e-3 * np.eye(len(z))[column]
        both = problem.residuals(replay, np.stack([z + change, z - change]), np.stack([start, start]))
        difference = (both[:, 0] - both[:, 1]) / 2.0e-3
        assert np.linalg.norm(difference) > 1.0
        error = np.linalg.norm(linear.jacobian[:, column] - difference)
        assert error < 0.01 * np.linalg.norm(difference)


def test_model_mismatch_widens_intervals(identified):
    _, _, motions = identified
    # the scale of an encoder is not a parameter
    parameters = few_parameters().without(["latency"])
    bent = [replace(motion, angle=1.02 * motion.angle) for motion in motions if motion.base == "fixed"]
    small = MotionReplay(threads=2)
    result = identify(bent, parameters, replay=small)
    assert result.mismatch > 2.0


def test_reports_that_masses_and_gains_share_a_scale(replay):
    wanted = ("kp", "kd", "link_mass", "armature", "motor_friction", "knee_damping")
    parameters = ParameterSet(tuple(p for p in jumper_parameters() if p.quantity in wanted))
    scorer = Scorer(parameters, replay=MotionReplay(threads=2))
    plan = sample_plan("hung chirp", np.random.default_rng(0), seconds=0.6)
    information = scorer.information(plan, scorer.record(plan))
    words = [direction.words for direction in weak_directions(parameters, information)]
    assert any("share a scale: add a weighed mass" in line for line in words), words


def test_refuses_bad_parameters_and_no_motions():
    good = dict(name="a", quantity="kp", places=(0,), unit="1", nominal=1.0, prior=0.1, bounds=(0.5, 2.0))
    Parameter(**good)
    for change in ({"bounds": (2.0, 3.0)}, {"prior": 0.0}, {"bounds": (-1.0, 2.0)}, {"bounds": (0.5, math.nan)}):
        with pytest.raises(InputError, match="parameter a"):
            Parameter(**(good | change))
    with pytest.raises(InputError, match="name of its own"):
        ParameterSet((Parameter(**good), Parameter(**good)))
    with pytest.raises(InputError, match="unknown group of parameters 'gears'"):
        jumper_parameters(["gears"])
    with pytest.raises(InputError, match="at least one motion"):
        identify([], jumper_parameters())


def test_normalised_inverts_values():
    parameters = jumper_parameters()
    assert len(parameters) == 79
    z = np.random.default_rng(0).normal(size=(3, 79))
    np.testing.assert_allclose(parameters.normalised(parameters.values(z)), z, atol=1e-9)
    robots = parameters.robots(np.zeros((2, 79)))
    assert total_mass(robots) == pytest.approx([load_description().mass] * 2)
