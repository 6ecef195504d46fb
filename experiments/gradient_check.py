"""Gradients of a jump's apex against central differences, and a jump raised by gradient ascent.

    python experiments/gradient_check.py --out outputs/gradients

The jump starts in a squat on the ground and goes through filter, motors, dynamics and contact, at the solver's usual
step. Gradients and differences are in double precision, the ascent in single precision.
"""

from __future__ import annotations

import dataclasses
import math
import time
from dataclasses import dataclass
from pathlib import Path

import matplotlib
import numpy as np
import tyro
import warp as wp
from rich.console import Console
from rich.table import Table

from jumper_warp.optim.rollout import DifferentiableRollout, Rollout
from jumper_warp.robot.description import load_description
from jumper_warp.robot.model import build_model, standing_configuration
from jumper_warp.robot.motors import jumping_motors, vertical_jump_filter
from jumper_warp.utils.output import output_dir, write_figures
from jumper_warp.utils.runtime import report_device
from kernels.layout import BASE, LEG_ROWS, MOMENT_ROWS, MU_DYNAMIC, MU_STATIC

matplotlib.use("Agg")
import matplotlib.pyplot as plt

TICKS = 36
"""Policy steps of 1/60 s."""
SQUAT = math.radians(85.0)
PUSH = (-5.0, -8.0)
"""[deg] Outer and inner transversal command of the push-off; the filter binds, the motors saturate at first."""
WEAK_PUSH = (20.0, 20.0)
"""[deg] The push-off that the ascent starts from."""
ASCENT_STEPS = 20
ASCENT_CHANGE = 0.05
"""[rad] Largest change of a target in a step of the ascent."""
SLIP_SPEED = 1.5
"""[m/s] Forward speed of the jump on slippery ground that friction is checked on."""
SLIP_FRICTION = 0.25
OUTER, INNER = 1, 2
"""Motors of the front left leg in the plot."""


@dataclass(frozen=True)
class Args:
    """Flags."""

    out: Path | None = None
    """Folder for figures and plot (default: outputs/gradient_check/<time>)."""
    device: str | None = None
    """Warp device."""


def schedule(push: tuple[float, float]) -> np.ndarray:
    """Return the motor targets [rad] of a push-off [deg], shape (TICKS, 12)."""
    targets = np.zeros((TICKS, 4, 3))
    targets[:2, :, 1:] = SQUAT
    targets[2:, :, 1:] = np.radians(push)
    return targets.reshape(TICKS, 12)


class Jump:
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

    def run(self, inputs: dict[str, np.ndarray], pack: bool = False) -> tuple[dict[str, wp.array], Rollout]:
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

    def gradients(self, inputs: dict[str, np.ndarray], pack: bool = False) -> tuple[Rollout, dict[str, np.ndarray]]:
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
    batch = Jump(2 * len(directions), double=True, device=device)
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


def mass_directions(jump: Jump) -> np.ndarray:
    """Return what 1 kg more of each body, its com and the inertia about it held, adds to the parameter table."""
    directions = np.zeros((21, len(jump.values["table"])))
    for body, direction in enumerate(directions):
        leg, link = divmod(body - 1, 5)
        row = int(BASE) if body == 0 else leg * int(LEG_ROWS) + link * MOMENT_ROWS
        c = jump.model.body_com.numpy()[body].astype(float)
        direction[row : row + MOMENT_ROWS] = [1.0, *c, *(c * c), c[0] * c[1], c[0] * c[2], c[1] * c[2]]
    return directions


def check(device: str | None) -> tuple[Rollout, dict[str, tuple[np.ndarray, np.ndarray]]]:
    """Return the jump, and by input the gradient of its apex beside the differences."""
    jump = Jump(1, double=True, device=device)
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


@dataclass
class Ascent:
    """A jump improved by gradient ascent."""

    apex: list[float]  # [m] before each step and after the last
    before: np.ndarray  # targets [rad], (TICKS, 12)
    after: np.ndarray


def ascend(device: str | None) -> Ascent:
    """Raise the weak jump by steps along the gradient with respect to all targets."""
    jump = Jump(1, double=False, device=device)
    targets, heights = schedule(WEAK_PUSH), []
    for _ in range(ASCENT_STEPS):
        rollout, grads = jump.gradients({"targets": targets})
        heights.append(float(rollout.apex.numpy()[0]))
        targets = targets + ASCENT_CHANGE * grads["targets"] / np.abs(grads["targets"]).max()
    heights.append(float(jump.run({"targets": targets})[1].apex.numpy()[0]))
    return Ascent(heights, schedule(WEAK_PUSH), targets)


def plot(rollout: Rollout, actions: tuple[np.ndarray, np.ndarray], ascent: Ascent, path: Path) -> None:
    """Draw the gradient along the jump with the differences on it, the jump, and the ascent."""
    fig, axes = plt.subplots(4, 1, figsize=(8, 11), constrained_layout=True)
    ticks = np.arange(TICKS) / 60.0
    found, differenced = (values.reshape(2, TICKS) for values in actions)
    for i, name in enumerate(("outer", "inner")):
        (line,) = axes[0].plot(ticks, 100.0 * found[i], label=f"FL {name}, gradient")
        axes[0].plot(ticks, 100.0 * differenced[i], "o", mfc="none", color=line.get_color(), label="central difference")
    height = rollout.height.numpy()[:, 0]
    axes[1].plot(np.arange(len(height)) / 480.0, height)
    axes[1].axvline(rollout.takeoff_row.numpy()[0] / 480.0, color="0.6", linestyle="--", label="takeoff")
    axes[2].plot(range(ASCENT_STEPS + 1), ascent.apex, "o-")
    for motor, name in ((OUTER, "outer"), (INNER, "inner")):
        (line,) = axes[3].plot(ticks, np.degrees(ascent.before[:, motor]), "--", label=f"FL {name}, before")
        axes[3].plot(ticks, np.degrees(ascent.after[:, motor]), color=line.get_color(), label="after")
    labels = (
        ("time of the target [s]", "d apex / d target [cm/rad]"),
        ("time [s]", "base height [m]"),
        ("step of the ascent", "apex [m]"),
        ("time [s]", "target [deg]"),
    )
    for axis, (x, y) in zip(axes, labels, strict=True):
        axis.set(xlabel=x, ylabel=y)
        axis.grid(alpha=0.3)
    for axis in (axes[0], axes[1], axes[3]):
        axis.legend(fontsize=8, ncols=2)
    fig.savefig(path, dpi=110)
    plt.close(fig)


def main(args: Args) -> dict:
    """Run the experiment and return its figures."""
    wp.config.log_level = wp.LOG_WARNING
    report_device(args.device)
    folder = output_dir("gradient_check", args.out)
    start = time.perf_counter()
    rollout, checks = check(args.device)
    ascent = ascend(args.device)
    values = {
        f"worst_relative_error_{name}": float(np.abs(found - differenced).max() / np.abs(differenced).max())
        for name, (found, differenced) in checks.items()
    }
    values |= {
        "jump_apex_m": float(rollout.apex.numpy()[0]),
        "apex_before_m": ascent.apex[0],
        "apex_after_m": ascent.apex[-1],
        "seconds": time.perf_counter() - start,
    }
    write_figures(folder, values)
    plot(rollout, checks["actions"], ascent, folder / "gradients.png")
    table = Table("figure", "value", title="Gradients of the apex; errors relative to the largest entry")
    for name, value in values.items():
        table.add_row(name, f"{value:.3g}")
    Console().print(table)
    print(f"figures and plot in {folder}")
    return values


if __name__ == "__main__":
    main(tyro.cli(Args))
