"""SIGINT and SIGTERM as one orderly, prompt end. No ROS is imported here."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

GRACE = 0.5
"""Time that clean-up may take after a signal [s]."""


class StopRequest:
    """Whether the process was asked to end."""

    def __init__(self) -> None:
        self.made = False
        self._deadline = threading.Timer(GRACE, os._exit, [0])
        self._deadline.daemon = True

    def handle(self, _number: int, _frame: FrameType | None) -> None:
        """Interrupt the main thread at the first signal; ignore the later ones.

        A terminal and ``ros2 launch`` both signal: the second must not break the clean-up.
        """
        if not self.made:
            self.made = True
            # numba swallows interrupts, and its compiler runs for seconds.
            self._deadline.start()
            raise KeyboardInterrupt

    def finish(self) -> None:
        """Say that the clean-up is done."""
        self._deadline.cancel()


@contextmanager
def stop_on_signals() -> Iterator[StopRequest]:
    """Turn the first SIGINT or SIGTERM within the block into a KeyboardInterrupt.

    If the block does not end soon after, the process does, with code 0. An
    interrupt that comes within a destructor is swallowed by Python, therefore
    loops have to look at ``made`` too. Once asked to end, the process goes on
    ignoring both signals. In other threads than the main one nothing is changed.
    """
    request = StopRequest()
    if threading.current_thread() is not threading.main_thread():
        yield request
        return
    signals = (signal.SIGINT, signal.SIGTERM)
    before = {number: signal.signal(number, request.handle) for number in signals}
    try:
        yield request
    finally:
        request.finish()
        if not request.made:
            for number, handler in before.items():
                signal.signal(number, signal.SIG_DFL if handler is None else handler)
