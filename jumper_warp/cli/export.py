"""`jumper export`: save a policy as a folder or one ONNX file, a bundle for the robot, or a web page with policies."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

import tyro

from jumper_warp.cli.flags import parse
from jumper_warp.utils.errors import InputError

if TYPE_CHECKING:
    from jumper_warp.policies.policy import Policy


@dataclass(frozen=True)
class ExportCfg:
    """Save the policy of a training run as a folder, or a policy as one ONNX file."""

    sources: tyro.conf.Positional[tuple[str, ...]] = ()
    """Name or folder of a policy, folder of a training run, logs/TASK for the task's newest run, or checkpoint; several
    of them with --bundle, several or none with --page."""
    out: Path | None = None
    """ONNX file, or folder of the new policy (default: policy/ in the run's folder; of a policy <task>.onnx)."""
    newest: bool = False  # Export the newest checkpoint of a run, not the best
    overwrite: bool = False  # Replace an existing policy with its metrics and README
    page: Path | None = None
    """Folder of a static web page on which a visitor drives the robot, with these policies and the project's others."""
    bundle: bool = False
    """Write a folder for the robot: policies with their conformance vectors, deploy.yaml and the runtime deploy.pyz."""


def run(args: Sequence[str], modules: Sequence[ModuleType] = ()) -> None:
    """Run `jumper export` or `jumper export robot`; raises as `export` or `export_robot`.

    modules: unused; all commands take it.
    """
    if args[:1] == ["robot"]:
        from jumper_warp.cli import export_robot

        export_robot.run(args[1:])
        return
    export(parse(ExportCfg, "export", args))


def export(cfg: ExportCfg) -> Path:
    """Write a policy as a folder or an ONNX file, print its path and return it.

    For a training run, also prints on standard error which checkpoint is exported. Raises PolicyError: the source
    cannot be used, the folder has a file's suffix, or exists without `overwrite`.
    CheckpointError: the checkpoint cannot be used.
    """
    from jumper_warp.policies.catalog import run_folder
    from jumper_warp.policies.policy import Policy, checked_folder, export_onnx, learning_curve, save_policy
    from jumper_warp.rl.run_names import CHECKPOINTS

    if cfg.page is not None and (cfg.bundle or cfg.out is not None):
        raise InputError("--page excludes --bundle and --out")
    if cfg.page is not None:
        return export_page(cfg, cfg.page)
    if cfg.bundle and cfg.sources:
        return export_for_robot(cfg)
    if len(cfg.sources) != 1:
        raise InputError("give one policy, or several with --page or --bundle")
    if cfg.out is not None and cfg.out.suffix != ".onnx":
        checked_folder(cfg.out, cfg.overwrite)
    policy = Policy.load(cfg.sources[0], newest=cfg.newest)
    source = Path(policy.source)
    trained = policy.checkpoint is not None
    if trained:
        chosen = ("newest " if cfg.newest else "best ") if (source / CHECKPOINTS).is_dir() else ""
        print(f"{run_folder(source)}: {chosen}checkpoint, iteration {policy.config['iteration']}", file=sys.stderr)
    out = cfg.out
    if out is None:
        out = run_folder(source) / "policy" if trained else Path(f"{policy.interface.task}.onnx")
    if out.suffix == ".onnx":
        path = export_onnx(policy, out)
    else:
        curve = learning_curve(source) if trained else None
        files = {} if curve is None else {"learning_curve.jsonl": curve}
        files |= files_for_page(policy, out.name)
        path = save_policy(out, policy, files=files, overwrite=cfg.overwrite)
    print(path)
    return path


def files_for_page(policy: Policy, name: str) -> dict[str, bytes]:
    """Return a policy's files for the web page, content by name; if the page cannot run it, print why and return {}.

    Nothing is printed for a user's task, whose file is not needed here.
    """
    from jumper_warp.live.site import browser_files
    from jumper_warp.tasks.saving import TaskError

    try:
        return browser_files(policy, name)
    except TaskError:
        return {}
    except InputError as error:
        print(f"without files for the web page: {error}", file=sys.stderr)
        return {}


def export_page(cfg: ExportCfg, folder: Path) -> Path:
    """Write a web page with policies to a folder, print the path of its index.html and return it.

    Raises InputError or PolicyError: see `write_page`.
    """
    from jumper_warp.live.site import write_page
    from jumper_warp.policies.policy import Policy

    path = write_page(folder, [Policy.load(source, newest=cfg.newest) for source in cfg.sources])
    print(path)
    return path


def export_for_robot(cfg: ExportCfg) -> Path:
    """Write a bundle of several policies, print its folder and return it. Raises InputError: see `export_bundle`."""
    from jumper_warp.bench.bundle import FILE, export_bundle
    from jumper_warp.policies.policy import Policy, checked_folder

    folder = cfg.out or Path("bundle")
    if not (cfg.overwrite and (folder / FILE).is_file()):
        checked_folder(folder, cfg.overwrite)
    named = [(Path(source).name.replace("-", "_"), Policy.load(source, newest=cfg.newest)) for source in cfg.sources]
    print(export_bundle(named, folder))
    return folder
