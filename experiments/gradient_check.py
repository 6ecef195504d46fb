"""Compare the gradients of a jump's apex with central differences, raise the apex by them, write metrics and a plot.

    python experiments/gradient_check.py --out outputs/gradients

The jump starts in a squat on the ground and is simulated with filter, motors, dynamics and contact, at the solver's
default step. Gradients and differences are in double precision, the ascent in single precision.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from jumper_warp.diff.rollout import Trajectory
from jumper_warp.viz.plots import figure
from support.gradients import INNER, OUTER, TICKS, GradientJump, GradientPair, apex, check, schedule
from support.scripts import DeviceArgs, prepare, report, run_script

WEAK_PUSH = (20.0, 20.0)  # [deg] Commands of the push-off that the ascent starts from
ASCENT_STEPS = 20  # Number of steps of the gradient ascent
ASCENT_CHANGE = 0.05  # [rad] Largest change of a target in a step of the ascent


@dataclass
class Ascent:
    """Result of the gradient ascent on a jump's apex."""

    apex: list[float]  # [m] Apex height before each step and after the last
    before: np.ndarray  # [rad] (TICKS, 12) Motor targets before the first step
    after: np.ndarray  # [rad] (TICKS, 12) Motor targets after the last step


def ascend(device: str | None) -> Ascent:
    """Raise the apex of a jump with a weak push-off by ASCENT_STEPS normalised gradient steps on all motor targets.

    In each step the target with the largest derivative changes by ASCENT_CHANGE, whatever the size of the gradient.
    """
    jump = GradientJump(1, double=False, device=device)
    targets = schedule(WEAK_PUSH)
    heights = []
    for _ in range(ASCENT_STEPS):
        rollout, grads = jump.gradients({"targets": targets})
        heights.append(float(apex(rollout)[0]))
        targets = targets + ASCENT_CHANGE * grads["targets"] / np.abs(grads["targets"]).max()
    heights.append(float(apex(jump.run({"targets": targets}))[0]))
    return Ascent(heights, schedule(WEAK_PUSH), targets)


def plot_gradients(jump: Trajectory, actions: GradientPair, ascent: Ascent, path: Path) -> None:
    """Plot the apex's gradient and central differences over time, the jump's height, and the ascent into a file.

    jump: in one world; actions: (gradient, differences) [m/rad], FL outer then FL inner, TICKS values each.
    """
    with figure(path, 4, 1, figsize=(8, 12), title="Gradient of a jump's apex with respect to its targets") as axes:
        ticks = np.arange(TICKS) / 60.0
        gradient, differenced = (values.reshape(2, TICKS) for values in actions)
        for i, name in enumerate(("outer", "inner")):
            (line,) = axes[0].plot(ticks, 100.0 * gradient[i], label=f"FL {name}: gradient")
            style = {"mfc": "none", "color": line.get_color(), "label": f"FL {name}: central difference"}
            axes[0].plot(ticks, 100.0 * differenced[i], "o", **style)
        height = jump.q.numpy()[:, 2, 0]
        pushed = np.flatnonzero(jump.impulse.numpy()[: height.argmax(), :, 0].any(axis=(1, 2)))
        axes[1].plot(np.arange(len(height)) / 480.0, height)  # physics steps of 1/480 s
        axes[1].axvline((pushed[-1] + 1) / 480.0, color="0.4", linestyle=":", label="takeoff")
        axes[2].plot(range(ASCENT_STEPS + 1), ascent.apex, "o-")
        for motor, name in ((OUTER, "outer"), (INNER, "inner")):
            (line,) = axes[3].plot(ticks, np.degrees(ascent.before[:, motor]), "--", label=f"FL {name}: at first")
            axes[3].plot(ticks, np.degrees(ascent.after[:, motor]), color=line.get_color(), label=f"FL {name}: at last")
        x_labels = ("time of the target [s]", "time [s]", "step of the ascent", "time [s]")
        y_labels = ("gradient [cm/rad]", "base height [m]", "apex [m]", "target [deg]")
        for axis, x_label, y_label in zip(axes, x_labels, y_labels, strict=True):
            axis.set(xlabel=x_label, ylabel=y_label)


def main(args: DeviceArgs) -> dict:
    """Check the gradients of a jump's apex, raise the apex by them, plot both, and return the metrics."""
    folder = prepare("gradient_check", args)
    jump, checks = check(args.device)
    ascent = ascend(args.device)
    values = {
        f"worst_relative_error_{name}": float(np.abs(gradient - differenced).max() / np.abs(differenced).max())
        for name, (gradient, differenced) in checks.items()
    }
    values |= {"jump_apex_m": float(apex(jump)[0]), "apex_before_m": ascent.apex[0], "apex_after_m": ascent.apex[-1]}
    plot_gradients(jump, checks["actions"], ascent, folder / "gradients.png")
    return report(args, folder, values, "Gradients of a jump's apex against central differences", values)


if __name__ == "__main__":
    run_script(main, DeviceArgs)
