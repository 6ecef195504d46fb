"""Train with a reward term that this script defines, as an example, and write the run and its reward as metrics.

    python experiments/new_reward.py --iterations 5

A term is a pure Warp function of the robot (`mdp.RobotView`), the state of the task (`mdp.JumpState`; `Any` for a term
that every task can use) and numbers by name. `RewardTerm` gives it a weight and these numbers. It is compiled into the
task's one step kernel and logged by its name. Weight and numbers can be changed during a training:
`env.set("rewards.even_load.weight", 2.0)`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import warp as wp

from jumper_warp import make_task, mdp
from jumper_warp.recipe import Recipe
from jumper_warp.rl.cfg import PpoCfg, TrainCfg
from jumper_warp.training import train
from jumper_warp.utils.output import output_dir
from support.scripts import DeviceArgs, report, run_script


@wp.func
def even_load(robot: mdp.RobotView, state: mdp.JumpState, spread: float) -> float:  # pyright: ignore[reportGeneralTypeIssues]
    """Reward for an even load of the paws on the ground, 0 to 1, and 0 in flight.

    It is exp(-norm(paw forces - their mean) / spread); spread: [N].
    """
    if state.phase == mdp.FLIGHT:
        return 0.0
    force = robot.paw_force
    mean = 0.25 * (force[0] + force[1] + force[2] + force[3])
    return wp.exp(-wp.length(force - wp.vec4(mean)) / spread)


TASK = make_task("vertical-jump")
TASK = replace(TASK, rewards=(*TASK.rewards, mdp.RewardTerm(even_load, weight=5.0, spread=50.0)))


@dataclass(frozen=True)
class Args(DeviceArgs):
    """Flags of the training with a new reward term."""

    num_envs: int = 256  # Number of environments
    iterations: int = 5  # Training iterations
    num_steps: int = 32  # Policy steps of each environment in an iteration


def main(args: Args) -> dict:
    """Train for a few iterations, write and return the logged reward of the new term and of whole episodes."""
    wp.config.log_level = wp.LOG_WARNING
    folder = output_dir("new_reward", args.out)
    ppo = PpoCfg(num_steps=args.num_steps)
    cfg = TrainCfg(
        num_envs=args.num_envs,
        max_iterations=args.iterations,
        log_interval=1,
        log_root=folder / "logs",
        ppo=ppo,
        device=args.device,
        tensorboard=False,
    )
    result = train(Recipe(TASK, cfg))
    values = {
        "episode_reward_even_load": result.metrics["Episode_Reward/even_load"],
        "mean_reward": result.metrics.get("Train/mean_reward"),
        "iterations": result.iteration,
    }
    return report(args, folder, values, "Training with a reward term of this script", values)


if __name__ == "__main__":
    run_script(main, Args)
