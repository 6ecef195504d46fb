"""A rollout as samples to learn from: advantages, returns, and one row of memory a sample."""

from __future__ import annotations

from itertools import accumulate
from typing import NamedTuple

import torch

from jumper_warp.envs.vec_env import sanitise
from jumper_warp.rl.cfg import PpoCfg
from jumper_warp.rl.compiling import Compiler
from jumper_warp.rl.flat import ROW_ALIGNMENT, FlatParameters, Layers, aligned
from jumper_warp.rl.mirror import Image
from jumper_warp.rl.networks import ActorCritic, gaussian_log_prob, joint_moments, own_moments
from jumper_warp.rl.passes import DTYPES, forward
from jumper_warp.rl.rollout import Pair, RolloutBuffer, normalised

CPU_ROWS = 4096
"""Samples that a CPU takes at a time, so that what is made of them stays in its caches."""


class Batch(NamedTuple):
    """Samples to learn from; first axis: sample."""

    features: torch.Tensor
    """(batch, num_obs) normalised observations."""
    critic_features: torch.Tensor
    """(batch, num_critic_obs) the critic's, normalised."""
    action: torch.Tensor
    mean: torch.Tensor
    """(batch, num_actions) mean of the policy that acted."""
    log_prob: torch.Tensor
    """(batch,) of the action under that policy."""
    value: torch.Tensor
    """(batch,) the critic's output then."""
    advantage: torch.Tensor
    target: torch.Tensor
    """(batch,) what the critic should have put out."""


class RowLayout(NamedTuple):
    """Which columns of a sample's row hold what; each group of columns begins at a multiple of ROW_ALIGNMENT.

    One row a sample is written once an iteration and gathered once a minibatch.
    """

    num_obs: int
    num_critic_obs: int
    num_actions: int

    @property
    def widths(self) -> tuple[int, int, int]:
        """Columns of both groups of features and of the rest, filled up."""
        obs, critic_obs = aligned(self.num_obs, ROW_ALIGNMENT), aligned(self.num_critic_obs, ROW_ALIGNMENT)
        return obs, critic_obs, aligned(2 * self.num_actions + 4, ROW_ALIGNMENT)

    def features(self, rows: torch.Tensor) -> torch.Tensor:
        """Return the actor's features with the zero columns that its first weight has."""
        return rows[:, : self.widths[0]]

    def critic_features(self, rows: torch.Tensor) -> torch.Tensor:
        """Return the critic's features with the zero columns that its first weight has."""
        return rows[:, self.widths[0] : sum(self.widths[:2])]

    def split(self, rows: torch.Tensor) -> Batch:
        """Return views of rows (batch, columns) as a batch."""
        sizes = (self.num_obs, self.widths[0] - self.num_obs, self.num_critic_obs, self.widths[1] - self.num_critic_obs,
                 self.num_actions, self.num_actions, 1, 1, 1, 1)  # fmt: skip
        starts = list(accumulate(sizes, initial=0))
        parts = [rows[:, first : first + size] for first, size in zip(starts, sizes, strict=False)]
        features, _, critic_features, _, action, mean, *scalars = parts
        return Batch(features, critic_features, action, mean, *(each[:, 0] for each in scalars))

    def pack(self, batch: Batch) -> torch.Tensor:
        """Return a batch as rows (batch, columns)."""
        scalars = torch.stack([batch.log_prob, batch.value, batch.advantage, batch.target], dim=-1)
        groups = ([batch.features], [batch.critic_features], [batch.action, batch.mean, scalars])
        pieces: list[torch.Tensor] = []
        for group, width in zip(groups, self.widths, strict=True):
            pieces += group
            if gap := width - sum(each.shape[1] for each in group):
                pieces.append(scalars.new_zeros(scalars.shape[0], gap))
        return torch.cat(pieces, dim=1)


def gae(
    reward: torch.Tensor, done: torch.Tensor, value: torch.Tensor, gamma: float, lam: float
) -> tuple[torch.Tensor, torch.Tensor]:
    """Generalised advantage estimation (Schulman et al. 2016, eq. 16).

    The recurrence A[t] = δ[t] + w[t] A[t+1] is solved by doubling: log2(steps) passes over all steps at once.

    Return advantages and returns, each (steps, num_envs). reward: (steps, num_envs), with the bootstrap of timeouts
    already in it. done: (steps, num_envs), 1 where nothing follows. value: (steps + 1, num_envs) expected return before
    each step and after the last. gamma: discount per step. lam: weight of longer estimates.
    """
    alive = 1.0 - done
    advantage = reward + gamma * alive * value[1:] - value[:-1]
    weight = gamma * lam * alive
    reach = 1  # advantage[t] holds δ[t] .. δ[t + reach - 1], weight[t] is the product of their weights
    while reach < reward.shape[0]:
        longer = torch.addcmul(advantage[:-reach], weight[:-reach], advantage[reach:])
        advantage = torch.cat([longer, advantage[-reach:]])
        weight = torch.cat([weight[:-reach] * weight[reach:], weight[-reach:]])
        reach *= 2
    return advantage, advantage + value[:-1]


class Sampler:
    """Turns a rollout into rows to learn from."""

    def __init__(
        self, rollout: RolloutBuffer, cfg: PpoCfg, model: ActorCritic, flat: FlatParameters, compiler: Compiler,
        obs_image: Image | None = None,
    ) -> None:  # fmt: skip
        """flat: the parameters of `model`; obs_image: of observations whose statistics are to be symmetric."""
        self._obs_image = obs_image
        self._rollout, self._cfg, self._model, self._critic = rollout, cfg, model, flat.critic()
        steps, worlds, num_actions = rollout.action.shape
        self.layout = RowLayout(rollout.obs.shape[2], rollout.critic_obs.shape[2], num_actions)
        self.rows = rollout.obs.new_zeros(steps * worlds, sum(self.layout.widths))
        """(steps · worlds, columns of `layout`), time-major."""
        self.old_log_std = torch.zeros_like(rollout.log_std)
        """Of the policy that acted."""
        self._rows = CPU_ROWS if self.rows.device.type == "cpu" else None
        self._estimate, self._pack = compiler(_estimate), compiler(_pack)

    @torch.no_grad()
    def pack(self) -> None:
        """Write the rollout to `rows` and take it into the running statistics."""
        model = self._model
        scalings = self._scalings()  # with which actor and critic acted
        estimates, own = self._estimates(scalings[1])
        of_advantage, of_target, of_obs, of_critic_obs = joint_moments(own, self.rows.shape[0])
        if self._obs_image is not None:
            of_obs = (*self._obs_image.moments(*of_obs[:2]), of_obs[2])
        model.obs_moments.take(of_obs)
        model.critic_moments.take(of_critic_obs)
        if self._cfg.normalise_value:
            model.value_moments.take(of_target)
        mean, var, count = of_advantage
        self._write(scalings, estimates, (mean.float(), ((var * count / (count - 1)).sqrt() + 1.0e-8).float()))
        self.old_log_std.copy_(self._rollout.log_std)

    @torch.no_grad()
    def rehearse(self) -> None:
        """Compile, as if a rollout were packed; spoils `rows`."""
        scalings = self._scalings()
        self._write(scalings, self._estimates(scalings[1])[0], self._model.value_moments.scaling())

    def _scalings(self) -> tuple[Pair, Pair]:
        return self._model.obs_moments.scaling(), self._model.critic_moments.scaling()

    def _estimates(self, critic_scaling: Pair) -> tuple[tuple[torch.Tensor, ...], list[Pair]]:
        rollout, of_value = self._rollout, self._model.value_moments.scaling()
        experience = (rollout.critic_obs, rollout.final_critic_obs, rollout.reward, rollout.done, rollout.timeout)
        return self._estimate(experience, rollout.obs, self._critic, critic_scaling, of_value, self._cfg, self._rows)

    def _write(self, scalings: tuple[Pair, Pair], estimates: tuple[torch.Tensor, ...], advantage_scaling: Pair) -> None:
        rollout = self._rollout
        acted = (rollout.obs, rollout.critic_obs, rollout.action, rollout.mean, rollout.log_std)
        target_scaling = self._model.value_moments.scaling() if self._cfg.normalise_value else None
        self._pack(self.rows, self.layout, acted, scalings, estimates, advantage_scaling, target_scaling, self._rows)


def _estimate(
    experience: tuple[torch.Tensor, ...], obs: torch.Tensor, critic: Layers, critic_scaling: Pair, value_scaling: Pair,
    cfg: PpoCfg, rows: int | None,
) -> tuple[tuple[torch.Tensor, ...], list[Pair]]:  # fmt: skip
    """Return what the critic makes of a rollout, and moments of it.

    experience: critic_obs, final_critic_obs, reward, done and timeout of a `RolloutBuffer`; rows: at a time.
    Return the critic's output, advantages and returns (samples,); and mean and variance of advantages, returns,
    observations and the critic's observations.
    """
    critic_obs, final_critic_obs, reward, done, timeout = experience
    columns, dtype = critic.weights[0].shape[1], DTYPES[cfg.precision]

    def head(raw: torch.Tensor) -> torch.Tensor:
        parts = _parts(raw.flatten(0, 1), rows)
        found = [forward(critic, normalised(sanitise(part), critic_scaling, columns), dtype)[0] for part in parts]
        return torch.cat(found).view(raw.shape[:2])

    now, final = head(critic_obs), head(final_critic_obs)
    now_value, final_value = (x * value_scaling[1] + value_scaling[0] for x in (now, final))
    advantage, target = gae(reward + cfg.gamma * timeout * final_value, done, now_value, cfg.gamma, cfg.lam)
    seen = (obs[:-1].flatten(0, 1), critic_obs[:-1].flatten(0, 1))
    own = [own_moments(x, rows) for x in (advantage.flatten(), target.flatten(), *seen)]
    return (now[:-1].flatten(), advantage.flatten(), target.flatten()), own


def _pack(
    rows: torch.Tensor, layout: RowLayout, acted: tuple[torch.Tensor, ...], scalings: tuple[Pair, Pair],
    estimates: tuple[torch.Tensor, ...], advantage_scaling: Pair, target_scaling: Pair | None, count: int | None,
) -> None:  # fmt: skip
    """Write samples to rows, so many at a time.

    acted: obs, critic_obs, action, mean and log_std of a `RolloutBuffer`; estimates: of `_estimate`.
    """
    obs, critic_obs, action, mean, log_std = acted
    value, advantage, target = estimates
    if target_scaling is not None:
        target = (target - target_scaling[0]) / target_scaling[1]
    advantage = (advantage - advantage_scaling[0]) / advantage_scaling[1]
    pieces = [x.flatten(0, 1) for x in (obs[:-1], critic_obs[:-1], action, mean)] + [value, advantage, target]
    for into, *part in zip(_parts(rows, count), *[_parts(x, count) for x in pieces], strict=True):
        seen, critic_seen, acting, meant, worth, gain, goal = part
        features = normalised(seen, scalings[0], layout.num_obs)
        critic_features = normalised(critic_seen, scalings[1], layout.num_critic_obs)
        log_prob = gaussian_log_prob(acting, meant, log_std)
        into.copy_(layout.pack(Batch(features, critic_features, acting, meant, log_prob, worth, gain, goal)))


def _parts(x: torch.Tensor, rows: int | None) -> tuple[torch.Tensor, ...]:
    """Return views of so many rows each, or of all."""
    return x.split(rows or x.shape[0])
