"""One thread for BLAS while small systems are solved."""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Iterator
from typing import Any

try:
    from threadpoolctl import ThreadpoolController
except ImportError:  # then BLAS keeps its threads, and takes time from ours
    ThreadpoolController = None


@functools.cache
def _controller() -> Any:
    import scipy.linalg  # noqa: F401 - a BLAS that is loaded later would not be found

    return ThreadpoolController()


@contextlib.contextmanager
def single_threaded_blas() -> Iterator[None]:
    """Keep OpenBLAS from waking its threads within the block.

    SciPy's L-BFGS-B wakes them for systems of a dozen unknowns. They find nothing
    to do, yet spin for milliseconds on the cores that the segments need.
    """
    if ThreadpoolController is None:
        yield
        return
    with _controller().limit(limits=1, user_api='blas'):
        yield
