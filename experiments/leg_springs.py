"""How much higher springs between the knees of each leg let the robot jump: open-loop jumps over stiffness and squat.

    python experiments/leg_springs.py --out outputs/springs
    python experiments/leg_springs.py --gravity 3.71 --torque 24.8 --kp 20 --length 0.17

Every robot makes the jump of `open_loop_jump.py` (squat, hold, full extension), each with its own stiffness and squat;
the highest jump of each stiffness counts. Springs that are longer than at rest pull the knees together: up to 90
degrees they stretch the leg, so that the motors have to pull the robot down into its squat, beyond it they fold it, and
the motors have to push it up. A spring that they cannot master leaves the robot standing, or down in its squat.
The authors' sequel has 1000 N/m and 0.17 m.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import tyro
from rich.console import Console
from rich.table import Table

from jumper_warp.cli.main import run_command
from jumper_warp.evaluation.plots import drawn
from jumper_warp.robot.gravity import EARTH, MARS
from jumper_warp.robot.motors import MotorCfg, jumping_motors, loose_filter, vertical_jump_filter
from jumper_warp.robot.overlay import with_springs
from jumper_warp.robot.values import RobotValues
from jumper_warp.sim.simulation import Simulation
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.output import output_dir, write_metrics
from jumper_warp.utils.runtime import announce
from support.open_loop import EXTEND, HOLD, RAMP, STAND, follow_jump, jump_metrics, transversal_command

FALLING = 60
"""Ticks after the extension in which a jump may still rise."""


@dataclass(frozen=True)
class Args:
    """Flags."""

    stiffness: tuple[float, ...] = (0.0, 125.0, 250.0, 375.0, 500.0, 625.0, 750.0, 875.0, 1000.0, 1250.0, 1500.0)
    """[N/m] Of the springs that are tried; 0: none."""
    length: float = 0.17
    """[m] At rest."""
    squats: tuple[float, ...] = (60.0, 75.0, 90.0, 105.0, 120.0, 135.0)
    """[deg] Transversal angles commanded for the squats that are tried."""
    torque: float = 18.0
    """[N m] Torque saturation of the motors; lateral motors give 18 at most."""
    kp: float = 17.0
    """[N m/rad] Position gain of the transversal motors."""
    gravity: float = EARTH
    """[m/s^2] Downward."""
    filter: Literal["both", "stock", "loose"] = "both"
    """Motor command filter: that of the vertical jump, the loose one, or each in turn."""
    out: Path | None = None
    """Folder for figures, plot and recording (default: outputs/leg_springs/<time>)."""
    device: str | None = None
    """Warp device."""

    def __post_init__(self) -> None:
        """Check the values."""
        if not self.stiffness or not self.squats:
            raise InputError("need at least one stiffness and one squat")
        for stiffness in self.stiffness:
            with_springs(stiffness, self.length)

    @property
    def motors(self) -> MotorCfg:
        """The motors."""
        motors = jumping_motors(self.torque)
        return replace(motors, transversal=replace(motors.transversal, kp=self.kp))


def apexes(args: Args, loose: bool) -> np.ndarray:
    """Return the highest base heights [m] of open-loop jumps, (springs, squats)."""
    shape = (len(args.stiffness), len(args.squats))
    count = shape[0] * shape[1]
    robots = RobotValues.nominal(count)
    robots.spring_stiffness[:, 0] = np.repeat(args.stiffness, shape[1])
    robots.spring_length[:, 0] = args.length
    sim = Simulation(
        count, motors=args.motors, command_filter=loose_filter() if loose else vertical_jump_filter(),
        gravity=args.gravity, robot=robots, visuals=False, device=args.device,
    )  # fmt: skip
    squats, highest, begun = np.tile(args.squats, shape[0]), np.zeros(count), STAND + RAMP + HOLD
    for tick in range(begun + EXTEND + FALLING):
        commands = [transversal_command(min(tick, begun + EXTEND - 1), squat) for squat in squats]
        sim.target.assign(np.outer(np.tile([0.0, 1.0, 1.0], 4), commands).astype(np.float32))
        sim.step()
        if tick >= begun:
            highest = np.maximum(highest, sim.joint_q()[:, 2])
    return highest.reshape(shape)


def record(args: Args, loose: bool, stiffness: float, squat: float, folder: Path) -> dict[str, float]:
    """Write the recording of a jump, and return its metrics."""
    command_filter = loose_filter() if loose else vertical_jump_filter()
    sim = Simulation(1, motors=args.motors, command_filter=command_filter, gravity=args.gravity, device=args.device,
                     robot=with_springs(stiffness, args.length))  # fmt: skip
    trace, recorder, _ = follow_jump(sim, {"spring_stiffness_n_m": stiffness, "squat_command_deg": squat}, squat)
    recorder.save_rrd(folder / f"jump_{'loose' if loose else 'stock'}.rrd")
    return jump_metrics(trace)


def main(args: Args) -> dict:
    """Run the experiment and return its figures."""
    start = time.perf_counter()
    announce(args.device)
    folder = output_dir("leg_springs", args.out)
    kinds = {"stock": [False], "loose": [True], "both": [False, True]}[args.filter]
    values: dict[str, Any] = {"gravity_m_s2": args.gravity, "torque_limit_nm": args.torque, "kp_nm_rad": args.kp,
                              "spring_length_m": args.length, "stiffness_n_m": list(args.stiffness)}  # fmt: skip
    place = {EARTH: "Earth", MARS: "Mars"}.get(args.gravity, f"{args.gravity:g} m/s^2")
    table = Table(
        "stiffness [N/m]", title=f"open-loop apex in m, {place}, {args.torque:g} N m, springs {args.length:g} m"
    )
    rows = [[f"{stiffness:g}"] for stiffness in args.stiffness]
    with drawn(folder / "springs.png", figsize=(7, 4.5)) as axis:
        for loose in kinds:
            name = "loose" if loose else "stock"
            found = apexes(args, loose)
            best = found.max(axis=1)
            values[f"{name}_apex_m"] = best.tolist()
            values[f"{name}_squat_command_deg"] = [args.squats[i] for i in found.argmax(axis=1)]
            top = int(best.argmax())
            chosen = args.stiffness[top], values[f"{name}_squat_command_deg"][top]
            values[f"{name}_highest_stiffness_n_m"] = chosen[0]
            values |= {f"{name}_highest_{key}": value for key, value in record(args, loose, *chosen, folder).items()}
            axis.plot(args.stiffness, best, marker="o", label=f"{name} filter")
            table.add_column(f"{name} filter")
            for row, apex in zip(rows, best, strict=True):
                row.append(f"{apex:.3f}")
        axis.set(xlabel="stiffness between the knees [N/m]", ylabel="highest base height [m]", title=table.title)
        axis.legend()
    for row in rows:
        table.add_row(*row)
    write_metrics(folder, values)
    Console().print(table)
    print(f"{time.perf_counter() - start:.1f} s; figures, plot and recordings in {folder}")
    return values


if __name__ == "__main__":
    run_command(lambda: main(tyro.cli(Args)))
