"""Parameters that domain randomisation changes, read from solver, motors and environment."""

import dataclasses

import numpy as np
from newton.solvers import SolverMuJoCo

from jump_helpers import DEG, make_env, only, resetting
from jumper_warp.envs.env import Env
from jumper_warp.kernels import layout
from jumper_warp.registry import make_task
from jumper_warp.sim.solver import SolverJumper
from jumper_warp.tasks.randomization import RandomizationCfg

N = 64
TASK = make_task("vertical-jump")
OFF = RandomizationCfg.off()
OF_MODEL = (
    "base_mass", "base_moments", "link_mass", "link_moments", "com_shift", "armature", "motor_friction",
    "static_friction", "dynamic_friction",
)  # fmt: skip
PAPER = {
    "static_friction": (0.9, 1.2), "dynamic_friction": (0.8, 0.9), "base_mass": (-1.0, 2.0), "link_mass": (0.8, 1.2),
    "com_shift": (-0.03, 0.03), "gains": (0.6, 1.4), "no_load_speed": (0.8, 1.2), "cutoff_speed": (0.8, 1.4),
    "motor_friction": (0.005, 0.04), "armature": (0.6, 1.4), "joint_offset": (-2.0, 2.0), "latency": (0.0, 16.0),
    "push_force": (-5.0, 5.0), "push_torque": (-3.0, 3.0),
}  # fmt: skip
"""Table V, jumping."""
HELD = {"push_interval": None, "push_probability": 1.0}  # A push in every episode, from its beginning to its end
ALL = PAPER | {"observation_latency": (0.0, 16.0)}  # Every row


def randomized(cfg, num_envs=N, **arguments):
    """Return an environment that begins in the default pose, with the randomisation cfg; arguments: of `make_env`."""
    task = resetting(dataclasses.replace(TASK, randomization=cfg), only("default"))
    return make_env(num_envs, task=task, **({"randomize": True} | arguments))


def read(env):
    """Return every randomised parameter from solver, motors and environment by name, (..., num_envs)."""
    n, table = env.num_envs, env.sim.dynamics.robot.table.numpy().astype(float)
    legs = np.array([leg * layout.LEG_ROWS for leg in range(4)])
    links = np.array([[leg + link * layout.MOMENT_ROWS for link in range(5)] for leg in legs]).ravel()
    base, motors, parameters = int(layout.BASE), env.sim.motors, env.parameters
    moments = table[links[:, None] + np.arange(10)].reshape(20, 10, n)
    three = (legs[:, None] + np.arange(3)).ravel()
    return {
        "static_friction": table[legs + int(layout.MU_STATIC)],
        "dynamic_friction": table[legs + int(layout.MU_DYNAMIC)],
        "base_mass": table[base],
        "base_moments": table[base : base + 10],
        "link_mass": moments[:, 0],
        "link_moments": moments,
        "com_shift": table[base + 1 : base + 4] / table[base],
        "armature": table[three + int(layout.ARMATURE)],
        "motor_friction": table[three + int(layout.FRICTION)],
        **{name: getattr(motors, name).numpy().astype(float) for name in ("kp", "kd", "no_load_speed", "cutoff_speed")},
        "joint_offset": motors.offset.numpy().astype(float),
        "latency": parameters.latency.numpy().astype(float),
        "observation_latency": parameters.observation_latency.numpy().astype(float),
        "push_force": parameters.push.numpy()[:, :3].T.astype(float),
        "push_torque": parameters.push.numpy()[:, 3:].T.astype(float),
    }


def own_model(env: Env) -> dict[str, np.ndarray]:
    """Return the randomised arrays of SolverMuJoCo's model by name, (num_envs, ...); {} on SolverJumper."""
    if not isinstance(env.sim.solver, SolverMuJoCo):
        return {}
    model = env.sim.solver.mjw_model
    names = ("body_mass", "body_inertia", "body_ipos", "dof_armature", "dof_frictionloss", "geom_friction")
    return {name: getattr(model, name).numpy().copy() for name in names}


def seen(env):
    """Return `read`, on SolverMuJoCo without the parameters in `own_model`."""
    left_out = [] if isinstance(env.sim.solver, SolverJumper) else OF_MODEL
    return {name: values for name, values in read(env).items() if name not in left_out}


def within(values, lower, upper):
    """Return whether values are within a range, with tolerance for rounding."""
    width = upper - lower
    return values.min() >= lower - 1e-5 * width and values.max() <= upper + 1e-5 * width


def fills(values, lower, upper):
    """Return whether values are within a range, reach both ends, and have their mean near its middle."""
    width = upper - lower
    wide = values.min() < lower + 0.03 * width and values.max() > upper - 0.03 * width
    return within(values, lower, upper) and wide and abs(values.mean() - 0.5 * (lower + upper)) < 0.1 * width


ROWS = {
    "base_mass": lambda sampled, nominal: sampled["base_mass"] - nominal["base_mass"],
    "link_mass": lambda sampled, nominal: sampled["link_mass"] / nominal["link_mass"],
    "com_shift": lambda sampled, nominal: sampled["com_shift"] - nominal["com_shift"],
    "gains": lambda sampled, nominal: np.stack([sampled["kp"] / nominal["kp"], sampled["kd"] / nominal["kd"]]),
    "no_load_speed": lambda sampled, nominal: sampled["no_load_speed"] / nominal["no_load_speed"],
    "motor_friction": lambda sampled, nominal: sampled["motor_friction"],
    "armature": lambda sampled, nominal: sampled["armature"] / nominal["armature"],
    "joint_offset": lambda sampled, nominal: sampled["joint_offset"] / DEG,
    "push_force": lambda sampled, nominal: sampled["push_force"],
    "push_torque": lambda sampled, nominal: sampled["push_torque"],
    "dynamic_friction": lambda sampled, nominal: sampled["dynamic_friction"],
    "static_friction": lambda sampled, nominal: sampled["static_friction"],
}
