"""Process that shows watched worlds: `python -m jumper_warp.live.viewer`, fed by `jumper_warp.live.feed.Feed`.

It imports neither PyTorch nor Warp, and ends with its input.
"""

from __future__ import annotations

import sys
import time
from collections import deque
from collections.abc import Sequence
from contextlib import ExitStack, suppress
from threading import Thread
from typing import Any, BinaryIO

import numpy as np

from jumper_warp.live.clips import ROLES, SHOWN_RUNS, Player
from jumper_warp.live.curves import MetricsTail
from jumper_warp.live.feed import Setup, Steps, write_address
from jumper_warp.live.films import Films
from jumper_warp.viz.rerun_server import RerunServer, announce

SKIPPED = 2  # Policy steps from one shown pose to the next
SPACING = 1.4  # [m] Distance between robots
REACH = 1.2  # [m] Horizontal distance from its place at which a robot is held, so that it stays in view
CURVES_EVERY, REWARDS_EVERY = (2.0, 1.0)  # [s] Time between two reads of the metrics files, and updates of the bars


class Show:
    """State of the viewer: players of all slots, metrics files, a view if there is one, and films."""

    def __init__(self, setup: Setup, view: Any) -> None:
        """Prepare to show runs; view: a `RerunView` or `ViserView`, or None to make films only."""
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
            if self._updates % round(REWARDS_EVERY * view.rate) == 0:
                view.show_rewards(times[-1], np.stack([player.terms for player in players]))
        if self._updates % round(CURVES_EVERY * view.rate) == 0:
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


def read_messages(source: BinaryIO, inbox: deque[Steps | None]) -> None:
    """Append all messages of a stream to an inbox, then None."""
    try:
        while True:
            inbox.append(Steps.read(source))
    except (EOFError, OSError):
        inbox.append(None)


def main() -> None:
    """Show what the standard input brings, until it ends."""
    source = sys.stdin.buffer
    try:
        setup = Setup.read(source)
    except EOFError:  # the sender has ended
        return
    single = len(setup.folders) == 1
    runs = setup.titles[:SHOWN_RUNS]
    names = [role if single else f"{run}: {role}" for run in runs for role in ROLES]
    view: Any = None
    with ExitStack() as cleanup:
        if setup.viewer != "none":
            view, url, page = open_view(setup, names, cleanup)
            with suppress(OSError):  # a full disk: the view can be opened, but not joined
                write_address(setup.folders, url, page)
            announce(url, page)
        run(Show(setup, view), source, 8.0 if view is None else view.rate)


def open_view(setup: Setup, names: Sequence[str], cleanup: ExitStack) -> tuple[Any, str, str]:
    """Return the view that a setup names, its address and that of a page in the browser; names: of the slots."""
    if setup.viewer == "viser":
        from jumper_warp.live.viser_view import ViserView

        page = ViserView(setup.scene, names, setup.terms)
        cleanup.callback(page.close)
        return page, page.url, page.page
    import rerun as rr

    from jumper_warp.live.rerun_view import RerunView

    server = RerunServer()
    cleanup.callback(server.close)
    stream = rr.RecordingStream("jumper-warp watch")
    stream.connect_grpc(server.url)
    cleanup.callback(stream.disconnect)
    return RerunView(stream, setup.scene, names, setup.terms), server.url, server.page


def run(show: Show, source: BinaryIO, rate: float) -> None:
    """Show the messages of a stream until it ends; rate: of updates [1/s]."""
    inbox: deque[Steps | None] = deque(maxlen=64)
    Thread(target=read_messages, args=(source, inbox), daemon=True).start()
    ended = False
    while not ended:
        started = time.monotonic()
        while inbox and not ended:
            if (steps := inbox.popleft()) is None:
                ended = True
            else:
                show.add(steps)
        show.update()
        time.sleep(max(0.0, started + 1.0 / rate - time.monotonic()))
    show.end()


if __name__ == "__main__":
    main()
