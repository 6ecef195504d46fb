"""Training of a policy from a recipe: `jumper train` calls `train`, and scripts can."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING

import torch

from jumper_warp.envs.env import Env
from jumper_warp.policies.warm_start import actor_init_from_policy, task_symmetries
from jumper_warp.recipe import Recipe
from jumper_warp.rl import runner
from jumper_warp.rl.run_folder import TrainResult
from jumper_warp.utils.errors import InputError

if TYPE_CHECKING:
    from jumper_warp.rl.checkpoint import Checkpoint


def train(
    recipe: Recipe, *, seeds: Sequence[int] | None = None, checkpoints: Sequence[Checkpoint] = (),
    command: str | None = None, observers: Sequence[runner.Observer] = (),
) -> TrainResult:  # fmt: skip
    """Train a policy, or one of each seed, save checkpoints in a new run's folder, and return the result.

    seeds: several trainings side by side (default: recipe.train.seeds). checkpoints: to continue from, one of each seed
    (default: those that `recipe.train.resume` selects). command, observers: as in
    `jumper_warp.rl.runner.train`, which lists the errors. Also raises InputError: the task cannot be saved, has no
    observation, or no mirror image although a symmetric policy is requested; PolicyError or CheckpointError:
    `init_policy` cannot be used.
    """
    if not isinstance(recipe, Recipe):
        raise InputError(f"train needs a Recipe, such as Recipe.of(name), got {recipe!r:.60}")
    recipe.check_saving()
    cfg, task = recipe.train, recipe.task
    if not task.observations.actor:
        raise InputError(f"the policy of {task.name} has no observation")
    if seeds is not None:
        cfg = dataclasses.replace(cfg, seeds=tuple(seeds))
    task_symmetries(task, cfg.ppo.symmetry)  # raises InputError where a mirror image is not known
    actor_init = None
    if cfg.init_policy and not checkpoints:
        actor_init = actor_init_from_policy(cfg.init_policy, task, cfg.ppo, recipe.robot and recipe.robot.description)
    return runner.train(cfg, partial(make_env, recipe), command, actor_init, checkpoints, observers)


def make_env(recipe: Recipe, num_envs: int, seed: int, device: str | torch.device) -> Env:
    """Return the environment in which a recipe's policy is trained. Raises InputError as `Env`."""
    return Env(
        recipe.task, num_envs, seed=seed, device=device, solver=recipe.solver, randomize=recipe.randomize,
        noise=recipe.noise, robot=recipe.robot,
    )  # fmt: skip
