"""`jumper export robot`: write the robot as a file of another simulator."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from jumper_warp.cli.flags import parse


@dataclass(frozen=True)
class ExportRobotCfg:
    """Write the robot for another simulator: MJCF (MuJoCo), URDF with closed loops as YAML, or USD (needs usd-core)."""

    out: Path
    """Folder to write to; existing files are replaced."""
    format: Literal["mjcf", "urdf", "usd"] = "mjcf"
    robot: Path | None = None
    """Folder or name of a robot, or overlay (docs/reference/overlays.md); by default the Jumper."""


def run(args: Sequence[str]) -> None:
    """Run `jumper export robot` with the arguments after these words; raises as `export_robot`."""
    cfg: ExportRobotCfg = parse(ExportRobotCfg, "export robot", args)
    from jumper_warp.robot.export import LOST, export_robot
    from jumper_warp.robot.overlay import load_overlay

    overlay = None if cfg.robot is None else load_overlay(cfg.robot)
    path = export_robot(cfg.format, cfg.out, overlay)
    lost = [] if overlay is None else [name for name in overlay.values if name in LOST[cfg.format]]
    if lost:
        print(f"{cfg.format} has no place for these values of {cfg.robot}: {', '.join(lost)}")
    print(path)
