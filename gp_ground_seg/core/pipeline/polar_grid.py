"""Stage 1: points to polar cells and square tiles; the lowest point of a cell is a candidate."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from gp_ground_seg.core.frame import (
    NO_TILE,
    NOT_FINITE,
    OUTSIDE,
    Candidates,
    CellArray,
    FloatArray,
    PointArray,
    PolarGrid,
    Scan,
    Tiles,
    Values,
)
from gp_ground_seg.core.jit import choose, shared
from gp_ground_seg.core.parameters.config import Config, GridConfig
from gp_ground_seg.core.pipeline.points import copy_points, points_in


def build_scan(xyz: PointArray, config: Config) -> Scan:
    """Copy points, sort them into cells and tiles, and take the lowest point of each cell.

    `xyz` (N, 3) are of a level frame [m]; ranges and angles are computed in their precision.
    """
    columns = np.empty((3, len(xyz)), dtype=xyz.dtype)
    copy_points(xyz, columns)
    xyz = points_in(columns)
    grid = build_polar_grid(xyz, config.grid)
    tiles = build_tiles(xyz, grid, config.faces.cell_size)
    extremes, numbers = reduce_cells(grid, xyz[:, 2], tiles.tile)
    candidates = ground_candidates(extremes, numbers, grid.edges, config.lines.min_density_extent)
    return Scan(xyz, grid, tiles, candidates)


def bin_edges(grid: GridConfig) -> FloatArray:
    """Ranges of the bin edges [m], (n_bins + 1,), read-only."""
    fraction = np.arange(grid.n_bins + 1) / grid.n_bins
    edges: FloatArray = grid.r_min + (grid.r_max - grid.r_min) * fraction**grid.bin_growth
    edges.setflags(write=False)
    return edges


def round_up_to(dtype: np.dtype[np.floating], edge: float) -> np.floating:
    """Least number of that precision that is no less than `edge`.

    A range in that precision lies below it if, and only if, it lies below the edge.
    """
    near: np.floating = dtype.type(edge)
    return near if near >= edge else np.nextafter(near, dtype.type(np.inf))


@shared
def azimuth_key(x: Values, y: Values, number: Callable[[float], Values]) -> Values:
    """Map azimuths to numbers in [0, 4] that grow with them, counter-clockwise from -x.

    The position on the unit diamond, which needs one division and no arctangent. Points are
    sorted into segments by comparing it with that of the segments' edges.
    The origin counts as lying on +x. `number` is the type of the coordinates.
    """
    zero, one, two, four = number(0.0), number(1.0), number(2.0), number(4.0)
    size = np.abs(x) + np.abs(y)
    share = y / choose(size > zero, size, one)
    left = choose(y < zero, -share, four - share)
    return choose(x >= zero, two + share, left)


@shared
def vertical_density(
    number: Values, width: Values, lowest: Values, highest: Values, min_extent: float
) -> Values:
    """Points over the area of a bin, its width by its height [points/m^2].

    `min_extent` is the least height [m]: the points of a flat cell are no closer together than
    the sensor's noise.
    """
    return number / (width * np.maximum(highest - lowest, min_extent))


def segment_edges(n_segments: int) -> FloatArray:
    """Azimuth keys of the edges of the segments, (M + 1,)."""
    angle = -np.pi + 2.0 * np.pi * np.arange(n_segments + 1) / n_segments
    edges: FloatArray = azimuth_key(np.cos(angle), np.sin(angle), np.float64)
    edges[0], edges[-1] = 0.0, 4.0
    return edges


def build_polar_grid(xyz: PointArray, grid: GridConfig) -> PolarGrid:
    """Sort points into segments and bins (paper, section II); parameters as `build_scan`."""
    edges = bin_edges(grid)
    finite = np.isfinite(xyz[:, 0]) & np.isfinite(xyz[:, 1]) & np.isfinite(xyz[:, 2])
    zero, nothing = xyz.dtype.type(0.0), xyz.dtype.type(np.nan)
    x, y = np.where(finite, xyz[:, 0], zero), np.where(finite, xyz[:, 1], zero)
    with np.errstate(over='ignore'):  # infinitely far is outside
        r = np.sqrt(x * x + y * y)
    near = r < edges[-1]
    key = azimuth_key(np.where(near, x, zero), np.where(near, y, zero), xyz.dtype.type)
    segment = np.searchsorted(segment_edges(grid.n_segments), key.astype(np.float64), side='right')
    segment -= 1
    # Exactly -x is the edge that ends the last segment: that is segment 0 again.
    segment %= grid.n_segments
    # Points nearer than the first edge belong to the first bin.
    index = np.maximum(np.searchsorted(edges, r.astype(np.float64), side='right') - 1, 0)
    cell = np.where(index < grid.n_bins, segment * grid.n_bins + index, OUTSIDE)
    cell = np.where(finite, cell, NOT_FINITE).astype(np.int32)
    return PolarGrid(cell, np.where(finite, r, nothing), edges, grid.n_segments)


def tiles_per_side(r_max: float, tile_size: float) -> int:
    """Tiles along a side of the square that holds the polar grid."""
    return math.ceil(2.0 * r_max / tile_size)


def build_tiles(xyz: PointArray, grid: PolarGrid, tile_size: float) -> Tiles:
    """Sort points into square tiles.

    Points (N, 3) outside the cells of `grid` belong to no tile; `tile_size` is their side [m].
    """
    half = round_up_to(xyz.dtype, grid.edges[-1])
    side = tiles_per_side(float(grid.edges[-1]), tile_size)
    inside = grid.inside
    tile = np.full(len(xyz), OUTSIDE, dtype=np.int32)
    per_metre = xyz.dtype.type(1.0 / tile_size)
    column, row = ((xyz[inside, :2] + half) * per_metre).astype(np.int64).T
    place = np.minimum(column, side - 1) * side + np.minimum(row, side - 1)
    tile[inside] = place
    z = xyz[inside, 2]
    lowest_z = np.full(side * side, np.inf, dtype=xyz.dtype)
    highest_z = np.full(side * side, -np.inf, dtype=xyz.dtype)
    np.minimum.at(lowest_z, place, z)
    np.maximum.at(highest_z, place, z)
    occupied = np.flatnonzero(highest_z > -np.inf).astype(np.int32)
    return Tiles(tile, np.column_stack([lowest_z, highest_z]), occupied)


def reduce_cells(grid: PolarGrid, z: PointArray, tile: CellArray) -> tuple[PointArray, CellArray]:
    """Lowest and highest point of each cell, and the number of its points.

    Of equally low points the nearest counts, then the one in the first tile, so that the
    order of the points does not matter.

    Returns, for heights `z` (N,) [m] and the `tile` (N,) of each point:

    extremes, (M * n_bins, 3), in the precision of the points: height of the lowest point, its
    range, and height of the highest point [m]; infinite, infinite, minus infinite in empty cells;
    numbers, (M * n_bins, 2): number of points; tile of the lowest point, or `NO_TILE`.
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
    number = np.bincount(cell, minlength=size).astype(np.int32)
    return (
        np.column_stack([lowest_z, lowest_r, highest_z]),
        np.column_stack([number, lowest_tile]),
    )


def ground_candidates(
    extremes: PointArray, numbers: CellArray, edges: FloatArray, min_extent: float
) -> Candidates:
    """Lowest point and vertical density of each occupied cell (paper, section II).

    The paper cuts a bin into j slices and averages their densities: points over
    area. The slices are equally high, so whatever j is, that mean is the number
    of points over the area of the whole bin, width by height.

    For `extremes` and `numbers` see `reduce_cells`; `edges`, (n_bins + 1,), are the ranges of the
    bin edges [m]. For `min_extent` see `vertical_density`.
    """
    n_bins = len(edges) - 1
    occupied = np.flatnonzero(numbers[:, 0])
    bins = occupied % n_bins
    lowest_z, lowest_r, highest_z = extremes[occupied].astype(np.float64).T
    widths = np.diff(edges)[bins]
    per_segment = np.bincount(occupied // n_bins, minlength=len(numbers) // n_bins)
    return Candidates(
        r=lowest_r.copy(),
        z=lowest_z.copy(),
        bin=bins,
        density=vertical_density(numbers[occupied, 0], widths, lowest_z, highest_z, min_extent),
        offsets=np.concatenate([[0], np.cumsum(per_segment)]),
        tile=numbers[occupied, 1],
    )
