"""Loops of `gp_ground_seg.core.pipeline.ground_plane` for compiled code."""

from typing import Any

import numpy as np

from gp_ground_seg.core.frame import BoolArray, Candidates, FloatArray, IntArray
from gp_ground_seg.core.jit import compiled_form, jit
from gp_ground_seg.core.pipeline import ground_plane, lowest_points
from gp_ground_seg.core.pipeline.ground_plane import (
    Plane,
    fit_plane,
    is_possible,
    levelness,
    solve_plane,
    support_by,
    tukey_weight,
)
from gp_ground_seg.core.pipeline.lowest_points import (
    MAX_Z,
    N_CELLS,
    N_RINGS,
    N_SECTORS,
    N_TOGETHER,
    RING_EDGES,
    LowestPoints,
    tolerance_at,
)


@compiled_form(lowest_points.lowest_of_cells)
def lowest_of_cells(candidates: Candidates) -> tuple[IntArray, IntArray, IntArray, BoolArray]:
    """Occupied cells, the lowest candidate of each, the one that counts, whether it is alone."""
    r, z, offsets = candidates.r, candidates.z, candidates.offsets
    n_segments = len(offsets) - 1
    cell, stop = np.full(len(r), N_CELLS), np.zeros(N_CELLS + 1, dtype=np.int64)
    for m in range(n_segments):
        for c in range(offsets[m], offsets[m + 1]):
            if RING_EDGES[0] <= r[c] < RING_EDGES[-1] and abs(z[c]) < MAX_Z:
                ring = np.searchsorted(RING_EDGES, r[c], side='right') - 1
                cell[c] = m * N_SECTORS // n_segments * N_RINGS + ring
                stop[cell[c] + 1] += 1
    stop = np.cumsum(stop)
    start, order = stop.copy(), np.empty(stop[N_CELLS], dtype=np.int64)
    # A cell's candidates go behind those that are not higher.
    for c in range(len(r)):
        own = cell[c]
        if own < N_CELLS:
            k = stop[own]
            stop[own] += 1
            while k > start[own] and z[order[k - 1]] > z[c]:
                order[k] = order[k - 1]
                k -= 1
            order[k] = c
    occupied = np.flatnonzero(stop > start)
    first = order[start[occupied]]
    lowest, is_alone = first.copy(), np.ones(len(first), dtype=np.bool_)
    for i in range(len(occupied)):
        for k in range(start[occupied[i]], stop[occupied[i]] - N_TOGETHER + 1):
            low = order[k]
            if z[order[k + N_TOGETHER - 1]] - z[low] <= tolerance_at(r[low]):
                lowest[i], is_alone[i] = low, False
                break
    return occupied, first, lowest, is_alone


@compiled_form(ground_plane.supports_of)
def supports_of(planes: FloatArray, cells: LowestPoints, weight: FloatArray) -> FloatArray:
    """Support of planes (P, 3) by the points near them, (P,)."""
    supports = np.empty(len(planes))
    for p in range(len(planes)):
        plane = (planes[p, 0], planes[p, 1], planes[p, 2])
        supports[p] = levelness(planes[p, 1], planes[p, 2]) * _support_of(plane, cells, weight)
    return supports


@jit(fastmath=True)
def _support_of(plane: Plane, cells: LowestPoints, weight: FloatArray) -> float:
    """Support of a plane by the points near it; a loop that adds in any order."""
    x, y, z, inverse = cells.x, cells.y, cells.z, cells.inverse
    total = 0.0
    for c in range(len(x)):
        total += support_by(x[c], y[c], z[c], inverse[c], weight[c], plane)
    return total


@compiled_form(ground_plane.refine)
def refine(
    x: FloatArray, y: FloatArray, z: FloatArray, inverse: FloatArray,
    planes: FloatArray, max_slope: float, n_steps: int,
) -> None:  # fmt: skip
    """Weighted least squares with Tukey's weights of the plane before, again and again."""
    for p in range(len(planes)):
        plane = (planes[p, 0], planes[p, 1], planes[p, 2])
        for _ in range(n_steps):
            plane = solve_plane(_weighted_moments(x, y, z, inverse, plane), plane)
        if is_possible(plane, max_slope):
            planes[p] = plane


@jit(fastmath=True)
def _weighted_moments(
    xs: FloatArray, ys: FloatArray, zs: FloatArray, inverse: FloatArray, plane: Plane
) -> Any:
    """Return the moments of the points with Tukey's weights; a loop that adds in any order."""
    w, wx, wy, wxx, wxy, wyy, wz, wxz, wyz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for c in range(len(xs)):
        x, y, z = xs[c], ys[c], zs[c]
        weight = tukey_weight(x, y, z, inverse[c], plane)
        w += weight
        wx += weight * x
        wy += weight * y
        wxx += weight * x * x
        wxy += weight * x * y
        wyy += weight * y * y
        wz += weight * z
        wxz += weight * x * z
        wyz += weight * y * z
    return w, wx, wy, wxx, wxy, wyy, wz, wxz, wyz


fit = jit(entry=True)(fit_plane)
