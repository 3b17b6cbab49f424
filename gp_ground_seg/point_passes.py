"""The passes over all points, compiled; the numpy twins are in the modules named below."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from gp_ground_seg.compiled import compiled
from gp_ground_seg.config import GridConfig
from gp_ground_seg.polar_grid import (
    NOT_FINITE,
    OUTSIDE,
    FloatArray,
    IntArray,
    PointArray,
    bin_edges,
    segment_edges,
)

CellArray = npt.NDArray[np.int32]
LARGEST_TABLE = 2**15
BLOCK = 512
"""Points sorted at a time: what is known of them stays in the nearest cache."""
EARLY = 0.02
"""How much earlier the entries of a table begin, in entries: more than single precision
puts a value off in the largest table."""


def first_bins(edges: FloatArray, fineness: int) -> tuple[npt.NDArray[np.int32], float]:
    """Table that says where to begin to look for the bin of a value.

    Parameters
    ----------
    edges : (n + 1,) float64
        Edges of the bins.
    fineness : int
        Entries in the narrowest bin: the more, the rarer a second look. Fewer where
        there would be more than `LARGEST_TABLE` in all.

    Returns
    -------
    table : (T,) int32
        Bin of the values ``edges[0] + k / scale``; the bin of a value in between is
        that one, or one soon after.
    scale : float
        Entries per unit.
    """
    extent = float(edges[-1] - edges[0])
    scale = min(fineness / float(np.diff(edges).min()), LARGEST_TABLE / extent)
    size = int(extent * scale) + 2
    # A little early, so that rounding never puts an entry too far.
    starts = edges[0] + (np.arange(size) - EARLY) / scale
    table = np.searchsorted(edges, starts, side='right') - 1
    return np.clip(table, 0, len(edges) - 2).astype(np.int32), scale


@lru_cache(maxsize=4)
def grid_ruler(
    grid: GridConfig,
) -> tuple[FloatArray, CellArray, float, FloatArray, CellArray, float]:
    """Edges of the bins and of the segments, each with its table of where to begin to look."""
    edges, turns = bin_edges(grid), segment_edges(grid.n_segments)
    for array in (edges, turns):
        array.setflags(write=False)
    return edges, *first_bins(edges, 4), turns, *first_bins(turns, 8)


@compiled
def sort_points(
    share: int,
    start: int,
    stop: int,
    columns: PointArray,
    edges: FloatArray,
    table: CellArray,
    scale: float,
    turn_edges: FloatArray,
    turn_table: CellArray,
    turn_scale: float,
    farthest: float,
    tiles_per_metre: float,
    n_sides: int,
    cell: CellArray,
    r: PointArray,
    lowest_z: FloatArray,
    lowest_r: FloatArray,
    highest_z: FloatArray,
    count: IntArray,
    lowest_tile: CellArray,
    tile: CellArray,
    foot_z: PointArray,
    top_z: PointArray,
    touched: CellArray,
) -> None:
    """Sort points `start` to `stop` into cells and tiles, with the extremes of each.

    The twins are `polar_grid.build_polar_grid`, `reduce_cells` and `tiles.build_tiles`.
    The tables ``[share]`` start empty. Block by block: where the points lie, in loops
    without branches; then the extremes.
    """
    turn, near = np.empty(BLOCK, dtype=columns.dtype), np.empty(BLOCK, dtype=np.int32)
    for first in range(start, stop, BLOCK):
        own = slice(first, min(first + BLOCK, stop))
        x, y, z = columns[0, own], columns[1, own], columns[2, own]
        _measure_range(x, y, z, edges[0], farthest, scale, r[own], near, cell[own])
        _measure_turn(x, y, farthest, tiles_per_metre, n_sides, cell[own], turn, tile[own])
        _look_up(edges, table, turn_edges, turn_table, turn_scale, r[own], near, turn, cell[own])
        _reduce_cells(z, r[own], cell[own], tile[own], lowest_z[share], lowest_r[share],
                      highest_z[share], count[share], lowest_tile[share])  # fmt: skip
        _reduce_tiles(z, tile[own], foot_z[share], top_z[share], touched[share])


@compiled
def _measure_range(
    x: PointArray,
    y: PointArray,
    z: PointArray,
    nearest: float,
    farthest: float,
    scale: float,
    r: PointArray,
    near: CellArray,
    cell: CellArray,
) -> None:
    """Range of each point and its entry in the table; ``cell`` 0, or why it has none."""
    number = x.dtype.type
    zero, infinity, nothing = number(0.0), number(np.inf), number(np.nan)
    start, end, per_metre = number(nearest), number(farthest), number(scale)
    for i in range(len(r)):
        finite = (abs(x[i]) < infinity) & (abs(y[i]) < infinity) & (abs(z[i]) < infinity)
        own_r = math.sqrt(x[i] * x[i] + y[i] * y[i])
        inside = finite & (own_r < end)
        r[i] = own_r if finite else nothing
        cell[i] = 0 if inside else (OUTSIDE if finite else NOT_FINITE)
        beyond = (own_r - start) * per_metre
        near[i] = np.int32(beyond if inside & (beyond > zero) else zero)


# Apart from the other: of many arrays the compiler does not find out that none overlap.
@compiled
def _measure_turn(
    x: PointArray,
    y: PointArray,
    farthest: float,
    tiles_per_metre: float,
    n_sides: int,
    cell: CellArray,
    turn: PointArray,
    tile: CellArray,
) -> None:
    """Pseudo-angle and tile of each point that has a cell."""
    number = x.dtype.type
    zero, two, four = number(0.0), number(2.0), number(4.0)
    half, per_metre, last = number(farthest), number(tiles_per_metre), number(n_sides - 1)
    for i in range(len(cell)):
        inside = cell[i] == 0
        own_x = x[i] if inside else zero
        own_y = y[i] if inside else zero
        size = abs(own_x) + abs(own_y)
        share = own_y / size if size > zero else zero
        left = -share if own_y < zero else four - share
        own_turn = two + share if own_x >= zero else left
        # Exactly 4 is the edge that ends the last segment: that is segment 0 again.
        turn[i] = own_turn if own_turn < four else zero
        column = np.int32(min((own_x + half) * per_metre, last))
        row = np.int32(min((own_y + half) * per_metre, last))
        tile[i] = column * np.int32(n_sides) + row if inside else OUTSIDE


@compiled
def _look_up(
    edges: FloatArray,
    table: CellArray,
    turn_edges: FloatArray,
    turn_table: CellArray,
    turn_scale: float,
    r: PointArray,
    near: CellArray,
    turn: PointArray,
    cell: CellArray,
) -> None:
    """Cell of the points that have one: the table's bin, or one soon after."""
    n_bins = len(edges) - 1
    for i in range(len(cell)):
        if cell[i] != 0:
            continue
        # One step without a branch, which nobody could predict; more are rare.
        n = np.intp(table[np.uintp(near[i])])
        n += np.intp(r[i] >= edges[np.uintp(n + 1)])
        while r[i] >= edges[np.uintp(n + 1)]:
            n += 1
        m = np.intp(turn_table[np.uintp(turn[i] * turn_scale)])
        m += np.intp(turn[i] >= turn_edges[np.uintp(m + 1)])
        while turn[i] >= turn_edges[np.uintp(m + 1)]:
            m += 1
        cell[i] = m * n_bins + n


@compiled
def _reduce_cells(
    z: PointArray,
    r: PointArray,
    cell: CellArray,
    tile: CellArray,
    lowest_z: FloatArray,
    lowest_r: FloatArray,
    highest_z: FloatArray,
    count: IntArray,
    lowest_tile: CellArray,
) -> None:
    """Extremes of the cells.

    Sensors send neighbours one after the other: the extremes of the latest cell stay
    in registers until a point of another one comes.
    """
    held = np.uintp(0)
    low_z, low_r, high_z, number = lowest_z[0], lowest_r[0], highest_z[0], count[0]
    low_tile = lowest_tile[0]
    for i in range(len(cell)):
        if cell[i] < 0:
            continue
        own = np.uintp(cell[i])
        if own != held:
            lowest_z[held], lowest_r[held], lowest_tile[held] = low_z, low_r, low_tile
            highest_z[held], count[held] = high_z, number
            held = own
            low_z, low_r, low_tile = lowest_z[held], lowest_r[held], lowest_tile[held]
            high_z, number = highest_z[held], count[held]
        own_z, own_r = np.float64(z[i]), np.float64(r[i])
        number += 1
        high_z = max(high_z, own_z)
        if own_z > low_z:
            continue
        if own_z < low_z or own_r < low_r or (own_r == low_r and tile[i] < low_tile):
            low_z, low_r, low_tile = own_z, own_r, tile[i]
    lowest_z[held], lowest_r[held], lowest_tile[held] = low_z, low_r, low_tile
    highest_z[held], count[held] = high_z, number


@compiled
def _reduce_tiles(
    z: PointArray, tile: CellArray, foot_z: PointArray, top_z: PointArray, touched: CellArray
) -> None:
    """Extremes of the tiles, likewise; after their number, those touched first here."""
    held = np.uintp(0)
    low, high = foot_z[0], top_z[0]
    n_touched = touched[0]
    for i in range(len(tile)):
        if tile[i] < 0:
            continue
        own = np.uintp(tile[i])
        if own != held:
            foot_z[held], top_z[held] = low, high
            held = own
            low, high = foot_z[held], top_z[held]
        if low > high:  # so far it was empty
            n_touched += 1
            touched[n_touched] = tile[i]
        low, high = min(low, z[i]), max(high, z[i])
    foot_z[held], top_z[held] = low, high
    touched[0] = n_touched


@compiled
def merge_cells(
    lowest_z: FloatArray,
    lowest_r: FloatArray,
    highest_z: FloatArray,
    count: IntArray,
    lowest_tile: CellArray,
) -> None:
    """Reduce the tables of all shares into the first."""
    for share in range(1, len(count)):
        for k in range(count.shape[1]):
            if count[share, k] == 0:
                continue
            z, r, tile = lowest_z[share, k], lowest_r[share, k], lowest_tile[share, k]
            own = lowest_z[0, k], lowest_r[0, k], lowest_tile[0, k]
            if (z, r, tile) < own:
                lowest_z[0, k], lowest_r[0, k], lowest_tile[0, k] = z, r, tile
            highest_z[0, k] = max(highest_z[0, k], highest_z[share, k])
            count[0, k] += count[share, k]


@compiled
def merge_tiles(foot_z: PointArray, top_z: PointArray, touched: CellArray) -> None:
    """Reduce the tables of all shares into the first."""
    for share in range(1, len(foot_z)):
        for place in range(1, touched[share, 0] + 1):
            k = np.uintp(touched[share, place])
            foot_z[0, k] = min(foot_z[0, k], foot_z[share, k])
            top_z[0, k] = max(top_z[0, k], top_z[share, k])


@compiled
def collect_candidates(
    lowest_z: FloatArray,
    lowest_r: FloatArray,
    highest_z: FloatArray,
    count: IntArray,
    lowest_tile: CellArray,
    widths: FloatArray,
    min_extent: float,
    offsets: IntArray,
    r: FloatArray,
    z: FloatArray,
    own_bin: IntArray,
    density: FloatArray,
    tile: CellArray,
) -> int:
    """Do what `polar_grid.ground_candidates` does, into arrays for all bins; their number."""
    c = 0
    for m in range(count.shape[0]):
        offsets[m] = c
        for n in range(count.shape[1]):
            if count[m, n] == 0:
                continue
            r[c], z[c], own_bin[c] = lowest_r[m, n], lowest_z[m, n], n
            tile[c] = lowest_tile[m, n]
            extent = max(highest_z[m, n] - lowest_z[m, n], min_extent)
            density[c] = count[m, n] / (widths[n] * extent)
            c += 1
    offsets[count.shape[0]] = c
    return c
