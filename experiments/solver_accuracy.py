"""Measure the error that time step, iterations and friction cone of both solvers cause in a jump, and write metrics.

    python experiments/solver_accuracy.py

Robots squat, push off, fly and land, each with its own targets. The errors are distances of the base's position from
that of the same solver with finer steps: SolverJumper with 16 times as many, SolverMuJoCo with 8 times as many, 50
iterations and elliptic cones. The differences between the contact models of the two solvers are therefore no errors.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from jumper_warp.robot.model import PHYSICS_DT
from jumper_warp.sim.mujoco import MujocoDynamics, mujoco_solver
from jumper_warp.sim.simulation import SUBSTEPS, Simulation, SolverName
from support.scripts import DeviceArgs, prepare, report, run_script
from support.speed import DEFAULT, EXTEND, SQUAT

PHASES = ((DEFAULT, 40), (SQUAT, 40), (EXTEND, 15), (DEFAULT, 85))  # [deg] Transversal targets; policy steps
SPREAD = 6.0  # [deg] Largest offset of a target; of lateral motors half as much
NAMES = ("iterations", "ls_iterations", "cone")  # Arguments of SolverMuJoCo in `Args.mujoco`
FINE = 16, (8, 50, 20, "elliptic")  # Settings of the references of both solvers, as in `Args`


@dataclass(frozen=True)
class Args(DeviceArgs):
    """Flags of the measurement of the errors of both solvers."""

    num_robots: int = 32
    jumper: tuple[int, ...] = (1, 2)  # Factors on the number of SolverJumper's physics steps
    mujoco: tuple[tuple[int, int, int, str], ...] = (
        (1, 2, 2, "pyramidal"), (1, 3, 3, "pyramidal"), (1, 6, 6, "pyramidal"), (1, 50, 20, "pyramidal"),
        (1, 6, 6, "elliptic"), (2, 3, 3, "pyramidal"), (4, 3, 3, "pyramidal"),
    )  # fmt: skip
    """Factor on the number of SolverMuJoCo's physics steps, iterations, line searches in each, friction cone."""


def largest_gap(sim: Simulation) -> float:
    """Return the largest distance [m] between the two anchors of an ankle, which closes the loop of a leg."""
    model, frames = sim.model, sim.state.body_q.numpy()
    ankles = [i for i, label in enumerate(model.joint_label) if label.endswith("_ankle")]
    ends = []
    for body, anchor in ((model.joint_parent, model.joint_X_p), (model.joint_child, model.joint_X_c)):
        frame = frames[body.numpy()[ankles]]
        ends.append(frame[:, :3] + Rotation.from_quat(frame[:, 3:]).apply(anchor.numpy()[ankles, :3]))
    return float(np.linalg.norm(ends[0] - ends[1], axis=1).max())


def jump(args: Args, solver: SolverName, refine: int, *settings: Any) -> tuple[np.ndarray, np.ndarray, float]:
    """Simulate a jump; return base positions [m] at the apex and at the end, (robots, 3), and the largest gap [m].

    refine: factor on the number of physics steps; settings: SolverMuJoCo's iterations, line searches and friction cone.
    """
    n = args.num_robots
    steps = {"dt": PHYSICS_DT / refine, "substeps": SUBSTEPS * refine}
    sim = Simulation(n, solver=solver, observe_forces=False, visuals=False, device=args.device, **steps)
    if isinstance(sim.dynamics, MujocoDynamics):
        sim.dynamics.solver = mujoco_solver(sim.model, dt=sim.dt, **dict(zip(NAMES, settings, strict=True)))
    rng = np.random.default_rng(7)
    path, gap = [], 0.0
    for number, (angle, count) in enumerate(PHASES):
        offset = rng.uniform(-SPREAD, SPREAD, (4, 3, n)) * np.array([0.5, 1.0, 1.0])[:, None] * (number > 0)
        target = angle * np.array([0.0, 1.0, 1.0])[:, None] + offset
        sim.target.assign(np.radians(target.reshape(12, n)).astype(np.float32))
        for _ in range(count):
            sim.step()
            path.append(sim.joint_q()[:, :3].copy())
            gap = max(gap, largest_gap(sim))
    positions = np.array(path)
    return positions[positions[:, :, 2].argmax(axis=0), np.arange(n)], positions[-1], gap


def main(args: Args) -> dict[str, float]:
    """Simulate the jumps with all settings, and return mean errors and largest loop gaps [mm]."""
    folder = prepare("solver_accuracy", args)
    values: dict[str, float] = {}
    references = {"jumper": jump(args, "jumper", FINE[0])}
    if args.mujoco:
        references["mujoco"] = jump(args, "mujoco", *FINE[1])
    measured = {f"jumper_{refine}": jump(args, "jumper", refine) for refine in args.jumper}
    measured |= {"_".join(map(str, ("mujoco", *case))): jump(args, "mujoco", *case) for case in args.mujoco}
    for name, (*ends, gap) in measured.items():
        for moment, end, reference in zip(("apex", "end"), ends, references[name.split("_")[0]], strict=False):
            values[f"{name}_{moment}_mm"] = 1e3 * float(np.linalg.norm(end - reference, axis=1).mean())
        values[f"{name}_gap_mm"] = 1e3 * gap
    return report(args, folder, values, f"Errors of the position of {args.num_robots} jumping robots", values)


if __name__ == "__main__":
    run_script(main, Args)
