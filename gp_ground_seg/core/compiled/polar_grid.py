"""Compiled twin of `gp_ground_seg.core.pipeline.polar_grid`."""

import math

import numpy as np

from gp_ground_seg.core.frame import (
    NOT_FINITE,
    OUTSIDE,
    Candidates,
    CellArray,
    FloatArray,
    PointArray,
    PolarGrid,
    Tiles,
)
from gp_ground_seg.core.jit import jit
from gp_ground_seg.core.pipeline import polar_grid as plain

BLOCK = 2048
"""Points sorted at a time, so that their intermediate values stay in the nearest caches."""


@jit(entry=True)
def build_grid(
    columns: PointArray,
    geometry: plain.GridGeometry,
    min_extent: float,
    grid: PolarGrid,
    tiles: Tiles,
    candidates: Candidates,
    extent: FloatArray,
) -> tuple[int, int]:
    """Sort points, (3, N), into cells and tiles, with the extremes of each.

    Block by block: first the places of the points, in loops without branches; then the
    extremes. Returns the numbers of tiles and of candidates, which have room for more; see
    `_take_candidates`.
    """
    cell, r, tile = grid.cell, grid.r, tiles.tile
    n_cells, n_tiles = (len(candidates.offsets) - 1) * (len(geometry.edges) - 1), 0
    # Of each cell: height of the lowest point, its range, height of the highest point, x and y of
    # the lowest point; number of points, and tile of the lowest. The last is for those in no cell.
    extremes, numbers = np.empty((n_cells + 1, 5), r.dtype), np.empty((n_cells + 1, 2), np.int32)
    for k in range(n_cells + 1):
        extremes[k, 0] = extremes[k, 1] = np.inf
        extremes[k, 2] = -np.inf
        numbers[k, 0], numbers[k, 1] = 0, OUTSIDE
    range_entry, place = np.empty(BLOCK, np.int32), np.empty(BLOCK, np.int32)
    key, key_entry = np.empty(BLOCK, dtype=r.dtype), np.empty(BLOCK, np.int32)
    for first in range(0, len(r), BLOCK):
        block = slice(first, min(first + BLOCK, len(r)))
        x, y, z = columns[0, block], columns[1, block], columns[2, block]
        _compute_range(x, y, z, geometry.ranges, r[block], range_entry, cell[block])
        _compute_azimuth_key(x, y, geometry, cell[block], key, key_entry, place)
        _look_up(geometry, r[block], range_entry, key, key_entry, cell[block])
        n_tiles = _widen(z, cell[block], place, tile[block], extremes, numbers, tiles, n_tiles)
    for first in range(0, len(r), BLOCK):
        block = slice(first, min(first + BLOCK, len(r)))
        own = columns[:, block], r[block], cell[block], tile[block]
        _resolve_lowest(*own, extremes, numbers)
    for k in range(n_cells):
        extent[k] = np.float64(extremes[k, 2]) - np.float64(extremes[k, 0])
    return n_tiles, _take_candidates(extremes, numbers, geometry.edges, min_extent, candidates)


@jit()
def _compute_range(
    x: PointArray,
    y: PointArray,
    z: PointArray,
    ranges: plain.BinLookup,
    r: PointArray,
    entry: CellArray,
    cell: CellArray,
) -> None:
    """Range of each point and its entry in the table; ``cell`` is 0, or the reason for none."""
    number = x.dtype.type
    zero, infinity, nothing = number(0.0), number(np.inf), number(np.nan)
    start, end, per_metre = ranges.edges[0], ranges.edges[-1], number(ranges.scale)
    for i in range(len(r)):
        finite = (abs(x[i]) < infinity) & (abs(y[i]) < infinity) & (abs(z[i]) < infinity)
        r_i = math.sqrt(x[i] * x[i] + y[i] * y[i])
        inside = finite & (r_i < end)
        r[i] = r_i if finite else nothing
        cell[i] = 0 if inside else (OUTSIDE if finite else NOT_FINITE)
        beyond = (r_i - start) * per_metre
        entry[i] = np.int32(beyond if inside & (beyond > zero) else zero)


# A loop of its own: for more arrays the compiler cannot prove that none overlap.
@jit()
def _compute_azimuth_key(
    x: PointArray,
    y: PointArray,
    geometry: plain.GridGeometry,
    cell: CellArray,
    key: PointArray,
    entry: CellArray,
    place: CellArray,
) -> None:
    """Azimuth key of each point that has a cell, its entry in the table, and place of its tile."""
    number = x.dtype.type
    zero, four = number(0.0), number(4.0)
    half, per_metre = number(geometry.ranges.edges[-1]), number(geometry.tiles_per_metre)
    last, n_sides = number(geometry.n_sides - 1), np.int32(geometry.n_sides)
    per_key = number(geometry.azimuths.scale)
    for i in range(len(cell)):
        inside = cell[i] == 0
        x_i = x[i] if inside else zero
        y_i = y[i] if inside else zero
        key_i = plain.azimuth_key(x_i, y_i, number)
        # Exactly 4 is the edge that ends the last segment: that is segment 0 again.
        key_i = key_i if key_i < four else zero
        key[i] = key_i
        entry[i] = np.int32(key_i * per_key)
        column = np.int32(min((x_i + half) * per_metre, last))
        row = np.int32(min((y_i + half) * per_metre, last))
        place[i] = column * n_sides + row if inside else OUTSIDE


@jit()
def _look_up(
    geometry: plain.GridGeometry,
    r: PointArray,
    range_entry: CellArray,
    key: PointArray,
    key_entry: CellArray,
    cell: CellArray,
) -> None:
    """Cell of the points that have one: the bin of the table's entry, or the next."""
    ranges, azimuths = geometry.ranges, geometry.azimuths
    n_bins = np.int32(len(ranges.edges) - 1)
    zero, one = np.int32(0), np.int32(1)
    for i in range(len(cell)):
        k, q = np.uintp(range_entry[i]), np.uintp(key_entry[i])
        n = ranges.bins[k] + (one if r[i] >= ranges.ends[k] else zero)
        m = azimuths.bins[q] + (one if key[i] >= azimuths.ends[q] else zero)
        cell[i] = m * n_bins + n if cell[i] == 0 else cell[i]


@jit()
def _widen(
    z: PointArray,
    cell: CellArray,
    place: CellArray,
    tile: CellArray,
    extremes: PointArray,
    numbers: CellArray,
    tiles: Tiles,
    n_tiles: int,
) -> int:
    """Heights and number of the points of each cell and tile; tile of each point.

    Numbers the tiles in the order of their first points; returns how many there are now.
    """
    tile_extremes, at = tiles.extremes, tiles.at
    for i in range(len(z)):
        k = np.uintp(cell[i] if cell[i] >= 0 else len(numbers) - 1)
        low, high = extremes[k, 0], extremes[k, 2]
        extremes[k, 0] = z[i] if z[i] < low else low
        extremes[k, 2] = z[i] if z[i] > high else high
        numbers[k, 0] += np.int32(1)
        if place[i] < 0:
            tile[i] = OUTSIDE
            continue
        t = at[np.uintp(place[i])]
        if t < 0:
            t = np.int32(n_tiles)
            at[np.uintp(place[i])], tiles.place[t] = t, place[i]
            tile_extremes[t, 0], tile_extremes[t, 1] = np.inf, -np.inf
            n_tiles += 1
        tile[i] = t
        k = np.uintp(t)
        low, high = tile_extremes[k, 0], tile_extremes[k, 1]
        tile_extremes[k, 0] = z[i] if z[i] < low else low
        tile_extremes[k, 1] = z[i] if z[i] > high else high
    return n_tiles


@jit()
def _resolve_lowest(
    columns: PointArray,
    r: PointArray,
    cell: CellArray,
    tile: CellArray,
    extremes: PointArray,
    numbers: CellArray,
) -> None:
    """Range, tile and place of the lowest point of each cell, once its height is known."""
    x, y, z = columns[0], columns[1], columns[2]
    for i in range(len(z)):
        k = np.uintp(cell[i] if cell[i] >= 0 else len(numbers) - 1)
        if cell[i] >= 0 and z[i] == extremes[k, 0]:
            own = r[i], x[i], y[i]
            if own < (extremes[k, 1], extremes[k, 3], extremes[k, 4]):
                extremes[k, 1], extremes[k, 3], extremes[k, 4] = own
                numbers[k, 1] = tile[i]


@jit()
def _take_candidates(
    extremes: PointArray,
    numbers: CellArray,
    edges: FloatArray,
    min_extent: float,
    candidates: Candidates,
) -> int:
    """Take the lowest point of each cell, into arrays with room for all cells.

    Returns the number of candidates. `edges` and `min_extent` are those of `ground_candidates`
    of the twin.
    """
    n_bins, c = len(edges) - 1, 0
    for m in range(len(candidates.offsets) - 1):
        candidates.offsets[m] = c
        for n in range(n_bins):
            k = m * n_bins + n
            count = numbers[k, 0]
            if count == 0:
                continue
            low, high = np.float64(extremes[k, 0]), np.float64(extremes[k, 2])
            candidates.z[c], candidates.r[c], candidates.bin[c] = low, extremes[k, 1], n
            candidates.tile[c] = numbers[k, 1]
            candidates.x[c], candidates.y[c] = extremes[k, 3], extremes[k, 4]
            candidates.density[c] = plain.vertical_density(
                count, edges[n + 1] - edges[n], low, high, min_extent
            )
            c += 1
    candidates.offsets[len(candidates.offsets) - 1] = c
    return c
