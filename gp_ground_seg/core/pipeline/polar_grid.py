"""Stage 1: points to polar cells and square tiles; the lowest point of a cell is a candidate."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from gp_ground_seg.core.frame import (
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
    as_index,
)
from gp_ground_seg.core.jit import choose, shared
from gp_ground_seg.core.parameters.config import Config, GridConfig
from gp_ground_seg.core.pipeline.points import finite_points, in_columns

LARGEST_TABLE = 2**20
EARLY = 0.1
"""Offset of the entries of a table towards smaller values, in entries: more than the error of
single precision in the largest table."""


def build_scan(xyz: PointArray, config: Config) -> Scan:
    """Sort points into cells and tiles, and take the lowest point of each cell.

    `xyz` (N, 3) are of a level frame [m]; ranges and angles are computed in their precision.
    """
    xyz = in_columns(xyz)
    geometry = grid_geometry(config.grid, config.faces.cell_size, xyz.dtype)
    grid = build_polar_grid(xyz, geometry)
    tiles = build_tiles(xyz, grid, geometry)
    extremes, numbers = reduce_cells(grid, xyz, tiles.tile)
    candidates = ground_candidates(extremes, numbers, grid.edges, config.lines.min_density_extent)
    extent = extremes[:, 2].astype(np.float64) - extremes[:, 0]
    return Scan(xyz, grid, tiles, candidates, extent)


def bin_edges(grid: GridConfig) -> FloatArray:
    """Ranges of the bin edges [m], read-only: `n_bins` bins from `start` on, and nearer ones.

    So what is seen near a low sensor does not move the bins beyond.
    """
    fraction = np.arange(grid.n_bins + 1) / grid.n_bins
    edges: FloatArray = grid.start + (grid.r_max - grid.start) * fraction**grid.bin_growth
    near = np.linspace(grid.r_min, grid.start, grid.n_near, endpoint=False)
    edges = np.concatenate([near, edges])
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


class BinLookup(NamedTuple):
    """Edges of bins, and a table that gives the bin of a value without a search."""

    edges: PointArray  # (n + 1,) rounded up to the precision of the values, see `round_up_to`
    bins: CellArray  # (T,) bin of the values from ``edges[0] + k / scale`` on, a little early
    ends: PointArray  # (T,) where that bin ends
    scale: float  # entries per unit

    @classmethod
    def of(cls, edges: FloatArray, fineness: int, dtype: np.dtype[np.floating]) -> BinLookup:
        """Table for values of type `dtype` in the bins between `edges` (n + 1,).

        The narrowest bin has `fineness` entries, as far as `LARGEST_TABLE` allows: no entry may
        hold two edges, of bins as narrow as `Config` accepts.
        """
        extent, narrowest = float(edges[-1] - edges[0]), float(np.diff(edges).min())
        scale = min(fineness / narrowest, LARGEST_TABLE / extent)
        # A little early, so that rounding never gives an entry too far.
        starts = edges[0] + (np.arange(int(extent * scale) + 2) - EARLY) / scale
        bins = np.clip(np.searchsorted(edges, starts, side='right') - 1, 0, len(edges) - 2)
        rounded = np.array([round_up_to(dtype, edge) for edge in edges], dtype=dtype)
        return cls(rounded, bins.astype(np.int32), rounded[bins + 1], scale)

    def find(self, values: PointArray) -> CellArray:
        """Bin of each of the values (N,), (N,) int32; they are less than the last edge.

        Those below the first edge are in bin 0.
        """
        beyond = np.maximum(values - self.edges[0], 0.0)
        entry = (beyond * values.dtype.type(self.scale)).astype(np.int64)
        result: CellArray = self.bins[entry]
        result += values >= self.ends[entry]
        return result


class GridGeometry(NamedTuple):
    """Where the edges of cells and tiles lie."""

    ranges: BinLookup  # bins over range [m]
    azimuths: BinLookup  # segments over azimuth key
    edges: FloatArray  # (n_bins + 1,) exact ranges of the bin edges [m]
    tiles_per_metre: float  # one over the side of a tile [1/m]
    n_sides: int  # tiles along a side of the square, which holds the polar grid


@lru_cache(maxsize=4)
def grid_geometry(
    grid: GridConfig, tile_size: float, dtype: np.dtype[np.floating]
) -> GridGeometry:
    """Geometry for points of type `dtype`."""
    edges = bin_edges(grid)
    ranges = BinLookup.of(edges, 4, dtype)
    azimuths = BinLookup.of(segment_edges(grid.n_segments), 8, dtype)
    n_sides = math.ceil(2.0 * grid.r_max / tile_size)
    return GridGeometry(ranges, azimuths, edges, 1.0 / tile_size, n_sides)


def build_polar_grid(xyz: PointArray, geometry: GridGeometry) -> PolarGrid:
    """Sort points (N, 3) into segments and bins (paper, section II)."""
    ranges, azimuths = geometry.ranges, geometry.azimuths
    n_segments, n_bins = len(azimuths.edges) - 1, len(ranges.edges) - 1
    finite = finite_points(xyz)
    x, y, _ = xyz.T
    with np.errstate(over='ignore', invalid='ignore'):  # infinitely far is outside
        r = np.sqrt(x * x + y * y)
        inside = np.flatnonzero(finite & (r < ranges.edges[-1]))
    key = azimuth_key(x[inside], y[inside], xyz.dtype.type)
    # Exactly 4 is the edge that ends the last segment: that is segment 0 again.
    key[key == 4.0] = 0.0
    cell = np.full(len(xyz), OUTSIDE, dtype=np.int32)
    cell[inside] = azimuths.find(key) * n_bins + ranges.find(r[inside])
    cell[~finite], r[~finite] = NOT_FINITE, np.nan
    return PolarGrid(cell, r, geometry.edges, n_segments)


def build_tiles(xyz: PointArray, grid: PolarGrid, geometry: GridGeometry) -> Tiles:
    """Sort points (N, 3) into square tiles; those outside the cells of `grid` belong to none."""
    half, side = geometry.ranges.edges[-1], geometry.n_sides
    per_metre = xyz.dtype.type(geometry.tiles_per_metre)
    # Places instead of a mask: it is used five times.
    inside = np.flatnonzero(grid.inside)
    column, row = (
        np.minimum(((xyz[:, i][inside] + half) * per_metre).astype(np.int64), side - 1)
        for i in range(2)
    )
    place_of_point = column * side + row
    is_occupied = np.zeros(side * side, dtype=np.bool_)
    is_occupied[place_of_point] = True
    place, at = np.flatnonzero(is_occupied), np.full(side * side, OUTSIDE, dtype=np.int32)
    at[place] = np.arange(len(place))
    tile = np.full(len(xyz), OUTSIDE, dtype=np.int32)
    own, z = at[place_of_point], xyz[:, 2][inside]
    tile[inside] = own
    own = as_index(own)
    lowest_z, highest_z = extremes = np.empty((2, len(place)), dtype=xyz.dtype)
    lowest_z[:], highest_z[:] = np.inf, -np.inf
    np.minimum.at(lowest_z, own, z)
    np.maximum.at(highest_z, own, z)
    return Tiles(tile, extremes.T, place.astype(np.int32), at)


def reduce_cells(
    grid: PolarGrid, xyz: PointArray, tile: CellArray
) -> tuple[PointArray, CellArray]:
    """Lowest and highest point of each cell, and the number of its points.

    Of equally low points the nearest counts, then the one of the least x, then of the least y, so
    that the order of the points does not matter.

    Returns, for points `xyz` (N, 3) [m] and the `tile` (N,) of each:

    extremes, (M * n_bins, 5), in the precision of the points: height of the lowest point, its
    range, height of the highest point, x and y of the lowest point [m]; infinite, but minus
    infinite for the highest point, in empty cells;
    numbers, (M * n_bins, 2): number of points; tile of the lowest point.
    """
    size = grid.n_segments * grid.n_bins
    inside = np.flatnonzero(grid.inside)
    cell, z = as_index(grid.cell[inside]), xyz[:, 2]
    z_inside = z[inside]
    lowest_z, highest_z = np.full((2, size), np.inf, dtype=z.dtype)
    highest_z[:] = -np.inf
    np.minimum.at(lowest_z, cell, z_inside)
    np.maximum.at(highest_z, cell, z_inside)
    # What is left after each is mostly one point of each cell.
    lowest = np.flatnonzero(z_inside == lowest_z[cell])
    lowest_r, lowest_x, lowest_y = others = np.full((3, size), np.inf, dtype=z.dtype)
    for least, values in zip(others, (grid.r, xyz[:, 0], xyz[:, 1]), strict=True):
        place, own = cell[lowest], values[inside[lowest]]
        np.minimum.at(least, place, own)
        lowest = lowest[own == least[place]]
    lowest_tile = np.full(size, OUTSIDE, dtype=np.int32)
    lowest_tile[cell[lowest]] = tile[inside[lowest]]
    number = np.bincount(cell, minlength=size).astype(np.int32)
    return (
        np.column_stack([lowest_z, lowest_r, highest_z, lowest_x, lowest_y]),
        np.column_stack([number, lowest_tile]),
    )


def ground_candidates(
    extremes: PointArray, numbers: CellArray, edges: FloatArray, min_extent: float
) -> Candidates:
    """Lowest point and vertical density of each occupied cell (paper, section II).

    The paper cuts a bin into j slices and averages their densities: points over area. The slices
    are equally high, so whatever j is, that mean is points over the area of the whole bin.

    For `extremes` and `numbers` see `reduce_cells`; `edges`, (n_bins + 1,), are the ranges of the
    bin edges [m]. For `min_extent` see `vertical_density`.
    """
    n_bins, occupied = len(edges) - 1, np.flatnonzero(numbers[:, 0])
    bins = occupied % n_bins
    z, r, highest_z, x, y = extremes[occupied].T.astype(np.float64, order='C')
    number, tile = numbers[occupied].T.copy()
    density = vertical_density(number, np.diff(edges)[bins], z, highest_z, min_extent)
    offsets = np.searchsorted(occupied, np.arange(0, len(numbers) + 1, n_bins))
    return Candidates(r, z, bins, density, offsets, tile, x, y)
