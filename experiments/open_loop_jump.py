"""The open-loop jump of the paper: squat, hold, then command full extension, through filter and motors.

    python experiments/open_loop_jump.py --solver jumper --torque 18 --out outputs/jump

The hardware reached 1.075 m at 18 N m with the gains and filter of the policies. With 24.8 N m, stiffer gains and a
looser filter, neither of which it states, the paper's simulation gives 1.42 m: `--torque 24.8 --loose --kp 20`.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import matplotlib
import numpy as np
import tyro
import warp as wp
from rich.console import Console
from rich.table import Table

from jumper_warp.robot.model import LEGS, MOTOR_JOINTS, build_model
from jumper_warp.robot.motors import MotorCfg, jumping_motors, loose_filter, vertical_jump_filter
from jumper_warp.sim.simulation import Simulation, motor_values
from jumper_warp.utils.output import output_dir, write_figures
from jumper_warp.utils.runtime import report_device
from jumper_warp.viz.recorder import Recorder
from jumper_warp.viz.snapshot import Camera, contact_sheet

matplotlib.use("Agg")
import matplotlib.pyplot as plt

HARDWARE_APEX = 1.075
"""[m] Paper, open loop on the robot at 18 N m."""
STAND, RAMP, HOLD, EXTEND, LAND = 60, 25, 50, 40, 60
"""Ticks of 1/60 s: default pose, ramp into the squat, squat, full extension, default pose again."""


MOMENTS = (0.9, 2.2, 2.32, 2.45, 2.7, 2.95, 3.15, 3.8)
"""[s] Of the filmstrip: standing, squatting, push-off, rising, apex, falling, landing, standing."""
PER_MOTOR = tuple(f"peak_{what}_{leg}" for what in ("torque", "speed") for leg in LEGS)
"""Beginnings of the figures that are saved but not printed."""


@dataclass(frozen=True)
class Args:
    """Flags."""

    solver: Literal["jumper", "mujoco"] = "jumper"
    torque: float = 18.0
    """[N m] Torque saturation of the motors; lateral motors give 18 at most."""
    kp: float = 17.0
    """[N m/rad] Position gain of the transversal motors."""
    loose: bool = False
    """A looser filter, as for the paper's 1.42 m."""
    out: Path | None = None
    """Folder for figures, plot and recording (default: outputs/open_loop_jump/<time>)."""
    device: str | None = None
    """Warp device."""


def transversal_command(tick: int) -> float:
    """Return the commanded transversal angle [rad] at a tick."""
    ramp = np.clip((tick - STAND) / RAMP, 0.0, 1.0)
    degrees = 45.0 + 90.0 * ramp
    if tick >= STAND + RAMP + HOLD:
        degrees = -45.0
    if tick >= STAND + RAMP + HOLD + EXTEND:
        degrees = 45.0
    return np.radians(degrees)


def motors(args: Args) -> MotorCfg:
    """Return the motors of the chosen variant."""
    cfg = jumping_motors(args.torque)
    return replace(cfg, transversal=replace(cfg.transversal, kp=args.kp))


@dataclass
class Trace:
    """What was measured at every physics step."""

    time: np.ndarray  # (n,) [s]
    height: np.ndarray  # (n,) [m]
    speed: np.ndarray  # (n,) [m/s], vertical, of the base origin
    angle: np.ndarray  # (n, 12) [rad]
    rate: np.ndarray  # (n, 12) [rad/s]
    torque: np.ndarray  # (n, 12) [N m]
    force: np.ndarray  # (n, 4, 3) [N]
    gap: np.ndarray  # (n,) [m]


def run(args: Args) -> tuple[Trace, Recorder, list[np.ndarray]]:
    """Simulate the jump; also return a recording at 60 Hz, and the body poses of six moments."""
    command_filter = loose_filter() if args.loose else vertical_jump_filter()
    sim = Simulation(1, solver=args.solver, motors=motors(args), command_filter=command_filter, device=args.device)
    recorder = Recorder(sim.model, notes={"solver": args.solver, "torque_nm": args.torque, "kp": args.kp})
    rows, frames = [], []
    total = STAND + RAMP + HOLD + EXTEND + LAND
    for tick in range(total):
        target = np.tile([0.0, 1.0, 1.0], 4) * transversal_command(tick)
        sim.target.assign(target[:, None].astype(np.float32))
        sim.filter_targets()
        for _ in range(sim.substeps):
            sim.physics_step()
            now = (len(rows) + 1) * sim.dt
            q, qd = sim.joint_q()[0], sim.joint_qd()[0]
            rows.append(
                (now, q[2], sim.base_velocity()[0, 2], motor_values(q[7:]), motor_values(qd[6:]),
                 sim.torque.numpy()[:, 0].copy(), sim.paw_force.numpy()[:, 0].copy(), sim.loop_gap()[0])
            )  # fmt: skip
        record(recorder, sim, rows[-1])
        frames.append(sim.state.body_q.numpy().copy())
    return Trace(*(np.array(column) for column in zip(*rows, strict=True))), recorder, frames


def record(recorder: Recorder, sim: Simulation, row: tuple) -> None:
    """Add a frame to the recording."""
    now, height, speed, angle, rate, torque, force, _ = row
    series = {"base/height [m]": height, "base/vertical speed [m s⁻¹]": speed}
    for i, name in enumerate(MOTOR_JOINTS):
        series[f"torque/{name} [N m]"] = torque[i]
        series[f"angle/{name} [deg]"] = np.degrees(angle[i])
        series[f"speed/{name} [rad s⁻¹]"] = rate[i]
    paws = sim.state.body_q.numpy()[[5, 10, 15, 20]]
    down = np.array([0.0, 0.0, -0.3])
    points = paws[:, :3] + down + 2.0 * np.cross(paws[:, 3:6], np.cross(paws[:, 3:6], down) + paws[:, 6:] * down)
    for i, leg in enumerate(LEGS):
        series[f"paw force/{leg} [N]"] = float(np.linalg.norm(force[i]))
    recorder.record(now, sim.state.body_q, series, contact_points=points, contact_forces=force)


def draw_filmstrip(frames: list[np.ndarray], path: Path) -> None:
    """Draw the robot at a few moments side by side; frames: body poses of every tick, (21, 7) each."""
    model = build_model(1)
    state = model.state()
    camera = Camera(model, eye=(1.6, 2.0, 0.75), target=(0.0, 0.0, 0.55), size=(300, 400))
    pictures = []
    for moment in MOMENTS:
        state.body_q.assign(frames[round(60 * moment)])
        pictures.append(camera.picture(state))
    contact_sheet(pictures, path, [f"{moment:.2f} s" for moment in MOMENTS])


def figures(args: Args, trace: Trace) -> dict:
    """Return the figures of the jump."""
    contact = np.linalg.norm(trace.force, axis=2).max(axis=1) > 0.1
    extend = trace.time > (STAND + RAMP + HOLD) / 60.0
    apex = int(np.argmax(np.where(extend, trace.height, 0.0)))
    takeoff = int(np.flatnonzero(contact[:apex])[-1])
    push = trace.time <= trace.time[takeoff]
    values = {
        "solver": args.solver,
        "torque_limit_nm": args.torque,
        "kp_nm_rad": args.kp,
        "loose_filter": args.loose,
        "apex_height_m": trace.height[apex],
        "apex_time_s": trace.time[apex] - (STAND + RAMP + HOLD) / 60.0,
        "takeoff_speed_m_s": trace.speed[takeoff],
        "takeoff_height_m": trace.height[takeoff],
        "takeoff_time_s": trace.time[takeoff] - (STAND + RAMP + HOLD) / 60.0,
        "squat_height_m": trace.height[int((STAND + RAMP + HOLD) * 8 - 1)],
        "peak_torque_nm": np.abs(trace.torque).max(),
        "peak_speed_rad_s": np.abs(trace.rate).max(),
        "peak_contact_force_n": np.linalg.norm(trace.force.sum(axis=1), axis=1)[push].max(),
        "peak_landing_force_n": np.linalg.norm(trace.force.sum(axis=1), axis=1)[apex:].max(),
        "largest_loop_gap_mm": 1000.0 * trace.gap.max(),
        "hardware_apex_height_m": HARDWARE_APEX if args.torque == 18.0 and not args.loose else None,
    }
    for i, name in enumerate(MOTOR_JOINTS):
        values[f"peak_torque_{name}_nm"] = np.abs(trace.torque[:, i]).max()
        values[f"peak_speed_{name}_rad_s"] = np.abs(trace.rate[:, i]).max()
    return {name: float(v) if isinstance(v, np.floating) else v for name, v in values.items()}


def plot(trace: Trace, path: Path, title: str) -> None:
    """Draw height, vertical speed, angles, torques and paw forces over time."""
    fig, axes = plt.subplots(5, 1, figsize=(9, 12), sharex=True, constrained_layout=True)
    axes[0].plot(trace.time, trace.height)
    axes[0].axhline(HARDWARE_APEX, color="0.6", linestyle="--", label="hardware, 18 N m")
    axes[0].legend(loc="upper left")
    axes[1].plot(trace.time, trace.speed)
    for i, name in enumerate(MOTOR_JOINTS):
        if name.endswith(("outer", "inner")) and name.startswith(("FL", "BL")):
            axes[2].plot(trace.time, np.degrees(trace.angle[:, i]), label=name)
            axes[3].plot(trace.time, trace.torque[:, i], label=name)
    for i, leg in enumerate(LEGS):
        axes[4].plot(trace.time, trace.force[:, i, 2], label=leg)
    labels = ("base height [m]", "vertical speed [m/s]", "motor angle [deg]", "motor torque [N m]", "paw force [N]")
    for axis, label in zip(axes, labels, strict=True):
        axis.set_ylabel(label)
        axis.grid(alpha=0.3)
    for axis in axes[2:]:
        axis.legend(ncols=4, fontsize=8, loc="upper left")
    axes[-1].set_xlabel("time [s]")
    fig.suptitle(title)
    fig.savefig(path, dpi=110)
    plt.close(fig)


def show(values: dict) -> None:
    """Print the figures."""
    table = Table(title=f"Open-loop jump, {values['solver']}, {values['torque_limit_nm']:g} N m")
    table.add_column("figure")
    table.add_column("value", justify="right")
    for name, value in values.items():
        if isinstance(value, float) and not name.startswith(
            ("peak_torque_F", "peak_torque_B", "peak_speed_F", "peak_speed_B")
        ):
            table.add_row(name, f"{value:.4f}")
    Console().print(table)


def main(args: Args) -> dict:
    """Run the experiment and return its figures."""
    wp.config.log_level = wp.LOG_WARNING
    report_device(args.device)
    folder = output_dir("open_loop_jump", args.out)
    start = time.perf_counter()
    trace, recorder, frames = run(args)
    draw_filmstrip(frames, folder / "jump_strip.png")
    values = figures(args, trace)
    write_figures(folder, values)
    plot(trace, folder / "jump.png", f"Open-loop jump, {args.solver}, {args.torque:g} N m")
    recorder.save_rrd(folder / "jump.rrd")
    show(values)
    print(f"{time.perf_counter() - start:.1f} s; figures, plot and recording (rerun {folder / 'jump.rrd'}) in {folder}")
    return values


if __name__ == "__main__":
    main(tyro.cli(Args))
