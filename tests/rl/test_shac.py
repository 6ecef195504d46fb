"""SHAC on the task of a mass on a line: gradient against finite differences, learning, saving and errors."""

import dataclasses

import pytest
import torch

from jumper_warp.rl.cfg import ShacCfg
from jumper_warp.rl.runner import train
from jumper_warp.rl.shac import Shac
from jumper_warp.utils.errors import InputError
from toy_task import SMALL, PushTask, equal, push_cfg

CFG = dataclasses.replace(SMALL, init_std=0.3, num_steps=8)


class SmoothPushTask(PushTask):
    """`PushTask` as a `DifferentiableVecEnv`; `present` (num_envs, 2): position and velocity with gradient."""

    def begin_window(self) -> None:
        """Detach the present state from earlier steps."""
        self.present = self.obs.clone()

    def observe(self):
        """Return the observations of actor (num_envs, 2) and critic (num_envs, 3), with gradient."""
        return self.present, torch.cat([self.present, self.present[:, :1].abs()], 1)

    def observe_final(self):
        """Return the observations after the last step, before a reset, as `observe`."""
        return self.last, torch.cat([self.last, self.last[:, :1].abs()], 1)

    def step_with_gradient(self, action):
        """Step the task with actions (num_envs, 1), and return the rewards (num_envs,) with gradient."""
        velocity = self.present[:, 1] + 0.2 * action[:, 0].clamp(-1.0, 1.0)
        position = self.present[:, 0] + 0.2 * velocity
        reward = torch.exp(-position.square() - 0.1 * velocity.square())
        self.step(action.detach())
        self.last = torch.stack([position, velocity], 1)
        self.present = torch.where(self.done[:, None] > 0.0, self.obs, self.last)
        return reward


def shac(num_envs=32, seed=0, **changes):
    """Return `Shac` on the reset task with episodes of 11 steps, windows of 8; changes: of CFG."""
    torch.manual_seed(seed)
    env = SmoothPushTask(num_envs, episode_length=11)
    env.reset()
    return Shac(env, dataclasses.replace(CFG, **changes), ShacCfg(lr=5.0e-3))


def test_gradient_agrees_with_finite_differences_of_the_loss():
    """The oracle is a central difference along the gradient; episodes end in the window, the critic is trained."""
    algorithm = shac(num_envs=8)
    algorithm.iterate()
    start, noise = algorithm.env.state_dict(), torch.get_rng_state()

    def loss():
        """Return the loss of the same window, from the same state with the same noise."""
        algorithm.env.load_state_dict(start)
        torch.set_rng_state(noise)
        return algorithm.window().loss

    weights = [*algorithm.model.actor.parameters(), algorithm.model.log_std]
    gradients = torch.autograd.grad(loss(), weights)
    norm = torch.stack([gradient.norm() for gradient in gradients]).norm()
    losses = []
    for move in (1.0e-2, -2.0e-2):  # to +1e-2 and -1e-2 along the unit gradient
        with torch.no_grad():
            for weight, gradient in zip(weights, gradients, strict=True):
                weight += move * gradient / norm
            losses.append(float(loss()))
    assert (losses[0] - losses[1]) / 2.0e-2 == pytest.approx(float(norm), rel=0.01)


def test_loss_agrees_with_a_loop_over_worlds():
    """The oracle sums discounted rewards by world; episodes end by timeout and, for a fast mass, by termination."""
    algorithm = shac(num_envs=6, num_steps=14, asymmetric_critic=False)
    env, model, gamma = algorithm.env, algorithm.model, algorithm.cfg.gamma
    env.start[0] = torch.tensor([4.5, 3.0])  # beyond the limit of 5 after one step of each episode
    env.reset()
    with torch.no_grad():
        model.actor[-1].bias += 0.2
    env.begin_window()
    start, noise = env.state_dict(), torch.get_rng_state()
    loss = float(algorithm.window().loss)
    env.load_state_dict(start)
    torch.set_rng_state(noise)
    sums, powers, ends = torch.zeros(6), torch.zeros(6), {"timeout": 0, "terminated": 0}
    with torch.no_grad():
        for step in range(14):
            mean = model.actor(model.features(env.obs))
            env.step(mean + model.log_std.exp() * torch.randn_like(mean))
            after, final = algorithm._target_value(env.obs), algorithm._target_value(env.final_obs)
            for world in range(6):
                sums[world] += gamma ** powers[world] * algorithm.cfg.reward_scale * env.reward[world]
                powers[world] += 1
                if env.done[world] > 0.0:
                    timeout = env.timeout[world] > 0.0
                    sums[world] += gamma ** powers[world] * final[world] if timeout else 0.0
                    powers[world] = 0
                    ends["timeout" if timeout else "terminated"] += 1
                elif step == 13:
                    sums[world] += gamma ** powers[world] * after[world]
    assert min(ends.values()) > 0
    assert loss == pytest.approx(-float(sums.mean()) / 14, rel=1.0e-5)


def test_shac_learns_to_push_the_mass_to_the_origin():
    """The mean distance after ten steps is 1.04 with initial weights and 0.26 after training."""
    algorithm, means = shac(init_std=0.1), []
    for iterations in (0, 60):
        for _ in range(iterations):
            algorithm.iterate()
        algorithm.env.reset()
        for _ in range(10):
            algorithm.env.step(algorithm.model.act(algorithm.env.obs))
        means.append(float(algorithm.env.obs[:, 0].abs().mean()))
    assert means[1] < 0.5 * means[0]


def test_same_seed_gives_the_same_weights_and_a_loaded_state_resumes_bitwise():
    first, second = shac(), shac()
    for algorithm in (first, second):
        torch.manual_seed(3)
        algorithm.iterate()
    assert equal(first.state_dict()["model"], second.state_dict()["model"])
    resumed = shac(seed=9)
    resumed.env.load_state_dict(first.env.state_dict())
    resumed.load_state_dict(first.state_dict())
    for algorithm in (first, resumed):
        torch.manual_seed(4)
        algorithm.iterate()
    assert equal(first.state_dict(), resumed.state_dict())


def test_refuses_a_state_without_learning_rate():
    state = shac().state_dict()
    with pytest.raises(ValueError, match="missing entries: lr"):
        shac().load_state_dict({name: value for name, value in state.items() if name != "lr"})


def test_train_with_shac_runs_resumes_and_refuses_an_env_without_gradients(tmp_path):
    cfg = push_cfg(tmp_path, num_envs=16, max_iterations=3, log_interval=1, trainer="shac", ppo=CFG)
    result = train(cfg, lambda n, seed, device: SmoothPushTask(n, seed, device, episode_length=8))
    assert result.iteration == 3
    assert result.metrics["Train/mean_episode_length"] == 8.0
    resumed = dataclasses.replace(cfg, max_iterations=4, resume=str(result.folder))
    assert train(resumed, lambda n, seed, device: SmoothPushTask(n, seed, device, episode_length=8)).iteration == 4
    with pytest.raises(InputError, match="an environment with gradients"):
        train(cfg, PushTask)
