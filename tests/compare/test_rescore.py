from dataclasses import replace

import numpy as np
import pytest
import warp as wp

from closed_pipe import closed_pipe
from jumper_warp import mdp
from jumper_warp.cli.main import main
from jumper_warp.compare.rescore import rescore
from jumper_warp.compare.tasks import base_of, task_of
from jumper_warp.registry import make_task
from jumper_warp.robot.overlay import load_overlay
from jumper_warp.utils.errors import InputError
from recordings import record_jumps

TASK_FILE = """
from dataclasses import replace
from jumper_warp import make_task
from jumper_warp.registry import register_task


def {name}():
    task = make_task("vertical-jump")
    return replace(task, name="{name}", rewards=(task.rewards[0].replace(weight=80.0), *task.rewards[1:]))


register_task("{name}", {name})
"""


@wp.func
def height_reward(robot: mdp.RobotView, state: mdp.JumpState) -> float:
    return robot.pos[2]


@pytest.fixture(scope="module")
def recording():
    """Return a recording of two robots that fall, since their actions are random."""
    return record_jumps([0.9, 0.9], 90, [0, 1]).recording()


def with_reward(*terms):
    task = make_task("vertical-jump")
    return replace(task, rewards=(*task.rewards, *terms))


def test_a_new_reward_is_paid_for_the_recorded_states_until_the_episode_ends(recording):
    task = with_reward(mdp.RewardTerm(height_reward, weight=60.0))
    result = rescore(recording, task, make_task("vertical-jump"))
    heights = np.stack([recording.body_poses(rank)[:, 0, 2] for rank in (0, 1)], axis=1)
    expected = np.where(result.running, heights, 0.0)  # 60 * height / 60 a step
    np.testing.assert_allclose(result.terms["height_reward"], expected, rtol=1e-5, atol=1e-6)
    assert not result.running.all()
    assert result.changed == ["total", "height_reward"]


def test_the_rewards_are_those_of_the_recorded_robot():
    paid = []
    settings = {"robot": load_overlay("small_direct_drive"), "auto_reset": False}
    pay = lambda env: paid.append(sum(values.numpy() for values in env.reward_terms.values()))  # noqa: E731
    recorder = record_jumps([0.9], 5, [0], pay, **settings)
    task = make_task("vertical-jump")
    result = rescore(recorder.recording(), task, task)
    np.testing.assert_allclose(result.values("total"), paid, rtol=1e-4)


def test_the_table_and_the_lanes_have_the_sums_of_task_and_base(recording, tmp_path):
    result = rescore(recording, with_reward(mdp.RewardTerm(height_reward, weight=60.0)), make_task("vertical-jump"))
    rows = {row.term: row for row in result.table}
    total, new = rows["total"], rows["height_reward"]
    assert new.base is None
    assert total.task == pytest.approx(total.base + new.task, rel=1e-5)
    lanes = result.with_lanes().series
    np.testing.assert_allclose(lanes["rewards/height_reward, 0.90 m, jump 1 [1]"], result.terms["height_reward"][:, 0])
    result.plot(tmp_path / "rewards.png")
    assert (tmp_path / "rewards.png").stat().st_size > 10_000


def test_the_base_of_a_file_of_one_task_is_the_most_similar_task(tmp_path):
    path = tmp_path / "rescored_height.py"
    path.write_text(TASK_FILE.format(name="rescored_height"))
    task = task_of(str(path))
    assert task.name == "rescored_height"
    assert base_of(task) == "vertical-jump"
    path = tmp_path / "no_task_at_all.py"
    path.write_text("")
    with pytest.raises(InputError, match="registers no task"):
        task_of(str(path))


def test_the_command_rescores_the_recording_of_a_policy_although_its_reader_closes_the_pipe(tmp_path):
    path = tmp_path / "rescored_twice.py"
    path.write_text(TASK_FILE.format(name="rescored_twice"))
    main(["play", "vertical_jump", "--height", "0.8", "--out", str(tmp_path / "play"), "--device", "cpu"])
    with closed_pipe():
        main(["rescore", str(tmp_path / "play/jump.rrd"), "--task", str(path), "--out", str(tmp_path / "out")])
    names = {file.name for file in (tmp_path / "out").iterdir()}
    assert {"rewards.png", "jump.rrd", "jump.npz", "metrics.json"} <= names


@pytest.mark.parametrize(
    ("key", "change", "message"),
    [
        ("robot.joint_q", lambda values: values * np.nan, r"the recorded robot\.joint_q is not finite"),
        ("robot.joint_qd", None, "no complete states"),
        ("robot.joint_q", lambda values: np.repeat(values, 2, axis=2), "the recorded states are of another shape"),
    ],
)
def test_damaged_states_are_refused(recording, key, change, message):
    motion = {name: values for name, values in recording.motion.items() if name != key}
    motion |= {key: change(recording.motion[key])} if change else {}
    task = make_task("vertical-jump")
    with pytest.raises(InputError, match=message):
        rescore(replace(recording, motion=motion), task, task)
