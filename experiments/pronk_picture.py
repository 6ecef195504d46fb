"""Plot the base height of a policy of the tutorial's task `pronk` over time, for four commands.

    python experiments/pronk_picture.py --policy pronk_policy --task-module pronk.py

`docs/tutorials/own_task.md` has the task, and the commands that train and export the policy.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from jumper_warp.envs.env import Env
from jumper_warp.policies.policy import load_policy
from jumper_warp.registry import load_task_module
from jumper_warp.viz.plots import figure
from jumper_warp.viz.style import ACTUAL_COLOR, GOAL_COLOR
from support.scripts import run_script

HEIGHTS = (0.5, 0.6, 0.7, 0.8)  # [m] Commanded heights
STEPS = 300  # Number of policy steps, 5 s


@dataclass(frozen=True)
class Args:
    """Flags of the plot."""

    policy: Path  # Folder of the policy
    task_module: Path  # File with the task
    out: Path = Path("outputs/pronk.png")  # Picture to write


def main(args: Args) -> np.ndarray:
    """Simulate a robot for each command, plot their heights, and return these, (steps, commands) [m]."""
    policy = load_policy(args.policy)
    task = policy.recipe([load_task_module(str(args.task_module))]).task
    env = Env(task, len(HEIGHTS), device="cpu", randomize=False, noise=False)
    env.evaluation_reset([[height] for height in HEIGHTS])
    heights = np.empty((STEPS, len(HEIGHTS)))
    for step in range(STEPS):
        env.step(policy.act(env.obs))
        heights[step] = env.task_arrays()["base_pos"][:, 2]
    args.out.parent.mkdir(parents=True, exist_ok=True)
    with figure(args.out, 2, 2, sharex=True, sharey=True, figsize=(9.0, 4.5)) as axes:
        for axis, command, values in zip(axes.flat, HEIGHTS, heights.T, strict=True):
            axis.axhline(command, color=GOAL_COLOR, label="command")
            axis.plot(np.arange(1, STEPS + 1) / 60.0, values, color=ACTUAL_COLOR, label="base height")
            axis.set(title=f"command {command:g} m", ylim=(0.0, 0.9))
        for axis in axes[1]:
            axis.set(xlabel="time [s]")
        for axis in axes[:, 0]:
            axis.set(ylabel="base height [m]")
    return heights


if __name__ == "__main__":
    run_script(main, Args)
