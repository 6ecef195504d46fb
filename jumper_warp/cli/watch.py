"""`jumper watch RUN` shows a training that runs or has ended: robots, reward terms and learning curves."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Literal

from jumper_warp.cli.flags import parse
from jumper_warp.cli.main import UsageError
from jumper_warp.utils.checks import check_not_negative


@dataclass(frozen=True)
class WatchArgs:
    """Show a training that runs or has ended, in the Rerun viewer or in a browser.

    jumper watch RUN joins the view of a training with --watch, else it simulates the run's newest checkpoint. RUN is a
    run's folder, or logs/TASK for the task's newest run.
    """

    seconds: float | None = None  # [s] Time after which to end (default: until Ctrl-C)
    device: str = "cpu"  # Device on which a checkpoint is simulated
    viewer: Literal["rerun", "viser"] = "rerun"  # The Rerun viewer, or a page in the browser


def run(args: Sequence[str], modules: Sequence[ModuleType] = ()) -> None:
    """Run `jumper watch` with the given arguments; args: the run's folder, then flags.

    modules: loaded by --task-module, for tasks outside the project. Raises UsageError: no run is given. PolicyError,
    CheckpointError or TaskError: the run cannot be shown. Exits with 0 after help.
    """
    named = bool(args) and not args[0].startswith("-")
    cfg = parse(WatchArgs, "watch RUN", args[named:])
    if not named:
        raise UsageError("the run comes first: jumper watch RUN [flags]")
    if cfg.seconds is not None:
        check_not_negative("seconds", cfg.seconds)
    from jumper_warp.live.feed import live_address
    from jumper_warp.viz.rerun_server import announce

    if address := live_address(Path(args[0])):
        announce(*address)
        return
    from jumper_warp.live.checkpoints import watch_checkpoints
    from jumper_warp.policies.catalog import find_policy, newest_run
    from jumper_warp.utils.runtime import configure_device

    folder = find_policy(newest_run(args[0]))
    configure_device(cfg.device)
    watch_checkpoints(folder, cfg.device, modules, cfg.seconds, cfg.viewer)
