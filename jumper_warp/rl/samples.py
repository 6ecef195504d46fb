"""A rollout as samples to learn from: advantages, returns, and one row of memory a sample."""

from __future__ import annotations

from itertools import accumulate
from typing import NamedTuple

import torch

from jumper_warp.envs.vec_env import sanitise
from jumper_warp.rl.cfg import PpoCfg
from jumper_warp.rl.flat import ROW_ALIGNMENT, FlatParameters, aligned
from jumper_warp.rl.graphs import Compiler
from jumper_warp.rl.mirror import MirrorMap
from jumper_warp.rl.networks import DTYPES, ActorCritic, Layers, Moments, Scaling, all_reduce_moments, gaussian_log_prob
from jumper_warp.rl.rollout import RolloutBuffer

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


class RolloutMoments(NamedTuple):
    """Of the samples of a rollout."""

    advantage: Moments
    target: Moments
    """() each."""
    obs: Moments
    """(num_obs,)"""
    critic_obs: Moments
    """(num_critic_obs,)"""


class Estimates(NamedTuple):
    """What the critic makes of a rollout; batch = num_steps · num_envs, time-major."""

    value: torch.Tensor
    """(batch,) the critic's output [standard deviations of the return]."""
    advantage: torch.Tensor
    target: torch.Tensor
    """(batch,) returns, like the advantage in scaled rewards."""
    moments: RolloutMoments
    """Over this rank's samples."""


class Scalings(NamedTuple):
    """By which observations and values are scaled."""

    obs: Scaling
    """(num_obs,)"""
    critic_obs: Scaling
    """(num_critic_obs,)"""
    value: Scaling
    """() of the return."""


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


class BatchPacker:
    """Turns a rollout into rows to learn from."""

    def __init__(
        self, rollout: RolloutBuffer, cfg: PpoCfg, model: ActorCritic, flat: FlatParameters, compiler: Compiler,
        obs_image: MirrorMap | None = None,
    ) -> None:  # fmt: skip
        """flat: the parameters of `model`; obs_image: of observations whose statistics are to be symmetric."""
        self._obs_image = obs_image
        self._rollout, self._cfg, self._model, self._critic = rollout, cfg, model, flat.critic
        steps, worlds, num_actions = rollout.action.shape
        self.layout = RowLayout(rollout.obs.shape[2], rollout.critic_obs.shape[2], num_actions)
        self.rows = rollout.obs.new_zeros(steps * worlds, sum(self.layout.widths))
        """(steps · worlds, columns of `layout`), time-major."""
        self.old_log_std = torch.zeros_like(rollout.log_std)
        """Of the policy that acted."""
        self._rows = CPU_ROWS if self.rows.device.type == "cpu" else None
        self._compute_values_and_gae, self._write = compiler(compute_values_and_gae), compiler(_write)

    @torch.no_grad()
    def pack(self) -> None:
        """Write the rollout to `rows` and take it into the running statistics."""
        model = self._model
        scalings = self._scalings()  # with which actor and critic acted
        estimates = self._estimates(scalings)
        moments = RolloutMoments(*all_reduce_moments(estimates.moments))
        of_obs = moments.obs
        if self._obs_image is not None:
            of_obs = Moments(*self._obs_image.moments(of_obs.mean, of_obs.var), of_obs.count)
        model.obs_moments.take(of_obs)
        model.critic_moments.take(moments.critic_obs)
        if self._cfg.normalise_value:
            model.value_moments.take(moments.target)
        mean, var, count = moments.advantage
        of_advantage = Scaling(mean.float(), ((var * count / (count - 1)).sqrt() + 1.0e-8).float())
        self._pack(scalings, estimates, of_advantage)
        self.old_log_std.copy_(self._rollout.log_std)

    @torch.no_grad()
    def warm_up(self) -> None:
        """Compile, as if a rollout were packed; spoils `rows`."""
        scalings = self._scalings()
        self._pack(scalings, self._estimates(scalings), scalings.value)

    def _scalings(self) -> Scalings:
        model = self._model
        return Scalings(*(each.scaling() for each in (model.obs_moments, model.critic_moments, model.value_moments)))

    def _estimates(self, scalings: Scalings) -> Estimates:
        return self._compute_values_and_gae(self._rollout, self._critic, scalings, self._cfg, self._rows)

    def _pack(self, scalings: Scalings, estimates: Estimates, of_advantage: Scaling) -> None:
        of_target = self._model.value_moments.scaling() if self._cfg.normalise_value else None
        self._write(self.rows, self.layout, self._rollout, scalings, estimates, of_advantage, of_target, self._rows)


def compute_values_and_gae(
    buffer: RolloutBuffer, critic: Layers, scalings: Scalings, cfg: PpoCfg, rows: int | None
) -> Estimates:
    """Return values, advantages and returns (num_steps · num_envs,) of a rollout, and moments of its samples.

    A timeout counts the value of the last observation. rows: observations that the critic takes at a time (None: all).
    """
    columns, dtype = critic.weights[0].shape[1], DTYPES[cfg.precision]

    def value_head(critic_obs: torch.Tensor) -> torch.Tensor:
        """Return the critic's output (steps, num_envs) for (steps, num_envs, num_critic_obs)."""
        scaling, parts = scalings.critic_obs, _parts(critic_obs.flatten(0, 1), rows)
        heads = [critic.forward(scaling.features(sanitise(part), columns), dtype)[0] for part in parts]
        return torch.cat(heads).view(critic_obs.shape[:2])

    head, final_head = value_head(buffer.critic_obs), value_head(buffer.final_critic_obs)
    value, final_value = scalings.value.restore(head), scalings.value.restore(final_head)
    reward = buffer.reward + cfg.gamma * buffer.timeout * final_value
    advantage, target = (x.flatten() for x in gae(reward, buffer.done, value, cfg.gamma, cfg.lam))
    samples = (advantage, target, buffer.obs[:-1].flatten(0, 1), buffer.critic_obs[:-1].flatten(0, 1))
    moments = RolloutMoments(*(Moments.of(x, rows) for x in samples))
    return Estimates(head[:-1].flatten(), advantage, target, moments)


def _write(
    rows: torch.Tensor, layout: RowLayout, buffer: RolloutBuffer, scalings: Scalings, estimates: Estimates,
    of_advantage: Scaling, of_target: Scaling | None, count: int | None,
) -> None:  # fmt: skip
    """Write samples to rows (batch, columns of `layout`), so many at a time."""
    target = estimates.target if of_target is None else of_target.normalise(estimates.target)
    steps = [x.flatten(0, 1) for x in (buffer.obs[:-1], buffer.critic_obs[:-1], buffer.action, buffer.mean)]
    pieces = [rows, *steps, estimates.value, of_advantage.normalise(estimates.advantage), target]
    for into, obs, critic_obs, action, mean, *estimated in zip(*[_parts(x, count) for x in pieces], strict=True):
        features = scalings.obs.features(obs, layout.num_obs)
        critic_features = scalings.critic_obs.features(critic_obs, layout.num_critic_obs)
        log_prob = gaussian_log_prob(action, mean, buffer.log_std)
        into.copy_(layout.pack(Batch(features, critic_features, action, mean, log_prob, *estimated)))


def _parts(x: torch.Tensor, rows: int | None) -> tuple[torch.Tensor, ...]:
    """Return views of so many rows each, or of all."""
    return x.split(rows or x.shape[0])
