"""The conditions that a policy is tried in, and the environment of a policy in them."""

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
"""[ms] A shorter one would become none."""


@dataclass(frozen=True)
class Conditions:
    """Conditions in which a policy is evaluated."""

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
        """Raises InputError: a value out of range, a latency of no step, or pushes in flight where there are none."""
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
        """Parameters that are neither nominal nor drawn."""
        given = {"latency": self.latency, "gains": self.gain_scale, "friction": self.friction}
        return {name: value for name, value in given.items() if value is not None}

    def overlay(self, config: dict[str, Any]) -> RobotOverlay | None:
        """Return the robot that a policy of this configuration is tried on; None: as described.

        Raises InputError or OSError: the overlay cannot be used.
        """
        if self.robot is not None:
            return load_overlay(self.robot)
        saved = config.get("env", {}).get("robot")
        return None if saved is None else RobotOverlay.from_json(saved)

    def env_settings(self, config: dict[str, Any]) -> dict[str, Any]:
        """Return settings of `Env`; config: of a policy, as in `overlay`, and raises as it."""
        same = {name: getattr(self, name) for name in ("seed", "device", "solver", "noise", "threads")}
        return {**same, "randomize": self.draws, "auto_reset": False, "robot": self.overlay(config)}

    @property
    def draws(self) -> bool:
        """Whether the environment sets parameters at resets."""
        return self.randomize or bool(self.fixed)

    def _with_fixed(self, ranges: RandomizationCfg) -> RandomizationCfg:
        return ranges.with_fixed(**self.fixed)

    def applied(self, task: TaskCfg) -> TaskCfg:
        """Return a task as it is tried in these conditions; pushes come and go, however its training had it."""
        task = (task if self.gravity is None else replace(task, gravity=self.gravity)).without_margins()
        trained = task.randomization
        if self.randomize:
            in_flight = trained.push_in_flight or self.push_in_flight
            drawn = replace(self._with_fixed(trained.in_tests()), push_in_flight=in_flight)
            return replace(task, randomization=drawn)
        if not self.fixed:
            return task
        nominal = RandomizationCfg.off().with_fixed(friction=trained.nominal_friction)
        return replace(task, randomization=self._with_fixed(nominal), events=()).on_level_ground()


def env_of_policy(
    policy: Policy,
    num_envs: int,
    conditions: Conditions,
    *,
    change: Callable[[TaskCfg], TaskCfg] | None = None,
    modules: Iterable[ModuleType] = (),
    **scene: Any,
) -> Env:
    """Return the environment that a policy was trained in, with other conditions.

    Without rewards, without what the critic sees, and unless randomised without events: so their functions need not be
    found, and are not run.

    policy: names the task in its configuration. change: returns the task that is wanted instead. modules: that the user
    has named, for tasks that are not the project's. scene: more settings of `Env`, such as its ground.
    Raises PolicyError: this version of the project cannot rebuild it, or its observation is not the policy's.
    """
    from jumper_warp.envs.env import Env

    leave_out = [section for section in OPTIONAL if section != "events" or not conditions.randomize]
    task = task_of_policy(policy, modules, leave_out=leave_out)
    task = conditions.applied(task if change is None else change(task))
    return Env(task, num_envs, **conditions.env_settings(policy.config), **scene)
