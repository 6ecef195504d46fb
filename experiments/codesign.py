"""Optimise the two lengths of the legs, a spring between the knees and the motor targets of a jump together.

    python experiments/codesign.py --planet mars

Random jumps of the nominal leg are optimised for 1 m (Mars: 2 m) with the least electrical energy. As many iterations
follow with the nominal leg, and from the same jumps with legs that change: as far as possible with the nominal leg's
energy, and 1 m with the least energy. Gradients are those of the reverse pass. With `--cma`, CMA-ES changes the legs by
as many simulated jumps (package `cma`). All jumps are repeated in SolverJumper and SolverMuJoCo. The script writes
`metrics.json`, `codesign.png` and the robots, for `jumper train horizontal-jump --robot FILE`.

- Links keep their mass per length and cross-section. Body, motor housings, motors and stops stay the same.
- Energy: positive work of the motors and copper loss, from standing to touchdown. The line from cutoff to no-load speed
  of a motor gives its loss: torque^2 (no-load - cutoff speed) / peak torque. Springs are loaded in standing for free.
- Distance: of the base, from standing to the instant when the first paw touches down.
"""

from __future__ import annotations

import importlib
import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import torch

from jumper_warp.robot.description import load_description
from jumper_warp.robot.gravity import EARTH, MARS
from jumper_warp.sim.simulation import SUBSTEPS, Simulation, SolverName, motor_values
from jumper_warp.utils.files import Json
from jumper_warp.viz.plots import figure
from support.leg_jumps import PUSH, STIFFEST, Jump, Jumps, overlay_of
from support.scripts import ThreadArgs, announce, prepare, report, run_script

PLANETS = {"earth": (EARTH, 1.0), "mars": (MARS, 2.0)}  # Gravity [m/s^2], distance of the nominal leg's jump [m]
KNOTS = 20  # Times of a jump between which targets are interpolated
TIME, SIZE = 0.5, 0.3  # Units of the unknowns of time and of the design; those of the targets are rad
NOMINAL = (1.0, 1.0, 0.0), (1.0, 1.0, 0.0)
CHANGED = (0.6, 0.6, 0.002), (1.4, 1.4, 1.0)
"""Least and largest thigh and shank in nominal lengths, and stiffness in `STIFFEST`."""
SCREENED = 512  # Random jumps of which the best are the starts
POPULATION = 16  # Jumps in an iteration of CMA-ES
WORST = 1.0e6  # Cost of a jump with NaN


@dataclass(frozen=True)
class Args(ThreadArgs):
    """Flags of the joint optimisation of leg and jump."""

    planet: Literal["earth", "mars"] = "earth"  # Planet to jump on
    count: int = 8  # Number of jumps that are optimised in parallel
    iterations: int = 200  # Number of iterations
    rate: float = 0.1  # [rad] Largest change of a target in an iteration
    cma: bool = False  # Whether to compare with CMA-ES
    spread: float = 0.03  # [rad] Initial standard deviation of CMA-ES
    seed: int = 0  # Seed of the starts


def jumps_of(args: Args, count: int) -> Jumps:
    """Return the simulation of a number of jumps on the planet of the flags."""
    return Jumps(count, *PLANETS[args.planet], device=args.device, threads=args.threads)


class Found(NamedTuple):
    """Optimised jumps, the best one first."""

    unknowns: torch.Tensor  # (4 KNOTS + 5, n)
    seconds: float  # [s] Processor time


def decode(unknowns: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return targets (PUSH, 4, n) [rad] and designs (3, n) of jumps.

    unknowns: targets at the knots, begin and stretch of the knots in time, and design; (4 KNOTS + 5, n).
    """
    knots, begin, stretch = unknowns[:-5].reshape(KNOTS, 4, -1), TIME * unknowns[-5], TIME * unknowns[-4]
    times = torch.arange(PUSH)[:, None] / (PUSH - 1.0)
    place = ((times - begin) * stretch.exp() * (KNOTS - 1)).clamp(0.0, KNOTS - 1.001)
    part = (place - place.floor())[:, None]
    before = place.long()[:, None].expand(PUSH, *knots.shape[1:])
    return knots.gather(0, before) * (1.0 - part) + knots.gather(0, before + 1) * part, SIZE * unknowns[-3:]


class Problem:
    """Jump on a planet with the least cost, by a leg that may change within bounds."""

    def __init__(self, args: Args, bounds: tuple, score: Callable[[Jump], torch.Tensor]):
        """Build the simulation. bounds: of designs; score: cost of jumps (n,)."""
        self.args, self.score = args, score
        self.begin = time.process_time()
        self.jumps = jumps_of(args, args.count)
        self.low, self.high = (self.jumps.tensor(bound)[:, None] / SIZE for bound in bounds)

    def clip(self, unknowns: torch.Tensor) -> torch.Tensor:
        """Move designs into their bounds, and return the unknowns."""
        unknowns[-3:] = unknowns[-3:].clamp(self.low, self.high)
        return unknowns

    def cost(self, jumps: Jumps, unknowns: torch.Tensor) -> torch.Tensor:
        """Return the costs (n,) of jumps."""
        return self.score(jumps(*decode(unknowns))).nan_to_num(WORST)

    def draw(self) -> torch.Tensor:
        """Return the best of many random jumps, as starts; their legs are the smallest of the bounds."""
        rng = np.random.default_rng(self.args.seed)
        lean = rng.uniform(0.0, 0.45, SCREENED) * np.array([[-1.0], [1.0], [1.0], [-1.0]])  # [rad]
        squat, push = rng.uniform(1.2, 2.0, SCREENED), rng.uniform(-0.2, 0.2, SCREENED)  # [rad]
        before = np.arange(KNOTS)[:, None, None] < rng.integers(KNOTS // 3, KNOTS - KNOTS // 6, SCREENED)
        targets = (np.where(before, squat, push) + lean).reshape(4 * KNOTS, SCREENED)
        unknowns = self.clip(self.jumps.tensor(np.concatenate([targets, np.zeros((5, SCREENED))])))
        with torch.no_grad():
            best = self.cost(jumps_of(self.args, SCREENED), unknowns).argsort()
        return unknowns[:, best[: self.args.count]]

    def descend(self, starts: torch.Tensor) -> Found:
        """Minimise the cost by Adam with gradients of the reverse pass, in parallel from all starts."""
        unknowns = self.clip(starts.clone()).requires_grad_()
        adam = torch.optim.Adam([unknowns], self.args.rate, betas=(0.9, 0.99))
        rates = torch.optim.lr_scheduler.CosineAnnealingLR(adam, self.args.iterations)
        for _ in range(self.args.iterations):
            (gradient,) = torch.autograd.grad(self.cost(self.jumps, unknowns).sum(), unknowns)
            unknowns.grad = (gradient / gradient.norm(dim=0).clamp(min=1.0)).nan_to_num(0.0)
            adam.step()
            rates.step()
            with torch.no_grad():
                self.clip(unknowns)
        with torch.no_grad():
            best = self.cost(self.jumps, unknowns).argsort()
        return self.found(unknowns.detach()[:, best])

    def evolve(self, starts: torch.Tensor) -> Found:
        """Minimise the cost by CMA-ES from the first start, with as many jumps as `descend`."""
        cma: Any = importlib.import_module("cma")
        jumps = jumps_of(self.args, POPULATION)
        options = {"popsize": POPULATION, "seed": 1 + self.args.seed, "verbose": -9}
        search = cma.CMAEvolutionStrategy(self.clip(starts.clone())[:, 0].numpy(), self.args.spread, options)
        least, best = math.inf, starts
        for _ in range(self.args.count * self.args.iterations // POPULATION):
            points = search.ask()
            unknowns = self.clip(jumps.tensor(np.array(points).T))
            with torch.no_grad():
                cost = self.cost(jumps, unknowns)
            search.tell(points, cost.tolist())
            if cost.min() < least:
                least, best = float(cost.min()), unknowns[:, [int(cost.argmin())]]
        return self.found(best)

    def found(self, unknowns: torch.Tensor) -> Found:
        """Return the result of a search."""
        return Found(unknowns, time.process_time() - self.begin)


def replay(solver: SolverName, design: np.ndarray, targets: np.ndarray, args: Args) -> tuple[np.ndarray, np.ndarray]:
    """Return a robot's states (rows + 1, 19, 1) and torques (rows, 12, 1) on a solver.

    targets: filtered ones of the physics steps [rad] (rows, 12).
    """
    gravity, _ = PLANETS[args.planet]
    sim = Simulation(
        1, solver=solver, robot=overlay_of(design), gravity=gravity, substeps=1, visuals=False, device=args.device
    )

    def state() -> np.ndarray:
        joints = sim.joint_q()[0]
        return np.concatenate([joints[:7], motor_values(joints[None, 7:])[0]])

    states, torques = [state()], []
    for target in targets:
        sim.set_targets(target)
        sim.step()
        states.append(state())
        torques.append(sim.torque.numpy()[:, 0].copy())
    return np.array(states)[..., None], np.array(torques)[..., None]


def validate(found: Found, jumps: Jumps, name: str, args: Args, folder: Path) -> tuple[Json, torch.Tensor]:
    """Save a jump's robot, repeat the jump on two solvers, and return metrics and states until touchdown (rows, 19)."""
    targets, design = decode(found.unknowns[:, :1])
    overlay_of(design[:, 0].tolist()).save(folder / f"{name}.json")
    with torch.no_grad():
        motion = jumps.simulate(targets, design)
    jump = jumps.measure(motion.q, motion.torque, design)
    leg = jumps.size
    values: Json = {
        f"{name}_thigh_m": float(design[0]) * leg.thigh, f"{name}_shank_m": float(design[1]) * leg.shank,
        f"{name}_stiffness_n_m": STIFFEST * float(design[2]), f"{name}_faults": float(jump.faults),
        f"{name}_processor_time_s": found.seconds,
    }  # fmt: skip
    commands = np.repeat(motion.filtered_target[..., 0].numpy(), SUBSTEPS, axis=0)
    solvers: tuple[SolverName, ...] = ("jumper", "mujoco")
    ends = {"": jump}
    for solver in solvers:
        states, torques = replay(solver, design[:, 0].numpy(), commands, args)
        ends[f"{solver}_"] = jumps.measure(jumps.tensor(states), jumps.tensor(torques), design)
    for run, end in ends.items():
        values |= {f"{name}_{run}distance_m": float(end.distance), f"{name}_{run}energy_j": float(end.energy),
                   f"{name}_{run}pitch_deg": math.degrees(float(end.pitch))}  # fmt: skip
    announce(f"{args.planet}, {name}: {float(jump.distance):.2f} m with {float(jump.energy):.0f} J")
    return values, motion.q[: int(jump.flight) + 1, :, 0]


def draw(axis: Any, jumps: Jumps, design: torch.Tensor, path: torch.Tensor, title: str) -> None:
    """Draw the base's path of a jump, and body and left legs at four instants; path: states (rows, 19)."""
    x, height = path[:, 0], path[:, 2]
    axis.plot(x, height, "--", color="C0")
    rows = 0, int(height.argmin()), int(height.argmax()), len(path) - 1
    for shade, row in zip((0.3, 0.5, 0.75, 1.0), rows, strict=True):
        outer, inner, paw = jumps.joints(path[row, 7:, None], design)[..., 0].unbind()
        zero = torch.zeros(4)
        chain = [[jumps.outer_hip[:, 0], zero], outer, paw, inner, [jumps.inner_hip[:, 0], zero]]
        points = torch.stack([torch.stack(list(point)) for point in chain])  # (5, x and z, 4 legs)
        pitch = 2.0 * float(path[row, 4].asin())
        turn = torch.tensor([[math.cos(pitch), math.sin(pitch)], [-math.sin(pitch), math.cos(pitch)]])
        body = torch.tensor([[-0.3, 0.3], [0.0, 0.0]])
        for line, width, color in ((body, 6.0, "0.4"), (points[..., 0].T, 1.5, "C3"), (points[..., 2].T, 1.5, "C3")):
            axis.plot(*(turn @ line + path[row, [0, 2], None]), "-", color=color, linewidth=width, alpha=shade)
    axis.set(aspect="equal", ylabel="height [m]", title=title)


def main(args: Args) -> Json:
    """Optimise the jump of the nominal leg, then leg and jump; draw both, and return the metrics."""
    if args.cma:
        importlib.import_module("cma")  # raise now, not after minutes
    torch.set_num_threads(1)
    folder = prepare("codesign", args, args.threads)
    gravity, distance = PLANETS[args.planet]
    jumps = jumps_of(args, 1)
    scale = load_description().mass * gravity * distance

    # 6.0: weight of the relative violation of a constraint; 0.1: weight of `Jump.faults`
    def least(jump: Jump) -> torch.Tensor:
        """Return the costs [1] (n,) of jumps over `distance` [m] with the least energy, in units of `scale` [J]."""
        return jump.energy / scale + 6.0 * (1.0 - jump.distance / distance).clamp(min=0.0) + 0.1 * jump.faults

    def farthest(jump: Jump) -> torch.Tensor:
        """Return the costs [1] (n,) of jumps as far as possible with at most the energy of the nominal leg's jump."""
        # `values` is assigned below, before the first call
        energy = values["nominal_energy_j"]
        return 6.0 * (jump.energy / energy - 1.0).clamp(min=0.0) - jump.distance / distance + 0.1 * jump.faults

    problem = Problem(args, NOMINAL, least)
    starts = problem.descend(problem.draw()).unknowns
    results = {"nominal": problem.descend(starts)}
    values, path = validate(results["nominal"], jumps, "nominal", args, folder)
    paths = {"nominal": path}
    for aim, cost in (("farthest", farthest), ("least", least)):
        results[aim] = Problem(args, CHANGED, cost).descend(starts)
        if args.cma:
            results[f"{aim}_cma"] = Problem(args, CHANGED, cost).evolve(starts)
    for name, found in list(results.items())[1:]:
        metrics, paths[name] = validate(found, jumps, name, args, folder)
        values |= metrics
    with figure(folder / "codesign.png", 2, 1, figsize=(9, 5.2), sharex=True, sharey=True) as axes:
        for axis, name in zip(axes, ("nominal", "farthest"), strict=True):
            title = f"{name}: {values[f'{name}_distance_m']:.2f} m with {values[f'{name}_energy_j']:.0f} J"
            draw(axis, jumps, decode(results[name].unknowns[:, :1])[1], paths[name], title)
        axes[-1].set_xlabel("x [m]")
    keys = [key for key in values if key.endswith(("distance_m", "energy_j"))]
    return report(args, folder, values, "Joint optimisation of leg and jump", keys)


if __name__ == "__main__":
    run_script(main, Args)
