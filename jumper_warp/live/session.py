"""Simulation of one robot that a person drives, with one policy or with several, between which the robot switches."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import torch
from newton import ModelFlags
from scipy.ndimage import map_coordinates

from jumper_warp.evaluation.conditions import Conditions, shared_robot
from jumper_warp.evaluation.courses import NUDGE, NUDGE_AFTER, NUDGE_TIME, SQUAT_TIME
from jumper_warp.evaluation.trained import trained_bounds
from jumper_warp.evaluation.velocities import SLEW_RATE, body_velocity
from jumper_warp.kernels.jump.state import LANDED, JumpState
from jumper_warp.kernels.velocity.state import VelocityState
from jumper_warp.recipe import Recipe
from jumper_warp.registry import task_names
from jumper_warp.robot.description import LEGS, MOTOR_JOINTS
from jumper_warp.robot.terrain import TerrainCfg, single_tile
from jumper_warp.tasks.cfg import Handover, TaskCfg
from jumper_warp.tasks.jump.evaluation import HeightEvaluation
from jumper_warp.tasks.switching import skills_and_handovers
from jumper_warp.utils.files import read_json
from jumper_warp.utils.kernels import records
from jumper_warp.utils.rotations import turn_plane, yaw_of

if TYPE_CHECKING:
    from jumper_warp.envs.env import Env
    from jumper_warp.policies.policy import Policy

FLAT = "flat"
GROUNDS = (FLAT, "uneven", "waves", "slope", "stairs", "blocks")  # Grounds to choose from
TILE = TerrainCfg(tile=8.0, cell=0.05)  # Size and roughness of all grounds but the flat one
PUSH_TIME = 0.2  # [s] Duration of a push
FALL_TIME = 1.5  # [s] Time from a fall to the reset
TURNING, WALKING = (2.0, 1.5)  # [1/s] Gains of the approach to a goal: yaw rate over bearing, speed over distance
SPEEDS, YAW_RATES = ((0.15, 0.5), (0.15, 1.0))  # [m/s], [rad/s] Smallest and largest of the approach
BEARING = 0.06  # [rad] Largest bearing of a goal from which the robot jumps
MAX_VALUES = {"friction [1]": 1.5, "payload [kg]": 10.0, "gravity [m/s²]": 20.0, "latency [ms]": 40.0}
"""Physical values that a driver can change while the robot moves, and their largest values."""
Agent = Literal["policy", "hold", "random"]


@dataclass
class Jump:
    """Jump that the driver has requested."""

    skill: int  # Index of the task
    height: float = 0.0  # [m] Commanded base height at the apex; 0: any
    goal: np.ndarray | None = None  # (2,) [m] Landing position x, y, world frame; None: on the spot
    ready: bool = False  # Whether the robot stands where it jumps from
    waited: float = 0.0  # [s] Time since then


class Session:
    """Simulation of one robot, advanced by `step`; the other methods take effect in the next step.

    With several policies the first one walks and the others jump, and the robot switches between them.
    """

    def __init__(
        self, recipes: Sequence[Recipe], policies: Sequence[Policy | None], conditions: Conditions, ground: str = FLAT,
        agent: Agent = "policy",
    ) -> None:  # fmt: skip
        """Build the environment and begin an episode.

        recipes: of the trainings; policies: None for robots that hold the default pose; ground: one of `GROUNDS`.
        Raises InputError: several tasks of which the first does not walk or another does not jump, or an unknown
        ground; PolicyError: trained for different robots.
        """
        self.recipes = list(recipes)
        self.policies = list(policies)
        self.conditions = conditions
        self.agent: Agent = agent
        self.velocity = np.zeros(3)  # Velocity that the driver commands: ahead, left [m/s], about z [rad/s]
        self.values: dict[str, float] = {}  # Values of `MAX_VALUES` that the driver has changed
        self.build(ground)

    # ------------------------------------------------------------------ environment and episodes

    def build(self, ground: str) -> None:
        """Build the environment on a ground of this name, and begin an episode."""
        from jumper_warp.envs.env import Env

        self.ground = ground
        self.field = None if ground == FLAT else single_tile(TILE, ground)
        self.tasks, handovers = self._tasks()
        names = {recipe.task.name: recipe.robot for recipe in self.recipes}
        settings = self.conditions.env_settings(shared_robot(names, self.conditions))
        scene: Any = {"ground": "plane" if self.field is None else self.field}
        self.env: Env = Env(self.tasks, 1, handovers=handovers, **settings, **scene)
        for policy in self.policies:
            if policy is not None:
                policy.to(self.env.device)
        self.env.reset()  # sets the conditions' friction and latency
        self.nominal = self._nominal_values()
        self.reset()

    def _tasks(self) -> tuple[list[TaskCfg], list[Handover]]:
        """Return the tasks in the session's conditions, with rewards but without critics, and their handovers."""
        tasks = []
        for recipe in self.recipes:
            task = replace(recipe.task, observations=replace(recipe.task.observations, critic=()))
            task = self.conditions.applied(recipe.task.evaluation.prepare_task(task)).on_level_ground()
            tasks.append(replace(task, randomization=replace(task.randomization, push_in_flight=True)))
        if len(tasks) == 1:
            return [replace(tasks[0], events=tasks[0].events if self.conditions.sets_parameters else ())], []
        switching, handovers = skills_and_handovers(tasks[0], tuple(tasks[1:]))
        full = [replace(new, rewards=task.rewards) for new, task in zip(switching, tasks, strict=True)]
        ends = [(full[switching.index(h.source)], full[switching.index(h.target)]) for h in handovers]
        return full, [replace(h, source=a, target=b) for h, (a, b) in zip(handovers, ends, strict=True)]

    def reset(self) -> None:
        """Begin an episode: at rest in the default pose or, for tasks of other kinds, as in training."""
        task = self.tasks[0]
        self.jump: Jump | None = None
        self.command = np.zeros(3)
        self.fallen = ""  # Name of the termination that ended the episode; empty: none
        self.fallen_time = 0.0
        self.push_steps = 0
        if task.state is VelocityState:
            self.env.evaluation_reset(np.zeros(3))
        elif task.state is JumpState:
            self._begin_jump(np.array([0.0, 0.0, 0.0, np.inf]))
        else:
            self.env.reset()
        if self.values:
            self._write_values()
        self._read()

    def _begin_jump(self, values: np.ndarray) -> None:
        """Begin an episode of a jump task with a command; the height of a jump to a place is 0."""
        bounds = trained_bounds(self.tasks[0])
        values[bounds[0].index] = max(values[bounds[0].index], bounds[0].low)
        self.env.evaluation_reset(values)

    def step(self) -> None:
        """Advance the robot by one policy step (1/60 s), and switch skills or begin an episode where due."""
        env = self.env
        if self.tasks[0].state is VelocityState:
            self._command_velocity()
        env.step(self._action())
        if self.push_steps > 0:
            self.push_steps -= 1
            if self.push_steps == 0:
                env.parameters.push.zero_()
        self._read()
        if self.fallen:
            self.fallen_time += env.step_dt
            if self.fallen_time > FALL_TIME:
                self.reset()

    def _action(self) -> torch.Tensor:
        """Return the actions for `Env.step`, of which only the active skill's are computed."""
        env = self.env
        actions = torch.zeros((len(self.tasks), 1, 12), device=env.device)
        policy = self.policies[self.skill]
        if self.agent == "random":
            actions.uniform_(-1.0, 1.0)
        elif self.agent == "policy" and policy is not None:
            actions[self.skill] = policy.act(env.skills[self.skill].obs["actor"])
        return actions if len(self.tasks) > 1 else actions[0]

    # ------------------------------------------------------------------ commands

    def kinds(self) -> dict[str, int]:
        """Return the index of the skill for each kind of command that the robot takes: walk, jump up, jump there."""
        kinds = {}
        for index, task in enumerate(self.tasks):
            if task.state is VelocityState:
                kinds["walk"] = index
            elif task.state is JumpState:
                up = isinstance(task.evaluation, HeightEvaluation)
                kinds["jump up" if up else "jump there"] = index
        return kinds

    def jump_up(self, height: float) -> None:
        """Request a jump on the spot; height: of the base at the apex [m]."""
        skill = self.kinds()["jump up"]
        if len(self.tasks) == 1:
            self._command_jump(np.array([0.0, 0.0, height]))
        else:
            self.jump = Jump(skill, height=height)

    def jump_to(self, goal: np.ndarray) -> None:
        """Request a jump to a place x, y [m], world frame, to which the robot first turns and walks if necessary."""
        skill = self.kinds()["jump there"]
        if len(self.tasks) == 1:
            self._command_jump(np.append(self._offset(goal), 0.0))
        else:
            self.jump = Jump(skill, goal=np.array(goal[:2], dtype=float))

    def cancel_jump(self) -> None:
        """Give up a jump to which the robot is on its way."""
        if self.skill == 0 and self.jump is not None:
            self.jump = None
            self.env.episodes.requested_task.fill_(-1)

    def _command_jump(self, goal: np.ndarray) -> None:
        """Command the jump of a robot that only jumps; goal: x, y relative to base and heading, and height [m]."""
        if self.phase == LANDED:
            self.env.command(goal)
        else:
            self._begin_jump(np.append(goal, round(SQUAT_TIME / self.env.step_dt)))

    def push(self, force: float, direction: float) -> None:
        """Push the base for PUSH_TIME; force [N], direction [deg] in the horizontal plane, from the robot's heading."""
        angle = np.radians(direction) + self.yaw
        wrench = np.array([[force * np.cos(angle), force * np.sin(angle), 0.0, 0.0, 0.0, 0.0]], dtype=np.float32)
        self.env.parameters.push.assign(wrench)
        self.push_steps = round(PUSH_TIME / self.env.step_dt)

    def _offset(self, goal: np.ndarray) -> np.ndarray:
        """Return the vector x, y [m] from the base to a place, (2,), in the robot's heading."""
        return turn_plane(goal[:2] - self.position[:2], np.asarray(-self.yaw))

    def _command_velocity(self) -> None:
        """Command a walking robot's velocity, the driver's or one that leads to its jump, and request that jump."""
        target = self.velocity if self.jump is None else self._approach(self.jump)
        if self.skill != 0:
            self.command[:] = 0.0
            return
        step = SLEW_RATE * self.env.step_dt
        limits = np.array([[bound.low, bound.high] for bound in trained_bounds(self.tasks[0])])
        command = self.command + np.clip(np.clip(target, *limits.T) - self.command, -step, step)
        if (command != self.command).any() or self.returned:
            self.env.command(command)
        self.command = command

    def _approach(self, jump: Jump) -> np.ndarray:
        """Return the velocity that brings the robot to where it can jump from; request the jump once it is there.

        A goal must be ahead, within the middle of the range of distances that training sampled. A robot that does not
        come to rest walks a few steps.
        """
        offset = np.zeros(2) if jump.goal is None else self._offset(jump.goal)
        if jump.goal is not None and not jump.ready:
            ahead, *_ = trained_bounds(self.tasks[jump.skill])
            span = ahead.high - max(ahead.low, 0.0)
            distance = float(np.linalg.norm(offset))
            nearest = max(ahead.low, 0.0) + 0.1 * span
            excess = distance - min(max(distance, nearest), nearest + 0.5 * span)
            bearing = float(np.arctan2(offset[1], offset[0]))
            if abs(bearing) > BEARING or abs(excess) > 0.0:
                speed, turn = (
                    math.copysign(min(max(gain * abs(error), low), high), error) if error else 0.0
                    for error, gain, (low, high) in ((excess, WALKING, SPEEDS), (bearing, TURNING, YAW_RATES))
                )
                return np.array([speed * (abs(bearing) < 0.5), 0.0, turn])
        jump.ready = True
        jump.waited += self.env.step_dt
        delay = round(SQUAT_TIME / self.env.step_dt)
        self.env.request(jump.skill, commands=np.array([[*offset, jump.height, delay]]))
        nudged = jump.waited > NUDGE_AFTER and jump.waited % NUDGE_AFTER < NUDGE_TIME
        return np.array(NUDGE if nudged else (0.0, 0.0, 0.0))

    # ------------------------------------------------------------------ physical values

    def _nominal_values(self) -> dict[str, float]:
        """Return the values of `MAX_VALUES` of the environment after its first reset."""
        parameters = self.env.parameters
        mu = parameters.shape_mu.numpy()[parameters.paw_shapes.numpy()[0]]
        names = ("mass", "inv_mass", "inertia", "inv_inertia")
        self.nominal_base = {name: getattr(parameters, f"body_{name}").numpy()[0].copy() for name in names}
        gravity = -float(self.env.sim.model.gravity.numpy()[0, 2])
        latency = 1.0e3 * self.env.physics_dt * float(parameters.latency.numpy()[0])
        return dict(zip(MAX_VALUES, (float(mu), 0.0, gravity, latency), strict=True))

    def set_value(self, name: str, value: float) -> None:
        """Change a physical value, a key of `MAX_VALUES`, at once and for later episodes."""
        self.values[name] = value
        self._write_values()

    def _write_values(self) -> None:
        """Write the physical values that the driver has changed to the simulation."""
        env = self.env
        parameters = env.parameters
        friction, payload, gravity, latency = (self.nominal | self.values).values()
        mu = parameters.shape_mu.numpy()
        mu[parameters.paw_shapes.numpy()] = friction
        parameters.shape_mu.assign(mu)
        scale = 1.0 + payload / self.nominal_base["mass"]
        for name, power in (("mass", 1), ("inv_mass", -1), ("inertia", 1), ("inv_inertia", -1)):
            array = getattr(parameters, f"body_{name}")
            values = array.numpy()
            values[0] = self.nominal_base[name] * scale**power
            array.assign(values)
        vectors = env.sim.model.gravity.numpy()
        vectors[:, 2] = -gravity
        env.sim.model.gravity.assign(vectors)
        parameters.latency.fill_(round(1.0e-3 * latency / env.physics_dt))
        flags = ModelFlags.BODY_INERTIAL_PROPERTIES | ModelFlags.SHAPE_PROPERTIES | ModelFlags.MODEL_PROPERTIES
        env.sim.solver.notify_model_changed(flags)

    # ------------------------------------------------------------------ readings

    def _read(self) -> None:
        """Read the state after a step or reset: poses, active skill, termination, and the series to plot."""
        env = self.env
        sim = env.sim
        previous = getattr(self, "skill", 0)
        self.skill = int(env.episodes.skill.numpy()[0])
        self.returned = previous != self.skill == 0  # whether walking has just taken over
        if self.returned and self.jump is not None and self.jump.ready:  # else it was requested during this jump
            self.jump = None
        self.poses = sim.links()[0].copy()
        self.position = self.poses[0, 0, :3].astype(float)
        self.yaw = float(yaw_of(self.poses[0, 0, 3:].astype(float)))
        jumps = self.tasks[self.skill].state is JumpState
        self.phase = int(records(env.skills[self.skill].states)["phase"][0]) if jumps else -1
        ended = int(env.episodes.termination.numpy()[0])
        if ended >= 0 and not self.fallen and bool(env.episodes.terminated.numpy()[0]):
            self.fallen = self.tasks[self.skill].terminations[ended].name

    def series(self) -> dict[str, float]:
        """Return the current values to plot, by name `group/quantity [unit]`; NaN: not defined."""
        sim = self.env.sim
        base = {
            "base_quat": self.poses[:, 0, 3:],
            "base_vel": sim.base_velocity(),
            "base_ang_vel": sim.joint_qd()[:, 3:6],
        }
        velocity = body_velocity(base)[0]
        walks = self.tasks[self.skill].state is VelocityState
        series = {"height/base [m]": self.position[2] - self.surface(*self.position[:2, None])[0]}
        series["height/commanded [m]"] = self.jump.height if self.jump and self.jump.height else np.nan
        for name, unit, actual, commanded in zip(
            ("ahead", "to the left", "yaw rate"), ("m/s", "m/s", "rad/s"), velocity, self.command, strict=True
        ):
            series[f"velocity/{name} [{unit}]"] = actual
            series[f"velocity/{name}, commanded [{unit}]"] = commanded if walks else np.nan
        force = np.linalg.norm(sim.paw_force.numpy()[:, 0], axis=1)
        series |= {f"paw force/{leg} [N]": force[i] for i, leg in enumerate(LEGS)}
        torque = sim.torque.numpy()[:, 0]
        limit = self.env.parameters.motors.saturation.numpy()[:, 0]
        series |= {f"torque over limit/{name} [1]": torque[i] / limit[i] for i, name in enumerate(MOTOR_JOINTS)}
        for index, skill in enumerate(self.env.skills):
            values = skill.term_value.numpy()[:, 0] * (1.0 if index == self.skill else np.nan)
            names = [f"reward of {skill.task.name}/{term.name} [1]" for term in skill.task.rewards]
            series |= dict(zip(names, values, strict=False))
        return {name: float(value) for name, value in series.items()}

    def surface(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Return the height of the ground [m] at places x, y [m], (n,) each, world frame."""
        if self.field is None:
            return np.zeros(len(x))
        field = self.field
        heights = field.min_z + np.asarray(field.data).reshape(field.nrow, field.ncol) * (field.max_z - field.min_z)
        row = (y + field.hy) / (2.0 * field.hy) * (field.nrow - 1)
        column = (x + field.hx) / (2.0 * field.hx) * (field.ncol - 1)
        return map_coordinates(heights, [row, column], order=1, mode="nearest")

    def ground_point(self, origin: np.ndarray, direction: np.ndarray) -> np.ndarray | None:
        """Return the first point of the ground on a ray [m], (3,), world frame, within 2 mm; None: there is none."""
        points = origin + np.arange(0.0, 30.0, 0.002)[:, None] * direction / np.linalg.norm(direction)
        below = np.flatnonzero(points[:, 2] <= self.surface(points[:, 0], points[:, 1]))
        return points[below[0]] if len(below) else None


def load(source: str, agent: Agent, modules: Sequence[ModuleType] = ()) -> tuple[Recipe, Policy | None]:
    """Return the recipe and the policy of a source; agents other than "policy" have none.

    source: as in `Policy.load`; for other agents also a task's name, or a JSON file with a recipe. modules: the user's.
    Raises InputError, PolicyError, TaskError or CheckpointError: it cannot be used.
    """
    from jumper_warp.policies.policy import Policy

    if agent != "policy" and Path(source).suffix == ".json":
        return Recipe.from_json(read_json(Path(source), "recipe"), modules, complete=False), None
    if agent != "policy" and source in task_names():
        return Recipe.of(source), None
    policy = Policy.load(source)
    return policy.recipe(modules), policy if agent == "policy" else None
