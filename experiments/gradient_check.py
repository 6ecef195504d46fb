"""Compare the gradients of a jump's apex with central differences, and write metrics.

    python experiments/gradient_check.py --out outputs/gradients

The jump starts in a squat on the ground and is simulated with filter, motors, dynamics and contact, at the solver's
default step, in double precision. Gradients are with respect to targets, start and parameters.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from jumper_warp.diff.bodies import body_gradients, moment_rows
from jumper_warp.diff.rollout import Rollout, Trajectory, compact
from jumper_warp.kernels.layout import BODIES, LEG_ROWS, MU_DYNAMIC, MU_STATIC
from jumper_warp.robot.description import load_description
from jumper_warp.robot.model import build_model, standing_configuration
from jumper_warp.robot.motors import jumping_motors, vertical_jump_filter
from support.scripts import DeviceArgs, prepare, report, run_script

TICKS = 36  # Number of policy steps of 1/60 s of the jump
SQUAT = math.radians(85.0)  # [rad] Transversal angle of the squat
PUSH = (-5.0, -8.0)  # [deg] Outer and inner command of the push-off; the filter binds, the motors saturate at first
SLIP_SPEED = 1.5  # [m/s] Initial forward speed of the jump on slippery ground for the gradient by friction
SLIP_FRICTION = 0.25  # [1] Dynamic friction of this ground; static is 1.2 times as large
OUTER, INNER = 1, 2  # Motors of the front left leg whose targets are checked
PARAMETERS = ("table", "saturation")  # Inputs that are parameters of the rollout
GradientPair = tuple[np.ndarray, np.ndarray]  # Derivatives of the apex: gradient, central differences; (n,) each


def schedule(push: tuple[float, float]) -> np.ndarray:
    """Return the motor targets [rad], (TICKS, 12), of a jump: squat, then push-off.

    push: outer and inner transversal angles of the push-off [deg].
    """
    targets = np.zeros((TICKS, 4, 3))
    targets[:2, :, 1:] = SQUAT
    targets[2:, :, 1:] = np.radians(push)
    return targets.reshape(TICKS, 12)


def start() -> tuple[np.ndarray, np.ndarray]:
    """Return the jump's initial state, a squat: coordinates (43,) and rates (38,).

    The paws are 0.1 mm in the ground, so that contacts do not switch.
    """
    squat = dataclasses.replace(load_description(), poses={"squat": (0.0, SQUAT)})
    q = standing_configuration(squat, "squat")
    q[2] -= 1.0e-4
    return q, np.zeros(38)


class GradientJump:
    """Differentiable simulation of a jump in parallel worlds, from inputs by name.

    targets [rad] (TICKS, 12), coordinates q (19,), rates qd (18,), parameters table (rows,), saturation [N m] (12,).
    """

    def __init__(self, num_worlds: int, device: str | None):
        """Build the rollout and the jump's default inputs, `values`."""
        self.num_worlds = num_worlds
        model = build_model(num_worlds, visuals=False, device=device)
        self.rollout = Rollout(model, jumping_motors(), vertical_jump_filter(), double=True, every=1)
        q, qd = (row[:, 0] for row in compact(*start()))
        self.values = {"targets": schedule(PUSH), "q": q, "qd": qd}
        self.values |= {name: self.rollout.parameters[name].numpy()[:, 0].astype(float) for name in PARAMETERS}

    def run(self, inputs: dict[str, np.ndarray]) -> Trajectory:
        """Simulate the jump with `inputs` in place of defaults; return the trajectory.

        An input that differs between worlds has them as first axis.
        """
        by_world = {}
        for name, value in (self.values | inputs).items():
            rows = np.broadcast_to(value, (self.num_worlds, *value.shape[-self.values[name].ndim :]))
            by_world[name] = np.moveaxis(rows, 0, -1)
        for name in PARAMETERS:
            self.rollout.parameters[name].assign(np.ascontiguousarray(by_world[name]))
        return self.rollout.run(by_world["targets"], by_world["q"], by_world["qd"])

    def gradients(self, inputs: dict[str, np.ndarray]) -> tuple[Trajectory, dict[str, np.ndarray]]:
        """Simulate a jump in one world; return it and the gradients of its apex with respect to all inputs.

        The gradient of the largest height is that of the height in its row. It has the shape of its input; `mass` (21,)
        is added.
        inputs: as for `run`; mass: of each body [m/kg].
        """
        jump = self.run(inputs)
        cotangent = np.zeros(jump.q.shape)
        cotangent[jump.q.numpy()[:, 2, 0].argmax(), 2, 0] = 1.0
        grads = {
            name: array.numpy()[..., 0].astype(float)
            for name, array in self.rollout.backward(jump, q=self.rollout.array(cotangent)).items()
        }
        grads["mass"] = body_gradients(self.rollout.parameters["table"].numpy(), grads["table"][:, None])["mass"][:, 0]
        return jump, grads


def apex(jump: Trajectory) -> np.ndarray:
    """Return the largest base height [m] of every world, (num_worlds,)."""
    return jump.q.numpy()[:, 2].max(axis=0)


def differences(
    inputs: dict[str, np.ndarray], name: str, directions: np.ndarray, step: float, device: str | None
) -> np.ndarray:
    """Compute central differences of a jump's apex with respect to the input `name`, [m per unit], (n,).

    directions: (n, ...), along which the input changes.
    inputs: as for `GradientJump.run`; step: half the distance of the two points. All 2 n jumps run in parallel worlds.
    """
    batch = GradientJump(2 * len(directions), device)
    middle = inputs.get(name, batch.values[name])
    points = np.concatenate([middle + step * directions, middle - step * directions])
    upper, lower = np.split(apex(batch.run(inputs | {name: points})), 2)
    return (upper - lower) / (2.0 * step)


def unit_directions(shape: tuple[int, ...], indices: list) -> np.ndarray:
    """Return unit vectors along single entries of an input, (n, *shape).

    shape: of the input; indices: n of its entries.
    """
    directions = np.zeros((len(indices), *shape))
    for direction, entry in zip(directions, indices, strict=True):
        direction[entry] = 1.0
    return directions


def mass_directions(table: np.ndarray) -> np.ndarray:
    """Return the change of the parameter table (rows,) by 1 kg more of each body, (bodies, rows).

    The COM c and the inertia about it are constant: the table's moments about the origin gain 1, c and c c^T.
    """
    directions = np.zeros((int(BODIES), len(table)))
    for body, direction in enumerate(directions):
        moments = table[moment_rows(body)]
        c = moments[1:4] / moments[0]
        direction[moment_rows(body)] = [1.0, *c, *(c * c), c[0] * c[1], c[0] * c[2], c[1] * c[2]]
    return directions


def check(device: str | None) -> tuple[Trajectory, dict[str, GradientPair]]:
    """Compute the gradients of a jump's apex by the reverse pass and by central differences.

    Returns the jump, and pairs (gradient, differences) by kind of input.
    Kinds: actions (targets of OUTER and INNER), mass, torque_limit, friction (on the slippery ground, since it has no
    effect on a paw that sticks), initial_state.
    """
    jump = GradientJump(1, device)
    trajectory, grads = jump.gradients({})
    motors = [(t, m) for m in (OUTER, INNER) for t in range(TICKS)]
    coords = [2, 3, 4, 5, *range(7, 19)]
    rates = list(range(18))

    def compare(gradient: np.ndarray, name: str, directions: np.ndarray, step: float, inputs: dict) -> GradientPair:
        """Pair derivatives of the apex along directions of an input with their central differences."""
        return gradient, differences(inputs, name, directions, step, device)

    def at_entries(name: str, indices: list, step: float, gradient: np.ndarray, inputs: dict) -> GradientPair:
        """Pair derivatives of the apex with respect to single entries of an input with their central differences."""
        directions = unit_directions(gradient.shape, indices)
        return compare(np.array([gradient[index] for index in indices]), name, directions, step, inputs)

    slip = {"table": jump.values["table"].copy(), "qd": jump.values["qd"].copy()}
    friction_rows = [leg * int(LEG_ROWS) + int(row) for leg in range(4) for row in (MU_DYNAMIC, MU_STATIC)]
    slip["table"][friction_rows] = [SLIP_FRICTION, 1.2 * SLIP_FRICTION] * 4
    slip["qd"][0] = SLIP_SPEED
    slip_grad = jump.gradients(slip)[1]["table"]
    position = at_entries("q", coords, 1.0e-7, grads["q"], {})
    speed = at_entries("qd", rates, 1.0e-6, grads["qd"], {})
    return trajectory, {
        "actions": at_entries("targets", motors, 2.0e-6, grads["targets"], {}),
        "mass": compare(grads["mass"], "table", mass_directions(jump.values["table"]), 1.0e-6, {}),
        "torque_limit": at_entries("saturation", list(range(12)), 1.0e-5, grads["saturation"], {}),
        "friction": at_entries("table", friction_rows, 1.0e-6, slip_grad, slip),
        "initial_state": (np.concatenate([position[0], speed[0]]), np.concatenate([position[1], speed[1]])),
    }


def main(args: DeviceArgs) -> dict:
    """Check the gradients of a jump's apex, and return the metrics."""
    folder = prepare("gradient_check", args)
    jump, checks = check(args.device)
    values = {
        f"worst_relative_error_{name}": float(np.abs(gradient - differenced).max() / np.abs(differenced).max())
        for name, (gradient, differenced) in checks.items()
    }
    values["jump_apex_m"] = float(apex(jump)[0])
    return report(args, folder, values, "Gradients of a jump's apex against central differences", values)


if __name__ == "__main__":
    run_script(main, DeviceArgs)
