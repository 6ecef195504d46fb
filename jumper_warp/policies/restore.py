"""Reading back what a policy or a training run was made with: its task, its environment, its weights.

Configurations are data: functions are looked up in the project's modules and in those that the user has named.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any, Literal

from jumper_warp.envs.vec_env import RAW_LIMIT
from jumper_warp.policies.folder import load_policy
from jumper_warp.policies.legacy import upgraded
from jumper_warp.policies.policy import Policy
from jumper_warp.policies.spec import PolicyError, make_interface
from jumper_warp.rl.checkpoint import (
    DAMAGE,
    CheckpointError,
    best_checkpoint,
    latest_checkpoint,
    load_checkpoint,
    one_line,
)
from jumper_warp.rl.mirror import Symmetry, image, plain_layers
from jumper_warp.rl.networks import EPS, NORMALISED_LIMIT
from jumper_warp.robot.gravity import check_gravity
from jumper_warp.robot.model import PHYSICS_DT
from jumper_warp.robot.overlay import RobotOverlay, load_overlay
from jumper_warp.tasks.cfg import Handover, TaskCfg
from jumper_warp.tasks.interface import interface
from jumper_warp.tasks.randomization import RandomizationCfg
from jumper_warp.tasks.saving import OPTIONAL, TaskError, handover_from_json, task_from_json
from jumper_warp.utils.checks import check_seed
from jumper_warp.utils.errors import InputError

if TYPE_CHECKING:
    import torch

    from jumper_warp.envs.env import Env

CHECKPOINTS = "checkpoints"
METRICS = "metrics.jsonl"
SHORTEST_LATENCY = 500.0 * PHYSICS_DT
"""[ms] A shorter one would become none."""


@dataclass(frozen=True)
class Conditions:
    """What a policy is tried in."""

    solver: Literal["jumper", "mujoco"] = "jumper"
    """Physics: the dedicated solver, or Newton's SolverMuJoCo."""
    randomize: bool = False
    """Draw masses, friction, motors, latency and pushes as in training."""
    noise: bool = False
    """Add the training's observation noise."""
    seed: int = 0
    """Of randomisation and noise, 0 to 2147483647."""
    device: str | None = None
    """Warp device (default: a GPU if there is one)."""
    threads: int | None = None
    """CPU threads that share the worlds (default: all cores); they change no result."""
    robot: Path | None = None
    """Robot overlay, as `jumper sysid` writes it (default: that of the training, if it had one)."""
    push_in_flight: bool = False
    """Pushes of a randomised test act in flight too, and not only while a paw is down."""
    latency: float | None = None
    """[ms] From action to motor, to the nearest physics step (default: none, or drawn if randomised)."""
    gains: tuple[float, float] | None = None
    """[1] Scales of kp and kd of all motors (default: 1, or drawn if randomised)."""
    friction: float | None = None
    """[1] Of the paws, static and dynamic (default: nominal, or drawn if randomised)."""
    gravity: float | None = None
    """[m/s^2] Downward (default: that of the task)."""

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
        given = {name: getattr(self, name) for name in ("latency", "gains", "friction")}
        return {name: value for name, value in given.items() if value is not None}

    def overlay(self, config: dict[str, Any]) -> RobotOverlay | None:
        """Return the robot that a policy of this configuration is tried on; None: as described.

        Raises InputError or OSError: the overlay cannot be used.
        """
        if self.robot is not None:
            return load_overlay(self.robot)
        saved = config.get("env", {}).get("robot")
        return None if saved is None else RobotOverlay.from_json(saved)

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


def is_run(source: str | Path) -> bool:
    """Return whether this is a training run's folder or a checkpoint."""
    source = Path(source)
    return source.suffix == ".pt" or (source / CHECKPOINTS).is_dir()


def open_policy(source: str | Path, *, newest: bool = False) -> Policy:
    """Return a policy by name or folder, or that of a run's best (or newest) checkpoint or of a checkpoint.

    Raises:
        PolicyError: There is none, or it cannot be used.
        CheckpointError: The checkpoint cannot be used.
    """
    if not is_run(source):
        return load_policy(source)
    source = Path(source)
    if source.suffix == ".pt":
        return _policy_of_checkpoint(source, load_checkpoint(source))
    folder = source / CHECKPOINTS
    if newest:
        path, state, _ = latest_checkpoint(folder)
        return _policy_of_checkpoint(path, state)
    path = best_checkpoint(folder)
    return _policy_of_checkpoint(path, load_checkpoint(path))


def _policy_of_checkpoint(path: Path, state: dict[str, Any]) -> Policy:
    """Return the actor of a checkpoint with the interface that its configuration describes."""
    try:
        config = json.loads(state["config"])
        env, ppo = config["env"], config["train"]["ppo"]
        model = state["ppo"]["model"]
        names = [key for key in model if key.startswith("actor.") and key.endswith(".weight")]
        names.sort(key=lambda key: int(key.split(".")[1]))
        layers = [(model[name], model[name.removesuffix("weight") + "bias"]) for name in names]
        mean = model["obs_moments.mean"].float()
        std = (model["obs_moments.var"] + EPS).sqrt().float()
        times = {"policy_dt": env["policy_dt_s"], "physics_dt": env["physics_dt_s"]}
        shape = {"hidden": tuple(ppo["hidden"]), "activation": ppo["activation"]}
        if symmetry := _symmetry(model):
            layers, shape["hidden"] = plain_layers(layers, symmetry), tuple(2 * width for width in ppo["hidden"])
        commit = config.get("commit") or {"hash": None, "dirty": None}
        config |= {"commit": commit["hash"], "dirty": commit["dirty"], "iteration": state["iteration"]}
    except DAMAGE as error:
        raise _no_training(path, error) from error
    try:
        described = env["interface"] if "interface" in env else interface(restored_task(config))
        face = make_interface(described, **times, **shape)
        face = dataclasses.replace(face, observation_limit=RAW_LIMIT, normalised_limit=NORMALISED_LIMIT)
        return Policy(layers, mean, std, face, config)
    except PolicyError as error:
        raise PolicyError(f"{path}: {error}") from error
    except DAMAGE as error:
        raise _no_training(path, error) from error


def _symmetry(model: dict[str, torch.Tensor]) -> Symmetry | None:
    """Return the symmetry of a checkpoint's actor, if it has one by its form."""
    if not any(name.startswith("mirror_") for name in model):
        return None
    parts = ((model[f"mirror_{name}_order"], model[f"mirror_{name}_signs"], name) for name in Symmetry._fields)
    return Symmetry(*(image(*part) for part in parts))


def _no_training(path: Path, error: Exception) -> CheckpointError:
    return CheckpointError(f"{path}: not of a training of this project ({type(error).__name__}: {one_line(error)})")


def learning_curve(source: Path) -> bytes | None:
    """Return the logged figures of a run or of a checkpoint's run, one JSON object a line; None if there are none."""
    run = source.parents[1] if source.suffix == ".pt" else source
    path = run / METRICS
    return path.read_bytes() if path.is_file() else None


def restored_task(
    config: dict[str, Any], modules: Iterable[ModuleType] = (), *, leave_out: Collection[str] = OPTIONAL
) -> TaskCfg:
    """Return the task of a saved configuration, from its entry `env` (`Env.config`).

    Args:
        config: What a policy or a run was made with.
        modules: That the user has named; functions that are not the project's are looked up there.
        leave_out: Sections that are not wanted, and whose functions need not be found; by default all that only a
            training needs.

    Raises:
        PolicyError: The configuration is not of a task that is known here.
    """
    try:
        saved = config["env"]["task"]
    except (KeyError, TypeError) as error:
        raise PolicyError(f"no task in the configuration ({type(error).__name__}: {error})") from error
    try:
        if isinstance(saved, dict) and "version" not in saved:
            saved = upgraded(saved | {"terms": []} if "rewards" in leave_out else saved)
        return task_from_json(saved, modules, leave_out=leave_out)
    except TaskError as error:
        raise PolicyError(f"task in the configuration: {error}") from error


def restored_skills(config: dict[str, Any], modules: Iterable[ModuleType] = ()) -> tuple[list[TaskCfg], list[Handover]]:
    """Return all tasks and handovers of an environment's saved configuration (`Env.config`).

    modules: that the user has named. Raises PolicyError: it is not of tasks and functions that are known here.
    """
    modules = list(modules)
    try:
        tasks = [task_from_json(saved, modules) for saved in config.get("tasks", [config["task"]])]
        return tasks, [handover_from_json(saved, tasks, modules) for saved in config.get("handovers", [])]
    except TaskError as error:
        raise PolicyError(f"tasks in the configuration: {error}") from error
    except (LookupError, TypeError, AttributeError) as error:
        raise PolicyError(f"no tasks in the configuration ({type(error).__name__}: {error})") from error


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

    Args:
        policy: Its configuration tells the task.
        num_envs: Number of worlds.
        conditions: Physics, randomisation and noise.
        change: Returns the task that is wanted instead.
        modules: That the user has named, for tasks that are not the project's.
        scene: More settings of `Env`, such as its ground.

    Raises:
        PolicyError: This version of the project cannot rebuild it, or its observation is not the policy's.
    """
    from jumper_warp.envs.env import Env

    leave_out = [section for section in OPTIONAL if section != "events" or not conditions.randomize]
    task = restored_task(policy.config, modules, leave_out=leave_out)
    if task.observation_names != policy.interface.observation_names:
        raise PolicyError("the policy's observation is not the one that this version of its task gives")
    return Env(
        conditions.applied(task if change is None else change(task)),
        num_envs,
        seed=conditions.seed,
        device=conditions.device,
        solver=conditions.solver,
        randomize=conditions.draws,
        noise=conditions.noise,
        auto_reset=False,
        robot=conditions.overlay(policy.config),
        **scene,
    )
