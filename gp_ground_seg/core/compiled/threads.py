"""Work shared out over the threads of ``concurrent.futures``."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

from gp_ground_seg.core.jit import JIT_ENABLED, jit
from gp_ground_seg.core.parameters.config import DEFAULT_MAX_THREADS

POINTS_TO_SORT, POINTS_TO_LABEL, SEGMENTS_TO_GROW = 40_000, 120_000, 60
"""Least number of a part: it then takes about 0.4 ms, several times what it takes to wake a thread
and to wait for it."""


class Part(NamedTuple):
    """A part of the work: a run of points (see `run_of`), or every `n_parts`-th segment."""

    number: int
    n_parts: int


def run_of(part: Part, n: int) -> slice:
    """Return which of `n` points are those of a part."""
    return slice(n * part.number // part.n_parts, n * (part.number + 1) // part.n_parts)


points_of = jit()(run_of)
"""The same for compiled code."""


class Workers:
    """Threads that run compiled functions, which release the interpreter's lock.

    Results do not depend on the number of threads. Threads start when they are first needed;
    where none can be started, the caller's thread does the work alone. Without compiled code
    there is one thread.

    Parameters
    ----------
    n_threads : int
        Number of threads, the caller's included; 0 = all cores of this process, at most
        `DEFAULT_MAX_THREADS`.

    Attributes
    ----------
    is_idle : bool
        Whether the last `run` saw all its parts end. After an exception, such as that of Ctrl-C
        while it waited, a thread may still work on the arrays that it was given.
    """

    def __init__(self, n_threads: int) -> None:
        wanted = n_threads or min(len(os.sched_getaffinity(0)), DEFAULT_MAX_THREADS)
        self.n_threads = wanted if JIT_ENABLED else 1
        self.is_idle = True
        self._pool: ThreadPoolExecutor | None = None

    def n_parts(self, n: int, least: int) -> int:
        """Return the number of parts that `n` points or segments are split into.

        Each has the `least` number, if there is more than one.
        """
        return max(min(self.n_threads, n // least), 1)

    def run(self, function: Callable[..., None], n_parts: int, *arguments: Any) -> None:
        """Call ``function(part, *arguments)`` for each part; return when all are done.

        Raises
        ------
        Exception
            The first error of a part, after all parts have ended (but see `is_idle`).
        """
        if n_parts > 1 and self._pool is None:
            self._start()
        first, *others = (Part(number, n_parts) for number in range(n_parts))
        if self._pool is None:
            for part in (first, *others):
                function(part, *arguments)
            return
        self.is_idle = False
        futures = [self._pool.submit(function, part, *arguments) for part in others]
        try:
            function(first, *arguments)
        finally:
            # The parts work on arrays that belong to the caller afterwards.
            errors = [future.exception() for future in futures]
        self.is_idle = True
        for error in errors:
            if error is not None:
                raise error

    def _start(self) -> None:
        """Start all threads; `submit` later never starts one, which could fail halfway."""
        pool = ThreadPoolExecutor(self.n_threads - 1, 'gp_ground_seg')
        all_started = threading.Event()
        try:
            for _ in range(self.n_threads - 1):
                pool.submit(all_started.wait)
        except RuntimeError:  # the system has no thread left
            pool.shutdown(wait=False, cancel_futures=True)
            self.n_threads = 1
        else:
            self._pool = pool
        finally:
            all_started.set()

    def close(self) -> None:
        """End the threads; they start again if they are needed again."""
        if self._pool is not None:
            self._pool.shutdown()
            self._pool = None
