"""Square tiles of the plane: points to tiles, lowest and highest point per tile."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from gp_ground_seg.frame import OUTSIDE, PolarGrid, Tiles
from gp_ground_seg.pipeline.polar_grid import reach


def tiles_per_side(r_max: float, tile_size: float) -> int:
    """Tiles along a side of the square that holds the polar grid."""
    return math.ceil(2.0 * r_max / tile_size)


def build_tiles(xyz: npt.NDArray[np.floating], grid: PolarGrid, tile_size: float) -> Tiles:
    """Sort points into square tiles.

    Parameters
    ----------
    xyz : (N, 3) float32 or float64
        Points [m].
    grid : PolarGrid
        Bins of the points; those outside belong to no tile.
    tile_size : float
        Side of a tile [m].
    """
    half = reach(grid.edges, xyz.dtype)
    side = tiles_per_side(float(grid.edges[-1]), tile_size)
    inside = grid.inside
    tile = np.full(len(xyz), OUTSIDE, dtype=np.int32)
    per_metre = xyz.dtype.type(1.0 / tile_size)
    column, row = ((xyz[inside, :2] + half) * per_metre).astype(np.int64).T
    own = np.minimum(column, side - 1) * side + np.minimum(row, side - 1)
    tile[inside] = own
    z = xyz[inside, 2]
    foot_z = np.full(side * side, np.inf, dtype=xyz.dtype)
    top_z = np.full(side * side, -np.inf, dtype=xyz.dtype)
    np.minimum.at(foot_z, own, z)
    np.maximum.at(top_z, own, z)
    touched = np.flatnonzero(top_z > -np.inf).astype(np.int32)
    return Tiles(tile, np.column_stack([foot_z, top_z]), touched)
