"""Radial grid map: points to segments and bins, lowest point per bin."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from gp_ground_seg.frame import (
    NO_TILE,
    NOT_FINITE,
    OUTSIDE,
    Candidates,
    FloatArray,
    PointArray,
    PolarGrid,
)
from gp_ground_seg.parameters.config import GridConfig


def bin_edges(grid: GridConfig) -> FloatArray:
    """Ranges of the bin edges [m], (n_bins + 1,), read-only."""
    fraction = np.arange(grid.n_bins + 1) / grid.n_bins
    edges: FloatArray = grid.r_min + (grid.r_max - grid.r_min) * fraction**grid.bin_growth
    # For compiled code what may be written to is another type.
    edges.setflags(write=False)
    return edges


def reach(edges: FloatArray, dtype: np.dtype[np.floating]) -> np.floating:
    """Least number of that precision that is no less than the last edge.

    A range in that precision lies below it if, and only if, it lies below the edge.
    """
    near: np.floating = edges[-1:].astype(dtype)[0]
    return near if near >= edges[-1] else np.nextafter(near, dtype.type(np.inf))


def pseudo_angle(x: PointArray, y: PointArray) -> PointArray:
    """Turn from -x, counter-clockwise, on the unit diamond: 0 to 4.

    It grows with the angle and needs one division: points are sorted into segments
    by comparing it with that of the segments' edges.

    Parameters
    ----------
    x, y : (N,) float32 or float64
        Coordinates; the origin counts as lying on +x.
    """
    size = np.abs(x) + np.abs(y)
    two, four = size.dtype.type(2.0), size.dtype.type(4.0)
    share = np.divide(y, size, out=np.zeros_like(size), where=size > 0.0)
    left = np.where(y < 0.0, -share, four - share)
    result: PointArray = np.where(x >= 0.0, two + share, left)
    return result


def segment_edges(n_segments: int) -> FloatArray:
    """Pseudo-angles of the edges of the segments, (M + 1,)."""
    angle = -np.pi + 2.0 * np.pi * np.arange(n_segments + 1) / n_segments
    edges: FloatArray = pseudo_angle(np.cos(angle), np.sin(angle)).astype(np.float64)
    edges[0], edges[-1] = 0.0, 4.0
    return edges


def build_polar_grid(xyz: PointArray, grid: GridConfig) -> PolarGrid:
    """Sort points into segments and bins (paper, section II).

    Parameters
    ----------
    xyz : (N, 3) float32 or float64
        Points [m]; in their precision ranges and angles are computed.
    grid : GridConfig
        Size of the grid.
    """
    edges = bin_edges(grid)
    finite = np.isfinite(xyz[:, 0]) & np.isfinite(xyz[:, 1]) & np.isfinite(xyz[:, 2])
    zero, nothing = xyz.dtype.type(0.0), xyz.dtype.type(np.nan)
    x, y = np.where(finite, xyz[:, 0], zero), np.where(finite, xyz[:, 1], zero)
    with np.errstate(over='ignore'):  # infinitely far is outside
        r = np.sqrt(x * x + y * y)
    # Exactly -x is the edge that ends the last segment: that is segment 0 again.
    near = r < edges[-1]
    angle = pseudo_angle(np.where(near, x, zero), np.where(near, y, zero))
    turn = (
        np.searchsorted(segment_edges(grid.n_segments), angle.astype(np.float64), side='right') - 1
    )
    segment = turn % grid.n_segments
    # Points nearer than the first edge belong to the first bin.
    index = np.maximum(np.searchsorted(edges, r.astype(np.float64), side='right') - 1, 0)
    cell = np.where(index < grid.n_bins, segment * grid.n_bins + index, OUTSIDE)
    cell = np.where(finite, cell, NOT_FINITE).astype(np.int32)
    return PolarGrid(cell, np.where(finite, r, nothing), edges, grid.n_segments)


@dataclass(frozen=True)
class CellTables:
    """Extremes of the points of every bin.

    Attributes
    ----------
    extremes : (M, n_bins, 3) float32 or float64
        Height of the lowest point and its range, the nearest of equally low ones, and
        height of the highest point [m], in the precision of the points; infinite,
        infinite and minus infinite in empty bins.
    numbers : (M, n_bins, 2) int32
        Number of points; tile of the lowest point, the first of equally low and near
        ones, or `NO_TILE`.
    """

    extremes: PointArray
    numbers: npt.NDArray[np.int32]


def reduce_cells(grid: PolarGrid, z: PointArray, tile: npt.NDArray[np.int32]) -> CellTables:
    """Lowest and highest point of each bin, and their number.

    Equal heights are settled by the smaller range, so that the order of the
    points does not matter.

    Parameters
    ----------
    grid : PolarGrid
        Bins of the points.
    z : (N,) float32 or float64
        Heights [m].
    tile : (N,) int32
        Tiles of the points.
    """
    size = grid.n_segments * grid.n_bins
    inside = grid.inside
    cell = grid.cell[inside]
    z_inside, r_inside = z[inside], grid.r[inside]
    lowest_z, lowest_r = np.full((2, size), np.inf, dtype=z.dtype)
    highest_z = np.full(size, -np.inf, dtype=z.dtype)
    np.minimum.at(lowest_z, cell, z_inside)
    is_lowest = z_inside == lowest_z[cell]
    np.minimum.at(lowest_r, cell[is_lowest], r_inside[is_lowest])
    is_lowest &= r_inside == lowest_r[cell]
    lowest_tile = np.full(size, NO_TILE, dtype=np.int32)
    np.minimum.at(lowest_tile, cell[is_lowest], tile[inside][is_lowest])
    np.maximum.at(highest_z, cell, z_inside)
    extremes = np.column_stack([lowest_z, lowest_r, highest_z])
    numbers = np.column_stack([np.bincount(cell, minlength=size).astype(np.int32), lowest_tile])
    shape = grid.n_segments, grid.n_bins, -1
    return CellTables(extremes.reshape(shape), numbers.reshape(shape))


def ground_candidates(cells: CellTables, edges: FloatArray, min_extent: float) -> Candidates:
    """Lowest point and vertical density of each occupied bin (paper, section II).

    The paper cuts a bin into j slices and averages their densities: points over
    area. The slices are equally high, so whatever j is, that mean is the number
    of points over the area of the whole bin, width by height.

    Parameters
    ----------
    cells : CellTables
        Extremes of every bin.
    edges : (n_bins + 1,) float64
        Ranges of the bin edges [m].
    min_extent : float
        Least height of a bin in the density [m]: the points of a flat bin are no
        closer together than the sensor's noise.
    """
    count = cells.numbers[:, :, 0]
    occupied = count > 0
    own_bin = np.nonzero(occupied)[1]
    lowest_z, lowest_r, highest_z = cells.extremes[occupied].astype(np.float64).T
    extent = np.maximum(highest_z - lowest_z, min_extent)
    return Candidates(
        r=lowest_r.copy(),
        z=lowest_z.copy(),
        bin=own_bin,
        density=count[occupied] / (np.diff(edges)[own_bin] * extent),
        offsets=np.concatenate([[0], np.cumsum(occupied.sum(axis=1))]),
        tile=cells.numbers[occupied, 1],
    )
