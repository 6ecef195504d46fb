"""`jumper robot`: write the folder of a robot of your own, check it, or show its open-loop jump."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from jumper_warp.cli.flags import parse
from jumper_warp.cli.main import UsageError

if TYPE_CHECKING:
    from jumper_warp.robot.overlay import RobotOverlay
    from jumper_warp.sim.simulation import SolverName

USAGE = """\
usage: jumper robot new FOLDER [--from SOURCE]
       jumper robot check ROBOT [--out FOLDER]
       jumper robot show ROBOT [--viewer NAME]

  new    write robot.json, a copy of a robot's quantities with unit and source, to edit
  check  print weight, reach, motors, open-loop jump and what is implausible; draw a picture
  show   open the open-loop jump in the viewer

ROBOT is a folder, a robot.json, an overlay, or one of the project's robots: {names}."""


@dataclass(frozen=True)
class NewCfg:
    """Write the folder of a robot: robot.json with all its quantities, to edit."""

    out: tyro.conf.Positional[Path]  # Folder to write to
    like: Annotated[str, tyro.conf.arg(name="from")] = "jumper"
    """Robot to copy: jumper, another ROBOT, or a URDF with loop_closures.yaml beside it."""


@dataclass(frozen=True)
class CheckCfg:
    """Check a robot: print its measures and what is implausible, and draw a picture."""

    robot: tyro.conf.Positional[str]  # Folder, robot.json, overlay, or name of one of the project's robots
    out: Path | None = None  # Folder for the picture and the recording (default: outputs/robot/<time>)
    solver: Literal["jumper", "mujoco"] = "jumper"  # Physics of the open-loop jump


@dataclass(frozen=True)
class ShowCfg(CheckCfg):
    """Show a robot's open-loop jump."""

    viewer: Literal["rerun", "none"] = "rerun"  # Viewer to open


def run(args: Sequence[str], modules: Sequence[Any] = ()) -> None:
    """Run `jumper robot` with the given arguments. Raises InputError or OSError: a robot cannot be read or written.

    modules: unused; all commands take it.
    """
    from jumper_warp.robot.overlay import ROBOTS

    actions = {"new": (NewCfg, new), "check": (CheckCfg, check), "show": (ShowCfg, show)}
    if not args or args[0] not in actions:
        usage = USAGE.format(names=", ".join(sorted(file.parent.name for file in ROBOTS.glob("*/robot.json"))))
        if args and args[0] in ("-h", "--help"):
            print(usage)
            return
        raise UsageError("expected jumper robot new, check or show; see jumper robot --help")
    kind, action = actions[args[0]]
    action(parse(kind, f"robot {args[0]}", args[1:]))


def robot_at(source: str) -> RobotOverlay:
    """Return the robot at a path or of a name. Raises InputError."""
    from jumper_warp.robot.overlay import RobotOverlay, load_overlay

    return RobotOverlay({}) if source == "jumper" else load_overlay(Path(source))


def new(cfg: NewCfg) -> None:
    """Write the table of a robot to a folder, which must not have one; print the values that it loses, and its path."""
    from jumper_warp.robot.description import LEGS
    from jumper_warp.robot.export import LOST
    from jumper_warp.robot.folder import FILE, read_urdf, table_of, write_robot
    from jumper_warp.robot.values import described

    if (cfg.out / FILE).exists():
        raise UsageError(f"{cfg.out / FILE} exists")
    if Path(cfg.like).suffix == ".urdf":
        table = table_of(read_urdf(Path(cfg.like)), cfg.like)
    else:
        robot = robot_at(cfg.like)
        table = robot.robot if robot.robot and not robot.values else None
        table = table or table_of(described(robot.robots(), robot.description), cfg.like)
        types = [motor.type for motor in robot.description.motors]
        kinds = {name: len({*zip(types, row, strict=False)}) for name, row in robot.values.items() if len(row) == 12}
        lost = [name for name in robot.values if name in LOST[FILE] or kinds.get(name, 0) > len({*types})]
        lost += [leg for leg in LEGS if robot.values and leg in (robot.robot or {})]
        lost += ["randomization"] if robot.randomization else []
        if lost:
            print(f"{FILE} lacks these values of {cfg.like}, or has one a type of motor: {', '.join(lost)}")
    print(write_robot(cfg.out, {**table, "name": cfg.out.name}))


def check(cfg: CheckCfg) -> Path:
    """Print a robot's measures and what is implausible, write picture and recording, and return the recording."""
    from jumper_warp.robot.plausible import facts, implausible
    from jumper_warp.robot.values import described
    from jumper_warp.utils.output import output_dir

    robot = robot_at(cfg.robot)
    description = described(robot.robots(), robot.description)
    folder = output_dir("robot", cfg.out)
    apex = recorded_jump(robot, folder, cfg.solver)
    for name, value in facts(description).items():
        print(f"{name:<22}{value}")
    print(f"{'open-loop apex':<22}{apex:.3f} m (SolverJumper)" if cfg.solver == "jumper" else f"apex {apex:.3f} m")
    for line in implausible(description, apex):
        print(f"implausible: {line}")
    print(folder / "robot.png")
    return folder / "jump.rrd"


def recorded_jump(robot: RobotOverlay, folder: Path, solver: SolverName = "jumper") -> float:
    """Write recording `jump.rrd` and picture `robot.png` of an open-loop jump to a folder; return its apex [m]."""
    from jumper_warp.sim.apex import OpenLoopJump
    from jumper_warp.viz.recorder import Recorder

    jump = OpenLoopJump(robot, solver, visuals=True)
    recorder = Recorder(jump.sim.model, notes={"robot": robot.description.name})
    apex = jump.run(lambda: recorder.record(recorder.frames / 60.0, jump.sim.links()[0][0]))
    recorder.save_rrd(folder / "jump.rrd")
    recorder.save_picture(folder / "robot.png")
    return apex


def show(cfg: ShowCfg) -> None:
    """Check a robot, and open the recording of its jump."""
    from jumper_warp.evaluation.commands import open_viewer

    path = check(cfg)
    print(path)
    open_viewer(path, cfg.viewer)
