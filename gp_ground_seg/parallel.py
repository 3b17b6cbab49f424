"""Rows of work shared out over threads."""

from __future__ import annotations

import os
import weakref
from collections.abc import Callable, Sequence
from itertools import pairwise
from threading import Lock, Thread
from typing import Any

FEWEST_POINTS = 4096
"""Points below which sharing out costs more than it saves."""
MOST_UNASKED = 4
"""Threads that are taken without being asked for: each of them costs a wake-up in every stage,
more than its share of what is left is worth."""


class _Worker:
    """Thread that waits for one call at a time.

    Two bare locks: an executor with its queue and futures takes longer to pass a call on,
    and some calls are as short as that.
    """

    def __init__(self) -> None:
        self._call: tuple[Callable[..., None], tuple[Any, ...]] | None = None
        self._error: BaseException | None = None
        self._go, self._done = Lock(), Lock()
        self._go.acquire()
        self._done.acquire()
        self._is_busy = False
        Thread(target=self._work, name='gp_ground_seg', daemon=True).start()

    def start(self, function: Callable[..., None], arguments: tuple[Any, ...]) -> None:
        """Call ``function(*arguments)`` in the thread."""
        if self._is_busy:  # whoever waited was interrupted
            self._done.acquire()
        self._call, self._is_busy, self._error = (function, arguments), True, None
        self._go.release()

    def wait(self) -> BaseException | None:
        """Wait until the call has returned; what it raised."""
        self._done.acquire()
        self._is_busy = False
        return self._error

    def end(self) -> None:
        """End the thread."""
        if self._is_busy:
            self._done.acquire()
        self._call = None
        self._go.release()

    def _work(self) -> None:
        while True:
            self._go.acquire()
            if self._call is None:
                return
            function, arguments = self._call
            try:
                function(*arguments)
            except BaseException as error:
                self._error = error
            # Nothing is held until the next call: frames are large.
            self._call = None
            del function, arguments
            self._done.release()


class Begun:
    """A call that a worker, if there is one, has begun."""

    def __init__(
        self,
        workers: list[_Worker],
        function: Callable[..., None],
        arguments: tuple[Any, ...],
    ) -> None:
        self._workers = workers
        self._call = None if workers else lambda: function(*arguments)
        self._error: BaseException | None = None
        for worker in workers:
            worker.start(function, arguments)

    def finish(self) -> None:
        """Wait until it is done, and raise what it raised."""
        if self._call is not None:
            self._call()
            self._call = None
        self.drop()
        if self._error is not None:
            raise self._error

    def drop(self) -> None:
        """Make sure that nobody works at it any more; `finish` may be called later."""
        while self._workers:
            self._error = self._workers.pop().wait()


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
        self._workers = [_Worker() for _ in range(self.n_threads - 1)]
        self._begun: Begun | None = None
        self._end = weakref.finalize(self, _end_all, self._workers)

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

    def begin(self, function: Callable[..., None], *arguments: Any) -> Begun:
        """Begin ``function(*arguments)`` beside what the caller goes on to do.

        With one thread, it is done when it is asked for. Before anything else is shared
        out, it is waited for.
        """
        self._settle()
        self._begun = Begun(self._workers[:1], function, arguments)
        return self._begun

    def _settle(self) -> None:
        if self._begun is not None:
            self._begun.drop()
            self._begun = None

    def _blocks(self, n_rows: int) -> list[tuple[int, int]]:
        n_shares = self.n_shares(n_rows)
        return list(pairwise(n_rows * k // n_shares for k in range(n_shares + 1)))

    def _run(
        self,
        function: Callable[..., None],
        shares: Sequence[tuple[int, ...]],
        arguments: tuple[Any, ...],
    ) -> None:
        self._settle()
        # As many as there are shares: small clouds are not shared out.
        workers = self._workers[: len(shares) - 1]
        for worker, share in zip(workers, shares[1:], strict=True):
            worker.start(function, (*share, *arguments))
        try:
            function(*shares[0], *arguments)
        finally:
            # All of them: they work on arrays that are the caller's again afterwards.
            errors = [worker.wait() for worker in workers]
        for error in errors:
            if error is not None:
                raise error

    def close(self) -> None:
        """End the threads."""
        self._settle()
        self._end()


def _end_all(workers: list[_Worker]) -> None:
    while workers:
        workers.pop().end()
