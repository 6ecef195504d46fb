"""Draw a composite picture of every policy, and the film of the README.

    python experiments/policy_pictures.py --policies vertical_jump walking_flat --out outputs/pictures
    python experiments/policy_pictures.py --save-to-policies

Every policy performs its task once, on SolverJumper with nominal robots. `walk_jump_walk` is one robot with three
policies, and a film. `--save-to-policies` writes `picture.webp` into the policies' folders.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from jumper_warp.evaluation.attitude import AttitudePlayFlags
from jumper_warp.evaluation.conditions import Conditions
from jumper_warp.evaluation.courses import CourseLog
from jumper_warp.evaluation.evaluations import PlayFlags
from jumper_warp.evaluation.jump_metrics import HeightPlayFlags, LandingPlayFlags
from jumper_warp.evaluation.log import run_evaluation
from jumper_warp.evaluation.recorder import EnvRecorder
from jumper_warp.evaluation.run import EvaluationRun, SkillRun
from jumper_warp.evaluation.scripts import read_script
from jumper_warp.evaluation.velocities import VelocityPlayFlags
from jumper_warp.policies.catalog import add_files, find_policy
from jumper_warp.robot.grounds import platform
from jumper_warp.robot.terrain import TerrainCfg, single_tile
from jumper_warp.utils.errors import InputError
from jumper_warp.viz.film import write_film
from jumper_warp.viz.picture import write_picture
from jumper_warp.viz.recording import Recording
from support.scripts import ThreadArgs, announce, prepare, report, run_script, tracked

COURSE = "walk_jump_walk"  # A script with three policies
SCRIPT = Path(__file__).parents[1] / "assets/scripts/walk_jump_walk.json"
FILM_SIZE = (560, 316)  # [px]


@dataclass(frozen=True)
class Shot:
    """Motion that a policy performs in its picture: flags of `jumper play`, title, ground and friction."""

    flags: PlayFlags
    title: str
    ground: Callable[[], Any] = lambda: "plane"  # as in `build_model`
    friction: float | None = None  # [1] of the paws (default: nominal)


def heights(*values: float) -> HeightPlayFlags:
    """Return flags of a recording of jumps to heights [m]."""
    return HeightPlayFlags(values, 6.0)


def goal(ahead: float, left: float = 0.0) -> LandingPlayFlags:
    """Return flags of a recording of one jump to a landing position [m]."""
    return LandingPlayFlags(goal=((ahead, left),))


def walk(ahead: float) -> VelocityPlayFlags:
    """Return flags of a recording of a straight walk of 6 s at a velocity [m/s]."""
    return VelocityPlayFlags(velocity=((ahead, 0.0, 0.0),), command_interval=6.0)


SHOTS = {
    "attitude": Shot(AttitudePlayFlags(), "turn by 90 degrees about the long axis, floating"),
    "horizontal_jump": Shot(goal(1.4), "jump to a place 1.4 m ahead"),
    "mars_horizontal_jump": Shot(goal(3.5), "Mars: jump to a place 3.5 m ahead"),
    "mars_springs_jump": Shot(goal(3.9), "Mars, springs between the knees: jump to a place 3.9 m ahead"),
    "mars_vertical_jump": Shot(heights(3.0), "Mars: jump to 3 m"),
    "mars_vertical_jump_stock": Shot(heights(2.0), "Mars, stock robot: jump to 2 m"),
    "omnidirectional_jump": Shot(goal(-0.5, 0.5), "jump to a place 0.5 m back and 0.5 m to the left"),
    "sighted_jump": Shot(goal(1.3), "jump off a platform of 0.15 m that it sees", lambda: platform(-0.15, edge=0.4)),
    "slippery_jump": Shot(goal(1.2), "friction 0.4: jump to a place 1.2 m ahead", friction=0.4),
    "slippery_waiting_jump": Shot(goal(1.2), "friction 0.4: wait, then jump to a place 1.2 m ahead", friction=0.4),
    "vertical_jump": Shot(heights(1.0), "jump to a base height of 1 m"),
    "walking_flat": Shot(walk(0.8), "walk at 0.8 m/s"),
    "walking_rough": Shot(
        walk(0.5), "walk at 0.5 m/s over stairs that it does not observe",
        lambda: single_tile(TerrainCfg(tile=8.0), "pit"),
    ),
}  # fmt: skip


@dataclass(frozen=True)
class Args(ThreadArgs):
    """Flags of the script that draws pictures of policies."""

    policies: tuple[str, ...] = (*SHOTS, COURSE)  # Names of the policies to draw
    save_to_policies: bool = False  # Write picture.webp into the policies' folders

    def __post_init__(self) -> None:
        unknown = sorted(set(self.policies) - {*SHOTS, COURSE})
        if unknown:
            raise InputError(f"no picture of {unknown[0]!r:.40}; there are {', '.join((*SHOTS, COURSE))}")


def record(name: str) -> Recording:
    """Simulate an episode of a policy, or for COURSE a walk with jumps by three policies, and return the recording."""
    if name == COURSE:
        run = SkillRun()
        log = CourseLog([read_script(SCRIPT)])
        env = run.env(1)
        ground = "plane"
    else:
        shot = SHOTS[name]
        run = EvaluationRun(name)
        log = shot.flags.log(run.evaluation.prepare_task(run.task))
        ground = shot.ground()
        env = run.env(log.count, conditions=Conditions(friction=shot.friction), ground=ground)
    recorder = EnvRecorder(env, log, [0], ground=ground, notes={"task": name})
    run_evaluation(run.actor(env), env, log, on_step=recorder)
    return recorder.recording()


def main(args: Args) -> dict:
    """Draw the pictures of all policies and the film of COURSE, and return the sizes of the files [KiB] by name."""
    folder = prepare("policy_pictures", args, args.threads)
    sizes = {}
    for name in tracked(args.policies, "drawing policies"):
        recording = record(name)
        title = "walk, jump up, walk, jump ahead, walk" if name == COURSE else SHOTS[name].title
        picture = write_picture(recording, folder / f"{name}.webp", title=title)
        paths = [picture]
        if name == COURSE:
            paths.append(write_film(recording, folder / f"{name}_film.webp", size=FILM_SIZE, fps=12.0))
        elif args.save_to_policies:
            add_files(find_policy(name), {"picture.webp": picture.read_bytes()})
        sizes |= {f"{path.name} [KiB]": path.stat().st_size / 1024 for path in paths}
        announce(f"{', '.join(path.name for path in paths)} drawn")
    return report(args, folder, sizes, f"Policies drawn: {len(args.policies)}", ())


if __name__ == "__main__":
    run_script(main, Args)
