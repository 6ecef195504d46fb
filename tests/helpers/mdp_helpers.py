"""Arrays of robots and worlds for tests of the stage kernels that every task shares."""

from types import SimpleNamespace

import numpy as np
import warp as wp

from columns import MOTOR_COORDS, Z
from jumper_warp.envs.arrays import delay_arrays, episode_arrays
from jumper_warp.kernels.layout import BODIES, COORDS, DOFS
from jumper_warp.kernels.mdp.observe import LANES, postprocess_obs_kernel
from jumper_warp.kernels.mdp.view import RobotArrays

STEP_DT = 1.0 / 60.0  # [s]
SUBSTEPS = 8
DEFAULT_ANGLE = np.tile([0.0, np.pi / 4.0, np.pi / 4.0], 4)  # [rad]
PAWS = ("impulse", "paw_force", "peak_force", "paw_pos", "paw_vel", "contact_time", "air_time", "touchdown_speed",
        "collisions", "paw_height")  # fmt: skip
MOTORS = ("torque", "prev_torque", "action", "prev_action", "prev_prev_action", "target", "filtered_target",
          "prev_rate", "joint_offset")  # fmt: skip


def array(values, dtype=float) -> wp.array:
    """Return values as a Warp array on the CPU."""
    return wp.array(np.asarray(values), dtype=dtype, device="cpu")


def standing_robots(n: int):
    """Return `RobotArrays` of n robots at rest in the default pose, 0.35 m high, with empty histories."""
    robot, q = RobotArrays(), np.zeros((n, int(COORDS)))
    q[:, Z], q[:, 6], q[:, MOTOR_COORDS] = 0.35, 1.0, DEFAULT_ANGLE
    robot.joint_q, robot.joint_qd = array(q.ravel()), array(np.zeros(n * int(DOFS)))
    robot.body_com = array(np.zeros((n * int(BODIES), 3)), wp.vec3)
    robot.body_f = array(np.zeros((n * int(BODIES), 6)), wp.spatial_vector)
    robot.gravity = array(np.tile([0.0, 0.0, -9.81], (n + 1, 1)), wp.vec3)
    robot.diverged = array(np.zeros(n), int)
    for names, rows in ((PAWS, 4), (MOTORS, 12)):
        for name in names:
            setattr(robot, name, wp.zeros((rows, n), dtype=RobotArrays.vars[name].type.dtype, device="cpu"))
    robot.prev_lin_vel = array(np.zeros((n, 3)), wp.vec3)
    robot.default_angle, robot.step_dt = array(DEFAULT_ANGLE), STEP_DT
    return robot


def new_worlds(n: int, seed: int = 0, skill=0):
    """Return the `EpisodeArrays` of n new worlds."""
    return episode_arrays(n, seed, "training", array(np.broadcast_to(skill, n), int), "cpu")


def no_delays(n: int, steps=0):
    """Return the `Delays` of n new worlds; steps: latency [physics steps]."""
    return delay_arrays(n, array(np.broadcast_to(steps, n), int), SUBSTEPS, "cpu")


def write(target: wp.array, where, values) -> None:
    """Overwrite the elements of an array at an index `where`."""
    copy = target.numpy().copy()
    copy[where] = values
    target.assign(copy)


def values_of(struct, kind) -> SimpleNamespace:
    """Return copies of all array fields of a struct as NumPy arrays; kind: its class."""
    fields = {name: getattr(struct, name) for name in kind.vars}
    return SimpleNamespace(**{name: v.numpy().copy() for name, v in fields.items() if isinstance(v, wp.array)})


def observe(skill, robot, parameters, ground, worlds, states, numbers, after_reset: int = 0) -> None:
    """Launch the observation stage of a skill; after_reset 1: only in worlds whose episode has just begun."""
    arrays = skill.observations
    inputs = [skill.index, robot, parameters, ground, worlds, states, numbers, after_reset, skill.term_value]
    inputs += [arrays.raw, skill.found, skill.found_states]
    wp.launch(skill.kernels["observe"], (skill.num_chunks, skill.num_envs), inputs, device="cpu")
    inputs = [skill.index, worlds, skill.columns, numbers, after_reset, arrays]
    wp.launch(postprocess_obs_kernel, (skill.num_envs, int(LANES)), inputs, device="cpu")
