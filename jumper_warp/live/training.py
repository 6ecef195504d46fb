"""Observer of a training that shows its worlds in a viewer, and writes films; it only reads the training."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from jumper_warp.live.buffer import WorldBuffer
from jumper_warp.live.clips import SHOWN_RUNS
from jumper_warp.live.feed import Feed, Setup, Steps, Viewer
from jumper_warp.live.scene import robot_scene
from jumper_warp.rl.run_names import title
from jumper_warp.utils.checks import check_not_negative

if TYPE_CHECKING:
    from pathlib import Path

    from jumper_warp.envs.env import Env
    from jumper_warp.rl.training_run import TrainingRun


class TrainingWatch:
    """Observer of one training, or of several seeds side by side; see `jumper_warp.rl.runner.Observer`."""

    def __init__(self, viewer: Viewer = "rerun", video_every: int = 0) -> None:
        """Prepare to show a training; video_every: iterations between two films, 0: none.

        Raises InputError: video_every is below 0.
        """
        check_not_negative("video_every", video_every)
        self._viewer = viewer
        self._video_every = video_every
        self.feed: Feed | None = None
        self._buffers: list[WorldBuffer] = []

    def begin(self, runs: Sequence[TrainingRun]) -> None:
        """Record the environments of the runs from the next policy step on, and start the viewer's process."""
        for run in runs[:SHOWN_RUNS]:
            env: Any = run.env
            with run.stream:
                self._buffers.append(WorldBuffer(env, run.cfg.ppo.num_steps))
            env.step_hooks.append(self._buffers[-1].record)
        first = runs[0]
        self.feed = Feed(setup_of(
            self._buffers[0], [run.folder for run in runs], first.clock.elapsed(), viewer=self._viewer,
            video_every=self._video_every, wandb=first.cfg.wandb,
        ))  # fmt: skip

    def after_iteration(self, runs: Sequence[TrainingRun]) -> None:
        """Send the policy steps of an iteration to the viewer's process."""
        if self.feed is None or self.feed.broken:
            return
        for index, (run, buffer) in enumerate(zip(runs, self._buffers, strict=False)):
            with run.stream:
                words = buffer.fetch()
            if words is not None:
                self.feed.put(Steps(index, buffer.number, run.iteration, words))

    def end(self) -> None:
        """Let the viewer's process end after the last policy steps."""
        if self.feed is not None:
            self.feed.close()


def setup_of(buffer: WorldBuffer, folders: Sequence[Path], elapsed: float, **settings: Any) -> Setup:
    """Return the viewer's setup for runs whose environments are like that of a buffer.

    folders: of the runs. elapsed: training time so far [s]. settings: further fields of `Setup`.
    """
    env: Env = buffer.env
    task = env.task
    return Setup(
        folders=tuple(folders),
        titles=tuple(map(title, folders)),
        scene=robot_scene(env.sim.model, env.sim.descriptions[0]),
        layout=buffer.layout,
        terms=tuple(term.name for term in task.rewards),
        endings=task.termination_names,
        state=buffer.state_type,
        goal=getattr(task.evaluation, "goal_marker", ""),
        step_dt=env.step_dt,
        elapsed=elapsed,
        **settings,
    )
