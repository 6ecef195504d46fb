"""Tasks of another robot than the Jumper: their numbers, stated in the robot's own measures.

A stock task holds the Jumper's numbers. Those with a dimension are multiples of one of its measures: its leg's length,
standing height, weight, torque, the gain in height of its open-loop jump, and the speeds and times that follow from
these. A robot with the Jumper's measures has the Jumper's numbers, bitwise, since every factor is 1.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import fields, replace
from typing import Any

from jumper_warp.robot.description import RobotDescription
from jumper_warp.robot.measures import Measures, filter_for, motors_for
from jumper_warp.tasks.cfg import TaskCfg

BY_NAME = {
    "std_fine": "gain", "std_wide": "gain", "std_middle": "gain", "scale_sharp": "gain", "tolerance": "gain",
    "height": "height", "distance": "leg", "target_height": "leg", "hip": "leg", "thigh": "leg", "shank": "leg",
    "speed": "speed", "speed_scale": "speed", "std_lin_vel": "speed", "takeoff_speed": "speed",
    "weight_force": "weight", "takeoff_height": "height", "floor": "height", "acceleration": "gain/height",
}  # fmt: skip
"""Measure of a term's number by its name; numbers of other names, such as angles, have none."""
OF_TERM = {
    "linear_velocity": {"std": "speed"}, "linear_velocity_fine": {"std": "speed"}, "capture_point": {"std": "leg"},
    "air_time": {"threshold": "time"}, "tracking_error": {"tolerance": "speed"}, "attitude_error": {"tolerance": ""},
    "advance_attitude": {"tolerance": ""}, "motor_torque_sq": {"weight": "1/torque^2"},
    "torque_ripple": {"weight": "1/torque^2"}, "joint_acceleration": {"weight": "leg^2"},
    "lin_vel_xy_l1": {"weight": "1/speed"},
    "lin_vel_z_l2": {"weight": "1/speed^2"}, "slip": {"weight": "1/speed^2"}, "touchdown": {"weight": "1/speed^2"},
    "foot_clearance": {"weight": "1/(leg^2 speed)"}, "touchdown_tracking": {"std": "gain"},
    "squat": {"std": "height"}, "shallow_squat": {"tolerance": "height"}, "settled": {"std": "speed"},
    "tracking": {"std": "gain"}, "estimated_tracking": {"std": "gain"}, "walked": {"margin": "gain"},
    "jump_height": {"std": "gain", "scale": "gain"}, "estimated_jump_height": {"std": "gain", "scale": "gain"},
}  # fmt: skip
"""Measures of numbers of a term by the term's name, which take precedence over BY_NAME."""
OF_FIELD = {
    "base_xy": "leg", "lean": "leg", "takeoff_ahead": "leg", "push_length": "leg", "touchdown_behind": "leg",
    "landed_ahead": "leg", "max_swing_height": "leg", "drop": "leg", "rise": "leg", "room": "leg", "clearance": "leg",
    "com_shift": "leg",
    "takeoff_height": "height", "landing_height": "height", "paw_depth": "height", "landed_height": "height",
    "base_height": "height", "landed_speed": "speed", "lin_vel": "speed", "tolerance": "speed",
    "front_x": "front_x", "back_x": "back_x", "front_y": "front_y", "back_y": "back_y", "mass": "mass",
    "base_mass": "mass", "push_force": "weight", "push_torque": "torque", "motor_friction": "torque",
    "contact_force": "weight", "highest_apex": "apex", "height_range": "apex", "success_range": "apex",
    "goal_x": "gain", "goal_y": "gain", "default_goals": "gain",
}  # fmt: skip
"""Measure of a setting by its name, in resets, levels, randomisation and evaluation."""


def scaled(task: TaskCfg, robot: RobotDescription, ours: Measures, theirs: Measures) -> TaskCfg:
    """Return a task of the Jumper for another robot.

    ours, theirs: measures of the robot and of the Jumper. Goals of a jump grow with the height that the robot gains in
    its open-loop jump; heights of the apex are counted from the standing height. Without lateral axis the robot starts
    level with its paws below its hips, and walks ahead and back only.
    """
    gain = (ours.apex - ours.height) / (theirs.apex - theirs.height)
    leg = ours.leg / theirs.leg
    speed = math.sqrt(leg)
    torque = ours.torque / theirs.torque
    factor = {
        "leg": leg, "height": ours.height / theirs.height, "speed": speed, "time": speed, "gain": gain, "": 1.0,
        "gain/height": gain * theirs.height / ours.height,
        "mass": ours.mass / theirs.mass, "weight": ours.mass / theirs.mass, "torque": torque,
        "1/torque^2": 1.0 / torque**2, "leg^2": leg**2, "1/speed": 1.0 / speed, "1/speed^2": 1.0 / speed**2,
        "1/(leg^2 speed)": 1.0 / (leg**2 * speed), "front_x": ours.paw_x[0] / theirs.paw_x[0],
        "back_x": ours.paw_x[1] / theirs.paw_x[1], "front_y": ours.paw_y[0] / theirs.paw_y[0],
        "back_y": ours.paw_y[1] / theirs.paw_y[1],
    }  # fmt: skip
    offset = ours.height - gain * theirs.height  # [m] 0 for the Jumper

    def times(value: Any, kind: str) -> Any:
        """Return a number, or numbers in tuples, times the factor of a measure."""
        if isinstance(value, tuple):
            return tuple(times(part, kind) for part in value)
        return value if value is None else gain * value + offset if kind == "apex" else value * factor[kind]

    def of_term(term: Any) -> Any:
        kinds = BY_NAME | OF_TERM.get(term.name, {})
        changes = {name: times(value, kinds[name]) for name, value in term.numbers.items() if kinds.get(name)}
        return term.replace(**changes) if changes else term

    def of_fields(cfg: Any, kinds: Mapping[str, str] = OF_FIELD) -> Any:
        names = {spec.name for spec in fields(cfg)}
        return replace(cfg, **{name: times(getattr(cfg, name), kind) for name, kind in kinds.items() if name in names})

    def of_velocity(velocity: Any) -> Any:
        *ahead, aside, turning = velocity
        slow = (1.0e-3, 1.0e-3) if ours.locked else (aside * speed, turning)
        return (*times(tuple(ahead), "speed"), *slow)

    def of_level(level: Any) -> Any:
        level = of_fields(level)
        if hasattr(level, "goal_lower"):
            ends = {}
            for name in ("goal_lower", "goal_upper"):
                x, y, z = getattr(level, name)
                ends[name] = (*times((x, 0.0 if ours.locked else y), "gain"), times(z, "apex") if z else z)
            return replace(level, **ends)
        if hasattr(level, "first_range"):
            ranges = {name: of_velocity(getattr(level, name)) for name in ("first_range", "last_range")}
            smallest = 0.0 if ours.locked else level.smallest * speed
            turns = 0.0 if ours.locked else level.turn_in_place_probability
            return replace(level, **ranges, smallest=smallest, turn_in_place_probability=turns)
        return level

    settings = task.reset.settings
    command_filter = filter_for(task.command_filter, robot)
    if settings is not None:
        walking = {} if not hasattr(settings, "gait") else {"height": "height"}
        settings = of_fields(settings, OF_FIELD | walking)
        if hasattr(settings, "ground"):
            tighter = min(command_filter.transversal.upper - task.command_filter.transversal.upper, 0.0)
            limit = max(settings.transversal_limit + tighter, 0.0)
            settings = replace(settings, ground=of_fields(settings.ground), transversal_limit=limit)
        if ours.locked:
            settings = on_fixed_paws(settings, ours)
    places = {} if not hasattr(task.evaluation, "goal_x") else {"success_range": "gain"}
    heights = {} if not hasattr(task.evaluation, "height_range") else {"height": "apex"}
    evaluation: Any = of_fields(task.evaluation, OF_FIELD | places | heights)
    if hasattr(evaluation, "max_velocity"):
        evaluation = replace(evaluation, max_velocity=of_velocity(evaluation.max_velocity))
    return replace(
        of_fields(task),
        advance=of_term(task.advance),
        curriculum=of_term(task.curriculum),
        rewards=tuple(map(of_term, task.rewards)),
        terminations=tuple(map(of_term, task.terminations)),
        levels=tuple(map(of_level, task.levels)),
        reset=replace(task.reset, settings=settings),
        randomization=of_fields(task.randomization),
        motors=motors_for(task.motors, robot),
        command_filter=command_filter,
        evaluation=evaluation,
    )


def on_fixed_paws(settings: Any, ours: Measures) -> Any:
    """Return settings of a reset in which no start needs a lateral axis: level bases above paws at a fixed width."""
    fixed = {
        "tilt": 0.0, "front_y": (ours.paw_y[0], ours.paw_y[0]), "back_y": (ours.paw_y[1], ours.paw_y[1]),
        "flight_lateral": 0.0, "forward_pitch": 0.0, "lateral": (0.0, 0.0), "base_xy": 0.0, "ang_vel": 0.0,
    }  # fmt: skip
    names = {spec.name for spec in fields(settings)}
    return replace(settings, **{name: value for name, value in fixed.items() if name in names})
