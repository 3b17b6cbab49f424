"""Loops of `gp_ground_seg.core.pipeline.ground_plane` for compiled code."""

from typing import Any

import numpy as np

from gp_ground_seg.core.frame import FloatArray
from gp_ground_seg.core.jit import compiled_form, jit
from gp_ground_seg.core.pipeline import ground_plane
from gp_ground_seg.core.pipeline.ground_plane import (
    Plane,
    fit_plane,
    is_possible,
    levelness,
    solve_plane,
    support_by,
    tukey_weight,
)
from gp_ground_seg.core.pipeline.lowest_points import LowestPoints


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
            planes[p, 0], planes[p, 1], planes[p, 2] = plane


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
