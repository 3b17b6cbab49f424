"""The numerics of a frame by the backend at hand: plain numpy, or compiled in threads."""

from __future__ import annotations

import logging
from typing import Protocol

import numpy as np

from gp_ground_seg.compiled import HAVE_NUMBA
from gp_ground_seg.config import GrowthConfig, RuntimeConfig
from gp_ground_seg.errors import MissingDependencyError
from gp_ground_seg.gp.growth import (
    BoolArray,
    grow_surface_compiled,
    grow_surface_reference,
)
from gp_ground_seg.gp.latent import latent_rows_compiled, latent_rows_reference
from gp_ground_seg.gp.objective import TrainingFrame, objective_reference
from gp_ground_seg.gp.objective_compiled import objective_rows
from gp_ground_seg.parallel import RowPool
from gp_ground_seg.polar_grid import Candidates, FloatArray
from gp_ground_seg.pseudo_inputs import PseudoInputs

_LOGGER = logging.getLogger('gp_ground_seg')
_said_slow = False


class Backend(Protocol):
    """What the segmenter asks of a backend; theta has one row per segment."""

    name: str
    n_threads: int

    def log_length_scales(
        self, theta: FloatArray, pseudo: PseudoInputs, candidates: Candidates, knots: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """See `gp_ground_seg.gp.latent.latent_rows_reference`."""

    def grow(
        self,
        candidates: Candidates,
        height: FloatArray,
        length_scale: FloatArray,
        seed: BoolArray,
        knots: FloatArray,
        knot_length_scale: FloatArray,
        theta: FloatArray,
        slope_std: float,
        growth: GrowthConfig,
    ) -> tuple[BoolArray, FloatArray, FloatArray]:
        """See `gp_ground_seg.gp.growth.grow_surface_reference`."""

    def objective(
        self, theta: FloatArray, frame: TrainingFrame, slope_std: float, latent_terms: bool
    ) -> tuple[float, FloatArray]:
        """See `gp_ground_seg.gp.objective.objective_reference`."""

    def close(self) -> None:
        """End worker threads."""


def choose_backend(wanted: str) -> str:
    """Return ``numba`` or ``numpy`` for the parameter ``runtime.backend``.

    Raises
    ------
    MissingDependencyError
        If numba is asked for by name and not installed.
    """
    global _said_slow
    if wanted == 'numba' and not HAVE_NUMBA:
        raise MissingDependencyError(
            'runtime.backend = numba, but numba is not installed: pip install numba, '
            'or set runtime.backend to auto'
        )
    if wanted == 'auto' and not HAVE_NUMBA and not _said_slow:
        _said_slow = True
        _LOGGER.warning(
            'numba is not installed: using numpy, several times slower (pip install numba)'
        )
    return 'numba' if HAVE_NUMBA and wanted != 'numpy' else 'numpy'


def make_backend(runtime: RuntimeConfig) -> Backend:
    """Backend for the parameters ``runtime``; raises as `choose_backend`."""
    if choose_backend(runtime.backend) == 'numpy':
        return ReferenceBackend()
    return CompiledBackend(runtime.n_threads)


class ReferenceBackend:
    """Plain numpy and SciPy, one thread."""

    name = 'numpy'
    n_threads = 1

    def log_length_scales(
        self, theta: FloatArray, pseudo: PseudoInputs, candidates: Candidates, knots: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Log length-scales at candidates and knots."""
        return latent_rows_reference(
            theta,
            pseudo.offsets,
            pseudo.r_bar,
            pseudo.surface_class,
            candidates.offsets,
            candidates.r,
            knots,
        )

    def grow(
        self,
        candidates: Candidates,
        height: FloatArray,
        length_scale: FloatArray,
        seed: BoolArray,
        knots: FloatArray,
        knot_length_scale: FloatArray,
        theta: FloatArray,
        slope_std: float,
        growth: GrowthConfig,
    ) -> tuple[BoolArray, FloatArray, FloatArray]:
        """Inliers, mean and standard deviation of the surface."""
        return grow_surface_reference(
            candidates.offsets,
            candidates.r,
            height,
            length_scale,
            seed,
            knots,
            knot_length_scale,
            np.exp(theta[:, 0]),
            np.exp(theta[:, 1]),
            slope_std,
            growth,
        )

    def objective(
        self, theta: FloatArray, frame: TrainingFrame, slope_std: float, latent_terms: bool
    ) -> tuple[float, FloatArray]:
        """Whole-frame objective and gradient."""
        return objective_reference(theta, frame, slope_std, latent_terms)

    def close(self) -> None:
        """Nothing to end."""


class CompiledBackend:
    """Compiled code on rows of segments, in threads.

    Parameters
    ----------
    n_threads : int
        Number of threads; 0 = all cores.
    """

    name = 'numba'

    def __init__(self, n_threads: int) -> None:
        self._pool = RowPool(n_threads)
        self.n_threads = self._pool.n_threads

    def log_length_scales(
        self, theta: FloatArray, pseudo: PseudoInputs, candidates: Candidates, knots: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Log length-scales at candidates and knots."""
        n_segments = len(candidates.offsets) - 1
        at_candidates = np.empty(len(candidates.r))
        at_knots = np.full((n_segments, len(knots)), np.nan)
        self._pool.run(
            latent_rows_compiled,
            n_segments,
            theta,
            pseudo.offsets,
            pseudo.r_bar,
            pseudo.surface_class,
            candidates.offsets,
            candidates.r,
            knots,
            at_candidates,
            at_knots,
        )
        return at_candidates, at_knots

    def grow(
        self,
        candidates: Candidates,
        height: FloatArray,
        length_scale: FloatArray,
        seed: BoolArray,
        knots: FloatArray,
        knot_length_scale: FloatArray,
        theta: FloatArray,
        slope_std: float,
        growth: GrowthConfig,
    ) -> tuple[BoolArray, FloatArray, FloatArray]:
        """Inliers, mean and standard deviation of the surface."""
        n_segments = len(candidates.offsets) - 1
        inlier = np.zeros(len(candidates.r), dtype=np.bool_)
        mean = np.full((n_segments, len(knots)), np.nan)
        std = np.full((n_segments, len(knots)), np.nan)
        self._pool.run(
            grow_surface_compiled,
            n_segments,
            candidates.offsets,
            candidates.r,
            height,
            length_scale,
            seed,
            knots,
            knot_length_scale,
            np.exp(theta[:, 0]),
            np.exp(theta[:, 1]),
            slope_std,
            growth.max_std,
            growth.max_standardised_residual,
            inlier,
            mean,
            std,
        )
        return inlier, mean, std

    def objective(
        self, theta: FloatArray, frame: TrainingFrame, slope_std: float, latent_terms: bool
    ) -> tuple[float, FloatArray]:
        """Whole-frame objective and gradient."""
        values = np.empty(frame.n_segments)
        gradients = np.empty((frame.n_segments, len(theta)))
        self._pool.run(
            objective_rows,
            frame.n_segments,
            theta,
            frame.offsets,
            frame.r,
            frame.z,
            frame.log_length_scale,
            frame.bar_offsets,
            frame.r_bar,
            frame.surface_class,
            slope_std,
            latent_terms,
            values,
            gradients,
        )
        value = float(values.sum())
        if not np.isfinite(value):
            return -np.inf, np.zeros(len(theta))
        return value, gradients.sum(axis=0)

    def close(self) -> None:
        """End the threads."""
        self._pool.close()
