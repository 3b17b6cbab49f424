"""Loops of `gp_ground_seg.core.pipeline.ground_plane` for compiled code."""

from typing import Any

import numpy as np

from gp_ground_seg.core.frame import FloatArray
from gp_ground_seg.core.jit import compiled_form, jit
from gp_ground_seg.core.pipeline import ground_plane
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
    N_CELLS,
    N_RINGS,
    N_SECTORS,
    RING_EDGES,
    LowestPoints,
)


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
