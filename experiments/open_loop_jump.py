"""The open-loop jump of the paper: squat, hold, then command full extension, through filter and motors.

    python experiments/open_loop_jump.py --solver jumper --torque-limit 18 --out outputs/jump

The hardware reached 1.075 m at 18 N m with the gains and filter of the policies. With 24.8 N m, stiffer gains and a
looser filter, neither of which it states, the paper's simulation gives 1.42 m: `--torque-limit 24.8 --loose --kp 20`.
Springs between the knees of each leg, as in the authors' sequel, are `--spring 1000 0.17`. Beyond 90 degrees they fold
the legs further: `--squat-angle` sets the depth. `--robot` takes a robot with other parameters, for example with a load
on its base.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from jumper_warp.evaluation.commands import print_metrics
from jumper_warp.evaluation.run import SOLVER_TITLES
from jumper_warp.robot.description import LEGS
from jumper_warp.robot.gravity import EARTH
from jumper_warp.robot.motors import jumping_motors, loose_filter, vertical_jump_filter
from jumper_warp.robot.overlay import load_overlay, with_springs
from jumper_warp.sim.simulation import Simulation
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.output import write_metrics
from support.open_loop import SQUAT, plot_trace, simulate_jump, trace_metrics
from support.scripts import DeviceArgs, prepare, run_script

HARDWARE_APEX = 1.075  # [m] Paper, open loop on the robot at 18 N m
PER_MOTOR = tuple(f"peak_{quantity}_{leg}" for quantity in ("torque", "speed") for leg in LEGS)
"""Prefixes of the metrics that are saved but not printed."""


@dataclass(frozen=True)
class Args(DeviceArgs):
    """Flags."""

    solver: Literal["jumper", "mujoco"] = "jumper"  # Physics: the dedicated solver, or Newton's SolverMuJoCo
    torque_limit: float = 18.0  # [N m] Torque saturation of the motors; lateral motors give 18 at most
    kp: float = 17.0  # [N m/rad] Position gain of the transversal motors
    gravity: float = EARTH  # [m/s^2] Downward
    loose: bool = False  # A looser filter, as for the paper's 1.42 m
    squat_angle: float = SQUAT  # [deg] Transversal angle commanded for the squat
    spring: tuple[float, float] | None = None
    """[N/m] [m] Stiffness and rest length of springs between the knees of each leg (default: none)."""
    robot: Path | None = None  # Robot overlay, as `jumper sysid` writes it, in place of springs

    def __post_init__(self) -> None:
        if self.spring is not None and self.robot is not None:
            raise InputError("give springs or a robot, which may have springs")


def main(args: Args) -> dict:
    """Simulate the jump, write its plots and recording, and return the metrics."""
    start = time.perf_counter()
    folder = prepare("open_loop_jump", args)
    variant = {"solver": args.solver, "gravity_m_s2": args.gravity, "torque_limit_nm": args.torque_limit,
               "kp_nm_rad": args.kp, "loose_filter": args.loose, "squat_command_deg": args.squat_angle}  # fmt: skip
    robot = None if args.robot is None else load_overlay(args.robot)
    if args.spring is not None:
        robot = with_springs(*args.spring)
        variant |= {"spring_stiffness_n_m": args.spring[0], "spring_length_m": args.spring[1]}
    if args.robot is not None:
        variant["robot"] = str(args.robot)
    motors = jumping_motors(args.torque_limit)
    motors = replace(motors, transversal=replace(motors.transversal, kp=args.kp))
    command_filter = loose_filter() if args.loose else vertical_jump_filter()
    sim = Simulation(
        1, solver=args.solver, motors=motors, command_filter=command_filter, gravity=args.gravity, robot=robot,
        device=args.device,
    )  # fmt: skip
    trace, recorder = simulate_jump(sim, variant, args.squat_angle)
    values: dict[str, Any] = {**variant, **trace_metrics(trace), "hardware_apex_height_m": None}
    if args.torque_limit == 18.0 and args.gravity == EARTH and not args.loose and robot is None:
        values["hardware_apex_height_m"] = HARDWARE_APEX
    write_metrics(folder, values)
    words = [SOLVER_TITLES[args.solver], f"{args.torque_limit:g} N m", f"kp {args.kp:g} N m/rad"]
    words += [f"gravity {args.gravity:g} m/s²"] + ["loose command filter"] * args.loose
    words += [] if args.spring is None else ["springs of {:g} N/m, {:g} m".format(*args.spring)]
    plot_trace(folder / "trace.png", trace, ", ".join(words), HARDWARE_APEX)
    recorder.save_rrd(folder / "jump.rrd")
    recorder.save_picture(folder / "jump.png", title="Open-loop jump, " + ", ".join(words))
    print_metrics({name: value for name, value in values.items() if not name.startswith(PER_MOTOR)})
    print(f"{time.perf_counter() - start:.1f} s; metrics, plot and recording (rerun {folder / 'jump.rrd'}) in {folder}")
    return values


if __name__ == "__main__":
    run_script(main, Args)
