"""Fine-tuning of a jumping policy by its misses: apex against commanded height, or landing place.

Gauss-Newton on the misses of many jumps, of the nominal robot and of drawn ones, held near the policy as it came. A
policy for places first gets its aim right: the goal that it sees is shifted by what its robots missed.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import torch

from jumper_warp.evaluation.jump_misses import Group, Misses, follow
from jumper_warp.evaluation.jumps import LANDED, jump_commands
from jumper_warp.evaluation.registry import evaluation_of
from jumper_warp.policies.conditions import Conditions, env_of_policy
from jumper_warp.policies.policy import Policy
from jumper_warp.tasks.cfg import TaskCfg
from jumper_warp.tasks.randomization import RandomizationCfg
from jumper_warp.trajectory.gauss_newton import Anchor, Network, gauss_newton_step
from jumper_warp.utils.checks import check_positive
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.runtime import git_commit

AHEAD = "goal_x"
"""Observation of jumps to places: way to the goal ahead [m]."""
DELAYS = (0.3, 0.7)
"""[s] Between which jumps are commanded."""
ANCHOR_SECONDS = 3.5
ANCHOR_ROWS = 4096
DAMPING = 1.0e-2
"""Of the first step."""
AIM_ROUNDS = 3
"""Corrections of the aim, at most: where robots come to rest follows the goal that they see, by and large."""


@dataclass(frozen=True)
class FinetuneCfg:
    """How a policy is fine-tuned."""

    num_goals: int = 64
    """Number of jumps of the nominal robot, spread evenly over the goals."""
    num_delayed: int = 32
    """Number of jumps of the nominal robot with latencies drawn from the training's range."""
    num_randomized: int = 64
    """Number of jumps of robots randomised as in the training, with noise, latency and pushes."""
    height_range: tuple[float, float] = (0.5, 1.075)
    """[m] Lowest and highest commanded base height, of jumps to heights."""
    distance_range: tuple[float, float] = (0.3, 1.4)
    """[m] Nearest and farthest goal straight ahead, of jumps to places."""
    iterations: int = 6
    """Gauss-Newton steps; 0 for places: the aim alone."""
    miss_std: float = 0.001
    """[m] Miss of the nominal robot that costs as much as a change of the actions by --action-std."""
    delayed_std: float = 0.003
    """[m] Miss with latencies that costs as much."""
    randomized_std: float = 0.01
    """[m] Miss of a randomised robot that costs as much."""
    action_std: float = 0.02
    """[1] Change of the actions against the given policy, root of the sum of squares over the motors."""
    landing_std: float = 0.005
    """[1] Change of the actions after touchdown that costs as much."""
    seed: int = 0
    """Seed of commands, latencies and robots."""
    device: str | None = None
    """Warp device (default: a GPU if there is one)."""
    threads: int | None = None
    """CPU threads that share the worlds (default: all cores); they change no result."""

    def __post_init__(self) -> None:
        """Raises InputError: a setting is out of range."""
        if self.num_goals < 2 or min(self.num_delayed, self.num_randomized, self.iterations) < 0:
            raise InputError("fine-tuning needs at least 2 goals, and no negative number of jumps or steps")
        for name in ("miss_std", "delayed_std", "randomized_std", "action_std", "landing_std"):
            check_positive(name, getattr(self, name))
        for name in ("height_range", "distance_range"):
            low, high = getattr(self, name)
            if not 0.0 < low < high < 10.0:
                raise InputError(f"{name} must be in (0, 10) m and rise, got {low}, {high}")


@dataclass(frozen=True)
class FinetuneArgs(FinetuneCfg):
    """Make a jumping policy miss its heights or places by less, by gradients through physics, motors and network."""

    out: Path | None = None
    """Folder of the new policy (default: <policy>_finetuned)."""
    overwrite: bool = False
    """Replace a policy that is there already."""


def make_groups(policy: Policy, cfg: FinetuneCfg, modules: Iterable[ModuleType] = ()) -> list[Group]:
    """Return the groups of jumps that have any."""
    rng, groups = np.random.default_rng(cfg.seed), []

    def level(task: TaskCfg) -> TaskCfg:
        return evaluation_of(task).for_evaluation(task).on_level_ground()

    def latencies(task: TaskCfg) -> TaskCfg:
        ranges = RandomizationCfg.off().with_fixed(friction=task.randomization.nominal_friction)
        return replace(level(task), randomization=replace(ranges, latency=task.randomization.latency), events=())

    kinds: tuple[tuple[str, int, float, bool, Callable[[TaskCfg], TaskCfg]], ...] = (
        ("nominal", cfg.num_goals, cfg.miss_std, False, level),
        ("late", cfg.num_delayed, cfg.delayed_std, True, latencies),
        ("randomized", cfg.num_randomized, cfg.randomized_std, True, level),
    )
    for name, count, std, draws, change in kinds:
        if count:
            conditions = Conditions(
                randomize=draws, noise=name == "randomized", seed=cfg.seed, device=cfg.device, threads=cfg.threads
            )
            env = env_of_policy(policy, count, conditions, change=change, modules=modules)
            misses = evaluation_of(env.task).misses
            if misses is None:
                raise InputError(f"fine-tuning is for jumps to heights and places, not for {env.task.name}")
            goals, to_height = np.zeros((count, 3)), misses == "height"
            low, high = cfg.height_range if to_height else cfg.distance_range
            goals[:, 2 if to_height else 0] = np.linspace(low, high, count)
            delays = rng.uniform(*DELAYS, count)
            groups.append(Group(name, env, std, jump_commands(goals, delays, env.step_dt), to_height))
    return groups


def make_anchor(groups: list[Group], network: Network, cfg: FinetuneCfg) -> Anchor:
    """Return what holds the network over observations of whole jumps of all groups, from standing to rest."""
    seen, landed = [], []
    for group in groups:
        group.begin()
        with torch.no_grad():
            for _ in range(round(ANCHOR_SECONDS / group.env.step_dt)):
                seen.append(group.env.obs.clone())
                landed.append(group.env.task_arrays()["phase"] == LANDED)
                group.env.step(network.act(group.env.obs))
    stds = np.where(np.concatenate(landed), cfg.landing_std, cfg.action_std).astype(np.float32)
    chosen = np.random.default_rng(cfg.seed).permutation(len(stds))[:ANCHOR_ROWS]
    obs = torch.cat(seen)[torch.as_tensor(chosen, device=seen[0].device)]
    return Anchor(network, obs, torch.as_tensor(stds[chosen], device=obs.device))


def mean_abs_misses(groups: list[Group], found: list[Misses]) -> dict[str, float]:
    """Return the mean absolute miss [m] of each group."""
    return {group.name: float(m.value[m.valid].abs().mean()) for group, m in zip(groups, found, strict=True)}


def with_aim(policy: Policy, shift: float) -> Policy:
    """Return the policy that sees its goals so much [m] farther ahead; the observation's normaliser does it."""
    mean = policy.mean.clone()
    mean[policy.interface.observation_names.index(AHEAD)] -= shift
    return Policy(policy.layers, mean, policy.std, policy.interface, policy.config)


def take_aim(
    policy: Policy, groups: list[Group], say: Callable[[str], object]
) -> tuple[Policy, list[dict[str, dict[str, float]]]]:
    """Return the policy with its aim at goals straight ahead corrected, and the misses [m] by group on the way.

    Every round takes the mean of what the robots missed, as the groups weigh it, off the goal that they see; one that
    does not lower the cost is taken back, and the last. A stretch would do little: the way to the goal that a robot
    sees is short by the time that it lands.
    """

    def measure(policy: Policy) -> tuple[float, list[Misses], dict[str, dict[str, float]]]:
        network = Network(policy, device=groups[0].env.device)
        found = [follow(group, network, derivatives=False) for group in groups]
        pairs = list(zip(groups, found, strict=True))
        cost = sum(float((group.importance(m) * m.value.square()).sum()) for group, m in pairs)
        ahead = {g.name: m.value[: len(g.commands)][m.valid[: len(g.commands)]] for g, m in pairs}
        means = {"ahead": {name: float(value.mean()) for name, value in ahead.items()}}
        means["mean_abs_miss_m"] = mean_abs_misses(groups, found)
        words = ", ".join(f"{name} {1000.0 * miss:+.2f} mm" for name, miss in means["ahead"].items())
        say(f"aim: cost {cost:.4g}, robots end ahead of their goals by {words}")
        return cost, found, means

    cost, found, means = measure(policy)
    told = [means]
    for _ in range(AIM_ROUNDS):
        ahead = [m.value[: len(g.commands)] for g, m in zip(groups, found, strict=True)]
        weight = [g.importance(m)[: len(g.commands)] for g, m in zip(groups, found, strict=True)]
        aimed = with_aim(policy, -float((torch.cat(weight) * torch.cat(ahead)).sum() / torch.cat(weight).sum()))
        new_cost, new, means = measure(aimed)
        if not new_cost < cost:
            break
        policy, cost, found = aimed, new_cost, new
        told.append(means)
    return policy, told


def tune_weights(
    groups: list[Group], network: Network, cfg: FinetuneCfg, say: Callable[[str], object], begin: float
) -> list[dict[str, Any]]:
    """Take Gauss-Newton steps on the network's weights; return the misses [m] by group before and after each step.

    begin: time from which the reported seconds count, by `time.perf_counter`.
    """
    anchor = make_anchor(groups, network, cfg)

    def measure(derivatives: bool) -> tuple[float, list[Misses]]:
        found = [follow(group, network, derivatives=derivatives) for group in groups]
        pairs = zip(groups, found, strict=True)
        total = sum(float((0.5 * group.importance(m) * m.value.square()).sum()) for group, m in pairs)
        return total + anchor.cost(network.weights), found

    cost, found = measure(cfg.iterations > 0)
    damping, history = DAMPING, []
    for step in range(cfg.iterations + 1):
        row = {"step": step, "mean_abs_miss_m": mean_abs_misses(groups, found), "cost": cost,
               "action_change": anchor.change(network.weights), "seconds": time.perf_counter() - begin}  # fmt: skip
        history.append(row)
        words = ", ".join(f"{name} {1000.0 * miss:.2f} mm" for name, miss in row["mean_abs_miss_m"].items())
        say(f"step {step}: cost {cost:.4g}, {words}, actions moved {row['action_change']:.4f}, {row['seconds']:.0f} s")
        if step == cfg.iterations:
            break
        kept = network.weights
        importance = [group.importance(m) for group, m in zip(groups, found, strict=True)]
        rows, values = [m.rows for m in found], [m.value for m in found]
        network.weights = kept + gauss_newton_step(kept, rows, values, importance, anchor, damping)
        new_cost, new = measure(step + 1 < cfg.iterations)
        if math.isfinite(new_cost) and new_cost < cost:
            cost, found, damping = new_cost, new, damping / 3.0
        else:
            network.weights, damping = kept, 10.0 * damping
    return history


def finetune(
    policy: Policy,
    cfg: FinetuneCfg,
    modules: Iterable[ModuleType] = (),
    say: Callable[[str], object] = print,
) -> tuple[Policy, dict]:
    """Return the fine-tuned policy, and its record: settings, and misses [m] by group before and after each step.

    modules: that the user has named. say: prints a line. Raises InputError as `ClosedLoop` and `make_groups`,
    and if there is nothing to do.
    """
    begin = time.perf_counter()
    groups = make_groups(policy, cfg, modules)
    aims = []
    if not groups[0].to_height:
        policy, aims = take_aim(policy, groups, say)
    elif cfg.iterations == 0:
        raise InputError("a policy for heights has no aim to be taken apart: fine-tuning it needs an iteration")
    network = Network(policy, device=groups[0].env.device)
    history = tune_weights(groups, network, cfg, say, begin)
    layers = network.layers(network.weights)
    settings = {name: value for name, value in asdict(cfg).items() if name not in ("out", "overwrite")}
    record = {"settings": json.loads(json.dumps(settings, default=str)), "aims": aims, "steps": history}
    config = policy.config | {"finetuned": record | {"commit": (commit := git_commit()) and commit.hash}}
    return Policy(layers, policy.mean, policy.std, policy.interface, config), record
