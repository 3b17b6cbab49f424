"""Threads that meet inside compiled code: blocks to claim, stages to wait for.

To wake a thread, and to hand over the interpreter's lock, takes a tenth of a millisecond,
and a frame has several occasions. Threads that stay in compiled code meet within less than
a microsecond. All of it goes by a board of whole numbers, see `make_board`.
"""

from __future__ import annotations

import time
from threading import Lock
from typing import Any

import numpy as np
import numpy.typing as npt

from gp_ground_seg.compiled import COMPILES, compiled, inlined

if COMPILES:
    from numba import types
    from numba.core import cgutils
    from numba.extending import intrinsic

Board = npt.NDArray[np.int64]

GIVEN_UP, SETTLED = 0, 1
"""Rows of the board: threads that failed; how many of the others have settled."""
_FIRST_STAGE = 2
_CACHE_LINE = 8  # whole numbers: two threads that count do not hinder each other
# In looks at the board, of a few nanoseconds each: some 100 and 50 us.
_BEFORE_SLEEP = 40_000 if COMPILES else 0
_FOR_OTHERS = 20_000 if COMPILES else 0
_PAUSE = 50  # us


def make_board(n_stages: int, n_shares: int) -> Board:
    """Board for that many stages in that many threads, none of which has begun."""
    return np.zeros((_FIRST_STAGE + n_stages * (1 + n_shares), _CACHE_LINE), dtype=np.int64)


_lock = Lock()


def _plain_add(board: Board, row: int, amount: int) -> int:
    with _lock:
        before = int(board[row, 0])
        board[row, 0] += amount
    return before


def _plain_look(board: Board, row: int) -> int:
    return int(board[row, 0])


def _place_of(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    kind = signature.args[0]
    array = context.make_array(kind)(context, builder, arguments[0])
    place = [arguments[1], context.get_constant(types.intp, 0)]
    return cgutils.get_item_pointer(context, builder, kind, array, place)


def _atomic_add(typing_context: Any, board: Any, row: Any, amount: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        pointer = _place_of(context, builder, signature, arguments)
        return builder.atomic_rmw('add', pointer, arguments[2], 'seq_cst')

    return types.int64(board, types.intp, types.int64), generate


def _atomic_look(typing_context: Any, board: Any, row: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        pointer = _place_of(context, builder, signature, arguments)
        return builder.load_atomic(pointer, 'acquire', 8)

    return types.int64(board, types.intp), generate


if COMPILES:
    # Add to a row of the board, at once for all threads, and return what was there; see
    # what is there now.
    _add: Any = intrinsic(_atomic_add)
    _look: Any = intrinsic(_atomic_look)
    _usleep: Any = types.ExternalFunction('usleep', types.int32(types.uint32))
else:
    _add, _look = _plain_add, _plain_look

    def _usleep(pause: int) -> None:
        time.sleep(1e-6 * pause)


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
        block: int = first + _add(board, row + 1 + owner, 1)
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
    n_done = _add(board, row, n_own) + n_own
    n_looks = 0
    while n_done < n_blocks:
        if _look(board, GIVEN_UP) > 0:
            return False
        n_looks += 1
        if n_looks > _BEFORE_SLEEP:
            _usleep(_PAUSE)
        _breathe(board, row + 1 + share)
        n_done = _look(board, row)
    return True


@inlined
def n_taken(board: Board, stage: int, share: int, n_shares: int) -> int:
    """Blocks of a stage, once all are done, that a thread did."""
    number: int = board[_first_row(stage, n_shares) + 1 + share, 1]
    return number


@inlined
def _first_row(stage: int, n_shares: int) -> int:
    """Row of the board with the number of blocks done; those of what is gone follow."""
    return _FIRST_STAGE + stage * (1 + n_shares)


@inlined
def _breathe(board: Board, own_row: int) -> None:
    """Take some nanoseconds, at nobody's expense."""
    _add(board, own_row, 0)


@compiled
def give_up(board: Board) -> None:
    """Tell the others that what this thread has claimed will never be done."""
    _add(board, GIVEN_UP, 1)


@compiled
def settle(board: Board) -> None:
    """Tell that this thread goes to sleep, or on in compiled code: it needs no lock any more."""
    _add(board, SETTLED, 1)


@compiled
def await_settled(board: Board, share: int, number: int) -> None:
    """Give others the time to `settle`, so often in all: two that want the lock wait longer.

    That is what share 0 does. Not for ever: one that has not woken up will not be in the
    way either.
    """
    for _ in range(_FOR_OTHERS):
        if share > 0 or _look(board, SETTLED) >= number:
            break
        _breathe(board, GIVEN_UP)
