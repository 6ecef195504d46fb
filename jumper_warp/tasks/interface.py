"""Description of the inputs and outputs of a task's policies, as plain data that is saved with every policy.

A program that runs a policy, as on the robot, needs no other part of this package to turn sensor readings into an
observation and an action into motor targets.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any

from jumper_warp.robot.description import MOTOR_JOINTS, RobotDescription, load_description
from jumper_warp.robot.motors import MotorKindCfg
from jumper_warp.tasks.cfg import TaskCfg


def interface(task: TaskCfg, robot: RobotDescription | None = None) -> dict[str, Any]:
    """Describe inputs and outputs of a task's policies as JSON data; lists of 12 are in the order of `joint_names`.

    robot: by default the Jumper.
    Units: action_scale, default_joint_pos [rad]; joint_stiffness [N m/rad]; joint_damping [N m s/rad]; torque_limit
    [N m]; command_filter [deg], [deg/s] and [s]. observation_layout: half-open column range by term.
    """

    def per_motor(lateral: float, transversal: float) -> list[float]:
        """Return a constant of the two kinds of motors for each of the 12 motors: lateral, outer, inner by leg."""
        return [lateral, transversal, transversal] * (len(MOTOR_JOINTS) // 3)

    def torque(kind: MotorKindCfg) -> float:
        """Return the largest torque [N m] of a kind of motor: the controller's limit or the motor's."""
        return min(kind.saturation, kind.peak)

    motors = task.motors
    return {
        "task": task.name,
        "observation_names": list(task.observation_names),
        "observation_layout": {
            term.name: {"first": first, "end": end, "scale": term.numbers["scale"], "clip": term.numbers["clip"],
                        "history": term.options["history"]}
            for term, (first, end) in zip(task.observations.actor, task.layout("actor").values(), strict=True)
        },
        "joint_names": list(MOTOR_JOINTS),
        "action_scale": per_motor(*map(math.radians, task.action_scale)),
        "default_joint_pos": [float(angle) for angle in (robot or load_description()).pose("default")],
        "joint_stiffness": per_motor(motors.lateral.kp, motors.transversal.kp),
        "joint_damping": per_motor(motors.lateral.kd, motors.transversal.kd),
        "torque_limit": per_motor(torque(motors.lateral), torque(motors.transversal)),
        "command_filter": dataclasses.asdict(task.command_filter),
    }  # fmt: skip
