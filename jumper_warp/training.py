"""Training of a policy from a recipe: `jumper train` calls `train`, and scripts can."""

from __future__ import annotations

from typing import TYPE_CHECKING

from jumper_warp.policies.policy import actor_init_from_policy
from jumper_warp.recipe import Recipe
from jumper_warp.rl import runner
from jumper_warp.rl.run_folder import TrainResult
from jumper_warp.tasks.mirror import mirror_of

if TYPE_CHECKING:
    from jumper_warp.rl.checkpoint import Checkpoint


def train(
    recipe: Recipe, *, checkpoint: Checkpoint | None = None, command: str | None = None, expected_rate: float = 0.0
) -> TrainResult:
    """Train a policy, save checkpoints in a new run's folder, and return the result.

    checkpoint: to continue from (default: the one that `recipe.train.resume` selects). command, expected_rate: as in
    `jumper_warp.rl.runner.train`, which lists the errors. Also raises InputError: the task cannot be saved, or has no
    mirror image and a symmetric policy is requested; PolicyError or CheckpointError: `init_policy` cannot be used.
    """
    recipe.check_saving()
    cfg, task = recipe.train, recipe.task
    if cfg.ppo.symmetry != "off":
        mirror_of(task, "actor")  # raises InputError where a term has no known mirror image
    actor_init = as_rsl_rl = None
    if cfg.init_policy and checkpoint is None:
        actor_init = actor_init_from_policy(cfg.init_policy, task, cfg.ppo)
    if cfg.trainer == "rsl-rl":
        from jumper_warp.envs.rsl_rl import RslRlVecEnv as as_rsl_rl
    return runner.train(cfg, recipe.make_env, command, as_rsl_rl, actor_init, checkpoint, expected_rate)
