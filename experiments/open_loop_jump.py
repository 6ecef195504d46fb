"""Measure how high squat, hold and full extension lift the robot, and write metrics, plots and a recording.

    python experiments/open_loop_jump.py --solver jumper --torque-limit 18 --out outputs/jump

This is the open-loop jump of the paper. Commands pass through the command filter and the motors.

- The paper's robot reached 1.075 m at 18 N m, with the gains and the filter of the policies.
- The paper's simulation reached 1.42 m at 24.8 N m, with stiffer gains and a looser filter that the paper does not
  state: `--torque-limit 24.8 --loose --kp 20`.
- `--spring 1000 0.17` adds springs between the knees of each leg, as in the authors' sequel. Beyond 90 degrees they
  fold the legs further: `--squat-angle` sets the depth.
- `--robot` takes a robot with other parameters, for example with a load on its base.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from jumper_warp.evaluation.run import SOLVER_TITLES
from jumper_warp.robot.gravity import EARTH
from jumper_warp.robot.motors import jumping_motors, loose_filter, vertical_jump_filter
from jumper_warp.robot.overlay import RobotOverlay, load_overlay, with_springs
from jumper_warp.robot.values import TRANSVERSAL
from jumper_warp.sim.simulation import Simulation
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.files import Json
from support.open_loop import SQUAT, plot_trace, simulate_jump, trace_metrics
from support.scripts import DeviceArgs, prepare, report, run_script

HARDWARE_APEX = 1.075  # [m] Paper, open loop on the robot at 18 N m
SUMMARY = ("apex_height_m", "takeoff_speed_m_s", "squat_height_m", "peak_torque_nm")


@dataclass(frozen=True)
class Args(DeviceArgs):
    """Flags of the open-loop jump."""

    solver: Literal["jumper", "mujoco"] = "jumper"  # Physics: the dedicated solver, or Newton's SolverMuJoCo
    torque_limit: float = 18.0  # [N m] Torque saturation of the motors; lateral motors give 18 at most
    kp: float = 17.0  # [N m/rad] Position gain of the transversal motors
    gravity: float = EARTH  # [m/s^2] Downward
    loose: bool = False  # A looser filter, as for the paper's 1.42 m
    squat_angle: float = SQUAT  # [deg] Transversal angle commanded for the squat
    spring: tuple[float, float] | None = None
    """[N/m], [m] Stiffness and rest length of springs between the knees of each leg (default: none)."""
    robot: Path | None = None  # Robot overlay, as `jumper sysid` writes it, in place of springs

    def __post_init__(self) -> None:
        """Raise InputError if springs are given twice: by flags, and by a robot overlay."""
        if self.spring is not None and self.robot is not None:
            raise InputError("give springs or a robot, which may have springs")


def factor_of(robot: RobotOverlay | None, name: str) -> float:
    """Return the smallest factor [1] by which an overlay scales `name` of the transversal motors; 1 without overlay.

    The titles state the value of the weakest motor.
    """
    return 1.0 if robot is None else float(getattr(robot.robots(), name)[0, list(TRANSVERSAL)].min())


def measure(args: Args, folder: Path) -> tuple[Json, str]:
    """Simulate the open-loop jump, write its plots and recording into a folder, return metrics and a title.

    The apex of the paper's robot is one of the metrics only if motors, gravity, filter and robot are the paper's.
    """
    robot = None if args.robot is None else load_overlay(args.robot)
    limit, kp = (value * factor_of(robot, name) for name, value in (("saturation", args.torque_limit), ("kp", args.kp)))
    variant = {"solver": args.solver, "gravity_m_s2": args.gravity, "torque_limit_nm": limit, "kp_nm_rad": kp,
               "loose_filter": args.loose, "squat_command_deg": args.squat_angle}  # fmt: skip
    if args.spring is not None:
        robot = with_springs(*args.spring)
        variant |= {"spring_stiffness_n_m": args.spring[0], "spring_length_m": args.spring[1]}
    if args.robot is not None:
        variant["robot"] = str(args.robot)
    motors = jumping_motors(args.torque_limit)
    motors = replace(motors, transversal=replace(motors.transversal, kp=args.kp))
    command_filter = loose_filter() if args.loose else vertical_jump_filter()
    sim = Simulation(
        1,
        solver=args.solver,
        motors=motors,
        command_filter=command_filter,
        gravity=args.gravity,
        robot=robot,
        device=args.device,
    )
    trace, recorder = simulate_jump(sim, variant, args.squat_angle)
    values: Json = {**variant, **trace_metrics(trace), "hardware_apex_height_m": None}
    if args.torque_limit == 18.0 and args.gravity == EARTH and not args.loose and robot is None:
        values["hardware_apex_height_m"] = HARDWARE_APEX
    words = [SOLVER_TITLES[args.solver], f"{limit:.4g} N m", f"kp {kp:.4g} N m/rad"]
    words += [f"gravity {args.gravity:g} m/s²"] + ["loose command filter"] * args.loose
    words += [] if args.spring is None else ["springs of {:g} N/m, {:g} m".format(*args.spring)]
    words += [] if args.robot is None else [f"robot of {args.robot.name}"]
    plot_trace(folder / "trace.png", trace, ", ".join(words), HARDWARE_APEX)
    recorder.save_rrd(folder / "jump.rrd")
    recorder.save_picture(folder / "jump.png", title="Open-loop jump, " + ", ".join(words))
    return values, "Open-loop jump, " + ", ".join(words)


def main(args: Args) -> dict:
    """Simulate the open-loop jump, write and print results, and return the metrics."""
    folder = prepare("open_loop_jump", args)
    values, title = measure(args, folder)
    known = values["hardware_apex_height_m"]
    return report(args, folder, values, title, SUMMARY, {} if known is None else {"apex_height_m": known})


if __name__ == "__main__":
    run_script(main, Args)
