"""Playback of watched worlds in real time, one whole episode after the other; needs NumPy only."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

ROLES = ("best", "median", "worst", "random")  # Watched worlds, by the return of their last finished episode
SHOWN_RUNS = 4  # Largest number of seeds whose robots are shown; the curves are of all seeds
LONGEST = 1200  # [policy steps] A longer episode is followed for this time only
Layout = dict[str, tuple[int, int]]  # Half-open range of columns of each recorded value


@dataclass
class Clip:
    """Policy steps of one episode of a watched world."""

    whole: bool  # Whether it begins with the episode
    rows: list[np.ndarray] = field(default_factory=list)  # Words of each step, (columns,) int32
    complete: bool = False  # Whether no step is missing at its end


class Player:
    """Player of the worlds that one slot watches: it plays a whole episode, then the newest one that has begun.

    Until the first whole episode it plays the part that it has. While there is no other episode it repeats the last.
    """

    def __init__(self, layout: Layout) -> None:
        """Prepare to play words with the columns of a layout."""
        self._layout = layout
        self._recorded: Clip | None = None
        self._next: Clip | None = None
        self._shown: Clip | None = None
        self._place = 0
        self.finished: Clip | None = None  # Newest whole episode
        self.terms = np.zeros(layout["rewards"][1] - layout["rewards"][0])  # Sum of each reward term so far

    def add(self, words: np.ndarray) -> None:
        """Add the words (steps, columns) of consecutive policy steps; a step that ends an episode shows the next one.

        It is recorded after the reset.
        """
        for row in words:
            clip = self._recorded
            ended = bool(row[self._layout["done"][0]])
            if clip is None or ended or row[0] != clip.rows[-1][0] or len(clip.rows) >= LONGEST:
                if clip is not None:
                    clip.complete = True
                    self.finished = clip if clip.whole else self.finished
                clip = self._recorded = Clip(ended)
                if self._shown is None:
                    self._shown = clip
                elif ended:
                    self._next = clip
            clip.rows.append(row)

    @property
    def first(self) -> np.ndarray:
        """Words of the first step of the shown episode, (columns,)."""
        assert self._shown is not None
        return self._shown.rows[0]

    def skip(self) -> None:
        """Begin a new episode with the next step, since steps were lost."""
        if self._recorded is not None:
            self._recorded.complete = True
            self._recorded = None

    def take(self, count: int) -> np.ndarray | None:
        """Return the words of the next `count` policy steps to show, (count, columns); None: there are none yet.

        The last step is repeated while the following ones are not recorded yet.
        """
        if self._shown is None:
            return None
        return np.stack([self._advance() for _ in range(count)])

    def _advance(self) -> np.ndarray:
        """Return the words of the next policy step, and add its rewards to the sums."""
        assert self._shown is not None
        if self._place == len(self._shown.rows):
            if not self._shown.complete or not (self._next or self._shown.whole):
                return self._shown.rows[-1]
            self._shown = self._next or self._shown
            self._next = None
            self._place = 0
        row = self._shown.rows[self._place]
        if self._place == 0:
            self.terms[:] = 0.0  # the first step has the rewards of the episode before
        else:
            self.terms += row[slice(*self._layout["rewards"])].view(np.float32)
        self._place += 1
        return row
