"""Rows of work shared out over threads."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from itertools import pairwise
from typing import Any

FEWEST_POINTS = 4096
"""Points below which sharing out costs more than it saves."""
MOST_UNASKED = 4
"""Threads that are taken without being asked for: each of them costs a wake-up in every stage,
more than its share of what is left is worth."""


class RowPool:
    """Runs compiled functions on shares of rows, one share in each thread.

    Every row is computed by itself, so the results do not depend on the number of
    threads. There are as many shares as threads, no more: waking a thread costs as
    much as dozens of rows.

    Parameters
    ----------
    n_threads : int
        Number of threads; 0 = all cores of this process, at most `MOST_UNASKED`.
    """

    def __init__(self, n_threads: int) -> None:
        self.n_threads = n_threads or min(len(os.sched_getaffinity(0)), MOST_UNASKED)
        # The caller's thread takes a share too.
        self._executor = (
            ThreadPoolExecutor(self.n_threads - 1, 'gp_ground_seg') if self.n_threads > 1 else None
        )

    def run(self, function: Callable[..., None], n_rows: int, *arguments: Any) -> None:
        """Call ``function(start, stop, step, *arguments)`` for every n-th segment each.

        The function must release the GIL to gain anything. Neighbouring segments
        cost alike, so interleaved shares are even ones.
        """
        shares = [(k, n_rows, self.n_threads) for k in range(self.n_threads)]
        self._run(function, shares, arguments)

    def run_points(self, function: Callable[..., None], n_rows: int, *arguments: Any) -> None:
        """Call ``function(start, stop, *arguments)`` for contiguous blocks of points."""
        self._run(function, self._blocks(n_rows), arguments)

    def n_shares(self, n_rows: int) -> int:
        """Into how many blocks `run_points` and `run_shares` cut that many points."""
        return self.n_threads if n_rows >= FEWEST_POINTS else 1

    def run_shares(self, function: Callable[..., None], n_rows: int, *arguments: Any) -> None:
        """Call ``function(share, start, stop, *arguments)`` for contiguous blocks of points."""
        shares = [(k, *block) for k, block in enumerate(self._blocks(n_rows))]
        self._run(function, shares, arguments)

    def _blocks(self, n_rows: int) -> list[tuple[int, int]]:
        n_shares = self.n_shares(n_rows)
        return list(pairwise(n_rows * k // n_shares for k in range(n_shares + 1)))

    def _run(
        self,
        function: Callable[..., None],
        shares: Sequence[tuple[int, ...]],
        arguments: tuple[Any, ...],
    ) -> None:
        futures: list[Future[None]] = []
        if self._executor is not None:
            futures = [self._executor.submit(function, *s, *arguments) for s in shares[1:]]
        function(*shares[0], *arguments)
        for future in futures:
            future.result()

    def close(self) -> None:
        """End the threads."""
        if self._executor is not None:
            self._executor.shutdown()
