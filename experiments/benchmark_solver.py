"""Policy steps per second of SolverJumper and of Newton's SolverMuJoCo, on the same robot, in one run.

    python experiments/benchmark_solver.py --envs 4096 --out outputs/benchmark

A policy step is 8 physics steps of 1/480 s, motors included. Both solvers replay a captured graph. Before anything is
timed, the outcome is checked: the robots stand, or reach their apex.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
import tyro
import warp as wp
from rich.console import Console
from rich.table import Table

from jumper_warp.robot.model import build_model
from jumper_warp.sim.simulation import Simulation, SolverName
from jumper_warp.utils.output import output_dir, write_figures
from jumper_warp.utils.runtime import report_device

SQUAT, DEFAULT, EXTEND = 110.0, 45.0, -10.0
"""[deg] Commanded transversal angles of the scripted jump."""
JUMP_STEPS = 45
"""Policy steps of the scripted jump that are timed: push-off, flight, landing."""


@dataclass(frozen=True)
class Args:
    """Flags."""

    envs: list[int] = field(default_factory=lambda: [64])
    """Numbers of environments, one run for each."""
    solvers: list[Literal["jumper", "mujoco"]] = field(default_factory=lambda: ["jumper", "mujoco"])
    repeats: int = 5
    """Timed repetitions; the median counts."""
    steps: int = 100
    """Policy steps in a repetition, standing."""
    out: Path | None = None
    """Folder for figures.json (default: outputs/benchmark_solver/<time>)."""
    device: str | None = None
    """Warp device."""


def command(sim: Simulation, degrees: float) -> None:
    """Command all transversal motors to an angle."""
    target = np.tile([0.0, 1.0, 1.0], 4) * np.radians(degrees)
    sim.target.assign(np.repeat(target[:, None], sim.num_worlds, axis=1).astype(np.float32))


def run_steps(sim: Simulation, steps: int) -> float:
    """Run policy steps and return the wall time [s]."""
    wp.synchronize_device(sim.device)
    start = time.perf_counter()
    for _ in range(steps):
        sim.step()
    wp.synchronize_device(sim.device)
    return time.perf_counter() - start


def heights(sim: Simulation) -> np.ndarray:
    """Return the base heights [m]."""
    return sim.joint_q()[:, 2].copy()


def time_standing(sim: Simulation, args: Args) -> float:
    """Return seconds a policy step while standing; every robot must stand."""
    command(sim, DEFAULT)
    run_steps(sim, 90)
    standing = heights(sim)
    if not (np.all(standing > 0.33) and np.all(standing < 0.37)):
        raise RuntimeError(f"the robots do not stand: heights {standing.min():.3f} to {standing.max():.3f} m")
    return float(np.median([run_steps(sim, args.steps) / args.steps for _ in range(args.repeats)]))


def time_jump(sim: Simulation, args: Args) -> tuple[float, float]:
    """Return seconds a policy step during a jump, and the mean apex [m]; every robot must jump."""
    times, apex = [], np.zeros(1)
    for repeat in range(args.repeats + 1):
        command(sim, DEFAULT)
        run_steps(sim, 60)
        command(sim, SQUAT)
        run_steps(sim, 40)
        command(sim, EXTEND)
        first = run_steps(sim, JUMP_STEPS // 3)
        command(sim, DEFAULT)
        if repeat > 0:
            times.append((first + run_steps(sim, JUMP_STEPS - JUMP_STEPS // 3)) / JUMP_STEPS)
            continue
        apex = heights(sim)  # the first jump only checks the outcome
        for _ in range(JUMP_STEPS - JUMP_STEPS // 3):
            sim.step()
            apex = np.maximum(apex, heights(sim))
        if not np.all(apex > 0.8):
            raise RuntimeError(f"the robots do not jump: apex {apex.min():.3f} to {apex.max():.3f} m")
    return float(np.median(times)), float(apex.mean())


def device_memory(device: wp.Device) -> int:
    """Return bytes in use on a GPU, 0 on a CPU."""
    return device.total_memory - device.free_memory if device.is_cuda else 0


def measure(solver: SolverName, envs: int, args: Args) -> dict:
    """Return the figures of one solver at one number of environments."""
    build_model(1, device=args.device)  # Newton's own modules are not part of the figures
    before = device_memory(wp.get_device(args.device))
    start = time.perf_counter()
    sim = Simulation(envs, solver=solver, observe_forces=False, visuals=False, device=args.device)
    sim.step()
    sim.step()
    wp.synchronize_device(sim.device)
    setup = time.perf_counter() - start
    standing = time_standing(sim, args)
    jump, apex = time_jump(sim, args)
    values = {
        "setup_s": setup,
        "ms_per_step_standing": 1e3 * standing,
        "steps_per_s_standing": envs / standing,
        "ms_per_step_jump": 1e3 * jump,
        "steps_per_s_jump": envs / jump,
        "apex_m": apex,
    }
    if sim.device.is_cuda:
        values["memory_kib_per_env"] = (device_memory(sim.device) - before) / envs / 1024.0
    if solver == "jumper":
        values["largest_residual_m_s"] = float(sim.solver.residual.numpy().max())
        values["most_sweeps"] = int(sim.solver.sweeps.numpy().max())
    return values


def compare(envs: int, args: Args) -> dict:
    """Return the figures of all solvers at one number of environments, as flat keys."""
    figures = {}
    for solver in args.solvers:
        for name, value in measure(solver, envs, args).items():
            figures[f"{solver}_{name}"] = value
    for phase in ("standing", "jump"):
        rates = [figures.get(f"{solver}_steps_per_s_{phase}") for solver in ("jumper", "mujoco")]
        if all(rates):
            figures[f"ratio_{phase}"] = rates[0] / rates[1]
    return figures


def show(results: dict[int, dict]) -> None:
    """Print a table of all runs."""
    table = Table(title="Policy steps per second (8 physics steps each, motors included, graphs on)")
    table.add_column("figure")
    for envs in results:
        table.add_column(f"{envs} environments", justify="right")
    for name in next(iter(results.values())):
        table.add_row(name, *(f"{values[name]:,.3f}" if name in values else "" for values in results.values()))
    Console(width=110).print(table)


def main(args: Args) -> dict:
    """Run the benchmark and return its figures."""
    wp.config.log_level = wp.LOG_WARNING
    info = report_device(args.device)
    folder = output_dir("benchmark_solver", args.out)
    results = {envs: compare(envs, args) for envs in args.envs}
    flat = {"device": info.name}
    for envs, values in results.items():
        prefix = "" if len(results) == 1 else f"envs_{envs}_"
        flat |= {f"{prefix}{name}": value for name, value in values.items()}
    flat["envs"] = args.envs
    write_figures(folder, flat)
    show(results)
    print(f"figures in {folder}")
    return flat


if __name__ == "__main__":
    main(tyro.cli(Args))
