"""Surface of a frame by the backend and threads at hand."""

from __future__ import annotations

import logging

import numpy as np

from gp_ground_seg.compiled import HAVE_NUMBA
from gp_ground_seg.config import Config
from gp_ground_seg.errors import MissingDependencyError
from gp_ground_seg.gp.growth import (
    BoolArray,
    grow_surface_compiled,
    grow_surface_reference,
)
from gp_ground_seg.parallel import RowPool
from gp_ground_seg.polar_grid import Candidates, FloatArray

_LOGGER = logging.getLogger('gp_ground_seg')
_said_slow = False


def choose_backend(wanted: str) -> str:
    """Return ``numba`` or ``numpy`` for the parameter ``runtime.backend``.

    Raises
    ------
    MissingDependencyError
        If numba is asked for by name and not installed.
    """
    global _said_slow
    if wanted == 'numpy':
        return 'numpy'
    if HAVE_NUMBA:
        return 'numba'
    if wanted == 'numba':
        raise MissingDependencyError(
            'runtime.backend = numba, but numba is not installed: pip install numba, '
            'or set runtime.backend to auto'
        )
    if not _said_slow:
        _said_slow = True
        _LOGGER.warning(
            'numba is not installed: using numpy, several times slower (pip install numba)'
        )
    return 'numpy'


def fit_surface(
    candidates: Candidates,
    height: FloatArray,
    length_scale: FloatArray,
    seed: BoolArray,
    knots: FloatArray,
    knot_length_scale: FloatArray,
    config: Config,
    backend: str,
    pool: RowPool,
) -> tuple[BoolArray, FloatArray, FloatArray]:
    """Inliers, mean and standard deviation of the surface.

    Parameters and results are those of `grow_surface_reference`, with `height`
    (C,) [m] the candidates' heights about the prior mean.
    """
    if backend == 'numpy':
        return grow_surface_reference(
            candidates.offsets,
            candidates.r,
            height,
            length_scale,
            seed,
            knots,
            knot_length_scale,
            config.observation,
            config.growth,
        )
    n_segments = len(candidates.offsets) - 1
    inlier = np.zeros(len(candidates.r), dtype=np.bool_)
    mean = np.full((n_segments, len(knots)), np.nan)
    std = np.full((n_segments, len(knots)), np.nan)
    pool.run(
        grow_surface_compiled,
        n_segments,
        candidates.offsets,
        candidates.r,
        height,
        length_scale,
        seed,
        knots,
        knot_length_scale,
        config.observation.sigma_f,
        config.observation.sigma_n,
        config.observation.slope_std,
        config.growth.max_std,
        config.growth.max_standardised_residual,
        inlier,
        mean,
        std,
    )
    return inlier, mean, std
