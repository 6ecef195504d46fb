import dataclasses

import numpy as np
import pytest
import warp as wp
from scipy.spatial.transform import Rotation

from columns import ANG_VEL, LIN_VEL, MOTOR_COORDS, MOTOR_DOFS, QUAT, XY, Z
from jumper_warp.kernels.mdp.env import BEGUN, COMMANDED, Delays, EpisodeArrays, Scene, SkillSettings
from jumper_warp.kernels.mdp.reset import advance_rng_kernel, clear_history_kernel, default_pose_kernel
from jumper_warp.kernels.mdp.track import track_kernel
from jumper_warp.kernels.mdp.view import RobotArrays
from jumper_warp.robot.grounds import BlockCfg
from jumper_warp.sim.simulation import Simulation
from mdp_helpers import DEFAULT_ANGLE, array, values_of
from probe_task import Probe, probe_task

N = 96
MASK = np.arange(N) % 3 == 0
"""(N,) bool, the worlds that are reset."""


class Stage(Probe):
    """n worlds of the probe task with a simulation's geometry, and launches of the reset kernels."""

    def __init__(self, n=N, task=None, seed=0):
        super().__init__(n, task, seed=seed)
        self.sim = Simulation(n, visuals=False, device="cpu")
        self.scene = scene_of(self.sim)
        self.settings = wp.array([self.skill.settings_of_skill()], dtype=SkillSettings, device="cpu")

    def mask(self, chosen):
        """Return chosen, (n,) or one for all, as a Warp array of floats."""
        return array(np.broadcast_to(np.asarray(chosen, dtype=float), self.n))

    def reset(self, chosen):
        """Launch the reset kernel where chosen is not 0; it samples due commands elsewhere."""
        skill = self.skill
        inputs = [skill.index, 1, self.mask(chosen), self.scene, self.settings, skill.settings, skill.levels,
                  self.episodes, skill.states, self.robot]  # fmt: skip
        wp.launch(skill.kernels["reset"], (self.n, 1), inputs, device="cpu")

    def set_command(self, chosen, begins, values, headings):
        """Launch the command kernel where chosen is not 0; begins 1: new episodes with headings [rad]."""
        skill = self.skill
        inputs = [skill.index, self.mask(chosen), begins, array(values, wp.vec4), array(headings), self.scene,
                  self.robot, self.episodes, skill.states]  # fmt: skip
        wp.launch(skill.kernels["set_command"], self.n, inputs, device="cpu")

    def clear_history(self, chosen):
        """Launch `clear_history_kernel` where chosen is not 0."""
        inputs = [0, self.mask(chosen), self.scene.geometry, self.robot, self.delays]
        wp.launch(clear_history_kernel, (12, self.n), inputs, device="cpu")

    def write_default_pose(self, chosen, headings):
        """Launch `default_pose_kernel` where chosen is not 0; headings [rad]: (n,)."""
        inputs = [self.mask(chosen), array(headings), self.scene, self.settings, self.episodes.skill, self.robot]
        wp.launch(default_pose_kernel, self.n, inputs, device="cpu")

    def scramble(self, seed=0):
        """Write random values into all robot and delay arrays, and random attitudes and motor angles."""
        rng = np.random.default_rng(seed)
        for struct, kind in ((self.robot, RobotArrays), (self.delays, Delays)):
            for name in kind.vars:
                values = getattr(struct, name)
                if isinstance(values, wp.array) and name not in ("body_com", "gravity", "default_angle"):
                    values.assign(rng.uniform(1.0, 9.0, values.numpy().shape))
        q = self.robot.joint_q.numpy().reshape(self.n, 43).copy()
        q[:, QUAT] = Rotation.random(self.n, random_state=seed).as_quat()
        q[:, MOTOR_COORDS] = DEFAULT_ANGLE + rng.uniform(-0.2, 0.2, (self.n, 12))
        self.robot.joint_q.assign(q.ravel())
        self.robot.body_com.assign(np.tile([0.01, -0.02, 0.03], (21 * self.n, 1)))


def scene_of(sim):
    """Return the kernels' `Scene` of a simulation."""
    scene, robot = Scene(), sim.dynamics.robot
    scene.geometry, scene.ground, scene.reference_q = robot.geometry, robot.ground, sim.model.joint_q
    return scene


@pytest.fixture
def stage():
    """Return N worlds of the probe task."""
    return Stage()


def by_world(values, n=N):
    """Return values as (n, columns), from an array whose last axis divisible by n holds the worlds."""
    axis = next(i for i in reversed(range(values.ndim)) if values.shape[i] % n == 0)
    values = np.moveaxis(values, axis, 0)
    return values.reshape(n, -1)


def assert_unchanged(before, after, worlds, but=()):
    """Assert that all arrays of a struct but those named in `but` are bitwise equal in worlds, (N,) bool."""
    for name, values in vars(before).items():
        if name in but or not any(size % N == 0 for size in values.shape):
            continue
        np.testing.assert_array_equal(by_world(getattr(after, name))[worlds], by_world(values)[worlds], name)


def test_a_reset_begins_episodes_in_masked_worlds_and_changes_no_other(stage):
    stage.scramble()
    stage.write(value=1.5, other=-1.0, steps=9)
    stage.episodes.level.assign(np.arange(N) % 2)  # the probe task's levels are numbered 11, 12
    before, worlds = values_of(stage.robot, RobotArrays), values_of(stage.episodes, EpisodeArrays)
    stage.episodes.diverged.fill_(1)
    stage.reset(MASK)
    after = values_of(stage.robot, RobotArrays)
    assert_unchanged(before, after, ~MASK)
    assert_unchanged(worlds, values_of(stage.episodes, EpisodeArrays), ~MASK, but=("diverged",))
    np.testing.assert_array_equal(stage.world("history_reset"), MASK)
    np.testing.assert_array_equal(stage.world("diverged"), ~MASK)
    np.testing.assert_array_equal(stage.read("value"), np.where(MASK, 2.5, 1.5))
    np.testing.assert_array_equal(stage.read("steps"), np.where(MASK, 0, 9))
    np.testing.assert_array_equal(stage.read("counts"), np.where(MASK, 11 + np.arange(N) % 2, 0))
    q = after.joint_q.reshape(N, 43)[MASK]
    reference = stage.scene.reference_q.numpy().reshape(N, 43)[MASK]
    np.testing.assert_array_equal(q[:, 7:], reference[:, 7:])
    np.testing.assert_allclose(q[:, Z], reference[:, 2] + 0.25, atol=1e-6)
    np.testing.assert_allclose(Rotation.from_quat(q[:, QUAT]).as_euler("ZYX"), np.tile([0.5, 0, 0], (MASK.sum(), 1)),
                               atol=1e-6)  # fmt: skip
    assert not after.joint_qd.reshape(N, 38)[MASK].any()


def test_worlds_of_another_skill_get_neither_resets_nor_commands(stage):
    stage.episodes.skill.assign(MASK.astype(int))
    stage.write(value=7.0)
    before = values_of(stage.robot, RobotArrays)
    stage.reset(1.0)
    stage.set_command(1.0, 1, np.ones((N, 4)), np.zeros(N))
    assert_unchanged(before, values_of(stage.robot, RobotArrays), MASK)
    np.testing.assert_array_equal(stage.read("value"), np.where(MASK, 7.0, 1.0))
    np.testing.assert_array_equal(stage.world("history_reset"), ~MASK)


def test_worlds_past_the_last_level_sample_one_at_each_reset():
    stage = Stage(2048)
    stage.episodes.level.fill_(2)
    stage.reset(1.0)
    assert set(stage.read("counts")) == {11, 12}
    assert np.mean(stage.read("counts") == 11) == pytest.approx(0.5, abs=4.0 * 0.5 / np.sqrt(2048))
    assert (stage.world("level") == 2).all()
    drawn = stage.read("other")
    assert abs(np.corrcoef(drawn, stage.read("counts"))[0, 1]) < 5.0 / np.sqrt(2048)


def test_a_due_command_is_sampled_and_changes_no_robot_state(stage):
    stage.scramble()
    due = np.arange(N) % 4 == 1
    stage.write(value=np.where(due, 7.0, 6.0), other=-1.0, steps=30)  # the probe task's command is due at 7
    stage.episodes.level.fill_(1)
    before = values_of(stage.robot, RobotArrays)
    stage.reset(0.0)
    assert_unchanged(before, values_of(stage.robot, RobotArrays), np.ones(N, dtype=bool))
    np.testing.assert_array_equal(stage.world("history_reset"), np.where(due, COMMANDED, 0))
    np.testing.assert_array_equal(stage.read("counts"), np.where(due, 12, 0))
    other = stage.read("other")
    assert (other[~due] == -1.0).all() and other[due].min() >= 0.0 and len(np.unique(other[due])) == due.sum()
    np.testing.assert_array_equal(stage.read("steps"), 30)


def test_a_reset_takes_precedence_over_a_due_command_and_uses_another_stream(stage):
    stage.write(value=7.0, steps=30)
    stage.reset(MASK)
    np.testing.assert_array_equal(stage.read("steps"), np.where(MASK, 0, 30))
    drawn = stage.read("other").copy()
    stage.write(value=7.0)
    stage.reset(~MASK)
    assert (stage.read("other") != drawn).all()


def test_a_task_without_sampled_commands_resets():
    task = probe_task()
    stage = Stage(
        task=dataclasses.replace(task, command=dataclasses.replace(task.command, resample_due=None, resample=None))
    )
    stage.write(value=7.0, other=-1.0)
    stage.reset(MASK)
    np.testing.assert_array_equal(stage.read("other") == -1.0, ~MASK)


def test_a_host_command_begins_an_episode_with_its_heading(stage):
    stage.write(value=1.5, steps=9, other=3.0)
    stage.episodes.diverged.fill_(1)
    values, headings = np.arange(4.0 * N).reshape(N, 4), np.linspace(-3.0, 3.0, N).astype(np.float32)
    stage.episodes.history_reset.fill_(BEGUN)
    stage.set_command(1.0, 0, values, headings)
    assert (stage.world("history_reset") == BEGUN).all()  # before the first step
    stage.episodes.history_reset.zero_()
    stage.write(value=1.5, other=3.0)
    stage.set_command(MASK, 1, values, headings)
    np.testing.assert_array_equal(stage.read("value"), np.where(MASK, values[:, 0], 1.5))
    np.testing.assert_array_equal(stage.read("other"), np.where(MASK, headings, 3.0))
    np.testing.assert_array_equal(stage.read("steps"), np.where(MASK, 0, 9))
    np.testing.assert_array_equal(stage.world("history_reset"), MASK)
    np.testing.assert_array_equal(stage.world("diverged"), ~MASK)


def test_a_host_command_within_an_episode_uses_the_robots_yaw(stage):
    stage.scramble()
    stage.write(value=1.5, steps=9, other=3.0)
    ahead = Rotation.from_quat(stage.robot.joint_q.numpy().reshape(N, 43)[:, QUAT]).apply([1.0, 0.0, 0.0])
    stage.set_command(MASK, 0, np.full((N, 4), 4.25), np.full(N, 99.0))
    np.testing.assert_array_equal(stage.read("value"), np.where(MASK, 4.25, 1.5))
    expected = np.where(MASK, np.arctan2(ahead[:, 1], ahead[:, 0]), 3.0)
    np.testing.assert_allclose(stage.read("other"), expected, atol=1e-5)
    assert (stage.read("steps") == 9).all()
    np.testing.assert_array_equal(stage.world("history_reset"), np.where(MASK, COMMANDED, 0))


def test_default_pose_has_its_heading_on_top_of_the_block_which_returns_to_its_start():
    stage = Stage()
    sim = Simulation(N, block=BlockCfg((0.0, 0.0)), visuals=False, device="cpu")
    stage.scene = scene_of(sim)
    blocks = stage.scene.ground.blocks
    records = blocks.numpy().copy()
    records["center"], records["velocity"] = [3.0, 4.0], [1.0, 1.0]
    blocks.assign(wp.array(records, dtype=blocks.dtype, device="cpu"))
    stage.scramble()
    before = values_of(stage.robot, RobotArrays)
    headings = np.linspace(-3.0, 3.0, N)
    stage.write_default_pose(MASK, headings)
    after = values_of(stage.robot, RobotArrays)
    assert_unchanged(before, after, ~MASK)
    q = after.joint_q.reshape(N, 43)[MASK]
    reference = stage.scene.reference_q.numpy().reshape(N, 43)[MASK]
    np.testing.assert_array_equal(q[:, 7:], reference[:, 7:])
    np.testing.assert_allclose(q[:, XY], reference[:, :2])
    np.testing.assert_allclose(q[:, Z], reference[:, 2] + records["height"][0], atol=1e-6)
    np.testing.assert_allclose(Rotation.from_quat(q[:, QUAT]).as_euler("ZYX")[:, 0], headings[MASK], atol=1e-6)
    assert not after.joint_qd.reshape(N, 38)[MASK].any()
    center = stage.scene.ground.blocks.numpy()["center"]
    np.testing.assert_array_equal(center, np.where(MASK[:, None], records["start"], [3.0, 4.0]))


def test_advance_rng_increments_the_step_count_of_masked_worlds(stage):
    step_count = stage.world("step_count")
    wp.launch(advance_rng_kernel, N, [stage.mask(MASK), stage.episodes], device="cpu")
    np.testing.assert_array_equal(stage.world("step_count"), step_count + MASK)


ZERO = ("torque", "prev_torque", "action", "prev_action", "prev_prev_action", "impulse", "paw_force", "peak_force",
        "contact_time", "air_time", "touchdown_speed", "paw_height", "diverged", "collisions", "body_f")  # fmt: skip
CLEARED = (*ZERO, "target", "filtered_target", "prev_rate", "prev_lin_vel", "paw_pos", "paw_vel")


def test_clear_history_sets_arrays_of_masked_worlds_to_0_or_the_present_state(stage):
    stage.scramble()
    before, delays = values_of(stage.robot, RobotArrays), values_of(stage.delays, Delays)
    stage.clear_history(MASK)
    robot = values_of(stage.robot, RobotArrays)
    assert_unchanged(before, robot, ~MASK)
    assert_unchanged(before, robot, MASK, but=CLEARED)
    assert_unchanged(delays, values_of(stage.delays, Delays), ~MASK)
    robot.body_f = robot.body_f.reshape(N, -1, 6)[:, 0]  # the base
    for name in ZERO:
        assert not by_world(getattr(robot, name))[MASK].any(), name
        assert by_world(getattr(robot, name))[~MASK].all(), name
    q, qd = robot.joint_q.reshape(N, 43), robot.joint_qd.reshape(N, 38)
    angles = q[:, MOTOR_COORDS][MASK] + robot.joint_offset.T[MASK]
    for name in ("target", "filtered_target"):
        np.testing.assert_array_equal(by_world(getattr(robot, name))[MASK], angles, name)
    np.testing.assert_array_equal(by_world(robot.prev_rate)[MASK], qd[:, MOTOR_DOFS][MASK])
    past = stage.delays.target_history.numpy()
    np.testing.assert_array_equal(past[:, :, MASK], np.tile(angles.T, (8, 1, 1)))
    com = Rotation.from_quat(q[:, QUAT]).apply([0.01, -0.02, 0.03])  # [m] of `scramble`, world axes
    np.testing.assert_allclose(
        robot.prev_lin_vel[MASK], (qd[:, LIN_VEL] - np.cross(qd[:, ANG_VEL], com))[MASK], atol=1e-5
    )


def test_clear_history_writes_paw_positions_and_velocities_of_the_present_state():
    """The oracle is `track_kernel` in the same state."""
    stage = Stage()
    stage.scramble()
    stage.clear_history(MASK)
    place, speed = (getattr(stage.robot, name).numpy().copy() for name in ("paw_pos", "paw_vel"))
    inputs = [stage.scene.geometry, stage.scene.ground, stage.settings, stage.episodes, stage.robot]
    wp.launch(track_kernel, (4, N), inputs, device="cpu")
    for before, after in ((place, stage.robot.paw_pos.numpy()), (speed, stage.robot.paw_vel.numpy())):
        np.testing.assert_array_equal(before[:, MASK], after[:, MASK])
        assert (before[:, ~MASK] != after[:, ~MASK]).all()
