"""Measure how much a jump's gradient costs, in units of the jump's simulation, and write metrics.

    python experiments/gradient_cost.py --out outputs/gradient_cost
    python experiments/gradient_cost.py --device cuda --num-envs 4096

The same jump (squat, push-off, flight; 36 policy steps of 8 physics steps) is simulated twice: by the solver's kernel
with the command filter, and as a rollout with its reverse pass. The reverse pass differentiates with respect to all
parameters, targets and the initial state. Both run in single precision, with the solver's default tolerance, on one
thread of a CPU. The errors of the gradient are relative to double precision.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import warp as wp

from jumper_warp.sim.simulation import SUBSTEPS
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.output import output_dir
from jumper_warp.utils.runtime import configure_device
from support.gradient_runs import GradientRun, PlainJump
from support.gradients import PUSH, TICKS, schedule
from support.scripts import DeviceArgs, report, run_script
from support.timing import device_memory, wall_time


@dataclass(frozen=True)
class Args(DeviceArgs):
    """Flags of the timing of a jump's gradient."""

    num_envs: int | None = None  # Number of environments (default: 64 on a CPU, 4096 on a GPU)
    repeats: int = 7
    """Number of timed repetitions; simulation and gradient alternate, and the fastest time of each counts."""
    double: bool = False  # Whether to compute in double precision

    def __post_init__(self) -> None:
        if self.repeats < 1 or (self.num_envs is not None and self.num_envs < 1):
            raise InputError("num_envs and repeats must be at least 1")


def main(args: Args) -> dict:
    """Time a jump's simulation and gradient, compare the gradient with double precision, return the metrics."""
    name, device = configure_device(args.device, 1).name, wp.get_device(args.device)
    folder = output_dir("gradient_cost", args.out)
    worlds = args.num_envs or (4096 if device.is_cuda else 64)
    exact = GradientRun(1, True, args.device).run()
    before = device_memory(device) if device.is_cuda else 0
    differentiable = GradientRun(worlds, args.double, args.device)
    plain = PlainJump(differentiable.rollout, schedule(PUSH))
    gradient = differentiable.run()
    errors = {  # largest error in world 0 (worlds last) relative to the largest entry, by input of the rollout
        key: float(np.abs(gradient[key].numpy()[..., 0] - exact[key].numpy()[..., 0]).max())
        / float(np.abs(exact[key].numpy()).max())
        for key in ("targets", "q", "qd", "table", "saturation")
    }
    first = differentiable.forward()
    saved = (first.q, first.qd, first.torque, first.impulse, first.pressed, first.filtered_target)
    times = {"plain": [], "forward": [], "gradient": []}
    for _ in range(args.repeats):
        for kind, run in (("plain", plain.run), ("forward", differentiable.forward), ("gradient", differentiable.run)):
            times[kind].append(wall_time(run, args.device))
    plain.run()
    best = {kind: min(values) for kind, values in times.items()}
    steps = worlds * TICKS * SUBSTEPS
    values = {
        "device": name,
        "worlds": worlds,
        f"{'gpu' if device.is_cuda else 'cpu'}_ratio": best["gradient"] / best["plain"],
        "forward_ratio": best["forward"] / best["plain"],
        **{f"{kind}_us_a_step": 1.0e6 * value / steps for kind, value in best.items()},
        "kept_bytes_a_policy_step": sum(a.size * wp.types.type_size_in_bytes(a.dtype) for a in saved) / worlds / TICKS,
        "height_difference_m": float(np.abs(plain.heights() - first.q.numpy()[-1, 2]).max()),  # final base z
        **{f"error_{key}": error for key, error in errors.items()},
    }
    if device.is_cuda:
        values["memory_kib_a_world"] = (device_memory(device) - before) / worlds / 1024.0
    keys = [key for key in values if key.endswith(("ratio", "us_a_step", "error_targets", "kib_a_world"))]
    return report(args, folder, values, f"Gradient of a jump in {worlds:,} worlds, {name}", keys)


if __name__ == "__main__":
    run_script(main, Args)
