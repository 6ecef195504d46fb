import dataclasses

import numpy as np
import pytest
import torch

from hold_height import hold_height
from jump_helpers import edit_episodes, make_env, random_actions, resetting
from jumper_warp.envs.env import Env
from jumper_warp.envs.state import nominal_fingerprint
from jumper_warp.registry import make_task
from jumper_warp.rl.cfg import PpoCfg, TrainCfg
from jumper_warp.rl.checkpoint import load_checkpoint
from jumper_warp.rl.runner import CHECKPOINTS, train
from jumper_warp.robot.motors import jumping_motors
from jumper_warp.tasks.jump.cfg import GroundCfg
from jumper_warp.tasks.randomization import RandomizationCfg
from toy_task import equal
from velocity_helpers import edit

N = 16
PPO = PpoCfg(num_steps=8, hidden=(32, 32), minibatches=4)
ALL_ON = {"randomize": True, "noise": True}


class Recorded(Env):
    """Environment that stores the rewards of all steps and the last metrics."""

    def step(self, action):
        result = super().step(action)
        self.rewards = [*getattr(self, "rewards", []), self.reward.clone()]
        return result

    def metrics(self):
        self.logged = super().metrics()
        return self.logged


def train_jump(cfg):
    """Train on the randomised vertical jump; return the environment and the last checkpoint."""
    made = []

    def make(num_envs, seed, device):
        made.append(Recorded(make_task("vertical-jump"), num_envs, seed=seed, device="cpu"))
        return made[-1]

    result = train(cfg, make)
    return made[0], load_checkpoint(result.folder / CHECKPOINTS / f"iteration_{result.iteration:06d}.pt")


@pytest.fixture
def cfg(tmp_path):
    """Return the settings of a training of four iterations with two checkpoints."""
    return TrainCfg(
        task="jump", num_envs=N, max_iterations=4, device="cpu", log_root=tmp_path, log_interval=4, save_interval=2,
        tensorboard=False, ppo=PPO,
    )  # fmt: skip


def test_a_resumed_training_continues_bitwise(cfg):
    whole, expected = train_jump(cfg)
    assert sum(state.sum() for state in whole.rewards) > 0.0
    (path,) = cfg.log_root.glob("jump/*/checkpoints/iteration_000002.pt")
    torch.manual_seed(12345)
    resumed, found = train_jump(dataclasses.replace(cfg, resume=str(path)))
    assert len(resumed.rewards) == 16 and len(whole.rewards) == 32
    assert all(torch.equal(a, b) for a, b in zip(resumed.rewards, whole.rewards[16:], strict=True))
    np.testing.assert_array_equal(resumed.sim.joint_q(), whole.sim.joint_q())
    np.testing.assert_array_equal(resumed.sim.joint_qd(), whole.sim.joint_qd())
    assert torch.equal(resumed.obs, whole.obs)
    assert resumed.logged == whole.logged and whole.logged["Episode_Reward/action_rate"] < 0.0
    for part in ("ppo", "env", "rng"):
        assert equal(found[part], expected[part]), part


def test_trainings_are_bitwise_equal_for_equal_seeds_only(cfg):
    cfg = dataclasses.replace(cfg, max_iterations=3)
    first, again, other = (train_jump(dataclasses.replace(cfg, seed=seed)) for seed in (1, 1, 2))
    assert all(torch.equal(a, b) for a, b in zip(first[0].rewards, again[0].rewards, strict=True))
    assert equal(first[1]["ppo"], again[1]["ppo"]) and equal(first[1]["env"], again[1]["env"])
    assert not torch.equal(first[0].obs, other[0].obs)
    weights = [state["ppo"]["model"]["actor.0.weight"] for _, state in (first, other)]
    assert not torch.equal(*weights)


# ---------------------------------------------------------------- environment


def assert_equal_steps(saved, fresh):
    """Step two environments with the same actions, assert that they stay equal, and yield the index of each step.

    At least one episode must end.
    """
    ended = 0.0
    for step, action in enumerate(random_actions(saved.num_envs, 25, seed=1)):
        for env in (saved, fresh):
            env.step(action)
        for name in ("obs", "critic_obs", "final_obs", "final_critic_obs", "reward", "done", "timeout"):
            assert torch.equal(getattr(saved, name), getattr(fresh, name)), (step, name)
        np.testing.assert_array_equal(saved.sim.joint_qd(), fresh.sim.joint_qd())
        table, expected = (env.sim.dynamics.robot.table.numpy() for env in (fresh, saved))
        np.testing.assert_array_equal(table, expected)
        ended += saved.done.sum().item()
        yield step
    assert (saved.skills[0].states.numpy() == fresh.skills[0].states.numpy()).all()
    assert 0.0 < ended


@pytest.mark.parametrize("solver", ["jumper", "mujoco"])
def test_an_environment_continues_bitwise_from_a_saved_state(solver):
    count = 8 if solver == "mujoco" else N
    saved, fresh = (make_env(count, seed=1, solver=solver, **ALL_ON) for _ in range(2))
    for action in random_actions(count, 5):
        saved.step(action)
    edit_episodes(saved, level=np.arange(count) % 4, streak=np.arange(count) % 5, phase=2, phase_steps=58)
    for action in random_actions(count, 2):
        saved.step(action)  # some episodes end, so that counters are not 0
    fresh.load_state_dict(saved.state_dict())
    assert len(list(assert_equal_steps(saved, fresh))) == 25
    assert fresh.metrics() == saved.metrics()


def test_a_loaded_evaluation_resets_no_world():
    saved, fresh = (make_env(N, seed=1, **ALL_ON) for _ in range(2))
    saved.evaluation_reset([0.0, 0.0, 0.8])
    edit_episodes(saved, phase=2, phase_steps=58)
    fresh.load_state_dict(saved.state_dict())
    for action in random_actions(N, 20):
        for env in (saved, fresh):
            env.step(action)
        np.testing.assert_array_equal(fresh.sim.joint_q(), saved.sim.joint_q())
    assert saved.done.any()


def ground_env(count=N, platform=0.4, block=0.6, **arguments):
    """Return an environment with far goals, whose starts have a platform or a block where there is room."""
    task = make_task("horizontal-jump")
    ground = dataclasses.replace(task.reset.settings, ground=GroundCfg(platform=platform, block=block))
    task = resetting(dataclasses.replace(task, levels=task.levels[-1:]), ground)
    return make_env(count, task=task, **({"seed": 1} | ALL_ON | arguments))


def test_an_environment_continues_bitwise_with_sampled_ground():
    saved, fresh = ground_env(), ground_env()
    for action in random_actions(N, 5):
        saved.step(action)
    blocks = saved.sim.dynamics.robot.ground.blocks
    sliding = blocks.numpy().copy()
    assert sliding["exists"].any() and not sliding["exists"].all()
    sliding["velocity"] = 0.3 * sliding["exists"][:, None]
    blocks.assign(sliding)
    fresh.load_state_dict(saved.state_dict())
    for step in assert_equal_steps(saved, fresh):
        found, expected = (env.sim.dynamics.robot.ground.blocks.numpy() for env in (fresh, saved))
        assert (found == expected).all(), step
        if step == 0:
            moved = np.abs(expected["center"] - sliding["center"]).max(axis=1)
            assert (moved[(sliding["exists"] == 1) & (sliding["mass"] < 1.0e3)] > 1e-3).any()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"num_envs": 4}, "saved with num_envs 2, this environment has 4"),
        ({"seed": 9}, "saved with seed 1, this environment has seed 9"),
        ({"randomize": False}, "saved with randomize True, this environment has randomize False"),
        ({"noise": True}, "saved with noise False, this environment has noise True"),
        ({"refine": 2}, "saved with substeps 8, this environment has substeps 16"),
        ({"task": dataclasses.replace(make_task("vertical-jump"), motors=jumping_motors(12.0))}, "with other robots"),
    ],
)
def test_refuses_a_state_of_another_environment_without_changes(change, message):
    state = make_env(2, seed=1, randomize=True).state_dict()
    arguments = {"num_envs": 2, "seed": 1, "randomize": True} | change
    env = make_env(arguments.pop("num_envs"), **arguments)
    before = env.state_dict()
    with pytest.raises(ValueError, match=message) as caught:
        env.load_state_dict(state)
    assert "\n" not in str(caught.value)
    assert equal(env.state_dict(), before)


def test_every_randomised_parameter_is_restored_and_is_not_in_the_fingerprint():
    """A changed parameter changes the state; loading restores it, in the solver too."""
    env = make_env(2)
    whole = env.state_dict()
    model, motors, parameters = env.sim.model, env.sim.motors, env.parameters
    arrays = (
        model.body_mass, model.body_com, model.body_inertia, model.joint_armature, model.joint_friction,
        model.shape_material_mu, motors.kp, motors.kd, motors.saturation, motors.no_load_speed, motors.cutoff_speed,
        motors.offset, parameters.push, parameters.static_ratio, parameters.latency, parameters.observation_latency,
        parameters.gain_ratio, parameters.speed_ratio, parameters.torque_ratio,
    )  # fmt: skip
    table = env.sim.dynamics.robot.table.numpy().copy()
    for array in arrays:
        values = array.numpy().copy()
        array.assign(values + 1)
        env.sim.dynamics.parameters_changed()
        assert not equal(env.state_dict(), whole)
        assert torch.equal(nominal_fingerprint(env), whole["nominal"])
        env.load_state_dict(whole)
        np.testing.assert_array_equal(array.numpy(), values)
        np.testing.assert_array_equal(env.sim.dynamics.robot.table.numpy(), table)


def test_an_environment_continues_bitwise_with_observation_latency_and_history():
    """Latencies, histories and intermittent pushes are sampled again at every reset."""
    saved, fresh = (Env(hold_height(), N, seed=1, device="cpu") for _ in range(2))
    saved.reset()
    states = saved.skills[0].states
    edit(saved, steps=120 - np.linspace(10, 62, N))  # some episodes end before saving, the others afterwards
    drawn = []
    for action in random_actions(N, 37):
        saved.step(action)
        drawn.append(saved.parameters.observation_latency.numpy().copy())
    assert len(np.unique(drawn, axis=0)) > 4 and 0 < states.numpy()["steps"].min()
    fresh.load_state_dict(saved.state_dict())
    for name in ("obs", "critic_obs"):
        assert torch.equal(getattr(saved, name), getattr(fresh, name))
    assert len(list(assert_equal_steps(saved, fresh))) == 25


def test_loading_restores_changed_parameters_and_resets_the_others_to_the_task():
    env, other = (make_env(4, **settings) for settings in ({}, {"task": make_task("vertical-jump").with_terms(
        "rewards", orientation={"weight": 3.5})}))  # fmt: skip
    env.skills[0].set("rewards", "jump_height", weight=7.0, std_fine=0.2)
    state = env.state_dict()
    other.skills[0].set("rewards", "jump_height", std_wide=0.9)
    other.load_state_dict(state)
    numbers, params = other.skills[0].params.values.numpy(), other.skills[0].task.params
    expected = np.array(params.values, dtype=np.float32)
    for key, value in (("weight", 7.0), ("std_fine", 0.2)):
        expected[params.index(f"rewards.jump_height.{key}")] = value
    np.testing.assert_array_equal(numbers, expected)
    before, clip = other.state_dict(), other.skills[0].task.params.index("observations.actor.gravity.clip")
    for index, number, message in ((clip, -5.0, "clip must be in"), (0, np.nan, "must be a finite number")):
        state["vertical-jump/changed"][index] = number
        with pytest.raises(ValueError, match=message):
            other.load_state_dict(state)
        assert equal(other.state_dict(), before)


def test_a_state_saved_without_a_reset_starts_like_a_new_environment():
    task = dataclasses.replace(make_task("vertical-jump"), randomization=RandomizationCfg(resample_at="startup"))
    saved, fresh = (Env(task, 2, seed=1, device="cpu") for _ in range(2))
    fresh.load_state_dict(saved.state_dict())
    with pytest.raises(RuntimeError, match="call reset before the first step"):
        fresh.step(torch.zeros((2, 12)))
    for env in (saved, fresh):
        env.reset()
    assert equal(saved.state_dict(), fresh.state_dict())
    assert len(set(fresh.sim.motors.kp.numpy().ravel())) == 24
