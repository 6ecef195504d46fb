"""Conditions in which policies are tested, and the environment of a policy in such conditions."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from jumper_warp.policies.spec import PolicyError
from jumper_warp.recipe import Recipe
from jumper_warp.robot.gravity import check_gravity
from jumper_warp.robot.overlay import RobotOverlay, load_overlay
from jumper_warp.tasks.cfg import TaskCfg
from jumper_warp.tasks.overlay_ranges import with_fixed_ranges
from jumper_warp.tasks.randomization import RandomizationCfg, fixed_ranges
from jumper_warp.tasks.saving import TaskError
from jumper_warp.utils.checks import check_flags, check_seed, check_type
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.files import Json
from jumper_warp.utils.progress import phase
from jumper_warp.utils.streams import purpose_seed

if TYPE_CHECKING:
    from jumper_warp.envs.env import Env


@dataclass(frozen=True)
class Conditions:
    """Conditions of a test: physics, randomisation, seed, and parameters with fixed values; see `env_of_recipe`."""

    solver: Literal["jumper", "mujoco"] = "jumper"  # Physics: the dedicated solver, or Newton's SolverMuJoCo
    randomize: bool = False  # Sample masses, friction, motors, latency and pushes as in training
    noise: bool = False  # Add the training's observation noise
    seed: int = 0  # Seed of randomisation and noise, 0 to 2147483647
    stream: Literal["tuning", "selection", "reporting"] = "reporting"
    """Purpose of the test. For any seeds, robots, commands and noise differ from those of other purposes."""
    device: str | None = None  # Warp device (default: a GPU if there is one)
    threads: int | None = None  # CPU threads (default: all cores); results do not depend on it
    robot: Path | None = None
    """Folder or name of a robot, or overlay, as `jumper sysid fit` writes it (default: the robot of the training)."""
    push_in_flight: bool = False  # In randomised tests, push the robot in flight too, not only while a paw is down
    latency: float | None = None
    """[ms] Latency from action to motor, rounded to a physics step (default: none, or sampled if randomised)."""
    gain_scale: tuple[float, float] | None = None
    """[1] Factors on kp and kd of all motors (default: 1, or sampled if randomised)."""
    friction: float | None = None
    """[1] Static and dynamic friction coefficient of the paws (default: nominal, or sampled if randomised)."""
    sensor_offset: float | None = None
    """[deg] Largest constant error of the motors' position sensors (default: none, or sampled if randomised)."""
    gravity: float | None = None  # [m/s^2] Gravity (default: the task's)

    def __post_init__(self) -> None:
        """Raise InputError if a value is out of range, or push_in_flight is set without randomize."""
        object.__setattr__(self, "seed", check_seed(self.seed))
        check_flags(randomize=self.randomize, noise=self.noise, push_in_flight=self.push_in_flight)
        check_type("latency", self.latency, float | None)
        check_type("gain_scale", self.gain_scale, Sequence[float] | None)
        check_type("sensor_offset", self.sensor_offset, float | None)
        if self.latency:
            from jumper_warp.robot.model import PHYSICS_DT

            shortest = 500.0 * PHYSICS_DT  # [ms] Half a physics step; a shorter latency would round to 0
            if 0.0 < self.latency < shortest:
                least = f"{shortest:.3g} ms, half a physics step"
                raise InputError(f"latency must be 0 or at least {least}, got {self.latency:g} ms")
        if self.gravity is not None:
            check_gravity(self.gravity)
        RandomizationCfg.off().with_fixed(**self.fixed_parameters)  # raises if a value is out of range
        if self.push_in_flight and not self.randomize:
            raise InputError("push_in_flight needs randomize: without it there are no pushes")

    @property
    def stream_seed(self) -> int:
        """Random seed of goals, headings and commands that are sampled on the host; see `purpose_seed`."""
        return purpose_seed(self.stream, self.seed)

    @property
    def fixed_parameters(self) -> Json:
        """Robot parameters with fixed values by name, as arguments of `RandomizationCfg.with_fixed`."""
        values = {
            "latency": self.latency,
            "gains": self.gain_scale,
            "friction": self.friction,
            "sensor_offset": self.sensor_offset,
        }
        return {name: value for name, value in values.items() if value is not None}

    def overlay(self, trained: RobotOverlay | None) -> RobotOverlay | None:
        """Return the robot overlay (values that differ from the description): from the file `robot`, else `trained`.

        None: the described robot. trained: of the training. Raises InputError or OSError: the file cannot be used.
        """
        return trained if self.robot is None else load_overlay(self.robot)

    def env_settings(self, trained: RobotOverlay | None) -> Json:
        """Return keyword arguments of `Env` for these conditions. Argument and errors: see `overlay`."""
        same = {name: getattr(self, name) for name in ("seed", "stream", "device", "solver", "noise", "threads")}
        fixed = fixed_ranges(**self.fixed_parameters)
        robot = with_fixed_ranges(self.overlay(trained), fixed, nominal=not self.randomize)
        return {**same, "randomize": self.sets_parameters, "auto_reset": False, "robot": robot}

    @property
    def sets_parameters(self) -> bool:
        """Whether the environment sets robot parameters at resets, to sampled or fixed values."""
        return self.randomize or bool(self.fixed_parameters)

    def applied(self, task: TaskCfg) -> TaskCfg:
        """Return a copy of a task with these conditions' gravity, randomisation and events, and collision margins 0 m.

        With fixed parameters and no randomisation it is on level ground, without the task's events.
        """
        gravity = task.gravity if self.gravity is None else self.gravity
        task = replace(task, gravity=gravity, self_collision_margin=0.0, obstacle_margin=0.0)
        trained = task.randomization
        if self.randomize:
            in_flight = trained.push_in_flight or self.push_in_flight
            randomization = replace(trained.in_tests().with_fixed(**self.fixed_parameters), push_in_flight=in_flight)
            return replace(task, randomization=randomization)
        if not self.fixed_parameters:
            return task
        nominal = RandomizationCfg.off().with_fixed(friction=trained.nominal_friction)
        return replace(task, randomization=nominal.with_fixed(**self.fixed_parameters), events=()).on_level_ground()


def shared_robot(robots: Mapping[str, RobotOverlay | None], conditions: Conditions) -> RobotOverlay | None:
    """Return the robot overlay (changed robot values) that applies to several policies; None: the described robot.

    robots: overlays of the trainings by name of the policy. One line on standard error names policies of the described
    robot that get the overlay of another one. The overlay of `conditions` replaces all of these.
    Raises PolicyError: policies were trained with different robots or overlays.
    """
    saved = {name: overlay.to_json() for name, overlay in robots.items() if overlay is not None}
    if conditions.robot is not None or not saved:
        return None
    first, *others = saved
    for other in others:
        if any(saved[other].get(key) != saved[first].get(key) for key in ("robot", "values", "randomization")):
            raise PolicyError(f"{first} and {other} were trained with different robots: choose one with --robot FILE")
    if without := [name for name in robots if name not in saved]:
        described = f"{' and '.join(without)} {'were' if len(without) > 1 else 'was'} trained without"
        print(f"jumper: the robot has the overlay of {first}; {described}", file=sys.stderr)
    return robots[first]


def evaluated_task(recipe: Recipe, randomize: bool, rewards: bool = False) -> TaskCfg:
    """Return a recipe's task for a test: without critic, with rewards only if asked for, with events if randomised.

    Raises TaskError: events are needed, and their functions were not found.
    """
    if randomize and recipe.missing:
        raise TaskError(recipe.missing)
    task = recipe.task if rewards else replace(recipe.task, rewards=())
    events = task.events if randomize else ()
    return replace(task, observations=replace(task.observations, critic=()), events=events)


def env_of_recipe(
    recipe: Recipe,
    num_envs: int,
    conditions: Conditions,
    *,
    change: Callable[[TaskCfg], TaskCfg] | None = None,
    rewards: bool = False,
    **scene: Any,
) -> Env:
    """Return the environment of a recipe's task in the given test conditions.

    It has no critic observation, and events only if randomised.
    change: returns a modified task before the conditions are applied. rewards: whether it has the task's rewards.
    scene: further arguments of `Env`.
    Raises TaskError: an event is needed, and its function was not found.
    """
    from jumper_warp.envs.env import Env

    task = evaluated_task(recipe, conditions.randomize, rewards)
    task = conditions.applied(task if change is None else change(task))
    with phase(f"building {num_envs} robots"):
        return Env(task, num_envs, **conditions.env_settings(recipe.robot) | scene)
