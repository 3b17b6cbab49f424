"""Loops of `gp_ground_seg.core.pipeline.ground_plane` for compiled code."""

from __future__ import annotations

import numpy as np

from gp_ground_seg.core.frame import Candidates, FloatArray
from gp_ground_seg.core.jit import compiled_form, jit
from gp_ground_seg.core.pipeline import ground_plane
from gp_ground_seg.core.pipeline.ground_plane import (
    MAX_Z,
    N_RINGS,
    N_SECTORS,
    RING_EDGES,
    GroundPlane,
    LowestPoints,
    Moments,
    Plane,
    gain,
    segment_directions,
    tolerance_at,
    tukey_weight,
)
from gp_ground_seg.core.pipeline.tilt import Direction

WIDTH = 32
"""The number of points ends at a multiple of it, so that no loop over them has a remainder."""
N_LARGEST = -(-N_SECTORS * N_RINGS // WIDTH) * WIDTH
_OUT_OF_REACH = 1e6

# Ring at the start of each stretch of range, a little early because of rounding: a range in the
# stretch lies in that ring or the next, as the narrowest ring is four stretches wide.
_PER_METRE = 4.0 / float(RING_EDGES[1] - RING_EDGES[0])
_STARTS = RING_EDGES[0] + (np.arange(int(RING_EDGES[-1] * _PER_METRE) + 1) - 0.02) / _PER_METRE
_RING_TABLE = np.clip(np.searchsorted(RING_EDGES, _STARTS, side='right') - 1, 0, N_RINGS - 1)

_fit_cells = jit(entry=True)(ground_plane.fit_cells)


def fit_plane(candidates: Candidates, max_slope: float, origin: Direction) -> GroundPlane | None:
    """Do what `gp_ground_seg.core.pipeline.ground_plane.fit_plane` does, to rounding."""
    directions = segment_directions(len(candidates.offsets) - 1)
    columns, sectors = np.empty((6, N_LARGEST)), np.empty(N_LARGEST, dtype=np.int64)
    x, y, z, r, tolerance, inverse = columns
    cells = LowestPoints(x, y, z, r, tolerance, inverse, sectors)
    n = _tabulate(candidates, directions, cells)
    cells = LowestPoints._make(column[: -(-n // WIDTH) * WIDTH] for column in cells)
    numbers = _fit_cells(cells, n, max_slope, origin)
    return GroundPlane(*numbers) if numbers[-1] > 0 else None


@jit(entry=True)
def _tabulate(candidates: Candidates, directions: FloatArray, cells: LowestPoints) -> int:
    """Set the lowest points, and those behind them to count for nothing; return their number."""
    offsets, r, z = candidates.offsets, candidates.r, candidates.z
    n_segments = len(offsets) - 1
    lowest, cell_of = np.empty(N_SECTORS * N_RINGS), np.empty(len(r), dtype=np.int16)
    index, home = np.empty(len(lowest), dtype=np.int64), np.empty(len(lowest), dtype=np.int64)
    for cell in range(len(lowest)):
        lowest[cell], index[cell], home[cell] = MAX_Z, -1, 0
    # Heights first, without a branch: which of two points is lower is unpredictable.
    for m in range(n_segments):
        first = (m * N_SECTORS // n_segments) * N_RINGS
        for c in range(offsets[m], offsets[m + 1]):
            cell_of[c] = -1
            if RING_EDGES[0] <= r[c] < RING_EDGES[N_RINGS] and abs(z[c]) < MAX_Z:
                ring = _RING_TABLE[int((r[c] - RING_EDGES[0]) * _PER_METRE)]
                cell = first + ring + (1 if r[c] >= RING_EDGES[ring + 1] else 0)
                lowest[cell] = z[c] if z[c] < lowest[cell] else lowest[cell]
                cell_of[c] = cell
    for m in range(n_segments):
        for c in range(offsets[m], offsets[m + 1]):
            cell = cell_of[c]
            is_lowest = cell >= 0 and z[c] == lowest[cell]
            if is_lowest and (index[cell] < 0 or r[c] < r[index[cell]]):
                index[cell], home[cell] = c, m
    n = 0
    for cell in range(len(lowest)):
        if index[cell] >= 0:
            range_, m = r[index[cell]], home[cell]
            cells.x[n], cells.y[n] = range_ * directions[0, m], range_ * directions[1, m]
            cells.z[n], cells.r[n] = lowest[cell], range_
            cells.tolerance[n] = tolerance_at(range_)
            cells.inverse[n] = 1.0 / cells.tolerance[n]
            cells.sector[n] = cell // N_RINGS
            n += 1
    for c in range(n, -(-n // WIDTH) * WIDTH):
        cells.x[c], cells.y[c], cells.z[c], cells.inverse[c] = 0.0, 0.0, _OUT_OF_REACH, 1.0
    return n


@compiled_form(ground_plane.scores_of)
def scores_of(planes: FloatArray, cells: LowestPoints) -> FloatArray:
    """Support less penalty of planes (P, 3), (P,)."""
    scores = np.empty(len(planes))
    for p in range(len(planes)):
        scores[p] = _score_of((planes[p, 0], planes[p, 1], planes[p, 2]), cells)
    return scores


@jit(fastmath=True)
def _score_of(plane: Plane, cells: LowestPoints) -> float:
    """Support less penalty of a plane; a loop that adds in any order."""
    x, y, z, inverse = cells.x, cells.y, cells.z, cells.inverse
    total = 0.0
    for c in range(len(x)):
        total += gain(x[c], y[c], z[c], inverse[c], plane)
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


@compiled_form(ground_plane.ranked)
def ranked(values: FloatArray, rank: int) -> float:
    """Value at `rank` in sorted order, by Hoare's selection, which reorders the values."""
    low, high = 0, len(values) - 1
    while low < high:
        pivot, i, j = values[rank], low, high
        while i <= j:
            while values[i] < pivot:
                i += 1
            while pivot < values[j]:
                j -= 1
            if i <= j:
                values[i], values[j] = values[j], values[i]
                i, j = i + 1, j - 1
        if j < rank:
            low = i
        if rank < i:
            high = j
    value: float = values[rank]
    return value
