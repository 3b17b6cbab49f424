"""Rows of work in fixed chunks over threads."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

# Rows per chunk: fixed, so that results do not depend on the number of threads.
SEGMENT_CHUNK = 15
POINT_CHUNK = 16384


class RowPool:
    """Runs ``function(start, stop, ...)`` over ranges of rows.

    Parameters
    ----------
    n_threads : int
        Number of threads; 0 = all cores of this process.
    """

    def __init__(self, n_threads: int) -> None:
        self.n_threads = n_threads or len(os.sched_getaffinity(0))
        self._executor = (
            ThreadPoolExecutor(self.n_threads, 'gp_ground_seg') if self.n_threads > 1 else None
        )

    def run(self, function: Callable[..., None], n_rows: int, *arguments: Any) -> None:
        """Call `function` for chunks of segments; it must release the GIL to gain anything."""
        self._run(SEGMENT_CHUNK, function, n_rows, arguments)

    def run_points(self, function: Callable[..., None], n_rows: int, *arguments: Any) -> None:
        """Call `function` for chunks of points."""
        self._run(POINT_CHUNK, function, n_rows, arguments)

    def _run(
        self, chunk: int, function: Callable[..., None], n_rows: int, arguments: tuple[Any, ...]
    ) -> None:
        if self._executor is None or n_rows <= chunk:
            function(0, n_rows, *arguments)
            return
        futures = [
            self._executor.submit(function, start, min(start + chunk, n_rows), *arguments)
            for start in range(0, n_rows, chunk)
        ]
        for future in futures:
            future.result()

    def close(self) -> None:
        """End the threads."""
        if self._executor is not None:
            self._executor.shutdown()
