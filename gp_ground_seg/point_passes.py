"""The passes over all points, compiled; the numpy twins are in the modules named below."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from gp_ground_seg.compiled import compiled
from gp_ground_seg.config import GridConfig
from gp_ground_seg.points import PointArray
from gp_ground_seg.polar_grid import (
    NOT_FINITE,
    OUTSIDE,
    FloatArray,
    IntArray,
    bin_edges,
    segment_edges,
)

CellArray = npt.NDArray[np.int32]
LARGEST_TABLE = 2**15
BLOCK = 512
"""Points sorted at a time: what is known of them stays in the nearest cache."""
EARLY = 1e-6
"""How much earlier the entries of a table begin, in entries: more than rounding does."""


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
    xyz: PointArray,
    edges: FloatArray,
    table: CellArray,
    scale: float,
    turn_edges: FloatArray,
    turn_table: CellArray,
    turn_scale: float,
    tiles_per_metre: float,
    n_sides: int,
    cell: CellArray,
    r: FloatArray,
    lowest_z: FloatArray,
    lowest_r: FloatArray,
    highest_z: FloatArray,
    count: IntArray,
    tile: CellArray,
    foot_z: PointArray,
    top_z: PointArray,
) -> None:
    """Sort points `start` to `stop` into cells and tiles, with the extremes of each.

    The twins are `polar_grid.build_polar_grid`, `reduce_cells` and `tiles.build_tiles`.
    The tables ``[share]`` start empty. Block by block: where the points lie, in loops
    without branches; then the extremes.
    """
    turn, near = np.empty(BLOCK), np.empty(BLOCK, dtype=np.int32)
    for first in range(start, stop, BLOCK):
        last = min(first + BLOCK, stop)
        own = slice(first, last)
        _measure_range(xyz[own], edges[0], edges[-1], scale, r[own], near, cell[own])
        _measure_turn(xyz[own], edges[-1], tiles_per_metre, n_sides, cell[own], turn, tile[own])
        _look_up(edges, table, turn_edges, turn_table, turn_scale, r[own], near, turn, cell[own])
        _reduce_cells(xyz[own], r[own], cell[own], lowest_z[share], lowest_r[share],
                      highest_z[share], count[share])  # fmt: skip
        _reduce_tiles(xyz[own], tile[own], foot_z[share], top_z[share])


@compiled
def _measure_range(
    xyz: PointArray,
    nearest: float,
    farthest: float,
    scale: float,
    r: FloatArray,
    near: CellArray,
    cell: CellArray,
) -> None:
    """Range of each point and its entry in the table; ``cell`` 0, or why it has none."""
    for i in range(len(r)):
        x, y, z = np.float64(xyz[i, 0]), np.float64(xyz[i, 1]), np.float64(xyz[i, 2])
        finite = (abs(x) < np.inf) & (abs(y) < np.inf) & (abs(z) < np.inf)
        own_r = math.sqrt(x * x + y * y)
        inside = finite & (own_r < farthest)
        r[i] = own_r if finite else np.nan
        cell[i] = 0 if inside else (OUTSIDE if finite else NOT_FINITE)
        beyond = (own_r - nearest) * scale
        near[i] = np.int32(beyond if inside & (beyond > 0.0) else 0.0)


# Apart from the other: of many arrays the compiler does not find out that none overlap.
@compiled
def _measure_turn(
    xyz: PointArray,
    farthest: float,
    tiles_per_metre: float,
    n_sides: int,
    cell: CellArray,
    turn: FloatArray,
    tile: CellArray,
) -> None:
    """Pseudo-angle and tile of each point that has a cell."""
    for i in range(len(cell)):
        inside = cell[i] == 0
        x = np.float64(xyz[i, 0]) if inside else 0.0
        y = np.float64(xyz[i, 1]) if inside else 0.0
        size = abs(x) + abs(y)
        share = y / size if size > 0.0 else 0.0
        left = -share if y < 0.0 else 4.0 - share
        own_turn = 2.0 + share if x >= 0.0 else left
        # Exactly 4 is the edge that ends the last segment: that is segment 0 again.
        turn[i] = own_turn if own_turn < 4.0 else 0.0
        column = np.int32(min((x + farthest) * tiles_per_metre, n_sides - 1.0))
        row = np.int32(min((y + farthest) * tiles_per_metre, n_sides - 1.0))
        tile[i] = column * np.int32(n_sides) + row if inside else OUTSIDE


@compiled
def _look_up(
    edges: FloatArray,
    table: CellArray,
    turn_edges: FloatArray,
    turn_table: CellArray,
    turn_scale: float,
    r: FloatArray,
    near: CellArray,
    turn: FloatArray,
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
    xyz: PointArray,
    r: FloatArray,
    cell: CellArray,
    lowest_z: FloatArray,
    lowest_r: FloatArray,
    highest_z: FloatArray,
    count: IntArray,
) -> None:
    """Extremes of the cells.

    Sensors send neighbours one after the other: the extremes of the latest cell stay
    in registers until a point of another one comes.
    """
    held = np.uintp(0)
    low_z, low_r, high_z, number = lowest_z[0], lowest_r[0], highest_z[0], count[0]
    for i in range(len(cell)):
        if cell[i] < 0:
            continue
        own = np.uintp(cell[i])
        if own != held:
            lowest_z[held], lowest_r[held] = low_z, low_r
            highest_z[held], count[held] = high_z, number
            held = own
            low_z, low_r = lowest_z[held], lowest_r[held]
            high_z, number = highest_z[held], count[held]
        z = np.float64(xyz[i, 2])
        number += 1
        high_z = max(high_z, z)
        if z < low_z or (z == low_z and r[i] < low_r):
            low_z, low_r = z, r[i]
    lowest_z[held], lowest_r[held] = low_z, low_r
    highest_z[held], count[held] = high_z, number


@compiled
def _reduce_tiles(xyz: PointArray, tile: CellArray, foot_z: PointArray, top_z: PointArray) -> None:
    """Extremes of the tiles, likewise."""
    held = np.uintp(0)
    low, high = foot_z[0], top_z[0]
    for i in range(len(tile)):
        if tile[i] < 0:
            continue
        own = np.uintp(tile[i])
        if own != held:
            foot_z[held], top_z[held] = low, high
            held = own
            low, high = foot_z[held], top_z[held]
        low, high = min(low, xyz[i, 2]), max(high, xyz[i, 2])
    foot_z[held], top_z[held] = low, high


@compiled
def merge_cells(
    lowest_z: FloatArray, lowest_r: FloatArray, highest_z: FloatArray, count: IntArray
) -> None:
    """Reduce the tables of all shares into the first."""
    for share in range(1, len(count)):
        for k in range(count.shape[1]):
            if count[share, k] == 0:
                continue
            z, r = lowest_z[share, k], lowest_r[share, k]
            if z < lowest_z[0, k] or (z == lowest_z[0, k] and r < lowest_r[0, k]):
                lowest_z[0, k], lowest_r[0, k] = z, r
            highest_z[0, k] = max(highest_z[0, k], highest_z[share, k])
            count[0, k] += count[share, k]


@compiled
def merge_tiles(foot_z: PointArray, top_z: PointArray) -> None:
    """Reduce the tables of all shares into the first."""
    for share in range(1, len(foot_z)):
        for k in range(foot_z.shape[1]):
            foot_z[0, k] = min(foot_z[0, k], foot_z[share, k])
            top_z[0, k] = max(top_z[0, k], top_z[share, k])
