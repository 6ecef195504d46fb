"""Fine-tuning of a jumping policy: Gauss-Newton on the errors of apex heights or landing positions.

Errors are those of nominal and of randomised robots. A trust region keeps the actions near those of the original
policy. For landing positions the aim is corrected first: the observed goal is shifted by the mean error.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Iterable
from dataclasses import asdict, replace
from types import ModuleType

import numpy as np
import torch

from jumper_warp.evaluation.conditions import Conditions, env_of_recipe
from jumper_warp.evaluation.finetuning_cfg import FinetuneCfg
from jumper_warp.evaluation.jump_errors import JumpErrors, JumpGroup, jump_errors
from jumper_warp.evaluation.jumps import LANDED, jump_commands
from jumper_warp.policies.policy import Policy
from jumper_warp.recipe import Recipe
from jumper_warp.robot.overlay import load_overlay
from jumper_warp.tasks.cfg import TaskCfg
from jumper_warp.tasks.jump.evaluation import HeightEvaluation, PlaceEvaluation
from jumper_warp.tasks.overlay_ranges import with_fixed_ranges
from jumper_warp.tasks.randomization import RandomizationCfg
from jumper_warp.trajectory.gauss_newton import Anchor, Network, gauss_newton_step
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.files import Json
from jumper_warp.utils.progress import phase
from jumper_warp.utils.runtime import git_commit
from jumper_warp.utils.streams import purpose_seed

AHEAD = "goal_x"  # Name of the observed distance to the goal ahead [m] in jumps to landing positions
DELAYS = (0.3, 0.7)  # [s] Range of the time until jumps are commanded
TRUST_REGION_SECONDS = 3.5  # [s] Length of the episodes whose observations are sampled
TRUST_REGION_SAMPLES = 4096  # Maximum number of these samples
DAMPING = 1.0e-2  # [1] Levenberg-Marquardt damping of the first step
AIM_ROUNDS = 3  # Maximum number of corrections of the aim


def make_groups(recipe: Recipe, cfg: FinetuneCfg) -> list[JumpGroup]:
    """Build the groups of simulated jumps for fine-tuning: `nominal`, `late` (with latency), `randomized`.

    Empty groups are left out. Goals are evenly spaced over the range in `cfg`. recipe: of the policy.
    Raises InputError: the policy does not jump.
    """
    rng = np.random.default_rng(purpose_seed("tuning", cfg.seed))
    groups = []
    shared: Json = {"seed": cfg.seed, "stream": "tuning", "device": cfg.device, "threads": cfg.threads}

    def on_level_ground(task: TaskCfg) -> TaskCfg:
        """Return the task as evaluations use it, without platforms and blocks."""
        return task.evaluation.prepare_task(task).on_level_ground()

    def with_latencies(task: TaskCfg) -> TaskCfg:
        """Return the task with nominal robots that differ only in the latency of their actions."""
        ranges = RandomizationCfg.off().with_fixed(friction=task.randomization.nominal_friction)
        ranges = replace(ranges, latency=task.randomization.latency)
        return replace(on_level_ground(task), randomization=ranges, events=())

    # name, number of jumps, standard deviation [m], whether robots are randomised, change of the task
    kinds: tuple[tuple[str, int, float, bool, Callable[[TaskCfg], TaskCfg]], ...] = (
        ("nominal", cfg.num_goals, cfg.miss_std, False, on_level_ground),
        ("late", cfg.num_delayed, cfg.delayed_std, True, with_latencies),
        ("randomized", cfg.num_randomized, cfg.randomized_std, True, on_level_ground),
    )
    for name, count, std, randomize, change_task in kinds:
        if count:
            conditions = Conditions(randomize=randomize, noise=name == "randomized", **shared)
            robot = conditions.overlay(recipe.robot)
            if robot is not None and name == "late":
                own = {row: pair for row, pair in robot.randomization.items() if row == "latency"}
                robot = with_fixed_ranges(robot, own, nominal=True)
            env = env_of_recipe(recipe, count, conditions, change=change_task, robot=robot)
            evaluation = env.task.evaluation
            to_height = isinstance(evaluation, HeightEvaluation)
            if not to_height and not (isinstance(evaluation, PlaceEvaluation) and evaluation.goal_x[0] > 0.0):
                raise InputError(f"fine-tuning supports jumps to heights and to places ahead, not {env.task.name}")
            goals = np.zeros((count, 3))
            low, high = cfg.height_range if to_height else cfg.distance_range
            goals[:, 2 if to_height else 0] = np.linspace(low, high, count)
            delays = rng.uniform(*DELAYS, count)
            groups.append(JumpGroup(name, env, std, jump_commands(goals, delays, env.step_dt), to_height))
    return groups


def collect_trust_region_samples(groups: list[JumpGroup], network: Network, cfg: FinetuneCfg) -> Anchor:
    """Return a penalty on changes of the network's actions at observations that are sampled from all groups of jumps.

    Observations are sampled from the first TRUST_REGION_SECONDS; after touchdown the allowed change of the actions is
    `cfg.landing_std`, before it `cfg.action_std`.
    """
    observations = []
    landed = []
    for group in groups:
        group.begin()
        with torch.no_grad():
            for _ in range(round(TRUST_REGION_SECONDS / group.env.step_dt)):
                observations.append(group.env.obs.clone())
                landed.append(group.env.task_arrays()["phase"] == LANDED)
                group.env.step(network.act(group.env.obs))
    stds = np.where(np.concatenate(landed), cfg.landing_std, cfg.action_std).astype(np.float32)
    sample = np.random.default_rng(purpose_seed("tuning", cfg.seed)).permutation(len(stds))[:TRUST_REGION_SAMPLES]
    obs = torch.cat(observations)[torch.as_tensor(sample, device=observations[0].device)]
    return Anchor(network, obs, torch.as_tensor(stds[sample], device=obs.device))


def mean_abs_errors(groups: list[JumpGroup], errors: list[JumpErrors]) -> dict[str, float]:
    """Return the mean of the apex errors, or of the distances from goal to landing, of valid jumps [m] by group."""
    parts = [(group.name, len(group.commands), each) for group, each in zip(groups, errors, strict=True)]
    return {name: float(e.value.view(-1, n).norm(dim=0)[e.valid.view(-1, n).all(0)].mean()) for name, n, e in parts}


def shift_goal_observation(policy: Policy, shift: float) -> Policy:
    """Return a copy of the policy whose normaliser is changed so that it observes goals `shift` [m] farther ahead."""
    mean = policy.mean.clone()
    mean[policy.interface.observation_names.index(AHEAD)] -= shift
    return Policy(policy.layers, mean, policy.std, policy.interface, policy.config)


def correct_aim(
    policy: Policy, groups: list[JumpGroup], log: Callable[[str], object]
) -> tuple[Policy, list[dict[str, dict[str, float]]]]:
    """Shift the goals ahead that a policy observes, to reduce its landing errors; return the policy and the errors.

    Every round subtracts the weighted mean error from the observed goal; a round that does not lower the cost is undone
    and ends the correction. A factor on the goal would have little effect: the observed distance is short at landing.
    Errors [m], initially and after each successful round: dicts `ahead` (mean, signed) and `mean_abs_miss_m` by group.
    log: prints a line of progress.
    """

    def measure(policy: Policy) -> tuple[float, list[JumpErrors], dict[str, dict[str, float]]]:
        """Simulate the jumps of a policy; return their cost [1], and errors and mean errors [m] of each group."""
        network = Network(policy, device=groups[0].env.device)
        errors = [jump_errors(group, network, derivatives=False) for group in groups]
        pairs = list(zip(groups, errors, strict=True))
        cost = sum(float((group.importance(e) * e.value.square()).sum()) for group, e in pairs)
        ahead = {g.name: e.value[: len(g.commands)][e.valid[: len(g.commands)]] for g, e in pairs}
        means = {"ahead": {name: float(value.mean()) for name, value in ahead.items()}}
        means["mean_abs_miss_m"] = mean_abs_errors(groups, errors)
        words = ", ".join(f"{name} {1000.0 * miss:+.2f} mm" for name, miss in means["ahead"].items())
        log(f"aim: cost {cost:.4g}, mean error ahead {words}")
        return cost, errors, means

    cost, errors, means = measure(policy)
    history = [means]
    for _ in range(AIM_ROUNDS):
        ahead = [e.value[: len(g.commands)] for g, e in zip(groups, errors, strict=True)]
        weight = [g.importance(e)[: len(g.commands)] for g, e in zip(groups, errors, strict=True)]
        mean_error = float((torch.cat(weight) * torch.cat(ahead)).sum() / torch.cat(weight).sum())
        aimed = shift_goal_observation(policy, -mean_error)
        new_cost, new_errors, means = measure(aimed)
        if not new_cost < cost:
            break
        policy = aimed
        cost = new_cost
        errors = new_errors
        history.append(means)
    return policy, history


def tune_weights(
    groups: list[JumpGroup], network: Network, cfg: FinetuneCfg, log: Callable[[str], object], begin: float
) -> list[Json]:
    """Reduce the errors of jumps by Gauss-Newton steps on the network's weights, in place; return errors by step.

    Returns one record before the steps and one per step.
    Keys: step, mean_abs_miss_m (by group [m]), cost, action_change (RMS [1]), seconds since `begin`, a value of
    `time.perf_counter`. A step that does not lower the cost is undone. log: prints a line of progress.
    """
    anchor = collect_trust_region_samples(groups, network, cfg)

    def measure(derivatives: bool) -> tuple[float, list[JumpErrors]]:
        """Simulate the jumps with the current weights; return cost [1], with the trust region's penalty, and errors.

        The cost is half the sum of squared errors, weighted by importance, plus the penalty.
        """
        errors = [jump_errors(group, network, derivatives=derivatives) for group in groups]
        pairs = zip(groups, errors, strict=True)
        total = sum(float((0.5 * group.importance(e) * e.value.square()).sum()) for group, e in pairs)
        return total + anchor.cost(network.weights), errors

    cost, errors = measure(cfg.iterations > 0)
    damping = DAMPING
    history = []
    for step in range(cfg.iterations + 1):
        row = {"step": step, "mean_abs_miss_m": mean_abs_errors(groups, errors), "cost": cost,
               "action_change": anchor.change(network.weights), "seconds": time.perf_counter() - begin}  # fmt: skip
        history.append(row)
        words = ", ".join(f"{name} {1000.0 * miss:.2f} mm" for name, miss in row["mean_abs_miss_m"].items())
        log(f"step {step}: cost {cost:.4g}, {words}, action change {row['action_change']:.4f}, {row['seconds']:.0f} s")
        if step == cfg.iterations:
            break
        previous = network.weights
        importance = [group.importance(e) for group, e in zip(groups, errors, strict=True)]
        jacobians = [e.jacobian for e in errors]
        values = [e.value for e in errors]
        network.weights = previous + gauss_newton_step(previous, jacobians, values, importance, anchor, damping)
        new_cost, new_errors = measure(step + 1 < cfg.iterations)
        if math.isfinite(new_cost) and new_cost < cost:
            cost = new_cost
            errors = new_errors
            damping = damping / 3.0
        else:
            network.weights = previous
            damping = 10.0 * damping
    return history


def finetune(
    policy: Policy, cfg: FinetuneCfg, modules: Iterable[ModuleType] = (), log: Callable[[str], object] = print
) -> tuple[Policy, dict]:
    """Fine-tune a policy; return the new policy, and a dictionary of the settings and of the errors in each step.

    Its keys: `settings`, `aims` (errors of `correct_aim`), `steps` (records of `tune_weights`).
    modules: the user's task modules; log: prints a line of progress. Raises InputError as `Env.gradients` and
    `make_groups`, for a policy for heights without iterations, and for an overlay that cannot be used.
    """
    begin = time.perf_counter()
    recipe = policy.recipe(modules)
    config = policy.config
    if cfg.robot is not None:
        robot = load_overlay(cfg.robot)
        recipe = replace(recipe, robot=robot)
        config = config | {"env": config["env"] | {"robot": robot.to_json()}}
    groups = make_groups(recipe, cfg)
    aims = []
    if not groups[0].to_height:
        with phase("correcting the aim", AIM_ROUNDS + 1) as advance:
            policy, aims = correct_aim(policy, groups, lambda line: (log(line), advance()))
    elif cfg.iterations == 0:
        raise InputError("iterations must be at least 1 for jumps to heights, which have no aim to correct, got 0")
    network = Network(policy, device=groups[0].env.device)
    with phase("fine-tuning", cfg.iterations + 1) as advance:
        history = tune_weights(groups, network, cfg, lambda line: (log(line), advance()), begin)
    layers = network.layers(network.weights)
    settings = {name: value for name, value in asdict(cfg).items() if name not in ("out", "overwrite", "json")}
    record = {"settings": json.loads(json.dumps(settings, default=str)), "aims": aims, "steps": history}
    config = config | {"finetuned": record | {"commit": (commit := git_commit()) and commit.hash}}
    return Policy(layers, policy.mean, policy.std, policy.interface, config), record
