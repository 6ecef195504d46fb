"""Jumps that `jumper_warp.optim.trajectory` optimises, and their replay in the simulation that trains policies."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

from jumper_warp.evaluation.film import ankles
from jumper_warp.evaluation.takeoff_search import KNOTS, TICKS
from jumper_warp.optim import jumps
from jumper_warp.optim.descent import Progress, minimise
from jumper_warp.optim.smoothing import Stage, smoothed
from jumper_warp.optim.trajectory import CONTACT_FORCE, Knots, Problem, Term
from jumper_warp.robot.model import MOTOR_JOINTS, build_model
from jumper_warp.robot.motors import FilterCfg, horizontal_jump_filter, jumping_motors, vertical_jump_filter
from jumper_warp.sim.simulation import SUBSTEPS, Simulation, motor_values
from kernels.collision.robot import collision_kernel
from kernels.layout import COORDS

SPEED = 0.25
"""[m/s] Of the base upward, with which a jump takes off."""
PITCH, AWAY, AHEAD = math.radians(29.8), 0.2985, 0.045
"""[rad], [m], [m] Most pitch at landing, of the base from its start in stance, of hind paws on the ground; a little
less than `jumper_warp.evaluation.takeoff_search` allows."""
TILT = math.radians(8.0)
"""[rad] Most of vertical jumps, at any time."""
DRIFT = 0.15
"""[m] Most of the base from its start in vertical jumps, at any time."""
HEIGHT = 0.80
"""[m] Of the jump with the least work."""
STILL_HEIGHT = 0.65
"""[m] Of the jump that lands still."""
FRICTION, PAW_RADIUS = 0.85, 0.025
"""[1] Of the paws, [m]."""
ESTIMATE = 61
"""Policy steps of a motion up to the apex."""


@dataclass(frozen=True)
class Jump:
    """What is optimised."""

    label: str
    unit: str
    """Of what `told` returns."""
    make: Callable[..., Problem]
    """Returns the problem, given substeps, device and threads."""
    stages: tuple[tuple[int, Stage], ...]
    """Parts of the search: physics steps in a policy step, and the part."""
    told: Callable[[Replay], float | None]
    """What is told of the replay."""
    torque: float = 18.0
    """[N m] Limit of the transversal motors."""
    lateral_torque: float = 18.0
    """[N m]"""
    command_filter: Callable[[], FilterCfg] = vertical_jump_filter
    samples: int = 2048
    """Random squats, among which the search begins."""
    after: str = ""
    """Name of the jump whose best motion is a start too."""

    def scaled(self, effort: float) -> Jump:
        """Return the same with other numbers of iterations."""
        stages = tuple(
            (n, replace(part, iterations=max(1, round(effort * part.iterations)))) for n, part in self.stages
        )
        return replace(self, stages=stages)


def squats(knots: Knots, count: int, rng: np.random.Generator, push: int) -> np.ndarray:
    """Return random candidates: two postures, then stretched legs, front and hind at their times, around step `push`.

    Shape (count, len(knots)), equal left and right.
    """
    shape, now = (count, 1, 4), np.array(knots.at)[None, :, None]
    first, second = rng.uniform(-1.0, 1.0, shape), rng.uniform(-0.2, 1.0, shape)
    change = rng.uniform(8.0, push - 4.0, (count, 1, 1))
    stretch = np.repeat(rng.uniform(push - 8.0, push + 8.0, (count, 1, 2)), 2, axis=2)
    return np.where(now < stretch, np.where(now < change, first, second), -1.0).reshape(count, -1)


def _far(**settings: Any) -> Problem:
    knots = Knots(tuple(map(float, KNOTS)), steps=TICKS + 5)
    constraints = (
        jumps.landing_pitch(PITCH), jumps.stays(AWAY, SPEED), jumps.clear(speed=SPEED), jumps.no_run_up(AHEAD),
        jumps.takes_off(SPEED),
    )  # fmt: skip
    return Problem(
        knots, jumps.farthest(SPEED), constraints, jumping_motors(18.0, lateral_torque=12.0), horizontal_jump_filter(),
        **settings,
    )  # fmt: skip


UP = Knots((0.0, 6.0, 12.0, 18.0, 22.0, *map(float, range(24, 44, 1))), steps=ESTIMATE)
"""Of vertical jumps: squat within half a second, push-off, legs stretched or drawn in."""
LANDING = Knots((*UP.at, 48.0, 52.0, *map(float, range(54, 74, 2)), 80.0, 90.0, 100.0), steps=126)
"""The same, on to a second after touchdown."""


def _vertical(
    objective: Term, *more: Term, torque: float = 18.0, knots: Knots = UP, **settings: Any
) -> Problem:  # fmt: skip
    constraints = (jumps.clear(), jumps.upright(TILT, at_end=False), jumps.drifts(DRIFT), *more)
    return Problem(knots, objective, constraints, jumping_motors(torque), vertical_jump_filter(), **settings)


COARSE = 4
"""Physics steps in a policy step of the first parts of a search."""
UPWARD = (
    (COARSE, Stage(32, 40, rate=0.05, noise=0.05, fall=False)),
    (COARSE, Stage(12, 100, rate=0.04, noise=0.04)),
    (SUBSTEPS, Stage(4, 100, rate=0.02, noise=0.02, penalty=100.0)),
)
JUMPS = {
    "farthest": Jump(
        "farthest flight, 18 N m", "m", _far,
        (
            (COARSE, Stage(48, 40, rate=0.05, noise=0.05, fall=False)),
            (SUBSTEPS, Stage(16, 150, rate=0.05, noise=0.05)),
            (SUBSTEPS, Stage(6, 200, rate=0.03, noise=0.03, penalty=100.0)),
        ),
        lambda replay: None, lateral_torque=12.0, command_filter=horizontal_jump_filter,
    ),
    "highest": Jump(
        "highest jump, 18 N m", "m", lambda **s: _vertical(jumps.highest(), jumps.takes_off(), **s), UPWARD,
        lambda replay: replay.apex,
    ),
    "highest_24_8": Jump(
        "highest jump, 24.8 N m", "m",
        lambda **s: _vertical(jumps.highest(), jumps.takes_off(), torque=24.8, **s), UPWARD,
        lambda replay: replay.apex, torque=24.8,
    ),
    "least_work": Jump(
        f"least work to {HEIGHT:g} m", "J",
        lambda **s: _vertical(jumps.positive_work(), jumps.reaches(HEIGHT), jumps.takes_off(), **s), UPWARD,
        lambda replay: replay.work,
    ),
    "still": Jump(
        f"still landing from {STILL_HEIGHT:g} m", "s",
        lambda **s: _vertical(jumps.still(), jumps.reaches(STILL_HEIGHT), knots=LANDING, **s),
        (
            (SUBSTEPS, Stage(16, 60, rate=0.05, noise=0.05, fall=False)),
            (SUBSTEPS, Stage(6, 100, rate=0.03, noise=0.03)),
        ),
        lambda replay: replay.longest_lift, samples=1024, after="least_work",
    ),
}  # fmt: skip


def optimise(
    jump: Jump, begin: np.ndarray, *, seed: int, polish: int, tell: Callable[[str], None], **settings: Any
) -> tuple[Progress, list[Problem]]:
    """Return what was found from candidates, and the problems that counted the steps; settings: device, threads."""
    problems = {n: jump.make(substeps=n, **settings) for n in sorted({SUBSTEPS, *(n for n, _ in jump.stages)})}
    fine, found = problems[SUBSTEPS], begin
    for number, (substeps, stage) in enumerate(jump.stages):
        found = smoothed(problems[substeps], found, stages=(stage,), seed=seed + number)
        tell(f"part {number + 1}: {len(found)} starts")
    return minimise(fine, found, iterations=polish, step=0.01, seed=seed), list(problems.values())


class Replay:
    """A motion in one world of the simulation that trains policies, in single precision, at every physics step."""

    def __init__(
        self, jump: Jump, targets: np.ndarray, *, device: str | None = None, notes: dict | None = None
    ) -> None:
        """Simulate targets [rad] (steps, 12) from standing."""
        from jumper_warp.viz.recorder import Recorder

        self.sim = Simulation(
            1, motors=jumping_motors(jump.torque, lateral_torque=jump.lateral_torque),
            command_filter=jump.command_filter(), friction=FRICTION, device=device,
        )  # fmt: skip
        self.targets, self.recorder = targets, Recorder(self.sim.model, notes=notes)
        rows: list[tuple] = []
        self.states: list[tuple[np.ndarray, np.ndarray]] = []
        self.poses: list[np.ndarray] = []
        self.flags, self.work = 0, 0.0
        for target in targets:
            self.sim.target.assign(target[:, None].astype(np.float32))
            self.sim.filter_targets()
            for _ in range(self.sim.substeps):
                rows.append(self._physics_step(len(rows)))
            self._record(rows[-1])
        self.time, self.height, self.up, self.force, self.gap, self.tilt, self.power, self.angle, self.torque = (
            np.array(column) for column in zip(*rows, strict=True)
        )
        self._follow()

    def _physics_step(self, number: int) -> tuple:
        sim = self.sim
        before = motor_values(sim.joint_qd()[0, 6:])
        sim.physics_step()
        q, qd = sim.joint_q()[0], sim.joint_qd()[0]
        torque = sim.torque.numpy()[:, 0].copy()
        power = torque * 0.5 * (before + motor_values(qd[6:]))
        force = np.linalg.norm(sim.paw_force.numpy()[:, 0], axis=1)
        pose = sim.state.body_q.numpy().copy()
        tilt = math.acos(min(1.0, 1.0 - 2.0 * (q[3] ** 2 + q[4] ** 2)))
        gap = ankles(pose[None])[0, :, 2] - PAW_RADIUS
        velocity = sim.base_velocity()[0, 2]
        return (
            (number + 1) * sim.dt, q[2], velocity, force, gap, tilt, np.maximum(power, 0.0).sum(), motor_values(q[7:]),
            torque,
        )  # fmt: skip

    def _record(self, row: tuple) -> None:
        sim = self.sim
        pose = sim.state.body_q.numpy().copy()
        self.poses.append(pose)
        self.states.append((sim.joint_q()[0].copy(), sim.joint_qd()[0].copy()))
        flags, clearance = wp.zeros(1, dtype=int, device=sim.device), wp.zeros(1, dtype=float, device=sim.device)
        robot = sim.physics.dynamics.robot
        wp.launch(
            collision_kernel, dim=1, inputs=[robot.geometry, robot.ground, sim.state.joint_q, COORDS, 0.0],
            outputs=[flags, clearance], device=sim.device,
        )  # fmt: skip
        self.flags |= int(flags.numpy()[0])
        series = {"base/height [m]": row[1], "base/vertical speed [m s⁻¹]": row[2]}
        for i, name in enumerate(MOTOR_JOINTS):
            series |= {f"torque/{name} [N m]": row[8][i], f"angle/{name} [deg]": math.degrees(row[7][i])}
        self.recorder.record(row[0], sim.state.body_q, series, ankles(pose[None])[0], sim.paw_force.numpy()[:, 0])

    def _follow(self) -> None:
        """Find takeoff, apex and what happens after touchdown."""
        down = self.force > CONTACT_FORCE
        ticks = slice(self.sim.substeps - 1, None, self.sim.substeps)
        free = ~down[ticks].any(axis=1) & (self.up[ticks] > SPEED)
        self.takeoff = int(free.argmax()) + 1 if free.any() else len(free)
        """Policy step at whose end the robot is off the ground; the last where it never is."""
        first = self.takeoff * self.sim.substeps
        self.work = float(self.sim.dt * self.power[:first].sum())
        """[J] Positive, of the motors until takeoff."""
        self.apex = float(self.height[first - 1 :].max())
        """[m] Highest base."""
        self.longest_lift, self.highest_lift, self.touched = 0.0, 0.0, 0
        """[s] and [m] Of a paw that had come down after the flight; how many have."""
        for leg in range(4):
            later = np.flatnonzero(down[first:, leg])
            if len(later):
                off = ~down[first + later[0] :, leg]
                edges = np.flatnonzero(np.diff(np.concatenate([[False], off, [False]]).astype(int)))
                self.longest_lift = max(self.longest_lift, self.sim.dt * max(np.diff(edges)[::2], default=0.0))
                self.highest_lift = max(self.highest_lift, float((self.gap[first + later[0] :, leg] * off).max()))
                self.touched += 1

    def metrics(self) -> dict[str, Any]:
        """Return what is told of every jump."""
        return {
            "apex_m": self.apex, "takeoff_s": float(self.takeoff / 60.0), "work_j": self.work,
            "largest_tilt_deg": math.degrees(float(self.tilt.max())), "collisions": self.flags,
            "deepest_paw_mm": float(-1000.0 * self.gap.min()), "peak_torque_nm": float(np.abs(self.torque).max()),
        }  # fmt: skip

    def save_rrd(self, path: Path) -> None:
        """Write the recording."""
        self.recorder.save_rrd(path)

    def save_strip(self, path: Path, count: int = 8) -> None:
        """Draw the robot at evenly spaced moments from the push-off on."""
        from jumper_warp.viz.snapshot import Camera, contact_sheet

        first = max(self.takeoff - 20, 0)
        moments = np.linspace(first, len(self.poses) - 1, count).round().astype(int)
        model = build_model(1)
        state, pictures = model.state(), []
        for moment in moments:
            x = float(self.poses[moment][0, 0])
            state.body_q.assign(self.poses[moment])
            pictures.append(Camera(model, (x + 1.2, 2.0, 0.7), (x, 0.0, 0.5), (300, 400)).picture(state))
        contact_sheet(pictures, path, [f"{moment / 60:.2f} s" for moment in moments])
