"""Measure how high robots jump in open loop, without and with springs between the knees, and write metrics and a plot.

    python experiments/leg_springs.py --out outputs/springs
    python experiments/leg_springs.py --gravity 3.71 --torque-limit 24.8 --kp 20 --rest-length 0.17
    python experiments/leg_springs.py --stiffness 0 --squat-angles 135 --torque-limit 24.8 --kp 20

Every robot makes an open-loop jump (squat, hold, full extension) with another stiffness and squat. The
highest jump of each stiffness counts. A stretched spring pulls the knees together. Up to 90 degrees this extends the
leg, and the motors have to pull the robot into its squat. Beyond 90 degrees it folds the leg, and the motors have to
push the robot up. If a spring is too stiff for the motors, the robot stays standing or in its squat. The authors'
sequel has 1000 N/m and 0.17 m.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from jumper_warp.robot.gravity import EARTH, MARS
from jumper_warp.robot.motors import jumping_motors, loose_filter, vertical_jump_filter
from jumper_warp.robot.values import RobotValues
from jumper_warp.sim.apex import EXTEND, HOLD, RAMP
from jumper_warp.sim.simulation import Simulation
from jumper_warp.utils.files import Json
from jumper_warp.viz.plots import figure
from support.scripts import DeviceArgs, prepare, report, run_script

STAND = 60  # Policy steps in the default pose before the jump
FALLING = 60  # Number of policy steps after the extension in which a jump may still rise
FILTERS = {"stock": vertical_jump_filter, "loose": loose_filter}  # Functions that return the command filter, by name


def transversal_command(step: int, squat: float) -> float:
    """Return the angle [rad] that the open-loop jump commands to the transversal motors at a policy step.

    The default pose has 45 degrees; -45 degrees extend the legs.
    squat [deg]: commanded angle of the squat.
    """
    if step >= STAND + RAMP + HOLD:
        return float(np.radians(-45.0))
    return float(np.radians(45.0 + (squat - 45.0) * np.clip((step - STAND) / RAMP, 0.0, 1.0)))


SUMMARY = ("apex_without_springs_m", "highest_apex_height_m", "highest_stiffness_n_m")  # Ends of keys


@dataclass(frozen=True)
class Args(DeviceArgs):
    """Flags of the jumps with springs between the knees."""

    stiffness: tuple[float, ...] = (0.0, 125.0, 250.0, 375.0, 500.0, 625.0, 750.0, 875.0, 1000.0, 1250.0, 1500.0)
    """[N/m] Stiffnesses of the springs to try; 0: no springs."""
    rest_length: float = 0.17  # [m] Rest length of the springs
    squat_angles: tuple[float, ...] = (60.0, 75.0, 90.0, 105.0, 120.0, 135.0)
    """[deg] Transversal angles to command for the squat."""
    torque_limit: float = 18.0  # [N m] Torque saturation of the motors; lateral motors give 18 at most
    kp: float = 17.0  # [N m/rad] Position gain of the transversal motors
    gravity: float = EARTH  # [m/s^2] Downward
    filter: Literal["both", "stock", "loose"] = "both"
    """Motor command filter: that of the vertical jump, the loose one, or each in turn."""

    def apexes(self, command_filter: str) -> np.ndarray:
        """Simulate the jumps: return the largest base height [m] of each, (stiffnesses, squat angles).

        All are parallel worlds of one simulation. The legs stay extended in flight, since only the apex counts.
        command_filter: a key of FILTERS.
        """
        shape = (len(self.stiffness), len(self.squat_angles))
        robots = RobotValues.nominal(shape[0] * shape[1])
        robots.spring_stiffness[:, 0] = np.repeat(self.stiffness, shape[1])
        robots.spring_length[:, 0] = self.rest_length
        motors = jumping_motors(self.torque_limit)
        motors = replace(motors, transversal=replace(motors.transversal, kp=self.kp))
        sim = Simulation(
            shape[0] * shape[1], motors=motors, command_filter=FILTERS[command_filter](), gravity=self.gravity,
            robot=robots, visuals=False, device=self.device,
        )  # fmt: skip
        apex = np.zeros(sim.num_worlds)
        extend_step = STAND + RAMP + HOLD
        for tick in range(extend_step + EXTEND + FALLING):
            commands = [transversal_command(tick, squat) for squat in self.squat_angles]
            sim.target.assign(np.outer(np.tile([0.0, 1.0, 1.0], 4), np.tile(commands, shape[0])).astype(np.float32))
            sim.step()
            if tick >= extend_step:
                apex = np.maximum(apex, sim.joint_q()[:, 2])
        return apex.reshape(shape)


def main(args: Args) -> dict:
    """Simulate a jump for each spring stiffness and squat angle, plot the best apexes, and return the metrics."""
    folder = prepare("leg_springs", args)
    values: Json = {"gravity_m_s2": args.gravity, "torque_limit_nm": args.torque_limit, "kp_nm_rad": args.kp,
                              "spring_length_m": args.rest_length, "stiffness_n_m": list(args.stiffness)}  # fmt: skip
    planet = {EARTH: "Earth", MARS: "Mars"}.get(args.gravity, f"{args.gravity:g} m/s^2")
    title = f"Open-loop apex in m, {planet}, {args.torque_limit:g} N m, springs {args.rest_length:g} m"
    with figure(folder / "springs.png", figsize=(7, 5), title=title) as axis:
        for name in FILTERS if args.filter == "both" else (args.filter,):
            apexes = args.apexes(name)
            best = apexes.max(axis=1)
            top = int(best.argmax())
            squats = [args.squat_angles[i] for i in apexes.argmax(axis=1)]
            values |= {f"{name}_apex_m": best.tolist(), f"{name}_squat_command_deg": squats,
                       f"{name}_highest_stiffness_n_m": args.stiffness[top],
                       f"{name}_highest_apex_height_m": float(best[top])}  # fmt: skip
            if 0.0 in args.stiffness:
                values[f"{name}_apex_without_springs_m"] = float(best[args.stiffness.index(0.0)])
            axis.plot(args.stiffness, best, marker="o", label=f"{name} filter")
        axis.set(xlabel="stiffness between the knees [N/m]", ylabel="highest base height [m]")
    return report(args, folder, values, title, [key for key in values if key.endswith(SUMMARY)])


if __name__ == "__main__":
    run_script(main, Args)
