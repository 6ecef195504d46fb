"""What a gradient of a jump costs, in times of its simulation by the solver's own kernel.

    python experiments/gradient_cost.py --out outputs/gradient_cost
    python experiments/gradient_cost.py --device cuda --worlds 4096

The same jump (squat, push-off, flight; 36 policy steps of 8 physics steps) is run by the solver's kernel with the
command filter, and as a rollout with its reverse pass, by all parameters, targets and the initial state. Both in single
precision, with the solver's usual tolerance, on one thread of a CPU. The gradient is checked first: it must be that of
double precision.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
import warp as wp

from jumper_warp.cli.main import run_command
from jumper_warp.diff.rollout import Rollout, Trajectory, compact
from jumper_warp.kernels.layout import COORDS, DOFS
from jumper_warp.robot.description import load_description
from jumper_warp.robot.model import PHYSICS_DT, build_model, standing_configuration
from jumper_warp.robot.motors import filter_params, jumping_motors, vertical_jump_filter
from jumper_warp.sim.simulation import SUBSTEPS
from jumper_warp.sim.solver import MAX_SWEEPS, TOLERANCE
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.output import output_dir, write_metrics
from jumper_warp.utils.runtime import announce
from support.gradients import SQUAT, TICKS, schedule
from support.timing import device_memory, wall_time

PUSH = (-5.0, -8.0)
"""[deg] Outer and inner transversal command of the push-off."""


@dataclass(frozen=True)
class Args:
    """Flags."""

    worlds: int | None = None
    """Worlds (default: 64 on a CPU, 4096 on a GPU)."""
    repeats: int = 7
    """Timed repetitions; the fastest counts, and the two kinds take turns."""
    double: bool = False
    """Whether to compute in double precision."""
    out: Path | None = None
    """Folder for metrics.json (default: outputs/gradient_cost/<time>)."""
    device: str | None = None
    """Warp device."""

    def __post_init__(self) -> None:
        """Check the values."""
        if self.repeats < 1 or (self.worlds is not None and self.worlds < 1):
            raise InputError("worlds and repeats must be at least 1")


def start() -> tuple[np.ndarray, np.ndarray]:
    """Return coordinates (43,) and rates (38,) of the squat."""
    squat = dataclasses.replace(load_description(), poses={"squat": (0.0, SQUAT)})
    q = standing_configuration(squat, "squat")
    q[2] -= 1.0e-4
    return q, np.zeros(38)


class PlainJump:
    """The jump by the solver's kernel: a captured graph of filter and physics, a policy step after the other."""

    def __init__(self, rollout: Rollout, targets: np.ndarray):
        """Capture; the model and the parameters are those of the rollout."""
        self._rollout, n = rollout, rollout.num_worlds
        dynamics, modules = rollout.dynamics, rollout.dynamics.modules
        self._start = [rollout.array(np.tile(values, n)) for values in start()]
        self._q, self._qd = (wp.clone(array) for array in self._start)
        self._targets = rollout.array(np.repeat(targets[:, :, None], n, axis=2))
        safe = rollout.array(np.zeros((12, n)))
        limits = filter_params(vertical_jump_filter(), module=modules.command_filter)
        wrench = wp.zeros(dynamics.model.body_count, dtype=wp.spatial_vector, device=rollout.device)
        motors = rollout.motors
        drive = dynamics.drive(rollout.array(np.zeros(38 * n)), wrench, motors, safe)
        settings = dynamics.settings(PHYSICS_DT, SUBSTEPS, MAX_SWEEPS, TOLERANCE)

        def run() -> None:
            dynamics.work.impulse.zero_()
            for mine, first in zip((self._q, self._qd), self._start, strict=True):
                wp.copy(mine, first)
            for target in (self._targets[step] for step in range(len(targets))):
                wp.launch(
                    modules.command_filter.command_filter_kernel, dim=(4, n), device=rollout.device,
                    inputs=[0, target, self._q, self._qd, COORDS, DOFS, motors.offset, limits], outputs=[safe],
                )  # fmt: skip
                dynamics.advance(settings, drive, self._q, self._qd, self._q, self._qd)

        run()
        with wp.ScopedCapture(device=rollout.device) as capture:
            run()
        self._graph, self._arrays = capture.graph, (drive, safe, wrench)  # a graph on a GPU keeps no arrays alive

    def run(self) -> None:
        """Simulate."""
        wp.capture_launch(self._graph)

    def heights(self) -> np.ndarray:
        """Return the final heights [m] of the bases, (num_worlds,)."""
        return self._q.numpy().reshape(self._rollout.num_worlds, -1)[:, 2]


class GradientRun:
    """The jump as a rollout, and the reverse pass of its final height."""

    def __init__(self, worlds: int, double: bool, device: str | None):
        """Allocate."""
        model = build_model(worlds, visuals=False, device=device)
        self.rollout = Rollout(
            model, jumping_motors(), vertical_jump_filter(), double=double, tolerance=TOLERANCE, threads=1
        )
        self._q, self._qd = (self.rollout.array(np.repeat(row, worlds, axis=1)) for row in compact(*start()))
        self._targets = self.rollout.array(np.repeat(schedule(PUSH)[:, :, None], worlds, axis=2))
        trajectory = self.forward()
        seed = np.zeros(trajectory.q.shape)
        seed[-1, 2] = 1.0
        self._seed = self.rollout.array(seed)

    def forward(self) -> Trajectory:
        """Simulate."""
        return self.rollout.run(self._targets, self._q, self._qd)

    def run(self) -> dict[str, wp.array]:
        """Simulate, and return the gradient."""
        return self.rollout.backward(self.forward(), q=self._seed)


def main(args: Args) -> dict:
    """Run the experiment and return its figures."""
    name, device = announce(args.device, 1).name, wp.get_device(args.device)
    folder = output_dir("gradient_cost", args.out)
    worlds = args.worlds or (4096 if device.is_cuda else 64)
    exact = GradientRun(1, True, args.device).run()
    before = device_memory(device) if device.is_cuda else 0
    mine = GradientRun(worlds, args.double, args.device)
    plain = PlainJump(mine.rollout, schedule(PUSH))
    found = mine.run()
    errors = {
        key: float(np.abs(found[key].numpy()[..., 0] - exact[key].numpy()[..., 0]).max())
        / float(np.abs(exact[key].numpy()).max())
        for key in ("targets", "q", "qd", "table", "saturation")
    }
    trajectory = mine.forward()
    kept = (trajectory.q, trajectory.qd, trajectory.torque, trajectory.impulse, trajectory.pressed, trajectory.safe)
    times = {"plain": [], "forward": [], "gradient": []}
    for _ in range(args.repeats):
        for kind, run in (("plain", plain.run), ("forward", mine.forward), ("gradient", mine.run)):
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
        "kept_bytes_a_policy_step": sum(a.size * wp.types.type_size_in_bytes(a.dtype) for a in kept) / worlds / TICKS,
        "height_difference_m": float(np.abs(plain.heights() - trajectory.q.numpy()[-1, 2]).max()),
        **{f"error_{key}": error for key, error in errors.items()},
    }
    if device.is_cuda:
        values["memory_kib_a_world"] = (device_memory(device) - before) / worlds / 1024.0
    write_metrics(folder, values)
    for key, value in values.items():
        print(f"{key:28} {value:.4g}" if isinstance(value, float) else f"{key:28} {value}")
    print(f"figures in {folder}")
    return values


if __name__ == "__main__":
    run_command(lambda: main(tyro.cli(Args)))
