"""Covariance functions, of arrays or of numbers, and the small systems that they give."""

from __future__ import annotations

import functools
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from gp_ground_seg.core.frame import BoolArray, FloatArray, IntArray, PointArray, Values
from gp_ground_seg.core.jit import shared
from gp_ground_seg.core.parameters.config import ObservationConfig

try:
    from threadpoolctl import ThreadpoolController
except ImportError:  # then BLAS keeps its threads
    ThreadpoolController = None

LARGEST_EXPONENT = 40.0
"""Largest x of which ``exp(-x)`` is computed: 4e-18, as good as nothing. Squares of less lose
digits in single precision, and take numpy tens of times as long."""
SEGMENTS_PER_BATCH = 24
"""Larger batches waste room on padding and leave the processor's cache; smaller ones cost
calls."""


def exp_neg(x: Values) -> Values:
    """``exp(-x)``; of numbers in compiled code, see `gp_ground_seg.core.compiled.numerics`."""
    return np.exp(-np.minimum(x, LARGEST_EXPONENT))


def nearer_first(r_a: Values, r_b: Values) -> tuple[Values, Values]:
    """Both ranges, the nearer one first; a choice between numbers in compiled code."""
    return np.minimum(r_a, r_b), np.maximum(r_a, r_b)


@shared
def paciorek(r_a: Values, l_a: Values, r_b: Values, l_b: Values, variance: Values) -> Values:
    """Non-stationary covariance of Paciorek and Schervish in one dimension (paper, eq. 8) [m^2].

    ``sigma_f^2 sqrt(2 l_a l_b / (l_a^2 + l_b^2)) exp(-(r_a - r_b)^2 / (l_a^2 + l_b^2))``

    Of ranges and length-scales [m], and the prior variance ``sigma_f^2`` [m^2]. As precise as
    these: there is no constant, which in compiled code would be of double precision.
    """
    spread, product = l_a * l_a + l_b * l_b, (l_a + l_a) * l_b
    distance = r_a - r_b
    root = np.sqrt(product / spread)
    return variance * root * exp_neg(distance * distance / spread)


@shared
def squared_exponential(r_a: Values, r_b: Values, variance: Values, sharpness: Values) -> Values:
    """Stationary covariance of the latent process (paper, eq. 12).

    ``sigma_f^2 exp(-(r_a - r_b)^2 / (2 length_scale^2))``

    Of ranges [m], the prior variance ``sigma_f^2``, in the squared unit of the process, and the
    sharpness ``1 / (2 length_scale^2)`` [1/m^2].
    """
    distance = r_a - r_b
    return variance * exp_neg(sharpness * distance * distance)


@shared
def line_covariance(r_a: Values, r_b: Values, slope: Values, sixth: Values) -> Values:
    """Covariance of the mean line's heights at two ranges [m^2].

    The line leaves the sensor's base with a slope of variance `slope`, and its slope walks: that
    adds ``drift^2 r^2 (3 r' - r) / 6``, with r the nearer range (an integrated Wiener process).
    `sixth` is ``drift^2 / 6`` [1/m], where ``drift^2`` is the variance that the slope gains over a
    metre.
    """
    near, far = nearer_first(r_a, r_b)
    return near * (slope * far + sixth * near * (far + far + far - near))


@shared
def line_variances(observation: ObservationConfig) -> tuple[float, float]:
    """Return the last two arguments of `line_covariance`."""
    return observation.slope_std**2, observation.slope_drift**2 / 6.0


@shared
def prior_variance(sill: Values, observation: ObservationConfig, r: Values) -> Values:
    """Prior variance of the ground's height at ranges [m^2]: of the process, and of its line."""
    return sill + line_covariance(r, r, *line_variances(observation))


class Padded(NamedTuple):
    """Where the values of S segments are in a ragged array, padded to the longest, n."""

    place: IntArray  # (S, n) in the ragged array; arbitrary where there is padding
    mask: BoolArray  # (S, n) False where there is padding

    @classmethod
    def of(cls, segments: IntArray, offsets: IntArray) -> Padded:
        """Lay out `segments`, whose values are ``offsets[m]:offsets[m + 1]``."""
        count = offsets[segments + 1] - offsets[segments]
        rank = np.arange(int(count.max(initial=0)))
        mask = rank < count[:, None]
        return cls(np.where(mask, offsets[segments, None] + rank, 0), mask)

    def take(self, values: npt.NDArray[np.generic], fill: float = 0.0) -> FloatArray:
        """Values of the segments, (S, n), with `fill` for padding."""
        return np.where(self.mask, values[self.place], fill)


def batches(segments: IntArray, offsets: IntArray) -> list[IntArray]:
    """Group those of the `segments` that are not empty, those of similar size together."""
    size = offsets[segments + 1] - offsets[segments]
    order = np.argsort(size, kind='stable')
    order = segments[order[size[order] > 0]]
    n_batches = -(-len(order) // SEGMENTS_PER_BATCH)
    return np.array_split(order, n_batches) if n_batches else []


def whitened(covariance: PointArray, rows: PointArray) -> PointArray:
    """Solve ``L X = rows`` for the Cholesky factor L of a covariance (n, n), and rows (n, k).

    NaN where it is not positive definite. Rows that are contiguous are overwritten.
    """
    factorise, solve = _solvers(rows.dtype)
    # LAPACK takes arrays by columns: to it ours are transposed.
    factor, is_failed = factorise(covariance.T)
    if is_failed:
        return np.full_like(rows, np.nan)
    result: PointArray = solve(1.0, factor, rows.T, side=1, overwrite_b=True).T
    return result


@functools.cache
def _solvers(dtype: np.dtype[np.floating]) -> tuple[Any, Any]:
    """Cholesky factor and triangular solution for a type."""
    from scipy.linalg import get_blas_funcs, get_lapack_funcs

    return get_lapack_funcs('potrf', dtype=dtype), get_blas_funcs('trsm', dtype=dtype)


def inverted(covariance: FloatArray) -> tuple[FloatArray, float]:
    """Inverse of a covariance (n, n), and half the logarithm of its determinant.

    NaN where it is not positive definite. Compiled code reads, and overwrites, its upper triangle.
    """
    root = whitened(covariance, np.eye(len(covariance)))
    return root.T @ root, -float(np.log(np.diagonal(root)).sum())


@functools.cache
def _controller() -> Any:
    import scipy.linalg  # noqa: F401 - the controller finds only what is loaded

    return ThreadpoolController()


@contextmanager
def single_threaded_blas() -> Iterator[None]:
    """Keep OpenBLAS from waking its threads within the block.

    NumPy wakes them for systems of a dozen unknowns. They find nothing
    to do, yet spin for milliseconds on the cores that the segments need.
    """
    has_limits = ThreadpoolController is not None
    with _controller().limit(limits=1, user_api='blas') if has_limits else nullcontext():
        yield
