"""Turning in free flight: a policy turns the floating robot by 90 degrees about each axis, each way, and about others.

    python experiments/attitude.py --policy attitude --num-turns 60 --out outputs/attitude
    python experiments/attitude.py --policy logs/attitude/<run> --randomize --angle 60

Robots float at rest in the default pose, in zero gravity, and are told to turn once. A turn is settled from when the
error stays within a tolerance until the end; it succeeds if it is, and nothing has touched anything. The authors' robot
turned by 90 degrees in 2.6 s. Nothing but its own legs turns the robot, so that its angular momentum should stay 0:
what the solver makes of it is told, as the largest of all robots at any time, and as the angle by which it alone turns
a robot: its integral over the moment of inertia in the default pose. By default the momentum is kept (`Simulation`);
`--no-keep-momentum` tells what the solver alone would do, `--refine 4` turns the same robots with a physics step of a
quarter, and `--solver mujoco` with physics that the policy was not trained on and that keep no momentum.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from jumper_warp.cli.main import run_command
from jumper_warp.evaluation.plots import drawn
from jumper_warp.evaluation.run import EvaluationArgs, EvaluationRun
from jumper_warp.evaluation.turns import DIRECTIONS, TurnFlags, Turns, axis_metrics, turn_metrics, turns_about_any
from support.momentum import MomentumWatch, rotational_inertia
from support.scripts import parse_flags

HARDWARE = {"mean_settling_s": 2.6}
"""The authors' robot, 90 degrees."""
COLORS = ("tab:red", "tab:green", "tab:blue")


@dataclass(frozen=True)
class Args(EvaluationArgs, TurnFlags):
    """Flags; as many turns about any axis as about the body's."""

    policy: str = "attitude"
    keep_momentum: bool = True
    """Whether the momentum of free flight is kept exactly, whatever the training had."""
    refine: int = 1
    """How many times finer the physics step is than that of the training."""
    num_recorded: int = 6
    """Number of turns to record for the Rerun viewer and, the first of them, as a filmstrip; 0: none."""

    def __post_init__(self) -> None:
        super().__post_init__()
        TurnFlags.__post_init__(self)


def plot(run: EvaluationRun, turns: Turns, title: str) -> None:
    """Draw the errors of turns about the body's axes over time."""
    errors = np.degrees(np.array(turns.errors))
    time = (np.arange(len(errors)) + 1) * turns.step_dt
    with drawn(run.folder / "turns.png", 1, 2, figsize=(11, 4.2)) as axes:
        for i, name in enumerate(DIRECTIONS):
            style = {"color": COLORS[i // 2], "linestyle": "-" if i % 2 == 0 else "--"}
            axes[0].plot(time, errors[:, i::6], alpha=0.15 if errors.shape[1] > 6 else 0.0, linewidth=0.6, **style)
            axes[0].plot(time, np.nanmean(errors[:, i::6], axis=1), label=name.replace("_", " "), **style)
            settled = turns.settling[i::6]
            axes[1].scatter(np.full(len(settled), i), settled, s=12, color=COLORS[i // 2])
        axes[0].axhline(turns.tolerance, color="0.6", linewidth=0.8)
        axes[0].set(xlabel="time [s]", ylabel="angle to the goal [deg]", title=title)
        axes[0].legend(fontsize=8)
        axes[1].axhline(2.6, color="0.6", linestyle="--", label="hardware, 90 degrees")
        axes[1].set_xticks(range(6), [name.replace("_", " ") for name in DIRECTIONS], rotation=30, fontsize=8)
        axes[1].set(ylabel="time to settle [s]", ylim=(0.0, turns.seconds))
        axes[1].legend(fontsize=8)


def main(args: Args) -> dict:
    """Run the test and return its figures."""
    run = EvaluationRun.of("attitude", args, ("attitude",))
    env = run.env(args.num_turns, lambda task: replace(task, keep_momentum=args.keep_momentum), refine=args.refine)
    run.told |= {"physics_step_s": env.physics_dt, "keep_momentum": args.keep_momentum}
    turns, watch = args.log(run.task, args.seed), MomentumWatch(env)
    inertia = rotational_inertia(env.sim)
    run.follow(env, turns, film="turns", watch=watch)
    values = turn_metrics(turns) | axis_metrics(turns) | watch.metrics(turns.apart, inertia)
    plot(run, turns, f"{args.num_turns} turns by {args.angle:g} degrees, {run.title}")
    others = Turns(turns_about_any(args.num_turns, args.angle, args.seed), args.tolerance, args.seconds)
    run.follow(env, others)
    values |= {f"any_axis_{name}": value for name, value in turn_metrics(others).items()}
    return run.report(values, HARDWARE)


if __name__ == "__main__":
    run_command(lambda: main(parse_flags(Args)))
