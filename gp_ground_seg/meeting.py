"""Threads that meet inside compiled code: calls to join, blocks to claim, stages to wait for.

To wake a thread, and to hand over the interpreter's lock, takes a tenth of a millisecond,
and a frame has several occasions. Threads that stay in compiled code meet within less than
a microsecond, and need no lock. All of it goes by a board of whole numbers, see
`make_board`.
"""

from __future__ import annotations

import time
from threading import Lock
from typing import Any

import numpy as np
import numpy.typing as npt

from gp_ground_seg.compiled import COMPILES, compiled, inlined

if COMPILES:
    from llvmlite import ir
    from numba import types
    from numba.core import cgutils
    from numba.extending import intrinsic

Board = npt.NDArray[np.int64]

TO_JOIN, TO_BEGIN = -1, -2
"""Instead of a share, see `enlist`."""
_CACHE_LINE = 8  # whole numbers: two threads that count do not hinder each other
GIVEN_UP = 0
"""Row of the board: how many threads failed."""
# Other rows: how often there was a call; whether somebody may still be at it; what is
# called, and with what.
_POSTED, _IS_OPEN, _FUNCTION, _ARGUMENTS = 1, 2, 3, 4
_MOST_ARGUMENTS = 64  # rows
_FIRST_WORKER = _ARGUMENTS + _MOST_ARGUMENTS
# For each worker: what it sleeps by; who was first to take the call; whether it is done.
_SLEEP, _TICKET, _IS_DONE = range(3)
_ROWS = 3
# In looks at the board, of a few nanoseconds each: some 100 us.
_BEFORE_SLEEP = 40_000
_PAUSE = 50  # us


def make_board(n_stages: int, n_shares: int) -> Board:
    """Board for that many stages in that many threads, none of which has begun."""
    n_rows = _FIRST_WORKER + _ROWS * (n_shares - 1) + n_stages * (1 + n_shares)
    return np.zeros((n_rows, _CACHE_LINE), dtype=np.int64)


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


def _address_of_row(typing_context: Any, board: Any, row: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        pointer = _place_of(context, builder, signature, arguments)
        return builder.ptrtoint(pointer, ir.IntType(64))

    return types.int64(board, types.intp), generate


def _keep_own_call(typing_context: Any, board: Any, row: Any) -> Any:
    """Keep what the function that this is in was called with, from a row on.

    What comes back is the address of a function that calls it so again, but for the first
    argument, and returns whether that went well. Arrays are lent: nobody counts who uses
    them.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        pointer = _place_of(context, builder, signature, arguments)
        own = builder.function
        kept = own.args[2:]
        layout = ir.LiteralStructType([argument.type for argument in kept])
        size = context.get_abi_sizeof(layout)
        if size > 8 * _CACHE_LINE * _MOST_ARGUMENTS:
            raise ValueError(f'{own.name}: too many arguments, {size} bytes')
        place = builder.bitcast(pointer, layout.as_pointer())
        for k, argument in enumerate(kept):
            value = ir.Constant(argument.type, None) if _owns(argument) else argument
            builder.store(value, cgutils.gep_inbounds(builder, place, 0, k))

        number = ir.IntType(64)
        again = ir.Function(
            builder.module,
            ir.FunctionType(number, [number, number]),
            name=own.name + '.again',
        )
        again.linkage = 'internal'
        inside = ir.IRBuilder(again.append_basic_block())
        place = inside.inttoptr(again.args[0], layout.as_pointer())
        values = [inside.load(cgutils.gep_inbounds(inside, place, 0, k)) for k in range(len(kept))]
        values[0] = again.args[1]
        # Where a result, which there is none of, and an exception would be told.
        told = [inside.bitcast(inside.alloca(number), argument.type) for argument in own.args[:2]]
        code = inside.call(own, [*told, *values])
        went_well = inside.or_(
            inside.icmp_signed('==', code, ir.Constant(code.type, 0)),
            inside.icmp_signed('==', code, ir.Constant(code.type, -2)),  # None
        )
        inside.ret(inside.zext(went_well, number))
        return builder.ptrtoint(again, number)

    return types.int64(board, types.intp), generate


def _owns(argument: Any) -> bool:
    """Whether an argument of a compiled function is a reference to an array's owner."""
    name = argument.name
    is_pointer = isinstance(argument.type, ir.PointerType)
    return is_pointer and (name.endswith('.0') or name.endswith('.1'))


def _call_kept(typing_context: Any, function: Any, address: Any, share: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        number = ir.IntType(64)
        kind = ir.FunctionType(number, [number, number]).as_pointer()
        return builder.call(builder.inttoptr(arguments[0], kind), arguments[1:])

    return types.int64(types.int64, types.int64, types.int64), generate


if COMPILES:
    # Add to a row of the board, at once for all threads, and return what was there; see
    # what is there now.
    _add: Any = intrinsic(_atomic_add)
    _look: Any = intrinsic(_atomic_look)
    _address: Any = intrinsic(_address_of_row)
    _keep_call: Any = intrinsic(_keep_own_call)
    _call: Any = intrinsic(_call_kept)
    _usleep: Any = types.ExternalFunction('usleep', types.int32(types.uint32))
    _sem_post: Any = types.ExternalFunction('sem_post', types.int32(types.int64))
    _sem_wait: Any = types.ExternalFunction('sem_wait', types.int32(types.int64))
else:
    _add, _look = _plain_add, _plain_look

    def _usleep(pause: int) -> None:
        time.sleep(1e-6 * pause)


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
    its arrays, the workers know until they are dismissed, see `dismiss`.

    Returns
    -------
    int
        Share of this call. 0 where `share` was `TO_JOIN`, -1 where it was `TO_BEGIN`: then
        the function is to return. Otherwise `share`, and nobody else is called.
    """
    if share < 0:
        if n_shares > 1:
            board[_FUNCTION, 0] = _keep_call(board, _ARGUMENTS)
            _post(board, n_shares)
        share = 0 if share == TO_JOIN else -1
    return share


@compiled
def _post(board: Board, n_shares: int) -> None:
    board[_IS_OPEN, 0] = 1
    for share in range(1, n_shares):
        row = _own_row(share)
        board[row + _IS_DONE, 0] = 0
        # From here on it may be taken, by who still was to look for the one before.
        _add(board, row + _TICKET, -_look(board, row + _TICKET))
    _add(board, _POSTED, 1)
    for share in range(1, n_shares):
        _sem_post(_address(board, _own_row(share) + _SLEEP))


@compiled
def send_home(board: Board, n_shares: int) -> None:
    """End `serve` in all workers."""
    board[_FUNCTION, 0] = 0
    _post(board, n_shares)


@compiled
def dismiss(board: Board, n_shares: int) -> None:
    """Wait until no worker is at what it was called for; who has not begun never will."""
    if board[_IS_OPEN, 0] == 0:
        return
    board[_IS_OPEN, 0] = 0
    for share in range(1, n_shares):
        row = _own_row(share)
        if _add(board, row + _TICKET, 1) > 0:
            n_looks = 0
            while _look(board, row + _IS_DONE) == 0:
                n_looks += 1
                if n_looks > _BEFORE_SLEEP:
                    _usleep(_PAUSE)


@compiled
def serve(board: Board, share: int, n_shares: int) -> None:
    """Do what others are called for, as that share, until sent home."""
    row, seen = _own_row(share), 0
    while True:
        while _look(board, _POSTED) == seen:
            _sem_wait(_address(board, row + _SLEEP))
        seen = _look(board, _POSTED)
        if _add(board, row + _TICKET, 1) == 0:
            if board[_FUNCTION, 0] == 0:
                break
            if not _call(board[_FUNCTION, 0], _address(board, _ARGUMENTS), share):
                give_up(board)
            _add(board, row + _IS_DONE, 1)


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
        # Some nanoseconds, at nobody's expense.
        _add(board, row + 1 + share, 0)
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
    return _FIRST_WORKER + _ROWS * (n_shares - 1) + stage * (1 + n_shares)


@compiled
def give_up(board: Board) -> None:
    """Tell the others that what this thread has claimed will never be done."""
    _add(board, GIVEN_UP, 1)
