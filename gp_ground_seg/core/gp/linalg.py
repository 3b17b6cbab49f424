"""Many small systems side by side, so that numpy works on the segments in batches."""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from gp_ground_seg.core.frame import BoolArray, FloatArray, IntArray

try:
    from threadpoolctl import ThreadpoolController
except ImportError:  # then BLAS keeps its threads
    ThreadpoolController = None

SEGMENTS_PER_BATCH = 48
"""Larger batches waste room on padding and leave the processor's cache; smaller ones cost
calls."""


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
        if self.place.size == 0:
            return np.full(self.place.shape, fill)
        return np.where(self.mask, values[self.place], fill)


def batches(offsets: IntArray) -> list[IntArray]:
    """Group the segments that are not empty, those of similar size together."""
    size = np.diff(offsets)
    order = np.argsort(size, kind='stable')
    order = order[size[order] > 0]
    n_batches = -(-len(order) // SEGMENTS_PER_BATCH)
    return np.array_split(order, n_batches) if n_batches else []


def add_noise(covariance: FloatArray, noise: FloatArray, mask: BoolArray) -> FloatArray:
    """Add noise to the diagonals; padding becomes a unit matrix, which changes nothing.

    `covariance` (S, n, n) is changed in place and returned; `noise` (S, n), (S, 1) or (1, 1) are
    variances, `mask` (S, n) is False where there is padding.
    """
    covariance *= mask[:, :, None] & mask[:, None, :]
    np.einsum('sii->si', covariance)[:] += np.where(mask, noise, 1.0)
    return covariance


def inverse_of_lower(factors: FloatArray) -> FloatArray:
    """Inverses of lower triangular matrices (S, n, n).

    One by one takes a third of the time of ``np.linalg.inv``, which is for any matrix.
    """
    from scipy.linalg.lapack import dtrtri

    # LAPACK takes arrays by columns: our rows are to it the columns of an upper triangle.
    return np.array([dtrtri(factor.T)[0].T for factor in factors])


@functools.cache
def _controller() -> Any:
    import scipy.linalg  # noqa: F401 - the controller finds only what is loaded

    return ThreadpoolController()


@contextlib.contextmanager
def single_threaded_blas() -> Iterator[None]:
    """Keep OpenBLAS from waking its threads within the block.

    NumPy wakes them for systems of a dozen unknowns. They find nothing
    to do, yet spin for milliseconds on the cores that the segments need.
    """
    if ThreadpoolController is None:
        yield
        return
    with _controller().limit(limits=1, user_api='blas'):
        yield
