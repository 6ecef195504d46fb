"""Evaluation of a policy: its environment, recorded runs of episodes, and the report of their metrics.

`evaluate` is the command `jumper evaluate`; experiments and `jumper play` use the classes.
"""

from __future__ import annotations

import sys
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import astuple, dataclass, field
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Annotated, Any, Generic, Self, TypeVar

import numpy as np
import tyro

from jumper_warp.evaluation.conditions import Conditions, env_of_recipe, evaluated_task, shared_robot
from jumper_warp.evaluation.log import EvaluationLog, check, run_evaluation
from jumper_warp.evaluation.recorder import EnvRecorder, save_recording
from jumper_warp.evaluation.skills import WALK, SkillNames
from jumper_warp.evaluation.trained import trained_range, trained_success
from jumper_warp.policies.catalog import add_files, find_policy, is_run
from jumper_warp.policies.spec import PolicyError
from jumper_warp.registry import TASKS
from jumper_warp.robot.overlay import RobotOverlay
from jumper_warp.robot.values import TRANSVERSAL
from jumper_warp.tasks.cfg import TaskCfg
from jumper_warp.tasks.evaluation import Evaluation
from jumper_warp.tasks.jump.evaluation import HeightEvaluation, PlaceEvaluation
from jumper_warp.tasks.overlay_ranges import range_words
from jumper_warp.tasks.switching import skills_and_handovers
from jumper_warp.tasks.velocity.cfg import VelocityEvaluation
from jumper_warp.utils.arrays import write_npz
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.files import Json
from jumper_warp.utils.metrics import AnyMetrics, Metrics, MetricValue
from jumper_warp.utils.output import Report, output_dir, write_metrics
from jumper_warp.utils.runtime import configure_device
from jumper_warp.utils.summary import PrintFlags, print_summary
from jumper_warp.utils.threads import checked_threads

if TYPE_CHECKING:
    import torch

    from jumper_warp.envs.env import Env

HEADLINES = (
    "success_rate", "within_training_success_rate", "beyond_training_success_rate", "goal_reached_rate",
    "apex_error_abs_mean_m", "goal_distance_at_rest_mean_m", "slewed_rmse_vx_m_s", "slewed_rmse_vy_m_s",
    "slewed_rmse_yaw_rate_rad_s", "settled_without_collision_rate", "settling_time_mean_s",
    "success_termination_rate", "failure_termination_rate", "ended_by_", "length_mean_s", "no_jump_rate",
    "at_rest_rate", "no_paw_lift_rate", "second_takeoff_rate", "fall_rate",
)  # fmt: skip
"""Keys of the metrics in a summary, unless an evaluation has its own; `ended_by_`: all keys that begin with it."""
MOST_ENDS = 6  # Largest number of terminations in a summary, the most frequent ones
SOLVER_TITLES = {"jumper": "SolverJumper", "mujoco": "SolverMuJoCo"}  # By value of `Conditions.solver`
Log = TypeVar("Log", bound=EvaluationLog)
Flags = TypeVar("Flags")


@dataclass(frozen=True)
class EvaluationArgs(Conditions, PrintFlags):
    """Common flags of experiments that evaluate a policy; randomised robots also have observation noise."""

    noise: tyro.conf.Suppress[tyro.conf.Fixed[bool]] = False
    policy: str = "horizontal_jump"  # Name or folder of a policy, a run's folder, or a checkpoint
    num_recorded: int = 1  # Number of jumps to record for the Rerun viewer and, one of them, as a picture; 0: none
    save_trials: bool = False  # Write the arrays of all trials, from which the metrics are computed, to trials.npz
    out: Path | None = None  # Folder for metrics, plots, pictures and recordings (default: outputs/<name>/<time>)

    def __post_init__(self) -> None:
        """Raise InputError for invalid conditions, numbers of threads or of recorded worlds."""
        object.__setattr__(self, "noise", self.randomize)
        super().__post_init__()
        check(self.num_recorded >= 0, f"num_recorded must not be negative, got {self.num_recorded}")
        checked_threads(self.threads)


class Run(ABC):
    """Base class of evaluations: runs and records episodes, reports metrics; subclasses define `actor`, the policy."""

    folder: Path  # Output folder, set by `prepare`
    trained_robot: RobotOverlay | None = None  # Robot of the policy's training; None: the Jumper, or several policies
    source: str | Path = "several policies"  # Name or folder of a policy, a run's folder, or a checkpoint

    def __init__(self) -> None:
        """Start the clock of the report; call `prepare` before any other method."""
        from jumper_warp.robot.model import PHYSICS_DT

        self.started = time.perf_counter()
        self.conditions = Conditions()  # Conditions of all episodes
        self.record = 0  # Number of worlds to record
        self.save_trials = False  # Whether `run_episodes` writes trials.npz
        self.name = ""  # Name of the evaluation
        self.print_flags = PrintFlags()  # Selects what `report` prints
        self._announced = ""  # Name of the robot that was announced as another one than that of the training
        self.settings: Json = {}  # Settings of task, robot and test, reported with the conditions
        self._ranges: list[str] = []  # Ranges of randomisation that the robot overlay changes, as text
        self._latency: list[np.ndarray] = []  # [physics steps] (num_envs,) per `run_episodes`
        self._physics_dt = PHYSICS_DT

    def prepare_from(self, name: str, args: EvaluationArgs) -> Self:
        """Set the conditions and create the output folder from an experiment's flags, and return the run itself.

        name: of the output folder, see `prepare`.
        """
        self.prepare(name, args, args.out, record=args.num_recorded, save_trials=args.save_trials)
        self.print_flags = args
        return self

    @abstractmethod
    def actor(self, env: Env) -> Callable[[torch.Tensor], torch.Tensor]:
        """Return the policy as a function from observations (num_envs, num_obs) to actions, see `run_evaluation`."""

    def prepare(
        self, name: str, conditions: Conditions, out: Path | None = None, *, record: int = 0, save_trials: bool = False
    ) -> None:
        """Set the conditions, select the device and create the output folder, before the simulation.

        name: of the folder outputs/<name>/<time>, unless `out` is passed; record: number of worlds to record;
        save_trials: whether to write trials.npz.
        Raises InputError: no such device or number of threads; OSError: the folder cannot be created.
        """
        configure_device(conditions.device, conditions.threads)
        self.conditions = conditions
        self.record = record
        self.save_trials = save_trials
        self.name = name
        self.folder = output_dir(name, out)

    @property
    def title(self) -> str:
        """Description of solver, robots and changed conditions, separated by commas, for tables and plots."""
        conditions = self.conditions
        words = [SOLVER_TITLES[conditions.solver], "randomised" if conditions.randomize else "nominal"]
        if conditions.latency is not None and self._latency:
            words.append(f"latency {latency_text(self._latency[0], self._physics_dt)}")
        words += [] if conditions.gain_scale is None else ["kp × {:g}, kd × {:g}".format(*conditions.gain_scale)]
        words += [] if conditions.friction is None else [f"friction {conditions.friction:g}"]
        words += [] if conditions.sensor_offset is None else [f"sensors ± {conditions.sensor_offset:g}°"]
        words += [] if conditions.gravity is None else [f"gravity {conditions.gravity:g} m/s²"]
        words += [] if conditions.robot is None else [f"robot of {conditions.robot.name}"]
        words += [f"robot {self.settings['robot']}"] if "robot" in self.settings else []
        return ", ".join(words + (["pushed in flight too"] if conditions.push_in_flight else []))

    @property
    def condition_values(self) -> Json:
        """Conditions of the evaluation by name, without unset ones; with the latencies of the episodes so far."""
        conditions = self.conditions
        values = {**self.settings}
        values |= {name: getattr(conditions, name) for name in ("solver", "randomize", "noise", "seed", "stream")}
        if conditions.randomize:
            values["push_in_flight"] = conditions.push_in_flight
        values |= {} if conditions.gain_scale is None else {"gains": list(conditions.gain_scale)}
        values |= {} if conditions.friction is None else {"friction": conditions.friction}
        values |= {} if conditions.sensor_offset is None else {"sensor_offset_deg": conditions.sensor_offset}
        values |= {} if conditions.robot is None else {"robot": str(conditions.robot)}
        if self._latency:
            steps = np.concatenate(self._latency)
            values |= {} if conditions.latency is None else {"latency_requested_ms": conditions.latency}
            values["latency_ms"] = 1000.0 * self._physics_dt * float(np.mean(steps))
            values["latency"] = latency_text(steps, self._physics_dt)
        return values

    def note_robot(self, env: Env) -> None:
        """Store gravity, robot overlay (values of one robot) and randomisation ranges of an environment."""
        self.settings["gravity_m_s2"] = env.task.gravity
        trained, robot = (self.trained_robot or RobotOverlay({})).description, env.sim.descriptions[0]
        if robot.name not in (trained.name, self._announced):
            self._announced = robot.name
            print(f"jumper: {self.source} was trained on {trained.name}; the robot is {robot.name}", file=sys.stderr)
        if env.overlay is None:
            return
        if self.conditions.robot is None:
            self.settings["robot"] = f"of the training{env.overlay.source and f' ({env.overlay.source:.60})'}"
        if self.conditions.randomize:
            self._ranges = range_words(env.task, env.overlay, changed=True)
            self.settings["ranges"] = range_words(env.task, env.overlay)

    def run_episodes(
        self,
        env: Env,
        log: Log,
        *,
        film: str = "",
        film_scene: Mapping[str, Any] | None = None,
        on_step: Callable[[Log], None] | None = None,
    ) -> Log:
        """Run one episode per world with the commands of a log, and return the log.

        film: name of the recording and picture of `record` evenly spaced worlds; empty: none. film_scene: the
        environment's `ground` and `block` for the recording. on_step: called with the log after every policy step.
        """
        recorder = None
        scene = film_scene or {}
        if film and self.record:
            worlds = np.linspace(0, env.num_envs - 1, min(self.record, env.num_envs)).round().astype(int).tolist()
            recorder = EnvRecorder(env, log, worlds, ground=scene.get("ground", "plane"), block=scene.get("block"))

        def after_step() -> None:
            """Call the caller's hook and the recorder, if any, after a policy step."""
            if on_step is not None:
                on_step(log)
            if recorder is not None:
                recorder()

        run_evaluation(self.actor(env), env, log, on_step=after_step)
        self._latency.append(env.parameters.latency.numpy().copy())
        self._physics_dt = env.physics_dt
        if self.save_trials:
            write_trials(self.folder, log, len(self._latency))
        if recorder is not None:
            save_recording(recorder.recording(), self.folder, film)
        return log

    def write(self, metrics: AnyMetrics) -> Report:
        """Write conditions and metrics to `metrics.json`, and return both."""
        return write_metrics(self.folder, metrics, self.condition_values)

    def summarise(self, report: Report, count: str, keys: Iterable[str], **settings: Any) -> None:
        """Print a summary of a report; count: number and kind of trials; settings: see `print_summary`."""
        name = self.name.replace("_", " ")
        count = f"{count}, " if count else ""
        seconds = time.perf_counter() - self.started
        what = f"{self.source}, {name}: {count}{self.title}"
        what += f"; ranges of this robot: {', '.join(self._ranges)}" if self._ranges else ""
        print_summary(report, what, keys, flags=self.print_flags, seconds=seconds, **settings)

    def report(self, metrics: Metrics, paper: Mapping[str, float], keys: Sequence[str] = HEADLINES) -> Json:
        """Write all metrics to `metrics.json`, print those with the given keys, and return all values by name."""
        written = self.write(metrics)
        ends = [key for key in metrics if key.startswith("ended_by_")]
        ends = sorted(ends, key=lambda key: metrics[key].value or 0.0, reverse=True)[:MOST_ENDS]  # pyright: ignore
        keys = [key for name in keys for key in (ends if name == "ended_by_" else [name])]
        printed = [metrics[key] for key in keys if key in metrics]
        most = max(printed, key=lambda metric: metric.trials or 0, default=MetricValue(None))
        over = most.over.removesuffix("s") if most.over and most.trials == 1 else most.over
        self.summarise(written, f"{most.trials:,} {over}" if most.trials else "", keys, paper=paper)
        return written.values


class EvaluationRun(Run):
    """Evaluation of one policy in its task."""

    def __init__(self, source: str | Path, modules: Iterable[ModuleType] = ()) -> None:
        """Load a policy; call `prepare` before any other method.

        source: name or folder of a policy, a run's folder, or a checkpoint; modules: the user's task modules.
        Raises PolicyError, TaskError or CheckpointError.
        """
        super().__init__()
        from jumper_warp.policies.policy import Policy

        self.policy = Policy.load(source)
        self.source = self.policy.source
        self.recipe = self.policy.recipe(modules)
        self.task = self.recipe.task
        self.trained_robot = self.recipe.robot
        self.evaluation = self.task.evaluation
        self.settings = {"task": self.task.name, **trained_range(self.task)}

    @classmethod
    def from_args(
        cls,
        name: str,
        args: EvaluationArgs,
        kind: type[Evaluation] = PlaceEvaluation,
        modules: Iterable[ModuleType] = (),
    ) -> EvaluationRun:
        """Return a prepared evaluation of the policy `args.policy` with the flags of an experiment.

        name: of the output folder; kind: class of the task's evaluation, else PolicyError; modules: the user's task
        modules. Also raises the errors of the constructor and `prepare`.
        """
        run = cls(args.policy, modules)
        if not isinstance(run.evaluation, kind):
            found = f"{args.policy} (task {run.task.name}) has a {type(run.evaluation).__name__}"
            raise PolicyError(f"expected a policy of a task with a {kind.__name__}, {found}")
        return run.prepare_from(name, args)

    def actor(self, env: Env) -> Callable[[torch.Tensor], torch.Tensor]:
        """Return the policy's function from observations to actions, `Policy.act`."""
        return self.policy.act

    def env(
        self,
        count: int,
        change: Callable[[TaskCfg], TaskCfg] | None = None,
        conditions: Conditions | None = None,
        **scene: Any,
    ) -> Env:
        """Return an environment of the policy's task with `count` worlds. Raises TaskError, see `env_of_recipe`.

        change: function that returns the task with other terminations (default: `Evaluation.prepare_task`); conditions:
        replace the run's; scene: further arguments of `Env`, such as `ground` or `block`.
        """
        change = change or self.evaluation.prepare_task
        conditions = conditions or self.conditions
        env = env_of_recipe(self.recipe, count, conditions, change=change, **scene)
        self.policy.to(env.device)
        self.settings["torque_limit_nm"] = torque_limit(env)
        self.note_robot(env)
        return env


@dataclass(frozen=True)
class EvaluateCfg(Generic[Flags]):
    """Measure a policy over many trials, print its metrics and write metrics.json."""

    flags: Annotated[Flags, tyro.conf.arg(name="")]
    """Flags of the task's kind, see `jumper_warp.tasks.evaluation.Evaluation.flags`."""
    conditions: Annotated[Conditions, tyro.conf.arg(name="")] = field(default_factory=Conditions)
    """Conditions of the evaluation."""
    out: Path | None = None  # Folder for metrics.json (default: outputs/evaluate/<time>)
    printing: Annotated[PrintFlags, tyro.conf.arg(name="")] = field(default_factory=PrintFlags)
    """Format of the printed results."""
    save_trials: bool = False  # Also write the arrays of all trials, from which the metrics are computed, to trials.npz
    save_to_policy: bool = False  # Also save the metrics into the policy's folder


def evaluate(run: EvaluationRun, cfg: EvaluateCfg) -> Json:
    """Evaluate a policy, write `metrics.json`, print a summary, and return conditions and metrics by name.

    Raises PolicyError: unusable policy, or `save_to_policy` for a run; InputError: `save_to_policy` for another stream
    than reporting; OSError: the folder cannot be created.
    """
    if cfg.save_to_policy and cfg.conditions.stream != "reporting":
        raise InputError(f"save_to_policy is for the stream reporting, got {cfg.conditions.stream}")
    if cfg.save_to_policy and is_run(run.source):
        raise PolicyError(f"{run.source}: a run keeps no metrics; export it first")
    run.print_flags = cfg.printing
    run.prepare("evaluate", cfg.conditions, cfg.out, save_trials=cfg.save_trials)
    log = cfg.flags.log(run.evaluation.prepare_task(run.task), cfg.conditions.stream_seed)
    run.run_episodes(run.env(log.count), log)
    metrics = cfg.flags.metrics(log) | trained_success(run.task, log)
    entry = TASKS.get(run.task.name)
    paper = run.evaluation.paper if entry and entry.of_project else {}
    values = run.report(metrics, paper, (*HEADLINES, *log.main_metrics))
    if cfg.save_to_policy:
        files = {name: (run.folder / name).read_bytes() for name in ("metrics.json", "run.json")}
        add_files(find_policy(run.source), files)
    return values


class SkillRun(Run):
    """Evaluation of three policies (WALK, JUMP_UP, JUMP_TO) on one robot, which switches between them.

    policies, recipes, tasks: of the skills. skills: tasks in the conditions of the last `env`.
    """

    def __init__(self, names: SkillNames | None = None) -> None:
        """Load the policies; call `prepare` before any other method.

        Raises PolicyError or CheckpointError: one cannot be used, or is for another kind of skill.
        """
        super().__init__()
        from jumper_warp.policies.policy import Policy

        self.names = astuple(names or SkillNames())
        self.policies = [Policy.load(name) for name in self.names]
        self.recipes = [policy.recipe() for policy in self.policies]
        self.tasks = [evaluated_task(recipe, randomize=False) for recipe in self.recipes]
        self.skills = self.tasks
        for task, kind in zip(self.tasks, (VelocityEvaluation, HeightEvaluation, PlaceEvaluation), strict=True):
            if not isinstance(task.evaluation, kind):
                raise PolicyError(f"expected a policy of a task with a {kind.__name__}, got one of {task.name}")

    def actor(self, env: Env) -> Callable[[torch.Tensor], torch.Tensor]:
        """Return a function that computes the actions of all skills, (skills, num_envs, 12), from the state of `env`.

        Its argument is ignored: every skill reads its own observation of `env`.
        """
        import torch

        pairs = list(zip(self.policies, env.skills, strict=True))
        return lambda obs: torch.stack([policy.act(skill.obs["actor"]) for policy, skill in pairs])

    def env(self, count: int, **scene: Any) -> Env:
        """Return an environment of `count` robots that start with WALK, and move the policies to its device.

        The robot has the overlay (changed parameters) of the policies' training. scene: further arguments of `Env`,
        e.g. `block`. Raises PolicyError: the policies have different overlays; InputError: the tasks do not fit.
        """
        from jumper_warp.envs.env import Env

        walk, *jumps = (self.conditions.applied(task) for task in self.tasks)
        self.skills, handovers = skills_and_handovers(walk, tuple(jumps))
        robots = {name: recipe.robot for name, recipe in zip(self.names, self.recipes, strict=True)}
        settings = self.conditions.env_settings(shared_robot(robots, self.conditions))
        env = Env(self.skills, count, skill=WALK, handovers=handovers, **settings, **scene)
        for policy in self.policies:
            policy.to(env.device)
        self.note_robot(env)
        return env


def write_trials(folder: Path, log: EvaluationLog, number: int) -> None:
    """Write the columns of a log as arrays (trials,) to trials.npz; number: of the test in the evaluation, from 1."""
    columns: Any = {
        name: np.array([np.nan if value is None else value for value in values])
        for name, values in log.columns().items()
    }
    write_npz(folder / ("trials.npz" if number == 1 else f"trials_{number}.npz"), **columns)


def latency_text(steps: np.ndarray, physics_dt: float) -> str:
    """Format latencies (num_envs,) [physics steps of physics_dt s] in ms and steps: one value, or range and mean."""
    least = int(np.min(steps))
    most = int(np.max(steps))
    low, high, mean = (f"{1000.0 * physics_dt * float(value):.3g}" for value in (least, most, np.mean(steps)))
    if least == most:
        return f"{low} ms ({least} physics step{'' if least == 1 else 's'})"
    return f"{low} to {high} ms ({least} to {most} physics steps), mean {mean} ms"


def torque_limit(env: Env) -> float:
    """Return the smallest torque limit [N m] of the outer and inner (transversal) motors, robot overlay included."""
    limit = env.task.motors.transversal.saturation
    return limit if env.sim.robot is None else limit * float(env.sim.robot.saturation[:, TRANSVERSAL].min())
