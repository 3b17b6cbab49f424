"""Segments of like size side by side, so that numpy works on many at once."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from gp_ground_seg.frame import FloatArray, IntArray

SEGMENTS_PER_BATCH = 32
"""More waste room on padding and leave the processor's cache, fewer cost calls."""


@dataclass(frozen=True)
class Padded:
    """Where the values of S segments are in a ragged array, padded to the longest, n.

    Attributes
    ----------
    index : (S, n) int64
        Places in the ragged array; any at all where there is padding.
    mask : (S, n) bool
        False where there is padding.
    """

    index: IntArray
    mask: npt.NDArray[np.bool_]

    @classmethod
    def of(cls, segments: IntArray, offsets: IntArray) -> Padded:
        """Lay out `segments`, whose values are ``offsets[m]:offsets[m + 1]``."""
        count = offsets[segments + 1] - offsets[segments]
        rank = np.arange(int(count.max(initial=0)))
        mask = rank < count[:, None]
        return cls(np.where(mask, offsets[segments, None] + rank, 0), mask)

    def take(self, values: npt.NDArray[np.generic], fill: float = 0.0) -> FloatArray:
        """Values of the segments, (S, n), with `fill` for padding."""
        if self.index.size == 0:
            return np.full(self.index.shape, fill)
        return np.where(self.mask, values[self.index], fill)


def batches(offsets: IntArray) -> list[IntArray]:
    """Group the segments that are not empty, those of like size together."""
    size = np.diff(offsets)
    order = np.argsort(size, kind='stable')
    order = order[size[order] > 0]
    n_batches = -(-len(order) // SEGMENTS_PER_BATCH)
    return np.array_split(order, n_batches) if n_batches else []


def regularised(
    covariance: FloatArray, noise: FloatArray, mask: npt.NDArray[np.bool_]
) -> FloatArray:
    """Add noise to the diagonals; padding becomes a unit matrix, which changes nothing.

    Parameters
    ----------
    covariance : (S, n, n) float64
        Changed in place and returned.
    noise : (S, n) or (S, 1) float64
        Variances.
    mask : (S, n) bool
        False where there is padding.
    """
    covariance *= mask[:, :, None] & mask[:, None, :]
    n = mask.shape[1]
    covariance[:, range(n), range(n)] += np.where(mask, noise, 1.0)
    return covariance
