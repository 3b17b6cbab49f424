"""Work shared out over threads."""

from __future__ import annotations

import weakref
from collections.abc import Callable
from threading import Lock, Thread
from typing import Any

from gp_ground_seg.cores import OutOfTheWay, usable_cores
from gp_ground_seg.meeting import Board, give_up, make_board, settle

MOST_STAGES = 4
"""Stages of the longest work that is shared out."""
FEWEST_POINTS = 4096
"""Points below which sharing out costs more than it saves."""
MOST_UNASKED = 4
"""Threads that are taken without being asked for: each of them has tables to fill and a wake-up,
more than its share of what is left is worth."""


class _Worker:
    """Thread that waits for one call at a time.

    Two bare locks: an executor with its queue and futures takes longer to pass a call on,
    and some calls are as short as that.

    Parameters
    ----------
    board : Board
        Where it tells that it has settled.

    Attributes
    ----------
    thread : Thread
        The thread.
    """

    def __init__(self, board: Board) -> None:
        self._call: tuple[Callable[..., None], tuple[Any, ...]] | None = None
        self._error: BaseException | None = None
        self._go, self._done = Lock(), Lock()
        self._go.acquire()
        self._done.acquire()
        self._is_busy = False
        self.thread = Thread(target=self._work, args=(board,), name='gp_ground_seg', daemon=True)
        self.thread.start()

    def start(self, function: Callable[..., None], arguments: tuple[Any, ...]) -> None:
        """Call ``function(*arguments)`` in the thread, which is at nothing else."""
        self._call, self._is_busy, self._error = (function, arguments), True, None
        self._go.release()

    def wait(self) -> BaseException | None:
        """Wait until the call has returned; what it raised."""
        if self._is_busy:
            self._done.acquire()
        self._is_busy = False
        return self._error

    def end(self) -> None:
        """End the thread."""
        self.wait()
        self._call = None
        self._go.release()

    def _work(self, board: Board) -> None:
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
            settle(board)


class Team:
    """Threads that share out the work of some stages, see `gp_ground_seg.meeting`.

    What the workers do is started once; the caller, share 0, takes part when it likes.

    Attributes
    ----------
    board : Board
        Where they meet.
    """

    def __init__(self, workers: list[_Worker], board: Board) -> None:
        self._idle, self._working = workers, list[_Worker]()
        self.board = board

    def start(self, *functions: Callable[[int], None]) -> None:
        """Have every worker call the functions one after the other, with its share."""
        while self._idle:
            worker = self._idle.pop(0)
            self._working.append(worker)
            worker.start(self._call, (len(self._working), *functions))

    def take_part(self, function: Callable[[int], None]) -> None:
        """Call ``function(0)``; the workers go on meanwhile and after it."""
        try:
            self._call(0, function)
        except BaseException:
            # They work on arrays that are the caller's again afterwards.
            self.settle()
            raise

    def wait(self) -> None:
        """Wait until no worker is at it any more, and raise what they raised."""
        for error in self.settle():
            raise error

    def settle(self) -> list[BaseException]:
        """Wait until no worker is at it any more; what they raised."""
        errors = []
        while self._working:
            error = self._working[-1].wait()
            self._working.pop()
            errors += [error] if error is not None else []
        return errors

    def _call(self, share: int, *functions: Callable[[int], None]) -> None:
        try:
            for function in functions:
                function(share)
        except BaseException:
            give_up(self.board)
            raise


class RowPool:
    """Threads for compiled functions that share out their work, see `gp_ground_seg.meeting`.

    Whatever thread does a block, its results are the same.

    Parameters
    ----------
    n_threads : int
        Number of threads; 0 = all cores of this process, at most `MOST_UNASKED`.
    """

    def __init__(self, n_threads: int) -> None:
        self.n_threads = n_threads or min(len(usable_cores()), MOST_UNASKED)
        self._board = make_board(MOST_STAGES, self.n_threads)
        # The caller's thread takes a share too.
        self._workers = [_Worker(self._board) for _ in range(self.n_threads - 1)]
        self._out_of_the_way = OutOfTheWay([worker.thread for worker in self._workers])
        self._team: Team | None = None
        self._end = weakref.finalize(self, _end_all, self._workers)

    def n_shares(self, n_rows: int) -> int:
        """Into how many threads so many points are worth to be shared out."""
        return self.n_threads if n_rows >= FEWEST_POINTS else 1

    def team(self, n_shares: int) -> Team:
        """Team of that many threads, all or one. The one before is waited for."""
        self._settle()
        self._board.fill(0)
        if n_shares > 1:
            self._out_of_the_way.leave_own_core()
        self._team = Team(self._workers[: n_shares - 1], self._board)
        return self._team

    def run(self, function: Callable[..., None], n_shares: int, *arguments: Any) -> None:
        """Call ``function(share, n_shares, board, *arguments)`` in a team."""
        team = self.team(n_shares)

        def work(share: int) -> None:
            function(share, n_shares, team.board, *arguments)

        team.start(work)
        team.take_part(work)
        team.wait()

    def _settle(self) -> None:
        if self._team is not None:
            self._team.settle()
            self._team = None

    def close(self) -> None:
        """End the threads."""
        self._settle()
        self._end()


def _end_all(workers: list[_Worker]) -> None:
    while workers:
        workers.pop().end()
