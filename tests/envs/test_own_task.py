"""User-defined task `hold_height`: training, its state and terms, and loading its saved configuration with its file."""

import importlib.util
import sys
from pathlib import Path

import numpy as np
import torch

import hold_height
from columns import Z
from jumper_warp.envs.env import Env
from jumper_warp.rl.cfg import PpoCfg
from jumper_warp.rl.torch.ppo import Ppo
from velocity_helpers import edit

ROOT = Path(__file__).parents[2]
FILE = ROOT / "tests/helpers/hold_height.py"
N = 8
PPO = PpoCfg(num_steps=12, epochs=4, minibatches=4, hidden=(32,), lr=2e-3, desired_kl=0.0, init_std=0.5, gamma=0.9)


def make_env(num_envs=N, task=None, **arguments) -> Env:
    """Return a reset environment, by default of the task `hold_height`; arguments: of `Env`."""
    env = Env(task or hold_height.hold_height(), num_envs, **({"seed": 1, "device": "cpu"} | arguments))
    env.reset()
    return env


def states_of(env) -> np.ndarray:
    """Return a copy of the task states of all worlds, a structured array."""
    return env.skills[0].states.numpy().copy()


# ---------------------------------------------------------------- training and terms


def mean_error(env, ppo) -> float:
    """Return the mean height error [m] of the policy without exploration, later than 0.25 s after each command."""
    env.reset()
    errors = []
    with torch.no_grad():
        for _ in range(110):
            env.step(ppo.model.actor(ppo.model.features(env.obs)))
            states = env.skills[0].states.numpy()
            is_late = states["age"] >= 15
            errors.append(np.abs(env.sim.joint_q()[:, Z] - states["goal"])[is_late])
    return float(np.concatenate(errors).mean())


def test_training_halves_the_height_error(one_thread):
    """The training has 123,000 randomised steps.

    Errors with seeds 1 to 3: 5.5 to 2.0 cm, 5.5 to 1.9 and 5.4 to 1.7; with a learning rate of 1e-6 above 5.0.
    """
    torch.manual_seed(1)
    env = make_env(128)
    ppo = Ppo(env, PPO)
    before = mean_error(env, ppo)
    env.reset()
    for _ in range(80):
        ppo.collect()
        ppo.update()
    assert mean_error(env, ppo) < 0.5 * before


def test_a_task_defined_again_has_kernels_for_its_new_structs():
    for _ in range(2):  # as a notebook's cell that runs again
        spec = importlib.util.spec_from_file_location("task_defined_again", FILE)
        module = importlib.util.module_from_spec(spec)
        sys.modules["task_defined_again"] = module
        spec.loader.exec_module(module)
        env = make_env(2, module.hold_height())
        env.evaluation_reset([0.3])
        env.step(torch.zeros(2, 12))
        assert list(states_of(env)["steps"]) == [1, 1]


def test_user_defined_state_settings_and_levels_are_used():
    env = make_env(64)
    states = states_of(env)
    assert set(states["lasts"]) == {30} and not states["steps"].any()
    assert states["goal"].min() < 0.25 and states["goal"].max() > 0.39
    assert ((states["goal"] >= 0.22) & (states["goal"] <= 0.42)).all()
    for _ in range(30):
        env.step(torch.zeros((64, 12)))
    found = states_of(env)
    is_running = env.done.numpy() == 0.0
    assert is_running.sum() > 32 and (found["steps"][is_running] == 30).all()
    assert not found["age"][is_running].any()  # a new command
    assert (found["goal"] != states["goal"])[is_running].all()
    env.episodes.level.fill_(1)
    env.reset()
    assert states_of(env)["goal"].min() < 0.22


def test_a_command_reaches_reward_and_observation():
    env = make_env(randomize=False, noise=False)
    height = env.sim.joint_q()[:, Z].copy()
    goals = np.linspace(0.25, 0.4, N)[:, None].astype(np.float32)
    chosen = np.arange(N) % 2 == 0
    env.command(goals, chosen)
    assert (states_of(env)["goal"] == goals[:, 0]).tolist() == chosen.tolist()
    env.evaluation_reset(goals)
    np.testing.assert_allclose(env.obs[:, 0], 5.0 * goals[:, 0], rtol=1e-6)
    np.testing.assert_allclose(env.obs[:, 1:4], np.tile(5.0 * height[0], (N, 3)), rtol=1e-5)  # history: first frame
    env.step(torch.zeros((N, 12)))
    height = env.sim.joint_q()[:, Z]
    np.testing.assert_allclose(env.reward, np.exp(-np.abs(height - goals[:, 0]) / 0.05), rtol=1e-4)
    np.testing.assert_allclose(env.obs[:, 3], 5.0 * height, rtol=1e-5)
    assert (states_of(env)["goal"] == goals[:, 0]).all() and (env.obs[:, 1:3] == env.obs[0, 1]).all()


def test_user_defined_terminations_and_curriculum_are_used():
    env = make_env(randomize=False, noise=False)
    goal = states_of(env)["goal"]
    height = env.sim.joint_q()[0, 2]
    edit(env, 0, near=99, goal=height)
    edit(env, 1, steps=119, goal=height + 0.2)
    env.episodes.streak.fill_(1)
    env.step(torch.zeros((N, 12)))
    names = [term.name for term in env.task.terminations]
    assert [names[i] if i >= 0 else "" for i in env.episodes.termination.numpy()] == ["held", "too_long"] + [""] * (
        N - 2
    )
    assert env.timeout.tolist() == [1.0, 1.0] + [0.0] * (N - 2)
    assert env.episodes.level.numpy().tolist() == [1] + [0] * (N - 1)
    assert env.episodes.streak.numpy().tolist() == [0, 0] + [1] * (N - 2)
    assert (states_of(env)["goal"][2:] == goal[2:]).all()
    assert env.metrics()["Metrics/success"] == 0.5


def test_user_defined_event_is_sampled_at_every_reset_of_a_world():
    task = hold_height.hold_height()
    env = make_env(task=task)
    nominal = np.tile([task.motors.lateral.saturation, *2 * [task.motors.transversal.saturation]], 4)[:, None]
    torques = []
    for _ in range(3):
        torques.append(env.sim.motors.saturation.numpy() / nominal)
        edit(env, 3, steps=119)
        env.step(torch.zeros((N, 12)))
        assert env.done.tolist() == [float(world == 3) for world in range(N)]
    torques = np.array(torques)
    assert 0.8 <= torques.min() < 0.83 and 0.97 < torques.max() <= 1.0
    others = np.arange(N) != 3
    assert (torques[1:, :, others] == torques[:-1, :, others]).all() and (torques[1:, :, 3] != torques[:-1, :, 3]).all()
    assert (make_env(task=task, randomize=False).sim.motors.saturation.numpy() == nominal.astype(np.float32)).all()
