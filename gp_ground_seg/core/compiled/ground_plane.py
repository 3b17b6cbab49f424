"""Loops of `gp_ground_seg.core.pipeline.ground_plane` for compiled code."""

from typing import Any

import numpy as np

from gp_ground_seg.core.frame import BoolArray, Candidates, FloatArray, IntArray
from gp_ground_seg.core.jit import compiled_form, jit
from gp_ground_seg.core.pipeline import ground_plane, lowest_points
from gp_ground_seg.core.pipeline.ground_plane import (
    CLEARLY_OFF,
    LEAST_REACH,
    Plane,
    crossing_of,
    distance,
    fit_plane,
    is_possible,
    levelness,
    refutation_by,
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
    """Do what the twin does."""
    r, z, end = candidates.r, candidates.z, candidates.offsets[1:]
    there, own, n = candidates.offsets.copy(), np.empty(len(r), np.int64), 0
    found, is_alone = np.empty((3, N_CELLS), np.int64), np.ones(N_CELLS, np.bool_)
    first = -(-np.arange(N_SECTORS + 1) * len(end) // N_SECTORS)
    for cell in range(N_CELLS):
        sector, stop, k = cell // N_RINGS, RING_EDGES[cell % N_RINGS + 1], 0
        # Each segment of the sector goes on where the ring before has ended.
        for m in range(first[sector], first[sector + 1]):
            while there[m] < end[m] and r[there[m]] < stop:
                c, place = there[m], k
                there[m] += 1
                if r[c] >= RING_EDGES[0] and abs(z[c]) < MAX_Z:
                    while place > 0 and z[own[place - 1]] > z[c]:
                        own[place] = own[place - 1]
                        place -= 1
                    own[place] = c
                    k += 1
        if k > 0:
            found[0, n], found[1, n], found[2, n] = cell, own[0], own[0]
            for i in range(k - N_TOGETHER + 1):
                if z[own[i + N_TOGETHER - 1]] - z[own[i]] <= tolerance_at(r[own[i]]):
                    found[2, n], is_alone[n] = own[i], False
                    break
            n += 1
    return found[0, :n], found[1, :n], found[2, :n], is_alone[:n]


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


@compiled_form(ground_plane.refutation_of)
def refutation_of(plane: Plane, cells: LowestPoints) -> float:
    """Weight of the rays that cross a plane where it should have stopped them."""
    x, y, z, r = cells.x, cells.y, cells.z, cells.r
    is_seen, reach = np.zeros(N_CELLS, dtype=np.bool_), np.full(N_SECTORS, LEAST_REACH)
    for c in range(len(x)):
        if abs(distance(x[c], y[c], z[c], plane) * cells.inverse[c]) < 1.0:
            is_seen[cells.cell[c]] = True
            # The farthest is the last of a sector.
            reach[cells.cell[c] // N_RINGS] = max(r[c], LEAST_REACH)
    refutation = 0.0
    for c in range(len(x)):
        height = distance(x[c], y[c], z[c], plane)
        if height * cells.inverse[c] < -CLEARLY_OFF and not cells.is_alone[c]:
            crossing = crossing_of(r[c], height, plane)
            sector = cells.cell[c] // N_RINGS
            ring = np.searchsorted(RING_EDGES[1:-1], crossing, side='right')
            if crossing < reach[sector] and not is_seen[sector * N_RINGS + ring]:
                refutation += refutation_by(crossing)
    return refutation


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
