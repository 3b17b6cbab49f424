"""Cores that threads run on."""

from __future__ import annotations

import contextlib
import ctypes
import os
from threading import Thread


def usable_cores() -> set[int]:
    """Numbers of the cores that the calling thread may run on."""
    return os.sched_getaffinity(0)


def own_core() -> int | None:
    """Core that the calling thread is on; None where the system does not tell."""
    return _ask_for_core() if _ask_for_core is not None else None


# PyDLL: to let go of the interpreter's lock, and take it again, would take far longer.
_ask_for_core = getattr(ctypes.PyDLL(None), 'sched_getcpu', None)


class OutOfTheWay:
    """Keeps threads off the core that another one is on.

    Linux is in no hurry to do so: it wakes a thread where that ran last, finds the other
    one there, and lets both take turns, though a core is idle, until it next balances the
    load. At ten frames a second that is for most of a frame.

    Parameters
    ----------
    threads : list of Thread
        Threads, started and no more of them than the cores that are left.
    """

    def __init__(self, threads: list[Thread]) -> None:
        self._threads = threads
        self._left: int | None = None

    def leave_own_core(self) -> None:
        """Have them leave the core of the calling thread to it, if they can have another.

        They may use every other core that the calling thread might use.
        """
        core = own_core()
        if core == self._left or core is None:
            return
        others = usable_cores() - {core}
        # None of them is alive in a process forked off this one.
        ids = [thread.native_id for thread in self._threads if thread.is_alive()]
        if len(others) < len(ids):
            return
        self._left = core
        for number in filter(None, ids):
            # Where that is forbidden they stay where they are, which costs nothing but time.
            with contextlib.suppress(OSError):
                os.sched_setaffinity(number, others)
