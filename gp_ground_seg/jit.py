"""The one policy for code compiled with numba, which is optional.

A function decorated with `compiled` is compiled where numba is installed and
stays plain Python elsewhere. Compiled functions release the GIL, so that the
caller can run them in threads, each on its own range of rows.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

try:
    import numba
except ImportError:  # Ubuntu 24.04 has no package of it
    numba = None

_LOGGER = logging.getLogger('gp_ground_seg')
_Function = TypeVar('_Function', bound=Callable[..., Any])

HAVE_NUMBA = numba is not None
COMPILES = HAVE_NUMBA and not numba.config.DISABLE_JIT
"""Whether functions are compiled, and do not stay plain Python."""

_dispatchers: list[Any] = []


def compiled(function: _Function) -> _Function:
    """Compile `function` where numba is installed; the code is kept on disk if possible."""
    return _compile(function, frozenset())


def compiled_vectors(function: _Function) -> _Function:
    """Compile like `compiled`, and let sums be taken in any order.

    Sums then use vector instructions. The order is fixed by the compiler, not by the
    number of threads; NaN and infinity keep their meaning.
    """
    return _compile(function, frozenset({'reassoc', 'contract', 'nsz'}))


def inlined(function: _Function) -> _Function:
    """Make `function` a part of the compiled functions that call it.

    It is never compiled by itself, which takes longer than the work it does in them; sums
    are taken in the order that those say.
    """
    if not COMPILES:
        return function
    part: _Function = numba.njit(inline='always', nogil=True, error_model='numpy')(function)
    return part


def _compile(function: _Function, fastmath: frozenset[str]) -> _Function:
    if not COMPILES:
        return function
    result = numba.njit(nogil=True, error_model='numpy', fastmath=set(fastmath))(function)
    try:
        from gp_ground_seg.compiled.compile_cache import KeptCode

        result._cache = KeptCode(function)
    except Exception as error:
        # Parts of numba that it may change at will; without them it compiles at every start.
        _LOGGER.warning('compiled code is not kept on disk: %r', error)
    _dispatchers.append(result)
    kept: _Function = result
    return kept


def compiled_signatures() -> dict[str, int]:
    """Count the signatures that each compiled function was compiled or loaded for so far."""
    return {
        f'{d.py_func.__module__}.{d.py_func.__qualname__}': len(d.signatures) for d in _dispatchers
    }


def is_code_kept() -> bool:
    """Stub of the lead's function: whether all code that a frame needs lies on disk."""
    from gp_ground_seg.backend import warm_up
    from gp_ground_seg.compiled.compile_cache import CodeNotKeptError, refusing

    try:
        with refusing('compilation'):
            warm_up().close()
    except CodeNotKeptError:
        return False
    return True


def code_folder() -> Path | None:
    """Stub of the lead's function: folder where compiled code is kept."""
    return Path(_dispatchers[0].stats.cache_path) if _dispatchers else None
