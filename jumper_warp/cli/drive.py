"""`jumper drive [POLICY …]`: drive a robot from the browser while it is simulated."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import astuple, dataclass, field
from pathlib import Path
from types import ModuleType
from typing import Annotated, Literal

import tyro

from jumper_warp.cli.flags import parse
from jumper_warp.evaluation.conditions import Conditions
from jumper_warp.evaluation.skills import SkillNames


@dataclass(frozen=True)
class DriveCfg:
    """Drive a robot from the browser: it walks and jumps as you command, in real time.

    jumper drive [POLICY …] [flags]: POLICY is as for `jumper play`. Several policies are one that walks, then those
    that jump; by default those of the project. The page listens on this machine's loopback address only.
    """

    policies: tyro.conf.Positional[tuple[str, ...]] = field(default_factory=lambda: astuple(SkillNames()))
    """Policies, runs or checkpoints; with another agent also a task, or a JSON file with a recipe."""
    agent: Literal["policy", "hold", "random"] = "policy"
    """Source of the actions: the policies, the default pose, or random numbers."""
    conditions: Annotated[Conditions, tyro.conf.arg(name="")] = field(default_factory=Conditions)
    """Conditions of the simulation."""
    ground: Literal["flat", "uneven", "waves", "slope", "stairs", "blocks"] = "flat"  # Ground at the start
    port: int = 8080  # Port of the page; the next free one is used if it is taken
    out: Path | None = None  # Folder for recordings (default: outputs/drive)


def run(args: Sequence[str], modules: Sequence[ModuleType] = ()) -> None:
    """Run `jumper drive` with the given arguments; modules: loaded by --task-module, for tasks outside the project.

    Raises InputError or OSError: viser is not installed, or a policy or a flag is invalid. Exits with 0 after help.
    """
    drive(parse(DriveCfg, "drive", args), modules)


def drive(cfg: DriveCfg, modules: Sequence[ModuleType]) -> None:
    """Serve the page until Ctrl-C."""
    from jumper_warp.live.page import Page
    from jumper_warp.live.session import Session, load
    from jumper_warp.utils.progress import phase
    from jumper_warp.utils.runtime import configure_device
    from jumper_warp.viz.viser import open_server

    server = open_server(cfg.port)
    configure_device(cfg.conditions.device, cfg.conditions.threads or 1)  # small networks are slower on several threads
    with phase("building the robot"):
        loaded = [load(source, cfg.agent, modules) for source in cfg.policies]
        recipes, policies = zip(*loaded, strict=True)
        session = Session(recipes, policies, cfg.conditions, cfg.ground, cfg.agent)
        page = Page(server, session, cfg.out or Path("outputs", "drive"))
    port = server.get_port()
    print(f"Drive at http://localhost:{port} (Ctrl-C ends).")
    print(f"From another machine: ssh -L {port}:localhost:{port} THIS_HOST, then open the same address.", flush=True)
    try:
        page.run()
    finally:
        server.stop()
