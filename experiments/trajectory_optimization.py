"""Optimise jumps by gradients through the simulation, and write metrics, plots, targets and recordings of the best.

    python experiments/trajectory_optimization.py --out outputs/trajectories
    python experiments/trajectory_optimization.py --jumps farthest farthest_torque_24_8 farthest_filter

The jumps are the farthest flight, the highest jumps, the jump with the least work, and a still landing. Motor targets,
equal left and right, pass through the command filter and motors of the tasks, from standing still.

1. A search begins with random squats in parallel worlds, for the farthest flight with run-ups in place.
2. It descends along smoothed gradients (`trajectory.smoothing`).
3. It ends with limited-memory BFGS inside an augmented Lagrangian (`trajectory.augmented_lagrangian`).
4. The best targets are replayed in the simulation that trains policies. The metrics come from this replay, at every
   physics step; collisions of all links count.

The farthest flight stays within 0.3 m of its start in stance, without a run-up, and lands within 30 degrees of level.
`farthest_*` change one limit (LIMITS) and also start from the farthest flight if it was
optimised before. In vertical jumps only the paws touch the ground, the tilt is at most 8 degrees and the base stays
within 0.15 m of its start. Work is the motors' positive work until takeoff.

The file holds, in this order: the replay and its metrics (`MotionReplay`), random motions that begin a search
(`squats`, `run_ups`), the families of jumps (`_far`, `_vertical`), the tables of jumps and limits (`JUMPS`, `LIMITS`),
their optimisation (`optimise`), and the script (`Args`, `main`).
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
import warp as wp

from jumper_warp.diff.rollout import compact
from jumper_warp.diff.torch_rollout import TorchTrajectory
from jumper_warp.evaluation.recorder import ankles
from jumper_warp.kernels.collision.robot import collision_kernel
from jumper_warp.kernels.layout import COORDS
from jumper_warp.robot.description import MOTOR_JOINTS
from jumper_warp.robot.gravity import EARTH
from jumper_warp.robot.motors import (
    FilterCfg,
    MotorCfg,
    horizontal_jump_filter,
    jumping_motors,
    loose_filter,
    vertical_jump_filter,
)
from jumper_warp.sim.simulation import SUBSTEPS, Simulation, motor_values
from jumper_warp.trajectory import jumps
from jumper_warp.trajectory.augmented_lagrangian import Progress, minimise
from jumper_warp.trajectory.problem import Knots, Problem, SimulatedMotion, Term
from jumper_warp.trajectory.smoothing import Stage, smoothed
from jumper_warp.utils.arrays import write_npz
from jumper_warp.utils.files import Json
from jumper_warp.utils.output import write_metrics
from jumper_warp.viz.plots import figure
from jumper_warp.viz.style import LEG_COLORS
from support.open_loop import largest_forces, plot_motors
from support.scripts import ThreadArgs, announce, prepare, report, run_script, tracked

CONTACT_FORCE = 0.1  # [N] Force above which a paw is in contact
TAKEOFF_SPEED = 0.25  # [m/s] Smallest upward speed of the base at takeoff
PAW_RADIUS = 0.025  # [m] Radius of a paw


# ---------------------------------------------------------------------- replay in the simulation


class MotionReplay:
    """One world of the simulation that trains policies, in single precision, driven by the targets of a motion.

    The measured arrays have one row per physics step: time [s], height [m] and up (upward speed) [m/s] of the base,
    force (n, 4) [N] and gap (n, 4) [m] above the ground of the paws FL, FR, BL, BR, tilt [rad], power (positive,
    all motors) [W], angle (n, 12) [rad], torque (n, 12) [N m]. `_evaluate` documents the results.
    """

    def __init__(self, targets: np.ndarray, problem: Problem, *, notes: Json | None = None) -> None:
        """Simulate motor targets [rad], (policy steps, 12), from standing, with the robot and ground of a problem.

        notes: JSON metadata of the recording.
        """
        from jumper_warp.viz.recorder import Recorder

        self.problem = problem
        self.sim = Simulation(
            1,
            motors=problem.motors,
            command_filter=problem.command_filter,
            friction=problem.friction,
            gravity=problem.gravity,
            device=problem.device,
        )
        self.targets = targets
        self.recorder = Recorder(self.sim.model, notes=notes)
        rows: list[tuple] = []
        self.states = [compact(self.sim.joint_q(), self.sim.joint_qd())]
        self.impulses: list[np.ndarray] = []
        self.flags = 0
        self.work = 0.0
        for target in targets:
            self.sim.set_targets(target)
            self.sim.filter_targets()
            for _ in range(self.sim.substeps):
                rows.append(self._physics_step(len(rows)))
            self._record(rows[-1])
        columns = (np.array(column) for column in zip(*rows, strict=True))
        (self.time, self.height, self.up, self.force, self.gap, self.tilt, self.power, self.angle, self.torque) = (
            columns
        )
        self._evaluate()

    def _physics_step(self, number: int) -> tuple:
        """Advance by a physics step, and return the measurements after it, a row of the measured arrays.

        Power is the torque in the step times the mean of the motor rates before and after it.
        number: of physics steps before it.
        """
        sim = self.sim
        before = motor_values(sim.joint_qd()[0, 6:])
        sim.physics_step()
        q = sim.joint_q()[0]
        qd = sim.joint_qd()[0]
        torque = sim.torque.numpy()[:, 0].copy()
        power = torque * 0.5 * (before + motor_values(qd[6:]))
        self.impulses.append(sim.dt * sim.paw_force.numpy())
        force = np.linalg.norm(sim.paw_force.numpy()[:, 0], axis=1)
        pose = sim.state.body_q.numpy().copy()
        tilt = math.acos(min(1.0, 1.0 - 2.0 * (q[3] ** 2 + q[4] ** 2)))
        gap = ankles(pose[None])[0, :, 2] - PAW_RADIUS
        return (
            (number + 1) * sim.dt, q[2], sim.base_velocity()[0, 2], force, gap, tilt, np.maximum(power, 0.0).sum(),
            motor_values(q[7:]), torque,
        )  # fmt: skip

    def _record(self, row: tuple) -> None:
        """Record a policy step: state, link poses, collision flags and a frame of the recording.

        row: measurements of its last physics step.
        """
        sim = self.sim
        pose = sim.state.body_q.numpy().copy()
        self.states.append(compact(sim.joint_q(), sim.joint_qd()))
        flags = wp.zeros(1, dtype=int, device=sim.device)
        clearance = wp.zeros(1, dtype=float, device=sim.device)
        robot = sim.dynamics.robot
        wp.launch(
            collision_kernel,
            dim=1,
            inputs=[robot.geometry, robot.ground, sim.state.joint_q, COORDS, 0.0],
            outputs=[flags, clearance],
            device=sim.device,
        )
        self.flags |= int(flags.numpy()[0])
        series = {"base/height [m]": row[1], "base/vertical speed [m s⁻¹]": row[2]}
        for i, name in enumerate(MOTOR_JOINTS):
            series |= {f"torque/{name} [N m]": row[8][i], f"angle/{name} [deg]": math.degrees(row[7][i])}
        forces = largest_forces(np.array(self.impulses[-sim.substeps :])[:, :, 0] / sim.dt)
        self.recorder.record(row[0], sim.state.body_q, series, ankles(pose[None])[0], forces)

    def _evaluate(self) -> None:
        """Compute the jump's takeoff, work, apex, landing acceleration, and paws lifted after touchdown.

        A lift begins and ends where the difference of "off the ground" between two physics steps is not 0.
        """
        down = self.force > CONTACT_FORCE
        ticks = slice(self.sim.substeps - 1, None, self.sim.substeps)
        free = ~down[ticks].any(axis=1) & (self.up[ticks] > TAKEOFF_SPEED)
        self.takeoff = int(free.argmax()) + 1 if free.any() else len(free)
        """Policy step at whose end the robot is off the ground; the last if it never is."""
        first = self.takeoff * self.sim.substeps
        self.work = float(self.sim.dt * self.power[:first].sum())  # [J] Positive work of the motors until takeoff
        landing = np.flatnonzero(down[first:].any(axis=1))
        self.apex = float(self.height[first - 1 : first + landing[0] if len(landing) else None].max())
        """[m] Largest base height before a paw touches down."""
        ups = np.diff(self.up[ticks][max(self.takeoff - 1, 0) :], prepend=self.up[ticks][max(self.takeoff - 1, 0)])
        self.hardest = float(ups.max() / (self.sim.substeps * self.sim.dt * EARTH))
        """[g] Largest upward acceleration of the base over a policy step after takeoff, g of Earth."""
        self.longest_lift = 0.0
        self.highest_lift = 0.0
        self.touched = 0
        """[s] and [m] Longest time and largest height of a paw lifted after touchdown; number of paws that touched."""
        for leg in range(4):
            later = np.flatnonzero(down[first:, leg])
            if len(later):
                off = ~down[first + later[0] :, leg]
                edges = np.flatnonzero(np.diff(np.concatenate([[False], off, [False]]).astype(int)))
                self.longest_lift = max(self.longest_lift, self.sim.dt * max(np.diff(edges)[::2], default=0.0))
                self.highest_lift = max(self.highest_lift, float((self.gap[first + later[0] :, leg] * off).max()))
                self.touched += 1

    @cached_property
    def motion(self) -> SimulatedMotion:
        """Return the replay as a `SimulatedMotion`, the argument of objectives and constraints."""
        q, qd = (np.stack(column) for column in zip(*self.states, strict=True))
        parts = q, qd, self.torque[..., None], np.stack(self.impulses), self.targets[..., None]
        device = str(self.problem.rollout(1).device)
        return self.problem.motion_of(
            TorchTrajectory(*(torch.as_tensor(x, dtype=torch.float64, device=device) for x in parts))
        )

    @property
    def violation(self) -> float:
        """Largest violation of a constraint of the problem by the replay, in its unit, at least 0."""
        constraints = self.problem.values(self.motion).constraints
        return max(0.0, float(constraints.max())) if constraints.shape[1] else 0.0

    def metrics(self) -> Json:
        """Return the metrics of the jump, with units at the end of the names; `collisions`: bit flags of contacts."""
        return {
            "apex_m": self.apex, "takeoff_s": float(self.takeoff / 60.0), "landing_g": self.hardest,
            "work_j": self.work,
            "largest_tilt_deg": math.degrees(float(self.tilt.max())), "collisions": self.flags,
            "deepest_paw_mm": float(-1000.0 * self.gap.min()), "peak_torque_nm": float(np.abs(self.torque).max()),
        }  # fmt: skip


def plot_replays(replays: dict[str, MotionReplay], path: Path) -> None:
    """Plot height, angles and torques of two legs, and paw forces over time into a file; replays: a column by label."""
    with figure(path, 4, len(replays), figsize=(5.0 * len(replays), 11), sharex="col", squeeze=False) as axes:
        for column, (label, replay) in zip(axes.T, replays.items(), strict=True):
            column[0].plot(replay.time, replay.height)
            column[0].axvline(replay.takeoff / 60.0, color="0.4", linestyle=":", label="takeoff")
            plot_motors(column[1:3], replay.time, replay.angle, replay.torque)
            for i, leg in ((0, "FL"), (2, "BL")):
                column[3].plot(replay.time, replay.force[:, i], color=LEG_COLORS[leg], label=f"{leg} paw")
            column[0].set_title(label)
            column[3].set_xlabel("time [s]")
        labels = ("base height [m]", "motor angle [deg]", "motor torque [N m]", "paw force [N]")
        for axis, label in zip(axes[:, 0], labels, strict=True):
            axis.set_ylabel(label)


PITCH, AWAY, AHEAD = math.radians(29.8), 0.2985, 0.045
"""[rad], [m], [m] Largest pitch at landing, distance of the base from its start in stance, and distance of hind paws on
the ground ahead of their start; slightly inside 30 degrees, 0.3 m (the task's limit) and 0.05 m."""
FREE = 100.0  # [rad], [m] Value of a limit that never binds
TILT = math.radians(8.0)  # [rad] Largest tilt of vertical jumps at any time
DRIFT = 0.15  # [m] Largest distance of the base from its start in vertical jumps at any time
HEIGHT = 0.80  # [m] Apex height of the jump with the least work
STILL_HEIGHT = 0.65  # [m] Apex height of the jump that lands still
SOFT = 4.5  # [g] Largest acceleration of the base over a policy step of the landing; the tasks end an episode at 5
APEX_STEPS = 61  # Number of policy steps of a motion up to the apex
BACK, LEAN = (0.28, 1.0)  # [m], [1] Largest backward shift of the base that early stages of the search reward; weight
POSTURES = np.array([[-0.2, -0.7, 0.7, -0.3], [0.6, 0.0, 0.3, 0.8], [0.9, 0.5, 0.9, 0.5]])
"""[1] Actions of a run-up in place: base behind the paws, hind legs folded under it, crouch."""
SCATTER = 0.35  # [1] Standard deviation of these postures


# ---------------------------------------------------------------------- first guesses


def squats(knots: Knots, count: int, rng: np.random.Generator, push: int = 32) -> np.ndarray:
    """Return random candidates of squat jumps: actions [1], (count, len(knots)), two postures, then extension.

    The extension begins around step `push`, separately for front and hind legs; left and right are equal.
    """
    shape = (count, 1, 4)
    step = np.array(knots.at)[None, :, None]
    first = rng.uniform(-1.0, 1.0, shape)
    second = rng.uniform(-0.2, 1.0, shape)
    switch_step = rng.uniform(8.0, push - 4.0, (count, 1, 1))
    extend_step = np.repeat(rng.uniform(push - 8.0, push + 8.0, (count, 1, 2)), 2, axis=2)
    return np.where(step < extend_step, np.where(step < switch_step, first, second), -1.0).reshape(count, -1)


def run_ups(knots: Knots, count: int, rng: np.random.Generator, push: int = 40) -> np.ndarray:
    """Return random candidates of jumps that begin with a fall forward: actions [1], (count, len(knots)).

    The robot leans back, falls forward, crouches, extends the hind legs, then the front legs. Postures scatter around
    POSTURES, times are random; the hind legs push around step `push`; left and right are equal.
    """
    step = np.array(knots.at)[None, :, None]
    shape = (count, 1, 1)
    lean, fall, crouch = np.clip(POSTURES[:, None, None] + SCATTER * rng.normal(size=(3, count, 1, 4)), -1.0, 1.0)
    hind = rng.uniform(push - 5.0, push + 3.0, shape)
    front = hind + rng.uniform(0.0, 4.0, shape)
    crouch_step = hind - rng.uniform(2.0, 8.0, shape)
    fall_step = crouch_step - rng.uniform(4.0, 10.0, shape)
    before = np.where(step < fall_step, lean, np.where(step < crouch_step, fall, crouch))
    extend_step = np.concatenate([front, front, hind, hind], axis=2)
    return np.where(step < extend_step, before, -1.0).reshape(count, -1)


def noisy_variants(solution: np.ndarray, knots: Knots, rng: np.random.Generator) -> np.ndarray:
    """Return 64 noisy copies of a solution, as candidates of another optimisation, (64, len(knots)).

    They are the solution (n,) plus noise of standard deviation 0 to 0.2. The solution may be of a shorter motion;
    missing knots are 0 before the noise.
    """
    actions = np.zeros((len(knots.at), 4))
    actions[: len(solution) // 4] = solution.reshape(-1, 4)
    spread = np.linspace(0.0, 0.2, 64)[:, None]
    return np.clip(actions.ravel() + spread * rng.normal(size=(64, actions.size)), -1.0, 1.0)


# ---------------------------------------------------------------------- the jumps


@dataclass(frozen=True)
class Jump:
    """A jump to optimise: its problem, the stages of the search, and the reported value."""

    label: str  # Name in tables and plots
    unit: str  # Unit of `value`
    make: Callable[..., Problem]  # make(**settings of a stage, device=, threads=); settings: e.g. `FINE`
    stages: tuple[tuple[Mapping[str, Any], Stage], ...]  # Stages of the search, each with its settings of `make`
    value: Callable[[MotionReplay], float]  # Returns the reported value of a replay
    draw: Callable[[Knots, int, np.random.Generator], np.ndarray] = squats  # Returns random candidates
    samples: int = 2048  # Default number of random candidates
    polish: int = 40  # Default number of iterations of the last descent
    after: str = ""  # Key in `JUMPS` of the jump whose solution is also a candidate; empty: none

    def replay(self, targets: np.ndarray, device: str | None = None) -> MotionReplay:
        """Replay the jump with motor targets [rad], (steps, 12), in the simulation that trains policies."""
        return MotionReplay(targets, self.make(**FINE, device=device, threads=1), notes={"jump": self.label})

    def scaled(self, effort: float) -> Jump:
        """Return a copy whose search stages have `effort` [1] times as many iterations, at least 1; `polish` stays."""
        stages = ((made, replace(s, iterations=max(1, round(effort * s.iterations)))) for made, s in self.stages)
        return replace(self, stages=tuple(stages))


FORWARD_KNOTS = Knots((0.0, 8.0, 16.0, *map(float, range(24, 48))), steps=53)  # Knots of the farthest flight


def motors_of(torque: float, speed: float = 1.0) -> MotorCfg:
    """Return the settings of motors with a torque limit [N m].

    speed [1]: factor on all speed limits of the transversal motors.
    """
    motors = jumping_motors(torque, lateral_torque=12.0)
    stock = motors.transversal
    faster = replace(stock, cutoff_speed=speed * stock.cutoff_speed, no_load_speed=speed * stock.no_load_speed)
    return replace(motors, transversal=faster, fade_start=speed * motors.fade_start, fade_end=speed * motors.fade_end)


def _far(
    lean: float = 0.0,
    *,
    torque: float = 18.0,
    speed: float = 1.0,
    pitch: float = PITCH,
    away: float = AWAY,
    command_filter: Callable[[], FilterCfg] = horizontal_jump_filter,
    **settings: Any,
) -> Problem:
    """Return the optimisation problem of the farthest flight.

    lean [1]: weight of leaning back before it, up to BACK, which gives the base a longer way to accelerate ahead;
    torque [N m] and speed [1]: as for `motors_of`; pitch [rad], away [m]: limits PITCH, AWAY; settings: further
    arguments of `Problem`.
    """
    constraints = (
        jumps.landing_pitch(pitch), jumps.stays(away, TAKEOFF_SPEED), jumps.clear(speed=TAKEOFF_SPEED),
        jumps.no_run_up(AHEAD), jumps.takes_off(TAKEOFF_SPEED),
    )  # fmt: skip
    far = jumps.farthest(TAKEOFF_SPEED)
    back = jumps.leans_back(BACK, TAKEOFF_SPEED)
    objective = (lambda motion: far(motion) + lean * back(motion)) if lean else far
    return Problem(FORWARD_KNOTS, objective, constraints, motors_of(torque, speed), command_filter(), **settings)


UP = Knots((0.0, 6.0, 12.0, 18.0, 22.0, *map(float, range(24, 44, 1))), steps=APEX_STEPS)
"""Knots of vertical jumps: squat within half a second, push-off, legs extended or folded."""
LANDING = Knots((*UP.at, 48.0, 52.0, *map(float, range(54, 74, 2)), 80.0, 90.0, 100.0), steps=126)
"""Knots of vertical jumps, continued to a second after touchdown."""


def _vertical(objective: Term, *more: Term, torque: float = 18.0, knots: Knots = UP, **settings: Any) -> Problem:
    """Return the optimisation problem of a vertical jump; more: additional constraints; torque [N m]: limit."""
    constraints = (jumps.clear(), jumps.upright(TILT, at_end=False), jumps.drifts(DRIFT), *more)
    return Problem(knots, objective, constraints, jumping_motors(torque), vertical_jump_filter(), **settings)


FINE: Json = {"substeps": SUBSTEPS}  # Arguments of `Problem`: physics steps per policy step
COARSE = FINE | {"substeps": 4}  # Fewer physics steps per policy step, for the first stages of a search
QUICK = FINE | {"double": False, "tolerance": None}  # Single precision, and its tolerance of the contact iteration
UPWARD = (
    (COARSE, Stage(32, 40, rate=0.05, noise=0.05, final_fraction=1.0)),
    (COARSE, Stage(12, 100, rate=0.04, noise=0.04)),
    (FINE, Stage(4, 100, rate=0.02, noise=0.02, penalty=100.0)),
)
CALM: Json = {"slack": 0.03, "check_every": 5, "return_scale": 0.7}
"""Settings of stages that often return to the best motion and continue with smaller steps."""
CALMEST: Json = CALM | {"slack": 0.02}
FORWARD = (
    (QUICK | {"lean": LEAN}, Stage(40, 40, rate=0.05, noise=0.05, final_fraction=1.0, slack=0.1)),
    (QUICK | {"lean": LEAN}, Stage(16, 40, rate=0.05, noise=0.05, final_fraction=1.0, slack=0.1)),
    (QUICK, Stage(10, 60, rate=0.04, noise=0.03, final_fraction=0.5, slack=0.1)),
    (QUICK, Stage(10, 80, rate=0.02, noise=0.015, final_fraction=0.2, penalty=40.0, dual=2.0, crossings=40, **CALM)),
    (QUICK, Stage(8, 80, rate=0.02, noise=0.015, final_fraction=0.2, penalty=40.0, dual=2.0, crossings=40, **CALM)),
    (QUICK, Stage(6, 80, rate=0.02, noise=0.01, final_fraction=0.2, penalty=40.0, dual=2.0, crossings=40, **CALM)),
    (QUICK, Stage(4, 100, rate=0.015, noise=0.006, final_fraction=0.1, penalty=40.0, dual=2.0, crossings=40, **CALM)),
    (QUICK, Stage(3, 150, rate=0.01, noise=0.003, final_fraction=0.1, penalty=100.0, dual=4.0, **CALMEST)),
)
JUMPS = {
    "farthest": Jump(
        "farthest flight, 18 N m", "m", _far, FORWARD,
        lambda replay: -float(jumps.farthest(TAKEOFF_SPEED)(replay.motion)), draw=run_ups, samples=768, polish=5,
    ),
    "highest": Jump(
        "highest jump, 18 N m", "m", lambda **s: _vertical(jumps.highest(), jumps.takes_off(), **s), UPWARD,
        lambda replay: replay.apex,
    ),
    "highest_24_8": Jump(
        "highest jump, 24.8 N m", "m",
        lambda **s: _vertical(jumps.highest(), jumps.takes_off(), torque=24.8, **s), UPWARD,
        lambda replay: replay.apex,
    ),
    "least_work": Jump(
        f"least work to {HEIGHT:g} m", "J",
        lambda **s: _vertical(jumps.positive_work(), jumps.reaches(HEIGHT), jumps.takes_off(), **s), UPWARD,
        lambda replay: replay.work,
    ),
    "still": Jump(
        f"still landing from {STILL_HEIGHT:g} m", "s",
        lambda **s: _vertical(jumps.still(), jumps.reaches(STILL_HEIGHT), jumps.soft(SOFT), knots=LANDING, **s),
        (
            (FINE, Stage(16, 60, rate=0.05, noise=0.05, final_fraction=1.0)),
            (FINE, Stage(6, 100, rate=0.03, noise=0.03)),
        ),
        lambda replay: replay.longest_lift, draw=partial(squats, push=30), samples=1024, after="least_work",
    ),
}  # fmt: skip
LIMITS: dict[str, tuple[str, Json]] = {
    "torque_24_8": ("24.8 N m", {"torque": 24.8}), "speed": ("motor speeds × 1.5", {"speed": 1.5}),
    "friction_1_5": ("friction 1.5", {"friction": 1.5}), "friction_0_6": ("friction 0.6", {"friction": 0.6}),
    "pitch": ("any pitch at landing", {"pitch": FREE}), "stance": ("stance beyond 0.3 m", {"away": FREE}),
    "filter": ("loose command filter", {"command_filter": loose_filter}),
}  # fmt: skip
"""Limits of the farthest flight: label, and the changed settings of its problem."""
LIMITED = {
    f"farthest_{name}": replace(
        JUMPS["farthest"], label=f"farthest flight, {label}", make=partial(_far, **changed), after="farthest"
    )
    for name, (label, changed) in LIMITS.items()
}


# ---------------------------------------------------------------------- search and report


def optimise(
    jump: Jump, begin: np.ndarray, seed: int, polish: int, **settings: Any
) -> tuple[Progress, dict[str, float]]:
    """Optimise a jump by all search stages and a last descent (`minimise`); return its result and the simulated steps.

    Keys: `simulated_steps` and `reverse_steps`, of all worlds.
    begin: candidates, (n, len(knots)); seed: of displacements; polish: iterations of the last descent; settings:
    device, threads.
    """
    problems = {str(how): jump.make(**how, **settings) for how in (FINE, *(how for how, _ in jump.stages))}
    costs: list[torch.Tensor] = []
    candidates = begin
    for number, (how, stage) in enumerate(jump.stages):
        problem = problems[str(how)]
        candidates = smoothed(
            problem, candidates, stages=(stage,), seed=seed + number, callback=lambda _, last: costs.append(last)
        )
        best = float(costs[-1][0])
        announce(f"{jump.label}, stage {number + 1} of {len(jump.stages)}: cost with penalties {best:.3f}")
    progress = minimise(problems[str(FINE)], candidates, iterations=polish, step=0.01, seed=seed)
    return progress, {
        "simulated_steps": float(sum(problem.world_steps for problem in problems.values())),
        "reverse_steps": float(sum(problem.reverse_steps for problem in problems.values())),
    }


ALL_JUMPS = JUMPS | LIMITED  # By name


@dataclass(frozen=True)
class Args(ThreadArgs):
    """Flags of the optimisation of jumps."""

    jumps: tuple[str, ...] = tuple(JUMPS)  # Names of the jumps to optimise
    samples: int | None = None  # Random candidates (default: those of each jump)
    effort: float = 1.0  # [1] Factor on the number of iterations
    final_iterations: int | None = None  # Iterations of the last descent (default: those of each jump)
    seed: int = 0  # Seed of random candidates and displacements


def run_jump(name: str, args: Args, folder: Path, best: dict[str, np.ndarray]) -> tuple[dict[str, float], MotionReplay]:
    """Optimise the named jump, write its targets, and return metrics of the search and the replay.

    best: solutions (len(knots),) by name of the jump; one may start this search, and the new one is added.
    """
    jump = ALL_JUMPS[name]
    wall = time.perf_counter()
    cpu = time.process_time()
    settings: Json = {"device": args.device, "threads": args.threads}
    knots = jump.make(**FINE, **settings).knots
    rng = np.random.default_rng(args.seed)
    begin = jump.draw(knots, args.samples or jump.samples, rng)
    if jump.after in best:
        begin = np.concatenate([begin, noisy_variants(best[jump.after], knots, rng)])
    last = args.final_iterations or jump.polish
    progress, steps = optimise(jump.scaled(args.effort), begin, args.seed, last, **settings)
    x = best[name] = progress.x[progress.best]
    targets = knots.targets(torch.as_tensor(x[None]))[..., 0].numpy()
    write_npz(folder / f"{name}.npz", targets=targets, knots=x.reshape(len(knots.at), -1), at=np.array(knots.at))
    values = steps | {"wall_s": time.perf_counter() - wall, "cpu_s": time.process_time() - cpu}
    replay = jump.replay(targets, args.device)
    return values | {"value": jump.value(replay), "violation": replay.violation}, replay


def main(args: Args) -> Json:
    """Optimise the jumps in order, write their replays, and return the metrics."""
    torch.set_num_threads(1)  # arrays of torch are small; the simulated worlds use the cores
    folder = prepare("trajectory_optimization", args, args.threads)
    best = {}
    replays: dict[str, MotionReplay] = {}
    values: Json = {}
    for name in tracked(args.jumps, "optimising jumps"):
        row, replay = run_jump(name, args, folder, best)
        replays[ALL_JUMPS[name].label] = replay
        values |= {f"{name}_gradients_{key}": value for key, value in row.items()}
        values[f"{name}_reached [{ALL_JUMPS[name].unit}]"] = row["value"]
        values |= {f"{name}_{key}": value for key, value in replay.metrics().items()}
        if name == "still":
            values |= {"still_longest_lift_s": replay.longest_lift, "still_highest_lift_m": replay.highest_lift}
        replay.recorder.save_rrd(folder / f"{name}.rrd")
        replay.recorder.save_picture(folder / f"{name}.png", title=ALL_JUMPS[name].label)
        write_metrics(folder, values)
    plot_replays(replays, folder / "trajectories.png")
    keys = [key for key in values if "_reached [" in key or key.endswith("_violation")]
    return report(args, folder, values, f"Optimised jumps: {', '.join(replays)}", keys)


if __name__ == "__main__":
    run_script(main, Args)
