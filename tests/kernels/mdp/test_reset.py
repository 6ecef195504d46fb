import dataclasses

import numpy as np
import pytest
import warp as wp
from scipy.spatial.transform import Rotation
from scipy.stats import kstest

from jumper_warp.kernels.mdp.env import BEGUN, COMMANDED, Delays, EpisodeArrays, Scene, SkillSettings
from jumper_warp.kernels.mdp.reset import advance_rng_kernel, clear_history_kernel, default_pose_kernel
from jumper_warp.kernels.mdp.track import track_kernel
from jumper_warp.kernels.mdp.view import RobotArrays
from jumper_warp.robot.grounds import BlockCfg
from jumper_warp.sim.simulation import Simulation
from mdp_helpers import DEFAULT_ANGLE, MOTOR_SLOTS, array, values_of, write
from probe_task import Probe, probe_task

N = 96
SOME = np.arange(N) % 3 == 0
"""Worlds that begin anew."""


class Stage(Probe):
    """Worlds in any state, and launches of what begins episodes."""

    def __init__(self, n=N, task=None, seed=0):
        super().__init__(n, task, seed=seed)
        self.sim = Simulation(n, visuals=False, device="cpu")
        self.scene = scene_of(self.sim)
        self.settings = wp.array([self.skill.settings_of_skill()], dtype=SkillSettings, device="cpu")

    def mask(self, chosen):
        return array(np.broadcast_to(np.asarray(chosen, dtype=float), self.n))

    def reset(self, chosen):
        """Launch the beginning of episodes."""
        skill = self.skill
        inputs = [skill.index, 1, self.mask(chosen), self.scene, self.settings, skill.settings, skill.levels,
                  self.episodes, skill.states, self.robot]  # fmt: skip
        wp.launch(skill.kernels["reset"], (self.n, 1), inputs, device="cpu")

    def give(self, chosen, begins, values, headings):
        """Launch commands from outside."""
        skill = self.skill
        inputs = [skill.index, self.mask(chosen), begins, array(values, wp.vec4), array(headings), self.scene,
                  self.robot, self.episodes, skill.states]  # fmt: skip
        wp.launch(skill.kernels["set_command"], self.n, inputs, device="cpu")

    def forget(self, chosen):
        """Launch what forgets the past."""
        inputs = [0, self.mask(chosen), self.scene.geometry, self.robot, self.delays]
        wp.launch(clear_history_kernel, (12, self.n), inputs, device="cpu")

    def stand(self, chosen, headings):
        """Launch what stands robots up."""
        inputs = [self.mask(chosen), array(headings), self.scene, self.settings, self.episodes.skill, self.robot]
        wp.launch(default_pose_kernel, self.n, inputs, device="cpu")

    def scramble(self, seed=0):
        """Give the robots random states and pasts."""
        rng = np.random.default_rng(seed)
        for struct, kind in ((self.robot, RobotArrays), (self.delays, Delays)):
            for name in kind.vars:
                values = getattr(struct, name)
                if isinstance(values, wp.array) and name not in ("body_com", "gravity", "default_angle"):
                    values.assign(rng.uniform(1.0, 9.0, values.numpy().shape))
        q = self.robot.joint_q.numpy().reshape(self.n, 43).copy()
        q[:, 3:7] = Rotation.random(self.n, random_state=seed).as_quat()
        q[:, 7 + MOTOR_SLOTS] = DEFAULT_ANGLE + rng.uniform(-0.2, 0.2, (self.n, 12))
        self.robot.joint_q.assign(q.ravel())
        self.robot.body_com.assign(np.tile([0.01, -0.02, 0.03], (21 * self.n, 1)))


def scene_of(sim):
    """Return the kernels' `Scene` of a simulation."""
    scene, robot = Scene(), sim.physics.dynamics.robot
    scene.geometry, scene.ground, scene.reference_q = robot.geometry, robot.ground, sim.model.joint_q
    return scene


@pytest.fixture
def stage():
    return Stage()


def rows(values, n=N):
    """Return the values of each world, whatever axis holds the worlds, (n, ...)."""
    axis = next(i for i in reversed(range(values.ndim)) if values.shape[i] % n == 0)
    values = np.moveaxis(values, axis, 0)
    return values.reshape(n, -1)


def unchanged(before, after, worlds, but=()):
    """Check that nothing of some worlds has changed, bit for bit."""
    for name, values in vars(before).items():
        if name in but or not any(size % N == 0 for size in values.shape):
            continue
        np.testing.assert_array_equal(rows(getattr(after, name))[worlds], rows(values)[worlds], name)


def test_a_reset_begins_episodes_in_the_masked_worlds_and_touches_no_other(stage):
    stage.scramble()
    stage.write(value=1.5, other=-1.0, steps=9)
    before, worlds = values_of(stage.robot, RobotArrays), values_of(stage.episodes, EpisodeArrays)
    stage.episodes.diverged.fill_(1)
    stage.reset(SOME)
    after = values_of(stage.robot, RobotArrays)
    unchanged(before, after, ~SOME)
    unchanged(worlds, values_of(stage.episodes, EpisodeArrays), ~SOME, but=("diverged",))
    np.testing.assert_array_equal(stage.world("history_reset"), SOME)
    np.testing.assert_array_equal(stage.world("diverged"), ~SOME)
    np.testing.assert_array_equal(stage.read("value"), np.where(SOME, 2.5, 1.5))
    np.testing.assert_array_equal(stage.read("steps"), np.where(SOME, 0, 9))
    np.testing.assert_array_equal(stage.read("counts"), np.where(SOME, 11, 0))
    q = after.joint_q.reshape(N, 43)[SOME]
    reference = stage.scene.reference_q.numpy().reshape(N, 43)[SOME]
    np.testing.assert_array_equal(q[:, 7:], reference[:, 7:])
    np.testing.assert_allclose(q[:, 2], reference[:, 2] + 0.25, atol=1e-6)
    np.testing.assert_allclose(Rotation.from_quat(q[:, 3:7]).as_euler("ZYX"), np.tile([0.5, 0, 0], (SOME.sum(), 1)),
                               atol=1e-6)  # fmt: skip
    assert not after.joint_qd.reshape(N, 38)[SOME].any()


def test_worlds_of_another_skill_are_passed_over(stage):
    stage.episodes.skill.assign(SOME.astype(int))
    stage.write(value=7.0)
    before = values_of(stage.robot, RobotArrays)
    stage.reset(1.0)
    stage.give(1.0, 1, np.ones((N, 4)), np.zeros(N))
    unchanged(before, values_of(stage.robot, RobotArrays), SOME)
    np.testing.assert_array_equal(stage.read("value"), np.where(SOME, 7.0, 1.0))
    np.testing.assert_array_equal(stage.world("history_reset"), ~SOME)


def test_draws_of_a_beginning_follow_seed_and_clock():
    def draws(seed=0, later=0):
        stage = Stage(seed=seed)
        stage.episodes.step_count.assign(stage.episodes.step_count.numpy() + later)
        stage.reset(1.0)
        return stage.read("other")

    first = draws()
    np.testing.assert_array_equal(draws(), first)
    assert kstest(first, "uniform").pvalue > 1e-3
    for other in (draws(seed=1), draws(later=1)):
        assert abs(np.corrcoef(first, other)[0, 1]) < 5.0 / np.sqrt(N)


@pytest.mark.parametrize("level", [0, 1])
def test_an_episode_is_of_its_worlds_level(stage, level):
    stage.episodes.level.fill_(level)
    stage.reset(1.0)
    assert set(stage.read("counts")) == {11 + level}


def test_past_the_last_level_every_episode_draws_one():
    stage = Stage(2048)
    stage.episodes.level.fill_(2)
    stage.reset(1.0)
    assert set(stage.read("counts")) == {11, 12}
    assert np.mean(stage.read("counts") == 11) == pytest.approx(0.5, abs=4.0 * 0.5 / np.sqrt(2048))
    assert (stage.world("level") == 2).all()
    drawn = stage.read("other")
    assert abs(np.corrcoef(drawn, stage.read("counts"))[0, 1]) < 5.0 / np.sqrt(2048)


def test_a_command_that_is_due_is_drawn_and_moves_nothing(stage):
    stage.scramble()
    due = np.arange(N) % 4 == 1
    stage.write(value=np.where(due, 7.0, 6.0), other=-1.0, steps=30)
    stage.episodes.level.fill_(1)
    before = values_of(stage.robot, RobotArrays)
    stage.reset(0.0)
    unchanged(before, values_of(stage.robot, RobotArrays), np.ones(N, dtype=bool))
    np.testing.assert_array_equal(stage.world("history_reset"), np.where(due, COMMANDED, 0))
    np.testing.assert_array_equal(stage.read("counts"), np.where(due, 12, 0))
    other = stage.read("other")
    assert (other[~due] == -1.0).all() and other[due].min() >= 0.0 and len(np.unique(other[due])) == due.sum()
    np.testing.assert_array_equal(stage.read("steps"), 30)


def test_a_beginning_comes_before_a_command_and_draws_other_numbers(stage):
    stage.write(value=7.0, steps=30)
    stage.reset(SOME)
    np.testing.assert_array_equal(stage.read("steps"), np.where(SOME, 0, 30))
    drawn = stage.read("other").copy()
    stage.write(value=7.0)
    stage.reset(~SOME)
    assert (stage.read("other") != drawn).all()


def test_a_task_without_drawn_commands_begins_alike():
    task = probe_task()
    stage = Stage(
        task=dataclasses.replace(task, command=dataclasses.replace(task.command, resample_due=None, resample=None))
    )
    stage.write(value=7.0, other=-1.0)
    stage.reset(SOME)
    np.testing.assert_array_equal(stage.read("other") == -1.0, ~SOME)


def test_a_command_from_outside_begins_an_episode_with_its_heading(stage):
    stage.write(value=1.5, steps=9, other=3.0)
    stage.episodes.diverged.fill_(1)
    values, headings = np.arange(4.0 * N).reshape(N, 4), np.linspace(-3.0, 3.0, N).astype(np.float32)
    stage.give(SOME, 1, values, headings)
    np.testing.assert_array_equal(stage.read("value"), np.where(SOME, values[:, 0], 1.5))
    np.testing.assert_array_equal(stage.read("other"), np.where(SOME, headings, 3.0))
    np.testing.assert_array_equal(stage.read("steps"), np.where(SOME, 0, 9))
    np.testing.assert_array_equal(stage.world("history_reset"), SOME)
    np.testing.assert_array_equal(stage.world("diverged"), ~SOME)


def test_a_command_from_outside_within_an_episode_comes_in_the_robots_heading(stage):
    stage.scramble()
    stage.write(value=1.5, steps=9, other=3.0)
    yaw = Rotation.from_quat(stage.robot.joint_q.numpy().reshape(N, 43)[:, 3:7]).apply([1.0, 0.0, 0.0])
    stage.give(SOME, 0, np.full((N, 4), 4.25), np.full(N, 99.0))
    np.testing.assert_array_equal(stage.read("value"), np.where(SOME, 4.25, 1.5))
    expected = np.where(SOME, np.arctan2(yaw[:, 1], yaw[:, 0]), 3.0)
    np.testing.assert_allclose(stage.read("other"), expected, atol=1e-5)
    assert (stage.read("steps") == 9).all()
    np.testing.assert_array_equal(stage.world("history_reset"), np.where(SOME, COMMANDED, 0))


def test_a_command_before_the_first_step_leaves_a_beginning_one(stage):
    stage.episodes.history_reset.fill_(BEGUN)
    stage.give(SOME, 0, np.zeros((N, 4)), np.zeros(N))
    assert (stage.world("history_reset") == BEGUN).all()


def test_robots_stand_up_with_their_headings_on_the_block_below_them_at_its_start():
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
    stage.stand(SOME, headings)
    after = values_of(stage.robot, RobotArrays)
    unchanged(before, after, ~SOME)
    q = after.joint_q.reshape(N, 43)[SOME]
    reference = stage.scene.reference_q.numpy().reshape(N, 43)[SOME]
    np.testing.assert_array_equal(q[:, 7:], reference[:, 7:])
    np.testing.assert_allclose(q[:, :2], reference[:, :2])
    np.testing.assert_allclose(q[:, 2], reference[:, 2] + records["height"][0], atol=1e-6)
    np.testing.assert_allclose(Rotation.from_quat(q[:, 3:7]).as_euler("ZYX")[:, 0], headings[SOME], atol=1e-6)
    assert not after.joint_qd.reshape(N, 38)[SOME].any()
    center = stage.scene.ground.blocks.numpy()["center"]
    np.testing.assert_array_equal(center, np.where(SOME[:, None], records["start"], [3.0, 4.0]))


def test_the_clock_goes_on_in_the_masked_worlds(stage):
    step_count = stage.world("step_count")
    wp.launch(advance_rng_kernel, N, [stage.mask(SOME), stage.episodes], device="cpu")
    np.testing.assert_array_equal(stage.world("step_count"), step_count + SOME)


def test_forgetting_touches_the_masked_worlds_only(stage):
    stage.scramble()
    before = values_of(stage.robot, RobotArrays), values_of(stage.delays, Delays)
    stage.forget(SOME)
    after = values_of(stage.robot, RobotArrays), values_of(stage.delays, Delays)
    for old, new in zip(before, after, strict=True):
        unchanged(old, new, ~SOME)
    unchanged(before[0], after[0], SOME, but=FORGOTTEN)


ZERO = ("torque", "prev_torque", "action", "prev_action", "prev_prev_action", "impulse", "paw_force", "peak_force",
        "contact_time", "air_time", "touchdown_speed", "paw_height", "diverged", "collisions")  # fmt: skip
FORGOTTEN = (*ZERO, "target", "filtered_target", "prev_rate", "prev_lin_vel", "paw_pos", "paw_vel")


def test_nothing_has_been_done_felt_or_touched_before_a_beginning(stage):
    stage.scramble()
    stage.forget(SOME)
    found = values_of(stage.robot, RobotArrays)
    for name in ZERO:
        assert not rows(getattr(found, name))[SOME].any(), name
        assert rows(getattr(found, name))[~SOME].all(), name
    q, qd = found.joint_q.reshape(N, 43), found.joint_qd.reshape(N, 38)
    angles = q[:, 7 + MOTOR_SLOTS][SOME]
    for name in ("target", "filtered_target"):
        np.testing.assert_array_equal(rows(getattr(found, name))[SOME], angles, name)
    np.testing.assert_array_equal(rows(found.prev_rate)[SOME], qd[:, 6 + MOTOR_SLOTS][SOME])
    past = stage.delays.target_history.numpy()
    np.testing.assert_array_equal(past[:, :, SOME], np.tile(angles.T, (8, 1, 1)))
    origin = qd[:, :3] - np.cross(qd[:, 3:6], Rotation.from_quat(q[:, 3:7]).apply([0.01, -0.02, 0.03]))
    np.testing.assert_allclose(found.prev_lin_vel[SOME], origin[SOME], atol=1e-5)


def test_paws_are_known_where_they_are_at_a_beginning():
    """As the stage that follows paws finds them in the same state."""
    stage = Stage()
    stage.scramble()
    stage.forget(SOME)
    place, speed = (getattr(stage.robot, name).numpy().copy() for name in ("paw_pos", "paw_vel"))
    inputs = [stage.scene.geometry, stage.scene.ground, stage.settings, stage.episodes, stage.robot]
    wp.launch(track_kernel, (4, N), inputs, device="cpu")
    for before, after in ((place, stage.robot.paw_pos.numpy()), (speed, stage.robot.paw_vel.numpy())):
        np.testing.assert_array_equal(before[:, SOME], after[:, SOME])
        assert (before[:, ~SOME] != after[:, ~SOME]).all()


def test_motors_hold_still_after_a_beginning_however_late_they_are(stage):
    write(stage.delays.target_history, slice(None), 9.0)
    stage.forget(1.0)
    angles = stage.robot.joint_q.numpy().reshape(N, 43)[:, 7 + MOTOR_SLOTS]
    assert (stage.delays.target_history.numpy() == angles.T).all()
