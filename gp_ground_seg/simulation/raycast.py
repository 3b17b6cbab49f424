"""First crossing of rays with a terrain, certified: no step can jump over one.

Along a ray the clearance f(t) = z_ray(t) - z_terrain(t) is smooth within a piece of the
terrain, and its second derivative is at least -K, with K the terrain's bend bound. So
f(t + s) >= f + f' s - K s^2 / 2, and the root of that parabola is the largest step that is
sure not to pass a crossing. Near a crossing it is a Newton step, quadratic in convergence;
on a plane it is exact at once.
"""

from __future__ import annotations

import numpy as np

from gp_ground_seg.frame import FloatArray
from gp_ground_seg.simulation.terrain import Terrain

CLEARANCE_TOLERANCE = 1e-9
"""Height above the terrain at which a ray has met it [m]."""
SHORTEST_PIECE = 1e-9
"""Pieces that a ray crosses in less than this are numerical debris of equal break lines [m]."""


def first_hit(
    terrain: Terrain, origin: FloatArray, direction: FloatArray, max_range: float
) -> FloatArray:
    """Range [m] at which each ray first meets the terrain, (R,), infinite beyond `max_range` [m].

    `origin` [m], above the terrain, and `direction`, unit vectors, are (R, 3).
    """
    entry = np.zeros(len(origin))
    ceiling = terrain.ceiling()
    if ceiling is not terrain:
        # Free space above all waves is crossed in a few steps.
        entry = _march(ceiling, origin, direction, entry, max_range)
    return _march(terrain, origin, direction, entry, max_range)


def _march(
    terrain: Terrain,
    origin: FloatArray,
    direction: FloatArray,
    start: FloatArray,
    max_range: float,
) -> FloatArray:
    """As `first_hit`, from the ranges `start` on (infinite = no hit)."""
    hit = np.full(len(origin), np.inf)
    ray = np.flatnonzero(start <= max_range)
    ends = _piece_ends(terrain, origin[ray], direction[ray], max_range)
    t, piece = start[ray].copy(), np.sum(ends < start[ray, None], axis=1)
    while len(ray):
        rows = np.arange(len(ray))
        end = ends[rows, piece]
        debris = end - t < SHORTEST_PIECE
        middle = 0.5 * (np.where(piece > 0, ends[rows, piece - 1], 0.0) + end)
        o, d = origin[ray], direction[ray]
        height, slope, bend = terrain.along(
            o[:, :2] + t[:, None] * d[:, :2], d[:, :2], o[:, :2] + middle[:, None] * d[:, :2]
        )
        clearance = o[:, 2] + t * d[:, 2] - height
        met = (clearance <= CLEARANCE_TOLERANCE) & ~debris
        hit[ray[met]] = t[met]

        step = _safe_step(clearance, d[:, 2] - slope, np.maximum(bend, 0.0))
        leaves = debris | (t + step >= end)
        t = np.where(leaves, end, t + step)
        piece = piece + leaves
        keep = ~met & (piece < ends.shape[1])
        ray, t, piece, ends = ray[keep], t[keep], piece[keep], ends[keep]
    return hit


def _safe_step(clearance: FloatArray, rate: FloatArray, bend: FloatArray) -> FloatArray:
    """Smallest positive root s of clearance + rate s - bend s^2 / 2, infinite if none."""
    root = np.sqrt(rate**2 + 2.0 * bend * np.maximum(clearance, 0.0))
    with np.errstate(divide='ignore', invalid='ignore', over='ignore'):
        # Two forms of one root; each loses no digits for its sign of the rate.
        falling = 2.0 * clearance / (root - rate)
        rising = (rate + root) / bend
    step = np.where(rate < 0.0, falling, rising)
    return np.where(np.isnan(step), np.inf, step)


def _piece_ends(
    terrain: Terrain, origin: FloatArray, direction: FloatArray, max_range: float
) -> FloatArray:
    """Ranges at which each ray leaves the smooth pieces it crosses, ascending, (R, B + 1).

    The last one is `max_range`; lines that a ray does not cross on the way are there too.
    """
    a, b, c = terrain.breaks().T
    rate = direction[:, :1] * a + direction[:, 1:2] * b
    distance = c - (origin[:, :1] * a + origin[:, 1:2] * b)
    with np.errstate(divide='ignore', invalid='ignore', over='ignore'):
        crossing = distance / rate
    ahead = (crossing > 0.0) & (crossing < max_range)
    crossing = np.where(ahead, crossing, max_range)
    last = np.full((len(origin), 1), max_range)
    return np.sort(np.concatenate([crossing, last], axis=1), axis=1)
