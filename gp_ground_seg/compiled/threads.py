"""Work shared out over the threads of ``concurrent.futures``."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import numpy as np

from gp_ground_seg.frame import IntArray
from gp_ground_seg.jit import JIT_ENABLED

MIN_POINTS_TO_SPLIT = 4096
"""Points below which sharing out costs more than it saves."""
DEFAULT_MAX_THREADS = 4
"""Most threads where their number is not given: each has tables to fill and a wake-up, which
costs more than a small part of the work saves."""


class Part(NamedTuple):
    """A part of the work: points or segments `first` to `stop` - 1; parts count from 0."""

    number: int
    first: int
    stop: int


def equal_parts(n: int, n_parts: int) -> list[Part]:
    """Split n points into parts of equal size."""
    edges = [n * k // n_parts for k in range(n_parts + 1)]
    return [Part(k, edges[k], edges[k + 1]) for k in range(n_parts)]


def parts_of_segments(offsets: IntArray, n_parts: int) -> list[Part]:
    """Split segments into parts of equal cost, which grows as the square of their size.

    Parameters
    ----------
    offsets : (M + 1,) int64
        Values of segment m are ``offsets[m]:offsets[m + 1]``.
    n_parts : int
        Number of parts.
    """
    n_segments = len(offsets) - 1
    if n_parts == 1:
        return [Part(0, 0, n_segments)]
    cost = np.cumsum(np.diff(offsets) ** 2)
    wanted = cost[-1] * np.arange(1, n_parts) / n_parts
    edges = [0, *np.searchsorted(cost, wanted).tolist(), n_segments]
    return [Part(k, edges[k], edges[k + 1]) for k in range(n_parts)]


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
    """

    def __init__(self, n_threads: int) -> None:
        wanted = n_threads or min(len(os.sched_getaffinity(0)), DEFAULT_MAX_THREADS)
        self.n_threads = wanted if JIT_ENABLED else 1
        self._pool: ThreadPoolExecutor | None = None

    def n_parts(self, n_points: int) -> int:
        """Return the number of parts that so many points are split into."""
        return self.n_threads if n_points >= MIN_POINTS_TO_SPLIT else 1

    def run(self, function: Callable[..., None], parts: list[Part], *arguments: Any) -> None:
        """Call ``function(part, *arguments)`` for each part; return when all are done.

        Raises
        ------
        Exception
            The first error of a part, after all parts have ended.
        """
        if len(parts) > 1 and self._pool is None:
            self._start()
        if len(parts) == 1 or self._pool is None:
            for part in parts:
                function(part, *arguments)
            return
        futures = [self._pool.submit(function, part, *arguments) for part in parts[1:]]
        try:
            function(parts[0], *arguments)
        finally:
            # The parts work on arrays that belong to the caller afterwards.
            errors = [future.exception() for future in futures]
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
            all_started.set()
            pool.shutdown(cancel_futures=True)
            self.n_threads = 1
        else:
            all_started.set()
            self._pool = pool

    def close(self) -> None:
        """End the threads; they start again if they are needed again."""
        if self._pool is not None:
            self._pool.shutdown()
            self._pool = None
