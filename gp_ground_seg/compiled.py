"""The one policy for code compiled with numba, which is optional.

A function decorated with `compiled` is compiled where numba is installed and
stays plain Python elsewhere. Compiled functions release the GIL, so that the
caller can run them in threads, each on its own range of rows.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Any, TypeVar

try:
    import numba
except ImportError:  # Ubuntu 24.04 has no package of it
    numba = None

_LOGGER = logging.getLogger(__name__)
_Function = TypeVar('_Function', bound=Callable[..., Any])

HAVE_NUMBA = numba is not None


def compiled(function: _Function) -> _Function:
    """Compile `function` where numba is installed, with a cache on disk if one is writable."""
    if numba is None:
        return function
    options = {'nogil': True, 'error_model': 'numpy'}
    try:
        result: _Function = numba.njit(cache=True, **options)(function)
    except RuntimeError:
        # numba found no writable place for its cache: compile anew in each process.
        _LOGGER.info('no writable cache for compiled code; it is compiled at every start')
        result = numba.njit(**options)(function)
    return result
