"""Rows of work in fixed chunks over threads."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

CHUNK = 15
"""Rows per chunk: fixed, so that results do not depend on the number of threads."""


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
        """Call `function` for each chunk of rows; it must release the GIL to gain anything."""
        if self._executor is None:
            function(0, n_rows, *arguments)
            return
        starts = range(0, n_rows, CHUNK)
        futures = [
            self._executor.submit(function, start, min(start + CHUNK, n_rows), *arguments)
            for start in starts
        ]
        for future in futures:
            future.result()

    def close(self) -> None:
        """End the threads."""
        if self._executor is not None:
            self._executor.shutdown()
