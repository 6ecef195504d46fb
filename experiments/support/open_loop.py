"""The open-loop jump (squat, hold, full extension), measured at every physics step."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from jumper_warp.evaluation.recorder import ankles
from jumper_warp.robot.description import LEGS, MOTOR_JOINTS
from jumper_warp.sim.apex import EXTEND, HOLD, RAMP
from jumper_warp.sim.simulation import Simulation, motor_values
from jumper_warp.viz.plots import figure
from jumper_warp.viz.style import LEG_COLORS

if TYPE_CHECKING:
    from jumper_warp.viz.recorder import Recorder

STAND, LAND = 60, 60  # Numbers of policy steps in the default pose before and after the jump
SQUAT = 135.0  # [deg] Commanded transversal angle of the squat, which the command filter does not let the legs reach


def largest_forces(forces: np.ndarray) -> np.ndarray:
    """Return each paw's force vector [N] at the step where its norm is largest, (4, 3); forces: (steps, 4, 3)."""
    return forces[np.linalg.norm(forces, axis=2).argmax(axis=0), np.arange(forces.shape[1])]


def transversal_command(tick: int, squat: float = SQUAT) -> float:
    """Return the angle [rad] that the open-loop jump commands to the transversal motors at a policy step.

    The default pose has 45 degrees; -45 degrees extend the legs.
    tick: the policy step; squat [deg]: commanded angle of the squat.
    """
    degrees = 45.0 + (squat - 45.0) * np.clip((tick - STAND) / RAMP, 0.0, 1.0)
    if tick >= STAND + RAMP + HOLD:
        degrees = -45.0 if tick < STAND + RAMP + HOLD + EXTEND else 45.0
    return np.radians(degrees)


@dataclass
class Trace:
    """Measurements of the open-loop jump at every physics step; motors and paws in the order of legs FL, FR, BL, BR."""

    time: np.ndarray  # (n,) [s]
    height: np.ndarray  # (n,) [m] of the base
    speed: np.ndarray  # (n,) [m/s] upward speed of the base origin
    angle: np.ndarray  # (n, 12) [rad] of the motors
    rate: np.ndarray  # (n, 12) [rad/s] of the motors
    torque: np.ndarray  # (n, 12) [N m] of the motors
    force: np.ndarray  # (n, 4, 3) [N] on the paws, world axes
    gap: np.ndarray  # (n,) [m] largest gap of the legs' closed loops


def simulate_jump(sim: Simulation, notes: Mapping[str, Any], squat: float = SQUAT) -> tuple[Trace, Recorder]:
    """Simulate the open-loop jump in world 0; return measurements and a recording at 60 Hz.

    notes: JSON metadata of the recording; squat [deg]: commanded transversal angle of the squat.
    """
    from jumper_warp.viz.recorder import Recorder

    recorder = Recorder(sim.model, notes=notes)
    rows = []
    total = STAND + RAMP + HOLD + EXTEND + LAND
    for tick in range(total):
        target = np.tile([0.0, 1.0, 1.0], 4) * transversal_command(tick, squat)
        sim.set_targets(target)
        sim.filter_targets()
        for _ in range(sim.substeps):
            sim.physics_step()
            now = (len(rows) + 1) * sim.dt
            q = sim.joint_q()[0]
            qd = sim.joint_qd()[0]
            rows.append(
                (
                    now,
                    q[2],
                    sim.base_velocity()[0, 2],
                    motor_values(q[7:]),
                    motor_values(qd[6:]),
                    sim.torque.numpy()[:, 0].copy(),
                    sim.paw_force.numpy()[:, 0].copy(),
                    sim.loop_gap()[0],
                )
            )
        forces = np.array([row[6] for row in rows[-sim.substeps :]])
        record(recorder, sim.state.body_q.numpy(), rows[-1], largest_forces(forces))
    return Trace(*(np.array(column) for column in zip(*rows, strict=True))), recorder


def record(recorder: Recorder, poses: np.ndarray, row: tuple, force: np.ndarray) -> None:
    """Add a frame to the jump's recording; poses: of the links, (21, 7); row: fields of `Trace` at one physics step.

    force [N]: largest on each paw in the policy step, (4, 3), world axes.
    """
    now, height, speed, angle, rate, torque, *_ = row
    series = {"base/height [m]": height, "base/vertical speed [m s⁻¹]": speed}
    for i, name in enumerate(MOTOR_JOINTS):
        series[f"torque/{name} [N m]"] = torque[i]
        series[f"angle/{name} [deg]"] = np.degrees(angle[i])
        series[f"speed/{name} [rad s⁻¹]"] = rate[i]
    for i, leg in enumerate(LEGS):
        series[f"peak paw force/{leg} [N]"] = float(np.linalg.norm(force[i]))
    recorder.record(now, poses, series, contact_points=ankles(poses[None])[0], contact_forces=force)


def trace_metrics(trace: Trace) -> dict[str, float]:
    """Return the metrics of the open-loop jump, with units at the end of the names.

    Takeoff is the last contact before the apex. Times count from the extension's command.
    """
    contact = np.linalg.norm(trace.force, axis=2).max(axis=1) > 0.1
    extend_s = (STAND + RAMP + HOLD) / 60.0  # [s] command of the extension
    apex = int(np.argmax(np.where(trace.time > extend_s, trace.height, 0.0)))
    takeoff = int(np.flatnonzero(contact[:apex])[-1])
    push = trace.time <= trace.time[takeoff]
    values = {
        "apex_height_m": trace.height[apex],
        "apex_time_s": trace.time[apex] - extend_s,
        "takeoff_speed_m_s": trace.speed[takeoff],
        "takeoff_height_m": trace.height[takeoff],
        "takeoff_time_s": trace.time[takeoff] - extend_s,
        "squat_height_m": trace.height[int((STAND + RAMP + HOLD) * 8 - 1)],  # 8 physics steps per policy step
        "peak_torque_nm": np.abs(trace.torque).max(),
        "peak_speed_rad_s": np.abs(trace.rate).max(),
        "peak_contact_force_n": np.linalg.norm(trace.force.sum(axis=1), axis=1)[push].max(),
        "peak_landing_force_n": np.linalg.norm(trace.force.sum(axis=1), axis=1)[apex:].max(),
        "largest_loop_gap_mm": 1000.0 * trace.gap.max(),
    }
    for i, name in enumerate(MOTOR_JOINTS):
        values[f"peak_torque_{name}_nm"] = np.abs(trace.torque[:, i]).max()
        values[f"peak_speed_{name}_rad_s"] = np.abs(trace.rate[:, i]).max()
    return {name: float(value) for name, value in values.items()}


def plot_trace(path: Path, trace: Trace, conditions: str, hardware: float) -> None:
    """Plot height, vertical speed, angles, torques and paw forces of the open-loop jump over time.

    hardware [m]: apex of the real robot.
    """
    with figure(path, 5, 1, figsize=(9, 12), sharex=True, title="Open-loop jump", conditions=conditions) as axes:
        axes[0].plot(trace.time, trace.height)
        axes[0].axhline(hardware, color="0.4", linestyle=":", label="paper, robot: 18 N m")
        axes[1].plot(trace.time, trace.speed)
        plot_motors(axes[2:4], trace.time, trace.angle, trace.torque)
        for i, leg in enumerate(LEGS):
            axes[4].plot(trace.time, trace.force[:, i, 2], color=LEG_COLORS[leg], label=f"{leg} paw")
        labels = ("base height [m]", "vertical speed [m/s]", "motor angle [deg]", "motor torque [N m]", "paw force [N]")
        for axis, label in zip(axes, labels, strict=True):
            axis.set_ylabel(label)
        axes[-1].set_xlabel("time [s]")


def plot_motors(axes: np.ndarray, time: np.ndarray, angle: np.ndarray, torque: np.ndarray) -> None:
    """Plot angles and torques of the transversal motors of two left legs over time [s], (n,), onto two axes.

    angle [rad], torque [N m]: of all motors, (n, 12).
    """
    for i, name in enumerate(MOTOR_JOINTS):
        leg, motor = name.split("_")
        if leg in ("FL", "BL") and motor != "lateral":
            style = {"color": LEG_COLORS[leg], "linestyle": "-" if motor == "outer" else "--"}
            axes[0].plot(time, np.degrees(angle[:, i]), **style, label=f"{leg} {motor} motor")
            axes[1].plot(time, torque[:, i], **style)
