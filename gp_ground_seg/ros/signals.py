"""SIGINT and SIGTERM as one orderly, prompt end. No ROS is imported here."""

from __future__ import annotations

import contextlib
import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

GRACE = 0.5
"""Time from the signal to the end of the process, if the work does not end before [s]."""
SIGNALS = (signal.SIGINT, signal.SIGTERM)


class StopRequest:
    """Whether the process was asked to end."""

    def __init__(self) -> None:
        self.made = False

    def note(self, _number: int, _frame: FrameType | None) -> None:
        """Set `made`, and no more.

        An exception here would come out of whatever runs: rclpy's bindings turn it into
        another one, the compiler and destructors print and forget it.
        """
        self.made = True


class Watchdog:
    """Ends the process with code 0 if a signal does not, within `GRACE`.

    Python calls its handlers between two steps of the main thread. The next one may be
    seconds away, behind a long computation. The number of a signal, though, is written
    to a pipe at once, where a thread waits for it.
    """

    def __init__(self) -> None:
        self._done = threading.Event()
        self._read_end, self._write_end = os.pipe()
        os.set_blocking(self._write_end, False)
        self._before = signal.set_wakeup_fd(self._write_end, warn_on_full_buffer=False)
        self._thread = threading.Thread(target=self._watch, name='signals', daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Let the process live."""
        self._done.set()
        signal.set_wakeup_fd(self._before)
        os.close(self._write_end)
        self._thread.join()
        os.close(self._read_end)

    def _watch(self) -> None:
        with contextlib.suppress(OSError):
            while number := os.read(self._read_end, 1):
                if number[0] in SIGNALS:
                    break
        # At the end of the pipe too: then it is done.
        if not self._done.wait(GRACE):
            os._exit(0)


@contextmanager
def stop_on_signals() -> Iterator[StopRequest]:
    """Have SIGINT and SIGTERM within the block noted, which looks at ``made`` now and then.

    If it does not end soon after, the process does, with code 0. Once asked to end,
    the process goes on ignoring both signals: a terminal and ``ros2 launch`` both
    send one, and the second must not break the clean-up. In other threads than the
    main one nothing is changed.
    """
    request = StopRequest()
    if threading.current_thread() is not threading.main_thread():
        yield request
        return
    watchdog = Watchdog()
    before = {number: signal.signal(number, request.note) for number in SIGNALS}
    try:
        yield request
    finally:
        if not request.made:
            for number, handler in before.items():
                signal.signal(number, signal.SIG_DFL if handler is None else handler)
        watchdog.close()
