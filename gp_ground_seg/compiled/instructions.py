"""What compiled code cannot say in Python: instructions made by hand, and calls of the C library.

Where nothing is compiled, one thread has the twins in plain Python that it needs.
"""

from __future__ import annotations

import ctypes
from typing import Any

import numpy as np
import numpy.typing as npt

from gp_ground_seg.jit import COMPILES

if COMPILES:
    from llvmlite import ir
    from numba import types
    from numba.core import cgutils
    from numba.extending import intrinsic

Rows = npt.NDArray[np.int64]
"""Whole numbers (R, W), C-contiguous; the first of a row is what is worked with."""

CALL_SIZE = 4096
"""Bytes that a call can be kept in."""
# What compiled functions return, see `numba.core.callconv`.
_OK, _NONE = 0, -2


def _plain_add(rows: Rows, row: int, amount: int) -> int:
    before = int(rows[row, 0])
    rows[row, 0] += amount
    return before


def _plain_look(rows: Rows, row: int) -> int:
    return int(rows[row, 0])


def _place_of(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    """Pointer to the first number of a row."""
    kind = signature.args[0]
    array = context.make_array(kind)(context, builder, arguments[0])
    place = [arguments[1], context.get_constant(types.intp, 0)]
    return cgutils.get_item_pointer(context, builder, kind, array, place)


def _atomic_add(typing_context: Any, rows: Any, row: Any, amount: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        pointer = _place_of(context, builder, signature, arguments)
        return builder.atomic_rmw('add', pointer, arguments[2], 'seq_cst')

    return types.int64(rows, types.intp, types.int64), generate


def _atomic_put(typing_context: Any, rows: Any, row: Any, number: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        pointer = _place_of(context, builder, signature, arguments)
        return builder.atomic_rmw('xchg', pointer, arguments[2], 'seq_cst')

    return types.int64(rows, types.intp, types.int64), generate


def _atomic_look(typing_context: Any, rows: Any, row: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        pointer = _place_of(context, builder, signature, arguments)
        return builder.load_atomic(pointer, 'acquire', 8)

    return types.int64(rows, types.intp), generate


def _address(typing_context: Any, rows: Any, row: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        pointer = _place_of(context, builder, signature, arguments)
        return builder.ptrtoint(pointer, ir.IntType(64))

    return types.int64(rows, types.intp), generate


def _keep_own_call(typing_context: Any, rows: Any, row: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        own = builder.function
        # The first two are where numba wants to be told of a result and an exception.
        kept = own.args[2:]
        layout = ir.LiteralStructType([argument.type for argument in kept])
        size = context.get_abi_sizeof(layout)
        if size > CALL_SIZE:
            raise ValueError(f'{own.name}: too many arguments, {size} of {CALL_SIZE} bytes')
        pointer = _place_of(context, builder, signature, arguments)
        place = builder.bitcast(pointer, layout.as_pointer())
        for k, argument in enumerate(kept):
            value = ir.Constant(argument.type, None) if _is_owner(argument) else argument
            builder.store(value, cgutils.gep_inbounds(builder, place, 0, k))
        return builder.ptrtoint(_calling_again(own, layout), ir.IntType(64))

    return types.int64(rows, types.intp), generate


def _is_owner(argument: Any) -> bool:
    """Whether an argument of a compiled function is a reference to an array's owner."""
    # Of each array numba passes on the counter of its users, the object, then numbers.
    is_pointer = isinstance(argument.type, ir.PointerType)
    return is_pointer and argument.name.endswith(('.0', '.1'))


def _calling_again(own: Any, layout: Any) -> Any:
    """Make the function (address of kept arguments, first argument) -> whether it went well."""
    number = ir.IntType(64)
    kind = ir.FunctionType(number, [number, number])
    again = ir.Function(own.module, kind, name=own.name + '.again')
    again.linkage = 'internal'
    builder = ir.IRBuilder(again.append_basic_block())
    place = builder.inttoptr(again.args[0], layout.as_pointer())
    values = [
        builder.load(cgutils.gep_inbounds(builder, place, 0, k))
        for k in range(len(layout.elements))
    ]
    values[0] = again.args[1]
    told = [builder.bitcast(builder.alloca(number), argument.type) for argument in own.args[:2]]
    code = builder.call(own, [*told, *values])
    is_fine = [builder.icmp_signed('==', code, ir.Constant(code.type, k)) for k in (_OK, _NONE)]
    builder.ret(builder.zext(builder.or_(*is_fine), number))
    return again


def _call_kept(typing_context: Any, function: Any, kept: Any, first: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        number = ir.IntType(64)
        kind = ir.FunctionType(number, [number, number]).as_pointer()
        return builder.call(builder.inttoptr(arguments[0], kind), arguments[1:])

    return types.int64(types.int64, types.int64, types.int64), generate


def _nothing_is_compiled(*arguments: Any) -> Any:
    raise NotImplementedError('without compiled code there is one thread')


add_to_row: Any = _plain_add
"""Add to a row, at once for all threads, and return what was there: ``(rows, row, amount)``."""
put_in_row: Any = _nothing_is_compiled
"""Put a number in a row, at once for all threads, and return what was there."""
look_at_row: Any = _plain_look
"""What is in a row now, and what was written before that was: ``(rows, row)``."""
pause: Any = _nothing_is_compiled
"""Let others use the core for some microseconds."""
address_of_row: Any = _nothing_is_compiled
"""Address of a row in memory: ``(rows, row)``."""
keep_own_call: Any = _nothing_is_compiled
"""Keep the arguments of the compiled function that this is in: ``(rows, row)``.

They are put into `CALL_SIZE` bytes from that row on. The result is what `call_kept` takes
for its function. Arrays are lent: the call does not count among their users, and is to be
over before they are gone.
"""
call_kept: Any = _nothing_is_compiled
"""Call a function as before but for the first argument: ``(function, address, first)``.

The address is that of the arguments that were kept. Returns whether it went well.
"""
wake: Any = _nothing_is_compiled
"""Wake who sleeps, or will, by the semaphore at an address."""
sleep: Any = _nothing_is_compiled
"""Sleep by the semaphore at an address until woken, or for less."""

if COMPILES:
    add_to_row, look_at_row = intrinsic(_atomic_add), intrinsic(_atomic_look)
    put_in_row, address_of_row = intrinsic(_atomic_put), intrinsic(_address)
    keep_own_call, call_kept = intrinsic(_keep_own_call), intrinsic(_call_kept)
    pause = types.ExternalFunction('usleep', types.int32(types.uint32))
    wake = types.ExternalFunction('sem_post', types.int32(types.int64))
    sleep = types.ExternalFunction('sem_wait', types.int32(types.int64))


def make_semaphore(rows: Rows, row: int) -> None:
    """Make a row what `wake` and `sleep` take the address of."""
    if COMPILES:
        address = rows.ctypes.data + row * rows.strides[0]
        ctypes.CDLL(None).sem_init(ctypes.c_void_p(address), 0, 0)
