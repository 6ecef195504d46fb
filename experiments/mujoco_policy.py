"""Run a policy in plain MuJoCo: MuJoCo simulates the exported MJCF, and ONNX Runtime computes the policy.

    python experiments/mujoco_policy.py vertical_jump --height 0.8
    python experiments/mujoco_policy.py horizontal_jump --goal 0.8 0
    python experiments/mujoco_policy.py mars_walking --velocity 0.6 0 0 --gravity 3.71

The robot starts in the default pose, and gets its command after half a second. Commands stay 0 without a flag.
"""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from typing import Any

import numpy as np
import tyro
from scipy.spatial.transform import Rotation

from jumper_warp.deploy.policy import JOINTS, DeployedPolicy, JumpCommand
from jumper_warp.policies.catalog import find_policy
from jumper_warp.utils.assets import ASSETS
from jumper_warp.utils.output import output_dir
from support.scripts import OutputArgs, report, run_script

mujoco: Any = import_module("mujoco")
START, SETTLED = 0.5, 2.0  # [s] Time of the command, and from which velocities are averaged


@dataclass(frozen=True)
class Args(OutputArgs):
    """Flags of the run of a policy in MuJoCo."""

    policy: tyro.conf.Positional[str] = "vertical_jump"  # Name or folder of a policy
    height: float = 0.0  # [m] Commanded apex of the base
    goal: tuple[float, float] = (0.0, 0.0)  # [m] Commanded place, ahead and to the left of the start
    velocity: tuple[float, float, float] = (0.0, 0.0, 0.0)  # [m/s], [m/s], [rad/s] Ahead, to the left, about z
    gravity: float = 9.81  # [m/s^2]
    seconds: float = 8.0  # [s] Length of the run


def make_robot(policy: DeployedPolicy, gravity: float) -> tuple[Any, Any]:
    """Return MjModel and MjData of the robot in the default pose, with the policy's gains and torque limits."""
    model = mujoco.MjModel.from_xml_path(str(ASSETS / "jumper" / "jumper.xml"))
    model.opt.gravity[2] = -gravity
    stiffness, damping, limit = (policy.interface[key] for key in ("joint_stiffness", "joint_damping", "torque_limit"))
    for i, name in enumerate(JOINTS):
        model.actuator(name).gainprm[0] = stiffness[i]
        model.actuator(name).biasprm[1:3] = -stiffness[i], -damping[i]
        model.actuator(name).forcerange[:] = -limit[i], limit[i]
        model.jnt_actfrcrange[model.joint(name).id] = -limit[i], limit[i]
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key("default").id)
    return model, data


def main(args: Args) -> dict:
    """Run the policy, write and return the metrics."""
    folder = output_dir("mujoco_policy", args.out)
    policy = DeployedPolicy(find_policy(args.policy) / "policy.onnx")
    model, data = make_robot(policy, args.gravity)
    paws = {model.geom(f"{name[:2]}_paw").id for name in JOINTS}
    policy_dt = policy.interface["policy_dt"]
    substeps = round(policy_dt / model.opt.timestep)
    start = round(START / policy_dt)
    jump = JumpCommand()
    heights = []
    velocities = []
    for step in range(round(args.seconds / policy_dt)):
        base = Rotation.from_quat(np.roll(data.qpos[3:7], -1))  # MuJoCo has the order wxyz
        yaw = Rotation.from_euler("z", base.as_euler("ZYX")[0])
        way = yaw.inv().apply([*(args.goal - data.qpos[:2]), 0.0])[:2]
        commanded = step >= start
        if step == start:
            jump.request()
        values = {
            "height": data.qpos[2], "lin_vel": base.inv().apply(data.qvel[:3]), "ang_vel": data.qvel[3:6],
            "gravity": base.inv().apply([0.0, 0.0, -1.0]), "angle": [data.joint(name).qpos[0] for name in JOINTS],
            "rate": [data.joint(name).qvel[0] for name in JOINTS], "way": way, "goal": commanded * way,
            "command": commanded * np.array(args.velocity), "wanted_height": args.height, "block_ahead": np.zeros(7),
            "jump_command": jump.update(data.qvel[2], len(paws & set(data.contact.geom.ravel().tolist()))),
        }  # fmt: skip
        readings = {name: value for name, value in values.items() if name in policy.layout}
        data.ctrl[: len(JOINTS)] = policy.targets(readings)
        mujoco.mj_step(model, data, nstep=substeps)
        heights.append(float(data.qpos[2]))
        velocities.append((*base.inv().apply(data.qvel[:3])[:2], data.qvel[5]))
    mean = np.mean(velocities[round(SETTLED / policy_dt) :], axis=0)
    metrics = {
        "apex_m": max(heights), "height_at_end_m": heights[-1], "vx_mean_m_s": mean[0], "vy_mean_m_s": mean[1],
        "yaw_rate_mean_rad_s": mean[2],
        "goal_distance_at_end_m": float(np.linalg.norm(args.goal - data.qpos[:2])),
    }  # fmt: skip
    return report(args, folder, {k: float(v) for k, v in metrics.items()}, f"{args.policy} in MuJoCo", list(metrics))


if __name__ == "__main__":
    run_script(main, Args)
