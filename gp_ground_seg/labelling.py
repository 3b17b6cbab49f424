"""Labels from the distance of each point to the surface."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from gp_ground_seg.config import LabelConfig
from gp_ground_seg.labels import Label
from gp_ground_seg.polar_grid import OUTSIDE, FloatArray, PolarGrid
from gp_ground_seg.surface import GroundSurface


def label_points(
    height: FloatArray, grid: PolarGrid, surface: GroundSurface, label: LabelConfig
) -> npt.NDArray[np.uint8]:
    """Label points by their height over the surface (paper, Algorithm 2, line 14).

    Parameters
    ----------
    height : (N,) float64
        Height over the surface [m]; NaN where there is none.
    grid : PolarGrid
        Bins of the points.
    surface : GroundSurface
        The surface; a bin across which it rises has a wider tolerance, since the
        bin's lowest point stands for its lower end.
    label : LabelConfig
        Tolerances.

    Returns
    -------
    (N,) uint8
        `Label` of each point; UNKNOWN for points that are not finite.
    """
    allowance = label.slope_allowance * surface.rise(grid)
    below = label.ground_tolerance + allowance
    above = np.where(stands_in_bin(height, grid, label), label.obstacle_tolerance, below)
    is_ground = (height <= above) & (height >= -below) & (grid.bin != OUTSIDE)
    result = np.where(is_ground, Label.GROUND, Label.OBSTACLE).astype(np.uint8)
    result[np.isnan(grid.r)] = Label.UNKNOWN
    return result


def stands_in_bin(
    height: FloatArray, grid: PolarGrid, label: LabelConfig
) -> npt.NDArray[np.bool_]:
    """Tell which points share their bin with an obstacle, (N,) bool.

    The foot of a wall lies within any tolerance that ground needs; the returns
    above it give it away. Higher returns say nothing of the foot: they overhang.
    """
    n_bins = len(grid.edges) - 1
    cell = grid.segment * n_bins + grid.bin
    shows = (
        (height >= label.obstacle_min_height)
        & (height <= label.obstacle_max_height)
        & (grid.bin != OUTSIDE)
    )
    occupied = np.zeros(grid.n_segments * n_bins, dtype=np.bool_)
    occupied[cell[shows]] = True
    result: npt.NDArray[np.bool_] = occupied[cell] & (grid.bin != OUTSIDE)
    return result
