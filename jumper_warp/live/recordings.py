"""Recordings of a driven robot: .rrd for Rerun, .mp4 and a self-contained .html page."""

from __future__ import annotations

import multiprocessing
import threading
import time
from collections.abc import Callable
from typing import TYPE_CHECKING

from jumper_warp.evaluation.recorder import ankles, peak_forces
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.files import write_atomically
from jumper_warp.viz.film import write_film
from jumper_warp.viz.recorder import Recorder
from jumper_warp.viz.rerun import write_rrd

if TYPE_CHECKING:
    from pathlib import Path

    from viser import ViserServer

    from jumper_warp.live.session import Session
    from jumper_warp.utils.newton_types import Model

LONGEST = 120.0  # [s] Length at which a recording ends by itself


class Take:
    """Recording under way."""

    def __init__(self, server: ViserServer, session: Session, model: Model, folder: Path) -> None:
        """Begin a recording; model: of the drawn robot and ground; folder: for the files."""
        self.path = folder / f"drive_{time.strftime('%H-%M-%S')}"
        self.step_dt = session.env.step_dt
        self.frames = 0
        self.serializer = server.get_scene_serializer()
        notes = {"task": " and ".join(task.name for task in session.tasks), "solver": session.conditions.solver}
        self.recorder = Recorder(model, notes=notes)

    def add(self, session: Session) -> bool:
        """Append the session's current state; return whether the recording continues."""
        self.frames += 1
        self.serializer.insert_sleep(self.step_dt)
        poses = session.poses
        values = (session.series(), ankles(poses), peak_forces(session.env.sim))
        self.recorder.record(self.frames * self.step_dt, poses[0], *values)
        return self.frames * self.step_dt < LONGEST

    def finish(self, report: Callable[[str, str], None]) -> None:
        """Write the files in the background; report: called with title and text for each complete file."""
        threading.Thread(target=self._write, args=(self.serializer.as_html(), report), daemon=True).start()

    def _write(self, page: str, report: Callable[[str, str], None]) -> None:
        """Write all files; the film is drawn by another process, since drawing would delay the simulation."""
        if not self.frames:
            return
        self.path.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(self.path.with_suffix(".html"), page.encode())
        recording = self.recorder.recording()
        write_rrd(recording, self.path.with_suffix(".rrd"))
        report("Recorded", f"{self.path}.html and .rrd; the film follows")
        try:
            with multiprocessing.get_context("spawn").Pool(1) as pool:
                pool.apply(write_film, (recording, self.path.with_suffix(".mp4")))
        except InputError as error:
            report("No film", str(error))
        else:
            report("Recorded", f"{self.path}.mp4")
