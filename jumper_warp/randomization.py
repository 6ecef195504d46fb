"""Domain randomisation (paper, Table V): every row per environment, written into the Newton model or the motors."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from typing import Any

import newton
import numpy as np
import warp as wp
from newton import ModelFlags

from jumper_warp.checks import check_finite
from jumper_warp.description import load_description
from jumper_warp.dynamics import find_paws

Range = tuple[float, float] | None
NUM_DRAWN = 50
"""Rows of `Randomizer.drawn`."""
MOTOR_DOFS = np.array([6 + 5 * leg + j for leg in range(4) for j in (0, 1, 3)])


@dataclass(frozen=True)
class RandomizationCfg:
    """Ranges of uniform draws; None turns a row off. Masses and scales stay positive; friction and latency may be 0."""

    static_friction: Range = (0.9, 1.2)
    """[1] Not below the dynamic coefficient of the same environment."""
    dynamic_friction: Range = (0.8, 0.9)
    """[1]"""
    base_mass: Range = (-1.0, 2.0)
    """[kg] Added to the base."""
    link_mass: Range = (0.8, 1.2)
    """[1] Scales mass and inertia of each link."""
    com_shift: Range = (-0.03, 0.03)
    """[m] Of the base, along each axis."""
    gains: Range = (0.6, 1.4)
    """[1] Scales kp and kd of each motor."""
    no_load_speed: Range = (0.8, 1.2)
    """[1] Scales each motor's."""
    cutoff_speed: Range = (0.8, 1.4)
    """[1] Scales each motor's; stays below the no-load speed."""
    motor_friction: Range = (0.005, 0.04)
    """[N m] Coulomb friction of each motor."""
    armature: Range = (0.6, 1.4)
    """[1] Scales each motor's."""
    joint_offset: Range = (-2.0, 2.0)
    """[deg] Constant error of each motor's position sensor."""
    latency: Range = (0.0, 16.0)
    """[ms] From action to motor, rounded down to whole physics steps."""
    force: Range = (-5.0, 5.0)
    """[N] On the base, along each world axis, while not in flight."""
    torque: Range = (-3.0, 3.0)
    """[N m] On the base, about each world axis, while not in flight."""

    def __post_init__(self) -> None:
        """Raises ValueError: a range falls, is not finite, or reaches what no robot can have."""
        for name, value in vars(self).items():
            if value is None:
                continue
            check_finite(f"randomisation range {name}", *value)
            least, above = _least(name)
            if not value[0] <= value[1]:
                raise ValueError(f"randomisation range {name} must rise, got {value}")
            if value[0] < least or (above and value[0] == least):
                bound = f"be above {least:g}" if above else "not be negative"
                raise ValueError(f"randomisation range {name} must {bound}, got {value}")

    @classmethod
    def off(cls) -> RandomizationCfg:
        """Return a configuration with every row off."""
        return cls(**dict.fromkeys(cls.__dataclass_fields__))


@cache
def _base_mass() -> float:
    """Return the mass of the base as described [kg]."""
    return load_description().links[0].mass


def _least(name: str) -> tuple[float, bool]:
    """Return the least value of a row, and whether the row must stay above it."""
    if name == "base_mass":
        return -_base_mass(), True
    if name in ("link_mass", "gains", "no_load_speed", "cutoff_speed", "armature"):
        return 0.0, True
    if name in ("static_friction", "dynamic_friction", "motor_friction", "latency"):
        return 0.0, False
    return -math.inf, False


class Randomizer:
    """Draws new parameters for all worlds of a model, always from the nominal values."""

    def __init__(self, model: newton.Model, motors: Any, cfg: RandomizationCfg, seed: int):
        """Remember the nominal values of the model and of `motors` (MotorArrays)."""
        self.cfg = cfg
        self._model, self._motors = model, motors
        self._rng = np.random.default_rng(seed)
        self._n = model.world_count
        names = ("body_mass", "body_com", "body_inertia", "joint_armature", "joint_friction", "shape_material_mu")
        self._nominal = {name: getattr(model, name).numpy().copy() for name in names}
        constants = ("kp", "kd", "no_load_speed", "cutoff_speed")
        self._nominal_motors = {name: getattr(motors, name).numpy().copy() for name in constants}
        self._paws = find_paws(model)

    def _draw(self, limits: Range, shape: tuple[int, ...], off: float) -> np.ndarray:
        return np.full(shape, off) if limits is None else self._rng.uniform(*limits, shape)

    def apply(self, env: Any) -> None:
        """Draw and write everything.

        `env` receives the rest: `env.push`, `env.delay`, `env.joint_offset` and `env.static_friction_ratio` are arrays,
        `env.notify(flags)` tells the solver.
        """
        self._bodies()
        self._joints()
        self._motor_constants()
        self._friction(env)
        n, cfg = self._n, self.cfg
        wrench = np.concatenate([self._draw(cfg.force, (n, 3), 0.0), self._draw(cfg.torque, (n, 3), 0.0)], axis=1)
        env.push.assign(wrench.astype(np.float32))
        delay = self._draw(cfg.latency, (n,), 0.0) / 1000.0 / env.physics_dt
        env.delay.assign(np.floor(delay + 1.0e-6).astype(np.int32))  # a whole step stays one despite rounding errors
        offset = np.radians(self._draw(cfg.joint_offset, (12, n), 0.0)).astype(np.float32)
        env.joint_offset.assign(offset)
        self._motors.offset.assign(offset)
        env.notify(
            ModelFlags.BODY_INERTIAL_PROPERTIES
            | ModelFlags.JOINT_DOF_FORCE_PROPERTIES
            | ModelFlags.JOINT_DOF_INERTIAL_PROPERTIES
            | ModelFlags.SHAPE_PROPERTIES
        )

    def drawn(self, env: Any) -> np.ndarray:
        """Return what was drawn and matters most to a jump, (NUM_DRAWN, num_worlds) float32, of order 1; 0 if nominal.

        Base mass and centre, mass of the legs, kp and no-load speed of each motor, latency, friction, sensor offsets,
        push.
        """
        n, model = self._n, self._model
        mass = model.body_mass.numpy().reshape(n, -1)
        off = mass - self._nominal["body_mass"].reshape(n, -1)
        com = (model.body_com.numpy() - self._nominal["body_com"]).reshape(n, -1, 3)[:, 0]
        ratio = {
            name: getattr(self._motors, name).numpy() / self._nominal_motors[name] - 1.0
            for name in ("kp", "no_load_speed")
        }
        mu = model.shape_material_mu.numpy()[self._paws[:, 0]] - self._nominal["shape_material_mu"][self._paws[:, 0]]
        push = env.push.numpy().reshape(n, 6)
        rows = [
            off[:, :1].T, off[:, 1:].sum(axis=1)[None], com.T / 0.03, ratio["kp"], ratio["no_load_speed"],
            env.delay.numpy()[None] / 8.0, mu[None] * 10.0, env.static_friction_ratio.numpy()[None] - 1.0,
            env.joint_offset.numpy() / 0.035, push[:, :3].T / 5.0, push[:, 3:].T / 3.0,
        ]  # fmt: skip
        return np.concatenate(rows).astype(np.float32)

    def _bodies(self) -> None:
        n, cfg, model = self._n, self.cfg, self._model
        nominal = self._nominal["body_mass"].reshape(n, -1)
        scale = self._draw(cfg.link_mass, nominal.shape, 1.0)
        scale[:, 0] = 1.0 + self._draw(cfg.base_mass, (n,), 0.0) / nominal[:, 0]
        mass = nominal * scale
        inertia = self._nominal["body_inertia"].reshape(n, -1, 3, 3) * scale[..., None, None]
        com = self._nominal["body_com"].reshape(n, -1, 3).copy()
        com[:, 0] += self._draw(cfg.com_shift, (n, 3), 0.0)
        model.body_mass.assign(mass.ravel().astype(np.float32))
        model.body_inv_mass.assign((1.0 / mass).ravel().astype(np.float32))
        model.body_inertia.assign(inertia.reshape(-1, 3, 3).astype(np.float32))
        model.body_inv_inertia.assign(np.linalg.inv(inertia.reshape(-1, 3, 3)).astype(np.float32))
        model.body_com.assign(com.reshape(-1, 3).astype(np.float32))

    def _joints(self) -> None:
        n, cfg = self._n, self.cfg
        armature = self._nominal["joint_armature"].reshape(n, -1).copy()
        armature[:, MOTOR_DOFS] *= self._draw(cfg.armature, (n, 12), 1.0)
        friction = self._nominal["joint_friction"].reshape(n, -1).copy()
        if cfg.motor_friction is not None:
            friction[:, MOTOR_DOFS] = self._draw(cfg.motor_friction, (n, 12), 0.0)
        self._model.joint_armature.assign(armature.ravel().astype(np.float32))
        self._model.joint_friction.assign(friction.ravel().astype(np.float32))

    def _motor_constants(self) -> None:
        cfg, shape = self.cfg, (12, self._n)
        gains = self._draw(cfg.gains, shape, 1.0)
        no_load = self._nominal_motors["no_load_speed"] * self._draw(cfg.no_load_speed, shape, 1.0)
        cutoff = self._nominal_motors["cutoff_speed"] * self._draw(cfg.cutoff_speed, shape, 1.0)
        values = {
            "kp": self._nominal_motors["kp"] * gains,
            "kd": self._nominal_motors["kd"] * (gains if cfg.gains is None else self._draw(cfg.gains, shape, 1.0)),
            "no_load_speed": no_load,
            "cutoff_speed": np.minimum(cutoff, 0.95 * no_load),
        }
        for name, value in values.items():
            getattr(self._motors, name).assign(value.astype(np.float32))

    def _friction(self, env: Any) -> None:
        mu = self._nominal["shape_material_mu"].copy()
        dynamic = mu[self._paws[:, 0]]
        if self.cfg.dynamic_friction is not None:
            dynamic = self._draw(self.cfg.dynamic_friction, (self._n,), 0.0)
            mu[self._paws] = dynamic[:, None]
        static = dynamic if self.cfg.static_friction is None else self._draw(self.cfg.static_friction, (self._n,), 0.0)
        self._model.shape_material_mu.assign(mu.astype(np.float32))
        ratio = np.ones_like(dynamic)  # without dynamic friction there is no static one either
        np.divide(np.maximum(static, dynamic), dynamic, out=ratio, where=dynamic > 0.0)
        env.static_friction_ratio.assign(ratio.astype(np.float32))


def no_motion(device: wp.DeviceLike, num_worlds: int) -> dict[str, wp.array]:
    """Return the arrays that `Randomizer.apply` fills, all zero: push, delay, joint_offset."""
    return {
        "push": wp.zeros(num_worlds, dtype=wp.spatial_vector, device=device),
        "delay": wp.zeros(num_worlds, dtype=int, device=device),
        "joint_offset": wp.zeros((12, num_worlds), dtype=float, device=device),
    }
