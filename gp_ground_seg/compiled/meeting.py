"""Threads that meet inside compiled code: calls to join, blocks to claim, stages to wait for.

To wake a thread, and to hand over the interpreter's lock, takes a tenth of a millisecond,
and a frame has several occasions. Threads that stay in compiled code meet within less than
a microsecond, and need no lock. All of it goes by a board of whole numbers, see
`make_board`.
"""

from __future__ import annotations

import numpy as np

from gp_ground_seg.compiled.instructions import (
    CALL_SIZE,
    Rows,
    add_to_row,
    address_of_row,
    call_kept,
    keep_own_call,
    look_at_row,
    make_semaphore,
    pause,
    put_in_row,
    sleep,
    wake,
)
from gp_ground_seg.jit import compiled, inlined

Board = Rows

TO_JOIN, TO_FOLLOW = -1, -2
"""Instead of a share, see `enlist`."""
_CACHE_LINE = 8  # whole numbers: two threads that count do not hinder each other
GIVEN_UP = 0
"""Row of the board: how many threads failed."""
# Other rows: how often there was a call; whether somebody may still be at it; the function
# that is called, and in the rows behind what it is called with; the same of what follows.
_POSTED, _IS_OPEN, _CALLED = 1, 2, 3
_FOLLOWS = _CALLED + 1 + CALL_SIZE // (8 * _CACHE_LINE)
_FIRST_WORKER = _FOLLOWS + 1 + CALL_SIZE // (8 * _CACHE_LINE)
# For each worker: what it sleeps by; who was first to take the call; whether it is done.
_SLEEP, _TICKET, _IS_DONE = range(3)
_ROWS = 3
# In looks at the board, of a few nanoseconds each: some 100 us.
_BEFORE_SLEEP = 40_000
_PAUSE = 50  # us


def make_board(n_stages: int, n_shares: int) -> Board:
    """Board for that many stages in that many threads, none of which has begun."""
    n_rows = _FIRST_WORKER + _ROWS * (n_shares - 1) + n_stages * (1 + n_shares)
    board = np.zeros((n_rows, _CACHE_LINE), dtype=np.int64)
    for share in range(1, n_shares):
        make_semaphore(board, _FIRST_WORKER + _ROWS * (share - 1) + _SLEEP)
    return board


@inlined
def _own_row(share: int) -> int:
    """First row of the board that is about a worker."""
    return _FIRST_WORKER + _ROWS * (share - 1)


@compiled
def clear(board: Board, n_shares: int) -> None:
    """Begin all stages anew; no worker is at any."""
    board[GIVEN_UP, 0] = 0
    for row in range(_first_row(0, n_shares), len(board)):
        board[row, 0] = board[row, 1] = 0


@inlined
def enlist(board: Board, share: int, n_shares: int) -> int:
    """Have the workers call the function that this is in, with their shares.

    The first thing that a function does that shares out its work. Of such a call, and of
    its arrays, the workers know until they are dismissed, see `dismiss`. (`share` is to be
    no literal: they would call what was compiled for it alone, and not with their shares.)

    Returns
    -------
    int
        Share of this call. 0 where `share` was `TO_JOIN`, -1 where it was `TO_FOLLOW`: then
        the function is to return, and the workers will go on to it from what they are
        called for next. Otherwise `share`, and nobody else is called.
    """
    if share < 0:
        joins = share == TO_JOIN
        if n_shares > 1:
            row = _CALLED if joins else _FOLLOWS
            board[row, 0] = keep_own_call(board, row + 1)
            if joins:
                _post(board, n_shares)
        share = 0 if joins else -1
    return share


@compiled
def _post(board: Board, n_shares: int) -> None:
    board[_IS_OPEN, 0] = 1
    for share in range(1, n_shares):
        row = _own_row(share)
        board[row + _IS_DONE, 0] = 0
        # From here on it may be taken, by who still was to look for the one before.
        put_in_row(board, row + _TICKET, 0)
    add_to_row(board, _POSTED, 1)
    for share in range(1, n_shares):
        wake(address_of_row(board, _own_row(share) + _SLEEP))


@compiled
def send_home(board: Board, n_shares: int) -> None:
    """End `serve` in all workers."""
    board[_CALLED, 0] = 0
    _post(board, n_shares)


@compiled
def dismiss(board: Board, n_shares: int) -> None:
    """Wait until no worker is at what it was called for; who has not begun never will."""
    if board[_IS_OPEN, 0] != 0:
        board[_IS_OPEN, 0] = 0
        for share in range(1, n_shares):
            row = _own_row(share)
            if add_to_row(board, row + _TICKET, 1) > 0:
                n_looks = 0
                while look_at_row(board, row + _IS_DONE) == 0:
                    n_looks += 1
                    if n_looks > _BEFORE_SLEEP:
                        pause(_PAUSE)
    board[_FOLLOWS, 0] = 0


@compiled
def serve(board: Board, share: int, n_shares: int) -> None:
    """Do what others are called for, as that share, until sent home."""
    row, seen = _own_row(share), 0
    while True:
        while look_at_row(board, _POSTED) == seen:
            sleep(address_of_row(board, row + _SLEEP))
        seen = look_at_row(board, _POSTED)
        if add_to_row(board, row + _TICKET, 1) == 0:
            if board[_CALLED, 0] == 0:
                break
            is_fine = call_kept(board[_CALLED, 0], address_of_row(board, _CALLED + 1), share)
            if is_fine and board[_FOLLOWS, 0] != 0 and look_at_row(board, GIVEN_UP) == 0:
                is_fine = call_kept(board[_FOLLOWS, 0], address_of_row(board, _FOLLOWS + 1), share)
            if not is_fine:
                give_up(board)
            add_to_row(board, row + _IS_DONE, 1)


@compiled
def claim(board: Board, stage: int, share: int, n_shares: int, n_blocks: int) -> int:
    """Next of the `n_blocks` blocks of a stage that nobody has, or -1.

    Each thread begins with its own share, so that it sees neighbours, and helps out with
    the others' when that is done. Which thread does a block is chance. (`stage` is to be no
    literal: for each of those numba would compile anew.)
    """
    row = _first_row(stage, n_shares)
    for k in range(n_shares):
        owner = (share + k) % n_shares
        first = n_blocks * owner // n_shares
        end = n_blocks * (owner + 1) // n_shares
        block: int = first + add_to_row(board, row + 1 + owner, 1)
        if block < end:
            board[row + 1 + share, 1] += 1
            return block
    return -1


@compiled
def all_done(board: Board, stage: int, share: int, n_shares: int, n_blocks: int) -> bool:
    """Wait until all blocks of a stage are done, as are those that this thread claimed.

    Not until all threads are here: one that wakes late finds nothing left to do. Whoever
    waits looks again and again for a while, and then sleeps in between: where there are
    fewer cores than threads the others need this one.

    Returns
    -------
    bool
        False if they never will be: a thread has given up.
    """
    row = _first_row(stage, n_shares)
    n_own = n_taken(board, stage, share, n_shares)
    n_done = add_to_row(board, row, n_own) + n_own
    n_looks = 0
    while n_done < n_blocks:
        if look_at_row(board, GIVEN_UP) > 0:
            return False
        n_looks += 1
        if n_looks > _BEFORE_SLEEP:
            pause(_PAUSE)
        # Some nanoseconds, at nobody's expense.
        add_to_row(board, row + 1 + share, 0)
        n_done = look_at_row(board, row)
    return True


@inlined
def n_taken(board: Board, stage: int, share: int, n_shares: int) -> int:
    """Blocks of a stage, once all are done, that a thread did."""
    number: int = board[_first_row(stage, n_shares) + 1 + share, 1]
    return number


@inlined
def _first_row(stage: int, n_shares: int) -> int:
    """Row of the board with the number of blocks done; those of what is gone follow."""
    return _FIRST_WORKER + _ROWS * (n_shares - 1) + stage * (1 + n_shares)


@compiled
def give_up(board: Board) -> None:
    """Tell the others that what this thread has claimed will never be done."""
    add_to_row(board, GIVEN_UP, 1)
