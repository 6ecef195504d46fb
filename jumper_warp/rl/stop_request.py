"""Request of a signal to stop a training."""

from __future__ import annotations

import signal
import threading
from types import FrameType

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)  # Ctrl-C, a scheduler's end of the job, a closed terminal


class StopRequest:
    """Context manager that records Ctrl-C, SIGTERM or SIGHUP as a request to stop.

    A second Ctrl-C raises KeyboardInterrupt, unless `can_abort` is False. Python handles signals in the main thread
    only, so that there are no requests in another thread. With nohup SIGHUP stays ignored.
    """

    def __init__(self) -> None:
        """Begin without a request."""
        self.requested = False
        self.can_abort = True  # False between iterations, when a checkpoint may be saved
        self._previous = {}

    def __enter__(self) -> StopRequest:
        """Install handlers of the signals that set `requested`."""
        if threading.current_thread() is threading.main_thread():
            ignored = {signal.SIGHUP} if signal.getsignal(signal.SIGHUP) is signal.SIG_IGN else set()
            self._previous = {each: signal.signal(each, self._on_signal) for each in SIGNALS if each not in ignored}
        return self

    def __exit__(self, *_: object) -> None:
        """Restore the previous handlers of the signals."""
        for number, handler in self._previous.items():
            signal.signal(number, handler)

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        """Handle a signal: set the request. Raises KeyboardInterrupt on a second Ctrl-C within an iteration."""
        if number == signal.SIGINT and self.requested and self.can_abort:
            raise KeyboardInterrupt
        self.requested = True
