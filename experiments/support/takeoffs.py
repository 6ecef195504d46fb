"""Takeoffs of a batch of jumps, one a world, the flights that follow from them, and what their landings ask for.

A flight is that of the centre of mass of the whole robot: from where it stood to where its parabola, fixed at takeoff,
falls through the height that it has with the base at LANDING_HEIGHT in the posture of the start. Takeoff is the end of
the policy step in which the task sees one. Robots start at the world's origin and jump along x; frames are the world's.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import torch
import warp as wp
from scipy.spatial.transform import Rotation

from jumper_warp.envs.env import Env
from jumper_warp.evaluation.film import Links, ankles
from jumper_warp.evaluation.jumps import LANDED, jump_commands
from jumper_warp.evaluation.log import success_index, termination_names
from jumper_warp.kernels.kinematics import geometry
from jumper_warp.kernels.kinematics import inverse as inverse_kinematics
from jumper_warp.kernels.kinematics.leg import leg_forward_kinematics
from jumper_warp.robot.description import load_description
from jumper_warp.robot.model import leg_geometry
from jumper_warp.robot.motors import FilterCfg
from jumper_warp.tasks.jump.horizontal import LANDING_HEIGHT

LATEST = 60
"""Policy steps within which a robot has to take off."""
CLEAR = 6
"""Policy steps after takeoff in which no paw may come down and nothing may collide."""
REST = 110
"""Policy steps from the latest takeoff to a second after touchdown."""
STEP = 0.05
"""[m] How far a hind paw on the ground may be ahead of its start; beyond, the jump has a run-up."""
LANDING_ACTION = (70.0 - 45.0) / 90.0
"""[1] Of the transversal motors after takeoff: 70 degrees, paws 0.30 m below the base."""
HIND = slice(2, 4)
"""Legs."""

Act = Callable[[torch.Tensor], torch.Tensor]


@dataclass
class Takeoffs:
    """What became of a jump a world; arrays of shape (num_envs, ...), zero before it happened."""

    env: Env
    """Its worlds have just been reset for an evaluation, heading along x."""
    off: np.ndarray = field(init=False)
    """Whether the robot has taken off."""
    bad: np.ndarray = field(init=False)
    """Whether the jump ended, stepped before takeoff, or came down right after."""
    com: np.ndarray = field(init=False)
    """[m] (..., 3) Centre of mass of the robot at takeoff."""
    com_vel: np.ndarray = field(init=False)
    """[m/s] (..., 3) Its velocity at takeoff."""
    pitch: np.ndarray = field(init=False)
    """[rad] Of the base at takeoff, nose down is positive."""
    spin: np.ndarray = field(init=False)
    """[rad/s] Angular momentum about y at takeoff over the inertia of the posture of the start."""
    back: np.ndarray = field(init=False)
    """[m] Farthest that the base went back before takeoff."""
    touchdown: np.ndarray = field(init=False)
    """[m] Base ahead of its start when the first paw came down."""
    touchdown_pitch: np.ndarray = field(init=False)
    """[rad] Of the base then."""
    paws_ahead: np.ndarray = field(init=False)
    """[m] Foremost paw ahead of the centre of mass then."""
    apex: np.ndarray = field(init=False)
    """[m] Largest base height up to then."""
    end: np.ndarray = field(init=False)
    """Index of the termination that ended the jump after takeoff, -1 before."""
    start: np.ndarray = field(init=False)
    """[m] (..., 3) Centre of mass at the start."""
    landing_height: np.ndarray = field(init=False)
    """[m] Of the centre of mass, at which a flight ends."""
    gravity: np.ndarray = field(init=False)
    """[m/s^2] Of each world, downward."""

    def __post_init__(self) -> None:
        """Read where all stand and what the links weigh."""
        n, model = self.env.num_envs, self.env.sim.model
        self._mass = model.body_mass.numpy().reshape(n, -1)
        self._center = model.body_com.numpy().reshape(n, -1, 3)
        self._inertia = model.body_inertia.numpy().reshape(n, -1, 3, 3)
        self.off, self.bad, self._since = np.zeros(n, dtype=bool), np.zeros(n, dtype=bool), np.zeros(n, dtype=int)
        self.com, self.com_vel = np.zeros((n, 3)), np.zeros((n, 3))
        self.pitch, self.spin, self.back, self.touchdown = (np.zeros(n) for _ in range(4))
        self.touchdown_pitch, self.paws_ahead, self.apex = (np.zeros(n) for _ in range(3))
        self.end, self._success = np.full(n, -1), success_index(termination_names(self.env.task))
        self.gravity = -self.env.sim.model.gravity.numpy()[:n, 2].astype(float)
        self._links = Links(self.env).read
        pose, twist = self._links()
        self.start, _, _, self._standing = self._whole(np.arange(n), pose, twist)
        self._base_start = pose[:, 0, :3].copy()
        self._hind_start = ankles(pose)[:, HIND, 0].max(axis=1)
        self.landing_height = LANDING_HEIGHT + self.start[:, 2] - self._base_start[:, 2]

    def _whole(self, worlds: np.ndarray, pose: np.ndarray, twist: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return centre of mass [m], its velocity [m/s], angular momentum and inertia about y of some robots."""
        pose, twist, mass = pose[worlds], twist[worlds], self._mass[worlds]
        turn = Rotation.from_quat(pose[..., 3:].reshape(-1, 4)).as_matrix().reshape(*mass.shape, 3, 3)
        center = pose[..., :3] + (turn @ self._center[worlds, :, :, None])[..., 0]
        share = (mass / mass.sum(axis=1, keepdims=True))[..., None]
        com, vel = (share * center).sum(axis=1), (share * twist[..., :3]).sum(axis=1)
        row = (turn @ self._inertia[worlds] @ turn.swapaxes(-1, -2))[..., 1, :]  # of each link's inertia, world axes
        arm, relative = center - com[:, None], twist[..., :3] - vel[:, None]
        moment = arm[..., 2] * relative[..., 0] - arm[..., 0] * relative[..., 2]
        momentum = (row * twist[..., 3:]).sum(axis=2) + mass * moment
        inertia = row[..., 1] + mass * (arm[..., 0] ** 2 + arm[..., 2] ** 2)
        return com, vel, momentum.sum(axis=1), inertia.sum(axis=1)

    @property
    def landed(self) -> np.ndarray:
        """Whether the jump was landed."""
        return self.end == self._success

    def look(self) -> None:
        """Take in a policy step."""
        task, (pose, twist) = self.env.task_arrays(), self._links()
        paws = ankles(pose)[..., 0]
        pitch = 2.0 * np.arctan2(pose[:, 0, 4], pose[:, 0, 6])
        force = np.linalg.norm(self.env.sim.paw_force.numpy()[HIND], axis=2).max(axis=0)
        stepped = (force > self.env.task.contact_force) & (paws[:, HIND].max(axis=1) > self._hind_start + STEP)
        back = self._base_start[:, 0] - pose[:, 0, 0]
        self.back = np.where(self.off, self.back, np.maximum(self.back, back))
        early = self._since <= CLEAR
        failed = (task["ending"] >= 0) & (task["ending"] != self._success)
        self.bad |= (~self.off & stepped) | (early & failed)
        self.bad |= early & self.off & (task["phase"] == LANDED)
        self.end = np.where((self.end < 0) & self.off, task["ending"], self.end)
        new = np.flatnonzero((task["took_off"] == 1) & ~self.off)
        if len(new):
            self.com[new], self.com_vel[new], momentum, _ = self._whole(new, pose, twist)
            self.spin[new], self.pitch[new] = momentum / self._standing[new], pitch[new]
            self.off[new] = True
        self._since += self.off
        down = np.flatnonzero(self.off & (task["touched_down"] == 1))
        if len(down):
            self.touchdown[down], self.touchdown_pitch[down] = -back[down], pitch[down]
            self.paws_ahead[down] = paws[down].max(axis=1) - self._whole(down, pose, twist)[0][:, 0]
            self.apex[down] = task["max_height"][down]

    @property
    def known(self) -> bool:
        """Whether all jumps are in the air and clear of the ground, or are bad."""
        return bool((self.bad | (self._since > CLEAR)).all())

    @property
    def air_time(self) -> np.ndarray:
        """[s] Until the centre of mass falls through its landing height; to its apex, if it never reaches that."""
        up = self.com_vel[:, 2]
        root = up**2 + 2.0 * self.gravity * (self.com[:, 2] - self.landing_height)
        return (up + np.sqrt(np.maximum(root, 0.0))) / self.gravity

    @property
    def flight(self) -> np.ndarray:
        """[m] From where the centre of mass stood to where it falls through its landing height; 0 before takeoff."""
        return np.where(self.off, self.com[:, 0] - self.start[:, 0] + self.air_time * self.com_vel[:, 0], 0.0)

    @property
    def landing_pitch(self) -> np.ndarray:
        """[rad] That the base would have at the end of the flight in the posture of the start."""
        return self.pitch + self.spin * self.air_time


def both_sides(rows: np.ndarray) -> np.ndarray:
    """Return actions of all motors (n, 12), left and right alike, lateral ones 0, of rows (n, 4).

    A row is front outer, front inner, hind outer, hind inner.
    """
    motors = np.zeros((len(rows), 2, 2, 3), dtype=np.float32)
    motors[..., 1:] = rows.reshape(-1, 2, 1, 2)
    return motors.reshape(-1, 12)


def mean_of_sides(actions: np.ndarray) -> np.ndarray:
    """Return the rows (n, 4) of `both_sides` that are the mean of left and right in actions (n, 12)."""
    return actions.reshape(-1, 2, 2, 3).mean(axis=2)[..., 1:].reshape(-1, 4)


def fly(
    env: Env,
    actions: np.ndarray,
    after: float | Act = LANDING_ACTION,
    *,
    goals: np.ndarray | None = None,
    to_rest: bool = False,
) -> Takeoffs:
    """Let every world jump from the default pose by fixed actions.

    Args:
        env: Nominal robots, no observation noise.
        actions: [1] (num_envs, policy steps, 4), within -1..1, rows as of `both_sides`; the last is held until takeoff.
        after: What follows in a world after its takeoff: an action of all transversal motors, or a policy's `act`.
        goals: [m] (num_envs, 3), what a policy is told; by default none is away from the start.
        to_rest: Whether to go on until REST, and not only until all takeoffs are known.
    """
    goals = np.zeros((env.num_envs, 3)) if goals is None else goals
    env.evaluation_reset(jump_commands(goals, 0.0, env.step_dt))
    takeoffs = Takeoffs(env)
    for tick in range(LATEST + (REST if to_rest else CLEAR)):
        action = torch.from_numpy(both_sides(actions[:, min(tick, actions.shape[1] - 1)])).to(env.device)
        later = after(env.obs) if callable(after) else torch.tensor([0.0, after, after], device=env.device).repeat(4)
        env.step(torch.where(torch.from_numpy(takeoffs.off).to(env.device)[:, None], later, action))
        takeoffs.look()
        if takeoffs.known and not to_rest:
            break
    return takeoffs


@dataclass(frozen=True)
class Flight:
    """One jump, as it is told; names end in units."""

    takeoff_speed_m_s: float
    """Of the centre of mass."""
    takeoff_angle_deg: float
    """Above the horizon."""
    flight_m: float
    """Of the centre of mass."""
    base_at_touchdown_m: float
    """From its start, when the first paw came down."""
    touchdown_pitch_deg: float
    """Of the base."""
    apex_m: float
    """Of the base."""
    leaned_back_m: float
    """Farthest that the base went back before takeoff."""
    landing_forward_speed_m_s: float
    """Of the centre of mass in the air."""
    landing_down_speed_m_s: float
    """Of the centre of mass at the end of the flight."""
    landing_paws_ahead_m: float
    """Foremost paw ahead of the centre of mass at touchdown."""
    landing_capture_m: float
    """How far ahead a pendulum asks it to be: `capture_distance`."""
    landing_friction_time_s: float
    """How long stopping takes at least: `stopping_time`."""

    @classmethod
    def of(cls, takeoffs: Takeoffs, world: int, friction: float) -> Flight:
        """Return the jump of a world that was followed to its touchdown; friction [1] of paws on the ground."""
        vel, g = takeoffs.com_vel[world], takeoffs.gravity[world]
        down = g * takeoffs.air_time[world] - vel[2]
        values = (
            np.linalg.norm(vel), math.degrees(math.atan2(vel[2], vel[0])), takeoffs.flight[world],
            takeoffs.touchdown[world], math.degrees(takeoffs.touchdown_pitch[world]), takeoffs.apex[world],
            takeoffs.back[world], vel[0], down, takeoffs.paws_ahead[world],
            capture_distance(vel[0], takeoffs.landing_height[world], g), stopping_time(vel[0], down, friction, g),
        )  # fmt: skip
        return cls(*map(float, values))


def capture_distance(forward: float, height: float, g: float) -> float:
    """Return how far ahead [m] of the centre of mass a pendulum on the front paws must begin to stop above them.

    forward: speed [m/s]; height [m] of the centre of mass, which stays; g [m/s^2]: gravity. Stopping the fall, which
    helps, and further steps are left out.
    """
    return forward * math.sqrt(height / g)


def stopping_time(forward: float, down: float, friction: float, g: float) -> float:
    """Return the least time [s] in which friction takes the forward speed, on paws that also stop the fall [m/s].

    g [m/s^2]: gravity.
    """
    return max(0.0, (forward / friction - down) / g)


def reach(command_filter: FilterCfg, base_height: float) -> float:
    """Return how far ahead of a level base [m] the front paws touch the ground, to 5 mm, legs within their limits."""
    leg, limits = geometry.LegGeometry(), inverse_kinematics.LegLimits()
    for name, value in leg_geometry(load_description())[0].items():
        setattr(leg, name, value)
    for name in ("transversal", "sum"):
        pair = getattr(command_filter, name)
        setattr(limits, f"{name}_lower", math.radians(pair.lower))
        setattr(limits, f"{name}_upper", math.radians(pair.upper))
    farthest = 0.0
    for x in np.arange(0.0, leg.outer_x + leg.thigh + leg.shank, 0.005):  # from the hip, lateral angle 0
        ankle = wp.vec3(float(x), leg.plane_y + leg.knee_y, leg.paw_radius - base_height)
        motors = inverse_kinematics.clamped_closed_form(leg, limits, ankle)
        if wp.length(leg_forward_kinematics(leg, 0.0, motors[1], motors[2]) - leg.hip - ankle) < 1.0e-4:
            farthest = float(x)
    return leg.hip[0] + farthest
