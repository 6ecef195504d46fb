"""Measure how well a policy follows commanded velocities, and write metrics, a plot, a picture and a recording.

    python experiments/walking_tracking.py --policy walking_flat --commands-per-axis 13 --out outputs/walking

There are five tests:

- Tracking: a grid of commands from minus to plus 0.8 m/s, 0.8 m/s and 0.8 rad/s. Each robot gets another command of the
  grid every 3 s. For each point of the grid, one robot gets it at once and one slewed. `jumper evaluate` runs the same.
- Change: the command changes by 0.8 m/s in any direction while the robot walks. A robot has settled when it stays near
  the new command: to the end, or for half a second, regardless of later pushes.
- Top speed: the command rises over three seconds, and must be kept for five more seconds within 10 %.
- Kick: the velocity changes by 0.5 m/s in any direction.
- Gait: a straight walk at 0.8 m/s.

`--randomize` adds the randomisation, noise, latency and pushes of the training. `--solver mujoco` evaluates on physics
that the policy was not trained on.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from jumper_warp.evaluation.run import EvaluationArgs, EvaluationRun
from jumper_warp.evaluation.velocities import AXES, VelocityFlags, VelocityLog, check_velocity_settings
from jumper_warp.tasks.velocity.cfg import VelocityEvaluation
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.metrics import MetricValue, rate
from jumper_warp.viz.plots import figure
from jumper_warp.viz.style import ACTUAL_COLOR
from support.gaits import GaitRecorder
from support.scripts import run_script
from support.walks import (
    HOLD,
    REACH,
    STEP,
    kicked_walks,
    redirected_walks,
    settling_times,
    sped_up_walks,
    speed_metrics,
)  # fmt: skip

GAIT_SPEED = 0.8  # [m/s] Speed of the straight walk whose gait is measured
PAPER = VelocityEvaluation.published
SUMMARY = (*PAPER, "fall_rate", "settling_time_median_s", "top_ahead_m_s", "kicked_fall_rate", "cost_of_transport")


@dataclass(frozen=True)
class Args(EvaluationArgs):
    """Flags of the tests of how well a policy follows commanded velocities."""

    policy: str = "walking_flat"
    commands_per_axis: int = 13
    """Number of commands along each of the three axes; one robot for each combination, and as many in other tests."""
    num_recorded: int = 1  # Number of robots to record for the Rerun viewer, redirected while they walk; 0: none

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.commands_per_axis < 2:
            raise InputError(f"commands_per_axis must be at least 2, got {self.commands_per_axis}")
        check_velocity_settings(self.commands_per_axis**3, 10.0)


def plot_tracking(run: EvaluationRun, walks: VelocityLog, settling: np.ndarray) -> None:
    """Plot mean velocities over commands, and the distribution of settling times, into `tracking.png`.

    walks: of the grid; settling [s]: (robots,), infinite if a robot did not settle.
    """
    history = walks.velocity_history()[round(1.0 / walks.step_dt) : round(walks.times[1] / walks.step_dt)]
    conditions = f"{run.title}, {len(walks.end)} robots"
    with figure(run.folder / "tracking.png", 2, 2, figsize=(9, 9), title="Walking", conditions=conditions) as axes:
        for i, (axis, name) in enumerate(zip(axes.flat, AXES, strict=False)):
            commanded = walks.commands[:, 0, i]
            axis.plot([-REACH, REACH], [-REACH, REACH], color=ACTUAL_COLOR, linestyle="--", label="commanded")
            standing = ~walks.fallen
            mean = history[:, standing, i].mean(axis=0)
            axis.plot(commanded[standing], mean, ".", color=ACTUAL_COLOR, label="mean of a walk")
            label = f"{name.replace('_', ' ')} [{'rad/s' if i == 2 else 'm/s'}]"
            axis.set(xlabel=f"commanded {label}", ylabel=f"mean {label}", aspect="equal")
        times = np.sort(settling)
        axes[1, 1].step(times, np.arange(1, len(times) + 1) / len(times), where="post")
        axes[1, 1].set(
            xlabel=f"time to settle after a step of {STEP} m/s [s]", ylabel="share of robots", xlim=(0.0, 4.0)
        )


def main(args: Args) -> dict:
    """Run all tests of walking, plot tracking and settling times, and return the metrics."""
    run = EvaluationRun.from_args("walking_tracking", args, VelocityEvaluation)
    rng = np.random.default_rng(args.stream_seed)
    flags = VelocityFlags(args.commands_per_axis, (REACH, REACH, REACH))
    log = flags.log(run.task, args.stream_seed)
    walks, env = run.run_episodes(run.env(log.count), log), run.env(args.commands_per_axis**3)
    redirected = run.run_episodes(env, redirected_walks(env, rng), film="walk")
    settling = settling_times(redirected)
    fast, direction = sped_up_walks(env)
    run.run_episodes(env, fast)
    kicked = run.run_episodes(env, kicked_walks(env, rng))
    straight, gait = VelocityLog(np.tile([GAIT_SPEED, 0.0, 0.0], (env.num_envs, 1, 1)), env.task), GaitRecorder(env)
    run.run_episodes(env, straight, on_step=gait)
    plot_tracking(run, walks, settling)
    median, held = (float(np.median(times)) for times in (settling, settling_times(redirected, HOLD)))
    times = {"settling_time_median_s": median, "settling_time_for_half_a_second_median_s": held}
    return run.report(
        flags.metrics(walks)
        | {name: MetricValue(time if np.isfinite(time) else None, env.num_envs, None, "redirected robots")
           for name, time in times.items()}
        | {"redirected_fall_rate": rate(redirected.fallen, "redirected robots"),
           "kicked_fall_rate": rate(kicked.fallen, "kicked robots")}
        | speed_metrics(fast, direction)
        | gait.metrics(~straight.fallen),
        PAPER,
        SUMMARY,
    )  # fmt: skip


if __name__ == "__main__":
    run_script(main, Args)
