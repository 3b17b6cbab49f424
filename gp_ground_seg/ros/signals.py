"""SIGINT and SIGTERM as one orderly end."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType


class StopRequest:
    """Whether the process was asked to end."""

    def __init__(self) -> None:
        self.made = False

    def handle(self, _number: int, _frame: FrameType | None) -> None:
        """Interrupt the main thread at the first signal; ignore the later ones.

        A terminal and ``ros2 launch`` both signal: the second must not break the clean-up.
        """
        if not self.made:
            self.made = True
            raise KeyboardInterrupt


@contextmanager
def stop_on_signals() -> Iterator[StopRequest]:
    """Turn the first SIGINT or SIGTERM within the block into a KeyboardInterrupt.

    An interrupt that comes within a destructor is swallowed by Python, therefore
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
        if not request.made:
            for number, handler in before.items():
                signal.signal(number, signal.SIG_DFL if handler is None else handler)
