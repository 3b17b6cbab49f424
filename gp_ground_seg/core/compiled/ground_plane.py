"""Compiled twin of `gp_ground_seg.core.pipeline.ground_plane`."""

from __future__ import annotations

import math

import numpy as np

from gp_ground_seg.core.frame import Candidates, FloatArray, IntArray
from gp_ground_seg.core.jit import jit
from gp_ground_seg.core.pipeline import ground_plane
from gp_ground_seg.core.pipeline.ground_plane import (
    CLEARLY_BELOW,
    ENOUGH_NEAR,
    FAR,
    LOOSER,
    MAX_HEIGHT,
    MAX_Z,
    MIN_AREA,
    MIN_CELLS,
    MIN_HEIGHT,
    N_LEVEL,
    N_REFINEMENTS,
    N_RINGS,
    N_SECTORS,
    NEAR,
    PENALTY,
    RESOLUTION,
    RING_EDGES,
    SPREAD,
    TOLERANCE,
    TOLERANCE_GROWTH,
    GroundPlane,
    segment_directions,
)
from gp_ground_seg.core.pipeline.tilt import Direction

X, Y, Z, RANGE, ALLOWED, INVERSE = range(6)
"""Rows of the table of lowest points; `ALLOWED` is the tolerance, `INVERSE` one over it."""
WIDTH = 32
"""Rows of the table end at a multiple of it, so that no loop over points has a remainder."""
N_LARGEST = -(-N_SECTORS * N_RINGS // WIDTH) * WIDTH
_OUT_OF_REACH = 1e6

# Ring at the start of each stretch of range, a little early because of rounding: a range in the
# stretch lies in that ring or the next, as the narrowest ring is four stretches wide.
_PER_METRE = 4.0 / float(RING_EDGES[1] - RING_EDGES[0])
_STARTS = RING_EDGES[0] + (np.arange(int(RING_EDGES[-1] * _PER_METRE) + 1) - 0.02) / _PER_METRE
_RING_TABLE = np.clip(np.searchsorted(RING_EDGES, _STARTS, side='right') - 1, 0, N_RINGS - 1)

NumbersOfPlane = tuple[
    float, float, float, float, float, float, float, float, float, float, int, int
]


_solve_plane = jit()(ground_plane.solve_plane)


def fit_plane(candidates: Candidates, max_slope: float, origin: Direction) -> GroundPlane | None:
    """Do what `gp_ground_seg.core.pipeline.ground_plane.fit_plane` does, to rounding."""
    cells, sectors = np.empty((6, N_LARGEST)), np.empty(N_LARGEST, dtype=np.int64)
    directions = segment_directions(len(candidates.offsets) - 1)
    n = _tabulate(candidates, directions, cells, sectors)
    if n < MIN_CELLS:
        return None
    found, best = _best_hypothesis(cells, n, max_slope)
    if not found:
        return None
    values = _describe(cells, sectors, n, _refine(cells, n, max_slope, best), origin)
    return GroundPlane(*values) if values[-1] > 0 else None


@jit(entry=True)
def _tabulate(
    candidates: Candidates, directions: FloatArray, cells: FloatArray, sectors: IntArray
) -> int:
    """Put the lowest points into a table (6, N_LARGEST); return their number."""
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
            own_r, m = r[index[cell]], home[cell]
            cells[X, n], cells[Y, n] = own_r * directions[0, m], own_r * directions[1, m]
            cells[Z, n], cells[RANGE, n] = lowest[cell], own_r
            cells[ALLOWED, n] = TOLERANCE + TOLERANCE_GROWTH * own_r
            cells[INVERSE, n] = 1.0 / cells[ALLOWED, n]
            sectors[n] = cell // N_RINGS
            n += 1
    for c in range(n, -(-n // WIDTH) * WIDTH):
        cells[X, c], cells[Y, c], cells[Z, c], cells[INVERSE, c] = 0.0, 0.0, _OUT_OF_REACH, 1.0
    return n


@jit(entry=True)
def _best_hypothesis(
    cells: FloatArray, n: int, max_slope: float
) -> tuple[bool, tuple[float, float, float]]:
    """First of the planes with the best score, and whether there is one."""
    found, most, best = False, 0.0, (0.0, 0.0, 0.0)
    n_level = min(n, N_LEVEL)
    for t in range(n_level + len(SPREAD)):
        if t < n_level:
            height, slope_x, slope_y = -cells[Z, t * n // n_level], 0.0, 0.0
        else:
            s = t - n_level
            i, j, k = int(SPREAD[s, 0] * n), int(SPREAD[s, 1] * n), int(SPREAD[s, 2] * n)
            x1, y1, z1 = (
                cells[X, j] - cells[X, i], cells[Y, j] - cells[Y, i], cells[Z, j] - cells[Z, i]
            )  # fmt: skip
            x2, y2, z2 = (
                cells[X, k] - cells[X, i], cells[Y, k] - cells[Y, i], cells[Z, k] - cells[Z, i]
            )  # fmt: skip
            area = x1 * y2 - x2 * y1
            if not abs(area) > MIN_AREA:
                continue
            slope_x, slope_y = (z1 * y2 - z2 * y1) / area, (x1 * z2 - x2 * z1) / area
            height = slope_x * cells[X, i] + slope_y * cells[Y, i] - cells[Z, i]
        if not _is_possible(height, slope_x, slope_y, max_slope):
            continue
        score = _score(cells, -(-n // WIDTH) * WIDTH, height, slope_x, slope_y)
        if not found or score > most:
            found, most, best = True, score, (height, slope_x, slope_y)
    return found, best


@jit()
def _is_possible(height: float, slope_x: float, slope_y: float, max_slope: float) -> bool:
    steep = slope_x * slope_x + slope_y * slope_y > max_slope * max_slope
    return MIN_HEIGHT <= height <= MAX_HEIGHT and not steep


@jit(fastmath=True)
def _score(cells: FloatArray, n: int, height: float, slope_x: float, slope_y: float) -> float:
    """Support less penalty of a plane; of whole numbers, whose sum is exact in any order."""
    x, y, z, inverse = cells[X], cells[Y], cells[Z], cells[INVERSE]
    total = 0.0
    for c in range(n):
        total += _gain(x[c], y[c], z[c], inverse[c], height, slope_x, slope_y)
    return total


@jit()
def _gain(
    x: float, y: float, z: float, inverse: float, height: float, slope_x: float, slope_y: float
) -> float:
    """Score of one point; apart from `_score`, whose `fastmath` would change the rounding."""
    d = (z - (slope_x * x + slope_y * y - height)) * inverse
    gain = RESOLUTION * (1.0 - d * d)
    gain = gain if gain > 0.0 else 0.0
    whole: float = np.floor(-PENALTY * RESOLUTION if d < -CLEARLY_BELOW else gain)
    return whole


@jit(entry=True, fastmath=True)
def _refine(
    cells: FloatArray, n: int, max_slope: float, plane: tuple[float, float, float]
) -> tuple[float, float, float]:
    """Weighted least squares with Tukey's weights of the plane before, again and again."""
    xs, ys, zs, inverses = cells[X], cells[Y], cells[Z], cells[INVERSE]
    height, slope_x, slope_y = plane
    for _ in range(N_REFINEMENTS):
        w, wx, wy, wxx, wxy, wyy, wz, wxz, wyz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for c in range(-(-n // WIDTH) * WIDTH):
            x, y, z, inverse = xs[c], ys[c], zs[c], inverses[c]
            d = (z - (slope_x * x + slope_y * y - height)) * inverse
            root = 1.0 - 0.5 * d * d
            root = (root if root > 0.0 else 0.0) * inverse
            weight = root * root
            w += weight
            wx += weight * x
            wy += weight * y
            wxx += weight * x * x
            wxy += weight * x * y
            wyy += weight * y * y
            wz += weight * z
            wxz += weight * x * z
            wyz += weight * y * z
        height, slope_x, slope_y = _solve_plane(
            (w, wx, wy, wxx, wxy, wyy, wz, wxz, wyz), (height, slope_x, slope_y)
        )
    if not _is_possible(height, slope_x, slope_y, LOOSER * max_slope):
        return plane
    return height, slope_x, slope_y


@jit(entry=True)
def _describe(
    cells: FloatArray,
    sectors: IntArray,
    n: int,
    plane: tuple[float, float, float],
    origin: Direction,
) -> NumbersOfPlane:
    """Evidence for a plane: fields of the `GroundPlane`; cells come sector by sector."""
    height, slope_x, slope_y = plane
    ranges, drops, near = np.empty(n), np.empty(n), np.empty(n)
    n_on_it, n_near, squares = 0, 0, 0.0
    n_any, n_covered, n_far = 0, 0, 0
    last_any, last_covered, last_far = -1, -1, -1
    for c in range(n):
        # A sector that differs from the last one is new.
        sector, r = sectors[c], cells[RANGE, c]
        if sector != last_any:
            n_any, last_any = n_any + 1, sector
        distance = cells[Z, c] - (slope_x * cells[X, c] + slope_y * cells[Y, c] - height)
        if not abs(distance) <= cells[ALLOWED, c]:
            continue
        ranges[n_on_it] = r
        away = math.hypot(cells[X, c] - origin[0], cells[Y, c] - origin[1])
        drops[n_on_it] = math.atan2(origin[2] - cells[Z, c], away)
        n_on_it += 1
        squares += distance * distance
        if r < NEAR:
            near[n_near] = distance
            n_near += 1
        if sector != last_covered:
            n_covered, last_covered = n_covered + 1, sector
        if r >= FAR and sector != last_far:
            n_far, last_far = n_far + 1, sector
    if n_on_it == 0:
        return 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, n, 0
    few, most = n_on_it // 10, (9 * n_on_it) // 10
    steep = _ranked(drops[:n_on_it], most)
    lift = _ranked(near[:n_near], n_near // 2) if n_near >= ENOUGH_NEAR else 0.0
    return (
        height, slope_x, slope_y, height - lift, n_on_it / n, n_covered / N_SECTORS,
        n_far / n_any, _ranked(ranges[:n_on_it], most),
        steep - _ranked(drops[:n_on_it], few), math.sqrt(squares / n_on_it),
        n, n_on_it,
    )  # fmt: skip


@jit()
def _ranked(values: FloatArray, rank: int) -> float:
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
