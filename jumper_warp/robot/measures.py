"""Measures of a robot in which tasks state heights, distances, speeds, forces and torques."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from jumper_warp.robot.description import LEGS, RobotDescription, load_description
from jumper_warp.robot.folder import LOCKED
from jumper_warp.robot.legs import leg_dimensions
from jumper_warp.robot.motors import FilterCfg, LimitsCfg, MotorCfg, MotorKindCfg
from jumper_warp.robot.values import ratio

JUMPER_APEX = 1.07545  # [m] `OpenLoopJump` of the Jumper


@dataclass(frozen=True)
class Measures:
    """Measures of a robot."""

    leg: float  # [m] thigh and inner shank, mean of all legs
    height: float  # [m] base of the robot that stands in the default pose
    mass: float  # [kg]
    torque: float  # [N m] peak torque of the transversal motors, mean of all legs
    paw_x: tuple[float, float]  # [m] distance of the front and back paws ahead of and behind the base, default pose
    paw_y: tuple[float, float]  # [m] their distance to either side
    apex: float  # [m] height that the base reaches in the open-loop jump at the torque limits of the jump tasks
    locked: bool  # whether no leg has a lateral axis


def measures_of(robot: RobotDescription, apex: float) -> Measures:
    """Return the measures of a robot; apex [m]: of its open-loop jump."""
    legs = [leg_dimensions(robot, leg) for leg in LEGS]
    pose = robot.poses["default"]
    middles = [abs(leg.hip[0] + 0.5 * (leg.outer_x + leg.inner_x)) for leg in legs]
    sides = [abs(leg.hip[1] + leg.plane_y + leg.knee_y) for leg in legs]
    return Measures(
        leg=float(np.mean([leg.thigh + leg.shank + leg.paw_offset for leg in legs])),
        height=max(leg.depth(*pose) - leg.hip[2] for leg in legs),
        mass=robot.mass,
        torque=float(np.mean([motor.peak_torque for motor in robot.motors[1::3]])),
        paw_x=(middles[0], middles[2]),
        paw_y=(sides[0], sides[2]),
        apex=apex,
        locked=all(motor == LOCKED for motor in robot.motors[::3]),
    )


def motors_for(cfg: MotorCfg, robot: RobotDescription) -> MotorCfg:
    """Return the motors of a task for a robot: gains and torque limits as factors on the Jumper's hold for its own."""
    jumper = load_description()
    walking = cfg.transversal.kd == jumper.motors[1].walking.kd
    kinds = []
    for kind, ours, theirs in zip((cfg.lateral, cfg.transversal), robot.motors, jumper.motors, strict=False):
        gains, usual = (motor.walking if walking else motor.jumping for motor in (ours, theirs))
        kinds.append(
            MotorKindCfg(
                kp=kind.kp * ratio(gains.kp, usual.kp),
                kd=kind.kd * ratio(gains.kd, usual.kd),
                saturation=kind.saturation * ratio(ours.peak_torque, theirs.peak_torque),
                peak=kind.peak * ratio(ours.peak_torque, theirs.peak_torque),
                cutoff_speed=kind.cutoff_speed * ratio(ours.cutoff_speed, theirs.cutoff_speed),
                no_load_speed=kind.no_load_speed * ratio(ours.no_load_speed, theirs.no_load_speed),
            )
        )
    fastest = max(1.0, ratio(robot.motors[1].no_load_speed, jumper.motors[1].no_load_speed))
    fade_start, fade_end = cfg.fade_start * fastest, cfg.fade_end * fastest
    return replace(cfg, lateral=kinds[0], transversal=kinds[1], fade_start=fade_start, fade_end=fade_end)


def filter_for(cfg: FilterCfg, robot: RobotDescription) -> FilterCfg:
    """Return a task's command filter for a robot: its limits keep the distances from the stops that the Jumper's have.

    Where legs have different stops, the tightest ones count. Limits of the lateral angle are cut to the stops. Without
    lateral axis they are 0.
    """
    jumper = load_description()

    def degrees(angle: float) -> float:
        return round(math.degrees(angle), 3)  # a URDF rounds radians

    def moved(limits: LimitsCfg, ours: tuple[float, float], theirs: tuple[float, float]) -> LimitsCfg:
        lower, upper = (degrees(a) - degrees(b) for a, b in zip(ours, theirs, strict=True))
        return replace(limits, lower=limits.lower + lower, upper=limits.upper + upper)

    def stops(robot: RobotDescription, name: str) -> tuple[float, float]:
        joints = [robot.joint(f"{leg}_{name}") for leg in LEGS]
        return max(joint.lower for joint in joints), min(joint.upper for joint in joints)

    lower, upper = map(degrees, stops(robot, "lateral"))
    lateral = replace(cfg.lateral, lower=max(cfg.lateral.lower, lower), upper=min(cfg.lateral.upper, upper))
    if robot.motors[0] == LOCKED:
        lateral = LimitsCfg(-0.01, 0.01)
    return replace(
        cfg, lateral=lateral, transversal=moved(cfg.transversal, stops(robot, "outer"), stops(jumper, "outer")),
        sum=moved(cfg.sum, robot.transversal_sum, jumper.transversal_sum),
    )  # fmt: skip
