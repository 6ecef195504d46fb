"""Optimise the two lengths of the legs, a spring between the knees and the motor targets of a jump together.

    python experiments/codesign.py --out outputs/codesign

On each planet the nominal leg first jumps a distance with the least electrical energy. Changed legs then jump as far as
possible with this energy, and jump this distance with the least energy. Gradients are those of the reverse pass.
CMA-ES (package `cma`, if installed) solves both problems with as many simulated jumps. The best designs jump in
SolverMuJoCo, and as an exported MJCF model in MuJoCo. The script writes `metrics.json`, `codesign.png` and a folder of
each robot, for `jumper train horizontal-jump --robot FOLDER`.

- Links keep their mass per length and cross-section. Body, motor housings, motors and stops stay the same.
- Energy: positive work of the motors and copper loss, from standing to touchdown. The line from cutoff to no-load speed
  of a motor gives its loss: torque^2 (no-load - cutoff speed) / peak torque. Springs are loaded in standing for free.
- Distance: of the base at the height at which the paws touch down, by its ballistic motion after takeoff.
"""

from __future__ import annotations

import importlib
import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from jumper_warp.robot.description import leg_dimensions, load_description
from jumper_warp.robot.export import export_robot
from jumper_warp.robot.folder import table_of, write_robot
from jumper_warp.robot.gravity import EARTH, MARS
from jumper_warp.robot.model import PHYSICS_DT
from jumper_warp.robot.motors import jumping_motors
from jumper_warp.robot.overlay import load_overlay
from jumper_warp.sim.simulation import SUBSTEPS, Simulation, SolverName, motor_values
from jumper_warp.utils.files import Json
from jumper_warp.utils.output import write_metrics
from jumper_warp.viz.plots import figure
from support.leg_jumps import PUSH, STIFFEST, Jump, Jumps, robot_of
from support.scripts import ThreadArgs, announce, prepare, report, run_script

PLANETS = {"earth": EARTH, "mars": MARS}
ANGLES = math.radians(-30.0), math.radians(140.0)  # [rad] Bounds of the transversal targets
LEGS = {
    "nominal": ((1.0, 1.0, 0.0), (1.0, 1.0, 0.0)), "lengths": ((0.6, 0.6, 0.0), (1.4, 1.4, 0.0)),
    "spring": ((1.0, 1.0, 0.002), (1.0, 1.0, 1.0)), "both": ((0.6, 0.6, 0.002), (1.4, 1.4, 1.0)),
}  # fmt: skip
"""Bounds of the designs, by what may change: thigh and shank in nominal lengths, stiffness in `STIFFEST`."""
SCREENED = 512  # Random jumps of which the best are the starts
SWAP = 40  # Iterations after which shifted copies of the better half of the jumps replace the worse half
KNOTS = 10  # Times between which the targets of CMA-ES are interpolated, as it needs few unknowns
MEMORY = "exp_avg", "exp_avg_sq"  # State of Adam


@dataclass(frozen=True)
class Args(ThreadArgs):
    """Flags of the joint optimisation of leg and jump."""

    planets: tuple[str, ...] = ("earth", "mars")  # Planets to jump on
    distances: tuple[float, ...] = (1.0, 2.0)  # [m] Distance of the nominal leg's jump on each planet
    legs: tuple[str, ...] = ("both", "spring")  # Changes of the leg
    count: int = 16  # Number of jumps that are optimised in parallel
    iterations: int = 600  # Number of iterations
    evolve: bool = True  # Whether to compare with CMA-ES
    seed: int = 0  # Seed of the starts


Cost = Callable[[Jump], torch.Tensor]


def farthest(energy: float, distance: float) -> Cost:
    """Return the cost of a jump that should be far with an energy [J]; distance [m]: its scale."""
    return lambda jump: (
        -jump.distance / distance + 6.0 * (jump.energy / energy - 1.0).clamp(min=0.0) + 0.1 * jump.faults
    )


def least(energy: float, distance: float) -> Cost:
    """Return the cost of a jump that should cover a distance [m] with little energy; energy [J]: its scale."""
    return lambda jump: jump.energy / energy + 6.0 * (1.0 - jump.distance / distance).clamp(min=0.0) + 0.1 * jump.faults


@dataclass(frozen=True)
class Found:
    """Optimised jump and leg."""

    targets: torch.Tensor  # (PUSH, 4, 1) [rad]
    design: torch.Tensor  # (3, 1)
    jumps: int  # Number of simulated jumps
    seconds: float  # [s] Processor time
    wall: float  # [s] Time


class Problem:
    """Problem of a jump on a planet with a leg that may change."""

    def __init__(self, gravity: float, leg: str, cost: Cost, args: Args):
        """Draw random jumps and legs, and keep the best as starts."""
        self.args, self.cost = args, cost
        self.begin = time.process_time(), time.perf_counter()
        rng = np.random.default_rng(args.seed)
        settings: Any = {"device": args.device, "threads": args.threads}
        screened = Jumps(SCREENED, gravity, **settings)
        self.jumps = Jumps(args.count, gravity, **settings)
        self.low, self.high = (screened.tensor(bound)[:, None] for bound in LEGS[leg])
        lean = rng.uniform(0.0, 0.45, SCREENED) * np.array([[-1.0], [1.0], [1.0], [-1.0]])  # [rad]
        squat, push = rng.uniform(1.2, 2.0, SCREENED), rng.uniform(-0.2, 0.2, SCREENED)  # [rad]
        before = np.arange(PUSH)[:, None, None] < rng.integers(16, PUSH - 8, SCREENED)
        targets = screened.tensor(np.where(before, squat, push) + lean)
        middle = 1.0 + 0.6 * (screened.tensor(rng.uniform(-0.5, 0.5, (3, SCREENED))))
        middle[2] = screened.tensor(rng.uniform(0.0, 0.6, SCREENED))
        design = middle.clamp(self.low, self.high)
        with torch.no_grad():
            best = cost(screened(targets, design)).nan_to_num(1.0e6).argsort()[: args.count]
        self.targets, self.design = targets[..., best], design[:, best]

    def found(self, targets: torch.Tensor, design: torch.Tensor, cost: torch.Tensor) -> Found:
        """Return the jump of the lowest cost (n,)."""
        best = [int(cost.nan_to_num(1.0e6).argmin())]
        now = time.process_time() - self.begin[0], time.perf_counter() - self.begin[1]
        jumps = SCREENED + self.args.count * self.args.iterations
        return Found(targets[..., best].detach(), design[:, best].detach(), jumps, *now)

    def descend(self) -> Found:
        """Minimise the cost by Adam with gradients of the reverse pass, in parallel from all starts."""
        rng = np.random.default_rng(self.args.seed)
        targets, design = self.targets.clone().requires_grad_(), self.design.clone().requires_grad_()
        groups = [{"params": [targets], "rate": 0.1}, {"params": [design], "rate": 0.03}]
        adam = torch.optim.Adam(groups, betas=(0.9, 0.99))
        cost = torch.zeros(self.args.count)
        for i in range(self.args.iterations):
            done = i / self.args.iterations
            for group in adam.param_groups:
                group["lr"] = group["rate"] * (0.5 + 0.5 * math.cos(math.pi * done) + 1.0e-3)
            cost = self.cost(self.jumps(targets, design))
            gradients = torch.autograd.grad(cost.sum(), (targets, design))
            norm = sum(gradient.square().flatten(end_dim=-2).sum(0) for gradient in gradients)
            for tensor, gradient in zip((targets, design), gradients, strict=True):
                tensor.grad = (gradient / torch.as_tensor(norm).sqrt().clamp(min=1.0)).nan_to_num(0.0)
            adam.step()
            with torch.no_grad():
                if i % SWAP == SWAP - 1 and done < 0.7:
                    better, worse = cost.nan_to_num(1.0e6).argsort().tensor_split(2)
                    better = better[: len(worse)]
                    self.shift(targets, better, worse, rng)
                    for tensor in (design, *(adam.state[x][name] for x in (targets, design) for name in MEMORY)):
                        tensor[..., worse] = tensor[..., better]
                targets.clamp_(*ANGLES)
                design.clamp_(self.low, self.high)
        with torch.no_grad():
            return self.found(targets, design, self.cost(self.jumps(targets, design)))

    def shift(self, targets: torch.Tensor, better: torch.Tensor, worse: torch.Tensor, rng: np.random.Generator) -> None:
        """Replace targets of worse jumps by those of better ones, one to three policy steps earlier or later."""
        for source, place in zip(better, worse, strict=True):
            steps = np.clip(np.arange(PUSH) + rng.choice([-3, -2, -1, 1, 2, 3]), 0, PUSH - 1)
            targets[..., place] = targets[steps][..., source]

    def evolve(self) -> Found | None:
        """Minimise the cost by CMA-ES from the best start, with as many jumps; return None without the package."""
        try:
            cma: Any = importlib.import_module("cma")
        except ImportError:
            return None
        knots = np.linspace(0.0, PUSH - 1.0, KNOTS)
        lines = self.jumps.tensor([np.interp(np.arange(PUSH), knots, row) for row in np.eye(KNOTS)]).T
        fitted = torch.linalg.lstsq(lines, self.targets[..., 0]).solution
        first = torch.cat([fitted.flatten(), self.design[:, 0]]).numpy()
        options = {"popsize": self.args.count, "seed": 1 + self.args.seed, "verbose": -9}
        search = cma.CMAEvolutionStrategy(first, 0.1, options)
        best = torch.full((1,), torch.inf), self.targets[..., :1], self.design[:, :1]
        for _ in range(self.args.iterations):
            points = search.ask()
            values = self.jumps.tensor(np.array(points).T)
            targets = torch.tensordot(lines, values[:-3].reshape(KNOTS, 4, -1), 1).clamp(*ANGLES)
            design = values[-3:].clamp(self.low, self.high)
            with torch.no_grad():
                cost = self.cost(self.jumps(targets, design)).nan_to_num(1.0e6)
            search.tell(points, cost.tolist())
            index = [int(cost.argmin())]
            if cost[index] < best[0]:
                best = cost[index], targets[..., index], design[:, index]
        return self.found(best[1], best[2], best[0])


class Flown(NamedTuple):
    """Jump in a simulation that continues until touchdown."""

    distance: float  # [m] at the height of touchdown
    energy: float  # [J] until then
    pitch: float  # [deg] then
    path: np.ndarray  # (rows, 19) states of the physics steps as in `Trajectory.q`


def flown(steps: list[tuple[np.ndarray, np.ndarray]], jumps: Jumps, landing: float) -> Flown:
    """Return a jump from its physics steps, each the state (19,) after it and the torques (12,) in it."""
    path = np.array([q for q, _ in steps])
    torque = np.array([torque for _, torque in steps])
    apex = int(path[:, 2].argmax())
    last = apex + int(np.argmax(path[apex:, 2] < landing))
    work = np.maximum(torque[1 : last + 1] * np.diff(path[: last + 1, 7:], axis=0), 0.0).sum()
    loss = PHYSICS_DT * (jumps.loss.numpy()[:, 0] * torque[: last + 1] ** 2).sum()
    pitch = 2.0 * math.degrees(math.asin(path[last, 4]))
    return Flown(float(path[last, 0]), float(work + loss), pitch, path[: last + 1])


def replay(solver: SolverName, folder: Path, targets: np.ndarray, gravity: float, device: str | None) -> list:
    """Return the physics steps of the robot in a folder that follows filtered targets [rad] (steps, 12) on a solver."""
    sim = Simulation(
        1, solver=solver, robot=load_overlay(folder), gravity=gravity, substeps=1, visuals=False, device=device
    )
    steps = []
    for target in targets:
        sim.set_targets(target)
        sim.step()
        joints = sim.joint_q()[0]
        q = np.concatenate([joints[:7], motor_values(joints[None, 7:])[0]])
        steps.append((q.astype(float), sim.torque.numpy()[:, 0].astype(float)))
    return steps


def replay_mjcf(model: Path, targets: np.ndarray, gravity: float) -> list:
    """Return the physics steps of an exported MJCF model in MuJoCo, with the jump's torque limit for all motors."""
    mujoco: Any = importlib.import_module("mujoco")
    robot = mujoco.MjModel.from_xml_path(str(model))
    data = mujoco.MjData(robot)
    robot.opt.gravity[2] = -gravity
    limit = jumping_motors().transversal.saturation
    robot.actuator_forcerange[:12] = [-limit, limit]
    mujoco.mj_resetDataKeyframe(robot, data, 0)
    steps = []
    for target in targets:
        data.ctrl[:12] = target
        mujoco.mj_step(robot, data)
        base = [*data.qpos[:3], *data.qpos[4:7], data.qpos[3]]
        steps.append((np.array([*base, *motor_values(data.qpos[None, 7:27])[0]]), data.actuator_force[:12].copy()))
    return steps


def validate(found: Found, jumps: Jumps, folder: Path, name: str, device: str | None) -> tuple[Json, Flown]:
    """Write the robot of a jump, let it jump on three simulations, and return metrics and the jump on SolverJumper."""
    design = found.design[:, 0].numpy()
    robot = folder / name
    source = "experiments/codesign.py"
    write_robot(robot, {**table_of(robot_of(design), source), "name": name})
    with torch.no_grad():
        jump = jumps(found.targets, found.design)
    filtered = jump.trajectory.filtered_target[:, :, 0].numpy()
    ticks = 2 * len(filtered) + round(60.0 * float(jump.landing) / jumps.gravity)
    targets = np.repeat(filtered[np.minimum(np.arange(ticks), len(filtered) - 1)], SUBSTEPS, axis=0)
    mjcf = export_robot("mjcf", robot / "mjcf", load_overlay(robot))
    solvers: tuple[SolverName, ...] = ("jumper", "mujoco")
    runs = {solver: replay(solver, robot, targets, jumps.gravity, device) for solver in solvers}
    runs["mjcf"] = replay_mjcf(mjcf, targets, jumps.gravity)
    ends = {solver: flown(steps, jumps, float(jump.landing)) for solver, steps in runs.items()}
    leg = jumps.size
    values: Json = {
        "distance_m": float(jump.distance), "energy_j": float(jump.energy), "faults": float(jump.faults),
        "thigh_m": float(design[0] * leg.thigh), "shank_m": float(design[1] * leg.shank),
        "stiffness_n_m": float(STIFFEST * design[2]), "simulated_jumps": found.jumps,
        "processor_time_s": found.seconds, "wall_time_s": found.wall,
    }  # fmt: skip
    for solver, end in ends.items():
        values |= {f"{solver}_distance_m": end.distance, f"{solver}_energy_j": end.energy,
                   f"{solver}_pitch_deg": end.pitch}  # fmt: skip
    return {f"{name}_{key}": value for key, value in values.items()}, ends["jumper"]


def draw(axis: Any, jump: Flown, design: np.ndarray, title: str) -> None:
    """Draw the path of a jump's base and the robot, to scale, in four instants, as the left legs show it."""
    robot = robot_of(design)
    path = jump.path
    lowest = int(path[: int(path[:, 2].argmax()), 2].argmin())
    axis.plot(path[:, 0], path[:, 2], "--", color="C0")
    for shade, row in zip((0.3, 0.5, 0.75, 1.0), (0, lowest, int(path[:, 2].argmax()), len(path) - 1), strict=True):
        q = path[row]
        pitch = 2.0 * math.asin(q[4])
        turn = np.array([[math.cos(pitch), -math.sin(pitch)], [math.sin(pitch), math.cos(pitch)]])  # of rows (x, z)
        points = [np.array([[-0.3, 0.0], [0.3, 0.0]])]
        for leg, (outer, inner) in (("FL", q[8:10]), ("BL", q[14:16])):
            size = leg_dimensions(robot, leg)
            hips = np.array([[size.hip[0] + size.outer_x, 0.0], [size.hip[0] + size.inner_x, 0.0]])
            angles = size.front * np.array([outer, -inner])
            knees = hips + size.thigh * np.column_stack([np.sin(angles), -np.cos(angles)])
            span = size.front * (knees[0] - knees[1])
            length = float(np.hypot(*span))
            ankle = knees.mean(0) + math.sqrt(size.shank**2 - 0.25 * length**2) / length * np.array([span[1], -span[0]])
            points.append(np.array([hips[0], knees[0], ankle, knees[1], hips[1]]))
        for line, width in zip(points, (6.0, 1.5, 1.5), strict=True):
            color = "C3" if len(line) > 2 else "0.4"
            axis.plot(*(line @ turn + q[[0, 2]]).T, "-", color=color, linewidth=width, alpha=shade)
    axis.set(aspect="equal", ylabel="height [m]", title=title)


def solve(planet: str, distance: float, args: Args, folder: Path) -> tuple[Json, list]:
    """Solve all problems of a planet, and return metrics and (jump, design, title) of the first and the best design."""
    gravity = PLANETS[planet]
    jumps = Jumps(1, gravity, device=args.device)
    scale = load_description().mass * gravity * distance
    values: Json = {}
    drawn = []

    def take(name: str, found: Found) -> float:
        """Validate a jump, keep its metrics, and return its energy [J]."""
        metrics, jump = validate(found, jumps, folder, f"{planet}_{name}", args.device)
        values.update(metrics)
        length, energy = (metrics[f"{planet}_{name}_{key}"] for key in ("distance_m", "energy_j"))
        title = f"{planet}, {name}: {length:.2f} m with {energy:.0f} J"
        announce(f"{title}, {found.seconds:.0f} s of processor time")
        if name in ("nominal", "both_farthest"):
            drawn.append((jump, found.design[:, 0].numpy(), title))
        return energy

    energy = take("nominal", Problem(gravity, "nominal", least(scale, distance), args).descend())
    for leg in args.legs:
        for name, cost in (("farthest", farthest(energy, distance)), ("least", least(scale, distance))):
            take(f"{leg}_{name}", Problem(gravity, leg, cost, args).descend())
            found = Problem(gravity, leg, cost, args).evolve() if args.evolve and leg == "both" else None
            if found is not None:
                take(f"{leg}_{name}_cma", found)
    return values, drawn


def main(args: Args) -> Json:
    """Solve the problems of all planets, draw the jumps before and after, and return the metrics."""
    torch.set_num_threads(1)
    folder = prepare("codesign", args, args.threads)
    values: Json = {}
    pictures = []
    for planet, distance in zip(args.planets, args.distances, strict=False):
        metrics, drawn = solve(planet, distance, args, folder)
        values |= metrics
        write_metrics(folder, values)
        pictures += drawn
    rows = len(pictures)
    with figure(folder / "codesign.png", rows, 1, figsize=(9, 2.6 * rows), sharex=True, squeeze=False) as axes:
        x, _, z = np.max([jump.path[:, :3].max(0) for jump, _, _ in pictures], axis=0)
        for axis, picture in zip(axes[:, 0], pictures, strict=True):
            draw(axis, *picture)
            axis.set(xlim=(-0.6, x + 0.5), ylim=(0.0, z + 0.1))
        axes[-1, 0].set_xlabel("x [m]")
    keys = [key for key in values if key.endswith(("distance_m", "energy_j"))]
    return report(args, folder, values, "Joint optimisation of leg and jump", keys)


if __name__ == "__main__":
    run_script(main, Args)
