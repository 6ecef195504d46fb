"""Process that shows watched worlds: `python -m jumper_warp.live.viewer`, fed by `jumper_warp.live.feed.Feed`.

It imports neither PyTorch nor Warp, and ends with its input.
"""

from __future__ import annotations

import json
import pickle
import sys
import time
from collections import deque
from pathlib import Path
from threading import Thread
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np

from jumper_warp.live.clips import ROLES, SHOWN_RUNS, Player
from jumper_warp.live.feed import Setup, Steps
from jumper_warp.live.films import Films
from jumper_warp.rl.metrics_file import METRICS_FILE

if TYPE_CHECKING:
    from jumper_warp.live.rerun_view import RerunView

RATE = 8.0  # [1/s] Updates of the robots; each brings all policy steps since the last one
SKIPPED = 2  # Policy steps from one shown pose to the next
SPACING = 1.4  # [m] Distance between robots
REACH = 1.2  # [m] Horizontal distance from its place at which a robot is held, so that it stays in view
CURVES_EVERY = 8  # Updates between two reads of the metrics files


class MetricsTail:
    """Reader of the lines that a training appends to its metrics file."""

    def __init__(self, folder: Path) -> None:
        """Begin at the start of the file, which may not exist yet."""
        self._path = folder / METRICS_FILE
        self._read = 0

    def lines(self) -> list[dict[str, Any]]:
        """Return the complete lines since the last call."""
        if not self._path.is_file():
            return []
        with self._path.open("rb") as file:
            file.seek(self._read)
            content = file.read()
        end = content.rfind(b"\n") + 1
        self._read += end
        return [json.loads(line) for line in content[:end].splitlines()]


class Show:
    """State of the viewer: players of all slots, metrics files, a view if there is one, and films."""

    def __init__(self, setup: Setup, view: RerunView | None) -> None:
        """Prepare to show runs; view: None if only films are made."""
        self.setup = setup
        self._view = view
        shown = range(min(len(setup.folders), SHOWN_RUNS))
        self._players = [[Player(setup.layout) for _ in ROLES] for _ in shown]
        self._numbers = [0 for _ in shown]
        self._places = np.array([[-1.6 * run, (1.5 - slot) * SPACING] for run in shown for slot in range(len(ROLES))])
        self._tails = [MetricsTail(folder) for folder in setup.folders]
        self._films = Films(setup) if setup.video_every else None
        self._begin = time.monotonic()
        self._frames = 0  # Policy steps shown so far
        self._updates = 0
        self._iteration = 0

    def add(self, steps: Steps) -> None:
        """Add the policy steps of an iteration."""
        players = self._players[steps.run]
        for slot, player in enumerate(players):
            if steps.number != self._numbers[steps.run] + 1:
                player.skip()
            player.add(steps.words[:, slot])
        self._numbers[steps.run] = steps.number
        self._iteration = steps.iteration
        if self._films and steps.run == 0:
            self._films.update(steps.iteration, players)

    def update(self) -> None:
        """Show the policy steps since the last update, in real time, and now and then rewards and curves."""
        view = self._view
        if view is None:
            return
        setup = self.setup
        seconds = time.monotonic() - self._begin
        count = max(min(int(seconds / setup.step_dt) - self._frames, int(1.0 / setup.step_dt)), 1)
        self._frames = int(seconds / setup.step_dt)
        players = [player for row in self._players for player in row]
        rows = [row for player in players if (row := player.take(count)) is not None]
        if len(rows) == len(players):
            times = setup.elapsed + setup.step_dt * np.arange(self._frames - count + 1, self._frames + 1)
            shown = slice((count - 1) % SKIPPED, None, SKIPPED)
            view.show(times[shown], *self._drawn(np.stack(rows, axis=1)[shown], players))
            if self._updates % 2 == 0:
                view.show_rewards(times[-1], np.stack([player.terms for player in players]))
        if self._updates % CURVES_EVERY == 0:
            labels = [f", {title}" if len(self._tails) > 1 else "" for title in setup.titles]
            for tail, label in zip(self._tails, labels, strict=True):
                view.show_curves(tail.lines(), label)
            view.show_status(f"**{setup.titles[0]}**, iteration {self._iteration}, {seconds:.0f} s")
        self._updates += 1

    def _drawn(self, words: np.ndarray, players: list[Player]) -> tuple[np.ndarray, np.ndarray]:
        """Return link poses (frames, slots, links, 7) and goals (slots, 3) [m] with each robot near its place.

        words: (frames, slots, columns).
        """
        columns = slice(*self.setup.layout["joint_q"])
        poses = np.nan_to_num(self.setup.scene.link_poses(words[..., columns].view(np.float32)))
        starts = np.stack([player.first[columns][:2].view(np.float32) for player in players])
        moved = poses[..., 0, :2] - starts
        shift = self._places - starts - (moved - np.clip(moved, -REACH, REACH))
        poses[..., :2] += shift[:, :, None]
        goals = np.stack([self.goal(row) for row in words[-1]])
        goals[:, :2] += shift[-1]
        return poses, goals

    def goal(self, row: np.ndarray) -> np.ndarray:
        """Return the goal [m], (3,), in the words of a world, NaN if there is none; a height is above the base."""
        state, marker = self.setup.state, self.setup.goal
        if not marker:
            return np.full(3, np.nan)
        value = np.frombuffer(row[slice(*self.setup.layout["state"])].tobytes(), dtype=state)[0][marker]
        if np.shape(value) == (3,):
            return np.array(value, dtype=float)
        base = row[self.setup.layout["joint_q"][0] :][:2].view(np.float32)
        return np.array([*base, value], dtype=float)

    def end(self) -> None:
        """Finish the films."""
        if self._films:
            self._films.end()


def read_messages(source: BinaryIO, inbox: deque[Any]) -> None:
    """Append all messages of a stream to an inbox, then None."""
    try:
        while True:
            inbox.append(pickle.load(source))
    except (EOFError, OSError, pickle.UnpicklingError):
        inbox.append(None)


def main() -> None:
    """Show what the standard input brings, until it ends."""
    source = sys.stdin.buffer
    setup: Setup = pickle.load(source)
    server = stream = view = None
    if setup.viewer == "rerun":
        import rerun as rr

        from jumper_warp.live.rerun_view import RerunView, write_address
        from jumper_warp.viz.rerun_server import RerunServer, announce

        server = RerunServer()
        stream = rr.RecordingStream("jumper-warp watch")
        stream.connect_grpc(server.url)
        single = len(setup.folders) == 1
        runs = setup.titles[:SHOWN_RUNS]
        names = [role if single else f"{run}: {role}" for run in runs for role in ROLES]
        view = RerunView(stream, setup.scene, names, setup.terms)
        write_address(setup.folders, server.url, server.page)
        announce(server.url, server.page)
    inbox: deque[Any] = deque(maxlen=64)
    Thread(target=read_messages, args=(source, inbox), daemon=True).start()
    show = Show(setup, view)
    ended = False
    while not ended:
        started = time.monotonic()
        while inbox and not ended:
            message = inbox.popleft()
            ended = message is None
            if not ended:
                show.add(message)
        show.update()
        time.sleep(max(0.0, started + 1.0 / RATE - time.monotonic()))
    show.end()
    if server is not None and stream is not None:
        stream.disconnect()
        server.close()


if __name__ == "__main__":
    main()
