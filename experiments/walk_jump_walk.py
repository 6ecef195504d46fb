"""Measure how well a robot switches between three policies, and write metrics, a plot, a picture and a recording.

    python experiments/walk_jump_walk.py --num-robots 200 --out outputs/walk_jump_walk

This is the paper's test: every robot walks by random commands, sampled every two seconds within 0.8 m/s and 0.8 rad/s,
jumps to 0.75 m, walks, jumps 0.85 m ahead, and walks. A jump is commanded while the robot walks: it stops, stands,
jumps, and walks again. `finished_rate` is the fraction of robots that finish every command without a fall.

`--course` gives every robot ten random commands instead: to walk, turn, jump up, jump to a landing position, or jump
onto a sliding block of 0.05 m (no block on SolverMuJoCo). The block is placed under the goal when the jump begins.
`--randomize` adds the jumps' randomisation, noise, latency and pushes. `--solver mujoco` evaluates on physics that the
policies were not trained on.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from jumper_warp.evaluation.courses import CourseLog, course_metrics, plot_course
from jumper_warp.evaluation.jumps import random_headings
from jumper_warp.evaluation.run import EvaluationArgs, SkillRun
from jumper_warp.evaluation.scripts import ScriptStep
from jumper_warp.evaluation.skills import SkillNames
from jumper_warp.tasks.velocity.cfg import VelocityEvaluation
from jumper_warp.utils.errors import InputError
from support.scripts import run_script

REACH, EACH = 0.8, 2.0  # [m/s] and [rad/s] Limit of commanded velocities; [s] time of each walking command
HEIGHT, DISTANCE = 0.75, 0.85  # [m] Apex height and distance of the paper's two jumps
WALKS = (3, 3, 2)  # Numbers of walking commands before, between and after the jumps
COMMANDS = 10  # Number of commands in a course
JUMPS = ("jump_up", "jump_to", "jump_onto")  # Kinds of `ScriptStep`
SUMMARY = (
    "finished_rate", "finished_on_goal_rate", "fall_rate", "apex_error_abs_mean_m", "goal_distance_at_handover_mean_m",
    *(f"settled_{key}" for key in VelocityEvaluation.published),
)  # fmt: skip
PROBABILITIES = (0.35, 0.2, 0.15, 0.15, 0.15)  # Probabilities of walking, turning and each of the jumps


@dataclass(frozen=True)
class Args(EvaluationArgs):
    """Flags of the test of a robot that switches between walking and jumping policies."""

    policy: str = "walking"  # Policy that walks: name or folder, a run's folder, or a checkpoint
    jump_up: str = "vertical_jump"  # Policy that jumps to heights
    jump_to: str = "horizontal_jump"  # Policy that jumps to places
    num_robots: int = 200  # Number of robots; each has its own commands
    course: bool = False  # Ten random commands a robot instead of the paper's test
    blocks: bool = True  # Whether courses have blocks to jump onto; SolverMuJoCo has none

    def __post_init__(self) -> None:
        """Raise InputError for a number of robots out of range."""
        super().__post_init__()
        if not 1 <= self.num_robots <= 20_000:
            raise InputError(f"num_robots must be in 1 to 20000, got {self.num_robots}")


def random_walks(rng: np.random.Generator, count: int) -> list[ScriptStep]:
    """Return `count` walking commands with random velocities within REACH, EACH seconds long."""
    return [ScriptStep("walk", tuple(rng.uniform(-REACH, REACH, 3).tolist()), EACH) for _ in range(count)]


def paper_script(rng: np.random.Generator) -> list[ScriptStep]:
    """Return the sequence of commands of the paper's test: random walks, a jump up, walks, a jump ahead, walks."""
    up = ScriptStep("jump_up", (HEIGHT,))
    ahead = ScriptStep("jump_to", (DISTANCE, 0.0))
    before, between, after = (random_walks(rng, count) for count in WALKS)
    return [*before, up, *between, ahead, *after]


def random_script(rng: np.random.Generator, blocks: bool = True) -> list[ScriptStep]:
    """Return a script of COMMANDS random commands to walk, turn in place or jump, with each kind of jump at least once.

    blocks: False to replace jumps onto a block by jumps to a position.
    """
    random_kinds = rng.choice(["walk", "turn", *JUMPS], COMMANDS - len(JUMPS), p=PROBABILITIES)
    script = []
    for kind in rng.permutation([*JUMPS, *random_kinds]):
        if kind == "walk":
            script += random_walks(rng, 1)
        elif kind == "turn":
            rate = float(rng.choice([-1.0, 1.0]) * rng.uniform(0.3, REACH))
            script.append(ScriptStep("walk", (0.0, 0.0, rate), EACH))
        elif kind == "jump_up":
            script.append(ScriptStep("jump_up", (float(rng.uniform(0.55, 0.95)),)))
        elif kind == "jump_to" or not blocks:
            script.append(ScriptStep("jump_to", (float(rng.uniform(0.4, 1.1)), float(rng.uniform(-0.2, 0.2)))))
        else:  # so far that no corner of the block is under the robot, whatever its heading
            script.append(ScriptStep("jump_onto", (float(rng.uniform(1.2, 1.5)), float(rng.uniform(-0.1, 0.1)))))
    return script


def scripts(args: Args) -> list[list[ScriptStep]]:
    """Return one script of walks and jumps per robot."""
    rng = np.random.default_rng(args.stream_seed)
    blocks = args.blocks and args.solver == "jumper"
    return [random_script(rng, blocks) if args.course else paper_script(rng) for _ in range(args.num_robots)]


def main(args: Args) -> dict:
    """Simulate robots that walk and jump by scripts, plot the course of robot 0, and return the metrics."""
    name = "course" if args.course else "walk_jump_walk"
    run = SkillRun(SkillNames(args.policy, args.jump_up, args.jump_to)).prepare_from(name, args)
    course = CourseLog(scripts(args), random_headings(args.num_robots, args.stream_seed))
    course.warn_beyond_training(run.tasks)
    run.run_episodes(run.env(args.num_robots, block=course.block), course, film=name)
    plot_course(run.folder / "timeline.png", course, 0, f"{run.title}, robot 0 of {course.count}")
    paper = {} if args.course else {f"settled_{key}": value for key, value in VelocityEvaluation.published.items()}
    return run.report(course_metrics(course), paper, SUMMARY)


if __name__ == "__main__":
    run_script(main, Args)
