"""Implementation of `jumper play`: record a policy, a script of commands or a state of a training, and show it.

Functions import what they need, so that the help of the settings needs neither PyTorch nor Newton.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from threading import Event
from typing import TYPE_CHECKING, Annotated, Generic, Literal, TypeVar

import tyro

from jumper_warp.evaluation.conditions import Conditions
from jumper_warp.evaluation.scripts import read_script
from jumper_warp.evaluation.skills import SkillNames
from jumper_warp.policies.catalog import is_run, run_folder
from jumper_warp.rl.run_names import title
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.files import Json
from jumper_warp.utils.metrics import MetricValue
from jumper_warp.utils.output import Report, write_metrics
from jumper_warp.utils.summary import PrintFlags

if TYPE_CHECKING:
    from jumper_warp.evaluation.log import EvaluationLog
    from jumper_warp.evaluation.run import EvaluationRun, Run
    from jumper_warp.viz.recording import Recording

Flags = TypeVar("Flags")
SCRIPT_SUMMARY = (
    "outcome", "jump_made_rate", "apex_error_abs_mean_m", "goal_distance_at_handover_mean_m",
    "settled_slewed_rmse_vx_m_s", "settled_slewed_rmse_vy_m_s", "settled_slewed_rmse_yaw_rate_rad_s",
)  # fmt: skip
"""Keys of the metrics in the summary of `jumper play --script`."""


@dataclass(frozen=True, kw_only=True)
class FilmCfg:
    """Settings of the film that is made of a recorded simulation."""

    video: Path | None = None  # Film to write: .mp4 (H.264), .webp or .gif (default: none)
    size: tuple[int, int] = (854, 480)  # [px] Width and height
    fps: float = 30.0  # [1/s] Frames per second
    speed: float = 1.0  # Speed of the playback; 0.25 for slow motion
    eye: tuple[float, float, float] | None = None
    """[m] Camera's offset from the robot, world axes: ahead, to the left, up (default: at the robot's side). It
    also sets the direction of the picture."""
    angle_of_view: float | None = None
    """[deg] Vertical angle of view of film and picture (default: the film's 30, the picture's 16)."""
    true_scale: bool = False
    """Draw all moments of the picture at their true places, also of a robot that stays in place."""
    title: str | None = None  # Title of film and picture (default: policy and task)

    def __post_init__(self) -> None:
        """Raise InputError for a vertical view or invalid film settings, before anything is simulated."""
        if self.angle_of_view is not None and not 1.0 <= self.angle_of_view <= 120.0:
            raise InputError(f"angle_of_view must be in [1, 120] deg, got {self.angle_of_view:g}")
        if self.eye is not None:
            import numpy as np

            from jumper_warp.viz.renderer import View

            View(np.array(self.eye), np.zeros(3)).axes()  # raises InputError if it is vertical
        if self.video is not None:
            from jumper_warp.viz.film import check_film

            check_film(self.video, self.size, self.fps, self.speed, self.eye)

    @property
    def view(self) -> Json:
        """Options of `write_film` and `write_picture` about the camera."""
        angle = {} if self.angle_of_view is None else {"field_of_view": self.angle_of_view}
        return {"eye": self.eye, **angle}

    @property
    def notes(self) -> Json:
        """Metadata of the recording."""
        return {} if self.title is None else {"title": self.title}

    def write(self, recording: Recording) -> Path:
        """Write a film of a recording to the path `video`, and return that path."""
        from jumper_warp.viz.film import write_film

        assert self.video is not None
        return write_film(recording, self.video, size=self.size, fps=self.fps, speed=self.speed, **self.view)


@dataclass(frozen=True, kw_only=True)
class RecordingCfg:
    """Common flags of the commands that record a simulation."""

    conditions: Annotated[Conditions, tyro.conf.arg(name="")] = field(default_factory=Conditions)
    """Conditions of the simulation."""
    film: Annotated[FilmCfg, tyro.conf.arg(name="")] = field(default_factory=FilmCfg)
    """Film of the recording to write."""
    out: Path | None = None  # Folder for all results (default: outputs/play/<time>)
    viewer: Literal["none", "rerun"] = "none"
    """Show the simulation while it runs in Rerun's viewer, a window or a page in the browser. It listens on this
    machine's loopback address only."""
    printing: Annotated[PrintFlags, tyro.conf.arg(name="")] = field(default_factory=PrintFlags)
    """Format of the printed results."""


@dataclass(frozen=True)
class PlayCfg(RecordingCfg, Generic[Flags]):
    """Simulate a policy, and write a recording, a picture, metrics and a film."""

    flags: Annotated[Flags, tyro.conf.arg(name="")]
    """Flags of the task's kind, see `jumper_warp.tasks.evaluation.Evaluation.flags`."""
    seconds: float | None = None
    """[s] Length of the recording (default: for jumps 3.5, and 2.5 for each further one; else 10)."""
    rewards: bool = False  # Record the task's reward terms too; their kernel is compiled at the first use
    controller: Literal["policy", "mpc"] = "policy"
    """Controller of jumps: the policy, or whole-jump predictive control, which begins with the policy's jump."""

    def __post_init__(self) -> None:
        """Raise InputError for a length of the recording [s] out of range."""
        if self.seconds is not None and not 0.02 <= self.seconds <= 3600.0:
            raise InputError(f"seconds must be in [0.02, 3600], got {self.seconds}")


def play(run: EvaluationRun, cfg: PlayCfg) -> Path:
    """Simulate a policy, write a recording and `metrics.json`, print a summary, and return the recording's path.

    `metrics.json` holds the columns of the log, one value per trial.
    Raises PolicyError: the policy cannot be used; OSError: the folder cannot be created.
    """
    live = Live(cfg.seconds or cfg.flags.length) if cfg.viewer == "rerun" else None
    log, recording = record(run, cfg, live)
    columns = log.columns()
    report = write_metrics(run.folder, columns)
    count = len(next(iter(columns.values())))
    words = f"{count} {log.row_name}{'s' * (count > 1)}"
    keys = log.main_columns or columns
    return show_recording(run, report, recording, log.row_name, cfg, words, keys, live)


def record(run: EvaluationRun, cfg: PlayCfg, live: Live | None = None) -> tuple[EvaluationLog, Recording]:
    """Simulate a policy, and return the log and the recording of all its robots; live: viewer that shows them.

    Without cfg.seconds the recording ends with the last episode. Predictive control plans with nominal robots, since it
    does not know what was sampled.
    Raises PolicyError: the policy cannot be used; OSError: the folder cannot be created.
    """
    from jumper_warp.evaluation.log import run_evaluation
    from jumper_warp.evaluation.recorder import EnvRecorder
    from jumper_warp.evaluation.trained import warn_beyond_training

    run.prepare("play", cfg.conditions, cfg.out)
    log = cfg.flags.log(run.evaluation.prepare_task(run.task))
    warn_beyond_training(run.task, log.all_commands())
    env = run.env(log.count, rewards=cfg.rewards)
    name = run.policy.interface.task
    notes = {"policy": played_name(run.source), "task": name, "solver": cfg.conditions.solver, **cfg.film.notes}
    recorder = EnvRecorder(env, log, range(log.count), notes=notes, live=live and live.recording)
    seconds = cfg.seconds or cfg.flags.length
    stop = cfg.seconds is None
    act = run.policy.act
    if cfg.controller == "mpc":
        from jumper_warp.evaluation.predictive_control import PredictiveController

        nominal = replace(cfg.conditions, randomize=False, noise=False, push_in_flight=False)
        act = PredictiveController(env, run.policy, run.env(log.count, conditions=nominal)).act
    run_evaluation(act, env, log, seconds=seconds, on_begin=recorder.begin, on_step=recorder, stop=stop)
    return log, recorder.recording()


def played_name(source: str | Path) -> str:
    """Return the name of a policy for titles, or "run RUN" for the folder or a checkpoint of the training run RUN."""
    folder = run_folder(Path(source))
    return f"run {title(folder)}" if is_run(source) else folder.resolve().name


@dataclass(frozen=True)
class ScriptCfg(RecordingCfg):
    """Simulate a script of walks and jumps of one robot, and write a recording, a picture, metrics and a plot.

    A script is a JSON list of {"walk": [vx, vy, yaw_rate], "seconds": s}, {"stand": s}, {"jump_up": height},
    {"jump_to": [ahead, left]} and {"jump_onto": [ahead, left]} (a block); SI units, as in
    assets/scripts/walk_jump_walk.json.
    """

    script: Path  # Script of commands, a JSON file
    policies: Annotated[SkillNames, tyro.conf.arg(name="")] = field(default_factory=SkillNames)
    """Policies of the three skills."""


def play_script(cfg: ScriptCfg) -> Path:
    """Simulate a script with one robot, write a recording, plot and `metrics.json`, return the recording's path.

    Raises InputError: unusable script or device; PolicyError: unusable policy; OSError: the folder cannot be created.
    """
    from jumper_warp.evaluation.courses import CourseLog, course_metrics, plot_course
    from jumper_warp.evaluation.log import run_evaluation
    from jumper_warp.evaluation.recorder import EnvRecorder
    from jumper_warp.evaluation.run import SkillRun

    script = read_script(cfg.script)
    run = SkillRun(cfg.policies)
    run.prepare("play", cfg.conditions, cfg.out)
    course = CourseLog([script])
    course.warn_beyond_training(run.tasks)
    env = run.env(1, block=course.block)
    notes = {"task": cfg.script.stem, "solver": cfg.conditions.solver, **cfg.film.notes}
    live = Live(course.seconds) if cfg.viewer == "rerun" else None
    recorder = EnvRecorder(env, course, [0], block=course.block, notes=notes, live=live and live.recording)
    run_evaluation(run.actor(env), env, course, on_step=recorder)
    plot_course(run.folder / "timeline.png", course, 0)
    metrics = {"outcome": str(course.outcomes[0]), **course_metrics(course)}
    report = run.write(metrics)
    defined = [
        key for key in SCRIPT_SUMMARY if not isinstance(metrics[key], MetricValue) or metrics[key].value is not None
    ]
    words = f"{len(script)} command{'s' * (len(script) > 1)} of {cfg.script}"
    return show_recording(run, report, recorder.recording(), "course", cfg, words, defined, live)


class Live:
    """Viewer that shows a recording while it grows; `recording` is its Rerun stream."""

    def __init__(self, seconds: float) -> None:
        """Start a server and, if there is a display, a window of the viewer; seconds: expected length [s]."""
        from jumper_warp.viz.live_recording import LiveRecording
        from jumper_warp.viz.rerun_server import RerunServer, announce

        self._server = RerunServer()
        self._window = announce(self._server.url, self._server.page)
        self.recording = LiveRecording(self._server.url, seconds)

    def finish(self, recording: Recording) -> None:
        """Complete the view of a recording, and wait until its window is closed, or for Ctrl-C in a terminal."""
        self.recording.finish(recording)
        if self._window is not None:
            self._window.wait()
        elif sys.stderr.isatty():
            print("Ctrl-C ends the view", file=sys.stderr)
            with suppress(KeyboardInterrupt):
                Event().wait()
        self._server.close()


def show_recording(
    run: Run, report: Report, recording: Recording, name: str, cfg: RecordingCfg, count: str, keys: Iterable[str],
    live: Live | None = None,
) -> Path:  # fmt: skip
    """Write a recording (.rrd, picture, film if requested), print a summary, and return the path of the .rrd file.

    report: written metrics of the run. name: of the files and of a trial; count, keys: number of trials and main
    metrics, for the summary. live: viewer that shows the recording, for whose end this waits.
    """
    from jumper_warp.evaluation.recorder import save_recording

    path = save_recording(recording, run.folder, name, true_scale=cfg.film.true_scale, **cfg.film.view)
    films = [] if cfg.film.video is None else [cfg.film.write(recording)]
    run.print_flags = cfg.printing
    run.summarise(report, count, keys, trial=name, films=films)
    if live is not None:
        live.finish(recording)
    return path


@dataclass(frozen=True)
class DumpCfg:
    """Show the robot's state at a non-finite value in training: write a recording and a picture of the robot."""

    dump: Path  # File that the training has written, RUN/non_finite/TERM.npz
    out: Path | None = None  # Folder for the results (default: outputs/play/<time>)
    viewer: Literal["none", "rerun"] = "none"
    """Open the recording in Rerun's viewer. It listens on this machine's loopback address only."""


def play_dump(cfg: DumpCfg) -> Path:
    """Write a recording and a picture of a dumped robot state, print its non-finite terms, and return the .rrd path.

    The robot is shown on level ground. Raises InputError: the file is no dump; OSError: the folder cannot be created.
    """
    import numpy as np

    from jumper_warp.utils.dumps import load_dump

    found, header = load_dump(cfg.dump)
    from jumper_warp.evaluation.recorder import ankles, save_recording
    from jumper_warp.robot.overlay import RobotOverlay
    from jumper_warp.sim.simulation import Simulation
    from jumper_warp.utils.output import output_dir
    from jumper_warp.utils.runtime import configure_device
    from jumper_warp.viz.recorder import Recorder
    from jumper_warp.viz.recording import FARTHEST

    configure_device("cpu")
    robot = header["config"].get("env", {}).get("robot")
    sim = Simulation(1, robot=robot and RobotOverlay.from_json(robot), device="cpu")
    q, qd = (np.where(np.abs(x) < FARTHEST, x, 0.0) for x in (found.arrays["joint_q"], found.arrays["joint_qd"]))
    sim.state.joint_q.assign(q)  # 0 in place of values that are not finite or cannot be drawn
    sim.state.joint_qd.assign(qd)
    poses = sim.links()[0]
    units = {name: zip(found.names[name], found.arrays[name], strict=True) for name in ("rewards", "observations")}
    series = {f"{group}/{name} [1]": float(value) for group, values in units.items() for name, value in values}
    notes = {"task": header["task"], "term": found.term, "world": found.world, "step": found.step}
    recorder = Recorder(sim.model, notes=notes, labels=[f"{found.term}, world {found.world}, step {found.step}"])
    recorder.record(0.0, poses.reshape(-1, 7), series, ankles(poses), np.zeros((1, 4, 3)))
    path = save_recording(recorder.recording(), output_dir("play", cfg.out), "dump")
    print(f"{header['task']}, iteration {header['iteration']}, seed {header['config']['train']['seed']}: {found}")
    for name in ("rewards", "observations"):
        bad = np.array(found.names[name])[~np.isfinite(found.arrays[name])]
        print(f"{name} that are not finite: {', '.join(bad) or 'none'}")
    print(path)
    open_viewer(path, cfg.viewer)
    return path


def open_viewer(path: Path, viewer: str) -> None:
    """Open a recording in the viewer of this name, `rerun` or `none`."""
    if viewer == "rerun":
        from jumper_warp.viz.rerun_server import viewer_command

        subprocess.run(viewer_command(path), check=False)
