"""Random actions for a long time: does any world ever become non-finite?

    python experiments/soak_test.py --envs 4096 --steps 2500 --out outputs/soak

An action is a target angle for every motor, drawn anew at random within the limits of the jump. Worlds start again
after `episode` steps, the legs' masses and the paws' friction differ from world to world.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path

import newton
import numpy as np
import tyro
import warp as wp

from jumper_warp.robot.motors import vertical_jump_filter
from jumper_warp.sim.simulation import Simulation
from jumper_warp.sim.solver import TOLERANCE
from jumper_warp.utils.output import output_dir, write_figures
from jumper_warp.utils.runtime import report_device


@dataclass(frozen=True)
class Args:
    """Flags."""

    envs: int = 1024
    """Number of environments."""
    steps: int = 10_000
    """Policy steps of each; with 1024 environments 10 million in all."""
    hold: int = 10
    """Policy steps for which an action is held."""
    episode: int = 300
    """Policy steps after which all worlds start again."""
    lateral: float = 15.0
    """[deg] Largest lateral target."""
    transversal: tuple[float, float] = (-30.0, 140.0)
    """[deg] Least and largest transversal target."""
    filter: bool = False
    """Whether the motor command filter guards the targets."""
    seed: int = 0
    """Of actions, masses and friction."""
    out: Path | None = None
    """Folder for figures.json (default: outputs/soak_test/<time>)."""
    device: str | None = None
    """Warp device."""

    def __post_init__(self) -> None:
        """Check the values."""
        for name in ("envs", "steps", "hold", "episode"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, got {getattr(self, name)}")


@wp.kernel(enable_backward=False)
def random_target_kernel(
    # in
    seed: wp.array(dtype=int),
    lower: wp.array(dtype=float),
    upper: wp.array(dtype=float),
    # out
    target: wp.array2d(dtype=float),
):
    """Draw a target [rad] for every motor; one thread per (motor, world)."""
    motor, world = wp.tid()
    state = wp.rand_init(seed[0], motor * target.shape[1] + world)
    target[motor, world] = wp.randf(state, lower[motor], upper[motor])


@wp.kernel(enable_backward=False)
def extremes_kernel(
    # in
    joint_qd: wp.array2d(dtype=float),
    residual: wp.array(dtype=float),
    tolerance: float,
    # in, out
    base_speed: wp.array(dtype=float),
    joint_speed: wp.array(dtype=float),
    unsolved: wp.array(dtype=int),
):
    """Keep the largest speeds, and count steps whose contact iteration missed its tolerance; one thread per world."""
    world = wp.tid()
    lin = wp.vec3(joint_qd[world, 0], joint_qd[world, 1], joint_qd[world, 2])
    base_speed[world] = wp.max(base_speed[world], wp.length(lin))
    for i in range(6, 26):
        joint_speed[world] = wp.max(joint_speed[world], wp.abs(joint_qd[world, i]))
    if residual[world] > tolerance:
        unsolved[world] += 1


def randomize(sim: Simulation, rng: np.random.Generator) -> None:
    """Give every world its own masses (0.8 to 1.25 times) and paw friction (0.2 to 1.2)."""
    model, n = sim.model, sim.num_worlds
    scale = rng.uniform(0.8, 1.25, n).astype(np.float32)
    model.body_mass.assign(model.body_mass.numpy() * np.repeat(scale, 21))
    model.body_inertia.assign(model.body_inertia.numpy() * np.repeat(scale, 21)[:, None, None])
    worlds, friction = model.shape_world.numpy(), rng.uniform(0.2, 1.2, n).astype(np.float32)
    mu = model.shape_material_mu.numpy()
    mu[worlds >= 0] = friction[worlds[worlds >= 0]]
    model.shape_material_mu.assign(mu)
    sim.solver.notify_model_changed(newton.ModelFlags.ALL)


def soak(sim: Simulation, args: Args) -> dict:
    """Run all steps and return the figures."""
    n, device = sim.num_worlds, sim.device
    lateral, low, high = (np.radians(value) for value in (args.lateral, *args.transversal))
    lower = wp.array(np.tile([-lateral, low, low], 4), dtype=float, device=device)
    upper = wp.array(np.tile([lateral, high, high], 4), dtype=float, device=device)
    seed = wp.zeros(1, dtype=int, device=device)
    speeds = [wp.zeros(n, dtype=float, device=device) for _ in range(2)]
    unsolved = wp.zeros(n, dtype=int, device=device)
    rates = sim.state.joint_qd.reshape((n, -1))
    flagged = 0
    start = time.perf_counter()
    for step in range(args.steps):
        if step % args.hold == 0:
            seed.fill_(args.seed + step)
            wp.launch(random_target_kernel, (12, n), inputs=[seed, lower, upper], outputs=[sim.target], device=device)
        sim.step()
        wp.launch(
            extremes_kernel,
            n,
            inputs=[rates, sim.solver.residual, TOLERANCE],
            outputs=[*speeds, unsolved],
            device=device,
        )
        if (step + 1) % args.episode == 0 or step + 1 == args.steps:
            flagged += int(np.count_nonzero(sim.solver.invalid.numpy()))
            finite = bool(np.isfinite(sim.joint_q()).all() and np.isfinite(sim.joint_qd()).all())
            if not finite:
                raise RuntimeError(f"a world holds values that are not finite but was not flagged, step {step}")
            sim.solver.reset(sim.state)
    wall = time.perf_counter() - start
    return {
        "steps": args.steps * n,
        "non_finite_worlds": flagged,
        "largest_speed_m_s": float(speeds[0].numpy().max()),
        "largest_joint_speed_rad_s": float(speeds[1].numpy().max()),
        "share_of_steps_contact_unsolved": float(unsolved.numpy().sum()) / (args.steps * n),
        "wall_s": wall,
        "steps_per_s": args.steps * n / wall,
    }


def main(args: Args) -> dict:
    """Run the soak test and return its figures."""
    wp.config.log_level = wp.LOG_WARNING
    report_device(args.device)
    folder = output_dir("soak_test", args.out)
    sim = Simulation(
        args.envs,
        command_filter=vertical_jump_filter() if args.filter else None,
        visuals=False,
        device=args.device,
    )
    randomize(sim, np.random.default_rng(args.seed))
    figures = soak(sim, args)
    write_figures(folder, figures | {"envs": args.envs, "filter": args.filter, "seed": args.seed})
    for name, value in figures.items():
        print(f"{name:34s} {value:,.6g}")
    print(f"figures in {folder}")
    return figures


if __name__ == "__main__":
    main(tyro.cli(Args))
