"""Loops of `gp_ground_seg.core.pipeline.ground_plane` for compiled code."""

from __future__ import annotations

from typing import Any

import numpy as np

from gp_ground_seg.core.frame import BoolArray, Candidates, FloatArray, IntArray
from gp_ground_seg.core.jit import compiled_form, jit
from gp_ground_seg.core.pipeline import ground_plane
from gp_ground_seg.core.pipeline.ground_plane import (
    CLEARLY_OFF,
    LEAST_REACH,
    MAX_Z,
    MIN_CELLS,
    N_CELLS,
    N_RINGS,
    N_SECTORS,
    N_TOGETHER,
    RING_EDGES,
    GroundPlane,
    LowestPoints,
    Moments,
    Plane,
    cells_of,
    crossed_at,
    described,
    distance,
    levelness,
    own_level,
    refutation_by,
    support_by,
    tolerance_at,
    tukey_weight,
)


@jit(entry=True)
def _fit_cells(cells: LowestPoints, max_slope: float) -> tuple[Plane, float]:
    return own_level(cells, max_slope)


def fit_plane(candidates: Candidates, max_slope: float) -> GroundPlane | None:
    """Do what `gp_ground_seg.core.pipeline.ground_plane.fit_plane` does, to rounding."""
    r, z, lowest_z = np.empty((3, N_CELLS))
    number, segment = np.empty((2, N_CELLS), dtype=np.int64)
    columns: tuple[Any, ...] = r, z, lowest_z, number, np.empty(N_CELLS, np.bool_), segment
    n = _tabulate(candidates, *columns)
    cells = cells_of(candidates.n_segments, *(column[:n] for column in columns))
    return described(cells, *_fit_cells(cells, max_slope)) if n >= MIN_CELLS else None


@jit(entry=True)
def _tabulate(
    candidates: Candidates,
    low_r: FloatArray,
    low_z: FloatArray,
    lowest_z: FloatArray,
    number: IntArray,
    is_alone: BoolArray,
    segment: IntArray,
) -> int:
    """Set the columns that `cells_of` takes; return the number of cells."""
    offsets, r, z = candidates.offsets, candidates.r, candidates.z
    n_segments = len(offsets) - 1
    cell_of, starts = np.empty(len(r), np.int64), np.zeros(N_CELLS + 1, np.int64)
    for m in range(n_segments):
        first = (m * N_SECTORS // n_segments) * N_RINGS
        for c in range(offsets[m], offsets[m + 1]):
            cell_of[c] = -1
            if RING_EDGES[0] <= r[c] < RING_EDGES[N_RINGS] and abs(z[c]) < MAX_Z:
                cell_of[c] = first + np.searchsorted(RING_EDGES, r[c], side='right') - 1
                starts[cell_of[c] + 1] += 1
    for cell in range(N_CELLS):
        starts[cell + 1] += starts[cell]
    # Candidates cell by cell, in order of their segments.
    n, ends, home = starts[N_CELLS], starts[:N_CELLS].copy(), np.empty(starts[N_CELLS], np.int64)
    near_r, near_z = np.empty(n), np.empty(n)
    for m in range(n_segments):
        for c in range(offsets[m], offsets[m + 1]):
            if cell_of[c] >= 0:
                k = ends[cell_of[c]]
                near_r[k], near_z[k], home[k] = r[c], z[c], m
                ends[cell_of[c]] += 1
    n = 0
    for cell in range(N_CELLS):
        if starts[cell] < ends[cell]:
            first, end = starts[cell], ends[cell]
            _sort(near_r, near_z, home, first, end)
            k = _lowest_together(near_r, near_z, first, end)
            is_alone[n], k, lowest_z[n], number[n] = k < 0, max(k, first), near_z[first], cell
            low_r[n], low_z[n], segment[n] = near_r[k], near_z[k], home[k]
            n += 1
    return n


@jit()
def _sort(r: FloatArray, z: FloatArray, home: IntArray, first: int, end: int) -> None:
    """Sort the candidates from `first` to `end` by height, then by range, in place: few."""
    start, one = np.uintp(first), np.uintp(1)
    for k in range(start + one, np.uintp(end)):
        r_k, z_k, home_k, place = r[k], z[k], home[k], k
        while place > start:
            before = place - one
            if z[before] < z_k or (z[before] == z_k and r[before] <= r_k):
                break
            r[place], z[place], home[place] = r[before], z[before], home[before]
            place = before
        r[place], z[place], home[place] = r_k, z_k, home_k


@jit()
def _lowest_together(r: FloatArray, z: FloatArray, first: int, end: int) -> int:
    """Lowest of the sorted ones from `first` to `end` that is not alone, or -1."""
    for k in range(first, end - N_TOGETHER + 1):
        if z[k + N_TOGETHER - 1] - z[k] <= tolerance_at(r[k]):
            return k
    return -1


@compiled_form(ground_plane.supports_of)
def supports_of(planes: FloatArray, cells: LowestPoints) -> FloatArray:
    """Support of planes (P, 3) by the points near them, (P,)."""
    supports = np.empty(len(planes))
    for p in range(len(planes)):
        plane = (planes[p, 0], planes[p, 1], planes[p, 2])
        supports[p] = levelness(planes[p, 1], planes[p, 2]) * _support_of(plane, cells)
    return supports


@jit(fastmath=True)
def _support_of(plane: Plane, cells: LowestPoints) -> float:
    """Support of a plane by the points near it; a loop that adds in any order."""
    x, y, z, inverse, weight = cells.x, cells.y, cells.z, cells.inverse, cells.weight
    total = 0.0
    for c in range(len(x)):
        total += support_by(x[c], y[c], z[c], inverse[c], weight[c], plane)
    return total


@compiled_form(ground_plane.refutation_of)
def refutation_of(plane: Plane, cells: LowestPoints) -> float:
    """Weight of the rays that cross a plane where it should have stopped them."""
    total, heights = 0.0, np.empty(len(cells.z))
    is_seen, reach = np.zeros(N_CELLS, np.bool_), np.full(N_SECTORS, LEAST_REACH)
    for c in range(len(heights)):
        heights[c] = distance(cells.x[c], cells.y[c], cells.z[c], plane)
        if abs(heights[c] * cells.inverse[c]) < 1.0:
            sector = cells.cell[c] // N_RINGS
            is_seen[cells.cell[c]], reach[sector] = True, max(reach[sector], cells.r[c])
    for c in range(len(heights)):
        if heights[c] * cells.inverse[c] < -CLEARLY_OFF and not cells.is_alone[c]:
            sector = cells.cell[c] // N_RINGS
            crossing = crossed_at(cells.r[c], heights[c], plane[0])
            ring = np.searchsorted(RING_EDGES[1:-1], crossing, side='right')
            if crossing < reach[sector] and not is_seen[sector * N_RINGS + ring]:
                total += refutation_by(crossing)
    return total


@compiled_form(ground_plane.weighted_moments, fastmath=True)
def weighted_moments(cells: LowestPoints, plane: Plane) -> Moments:
    """Return the moments of the points with Tukey's weights; a loop that adds in any order."""
    w, wx, wy, wxx, wxy, wyy, wz, wxz, wyz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for c in range(len(cells.x)):
        x, y, z = cells.x[c], cells.y[c], cells.z[c]
        weight = tukey_weight(x, y, z, cells.inverse[c], plane)
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
