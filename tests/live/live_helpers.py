"""A short training of a small task."""

from hold_height import hold_height
from jumper_warp.recipe import Recipe
from jumper_warp.rl.cfg import PpoCfg, TrainCfg

STEPS = 8  # policy steps of an iteration


def short_training(folder):
    """Return the recipe of a training of 4 iterations, whose runs are in a folder."""
    ppo = PpoCfg(num_steps=STEPS, hidden=(16, 16), minibatches=2, epochs=1)
    cfg = TrainCfg(task="hold-height", num_envs=8, max_iterations=4, device="cpu", log_interval=2, save_interval=2,
                   tensorboard=False, log_root=folder, ppo=ppo)  # fmt: skip
    return Recipe(hold_height(), cfg)
