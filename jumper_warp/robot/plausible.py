"""Facts of a robot in words, and what is implausible about it."""

from __future__ import annotations

import math

import numpy as np

from jumper_warp.robot.description import LEGS, MOTOR_JOINTS, RobotDescription
from jumper_warp.robot.folder import LOCKED
from jumper_warp.robot.gravity import EARTH
from jumper_warp.robot.legs import leg_dimensions
from jumper_warp.robot.measures import measures_of
from jumper_warp.robot.model import PHYSICS_DT
from jumper_warp.robot.values import TRANSVERSAL
from jumper_warp.utils.errors import InputError


def depths(leg: str, robot: RobotDescription) -> list[float]:
    """Return the depths [m] of a paw below its hip at equal thigh angles within the stops where the loop closes."""
    joint = robot.joint(f"{leg}_outer")
    size = leg_dimensions(robot, leg)
    lower = max(joint.lower, 0.5 * robot.transversal_sum[0])
    upper = min(joint.upper, 0.5 * robot.transversal_sum[1])
    found = []
    for angle in np.linspace(lower, upper, 100):
        try:
            found.append(size.depth(0.0, angle))
        except InputError:
            continue
    return found


def facts(robot: RobotDescription) -> dict[str, str]:
    """Return weight, reach, standing height, symmetry and motors of a robot as texts, by name."""
    legs = [leg_dimensions(robot, leg) for leg in LEGS]
    reach = [[f"{end(depths(leg, robot)):.3f}" for end in (min, max)] for leg in ("FL", "BL")]
    mirrored = all(
        abs(getattr(left, name)) == abs(getattr(right, name))
        for left, right in zip(legs[::2], legs[1::2], strict=True)
        for name in ("outer_x", "inner_x", "plane_y", "thigh", "shank", "outer_shank", "paw_offset", "paw_radius")
    )
    motors = {motor.type: motor for motor in robot.motors if motor != LOCKED}
    sizes = measures_of(robot, 0.0)
    return {
        "robot": robot.name,
        "weight": f"{robot.mass:.3f} kg, legs {100.0 * (1.0 - robot.links[0].mass / robot.mass):.0f} %",
        "reach below the hip": f"{' to '.join(reach[0])} m front, {' to '.join(reach[1])} m back",
        "standing height": f"{sizes.height:.3f} m",
        "left and right": "mirrored" if mirrored else "differ",
        "lateral axis": "locked" if sizes.locked else "free",
        "springs": f"{robot.spring[0]:g} N/m, {robot.spring[1]:g} m" if robot.spring[0] else "none",
        **{
            f"motor {name}": f"{motor.peak_torque:g} N m up to {motor.cutoff_speed:.1f} rad/s, "
            f"none from {motor.no_load_speed:.1f} rad/s"
            for name, motor in motors.items()
        },
    }


def implausible(robot: RobotDescription, apex: float) -> list[str]:
    """Return what is implausible about a robot and why, one line each; apex [m]: of its open-loop jump."""
    lines = []
    for link in robot.links:
        moments = np.linalg.eigvalsh(link.inertia)
        if link.mass <= 0.0 or moments[0] <= 0.0 or moments[2] > moments[0] + moments[1]:
            lines.append(f"{link.name}: no body has mass {link.mass:g} kg and principal moments {moments} kg m^2")
        elif math.sqrt(moments[2] / link.mass) > 0.5:
            lines.append(f"{link.name}: a radius of gyration of {math.sqrt(moments[2] / link.mass):.2f} m")
    for index in TRANSVERSAL:
        motor, leg = robot.motors[index], MOTOR_JOINTS[index][:2]
        size = leg_dimensions(robot, leg)
        load = robot.mass * EARTH / 8.0 * size.thigh
        if motor.peak_torque < load:
            lines.append(f"{MOTOR_JOINTS[index]}: {motor.peak_torque:g} N m cannot carry a bent leg, {load:.3g} N m")
        thigh = robot.link(f"{MOTOR_JOINTS[index]}_thigh")
        inertia = motor.armature + thigh.inertia[1, 1] + thigh.mass * float(thigh.com @ thigh.com)
        if max(motor.jumping.kd, motor.walking.kd) * PHYSICS_DT > inertia:
            lines.append(f"{MOTOR_JOINTS[index]}: damping of {motor.jumping.kd:g} N m s/rad oscillates at 480 Hz")
        if motor.cutoff_speed >= motor.no_load_speed:
            lines.append(f"{MOTOR_JOINTS[index]}: full torque beyond the no-load speed")
    height = measures_of(robot, apex).height
    if not height + 0.1 * height < apex < 20.0 * height:
        lines.append(f"an open-loop jump to {apex:.3f} m from {height:.3f} m: it falls, or its motors are too weak")
    return lines
