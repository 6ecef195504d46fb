"""What limits how far the robot can jump: its motors, the ground, the terminations of the task, or the policy?

    python experiments/distance_limit.py --out outputs/limit

Actions as a policy gives them, but fixed in advance and equal left and right, are searched for the farthest flight of
the centre of mass (`support.takeoffs`) from standing still: 60 Hz, within -1..1, through the command
filter and motors of the task, lateral motors held. Penalties keep out jumps that collide, whose base leaves its start
by more than 0.3 m while standing or lands beyond 30 degrees of level, as the task's training does, and those whose
hind paws go forward on the ground, a run-up. The pitch at landing is taken from the angular momentum at takeoff and
the inertia of the standing posture. Then one limit after the other is changed, and the search goes on from the nominal
robot's best; gains are counted from how far the nominal robot gets in as many further generations.

The search is an evolution strategy with covariance matrix adaptation (Hansen 2016, arXiv:1604.00772), from the package
`cma`. Every optimum is a lower bound of what is possible: searches of the nominal robot that begin elsewhere end about
0.1 m apart, of which the best counts. Differences below 0.04 m are noise.

The jumps that were found are flown on to their touchdown. The landing is judged by a level pendulum on the front paws,
which stops above them if they touch the ground at least forward speed x sqrt(height / g) ahead of the centre of mass;
it leaves out that stopping the fall helps, and that more steps may follow. The time is told too that friction needs at
least, on paws that also stop the fall. And the policy is asked: it takes over at takeoff of the nominal best.
"""

from __future__ import annotations

import math
import time
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from rich.console import Console
from rich.table import Column, Table

from jumper_warp.cli.main import run_command
from jumper_warp.envs.env import Env
from jumper_warp.evaluation.plots import drawn
from jumper_warp.evaluation.run import EvaluationArgs, EvaluationRun
from jumper_warp.robot.model import KNEE_DOFS
from jumper_warp.robot.motors import horizontal_jump_filter, jumping_motors, loose_filter, vertical_jump_filter
from jumper_warp.tasks.cfg import TaskCfg
from jumper_warp.tasks.jump.horizontal import LANDING_HEIGHT
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.output import write_metrics
from support.takeoff_search import (
    FURTHER_SIGMA,
    NOMINAL,
    POLICY_GOALS,
    SIGMA,
    Limit,
    actions_of,
    cma_package,
    env_of_limit,
    fly_best,
    fly_policy,
    knots_of,
    random_squat,
    search,
)
from support.takeoffs import Flight, reach

FRICTION = 0.85
"""[1] Of the paws of nominal robots on this task."""
STRETCHED = -1.0
"""[1] Of the transversal motors after takeoff for the highest apex: all that the filter lets."""
OPEN_LOOP_APEX = 1.0748
"""[m] Base, experiments/open_loop_jump.py."""


Rows = dict[str, tuple[str, Flight]]
"""What is told: the name of its figures, its label and the jump."""


def with_torque(task: TaskCfg, torque: float) -> TaskCfg:
    """Return the task with another limit of the transversal motors' torque [N m]."""
    return replace(task, motors=replace(task.motors, transversal=jumping_motors(torque).transversal))


def with_speed(task: TaskCfg, scale: float) -> TaskCfg:
    """Return the task with faster motors: cutoff and no-load speed of the transversal ones, over-speed protection."""
    motors, kind = task.motors, task.motors.transversal
    faster = replace(kind, cutoff_speed=scale * kind.cutoff_speed, no_load_speed=scale * kind.no_load_speed)
    fade = {"fade_start": scale * motors.fade_start, "fade_end": scale * motors.fade_end}
    return replace(task, motors=replace(motors, transversal=faster, **fade))


def set_friction(env: Env, friction: float) -> None:
    """Give the paws another friction coefficient [1]."""
    mu = env.sim.model.shape_material_mu
    mu.assign(np.where(mu.numpy() > 0.1, friction, mu.numpy()).astype(np.float32))
    env.sim.physics.parameters_changed()


def set_mass(env: Env, scale: float) -> None:
    """Scale mass and inertia of every link."""
    model = env.sim.model
    model.body_mass.assign(scale * model.body_mass.numpy())
    model.body_inertia.assign(scale * model.body_inertia.numpy())
    env.sim.physics.parameters_changed()


def free_knees(env: Env) -> None:
    """Take the damping of the passive knees away."""
    damping = env.sim.model.joint_damping.numpy().reshape(env.num_envs, -1)
    damping[:, KNEE_DOFS] = 0.0
    env.sim.model.joint_damping.assign(damping.ravel())
    env.sim.physics.parameters_changed()


APEX = Limit("highest apex", lambda task: replace(task, command_filter=vertical_jump_filter()), apex=True)
LIMITS = {
    "torque_x_1_1": Limit("torque 18 → 19.8 N m", lambda task: with_torque(task, 19.8)),
    "torque_24_8": Limit("torque 18 → 24.8 N m", lambda task: with_torque(task, 24.8)),
    "speed": Limit("motor speeds × 1.5", lambda task: with_speed(task, 1.5)),
    "knees": Limit("no knee damping", model=free_knees),
    "friction_1_5": Limit("friction 0.85 → 1.5", model=lambda env: set_friction(env, 1.5)),
    "friction_0_6": Limit("friction 0.85 → 0.6", model=lambda env: set_friction(env, 0.6)),
    "pitch": Limit("any pitch at landing", pitch=math.inf),
    "stance": Limit("stance beyond 0.3 m", stance=False),
    "lean": Limit("leans back ≤ 0.05 m", back=0.05),
    "filter": Limit("loose command filter", lambda task: replace(task, command_filter=loose_filter())),
    "mass": Limit("mass − 10 %", model=lambda env: set_mass(env, 0.9)),
}


@dataclass(frozen=True)
class Args:
    """Flags."""

    policy: str = "horizontal_jump"
    """Name or folder of a policy, a run's folder, or a checkpoint; it is compared, and begins the search."""
    limits: tuple[str, ...] = tuple(LIMITS)
    """Limits to change, one at a time."""
    population: int = 64
    """Candidates in a generation."""
    generations: int = 480
    """Of each search from the start: of those of the nominal robot, and of the one for the highest apex."""
    squats: int = 3
    """Searches of the nominal robot from random squats, besides the one from the policy's actions."""
    further: int = 200
    """Generations after a limit was changed."""
    seed: int = 0
    """Of the search."""
    out: Path | None = None
    """Folder for figures and plot (default: outputs/distance_limit/<time>)."""
    device: str | None = None
    """Warp device."""
    threads: int | None = None
    """CPU threads that share the worlds (default: all cores); they change no result."""
    gravity: float | None = None
    """[m/s^2] Downward (default: that of the task)."""

    def __post_init__(self) -> None:
        """Check the values."""
        unknown = [name for name in self.limits if name not in LIMITS]
        if unknown:
            raise InputError(f"no limit {unknown[0]!r:.40}; there are {', '.join(LIMITS)}")
        if self.population < 8 or min(self.generations, self.further) < 1 or self.squats < 0:
            raise InputError("need a population of at least 8, a generation in each search, and no negative squats")


def caught(run: EvaluationRun, best: np.ndarray) -> dict[str, Any]:
    """Return how the policy lands a jump if it takes over at takeoff, told each of POLICY_GOALS."""
    goals = np.outer(POLICY_GOALS, [1.0, 0.0, 0.0])
    takeoffs = fly_best(run.env(len(goals)), best, run.policy.act, goals)
    landed = takeoffs.landed.tolist()
    told = ", ".join(f"{goal:g} m: {'yes' if good else 'no'}" for goal, good in zip(POLICY_GOALS, landed, strict=True))
    print(f"the policy takes over the nominal jump at takeoff and lands it, told a goal of {told}")
    return {"caught_goal_m": list(POLICY_GOALS), "caught": landed}


def nominal_best(actions: np.ndarray, args: Args) -> tuple[np.ndarray, dict[str, Any]]:
    """Return the best of several searches, from the policy's actions and without them, and how far each flew."""
    env = env_of_limit(NOMINAL, args.population, args.device, args.gravity)
    squats = [random_squat(env, NOMINAL, args.seed + number) for number in range(args.squats)]
    found = []
    for number, begin in enumerate([knots_of(actions), *squats]):
        limit = replace(NOMINAL, label=f"nominal, from random squat {number}" if number else "nominal, from the policy")
        found.append(search(env, limit, begin, SIGMA, args.generations, args.seed + max(number - 1, 0)))
    flights = [value for _, value in found]
    values = {"from_policy_flight_m": flights[0], "from_random_squats_flight_m": flights[1:]}
    return max(found, key=lambda pair: pair[1])[0], values


def highest(args: Args) -> dict[str, float]:
    """Return the highest apex found [m], of the base with its legs stretched, beside that of the open-loop jump."""
    env = env_of_limit(APEX, args.population, args.device, args.gravity)
    best, _ = search(env, APEX, random_squat(env, APEX, args.seed), SIGMA, args.generations, args.seed)
    apex = float(fly_best(env, best, STRETCHED).apex[0])
    print(f"highest apex {apex:.3f} m, open-loop jump {OPEN_LOOP_APEX:.3f} m")
    return {"highest_apex_m": apex, "open_loop_apex_m": OPEN_LOOP_APEX}


def of_nominal(rows: Rows) -> Rows:
    """Return the rows of the nominal robot, whose landings are told."""
    return {name: row for name, row in rows.items() if name == "nominal" or name.startswith("policy")}


def metrics(rows: Rows) -> dict[str, float]:
    """Return the metrics of all jumps, the gain over the nominal best among them."""
    values, told = {}, of_nominal(rows)
    for name, (_, jump) in rows.items():
        values[f"{name}_gain_m"] = jump.flight_m - rows["nominal"][1].flight_m
        for key, value in asdict(jump).items():
            if name in told or not key.startswith("landing"):
                values[f"{name}_{key}"] = value
    return values


def show(rows: Rows, ahead: float) -> None:
    """Print flights, with the base at touchdown, and landings; ahead [m] of the base is how far front paws reach."""
    title = "Flight of the centre of mass, base at touchdown; below 0.04 m is noise"
    flights = Table(Column("limit changed", no_wrap=True), title=title)
    landings = Table(Column("landing", no_wrap=True), title=f"front paws reach {ahead:.2f} m ahead of the base")
    for name in ("speed [m/s]", "angle [deg]", "flight [m]", "gain [m]", "base [m]", "leaned back [m]"):
        flights.add_column(name, justify="right")
    for name in ("forward [m/s]", "down [m/s]", "paws ahead [m]", "pendulum asks [m]", "friction asks [s]"):
        landings.add_column(name, justify="right")
    for label, jump in rows.values():
        gain = jump.flight_m - rows["nominal"][1].flight_m
        cells = f"{jump.takeoff_speed_m_s:.2f}", f"{jump.takeoff_angle_deg:.0f}", f"{jump.flight_m:.2f}", f"{gain:+.2f}"
        flights.add_row(label, *cells, f"{jump.base_at_touchdown_m:.2f}", f"{jump.leaned_back_m:.2f}")
    for label, jump in of_nominal(rows).values():
        told = [value for key, value in asdict(jump).items() if key.startswith("landing")]
        landings.add_row(label, *(f"{value:.2f}" for value in told))
    Console().print(flights, landings)


def plot(rows: Rows, path: Path) -> None:
    """Draw the flights as bars, and those of the policy as lines."""
    bars = {label: jump.flight_m for name, (label, jump) in rows.items() if not name.startswith("policy")}
    colors = ["tab:blue" if label == NOMINAL.label else "0.7" for label in bars]
    with drawn(path, figsize=(8, 5)) as axis:
        axis.bar_label(axis.barh(list(bars), list(bars.values()), color=colors), fmt="%.2f", padding=3)
        for goal, style, color in zip(POLICY_GOALS, ("-", "--", ":"), ("orange", "tab:red", "black"), strict=True):
            flight = rows[f"policy_{goal:g}"][1].flight_m
            axis.axvline(flight, color=color, linestyle=style, label=f"policy, goal {goal:g} m: {flight:.2f} m")
        axis.invert_yaxis()
        axis.set(
            xlabel="flight of the centre of mass [m]", title="Farthest flight found, a lower bound; one limit changed"
        )
        axis.margins(x=0.1)
        axis.figure.legend(loc="outside lower center", ncols=len(POLICY_GOALS))


def main(args: Args) -> dict[str, Any]:
    """Search, and return the figures."""
    cma_package()  # that it is missing is said before anything else
    evaluation = EvaluationArgs(args.policy, record=0, out=args.out, device=args.device, threads=args.threads,
                                gravity=args.gravity)  # fmt: skip
    run = EvaluationRun.of("distance_limit", evaluation)
    flown, landings, actions = fly_policy(run)
    begin, values = nominal_best(actions, args)
    rows: Rows = {}
    for i, goal in enumerate(POLICY_GOALS):
        rows[f"policy_{goal:g}"] = (f"policy, goal {goal:g} m", Flight.of(flown, i, FRICTION))
        values[f"policy_{goal:g}_steps_after_landing"] = bool(landings.stepped[i, 0])
    for name in ("nominal", *args.limits):
        limit = LIMITS.get(name, NOMINAL)
        env = env_of_limit(limit, args.population, args.device, args.gravity)
        best, _ = search(env, limit, begin, FURTHER_SIGMA, args.further, args.seed)
        rows[name] = (limit.label, Flight.of(fly_best(env, best), 0, FRICTION))
        if name == "nominal":
            values |= caught(run, best)
            np.save(run.folder / "actions.npy", actions_of(best[None])[0])
    values |= highest(args) | metrics(rows)
    values["reach_ahead_of_base_m"] = reach(horizontal_jump_filter(), LANDING_HEIGHT)
    show(rows, values["reach_ahead_of_base_m"])
    plot(rows, run.folder / "distance_limit.png")
    values["seconds"] = time.perf_counter() - run.started
    write_metrics(run.folder, values)
    print(f"{values['seconds']:.0f} s; figures, plot and the nominal robot's actions in {run.folder}")
    return values


if __name__ == "__main__":
    run_command(lambda: main(tyro.cli(Args)))
