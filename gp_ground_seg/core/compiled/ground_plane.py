"""Loops of `gp_ground_seg.core.pipeline.ground_plane` for compiled code."""

from __future__ import annotations

import numpy as np

from gp_ground_seg.core.frame import Candidates, FloatArray
from gp_ground_seg.core.jit import compiled_form, jit
from gp_ground_seg.core.pipeline import ground_plane
from gp_ground_seg.core.pipeline.ground_plane import (
    MIN_CELLS,
    GroundPlane,
    LowestPoints,
    Moments,
    Plane,
    described,
    levelness,
    lowest_points,
    own_level,
    support_by,
    tukey_weight,
)


@jit(entry=True)
def _fit_cells(cells: LowestPoints, max_slope: float) -> tuple[Plane, float]:
    return own_level(cells, max_slope)


def fit_plane(candidates: Candidates, max_slope: float) -> GroundPlane | None:
    """Do what `gp_ground_seg.core.pipeline.ground_plane.fit_plane` does, to rounding."""
    cells = lowest_points(candidates)
    return described(cells, *_fit_cells(cells, max_slope)) if len(cells.z) >= MIN_CELLS else None


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
