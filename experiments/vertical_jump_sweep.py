"""The paper's test of the vertical jump: a policy jumps to heights spread evenly over 0.5 to 1.2 m, each once.

    python experiments/vertical_jump_sweep.py --policy vertical_jump --jumps 200 --out outputs/sweep

Every robot stands in the default pose and is told to jump after half a second. A jump succeeds if the highest base
height is within 0.1 m of the commanded one. A landing is good if nothing but the paws touched anything, the base
stayed within 10° of level and was at rest a second after touchdown. A fall or a collision ends a jump: what it had
reached before counts. `--randomize` adds the randomisation, noise and latency of the training; `--solver mujoco` is a
check against physics that the policy was not trained on.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import matplotlib
import numpy as np
import torch
import tyro
from rich.console import Console
from rich.table import Table

from jumper_warp.cli.main import announce, run_command
from jumper_warp.envs.env import Env
from jumper_warp.evaluation.film import Film, moments
from jumper_warp.evaluation.jumps import COLLIDED, REST_SPEED, Jumps, largest, mean, rule_names, run, within
from jumper_warp.policies.policy import Policy
from jumper_warp.policies.restore import Conditions, env_of_policy, open_policy
from jumper_warp.policies.spec import PolicyError
from jumper_warp.tasks.cfg import TaskCfg
from jumper_warp.utils.output import output_dir, write_figures

matplotlib.use("Agg")
import matplotlib.pyplot as plt

TASK = "vertical-jump"
LOWER, UPPER = 0.5, 1.2
"""[m] Commanded base heights."""
IN_RANGE = (0.5, 1.1)
"""[m] Those that the paper reaches always."""
NEAR = 0.1
"""[m] A jump that comes this close succeeds."""
LEVEL = 10.0
"""[deg] A good landing tilts the base less."""
OPEN_LOOP_LIMIT = 1.0748
"""[m] Highest base height that `open_loop_jump.py` reaches at 18 N m; the paper's robot reached 1.075 m. It is
that of the nominal robot: with `--randomize` no number is measured against it."""
ENDS = ("success", "came_apart", "low_base", "tilted", "collided", "no_jump", "too_long")
"""Rules of the task that end a jump here; the others only shape the training."""
FALLS = ("low_base", "tilted")
PAPER = {"mean_abs_error_m": 0.04, "success_rate": 0.91, "success_rate_in_range": 1.0}
"""The paper's figures for this test, in its simulation."""


@dataclass(frozen=True)
class Args:
    """Flags."""

    policy: str = "vertical_jump"
    """Name or folder of a policy, a run's folder, or a checkpoint."""
    solver: Literal["jumper", "mujoco"] = "jumper"
    """Physics: the dedicated solver, or Newton's SolverMuJoCo."""
    jumps: int = 200
    """Number of jumps, one world each."""
    randomize: bool = False
    """Randomisation, observation noise, latency and pushes as in training."""
    latency: float = 0.0
    """[ms] From action to motor, in whole physics steps, unless randomised: training has 0 to 16, mean 8."""
    seed: int = 0
    """Of these."""
    record: int = 5
    """Number of jumps to record for the Rerun viewer and, one of them, as a filmstrip; 0: none."""
    out: Path | None = None
    """Folder for figures, plot, recording and filmstrip (default: outputs/vertical_jump_sweep/<time>)."""
    device: str | None = None
    """Warp device."""

    def __post_init__(self) -> None:
        """Check the values."""
        if not 0 <= self.record <= self.jumps or self.jumps < 3:
            raise ValueError(f"need 0 <= record <= jumps and at least 3 jumps, got {self.record}, {self.jumps}")
        if not 0.0 <= self.latency <= 16.0 or (self.latency and self.randomize):
            raise ValueError(f"latency must be in 0..16 ms, and is drawn with --randomize, got {self.latency}")


def ends_of_the_sweep(task: TaskCfg) -> TaskCfg:
    """Return a task with this test's ends of a jump."""
    return replace(task, terminations=tuple(rule for rule in task.terminations if rule.name in ENDS))


def make_env(policy: Policy, args: Args) -> Env:
    """Return the environment that the policy was trained in, with this test's ends of a jump and its latency."""
    conditions = Conditions(args.solver, args.randomize, args.randomize, args.seed, args.device)
    env = env_of_policy(policy, args.jumps, conditions, change=ends_of_the_sweep)
    if not args.randomize:
        env.parameters.latency.fill_(int(args.latency / 1000.0 / env.physics_dt + 1.0e-6))
    return env


class Observer:
    """Acts with the policy and sees who jumped before being told to."""

    def __init__(self, policy: Policy, env: Env) -> None:
        """Begin before the first step."""
        self.policy, self.env = policy, env
        self.early = np.zeros(env.num_envs, dtype=bool)
        self.steps = 0
        self.command_step = 0

    def act(self, obs: torch.Tensor) -> torch.Tensor:
        """Return the actions, as `Policy.act`."""
        if self.steps == 0:
            self.command_step = int(self.env.task_arrays()["command_step"][0])
        if self.steps == self.command_step:
            self.early = self.env.task_arrays()["phase"] != 0
        self.steps += 1
        return self.policy.act(obs)


def save_film(film: Film, targets: np.ndarray, command_step: int, folder: Path) -> None:
    """Write `jumps.rrd` and the filmstrip of the jump closest to 1 m; targets (filmed worlds,) [m]."""
    film.save_rrd(folder / "jumps.rrd")
    index = int(np.argmin(np.abs(targets - 1.0)))
    height = film.base(index)[:, 2]
    frames = moments(height, command_step - 1)
    captions = [f"{(frame + 1) * film.env.step_dt:.2f} s, {height[frame]:.2f} m" for frame in frames]
    film.strip(folder / f"jump_{targets[index]:.2f}_m.png", index, frames, captions, (1.5, 2.0, 0.9), (0.0, 0.0, 0.55))


def reached(jumps: Jumps, early: np.ndarray) -> np.ndarray:
    """Return which jumps, begun on command, came near their height; early: (jumps,) which began before it."""
    return (np.abs(jumps.error) <= NEAR) & ~early


def figures(jumps: Jumps, early: np.ndarray) -> dict:
    """Return the figures of the sweep, those against the open-loop limit left out; arguments as for `reached`."""
    target, error = jumps.target, np.abs(jumps.error)
    near = reached(jumps, early)
    tilt = np.where(np.isnan(error), 0.0, np.degrees(jumps.tilt))
    landed = jumps.success & (tilt < LEVEL) & (jumps.rest_speed < REST_SPEED)
    return {
        "jumps": len(target),
        "mean_abs_error_m": mean(error),
        "mean_abs_error_in_range_m": mean(error[within(target, IN_RANGE)]),
        "mean_error_m": mean(jumps.error),
        "success_rate": float(near.mean()),
        "success_and_landing_rate": float((near & landed).mean()),
        "success_rate_in_range": mean(near[within(target, IN_RANGE)]),
        "success_rate_0_6_1_1": mean(near[within(target, (0.6, 1.1))]),
        "largest_reached_m": largest(jumps.error + target),
        "landing_rate": float(landed.mean()),
        "collision_rate": float((jumps.outcomes == COLLIDED).mean()),
        "fall_rate": float(np.isin(jumps.outcomes, FALLS).mean()),
        "no_jump_rate": float((jumps.outcomes == "no_jump").mean()),
        "early_rate": float(early.mean()),
        "at_rest_within_1_s_rate": float((jumps.rest_speed < REST_SPEED).mean()),
        "largest_tilt_deg": float(tilt.max()),
        "came_apart": int(np.isnan(jumps.error).sum()),
    }


def limit_figures(jumps: Jumps, early: np.ndarray) -> dict:
    """Return the figures of the nominal robot's sweep against OPEN_LOOP_LIMIT; arguments as for `reached`.

    `open_loop_mean_abs_error_m` is that of jumps which stop at the limit and are perfect below it.
    """
    target = jumps.target
    reachable = within(target, (LOWER, OPEN_LOOP_LIMIT + NEAR))
    return {
        "open_loop_limit_m": OPEN_LOOP_LIMIT,
        "open_loop_mean_abs_error_m": mean(np.maximum(target - OPEN_LOOP_LIMIT, 0.0)),
        "mean_abs_error_up_to_limit_m": mean(np.abs(jumps.error)[target <= OPEN_LOOP_LIMIT]),
        "success_rate_reachable": mean(reached(jumps, early)[reachable]),
        "reachable_share": mean(reachable),
    }


def plot(jumps: Jumps, early: np.ndarray, path: Path, title: str) -> None:
    """Draw reached over commanded height; arguments as for `reached`."""
    line = np.array([LOWER, UPPER])
    near = reached(jumps, early)
    fig, axis = plt.subplots(figsize=(6, 5.5), constrained_layout=True)
    axis.fill_between(line, line - NEAR, line + NEAR, color="tab:green", alpha=0.12, label=f"within {NEAR:g} m")
    axis.plot(line, line, color="tab:green", linewidth=1.0, label="commanded")
    axis.axhline(OPEN_LOOP_LIMIT, color="0.5", linestyle="--", linewidth=1.0, label="open-loop jump, 18 N m")
    axis.scatter(jumps.target[near], jumps.apex[near], s=9, color="tab:blue", label="reached")
    axis.scatter(jumps.target[~near], jumps.apex[~near], s=14, color="tab:red", marker="x", label="missed")
    axis.set(xlabel="commanded base height [m]", ylabel="highest base height [m]", title=title)
    axis.legend(loc="upper left")
    fig.savefig(path, dpi=110)
    plt.close(fig)


def main(args: Args) -> dict:
    """Run the sweep and return its figures."""
    start = time.perf_counter()
    policy = open_policy(args.policy)
    if policy.interface.task != TASK:
        raise PolicyError(f"this needs a policy of {TASK}, {args.policy} is of {policy.interface.task!r:.60}")
    announce(args.device)
    env = make_env(policy, args)
    policy.to(env.device)
    targets = np.linspace(LOWER, UPPER, args.jumps)
    observer = Observer(policy, env)
    jumps = Jumps(targets, rule_names(env))
    worlds = np.linspace(0, args.jumps - 1, args.record).round().astype(int).tolist()
    film = Film(env, jumps, worlds, notes={"targets_m": targets[worlds].tolist()}) if worlds else None
    run(observer.act, env, jumps, watch=film)
    conditions = {"solver": args.solver, "randomize": args.randomize, "seed": args.seed}
    conditions |= {} if args.randomize else {"latency_ms": args.latency}
    values = conditions | {"torque_limit_nm": env.task.motors.transversal.saturation} | figures(jumps, observer.early)
    values |= {} if args.randomize else limit_figures(jumps, observer.early)
    folder = output_dir("vertical_jump_sweep", args.out)
    write_figures(folder, values)
    title = f"{args.jumps} jumps, {args.solver}, {'randomised' if args.randomize else 'nominal'}"
    plot(jumps, observer.early, folder / "sweep.png", title)
    if film is not None:
        save_film(film, targets[worlds], observer.command_step, folder)
    table = Table("figure", title, "paper")
    for name, value in values.items():
        table.add_row(name, f"{value:.4g}" if isinstance(value, float) else str(value), str(PAPER.get(name, "")))
    Console().print(table)
    print(f"{time.perf_counter() - start:.1f} s; figures, plot and recordings in {folder}")
    return values


if __name__ == "__main__":
    run_command(lambda: main(tyro.cli(Args)))
