"""Work shared out over threads."""

from __future__ import annotations

import weakref
from collections.abc import Callable
from threading import Thread
from typing import Any

from gp_ground_seg.compiled.cores import OutOfTheWay, usable_cores
from gp_ground_seg.compiled.meeting import (
    GIVEN_UP,
    TO_FOLLOW,
    TO_JOIN,
    Board,
    clear,
    dismiss,
    give_up,
    make_board,
    send_home,
    serve,
)
from gp_ground_seg.jit import COMPILES

MOST_STAGES = 6
"""Stages of the longest works that follow one another."""
FEWEST_POINTS = 4096
"""Points below which sharing out costs more than it saves."""
MOST_UNASKED = 4
"""Threads that are taken without being asked for: each of them has tables to fill and a wake-up,
more than its share of what is left is worth."""


class Team:
    """Threads that share out the stages of compiled functions, see `compiled.meeting`.

    Such a function takes a share, the number of them and the board before anything else,
    and begins with `gp_ground_seg.compiled.meeting.enlist`.

    Parameters
    ----------
    board : Board
        Where they meet. No other team may be at work there.
    n_shares : int
        Number of threads.
    """

    def __init__(self, board: Board, n_shares: int) -> None:
        self.board, self.n_shares = board, n_shares
        clear(board, n_shares)
        self._rest: Callable[[], None] | None = None

    def run(self, function: Callable[..., None], *arguments: Any) -> None:
        """Call ``function(share, n_shares, board, *arguments)`` in all threads."""
        self._take_part(lambda: function(TO_JOIN, self.n_shares, self.board, *arguments))

    def begin(
        self,
        first: Callable[..., None],
        first_arguments: tuple[Any, ...],
        second: Callable[..., None],
        second_arguments: tuple[Any, ...],
    ) -> None:
        """Take part in the first of two works; the others go on to the second.

        Nobody has to be woken for that, and who called may have something else to see to
        before it helps them, see `finish`.

        Parameters
        ----------
        first, second : callable
            As for `run`; with other stages, so that who is late is told from who is early.
        first_arguments, second_arguments : tuple
            What they take after share, number of shares and board.
        """

        def call(function: Callable[..., None], share: int, arguments: tuple[Any, ...]) -> None:
            function(share, self.n_shares, self.board, *arguments)

        def begin() -> None:
            if self.n_shares > 1:
                call(second, TO_FOLLOW, second_arguments)
            call(first, TO_JOIN, first_arguments)

        self._rest = lambda: call(second, 0, second_arguments)
        self._take_part(begin, others_go_on=True)

    def finish(self) -> bool:
        """Take part in the second work until all of it is done; False if it was dismissed."""
        rest, self._rest = self._rest, None
        if rest is None:
            return False
        self._take_part(rest)
        return True

    def dismiss(self) -> None:
        """Wait until no worker is at it any more, whether or not all of it is done."""
        dismiss(self.board, self.n_shares)
        # Nothing is held until the next call: frames are large.
        self._rest = None

    def _take_part(self, call: Callable[[], None], others_go_on: bool = False) -> None:
        is_over = True
        try:
            call()
            if self.board[GIVEN_UP, 0] > 0:
                raise RuntimeError(
                    'a thread of the segmentation failed, for lack of memory perhaps'
                )
            is_over = not others_go_on
        except BaseException:
            give_up(self.board)
            raise
        finally:
            # They work on arrays that are the caller's again afterwards.
            if is_over:
                self.dismiss()


class RowPool:
    """Threads for compiled functions that share out their work, see `Team`.

    Whatever thread does a block, its results are the same. Where nothing is compiled there
    are no threads: they would only take turns. They start when they are first needed.

    Parameters
    ----------
    n_threads : int
        Number of threads; 0 = all cores of this process, at most `MOST_UNASKED`.
    """

    def __init__(self, n_threads: int) -> None:
        asked = n_threads or min(len(usable_cores()), MOST_UNASKED)
        self.n_threads = asked if COMPILES else 1
        self._boards = {n: make_board(MOST_STAGES, n) for n in {1, self.n_threads}}
        self._out_of_the_way: OutOfTheWay | None = None
        self._team: Team | None = None
        self._end: Callable[[], Any] = lambda: None

    def n_shares(self, n_rows: int) -> int:
        """Into how many threads so many points are worth to be shared out."""
        return self.n_threads if n_rows >= FEWEST_POINTS else 1

    def team(self, n_shares: int) -> Team:
        """Team of that many threads, all or one. The one before is dismissed."""
        self._dismiss()
        if n_shares > 1:
            if self._out_of_the_way is None:
                self._out_of_the_way = OutOfTheWay(self._start())
            self._out_of_the_way.leave_own_core()
        self._team = Team(self._boards[n_shares], n_shares)
        return self._team

    def run(self, function: Callable[..., None], n_shares: int, *arguments: Any) -> None:
        """Call ``function(share, n_shares, board, *arguments)`` in a team."""
        self.team(n_shares).run(function, *arguments)

    def _start(self) -> list[Thread]:
        """Start the threads, of which the caller's is none: it takes a share too."""
        _compile_serve()
        board, n_threads = self._boards[self.n_threads], self.n_threads
        workers = [
            Thread(target=serve, args=(board, k, n_threads), name='gp_ground_seg', daemon=True)
            for k in range(1, n_threads)
        ]
        for worker in workers:
            worker.start()
        self._end = weakref.finalize(self, _end_all, board, n_threads)
        return workers

    def _dismiss(self) -> None:
        if self._team is not None:
            self._team.dismiss()
            self._team = None

    def close(self) -> None:
        """End the threads."""
        self._dismiss()
        self._end()


def _compile_serve() -> None:
    """Have it compiled here and now: threads would all do so, and tell nobody what failed."""
    board = make_board(0, 2)
    send_home(board, 2)
    serve(board, 1, 2)


def _end_all(board: Board, n_threads: int) -> None:
    # What they may still be at is on arrays that go when this returns.
    dismiss(board, n_threads)
    send_home(board, n_threads)
