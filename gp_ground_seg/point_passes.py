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


def first_bins(edges: FloatArray) -> tuple[IntArray, float]:
    """Table that says where to begin to look for the bin of a range.

    Returns
    -------
    table : (T,) int64
        Bin of the ranges ``edges[0] + k / scale``; the bin of a range in between is
        that one or the next few.
    scale : float
        Entries per metre: no bin is narrower than an entry.
    """
    scale = 1.0 / float(np.diff(edges).min())
    size = int((edges[-1] - edges[0]) * scale) + 2
    starts = edges[0] + np.arange(size) / scale
    table = np.searchsorted(edges, starts, side='right') - 1
    return np.clip(table, 0, len(edges) - 2), scale


@lru_cache(maxsize=4)
def grid_ruler(
    grid: GridConfig,
) -> tuple[FloatArray, IntArray, float, FloatArray, IntArray, float]:
    """Edges of the bins and of the segments, each with its table of where to begin to look."""
    edges, turns = bin_edges(grid), segment_edges(grid.n_segments)
    for array in (edges, turns):
        array.setflags(write=False)
    return edges, *first_bins(edges), turns, *first_bins(turns)


@compiled
def sort_points(
    share: int,
    start: int,
    stop: int,
    xyz: FloatArray,
    edges: FloatArray,
    table: IntArray,
    scale: float,
    turn_edges: FloatArray,
    turn_table: IntArray,
    turn_scale: float,
    cell: CellArray,
    r: FloatArray,
    lowest_z: FloatArray,
    lowest_r: FloatArray,
    highest_z: FloatArray,
    count: IntArray,
) -> None:
    """Do what `polar_grid.build_polar_grid` and `reduce_cells` do for some points.

    Points `start` to `stop`, reduced into tables ``[share]`` that start empty.
    """
    n_bins = len(edges) - 1
    lowest_z, lowest_r = lowest_z[share], lowest_r[share]
    highest_z, count = highest_z[share], count[share]
    for i in range(start, stop):
        x, y, z = xyz[i, 0], xyz[i, 1], xyz[i, 2]
        if not (math.isfinite(x) and math.isfinite(y) and math.isfinite(z)):
            cell[i], r[i] = NOT_FINITE, np.nan
            continue
        own_r = math.sqrt(x * x + y * y)
        r[i] = own_r
        if own_r >= edges[n_bins]:
            cell[i] = OUTSIDE
            continue
        n = 0
        if own_r >= edges[1]:
            n = table[int((own_r - edges[0]) * scale)]
            # Rounding may have put the entry one too far.
            while own_r < edges[n]:
                n -= 1
            while own_r >= edges[n + 1]:
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
        if turn < 4.0:
            m = turn_table[int(turn * turn_scale)]
            while turn < turn_edges[m]:
                m -= 1
            while turn >= turn_edges[m + 1]:
                m += 1
        own = m * n_bins + n
        cell[i] = own
        count[own] += 1
        if z < lowest_z[own] or (z == lowest_z[own] and own_r < lowest_r[own]):
            lowest_z[own], lowest_r[own] = z, own_r
        if z > highest_z[own]:
            highest_z[own] = z


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
