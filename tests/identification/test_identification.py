"""Identification against robots whose parameters are known."""

import math
from dataclasses import replace

import numpy as np
import pytest

from columns import Z
from jumper_warp.identification.excitation import Scorer, choose
from jumper_warp.identification.identify import identify
from jumper_warp.identification.initial_states import paw_positions, stance, unevenness
from jumper_warp.identification.motions import NoiseLevels
from jumper_warp.identification.parameters import ParameterSet, jumper_parameters, total_mass, weighed_mass
from jumper_warp.identification.recording import KINDS, Plan, measure, replay_plan, sample_plan
from jumper_warp.identification.replay import MotionReplay
from jumper_warp.identification.report import identified_overlay
from jumper_warp.identification.residuals import MotionResiduals
from jumper_warp.identification.uncertainty import weak_directions
from jumper_warp.robot.description import load_description
from jumper_warp.robot.model import standing_configuration
from jumper_warp.robot.overlay import RobotOverlay, load_overlay
from jumper_warp.robot.values import TRANSVERSAL, RobotValues
from jumper_warp.utils.errors import InputError
from recorded_motions import simulate_plan

DEGREE = math.pi / 180.0  # [rad]
OTHER_ROBOTS = ("heavy", "small_direct_drive")  # with weaker motors at the back; without lateral axes


@pytest.fixture(scope="module")
def replay():
    """Return a replay of the described robot on two CPU threads."""
    return MotionReplay(threads=2)


def sample_z(parameters, seed=0):
    """Return normalised parameters (P,) sampled with 0.7 of the priors' std, clipped to ±1.5; latency at 0.9."""
    z = np.clip(0.7 * np.random.default_rng(seed).normal(size=len(parameters)), -1.5, 1.5)
    if "latency" in parameters.names:
        z[parameters.names.index("latency")] = 0.9
    return z


@pytest.mark.parametrize("kind", dict.fromkeys(KINDS))
def test_replay_matches_simulation_of_a_robot_with_all_parameters_changed(replay, kind):
    parameters = jumper_parameters()
    robots = parameters.robots(sample_z(parameters))
    plan = sample_plan(kind, np.random.default_rng(1), seconds=0.6)
    replayed, simulated = replay_plan(replay, plan, robots), simulate_plan(plan, robots)
    assert replayed.valid.all() and np.ptp(replayed.angle[:, 1, 0]) > 2.0 * DEGREE  # FL_outer moves
    np.testing.assert_allclose(replayed.angle, simulated.angle, atol=0.01 * DEGREE)
    np.testing.assert_allclose(replayed.rate, simulated.rate, atol=0.02)  # [rad/s]
    np.testing.assert_allclose(replayed.position, simulated.position, atol=2.0e-5)  # [m]
    np.testing.assert_allclose(replayed.torque, simulated.torque, atol=0.02)  # [N m]


def test_torque_is_linear_in_a_latency_below_a_physics_step(replay):
    """A motor follows its old target for a part of the physics step, so torque mixes in proportion to the latency."""
    parameters = jumper_parameters(["latency"])
    plan = sample_plan("hung chirp", np.random.default_rng(0), seconds=0.5)
    torques = []  # [N m] of FL_outer in row 4, the first of the second target
    for steps in (0.0, 0.25, 0.5, 1.0):  # latency in physics steps of 1/480 s
        robots = parameters.robots(parameters.normalised(np.array([[steps / 480.0]])))
        torques.append(replay_plan(replay, plan, robots).torque[4, 1, 0])
    punctual, quarter, half, late = torques
    assert abs(punctual - late) > 0.01
    assert punctual - quarter == pytest.approx(0.25 * (punctual - late), rel=1e-6)
    assert punctual - half == pytest.approx(0.5 * (punctual - late), rel=1e-6)


@pytest.mark.parametrize(("name", "damping"), [("heavy", 0.3), ("small_direct_drive", 1.0)])
def test_replay_of_another_robot_matches_its_simulation(name, damping):
    """Steps of the targets drive the motors to their own peak torques at high speeds; damping: ratio of kd [1]."""
    robot = load_overlay(name).description
    target = np.zeros((30, 12))
    target[:, TRANSVERSAL] = np.where(np.arange(30) // 6 % 2, 2.0, 0.4)[:, None]  # [rad]
    plan = Plan("hung chirp", target, 100.0)
    robots = RobotValues.nominal(1, robot)
    robots.kd *= damping
    replayed = replay_plan(MotionReplay(description=robot, threads=2), plan, robots)
    simulated = simulate_plan(plan, robots, robot)
    assert np.abs(replayed.rate).max() > 35.0  # [rad/s] where the Jumper's over-speed protection begins
    np.testing.assert_allclose(replayed.angle, simulated.angle, atol=0.05 * DEGREE)


@pytest.mark.parametrize(
    ("limit", "front", "back"), [(40.0, 40.0, 40.0), (90.0, 90.0, 86.2014), (200.0, 95.7793, 86.2014)]
)
def test_torque_limit_of_a_motion_is_that_of_all_motors_up_to_their_peaks(limit, front, back):
    robot = load_overlay("heavy").description
    target = np.full((30, 12), 0.4)
    target[10:, TRANSVERSAL] = 2.0  # [rad] a step that asks for more than the peak torques
    robots = RobotValues.nominal(1, robot)
    robots.saturation *= 0.8
    record = replay_plan(MotionReplay(description=robot, threads=2), Plan("hung chirp", target, limit), robots)
    expected = 0.8 * np.tile([front, front, back, back], (2, 1)).T.ravel()  # [N m]
    assert np.abs(record.torque[:, TRANSVERSAL, 0]).max(axis=0) == pytest.approx(expected)


@pytest.mark.parametrize("name", ["", *OTHER_ROBOTS])
def test_stance_has_the_models_height(name):
    """On all paws in the nominal pose the base is as high above the ground as in the simulation's start state."""
    robot = load_overlay(name).description if name else load_description()
    height = stance(robot, robot.pose("nominal")[None], np.zeros((1, 12))).height[0]
    assert height == pytest.approx(standing_configuration(robot, "nominal")[Z], abs=1e-9)  # [m]


def test_stance_velocity_minimises_paw_velocities():
    robot = load_description()
    angle = robot.pose("nominal")[None] + 0.2 * np.random.default_rng(0).normal(size=(1, 12))
    rate = np.random.default_rng(1).normal(size=(1, 12))
    base = stance(robot, angle, rate)
    contacts = paw_positions(robot, angle) - 0.025 * base.up[:, None]  # [m]; 0.025: radius of a paw
    relative = (paw_positions(robot, angle + 1e-6 * rate) - paw_positions(robot, angle - 1e-6 * rate)) / 2e-6
    velocity = base.velocity[:, None] + np.cross(base.spin[:, None], contacts) + relative
    assert np.linalg.norm(velocity) < np.linalg.norm(relative)  # smaller than with a base at rest
    assert np.linalg.norm(velocity) < np.linalg.norm(velocity + 0.01)  # and with another base velocity [m/s]


@pytest.fixture(scope="module")
def standing(replay):
    """Return the residuals of a 0.5 s chirp on the ground, with sensor offsets as parameters, and the true z (P,)."""
    parameters, rng = jumper_parameters(["offsets"]), np.random.default_rng(4)
    truth = sample_z(parameters)
    robots = parameters.robots(truth)
    plan = sample_plan("standing chirp", rng, seconds=0.5)
    motion = measure(plan, "standing", replay_plan(replay, plan, robots), robots, rng)
    return MotionResiduals(motion, parameters, NoiseLevels(), replay.description), truth


def test_initial_states_of_a_standing_robot_keep_all_paws_on_the_ground(standing, replay):
    (problem, truth), rng, robot = standing, np.random.default_rng(0), replay.description
    z = truth + 0.1 * rng.normal(size=(5, len(truth)))
    starts = problem.initial.states(rng.normal(size=(5, problem.start_size)), problem.parameters.robots(z))
    assert problem.initial.resting
    for time, tolerance in ((0.0, 1e-12), (1.0e-4, 1e-9)):  # [s], [m]: no paw leaves the plane at once
        assert np.abs(unevenness(robot, starts.angle + time * starts.rate)).max() < tolerance
    assert np.abs(unevenness(robot, problem.motion.angle[:1])).max() > 1.0e-4  # [m] of the readings, with offsets
    assert stance(robot, starts.angle, np.zeros((5, 12))).gap.max() < 1e-12  # [m]


def test_residuals_of_a_standing_robot_are_linear_in_its_initial_state(standing, replay):
    """The change of the residuals within the posterior differs by less than 5 % from Jacobian times step."""
    problem, truth = standing
    size, start = len(truth), np.zeros(problem.start_size)
    for _ in range(2):  # Gauss-Newton steps to the start that fits the measurements
        linear = problem.linearise(replay, truth, start, 1.0e-4)
        slope = linear.jacobian[:, size:]
        square = slope.T @ slope + np.eye(len(start))
        start = start - np.linalg.solve(square, slope.T @ linear.residual + start)
    unknown = sorted({column - size for world in problem.jacobian_worlds for column, _ in world if column >= size})
    move = np.zeros(len(start))  # sampled from the posterior of the coordinates that contact does not determine
    lower = np.linalg.cholesky(square[np.ix_(unknown, unknown)])
    move[unknown] = np.linalg.solve(lower.T, np.random.default_rng(1).normal(size=len(unknown)))
    both = problem.residuals(replay, np.repeat(truth[None], 2, axis=0), np.stack([start, start + move]))
    change, expected = both[:, 1] - both[:, 0], slope @ move  # columns of both: start, start + move
    assert np.linalg.norm(expected) > 1.0
    assert np.linalg.norm(change - expected) < 0.05 * np.linalg.norm(expected)


def few_parameters():
    """Return kp, kd and offset of leg FL's motors, base mass, latency and knee damping: 12 parameters."""
    wanted = {f"{name}/{joint}" for name in ("kp", "kd", "offset") for joint in ("FL_lateral", "FL_outer", "FL_inner")}
    wanted |= {"base_mass", "latency", "knee_damping"}
    return ParameterSet(tuple(p for p in jumper_parameters() if p.name in wanted))


@pytest.fixture(scope="module")
def identified(replay):
    """Return the identification by two motions of 0.6 s and the exact mass, the true z (P,), and the motions."""
    parameters, rng = few_parameters(), np.random.default_rng(5)
    truth = sample_z(parameters, seed=2)
    robots = parameters.robots(truth)
    small = MotionReplay(threads=2)
    plans = [sample_plan(kind, rng, seconds=0.6) for kind in ("hung chirp", "standing chirp")]
    motions = [measure(plan, f"m{i}", replay_plan(small, plan, robots), robots, rng) for i, plan in enumerate(plans)]
    mass = weighed_mass(float(total_mass(robots)[0]))
    return identify(motions, parameters, prior_measurements=[mass], replay=small), truth, motions


def test_known_parameters_are_identified_within_four_standard_deviations(identified):
    """The fit is at the level of the noise: χ² is near 1, without mismatch."""
    result, truth, _ = identified
    assert result.nominal_chi2 > 20.0
    assert 0.93 < result.chi2 < 1.05
    assert result.mismatch == 1.0
    error = np.abs(result.z - truth) / np.sqrt(np.diag(result.covariance))
    assert np.sqrt(np.mean(error**2)) < 1.6 and error.max() < 4.0
    for parameter, value, true in zip(result.parameters, result.values, result.parameters.values(truth), strict=True):
        if parameter.quantity in ("kp", "kd"):
            assert value == pytest.approx(true, rel=0.02)
    assert result.identified.sum() >= len(truth) - 1


def test_jacobian_with_shared_worlds_matches_central_differences(replay):
    """The four legs of a hung robot share worlds; columns agree within 1 % of their norm."""
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


def test_scaled_angles_double_the_mismatch(identified):
    """Readings are scaled by 1.02, which no parameter can explain."""
    _, _, motions = identified
    scaled = [replace(motion, angle=1.02 * motion.angle) for motion in motions if motion.base == "fixed"]
    result = identify(scaled, few_parameters().without(["latency"]), replay=MotionReplay(threads=2))
    assert result.mismatch > 2.0


def test_open_directions_report_that_masses_and_gains_share_a_scale():
    wanted = ("kp", "kd", "link_mass", "armature", "motor_friction", "knee_damping")
    parameters = ParameterSet(tuple(p for p in jumper_parameters() if p.quantity in wanted))
    scorer = Scorer(parameters, replay=MotionReplay(threads=2))
    plan = sample_plan("hung chirp", np.random.default_rng(0), seconds=0.6)
    information = scorer.information(plan, scorer.record(plan))
    lines = [direction.words for direction in weak_directions(parameters, information)]
    assert any("share a scale: add a weighed mass" in line for line in lines), lines


def test_scorer_of_another_robot_simulates_this_robot():
    robot = load_overlay("heavy").description
    scorer = Scorer(jumper_parameters(["motors"], robot), replay=MotionReplay(description=robot))
    for quantity, described in vars(RobotValues.nominal(1, robot)).items():
        np.testing.assert_allclose(getattr(scorer._nominal, quantity), described, rtol=1e-12, err_msg=quantity)


def test_recorded_torques_reveal_gains_apart_from_masses(replay):
    parameters, plan = jumper_parameters(), sample_plan("hung chirp", np.random.default_rng(0), seconds=0.6)
    place, stds = parameters.names.index("kp/FL_inner"), []  # [1] of kp after the fit, relative to that before
    for torque in (False, True):
        scorer = Scorer(parameters, replay=replay, torque=torque)
        information = scorer.information(plan, scorer.record(plan))
        stds.append(np.linalg.inv(information + np.eye(len(parameters)))[place, place] ** 0.5)
    assert stds[1] < 0.5 * stds[0] < 0.5


def test_identify_refuses_a_recording_given_twice(standing):
    motion = standing[0].motion
    copy = replace(motion, name="copy", time=motion.time + 5.0, position=None, angle=motion.angle + 1.0e-12)
    for motions in ([motion, motion], [motion, replace(motion, angle=motion.angle + 0.001), copy]):
        with pytest.raises(InputError, match=rf"motions 1 \(standing\) and {len(motions)} .* are the same recording"):
            identify(motions, jumper_parameters())


def test_identify_refuses_a_robot_that_does_not_move(replay):
    parameters, rng = jumper_parameters(["latency"]), np.random.default_rng(0)
    plan, robots = sample_plan("hung chirp", rng, seconds=0.5), parameters.robots(np.zeros((1, 1)))
    plan = replace(plan, target=np.repeat(plan.target[:1], len(plan.target), axis=0))
    motion = measure(plan, "still", replay_plan(replay, plan, robots), robots, rng)
    with pytest.raises(InputError, match="identify none of 1 parameters: latency: the targets hardly change"):
        identify([motion], parameters, replay=replay)


@pytest.mark.parametrize(("name", "count"), [("heavy", 82), ("small_direct_drive", 56)])
def test_parameters_of_another_robot_at_their_prior_means_give_the_described_robot(name, count):
    """Motors at the back have a torque limit and speeds of their own; a locked axis has no parameters."""
    robot = load_overlay(name).description
    parameters = jumper_parameters(description=robot)
    assert len(parameters) == count
    robots = vars(parameters.robots(np.zeros((1, count)), robot))
    for quantity, described in vars(RobotValues.nominal(1, robot)).items():
        np.testing.assert_allclose(robots[quantity], described, rtol=1e-12, err_msg=quantity)


@pytest.mark.parametrize("name", OTHER_ROBOTS)
def test_another_robot_is_identified_by_safe_motions(name):
    robot, rng = load_overlay(name).description, np.random.default_rng(3)
    wanted = ("kp", "saturation", "base_mass", "latency", "knee_damping")
    every = jumper_parameters(description=robot)
    parameters = ParameterSet(tuple(p for p in every if p.quantity in wanted and "lateral" not in p.name))
    truth = sample_z(parameters, seed=2)
    robots = parameters.robots(truth, robot)
    replay = MotionReplay(description=robot, threads=2)
    plans = choose(Scorer(parameters, replay=replay), ("hung chirp", "small jump"), seconds=1.0).plans
    motions = [measure(plan, f"m{i}", replay_plan(replay, plan, robots), robots, rng) for i, plan in enumerate(plans)]
    mass = weighed_mass(float(total_mass(robots, robot)[0]), description=robot)
    result = identify(motions, parameters, prior_measurements=[mass], replay=replay)
    assert 0.93 < result.chi2 < 1.05
    error = np.abs(result.z - truth) / result.std
    assert result.identified.all() and error.max() < 4.0
    assert RobotOverlay.from_json(identified_overlay(result).to_json()).description.mass == pytest.approx(robot.mass)
