"""Implementation of `jumper play --dump FILE`: the state in which a term was not finite, as recording and picture."""

from __future__ import annotations

import subprocess
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from jumper_warp.utils.dumps import load_dump
from jumper_warp.utils.output import output_dir


@dataclass(frozen=True)
class DumpCfg:
    """Show the state in which a term of a training was not finite: write a recording and a picture of the robot."""

    dump: Path  # File that the training has written, RUN/non_finite/TERM.npz
    out: Path | None = None  # Folder for the results (default: outputs/play/<time>)
    viewer: Literal["none", "rerun"] = "none"
    """Open the recording in Rerun's viewer. It listens on this machine's loopback address only."""


def play_dump(cfg: DumpCfg) -> Path:
    """Write a recording of one frame and a picture of the state in a dump, and print its values; return the recording.

    The robot is shown on level ground. Raises InputError: the file is no dump; OSError: the folder cannot be created.
    """
    found, header = load_dump(cfg.dump)
    from jumper_warp.evaluation.commands import viewer_command
    from jumper_warp.evaluation.recorder import ankles, save_recording
    from jumper_warp.sim.links import LinkReader
    from jumper_warp.sim.simulation import Simulation
    from jumper_warp.utils.runtime import configure_device
    from jumper_warp.viz.recorder import Recorder

    configure_device("cpu")
    sim = Simulation(1, device="cpu")
    sim.state.joint_q.assign(np.nan_to_num(found.arrays["joint_q"], posinf=0.0, neginf=0.0))
    sim.state.joint_qd.assign(np.nan_to_num(found.arrays["joint_qd"], posinf=0.0, neginf=0.0))
    poses = LinkReader(sim).read()[0]
    units = {name: zip(found.names[name], found.arrays[name], strict=True) for name in ("rewards", "observations")}
    series = {f"{group}/{name} [1]": float(value) for group, values in units.items() for name, value in values}
    notes = {"task": header["task"], "term": found.term, "world": found.world, "step": found.step}
    recorder = Recorder(sim.model, notes=notes, labels=[f"{found.term}, world {found.world}, step {found.step}"])
    recorder.record(0.0, poses.reshape(-1, 7), series, ankles(poses), np.zeros((1, 4, 3)))
    folder = output_dir("play", cfg.out)
    path = save_recording(recorder.recording(), folder, "dump")
    print(f"{header['task']}, iteration {header['iteration']}, seed {header['config']['train']['seed']}: {found}")
    for name in ("rewards", "observations"):
        bad = [
            entry for entry, value in zip(found.names[name], found.arrays[name], strict=True) if value - value != 0.0
        ]
        print(f"{name} that are not finite: {', '.join(bad) or 'none'}")
    print(path)
    if cfg.viewer == "rerun":
        subprocess.run(viewer_command(path), check=False)
    return path
