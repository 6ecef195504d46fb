"""Squats that are held: how quietly a policy waits for the command to jump.

    python experiments/squat_hold.py --policy vertical_jump --out outputs/hold
    python experiments/squat_hold.py --policy horizontal_jump --num-squats 500 --randomize

Robots stand, get a goal but no command, and squat. In the last second it is looked at how much the force on each paw
varies, of all physics steps for the largest and of policy steps for the smallest, and how much the torques of the
motors ripple. Randomised robots see noise and are pushed by up to 10 N.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from jumper_warp.cli.main import run_command
from jumper_warp.evaluation.plots import drawn
from jumper_warp.evaluation.run import HEIGHTS, PLACES, EvaluationArgs, EvaluationRun
from jumper_warp.utils.errors import InputError
from support.holds import Holds, hold_goals, hold_metrics
from support.scripts import parse_flags


@dataclass(frozen=True)
class Args(EvaluationArgs):
    """Flags."""

    policy: str = "vertical_jump"
    """Name or folder of a policy that jumps, a run's folder, or a checkpoint."""
    num_squats: int = 100
    """Number of robots."""
    hold_time: float = 3.0
    """[s] How long each robot holds its squat."""
    height: tuple[float, float] = (0.6, 1.1)
    """[m] Lowest and highest goal, for a policy that jumps to heights."""
    distance: tuple[float, float] = (0.3, 1.5)
    """[m] Nearest and farthest goal, for a policy that jumps to places."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.num_squats < 1 or not 1.5 <= self.hold_time <= 30.0:
            given = f"{self.num_squats}, {self.hold_time}"
            raise InputError(f"need at least one squat, and hold_time in 1.5 to 30 s, got {given}")
        for name in ("height", "distance"):
            low, high = getattr(self, name)
            if not 0.0 < low <= high < 10.0:
                raise InputError(f"{name} must be in (0, 10) m and rise, got {low}, {high}")


def plot(run: EvaluationRun, holds: Holds) -> None:
    """Draw forces and torques of the robot whose forces vary most, and the ranges of all."""
    time = (np.arange(len(holds.forces)) + 1) * holds.step_dt
    robot = np.flatnonzero(~holds.over)[holds.force_range.argmax()]
    with drawn(run.folder / "hold.png", 1, 3, figsize=(14, 4)) as axes:
        axes[0].plot(time, np.array(holds.forces)[:, robot], linewidth=0.8)
        axes[0].set(xlabel="time [s]", ylabel="force on each paw [N]", title="the robot whose forces vary most")
        axes[1].plot(time, np.array(holds.torques)[:, robot], linewidth=0.8)
        axes[1].set(xlabel="time [s]", ylabel="torque of each motor [N m]")
        axes[2].hist(holds.force_range, bins=30)
        axes[2].set(xlabel="range of a paw's force in the last second [N]", ylabel="robots", title=run.title)


def main(args: Args) -> dict:
    """Hold squats and return the figures."""
    run = EvaluationRun.of("squat_hold", args, (*HEIGHTS, *PLACES))
    env = run.env(args.num_squats)
    up = run.task.evaluation in HEIGHTS
    goals = hold_goals(args.num_squats, args.height if up else args.distance, up=up)
    holds = run.follow(env, Holds(goals, args.hold_time), film="holds")
    if not holds.over.all():
        plot(run, holds)
    return run.report({"hold_s": args.hold_time} | hold_metrics(holds), {})


if __name__ == "__main__":
    run_command(lambda: main(parse_flags(Args)))
