import numpy as np
import pytest

from jump_helpers import make_env, random_actions
from jumper_warp.envs.env import Env
from jumper_warp.evaluation.jumps import JumpLog
from jumper_warp.evaluation.log import run_evaluation
from jumper_warp.evaluation.motion import set_motion
from jumper_warp.evaluation.recorder import EnvRecorder
from jumper_warp.registry import make_task
from jumper_warp.viz.recording import load_npz

STEPS = 60


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """Return the recording of the second of three worlds, read from its file, and its reward terms of every step."""
    env, log = make_env(3), JumpLog(np.full(3, 0.9), make_task("vertical-jump").termination_names)
    recorder = EnvRecorder(env, log, [1])
    actions = iter(random_actions(3, STEPS))
    rewards = []

    def on_step():
        recorder()
        rewards.append({name: float(values[1]) for name, values in env.reward_terms.items()})

    run_evaluation(
        lambda obs: next(actions), env, log, seconds=STEPS / 60, on_begin=recorder.begin, on_step=on_step, stop=False
    )
    path = recorder.recording().save_npz(tmp_path_factory.mktemp("motion") / "jump.npz")
    return load_npz(path), rewards


def test_rewards_of_a_recorded_motion_are_those_of_the_simulation(recorded):
    recording, rewards = recorded
    env = Env(make_task("vertical-jump"), 1, device="cpu", randomize=False, noise=False)
    episode = env.stages()["episode"]
    for frame, expected in enumerate(rewards):
        set_motion(env, recording.motion, frame)
        episode()
        assert {name: float(values[0]) for name, values in env.reward_terms.items()} == expected
    assert sum(value != 0.0 for terms in rewards for value in terms.values()) > 5 * STEPS
