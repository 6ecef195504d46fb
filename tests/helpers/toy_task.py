"""Toy task that trains in a second: push a mass on a line to the origin."""

import dataclasses
import os
import shutil
import socket
from pathlib import Path

import torch

from jumper_warp.rl.cfg import PpoCfg, TrainCfg
from jumper_warp.rl.distributed import init_distributed
from jumper_warp.rl.runner import CHECKPOINTS, train
from jumper_warp.rl.torch.ppo import Ppo

torch.set_num_threads(1)  # on matrices this small, threads mostly wait for each other
SMALL = PpoCfg(num_steps=16, hidden=(32, 32), minibatches=4)


def push_cfg(folder: Path, **changes) -> TrainCfg:
    """Return the settings of a short training on the task, which logs to a folder."""
    cfg = TrainCfg(
        task="push", num_envs=32, max_iterations=4, device="cpu", log_root=folder, log_interval=2, save_interval=2,
        tensorboard=False, ppo=SMALL,
    )  # fmt: skip
    return dataclasses.replace(cfg, **changes)


class PushTask:
    """A `VecEnv`: position and velocity of each mass are the observation, its acceleration the action.

    The critic sees the distance from the origin too.
    """

    num_obs, num_critic_obs, num_actions = 2, 3, 1
    STATE = ("steps", "obs", "critic_obs", "age")

    def __init__(self, num_envs: int, seed: int = 0, device: torch.device | str = "cpu", episode_length: int = 50):
        self.num_envs, self.seed, self.device = num_envs, seed, torch.device(device)
        self.episode_length = episode_length
        self.obs, self.final_obs = (torch.zeros(num_envs, 2, device=self.device) for _ in range(2))
        self.critic_obs, self.final_critic_obs = (torch.zeros(num_envs, 3, device=self.device) for _ in range(2))
        self.reward, self.done, self.timeout, self.age = (torch.zeros(num_envs, device=self.device) for _ in range(4))
        self.steps = torch.zeros((), device=self.device)
        start = torch.linspace(-1.0, 1.0, num_envs, device=self.device)
        self.start = torch.stack([start, -0.5 * start.flip(0)], dim=1)

    def reset(self) -> None:
        self.obs.copy_(self.start)
        self.age.zero_()
        self.show_critic(self.critic_obs, self.obs)

    def show_critic(self, critic_obs: torch.Tensor, obs: torch.Tensor) -> None:
        """Write the critic's observation: position, velocity, distance."""
        critic_obs.copy_(torch.cat([obs, obs[:, :1].abs()], dim=1))

    def step(self, action: torch.Tensor) -> None:
        velocity = self.obs[:, 1] + 0.2 * action[:, 0].clamp(-1.0, 1.0)
        position = self.obs[:, 0] + 0.2 * velocity
        self.final_obs.copy_(torch.stack([position, velocity], dim=1))
        self.reward.copy_(torch.exp(-position.square() - 0.1 * velocity.square()))
        self.age += 1.0
        self.steps += 1.0
        self.show_critic(self.final_critic_obs, self.final_obs)
        lost = (position.abs() > 5.0).float()
        self.timeout.copy_((self.age >= self.episode_length).float() * (1.0 - lost))
        self.done.copy_(lost + self.timeout)
        ended = self.done[:, None]
        self.obs.copy_(self.final_obs * (1.0 - ended) + self.start * ended)
        self.age *= 1.0 - self.done
        self.show_critic(self.critic_obs, self.obs)

    def mirror(self, what: str, plane: str) -> tuple[list[int], list[float]]:
        """Return the mirror map (order, signs): the image of position, velocity and acceleration is the negative."""
        return ([0, 1], [-1.0, -1.0]) if what == "observation" else ([0], [-1.0])

    def metrics(self) -> dict[str, float]:
        return {"Metrics/success": float(self.obs[:, 0].abs().lt(0.1).float().mean())}

    def config(self) -> dict:
        return {"episode_length": self.episode_length}

    def state_dict(self) -> dict[str, torch.Tensor]:
        """Return copies of the tensors in STATE by name."""
        return {name: getattr(self, name).clone() for name in self.STATE}

    def load_state_dict(self, state: dict[str, torch.Tensor]) -> None:
        for name in self.STATE:
            getattr(self, name).copy_(state[name])


def fill(ppo: Ppo, worlds: slice, num_worlds: int) -> None:
    """Fill a rollout with the part of some made-up experience that belongs to these worlds."""
    rollout, generator = ppo.rollout, torch.Generator().manual_seed(3)

    def draw(*shape: int) -> torch.Tensor:
        return torch.randn(shape[0], num_worlds, *shape[1:], generator=generator)[:, worlds]

    steps = ppo.cfg.num_steps
    rollout.obs.copy_(3.0 + 2.0 * draw(steps + 1, 2))
    rollout.critic_obs.copy_(0.5 * draw(steps + 1, 3) - 1.0)
    rollout.final_critic_obs.copy_(0.5 * draw(steps, 3) - 1.0)
    rollout.reward.copy_(draw(steps))
    rollout.done.copy_((draw(steps) > 1.0).float())
    rollout.timeout.copy_(rollout.done * (draw(steps) > 0.0).float())
    with torch.no_grad():
        rollout.mean.copy_(ppo.model.mean(ppo.model.features(rollout.obs[:-1])))
        rollout.log_std.copy_(ppo.model.log_std)
    rollout.action.copy_(rollout.mean + draw(steps, 1))


def local_order(rank: int, size: int) -> torch.Tensor:
    """Return a process's random order of `size` samples, by its rank as seed."""
    return torch.randperm(size, generator=torch.Generator().manual_seed(rank))


def equal(a, b) -> bool:
    """Return whether two nested dicts and lists have equal tensors and values."""
    if isinstance(a, (dict, list)):
        keys = a.keys() if isinstance(a, dict) else range(len(a))
        return len(a) == len(b) and all(equal(a[key], b[key]) for key in keys)
    return torch.equal(a, b) if isinstance(a, torch.Tensor) else a == b


def free_port() -> int:
    """Return a TCP port of this computer that no process uses."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def join(rank: int, port: int) -> None:
    """Set the environment variables by which a process joins a group of two."""
    os.environ.update(RANK=str(rank), LOCAL_RANK=str(rank), WORLD_SIZE="2", MASTER_ADDR="127.0.0.1")
    os.environ["MASTER_PORT"] = str(port)


def update_half(rank: int, port: int, cfg: PpoCfg, path: str) -> None:
    """Update from half of the worlds in one of two processes, whose clocks differ; save the state to path + rank."""
    join(rank, port)
    init_distributed("cpu")
    torch.manual_seed(0)
    ppo = Ppo(PushTask(4), cfg)
    fill(ppo, slice(4 * rank, 4 * rank + 4), 8)
    ppo.order = lambda: local_order(rank, ppo.batch_size)
    ppo.set_progress(0.6 + 0.2 * rank)
    ppo.update()
    torch.save({"desired_kl": ppo._desired_kl, **ppo.state_dict()}, path + str(rank))
    torch.distributed.destroy_process_group()


def train_twice(rank: int, ports: tuple[int, int], cfg: TrainCfg) -> None:
    """Train in one of two processes, then again from the middle; episodes are longer than an iteration."""

    def make(num_envs: int, seed: int, device: torch.device) -> PushTask:
        return PushTask(num_envs, seed, device, episode_length=20 + 7 * rank)

    join(rank, ports[0])
    train(cfg, make)
    (folder,) = cfg.log_root.glob(f"push/*/{CHECKPOINTS}")
    if rank == 0:
        shutil.copyfile(folder / "iteration_000004.pt", cfg.log_root / "whole.pt")
    join(rank, ports[1])
    train(dataclasses.replace(cfg, resume=str(folder / "iteration_000002.pt")), make)


def train_seeds_rank(rank: int, port: int, cfg: TrainCfg) -> None:
    """Train the seeds of one of two processes."""
    join(rank, port)
    train(cfg, PushTask)
    assert not torch.distributed.is_initialized()
