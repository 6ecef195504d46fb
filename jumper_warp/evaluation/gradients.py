"""Gradients of a jump's apex, beside central differences.

The jump starts in a squat on the ground and goes through filter, motors, dynamics and contact, at the solver's usual
step.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import warp as wp

from jumper_warp.optim.rollout import DifferentiableRollout, Trajectory
from jumper_warp.robot.description import load_description
from jumper_warp.robot.model import build_model, standing_configuration
from jumper_warp.robot.motors import jumping_motors, vertical_jump_filter
from kernels.layout import BASE, LEG_ROWS, MOMENT_ROWS, MU_DYNAMIC, MU_STATIC

TICKS = 36
"""Policy steps of 1/60 s."""
SQUAT = math.radians(85.0)
PUSH = (-5.0, -8.0)
"""[deg] Outer and inner transversal command of the push-off; the filter binds, the motors saturate at first."""
SLIP_SPEED = 1.5
"""[m/s] Forward speed of the jump on slippery ground that friction is checked on."""
SLIP_FRICTION = 0.25
OUTER, INNER = 1, 2
"""Motors of the front left leg in the plot."""


def schedule(push: tuple[float, float]) -> np.ndarray:
    """Return the motor targets [rad] of a push-off [deg], shape (TICKS, 12)."""
    targets = np.zeros((TICKS, 4, 3))
    targets[:2, :, 1:] = SQUAT
    targets[2:, :, 1:] = np.radians(push)
    return targets.reshape(TICKS, 12)


class GradientJump:
    """Jumps from NumPy inputs, by name: targets (TICKS, 12), q (43,), qd (38,), table (rows,), saturation (12,)."""

    def __init__(self, num_worlds: int, double: bool, device: str | None):
        self.num_worlds = num_worlds
        self.model = build_model(num_worlds, visuals=False, requires_grad=True, device=device)
        self.rollout = DifferentiableRollout(self.model, jumping_motors(), vertical_jump_filter(), double=double)
        self._parameters = {
            "table": self.rollout.dynamics.robot.table, "saturation": self.rollout.motors.saturation,
        }  # fmt: skip
        squat = dataclasses.replace(load_description(), poses={"squat": (0.0, SQUAT)})
        q = standing_configuration(squat, "squat")
        q[2] -= 1.0e-4  # in the ground, where no contact is about to switch
        self.values = {"targets": schedule(PUSH), "q": q, "qd": np.zeros(38)}
        self.values |= {name: array.numpy()[:, 0].astype(float) for name, array in self._parameters.items()}

    def run(self, inputs: dict[str, np.ndarray], pack: bool = False) -> tuple[dict[str, wp.array], Trajectory]:
        """Simulate. Inputs have the world as first axis where they differ; pack: read masses from the model first."""
        full = {}
        for name, value in (self.values | inputs).items():
            full[name] = np.broadcast_to(value, (self.num_worlds, *value.shape[-self.values[name].ndim :]))
        arrays = dict(self._parameters)
        for name, array in arrays.items():
            array.assign(full[name].T)
        setup = {"dtype": self.rollout.real, "device": self.model.device, "requires_grad": True}
        arrays["targets"] = wp.array(np.moveaxis(full["targets"], 0, -1), **setup)
        arrays["q"], arrays["qd"] = (wp.array(full[name].flatten(), **setup) for name in ("q", "qd"))
        if pack:
            self.rollout.dynamics.pack_masses()
        return arrays, self.rollout.run(arrays["targets"], arrays["q"], arrays["qd"])

    def gradients(self, inputs: dict[str, np.ndarray], pack: bool = False) -> tuple[Trajectory, dict[str, np.ndarray]]:
        """Return a jump in one world and the gradients of its apex; with `pack` also that of the bodies' mass."""
        with wp.Tape() as tape:
            arrays, rollout = self.run(inputs, pack)
        tape.backward(grads={rollout.apex: wp.ones_like(rollout.apex)})
        arrays["mass"] = self.model.body_mass
        grads = {name: array.grad.numpy().astype(float) for name, array in arrays.items()}
        tape.zero()
        return rollout, {name: grad[..., 0] if grad.ndim > 1 else grad for name, grad in grads.items()}


def differences(
    inputs: dict[str, np.ndarray], name: str, directions: np.ndarray, step: float, device: str | None
) -> np.ndarray:
    """Return central differences of the apex along directions (n, ...) of an input, each end in a world of its own."""
    batch = GradientJump(2 * len(directions), double=True, device=device)
    middle = inputs.get(name, batch.values[name])
    ends = np.concatenate([middle + step * directions, middle - step * directions])
    ahead, behind = np.split(batch.run(inputs | {name: ends})[1].apex.numpy(), 2)
    return (ahead - behind) / (2.0 * step)


def entries(shape: tuple[int, ...], chosen: list) -> np.ndarray:
    """Return unit directions along single entries of an input, (n, *shape)."""
    directions = np.zeros((len(chosen), *shape))
    for direction, entry in zip(directions, chosen, strict=True):
        direction[entry] = 1.0
    return directions


def mass_directions(jump: GradientJump) -> np.ndarray:
    """Return what 1 kg more of each body, its com and the inertia about it held, adds to the parameter table."""
    directions = np.zeros((21, len(jump.values["table"])))
    for body, direction in enumerate(directions):
        leg, link = divmod(body - 1, 5)
        row = int(BASE) if body == 0 else leg * int(LEG_ROWS) + link * MOMENT_ROWS
        c = jump.model.body_com.numpy()[body].astype(float)
        direction[row : row + MOMENT_ROWS] = [1.0, *c, *(c * c), c[0] * c[1], c[0] * c[2], c[1] * c[2]]
    return directions


def check(device: str | None) -> tuple[Trajectory, dict[str, tuple[np.ndarray, np.ndarray]]]:
    """Return the jump, and by input the gradient of its apex beside the differences."""
    jump = GradientJump(1, double=True, device=device)
    rollout, grads = jump.gradients({})
    masses = jump.gradients({}, pack=True)[1]["mass"]
    motors = [(t, m) for m in (OUTER, INNER) for t in range(TICKS)]
    joints = [5 * leg + j for leg in range(4) for j in (0, 1, 3)]
    coords, rates = [2, 3, 4, 5, *(7 + j for j in joints)], [*range(6), *(6 + j for j in joints)]

    def pair(found: np.ndarray, name: str, directions: np.ndarray, step: float, inputs: dict) -> tuple:
        return found, differences(inputs, name, directions, step, device)

    def chosen(name: str, which: list, step: float, gradient: np.ndarray, inputs: dict) -> tuple:
        found = np.array([gradient[entry] for entry in which])
        return pair(found, name, entries(gradient.shape, which), step, inputs)

    slip = {"table": jump.values["table"].copy(), "qd": jump.values["qd"].copy()}
    friction_rows = [leg * int(LEG_ROWS) + int(row) for leg in range(4) for row in (MU_DYNAMIC, MU_STATIC)]
    slip["table"][friction_rows] = [SLIP_FRICTION, 1.2 * SLIP_FRICTION] * 4
    slip["qd"][0] = SLIP_SPEED
    slip_grad = jump.gradients(slip)[1]["table"]
    position = chosen("q", coords, 1.0e-7, grads["q"], {})
    speed = chosen("qd", rates, 1.0e-6, grads["qd"], {})
    return rollout, {
        "actions": chosen("targets", motors, 2.0e-6, grads["targets"], {}),
        "mass": pair(masses, "table", mass_directions(jump), 1.0e-6, {}),
        "torque_limit": chosen("saturation", list(range(12)), 1.0e-5, grads["saturation"], {}),
        "friction": chosen("table", friction_rows, 1.0e-6, slip_grad, slip),
        "initial_state": tuple(np.concatenate(parts) for parts in zip(position, speed, strict=True)),
    }
