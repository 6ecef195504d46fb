"""Measure how steadily a policy holds a squat before its jump is commanded, and write metrics, a plot and a recording.

    python experiments/squat_hold.py --policy vertical_jump --out outputs/hold
    python experiments/squat_hold.py --policy horizontal_jump --num-squats 500 --randomize

Robots stand, get a goal but no command, and squat. Two metrics cover the last second: the range of the force on each
paw (largest value over physics steps minus smallest over policy steps) and the ripple of the motor torques. Randomised
robots have observation noise and are pushed by up to 10 N.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from jumper_warp.evaluation.run import EvaluationArgs, EvaluationRun
from jumper_warp.tasks.jump.evaluation import JumpEvaluation
from jumper_warp.viz.plots import figure
from jumper_warp.viz.style import LEG_COLORS
from support.scripts import run_script
from support.squats import SquatLog, squat_goals, squat_metrics


@dataclass(frozen=True)
class Args(EvaluationArgs):
    """Flags of the test of held squats."""

    policy: str = "vertical_jump"  # Name or folder of a policy that jumps, a run's folder, or a checkpoint
    num_squats: int = 100  # Number of robots
    hold_time: float = 3.0  # [s] Time for which each robot holds its squat
    height: tuple[float, float] = (0.6, 1.1)  # [m] Lowest and highest goal, for a policy that jumps to heights
    distance: tuple[float, float] = (0.3, 1.5)  # [m] Nearest and farthest goal, for a policy that jumps to places


def plot_squats(run: EvaluationRun, squats: SquatLog) -> None:
    """Plot forces and torques of the robot with the largest force range, and all force ranges, into `hold.png`."""
    time = (np.arange(len(squats.forces)) + 1) * squats.step_dt
    robot = np.flatnonzero(~squats.ended)[squats.force_range.argmax()]
    settings = {"title": "Held squats", "conditions": f"{run.title}, {len(squats.ended)} robots"}
    with figure(run.folder / "hold.png", 1, 3, figsize=(14, 5), **settings) as axes:
        forces, torques = (np.array(values)[:, robot] for values in (squats.forces, squats.torques))
        for i, (leg, color) in enumerate(LEG_COLORS.items()):
            axes[0].plot(time, forces[:, i], linewidth=1.0, color=color, label=leg)
            axes[1].plot(time, torques[:, 3 * i : 3 * i + 3], linewidth=1.0, color=color)
        axes[0].set(xlabel="time [s]", ylabel="force on each paw [N]", title="robot whose forces vary most")
        axes[1].set(xlabel="time [s]", ylabel="torque of each motor [N m]", title="the same robot")
        axes[2].hist(squats.force_range, bins=30)
        axes[2].locator_params(axis="x", nbins=5)
        axes[2].set(xlabel="range of a paw's force in the last second [N]", ylabel="robots", title="all robots")


def main(args: Args) -> dict:
    """Simulate the held squats, plot them unless all robots fall, and return the metrics."""
    run = EvaluationRun.from_args("squat_hold", args, JumpEvaluation)
    env = run.env(args.num_squats)
    up = run.evaluation.kind == "height"
    goals = squat_goals(args.num_squats, args.height if up else args.distance, up=up)
    squats = run.run_episodes(env, SquatLog(goals, args.hold_time), film="holds")
    if not squats.ended.all():
        plot_squats(run, squats)
    run.settings["hold_s"] = args.hold_time
    keys = ("holding_rate", "paw_force_range_median_n", "lost_paw_share_mean", "torque_ripple_mean_nm")
    return run.report(squat_metrics(squats), {}, keys)


if __name__ == "__main__":
    run_script(main, Args)
