"""Test conditions of a policy, and the environment of a policy in these conditions."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any, Literal

from jumper_warp.policies.policy import Policy
from jumper_warp.policies.restore import task_of_policy
from jumper_warp.robot.gravity import check_gravity
from jumper_warp.robot.model import PHYSICS_DT
from jumper_warp.robot.overlay import RobotOverlay, load_overlay
from jumper_warp.tasks.cfg import TaskCfg
from jumper_warp.tasks.randomization import RandomizationCfg
from jumper_warp.tasks.saving import OPTIONAL
from jumper_warp.utils.checks import check_seed
from jumper_warp.utils.errors import InputError

if TYPE_CHECKING:
    from jumper_warp.envs.env import Env

SHORTEST_LATENCY = 500.0 * PHYSICS_DT
"""[ms] Half a physics step; a shorter latency would be rounded to 0."""


@dataclass(frozen=True)
class Conditions:
    """Test conditions of a policy."""

    solver: Literal["jumper", "mujoco"] = "jumper"
    """Physics: the dedicated solver, or Newton's SolverMuJoCo."""
    randomize: bool = False
    """Draw masses, friction, motors, latency and pushes as in training."""
    noise: bool = False
    """Add the training's observation noise."""
    seed: int = 0
    """Seed of randomisation and noise, 0 to 2147483647."""
    device: str | None = None
    """Warp device (default: a GPU if there is one)."""
    threads: int | None = None
    """CPU threads that share the worlds (default: all cores); they change no result."""
    robot: Path | None = None
    """Robot overlay, as `jumper sysid` writes it (default: that of the training, if it had one)."""
    push_in_flight: bool = False
    """Pushes of a randomised test act in flight too, and not only while a paw is down."""
    latency: float | None = None
    """[ms] Latency from action to motor, to the nearest physics step (default: none, or drawn if randomised)."""
    gain_scale: tuple[float, float] | None = None
    """[1] Scales of kp and kd of all motors (default: 1, or drawn if randomised)."""
    friction: float | None = None
    """[1] Friction of the paws, static and dynamic (default: nominal, or drawn if randomised)."""
    gravity: float | None = None
    """[m/s^2] Gravity, downward (default: the task's)."""

    def __post_init__(self) -> None:
        """Raise InputError if a value is out of range, or push_in_flight is set without randomize."""
        check_seed(self.seed)
        if self.latency is not None and 0.0 < self.latency < SHORTEST_LATENCY:
            least = f"{SHORTEST_LATENCY:.3g} ms, half a physics step"
            raise InputError(f"latency must be 0 or at least {least}, got {self.latency:g} ms")
        if self.gravity is not None:
            check_gravity(self.gravity)
        self._with_fixed(RandomizationCfg.off())
        if self.push_in_flight and not self.randomize:
            raise InputError("push_in_flight needs randomize: without it there are no pushes")

    @property
    def fixed(self) -> dict[str, Any]:
        """Parameters with a value given here, which are neither nominal nor randomised."""
        values = {"latency": self.latency, "gains": self.gain_scale, "friction": self.friction}
        return {name: value for name, value in values.items() if value is not None}

    def overlay(self, config: dict[str, Any]) -> RobotOverlay | None:
        """Return the robot overlay: the one given here, else the one that `config` saves; None for the nominal robot.

        config: configuration of a policy. Raises InputError or OSError: the overlay cannot be used.
        """
        if self.robot is not None:
            return load_overlay(self.robot)
        saved = config.get("env", {}).get("robot")
        return None if saved is None else RobotOverlay.from_json(saved)

    def env_settings(self, config: dict[str, Any]) -> dict[str, Any]:
        """Return keyword arguments of `Env`. Argument and errors as for `overlay`."""
        same = {name: getattr(self, name) for name in ("seed", "device", "solver", "noise", "threads")}
        return {**same, "randomize": self.draws, "auto_reset": False, "robot": self.overlay(config)}

    @property
    def draws(self) -> bool:
        """Whether the environment sets robot parameters at resets."""
        return self.randomize or bool(self.fixed)

    def _with_fixed(self, ranges: RandomizationCfg) -> RandomizationCfg:
        """Return randomisation ranges with the `fixed` parameters set to their value."""
        return ranges.with_fixed(**self.fixed)

    def applied(self, task: TaskCfg) -> TaskCfg:
        """Return a task with these conditions applied to its gravity, randomisation and events."""
        task = (task if self.gravity is None else replace(task, gravity=self.gravity)).without_margins()
        trained = task.randomization
        if self.randomize:
            in_flight = trained.push_in_flight or self.push_in_flight
            randomization = replace(self._with_fixed(trained.in_tests()), push_in_flight=in_flight)
            return replace(task, randomization=randomization)
        if not self.fixed:
            return task
        nominal = RandomizationCfg.off().with_fixed(friction=trained.nominal_friction)
        return replace(task, randomization=self._with_fixed(nominal), events=()).on_level_ground()


def env_of_policy(
    policy: Policy, num_envs: int, conditions: Conditions, *, change: Callable[[TaskCfg], TaskCfg] | None = None,
    modules: Iterable[ModuleType] = (), **scene: Any,
) -> Env:  # fmt: skip
    """Return the environment of a policy's task in some test conditions.

    It has no rewards, no critic observation, and events only if randomised, so that their functions are not needed.

    policy: its configuration holds the task. change: modifies the task, if given. modules: user modules with functions
    of the task. scene: more arguments of `Env`, such as its ground.
    Raises PolicyError: the task cannot be restored, or its observation is not the policy's.
    """
    from jumper_warp.envs.env import Env

    leave_out = [section for section in OPTIONAL if section != "events" or not conditions.randomize]
    task = task_of_policy(policy, modules, leave_out=leave_out)
    task = conditions.applied(task if change is None else change(task))
    return Env(task, num_envs, **conditions.env_settings(policy.config), **scene)
