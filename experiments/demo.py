"""Show jumps of the robot beside the paper's numbers, and write metrics, plots, pictures, recordings and a film.

    python experiments/demo.py --out outputs/demo

The parts are the open-loop jump, the paper's tests of the vertical and of the horizontal jump, and one filmed jump.
Each test has a folder in the output folder.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from jumper_warp.cli.robot import recorded_jump
from jumper_warp.evaluation.conditions import Conditions
from jumper_warp.evaluation.jump_metrics import LandingPlayFlags
from jumper_warp.evaluation.jumps import JumpLog
from jumper_warp.evaluation.log import run_evaluation
from jumper_warp.evaluation.recorder import EnvRecorder, save_recording
from jumper_warp.evaluation.run import EvaluationRun
from jumper_warp.evaluation.sweeps import DistanceSweep, HeightSweep
from jumper_warp.robot.overlay import RobotOverlay
from jumper_warp.utils.files import Json
from jumper_warp.viz.film import write_film
from support.scripts import DeviceArgs, announce, prepare, report, run_script

SUITES = {"vertical": HeightSweep, "horizontal": DistanceSweep}  # By direction of the jumps
SUMMARY = (
    "open_loop_apex_height_m", "vertical_goal_reached_rate", "vertical_apex_error_abs_mean_m",
    "horizontal_success_rate", "horizontal_goal_distance_at_rest_mean_m", "filmed_goal_distance_at_rest_m",
)  # fmt: skip


@dataclass(frozen=True)
class Args(DeviceArgs):
    """Flags of the demonstration of jumps."""

    num_jumps: int = 200  # Number of vertical and of horizontal jumps
    goal: float = 1.3  # [m] Distance of the filmed jump
    size: tuple[int, int] = (854, 480)  # [px] Width and height of the film


def film_jump(args: Args, folder: Path) -> JumpLog:
    """Let a policy jump once, write picture, recording and film `jump.*`, and return the log."""
    run = EvaluationRun("horizontal_jump")
    run.prepare("demo", Conditions(device=args.device), folder)
    log = LandingPlayFlags(goal=((args.goal, 0.0),)).log(run.evaluation.prepare_task(run.task))
    env = run.env(log.count)
    recorder = EnvRecorder(env, log, [0])
    run_evaluation(run.actor(env), env, log, on_step=recorder)
    save_recording(recorder.recording(), folder, "jump")
    write_film(recorder.recording(), folder / "jump.mp4", size=args.size)
    return log


def main(args: Args) -> Json:
    """Simulate open-loop jump, paper's tests and filmed jump, print one summary, and return the metrics."""
    folder = prepare("demo", args)
    values: Json = {}
    announce("open-loop jump; the first run compiles kernels for up to a minute")
    (folder / "open_loop").mkdir(exist_ok=True)
    values["open_loop_apex_height_m"] = recorded_jump(RobotOverlay({}), folder / "open_loop")
    paper = {"open_loop_apex_height_m": 1.075}
    for name, suite in SUITES.items():
        announce(f"{args.num_jumps} {name} jumps")
        flags = {"num_jumps": args.num_jumps, "device": args.device, "out": folder / f"{name}_jump"}
        run, metrics = suite(policy=f"{name}_jump", **flags).evaluate()
        run.write(metrics)
        values |= {f"{name}_{key}": value for key, value in metrics.items()}
        paper |= {f"{name}_{key}": value for key, value in suite.paper.items()}
    announce(f"film of a jump to {args.goal:g} m")
    values["filmed_goal_distance_at_rest_m"] = float(film_jump(args, folder).outcome.distance_at_rest_m[0, 0])
    done = f"Open-loop jump, {args.num_jumps} vertical and {args.num_jumps} horizontal jumps, one film"
    return report(args, folder, values, done, SUMMARY, paper)


if __name__ == "__main__":
    run_script(main, Args)
