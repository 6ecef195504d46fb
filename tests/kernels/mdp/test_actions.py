import dataclasses

import numpy as np
import pytest
import torch
import warp as wp

from columns import LIN_VEL, MOTOR_COORDS, MOTOR_DOFS
from jump_helpers import make_env, only, random_actions
from jumper_warp.envs.skill import TaskRuntime
from jumper_warp.kernels.mdp.actions import action_kernel
from jumper_warp.kernels.mdp.env import SkillSettings
from jumper_warp.kernels.mdp.reset import advance_rng_kernel
from jumper_warp.robot.motors import LimitsCfg, vertical_jump_filter
from jumper_warp.tasks.randomization import RandomizationCfg
from mdp_helpers import DEFAULT_ANGLE, STEP_DT, SUBSTEPS, array, new_worlds, no_delays, standing_robots
from probe_task import probe_task

DEG = np.pi / 180.0
SCALE = np.tile([15.0, 90.0, 90.0], 4) * DEG
DELAYS = np.arange(49)
"""[physics steps] All latencies that the ring buffer of targets can hold."""


class Commands:
    """Arrays of n worlds, and launches of `action_kernel` on them; motor targets start at the default pose."""

    def __init__(self, n, tasks=(), delay=0):
        """tasks: one per skill, by default the probe task; delay [physics steps]: (n,) or one for all worlds."""
        skills = [TaskRuntime(task, i, n, STEP_DT, SUBSTEPS, "cpu") for i, task in enumerate(tasks or [probe_task()])]
        self.n, self.robot, self.episodes = n, standing_robots(n), new_worlds(n)
        self.delays = no_delays(n, delay)
        self.settings = wp.array([s.settings_of_skill() for s in skills], dtype=SkillSettings, device="cpu")
        self.push = wp.zeros(n, dtype=wp.spatial_vector, device="cpu")
        self.delays.target_history.assign(np.tile(DEFAULT_ANGLE[None, :, None], (8, 1, n)))

    def act(self, action):
        """Launch the action stage with an action, (n, 12) or (skills, n, 12), and increment the step count."""
        action = array(np.reshape(action, (-1, self.n, 12)))
        inputs = [action, self.settings, self.push, self.robot, self.episodes, self.delays]
        wp.launch(action_kernel, (5, self.n), inputs, device="cpu")
        wp.launch(advance_rng_kernel, self.n, [array(np.ones(self.n)), self.episodes], device="cpu")

    def motor_array(self, name):
        """Return a copy of the array `name` of `RobotArrays`, (n, 12)."""
        return getattr(self.robot, name).numpy().T.copy()


def random_action(n, size=1.0, seed=0):
    """Return a uniform action within -size..size, (n, 12)."""
    return np.random.default_rng(seed).uniform(-size, size, (n, 12)).astype(np.float32)


def test_an_action_is_clamped_scaled_about_the_default_pose_and_kept_for_two_steps():
    commands, action = Commands(32), random_action(32, 2.0)
    commands.act(action)
    clamped = np.clip(action, -1.0, 1.0)
    np.testing.assert_array_equal(commands.motor_array("action"), clamped)
    np.testing.assert_allclose(commands.motor_array("target"), DEFAULT_ANGLE + SCALE * clamped, atol=1e-6)
    assert not commands.motor_array("prev_action").any()
    commands.act(0.5 * action)
    np.testing.assert_array_equal(commands.motor_array("prev_action"), clamped)
    assert not commands.motor_array("prev_prev_action").any()
    commands.act(0.2 * action)
    np.testing.assert_array_equal(commands.motor_array("prev_prev_action"), clamped)


def test_a_world_uses_the_action_and_the_scale_of_its_skill():
    second_task = dataclasses.replace(probe_task(), name="other", action_scale=(30.0, 45.0))  # [deg]
    commands = Commands(32, [probe_task(), second_task])
    commands.episodes.skill.assign(np.arange(32) % 2)
    actions = np.stack([random_action(32, seed=1), random_action(32, seed=2)])
    commands.act(actions)
    odd = (np.arange(32) % 2 == 1)[:, None]
    scale = np.where(odd, np.tile([30.0, 45.0, 45.0], 4) * DEG, SCALE)
    np.testing.assert_allclose(
        commands.motor_array("target"), DEFAULT_ANGLE + scale * np.where(odd, actions[1], actions[0]), atol=1e-6
    )


def test_rates_torques_and_base_velocity_are_stored_as_previous_ones():
    commands = Commands(32)
    rates, torque = random_action(32, seed=3), random_action(32, seed=4)
    qd = np.zeros((32, 38), dtype=np.float32)
    qd[:, MOTOR_DOFS], qd[:, LIN_VEL] = rates, [1.0, 2.0, 3.0]
    commands.robot.joint_qd.assign(qd.ravel())
    commands.robot.torque.assign(torque.T)
    commands.act(np.zeros((32, 12)))
    np.testing.assert_array_equal(commands.motor_array("prev_rate"), rates)
    np.testing.assert_array_equal(commands.motor_array("prev_torque"), torque)
    np.testing.assert_array_equal(commands.robot.prev_lin_vel.numpy(), np.tile([1.0, 2.0, 3.0], (32, 1)))


@pytest.mark.parametrize(("offset", "safe"), [(0.0, 24.375), (4.0, 16.875), (-10.0, 30.0)])
def test_targets_are_filtered_at_the_sensed_angle(offset, safe):
    """The motor is at 10 degrees (sensor error `offset` [deg]), the target is 30, the limit 15; safe: filtered [deg].

    The sensed distance to the limit is 5, 1 or 15 degrees; at the least speed of 60 deg/s the target moves toward the
    limit with a weight of 1 - 5/8, 1 - 1/8 or 0.
    """
    open_filter = dataclasses.replace(vertical_jump_filter(), lateral=LimitsCfg(-15.0, 15.0))
    commands = Commands(1, [probe_task(action_scale=(30.0, 90.0), command_filter=open_filter)])
    q = commands.robot.joint_q.numpy().copy()
    q[7] = 10.0 * DEG  # FL lateral
    commands.robot.joint_q.assign(q)
    commands.robot.joint_offset.assign(np.full((12, 1), offset * DEG))
    commands.act(np.eye(1, 12))
    assert commands.motor_array("target")[0, 0] == pytest.approx(30.0 * DEG)
    assert commands.motor_array("filtered_target")[0, 0] == pytest.approx(safe * DEG, abs=1e-5)
    np.testing.assert_array_equal(commands.motor_array("target")[0, 1:], commands.motor_array("filtered_target")[0, 1:])


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_a_nonfinite_action_counts_as_0_and_sets_bad_action(bad):
    commands, action = Commands(8), random_action(8)
    action[3, 7], action[5] = bad, bad
    commands.act(action)
    expected = np.where(np.isfinite(action), action, 0.0)
    np.testing.assert_array_equal(commands.motor_array("action"), expected)
    assert commands.episodes.bad_action.numpy().tolist() == [0, 0, 0, 1, 0, 1, 0, 0]


@pytest.mark.parametrize("clock", [16, 2**20 - 3])  # policy steps
def test_motors_follow_targets_delayed_by_the_latency_in_physics_steps(clock):
    """Each world has its own latency; targets change in every policy step, and start at the default pose."""
    commands = Commands(len(DELAYS), delay=DELAYS)
    commands.episodes.step_count.fill_(clock)
    steps = 30
    actions = 0.2 * np.random.default_rng(0).uniform(-1.0, 1.0, (steps, 12))
    targets = DEFAULT_ANGLE + SCALE * actions  # well within the limits, so that the filter leaves them alone
    followed = []
    for action in actions:
        commands.act(np.tile(action, (len(DELAYS), 1)))
        np.testing.assert_array_equal(commands.motor_array("filtered_target"), commands.motor_array("target"))
        late, earlier = commands.delays.current_target.numpy().T, commands.delays.prev_target.numpy().T
        when = commands.delays.switch_step.numpy()
        assert (when >= 0).all() and (when < SUBSTEPS).all()
        followed += [np.where((substep < when)[:, None], earlier, late) for substep in range(SUBSTEPS)]
    followed = np.array(followed)
    commanded = np.repeat(targets, SUBSTEPS, axis=0)  # by physics step
    for world, delay in enumerate(DELAYS):
        expected = np.concatenate([np.tile(DEFAULT_ANGLE, (delay, 1)), commanded])[: steps * SUBSTEPS]
        np.testing.assert_allclose(followed[:, world], expected, atol=1e-6, err_msg=f"latency {delay}")


def test_simulated_motors_follow_delayed_targets():
    """The oracle advances the same robots by single physics steps with targets delayed in NumPy."""
    delays = np.array([0, 1, 7, 8, 13, 16, 31, 48])
    env, oracle = (make_env(len(delays), reset=only("default")) for _ in range(2))
    env.parameters.latency.assign(delays)
    for each in (env, oracle):  # contact iterations from different initial guesses differ by the tolerance
        each.sim.dynamics.tolerance = 1.0e-6
    past = []
    initial = env.sim.joint_q()[:, MOTOR_COORDS]
    target = wp.zeros((12, len(delays)), dtype=float, device="cpu")
    for action in 0.3 * random_actions(len(delays), 12, seed=1):
        env.step(action)
        past += SUBSTEPS * [env.robot.filtered_target.numpy().T.copy()]
        for substep in range(SUBSTEPS):
            when = len(past) - SUBSTEPS + substep - delays
            targets = [past[step][world] if step >= 0 else initial[world] for world, step in enumerate(when)]
            target.assign(np.array(targets).T)
            oracle.sim.advance(1, target)
        assert not env.done.any()
        motors, rates = [*range(7), *MOTOR_COORDS], [*range(6), *MOTOR_DOFS]  # base and motors; knees are not written
        np.testing.assert_allclose(env.sim.joint_q()[:, motors], oracle.sim.joint_q()[:, motors], atol=1e-5)  # [rad]
        np.testing.assert_allclose(env.sim.joint_qd()[:, rates], oracle.sim.joint_qd()[:, rates], atol=0.01)  # [rad/s]
    assert np.abs(env.sim.joint_qd()[1:] - env.sim.joint_qd()[:1]).max() > 0.1


def test_a_push_acts_on_the_base_with_a_paw_in_contact_or_with_push_in_flight():
    flying = probe_task(name="flying", randomization=dataclasses.replace(RandomizationCfg.off(), push_in_flight=True))
    commands = Commands(8, [probe_task(), flying])
    commands.episodes.skill.assign([0, 0, 0, 0, 1, 1, 1, 1])
    wrench = np.arange(48.0).reshape(8, 6) + 1.0
    commands.push.assign(wrench)
    time = np.zeros((4, 8))
    time[2, 1] = time[:, 3] = time[0, 5] = STEP_DT
    commands.robot.contact_time.assign(time)
    commands.act(np.zeros((2, 8, 12)))
    pushed = np.array([False, True, False, True, True, True, True, True])
    wrenches = commands.robot.body_f.numpy().reshape(8, 21, 6)  # (worlds, bodies, force and torque)
    np.testing.assert_array_equal(wrenches[:, 0], np.where(pushed[:, None], wrench, 0.0))
    assert not wrenches[:, 1:].any()


def test_a_step_increments_the_step_count_and_clears_history_reset():
    env = make_env(4)
    env.episodes.history_reset.fill_(1)
    step_count = env.episodes.step_count.numpy().copy()
    env.step(torch.zeros(4, 12))
    np.testing.assert_array_equal(env.episodes.step_count.numpy(), step_count + 1)
    assert not env.episodes.history_reset.numpy().any()
