"""Jumps by gradients through the simulation: farthest, highest, least work, and one that lands still.

    python experiments/trajectory_optimization.py --out outputs/trajectories
    python experiments/trajectory_optimization.py --jumps farthest --baseline cma --out outputs/trajectories

Motor targets, equal left and right, through the command filter and motors of the tasks, from standing still. A search
begins with random squats in parallel worlds, for the farthest flight with run-ups in place, goes on along smoothed
gradients (`trajectory.smoothing`), at first with fewer physics steps or in single precision, for the farthest
flight also from crossings of the best, with multipliers and ever smaller displacements, and ends with limited-memory
BFGS inside an augmented Lagrangian (`trajectory.augmented_lagrangian`). What is told is not the optimiser's own
figure: the targets are replayed in the simulation that trains policies, at every physics step, and collisions of all
links are looked for; the farthest flight is scored as in `experiments/distance_limit.py`, whose constraints it has. Of
each jump a JSON file is written that can take the place of one in `assets/motions`, for episodes that begin along it.

Constraints of vertical jumps: no link but the paws touches the ground, tilt at most 8 degrees and base at most 0.15 m
from its start at all times. Work is what the motors put in until takeoff, braking apart.

`--baseline cma` runs evolution strategies beside it, in the same process: for the farthest flight the search of
`distance_limit.py` (four searches, and on from the best), and for every jump CMA-ES on the same rollouts with the
same penalised objective, for `--longer` times as long. Policy steps are counted: simulated ones, and those of reverse
passes, each of which costs about three simulated ones.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
import tyro
from rich.console import Console
from rich.table import Table

from jumper_warp.cli.main import run_command
from jumper_warp.evaluation.plots import drawn
from jumper_warp.evaluation.run import EvaluationArgs, EvaluationRun
from jumper_warp.sim.simulation import SUBSTEPS
from jumper_warp.trajectory.problem import Problem
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.output import output_dir, write_metrics
from jumper_warp.utils.runtime import announce
from support import takeoff_search
from support.evolved_jumps import Clock, evolve, search_as_published
from support.motion_replay import Replay
from support.optimized_jumps import JUMPS, Jump, optimise


@dataclass(frozen=True)
class Args:
    """Flags."""

    jumps: tuple[str, ...] = tuple(JUMPS)
    """What is optimised."""
    policy: str | None = None
    """Whose actions begin the search for the farthest flight too, as in `distance_limit.py`; None: random ones."""
    baseline: Literal["none", "cma"] = "none"
    """Whether evolution strategies run beside it."""
    generations: int = 480
    """Of each search of `distance_limit.py`; 200 / 480 of it when it goes on from the best."""
    longer: float = 1.0
    """[1] Time of CMA-ES on the same rollouts over that of the gradients."""
    samples: int | None = None
    """Random candidates (default: those of each jump)."""
    effort: float = 1.0
    """[1] Scales the iterations."""
    polish: int | None = None
    """Iterations of the last descent (default: those of each jump)."""
    seed: int = 0
    """Of random candidates and displacements."""
    out: Path | None = None
    """Folder for figures, plots, targets and recordings (default: outputs/trajectory_optimization/<time>)."""
    device: str | None = None
    """Warp device."""
    threads: int | None = None
    """CPU threads that share the worlds (default: all cores); they change no result."""

    def __post_init__(self) -> None:
        """Check the values."""
        unknown = [name for name in self.jumps if name not in JUMPS]
        if unknown or not self.jumps:
            raise InputError(f"no jump {(unknown or [''])[0]!r:.40}; there are {', '.join(JUMPS)}")
        polish = 1 if self.polish is None else self.polish
        if self.generations < 1 or not (self.longer > 0.0 and self.effort > 0.0) or polish < 1:
            raise InputError("need a generation, an iteration of the last descent, and longer and effort above 0")
        if self.samples is not None and self.samples < 48:
            raise InputError(f"need at least 48 samples, got {self.samples}")


def counted(problems: list[Problem]) -> dict[str, float]:
    """Return policy steps that were simulated and of reverse passes."""
    return {
        "simulated_steps": float(sum(problem.world_steps for problem in problems)),
        "reverse_steps": float(sum(problem.reverse_steps for problem in problems)),
    }


def flights_of(x: np.ndarray) -> np.ndarray:
    """Return what candidates for the farthest flight count in the search of `distance_limit.py` [m], (n,)."""
    env = takeoff_search.env_of_limit(takeoff_search.NOMINAL, len(x), "cpu")
    return takeoff_search.score(takeoff_search.fly(env, takeoff_search.actions_of(x)), takeoff_search.NOMINAL)


def policy_actions(args: Args, steps: int) -> np.ndarray:
    """Return the actions up to takeoff of the policy's jump over 2 m, the last ones held, (steps, 4)."""
    evaluation = EvaluationArgs(args.policy, record=0, out=args.out, device=args.device, threads=args.threads)
    actions = takeoff_search.fly_policy(EvaluationRun.of("trajectory_optimization", evaluation))[2]
    actions = actions[-takeoff_search.TICKS :]
    return np.concatenate([actions, np.repeat(actions[-1:], max(0, steps - len(actions)), axis=0)])[:steps]


def run_jump(
    name: str, args: Args, folder: Path, seeds: dict[str, np.ndarray], tell: Callable[[str], None]
) -> tuple[dict[str, dict[str, Any]], Replay]:
    """Optimise one jump, with its baselines; returns rows of figures by method, and the replay."""
    jump, clock = JUMPS[name], Clock()
    settings: dict[str, Any] = {"device": args.device, "threads": args.threads}
    knots = jump.make(substeps=SUBSTEPS, **settings).knots
    rng = np.random.default_rng(args.seed)
    begin = jump.draw(knots, args.samples or jump.samples, rng)
    if name == "farthest" and args.policy is not None:
        begin = np.concatenate([begin, around(knots.nearest(policy_actions(args, knots.steps)), knots, rng)])
    if jump.after in seeds:
        begin = np.concatenate([begin, around(seeds[jump.after], knots, rng)])
    scaled = jump.scaled(args.effort)
    found, problems = optimise(scaled, begin, seed=args.seed, polish=args.polish or jump.polish, tell=tell, **settings)
    # of flights that end alike, one may be a hair beyond a limit in the other simulation
    best = found.best if name != "farthest" else int(np.argmax(flights_of(found.x)))
    x = found.x[best]
    seeds[name] = x
    targets = knots.targets(torch.as_tensor(x[None]))[..., 0].numpy()
    rows = {"gradients": clock() | counted(problems)}
    replay = jump.replay(targets, device=args.device, notes={"jump": jump.label})
    rows["gradients"] |= {"value": value_of(name, jump, x, replay), "violation": float(found.violation[best])}
    np.savez(folder / f"{name}.npz", targets=targets, knots=x.reshape(len(knots.at), -1), at=np.array(knots.at))
    if args.baseline == "cma":
        fine, clock = jump.make(substeps=SUBSTEPS, **settings), Clock()
        other = evolve(fine, begin, args.longer * rows["gradients"]["cpu_s"], args.seed)
        rows["cma"] = clock() | counted([fine]) | {"value": None}
        if other is not None:
            moved = knots.targets(torch.as_tensor(other[None]))[..., 0].numpy()
            rows["cma"]["value"] = value_of(name, jump, other, jump.replay(moved, device=args.device))
        if name == "farthest":
            rows["cma_as_published"] = search_as_published(args.device, args.generations, args.seed)
    return rows, replay


def around(x: np.ndarray, knots: Any, rng: np.random.Generator) -> np.ndarray:
    """Return a jump that may be shorter and variants of it, as candidates for other knots; its end is filled with 0."""
    known = x.reshape(-1, 4)
    rest = np.zeros((len(knots.at) - len(known), 4))
    whole = np.concatenate([known, rest]).ravel()
    spread = np.linspace(0.0, 0.2, 64)[:, None]
    return np.clip(whole + spread * rng.normal(size=(64, len(whole))), -1.0, 1.0)


def value_of(name: str, jump: Jump, x: np.ndarray, replay: Replay) -> float:
    """Return what a jump is told by, from its replay."""
    told = jump.told(replay)
    return float(flights_of(x[None])[0] if told is None else told)


def plot(replays: dict[str, Replay], path: Path) -> None:
    """Draw height, angles of two legs, torques and paw forces of all jumps over time."""
    with drawn(path, 4, len(replays), figsize=(4.2 * len(replays), 10), sharex="col", squeeze=False) as axes:
        for column, (name, replay) in zip(axes.T, replays.items(), strict=True):
            column[0].plot(replay.time, replay.height)
            column[0].axvline(replay.takeoff / 60.0, color="0.7", linestyle="--")
            for i, label in ((1, "FL outer"), (2, "FL inner"), (7, "BL outer"), (8, "BL inner")):
                column[1].plot(replay.time, np.degrees(replay.angle[:, i]), label=label)
                column[2].plot(replay.time, replay.torque[:, i], label=label)
            column[3].plot(replay.time, replay.force[:, 0], label="FL")
            column[3].plot(replay.time, replay.force[:, 2], label="BL")
            column[0].set_title(JUMPS[name].label)
            column[3].set_xlabel("time [s]")
            for axis in column:
                axis.grid(alpha=0.3)
        labels = ("base height [m]", "motor angle [deg]", "motor torque [N m]", "paw force [N]")
        for axis, label in zip(axes[:, 0], labels, strict=True):
            axis.set_ylabel(label)
        axes[1, 0].legend(fontsize=8)
        axes[3, 0].legend(fontsize=8)


def show(rows: dict[str, dict[str, dict[str, Any]]]) -> None:
    """Print the table."""
    table = Table("jump", "method", "reached", "simulated steps", "reverse steps", "processor [s]", "wall [s]")
    for name, methods in rows.items():
        for method, row in methods.items():
            table.add_row(
                JUMPS[name].label, method.replace("_", " "),
                "none" if row["value"] is None else f"{row['value']:.3f} {JUMPS[name].unit}",
                f"{row['simulated_steps'] / 1e6:.2f} M", f"{row['reverse_steps'] / 1e6:.2f} M", f"{row['cpu_s']:.0f}",
                f"{row['wall_s']:.0f}",
            )  # fmt: skip
    Console().print(table)


def main(args: Args) -> dict[str, Any]:
    """Optimise, and return the figures."""
    if args.baseline == "cma":
        takeoff_search.cma_package()  # that it is missing is said before anything else
    announce(args.device, args.threads)
    torch.set_num_threads(1)  # its arrays are small, and the worlds have the cores
    folder, seeds = output_dir("trajectory_optimization", args.out), {}
    rows: dict[str, dict[str, dict[str, Any]]] = {}
    replays: dict[str, Replay] = {}
    values: dict[str, Any] = {}
    for name in args.jumps:
        rows[name], replay = run_jump(name, args, folder, seeds, lambda text, name=name: print(name, text, flush=True))
        replays[name] = replay
        values |= {f"{name}_{method}_{key}": v for method, row in rows[name].items() for key, v in row.items()}
        values |= {f"{name}_{key}": value for key, value in replay.metrics().items()}
        if name == "still":
            values |= {"still_longest_lift_s": replay.longest_lift, "still_highest_lift_m": replay.highest_lift}
        reach = rows[name]["gradients"]["value"] if name == "farthest" else 0.0
        (folder / f"{name}.json").write_text(json.dumps(replay.reference(reach)) + "\n")
        replay.save_rrd(folder / f"{name}.rrd")
        replay.save_strip(folder / f"{name}_strip.png")
        write_metrics(folder, values)
        show({name: rows[name]})
    plot(replays, folder / "trajectories.png")
    show(rows)
    print(f"figures, plots, targets and recordings in {folder}")
    return values


if __name__ == "__main__":
    run_command(lambda: main(tyro.cli(Args)))
