from dataclasses import replace

import numpy as np
import pytest

from hold_height import hold_height
from jump_helpers import random_actions
from jumper_warp.envs.env import Env
from jumper_warp.evaluation.episodes import EpisodeLog
from jumper_warp.evaluation.log import run_evaluation
from jumper_warp.evaluation.motion import set_motion
from jumper_warp.evaluation.recorder import EnvRecorder, ankles
from jumper_warp.registry import make_task
from jumper_warp.robot.grounds import platform
from jumper_warp.robot.model import build_model
from jumper_warp.viz.props import BAR_OFFSET, RING_RADIUS, goal_shapes, with_blocks
from jumper_warp.viz.recording import Recording, load_npz
from jumper_warp.viz.shapes import shape_meshes
from recordings import record_jumps


def recording(frames=3, worlds=2, spacing=2.0):
    """Return a recording with one body per world at the origin; spacing [m]: between worlds along y."""
    return Recording(
        times=np.arange(1, frames + 1) / 60.0,
        worlds=tuple(range(worlds)),
        bodies=tuple(f"world_{world}/body" for world in range(worlds)),
        poses=np.zeros((frames, worlds, 7), dtype=np.float32),
        series={},
        contact_points=np.zeros((frames, worlds, 0, 3), dtype=np.float32),
        contact_forces=np.zeros((frames, worlds, 0, 3), dtype=np.float32),
        spacing=spacing,
    )


def test_ankle_positions_follow_shank_poses():
    poses = np.zeros((1, 21, 7))
    poses[..., 6] = 1.0
    poses[0, 5, 2] = 1.0  # [m] FL shank is link 5, FR shank link 10; the ankle is 0.3 m below the shank's origin
    poses[0, 10] = [0.0, 0.0, 1.0, 0.0, np.sqrt(0.5), 0.0, np.sqrt(0.5)]  # 90° about y: z points to x
    points = ankles(poses)
    assert points.shape == (1, 4, 3)
    assert points[0, 0] == pytest.approx([0.0, 0.0, 0.7])
    assert points[0, 1] == pytest.approx([-0.3, 0.0, 1.0])


def test_paw_forces_are_peaks_between_the_frames():
    sampled_last = []
    recorder = record_jumps([0.9], 30, [0], lambda env: sampled_last.append(env.sim.paw_force.numpy()[:, 0].T.copy()))
    shown = recorder.recording()
    sampled = np.linalg.norm(shown.contact_forces[:, 0], axis=2)
    peaks = np.stack([shown.series[f"peak paw force/{leg} [N]"] for leg in ("FL", "FR", "BL", "BR")], axis=1)
    np.testing.assert_allclose(sampled, peaks, rtol=1e-5, atol=1e-3)  # [N] the arrows of the viewer
    last = np.linalg.norm(np.array(sampled_last), axis=1)
    assert (peaks >= last - 1e-3).all()
    assert (peaks > 2.0 * last + 50.0).any()  # [N] an impact is over before the frame
    assert shown.labels == ("0.90 m",) and set(shown.states) == {"phase/0.90 m", "termination/0.90 m"}


def test_series_are_those_of_the_environment():
    env = Env(hold_height(), 2, device="cpu", auto_reset=False)
    log = EpisodeLog(np.array([[0.3], [0.35]]), env.task)
    recorder = EnvRecorder(env, log, [1])
    actions = iter(random_actions(2, 12))
    rows = []

    def on_step():
        recorder()
        view = env.sim.joint_q()[1], env.sim.joint_qd()[1], env.sim.base_velocity()[1]
        rows.append(
            (*(each.copy() for each in view), env.obs[1].numpy().copy(), env.reward_terms["near_goal"][1].item())
        )

    run_evaluation(lambda obs: next(actions), env, log, seconds=0.2, on_step=on_step, stop=False)
    q, qd, velocity, obs, reward = map(np.array, zip(*rows, strict=True))
    series = recorder.recording().series
    np.testing.assert_allclose(series["angle/FR_lateral [rad]"], q[:, 12])
    np.testing.assert_allclose(series["rate/FL_inner [rad/s]"], qd[:, 9])
    np.testing.assert_allclose(series["reward/near_goal [1]"], reward)
    speed = [series[f"base velocity/{name} [m/s]"] for name in ("ahead", "left", "up")]
    np.testing.assert_allclose(np.linalg.norm(speed, axis=0), np.linalg.norm(velocity, axis=1), rtol=1e-5)
    names = list(env.task.observation_names)
    for name, column in (("wanted_height/wanted_height", "wanted_height"), ("height/height", "height"),
                         ("gravity/z", "gravity_z"), ("angle/BR_outer", "angle_BR_outer")):  # fmt: skip
        np.testing.assert_allclose(series[f"observation {name} [1]"], obs[:, names.index(column)])
    (command,) = (values for name, values in series.items() if name.startswith("command/"))
    np.testing.assert_allclose(command, 0.35)


def test_rewards_of_a_recorded_motion_are_those_of_the_simulation(tmp_path):
    """The recording of the second of three worlds, read from its file."""
    rewards = []

    def on_step(env):
        rewards.append({name: float(values[1]) for name, values in env.reward_terms.items()})

    recorder = record_jumps([0.9] * 3, 60, [1], on_step)
    recording = load_npz(recorder.recording().save_npz(tmp_path / "jump.npz"))
    env = Env(make_task("vertical-jump"), 1, device="cpu", randomize=False, noise=False)
    episode = env.stages()["episode"]
    for frame, expected in enumerate(rewards):
        set_motion(env, recording.motion, frame)
        episode()
        assert {name: float(values[0]) for name, values in env.reward_terms.items()} == expected
    assert sum(value != 0.0 for terms in rewards for value in terms.values()) > 300


def test_a_recording_may_begin_at_any_frame():
    recorder = record_jumps([0.9], 6, [0])
    whole = recorder.recording()
    part = recorder.recorder.recording(first=4)
    assert part.times.tolist() == whole.times[4:].tolist()
    assert np.array_equal(part.poses, whole.poses[4:])
    assert all(np.array_equal(part.series[name], values[4:]) for name, values in whole.series.items())
    assert part.states["phase/0.90 m"] == whole.states["phase/0.90 m"][4:]


def test_goals_are_rings_of_the_tolerance_on_the_ground_spaced_by_world():
    places = np.array([[[0.8, 0.2, 0.0], [np.nan, np.nan, 0.0]], [[0.5, 0.0, 0.1], [0.6, 0.0, 0.1]]])
    shapes = goal_shapes(replace(recording(), goals=places))
    assert [shape.name for shape in shapes] == ["goal_0_0", "goal_1_0", "goal_1_1"]
    assert all(shape.body == -1 for shape in shapes)
    for shape, center in zip(shapes, ([0.8, 0.2, 0.0], [0.5, 2.0, 0.1], [0.6, 2.0, 0.1]), strict=True):
        offset = shape.vertices - center
        assert np.linalg.norm(offset[:, :2], axis=1).max() == pytest.approx(RING_RADIUS, rel=1e-5)
        assert np.linalg.norm(offset[:, :2], axis=1).min() > 0.8 * RING_RADIUS
        assert offset[:, 2].min() == pytest.approx(0.0, abs=1e-6)


def test_goal_off_a_platform_and_on_a_block_is_on_the_surface_under_it():
    ground = shape_meshes(build_model(2, ground=platform(-0.15, edge=0.4), device="cpu"), ())
    shown = with_blocks(replace(recording(), shapes=tuple(ground)), np.tile([0.0, -1.0], (3, 2, 1)),
                        np.full((2, 2), 0.4), np.array([0.05, 0.2]))  # fmt: skip
    goals = np.array([[[0.2, 0.0, 0.0], [1.0, 0.1, 0.0]], [[0.1, -1.1, 0.0], [0.3, -1.7, 0.0]]])
    rings = goal_shapes(replace(shown, goals=goals))
    assert [ring.vertices[:, 2].min() for ring in rings] == pytest.approx([0.0, -0.15, 0.2, 0.0], abs=1e-6)


def test_commanded_heights_are_bars_to_the_left_of_the_base_at_its_start():
    jump = recording(worlds=3)
    jump.poses[0, 1, :3] = [0.4, 0.1, 0.35]
    shapes = goal_shapes(replace(jump, heights=np.array([np.nan, 0.9, 0.6])))
    assert [shape.name for shape in shapes] == ["height_1", "height_2"]
    assert shapes[0].vertices.mean(axis=0) == pytest.approx([0.4, 2.1 + BAR_OFFSET, 0.9], abs=1e-6)
    assert np.ptp(shapes[0].vertices, axis=0) == pytest.approx([1.2, 0.012, 0.012], abs=1e-6)


def test_blocks_are_bodies_that_move():
    centers = np.array([[[0.8, 0.0], [1.0, 0.1]], [[0.81, 0.0], [1.0, 0.1]], [[0.82, 0.0], [1.1, 0.1]]])
    shown = with_blocks(recording(), centers, np.array([[0.4, 0.3], [0.4, 0.3]]), np.array([0.05, 0.1]))
    assert shown.bodies == ("world_0/body", "world_1/body", "world_0/block", "world_1/block")
    assert shown.poses[2, 2] == pytest.approx([0.82, 0.0, 0.025, 0.0, 0.0, 0.0, 1.0])
    assert shown.poses[2, 3] == pytest.approx([1.1, 0.1, 0.05, 0.0, 0.0, 0.0, 1.0])
    assert [shape.body for shape in shown.shapes] == [2, 3]
    assert np.ptp(shown.shapes[1].vertices, axis=0) == pytest.approx([0.8, 0.6, 0.1])
