"""The passes over all points, compiled; the numpy twins are in the modules named below."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from gp_ground_seg.compiled import compiled
from gp_ground_seg.polar_grid import OUTSIDE, FloatArray, IntArray

BoolArray = npt.NDArray[np.bool_]


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


@compiled
def assign_cells(
    start: int,
    stop: int,
    xyz: FloatArray,
    finite: BoolArray,
    edges: FloatArray,
    table: IntArray,
    scale: float,
    n_segments: int,
    segment: IntArray,
    index: IntArray,
    r: FloatArray,
) -> None:
    """Do what `gp_ground_seg.polar_grid.build_polar_grid` does for points `start` to `stop`."""
    last = len(edges) - 1
    for i in range(start, stop):
        if not finite[i]:
            segment[i], index[i], r[i] = 0, OUTSIDE, np.nan
            continue
        x, y = xyz[i, 0], xyz[i, 1]
        own_r = math.hypot(x, y)
        r[i] = own_r
        turn = math.atan2(y, x) / (2.0 * math.pi) + 0.5
        segment[i] = int(turn * n_segments) % n_segments
        if own_r >= edges[last]:
            index[i] = OUTSIDE
        elif own_r < edges[1]:
            index[i] = 0
        else:
            n = table[int((own_r - edges[0]) * scale)]
            # Rounding may have put the entry one too far.
            while own_r < edges[n]:
                n -= 1
            while own_r >= edges[n + 1]:
                n += 1
            index[i] = n


@compiled
def fill_cells(
    segment: IntArray,
    index: IntArray,
    r: FloatArray,
    z: FloatArray,
    lowest_z: FloatArray,
    lowest_r: FloatArray,
    highest_z: FloatArray,
    count: IntArray,
) -> None:
    """Do what `gp_ground_seg.polar_grid.reduce_cells` does, into tables that start empty."""
    for i in range(len(r)):
        n = index[i]
        if n == OUTSIDE:
            continue
        m = segment[i]
        count[m, n] += 1
        if z[i] < lowest_z[m, n] or (z[i] == lowest_z[m, n] and r[i] < lowest_r[m, n]):
            lowest_z[m, n], lowest_r[m, n] = z[i], r[i]
        highest_z[m, n] = max(highest_z[m, n], z[i])


@compiled
def surface_under_points(
    start: int,
    stop: int,
    segment: IntArray,
    index: IntArray,
    r: FloatArray,
    knots: FloatArray,
    mean: FloatArray,
    std: FloatArray,
    ground_z: FloatArray,
    ground_std: FloatArray,
) -> None:
    """Do what `gp_ground_seg.surface.GroundSurface.at` does for points `start` to `stop`."""
    for i in range(start, stop):
        n = index[i]
        if n == OUTSIDE:
            ground_z[i] = ground_std[i] = np.nan
            continue
        m = segment[i]
        weight = max((r[i] - knots[n]) / (knots[n + 1] - knots[n]), 0.0)
        ground_z[i] = mean[m, n] * (1.0 - weight) + mean[m, n + 1] * weight
        ground_std[i] = std[m, n] * (1.0 - weight) + std[m, n + 1] * weight
