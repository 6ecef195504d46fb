"""Logs of the runtime in other tools: as motions for identification, and as a recording beside the simulation."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal

import numpy as np

from jumper_warp.bench.bus_sim import BusSim, make_simulation
from jumper_warp.deploy.log import read_log
from jumper_warp.deploy.runtime import State
from jumper_warp.evaluation.commands import open_viewer
from jumper_warp.evaluation.recorder import ankles, save_recording
from jumper_warp.identification.motions import RecordedMotion
from jumper_warp.robot.motors import jumping_motors
from jumper_warp.sim.simulation import Simulation
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.output import output_dir
from jumper_warp.viz.recorder import Recorder

LEAST_SECONDS = 0.5  # [s] of a motion
MOTORS = [7 + 5 * leg + j for leg in range(4) for j in (0, 1, 3)]  # columns of the motors in joint coordinates
DRIVEN = (State.STAND_UP, State.HOLD, State.WALK, State.JUMP_UP, State.JUMP_TO)  # states with position control


def motions_of_log(folder: Path, **settings: Any) -> list[RecordedMotion]:
    """Return the stretches of a log in one state with position control, as motions for identification.

    settings: `base`, `gains` and `torque_limit` [N m] of all motions; "" or 0: free, those of the state, 18.
    Raises InputError: there is none of LEAST_SECONDS, or the log is of a dry run.
    """
    ticks, about = read_log(folder)
    if about.get("dry_run"):
        raise InputError(f"{folder}: log of a dry run, in which no motor was driven")
    given = {name: value for name, value in settings.items() if value}
    rate = about["rate"]
    state = np.where((ticks["kp"] > 0.0).all(axis=1) & np.isin(ticks["state"], DRIVEN), ticks["state"], -1)
    edges = [0, *(np.flatnonzero(np.diff(state)) + 1), len(state)]
    motions = []
    for first, end in pairwise(edges):
        if state[first] < 0 or end - first < LEAST_SECONDS * rate:
            continue
        part = ticks[first + 1 : end]
        names = ("angle", "rate", "torque", "position", "quaternion")
        columns: dict[str, Any] = {name: part[name].astype(float) for name in names}
        columns |= {"gains": "walking" if state[first] == State.WALK else "jumping"} | given
        motion = RecordedMotion(
            f"{folder.name}_{State(int(state[first])).name.lower()}_{first}", time=np.arange(len(part)) / rate,
            **columns, target=ticks["target"][first : end - 1].astype(float),  # sent with the next tick
        )  # fmt: skip
        motions.append(motion)
    if not motions:
        raise InputError(f"{folder}: no {LEAST_SECONDS} s in one state with position control")
    return motions


@dataclass(frozen=True)
class LogCfg:
    """Show a log of the robot beside a simulation with the same commands: write a recording and a picture."""

    log: Path  # Folder of the log
    out: Path | None = None  # Folder for the results (default: outputs/play/<time>)
    viewer: Literal["none", "rerun"] = "none"
    """Open the recording in Rerun's viewer. It listens on this machine's loopback address only."""


def simulated_again(ticks: np.ndarray, rate: int) -> np.ndarray:
    """Return the joint coordinates (ticks, 43) of a simulation that gets a log's commands, from its first pose on.

    It starts at rest, without an estimated position at the default height. rate: ticks per second. A row is the state
    in which a tick's commands arrive.
    """
    far = BusSim([], sim=make_simulation(1.0 / rate))
    q = far.sim.joint_q()[0].copy()
    q[3:7], q[MOTORS] = ticks["quaternion"][0], ticks["angle"][0]
    if ticks["position"][0].any():  # else the height of the default pose
        q[:3] = ticks["position"][0]
    far.sim.state.joint_q.assign(q)
    result = np.empty((len(ticks), len(q)), np.float32)
    for number, frames in enumerate(ticks["sent"]):
        for motor, frame in enumerate(frames):
            far.take(motor, frame.tobytes())
        result[number] = far.sim.joint_q()[0]
        far.advance()
    return result


def play_log(cfg: LogCfg) -> Path:
    """Write the recording of a log and its simulation, print how far they differ, and return its path.

    They begin at the log's first estimated position. The first robot is the log, the second the simulation. Raises
    InputError: the log is damaged.
    """
    ticks, about = read_log(cfg.log)
    ticks = ticks[ticks["position"].any(axis=1).argmax() :]  # from the first estimated position on
    rate = about["rate"]
    simulated = simulated_again(ticks, rate)
    sim = Simulation(2, motors=jumping_motors(), device="cpu")
    recorder = Recorder(sim.model, (0, 1), spacing=1.0, notes={"log": str(cfg.log)}, labels=["log", "simulation"])
    for number in range(0, len(ticks), max(1, rate // 60)):
        q = np.tile(simulated[number], (2, 1))
        q[0, :3], q[0, 3:7] = ticks["position"][number], ticks["quaternion"][number]
        q[0, MOTORS] = ticks["angle"][number]
        sim.state.joint_q.assign(q.ravel())
        poses = sim.links()[0]
        series = {"height/log [m]": float(q[0, 2]), "height/simulation [m]": float(q[1, 2])}
        recorder.record(number / rate, poses.reshape(-1, 7), series, ankles(poses), np.zeros((2, 4, 3)))
    path = save_recording(recorder.recording(), output_dir("play", cfg.out), "log")
    error = np.sqrt(np.mean((simulated[:, MOTORS] - ticks["angle"]) ** 2))
    print(f"{len(ticks) / rate:.1f} s, RMS difference of joint angles {error:.4f} rad")
    print(path)
    open_viewer(path, cfg.viewer)
    return path
