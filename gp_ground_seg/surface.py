"""The estimated ground of a frame, and its value under any point."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gp_ground_seg.polar_grid import OUTSIDE, FloatArray, PolarGrid
from gp_ground_seg.gp.growth import BoolArray


@dataclass(frozen=True)
class GroundSurface:
    """Ground height over range in every segment.

    Attributes
    ----------
    knots : (K,) float64
        Ranges [m]: the bin edges.
    mean, std : (M, K) float64
        Ground height in the sensor frame and its standard deviation [m]; NaN in
        segments without a model.
    inlier : (C,) bool
        Candidates that made the surface.
    """

    knots: FloatArray
    mean: FloatArray
    std: FloatArray
    inlier: BoolArray

    def at(self, grid: PolarGrid) -> tuple[FloatArray, FloatArray]:
        """Height and standard deviation [m] under each point, two (N,) float64.

        Linear between the knots; nearer than the first knot it is the first
        knot's. NaN beyond the last knot and in segments without a model.
        """
        index = np.maximum(grid.bin, 0)
        left, right = self.knots[index], self.knots[index + 1]
        weight = np.clip((grid.r - left) / (right - left), 0.0, 1.0)
        flat = grid.segment * len(self.knots) + index
        outside = grid.bin == OUTSIDE
        values = []
        for table in (self.mean.ravel(), self.std.ravel()):
            value = table[flat] * (1.0 - weight) + table[flat + 1] * weight
            value[outside] = np.nan
            values.append(value)
        return values[0], values[1]
