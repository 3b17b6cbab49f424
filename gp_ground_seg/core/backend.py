"""Compute backends: the stages of a frame in plain numpy, or compiled with numba."""

import logging
from typing import TYPE_CHECKING, TypeAlias

from gp_ground_seg.core.errors import MissingDependencyError, install_hint, log_once
from gp_ground_seg.core.gp import ground, learning
from gp_ground_seg.core.jit import HAVE_NUMBA
from gp_ground_seg.core.parameters.config import RuntimeConfig
from gp_ground_seg.core.pipeline import (
    ground_plane,
    labels,
    lines,
    polar_grid,
    relief,
    vertical_faces,
)

if TYPE_CHECKING:
    from gp_ground_seg.core.compiled.backend import NumbaBackend


class NumpyBackend:
    """The stages of a frame in plain numpy.

    Each takes the values of the stages before and returns new ones.
    """

    name = 'numpy'
    build_grid = staticmethod(polar_grid.build_scan)
    find_planes = staticmethod(ground_plane.find_planes)
    find_faces = staticmethod(vertical_faces.find_faces)
    find_relief = staticmethod(relief.find_relief)
    extract_lines = staticmethod(lines.find_lines)
    learn_frame = staticmethod(learning.learn_frame)
    estimate_surface = staticmethod(ground.estimate_surface)
    label_points = staticmethod(labels.label_points)


Backend: TypeAlias = 'NumpyBackend | NumbaBackend'


def choose_backend(wanted: str) -> str:
    """Return ``numba`` or ``numpy`` for the parameter ``runtime.backend``.

    Raises
    ------
    MissingDependencyError
        If numba is asked for by name and not installed.
    """
    if wanted == 'numba' and not HAVE_NUMBA:
        raise MissingDependencyError(
            f'runtime.backend = numba, but numba is not installed: {install_hint("numba")}; '
            'or set runtime.backend to auto'
        )
    if wanted == 'auto' and not HAVE_NUMBA:
        _warn_slow('is not installed', install_hint('numba'))
    return 'numba' if HAVE_NUMBA and wanted != 'numpy' else 'numpy'


def make_backend(runtime: RuntimeConfig) -> Backend:
    """Backend for the parameters ``runtime``; raises as `choose_backend`."""
    if choose_backend(runtime.backend) == 'numpy':
        return NumpyBackend()
    try:
        # Imported only where it is used, as it imports numba.
        from gp_ground_seg.core.compiled.backend import NumbaBackend
    except Exception as error:  # of many types: a numba that does not fit this numpy, or coverage
        if runtime.backend == 'numba':
            raise MissingDependencyError(f'runtime.backend = numba: {error}') from error
        _warn_slow('cannot be imported', error)
        return NumpyBackend()
    return NumbaBackend()


def _warn_slow(reason: str, more: object) -> None:
    log_once(logging.WARNING, 'numba %s: using numpy, several times slower (%s)', reason, more)
