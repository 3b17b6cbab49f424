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
    bin_edges,
    segment_edges,
)

CellArray = npt.NDArray[np.int32]


def first_bins(edges: FloatArray, fineness: int) -> tuple[npt.NDArray[np.int32], float]:
    """Table that says where to begin to look for the bin of a value.

    Parameters
    ----------
    edges : (n + 1,) float64
        Edges of the bins.
    fineness : int
        Entries in the narrowest bin: the more, the rarer a second look.

    Returns
    -------
    table : (T,) int32
        Bin of the values ``edges[0] + k / scale``; the bin of a value in between is
        that one or the next.
    scale : float
        Entries per unit.
    """
    scale = fineness / float(np.diff(edges).min())
    size = int((edges[-1] - edges[0]) * scale) + 2
    starts = edges[0] + np.arange(size) / scale
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
    xyz: FloatArray,
    edges: FloatArray,
    table: CellArray,
    scale: float,
    turn_edges: FloatArray,
    turn_table: CellArray,
    turn_scale: float,
    cell: CellArray,
    r: FloatArray,
    lowest_z: FloatArray,
    lowest_r: FloatArray,
    highest_z: FloatArray,
    count: IntArray,
) -> None:
    """Do what `polar_grid.build_polar_grid` and `reduce_cells` do for some points.

    Points `start` to `stop`, reduced into tables ``[share]`` that start empty. Sensors
    send neighbours one after the other: the extremes of the latest cell stay in
    registers until a point of another one comes.
    """
    n_bins = len(edges) - 1
    nearest, first_edge, farthest = edges[0], edges[1], edges[n_bins]
    held = np.uintp(0)
    low_z, low_r, high_z, number = np.inf, np.inf, -np.inf, 0
    for i in range(start, stop):
        x, y, z = xyz[i, 0], xyz[i, 1], xyz[i, 2]
        if not (math.isfinite(x) and math.isfinite(y) and math.isfinite(z)):
            cell[i], r[i] = NOT_FINITE, np.nan
            continue
        own_r = math.sqrt(x * x + y * y)
        r[i] = own_r
        if own_r >= farthest:
            cell[i] = OUTSIDE
            continue
        n = 0
        if own_r >= first_edge:
            n = int(table[np.uintp((own_r - nearest) * scale)])
            # Rounding may have put the entry one too far.
            if own_r < edges[np.uintp(n)]:
                n -= 1
            while own_r >= edges[np.uintp(n + 1)]:
                n += 1
        size = abs(x) + abs(y)
        turn = y / size if size > 0.0 else 0.0
        if x >= 0.0:
            turn += 2.0
        elif y < 0.0:
            turn = -turn
        else:
            turn = 4.0 - turn
        m = 0
        # Exactly 4 is the edge that ends the last segment: that is segment 0 again.
        if turn < 4.0:
            m = int(turn_table[np.uintp(turn * turn_scale)])
            if turn < turn_edges[np.uintp(m)]:
                m -= 1
            while turn >= turn_edges[np.uintp(m + 1)]:
                m += 1
        own = np.uintp(m * n_bins + n)
        cell[i] = own
        if own != held:
            if number > 0:
                lowest_z[share, held], lowest_r[share, held] = low_z, low_r
                highest_z[share, held], count[share, held] = high_z, number
            held = own
            low_z, low_r = lowest_z[share, held], lowest_r[share, held]
            high_z, number = highest_z[share, held], count[share, held]
        number += 1
        high_z = max(high_z, z)
        if z < low_z or (z == low_z and own_r < low_r):
            low_z, low_r = z, own_r
    if number > 0:
        lowest_z[share, held], lowest_r[share, held] = low_z, low_r
        highest_z[share, held], count[share, held] = high_z, number


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
