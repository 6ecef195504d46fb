"""`jumper export`: a run's policy as a folder, or a policy as one ONNX file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

import tyro

from jumper_warp.cli.main import parse


@dataclass(frozen=True)
class ExportCfg:
    """Turn a training run into a policy's folder, or a policy into one ONNX file."""

    source: tyro.conf.Positional[str]
    """A run's folder, a checkpoint, or a policy's name or folder."""
    out: Path | None = None
    """A file that ends in .onnx, or the folder of the new policy (default: policy/ in the run, or <task>.onnx)."""
    newest: bool = False
    """Of a run, take the newest checkpoint, not the best."""
    overwrite: bool = False
    """Replace a policy that is there already, figures and README included."""
    blend: tuple[str, float] | None = None
    """Another policy and its share, 0 to 1, of the mean of both networks' weights; useful where one was trained on from
    the other."""


def run(args: Sequence[str], modules: Sequence[ModuleType] = ()) -> None:
    """Export as the arguments say; raises as `export`. A policy's own interface is enough: no module is needed."""
    export(parse(ExportCfg, "export", args))


def export(cfg: ExportCfg) -> Path:
    """Write what the configuration asks for, print where, and return the path.

    Raises PolicyError: the source cannot be used, two policies cannot be blended, the folder has a file's name, or it
    exists and is not to be overwritten. CheckpointError: the checkpoint cannot be used.
    """
    from jumper_warp.policies.blend import blend
    from jumper_warp.policies.folder import checked_folder, save_policy
    from jumper_warp.policies.onnx import export_onnx
    from jumper_warp.policies.runs import is_run, learning_curve, open_policy

    source = Path(cfg.source)
    if cfg.out is not None and cfg.out.suffix != ".onnx":
        checked_folder(cfg.out)
    trained = is_run(source)
    policy = open_policy(cfg.source, newest=cfg.newest)
    if cfg.blend is not None:
        policy = blend(policy, open_policy(cfg.blend[0]), cfg.blend[1])
    out = cfg.out
    if out is None:
        run = source.parents[1] if source.suffix == ".pt" else source
        out = run / "policy" if trained else Path(f"{policy.interface.task}.onnx")
    if out.suffix == ".onnx":
        path = export_onnx(policy, out)
    else:
        curve = learning_curve(source) if trained else None
        files = {} if curve is None else {"learning_curve.jsonl": curve}
        path = save_policy(out, policy, files=files, overwrite=cfg.overwrite)
    print(path)
    return path
