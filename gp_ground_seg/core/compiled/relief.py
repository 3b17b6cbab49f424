"""Compiled twin of `gp_ground_seg.core.pipeline.relief`.

Tables of squares have one more at each side, so that each square has eight around it.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from gp_ground_seg.core.frame import (
    BoolArray,
    Candidates,
    CellArray,
    Faces,
    FloatArray,
    IntArray,
    PointArray,
)
from gp_ground_seg.core.jit import jit
from gp_ground_seg.core.parameters.config import GrowthConfig
from gp_ground_seg.core.pipeline.relief import (
    FADED,
    MIN_ENTRY,
    MIN_SEEDS,
    MIN_WEIGHT,
    N_ASIDE,
    N_ROUNDS,
    N_SIDES,
    RAISED,
    REACH,
    STEEP,
    arc_of,
    can_step,
    faded,
    falls,
    from_first_middle,
    goes_on,
    height_in,
    height_of,
    is_gentle,
    largest_gap,
    least_width,
    longest_gap,
    middle_of,
    piece_of,
    plane_of,
    robust_weight,
    square_of,
)

_WIDTH = N_SIDES + 2
_N_SQUARES = _WIDTH * _WIDTH
_N_SUMS = 9


@jit(entry=True)
def find_relief(
    candidates: Candidates,
    faces: Faces,
    height: float,
    growth: GrowthConfig,
    pieces: FloatArray,
    z: FloatArray,
    stands: BoolArray,
) -> None:
    """Set the pieces of the relief, and heights of candidates over it; not where it is level.

    `stands` (C,) becomes true of what stands on the ground.
    """
    before, behind = reachable(candidates, faces, height, growth, stands)
    terrain, is_known = _fit_planes(candidates, before, height)
    below, is_known_below = terrain, np.zeros(_N_SQUARES, np.bool_)
    if behind.any():
        below, is_known_below = _fit_planes(candidates, behind, height)
    if max(np.abs(terrain).max(), np.abs(below).max()) <= FADED:
        return
    is_behind = np.zeros(_N_SQUARES, np.bool_)
    if is_known_below.any():
        is_behind = _behind_of(candidates, before, is_known, behind, is_known_below)
        _set_pieces(below, is_known_below, is_behind, pieces)
    _set_pieces(terrain, is_known, ~is_behind, pieces)
    for c in range(len(z)):
        u = from_first_middle(candidates.x[c], np.float64)
        v = from_first_middle(candidates.y[c], np.float64)
        z[c] = candidates.z[c] - height_in(pieces[np.uintp(u), np.uintp(v)], u, v)


@jit()
def _set_pieces(
    terrain: FloatArray, is_known: BoolArray, chosen: BoolArray, pieces: FloatArray
) -> None:
    """Set the `chosen` ones of the pieces by the terrain, and let it be known all over."""
    _fill(terrain, is_known)
    for k in range(_N_SQUARES):
        terrain[k] = faded(terrain[k])
    for i in range(N_SIDES - 1):
        for j in range(N_SIDES - 1):
            k = _place(i, j)
            if chosen[k]:
                corners = terrain[k], terrain[k + _WIDTH], terrain[k + 1], terrain[k + 1 + _WIDTH]
                pieces[i, j] = piece_of(*corners)


@jit()
def _behind_of(
    candidates: Candidates,
    before: BoolArray,
    is_known: BoolArray,
    behind: BoolArray,
    is_known_below: BoolArray,
) -> BoolArray:
    """Which pieces are of the terrain behind falls, (squares,). See the plain `_is_behind`."""
    share, is_seen = np.zeros(_N_SQUARES), np.zeros(_N_SQUARES, np.bool_)
    for c in range(len(before)):
        x, y = candidates.x[c], candidates.y[c]
        square = _place(int(square_of(x)), int(square_of(y)))
        u, v = from_first_middle(x, np.float64), from_first_middle(y, np.float64)
        piece = _place(int(u), int(v))
        if before[c] and is_known[square]:
            share[piece], is_seen[piece] = 1.0, True
        elif behind[c] and is_known_below[square]:
            is_seen[piece] = True
    # Of those without terrain, all that are as near to terrain before falls get a share of it.
    _fill(share, is_seen)
    result: BoolArray = is_seen & (share == 0.0)
    return result


@jit()
def find_places(
    x: PointArray, y: PointArray, u: PointArray, v: PointArray, piece: CellArray
) -> None:
    """Set `u`, `v` and the piece, counted over all, of places (P,) [m], in a loop of vectors."""
    n, number = np.int32(N_SIDES - 1), x.dtype.type
    for i in range(len(x)):
        u[i], v[i] = from_first_middle(x[i], number), from_first_middle(y[i], number)
        piece[i] = np.int32(u[i]) * n + np.int32(v[i])


@jit()
def _place(i: int, j: int) -> int:
    return (i + 1) * _WIDTH + j + 1


@jit()
def _fit_planes(
    candidates: Candidates, reached: BoolArray, height: float
) -> tuple[FloatArray, BoolArray]:
    """Heights of the terrain in all squares, 0 where unknown, and which are known.

    See the plain `fit_planes`.
    """
    x, y, z = candidates.x, candidates.y, candidates.z
    square, number = np.empty(len(x), np.int64), np.zeros(_N_SQUARES, np.int64)
    for c in range(len(x)):
        square[c] = _place(int(square_of(x[c])), int(square_of(y[c])))
        number[square[c]] += reached[c]
    weight, plane = np.empty(len(x)), np.zeros((_N_SQUARES, 5))
    for c in range(len(x)):
        weight[c] = 1.0 / number[square[c]] if reached[c] else 0.0
    terrain, is_known = np.zeros(_N_SQUARES), np.zeros(_N_SQUARES, np.bool_)
    for _ in range(N_ROUNDS):
        sums = _sums_around(x, y, z, height, weight, square)
        for k in range(_N_SQUARES):
            if number[k] > 0:
                plane[k] = plane_of(sums[k])
        for c in range(len(x)):
            if reached[c]:
                there = height_of(plane[square[c]], x[c], y[c])
                weight[c] = robust_weight(z[c] + height - there) / number[square[c]]
    for i in range(N_SIDES):
        for j in range(N_SIDES):
            k = _place(i, j)
            # Most squares have no terrain about them.
            if sums[k, 0] >= MIN_WEIGHT:
                plane[k] = plane_of(sums[k])
                is_known[k] = True
                terrain[k] = height_of(plane[k], middle_of(i), middle_of(j))
    return terrain, is_known


@jit()
def _sums_around(
    x: FloatArray,
    y: FloatArray,
    z: FloatArray,
    height: float,
    weight: FloatArray,
    square: IntArray,
) -> FloatArray:
    """Weighted sums of `plane_of` over each square and the eight around it, (squares, 9)."""
    own = np.zeros(_N_SQUARES * _N_SUMS)
    for c in range(len(x)):
        w, over, first = weight[c], z[c] + height, square[c] * _N_SUMS
        if w > 0.0:
            own[first] += w
            own[first + 1] += w * x[c]
            own[first + 2] += w * y[c]
            own[first + 3] += w * over
            own[first + 4] += w * (x[c] * x[c])
            own[first + 5] += w * (x[c] * y[c])
            own[first + 6] += w * (y[c] * y[c])
            own[first + 7] += w * (x[c] * over)
            own[first + 8] += w * (y[c] * over)
    # What stays arbitrary is that of squares at the border, which nothing needs.
    rows, around = np.empty(len(own)), np.empty(len(own))
    column, row = np.uintp(_WIDTH * _N_SUMS), np.uintp(_N_SUMS)
    for k in range(column, np.uintp(len(own)) - column):
        rows[k] = own[k - column] + own[k] + own[k + column]
    for k in range(column, np.uintp(len(own)) - column):
        around[k] = rows[k - row] + rows[k] + rows[k + row]
    return around.reshape(_N_SQUARES, _N_SUMS)


@jit()
def _fill(terrain: FloatArray, is_known: BoolArray) -> None:
    """See the plain `filled`; unknown heights are 0 before."""
    is_waiting, mean = np.zeros(_N_SQUARES, np.bool_), np.empty(_N_SQUARES)
    for i in range(N_SIDES):
        for j in range(N_SIDES):
            is_waiting[_place(i, j)] = not is_known[_place(i, j)]
    ring = np.flatnonzero(is_known)
    while len(ring) > 0:
        following, n = np.empty(_N_SQUARES, np.int64), 0
        for q in range(len(ring)):
            for step in range(-_WIDTH, _WIDTH + 1, _WIDTH):
                for k in range(ring[q] + step - 1, ring[q] + step + 2):
                    if is_waiting[k]:
                        is_waiting[k] = False
                        following[n] = k
                        n += 1
        ring = following[:n]
        for q in range(n):
            mean[q] = _mean_around(terrain, is_known, ring[q])
        for q in range(n):
            terrain[ring[q]], is_known[ring[q]] = mean[q], True


@jit()
def _mean_around(terrain: FloatArray, is_known: BoolArray, k: int) -> float:
    """Mean of the known heights in the eight squares around one."""
    number, total = 0, 0.0
    for here in range(k - 1, k + 2):
        near, far = here - _WIDTH, here + _WIDTH
        # Of one side to the other first, as in the plain `three_by_three`.
        total += (terrain[near] + terrain[here]) + terrain[far]
        for there in (near, here, far):
            number += is_known[there]
    mean: float = total / number
    return mean


# Which candidates are terrain.


class _Walk(NamedTuple):
    """What the steps taken so far lead to."""

    parent: IntArray  # (C,) a tree for each group of candidates that steps join
    is_raised: BoolArray  # (C,) allowed candidates that are raised
    part: IntArray  # (C,) as `parent`, by steps between raised candidates alone
    is_foot: BoolArray  # (C,) raised candidates, to which it is too steep from one that is not
    is_entry: BoolArray  # (C,) raised candidates that a step from one that is not leads to
    is_fallen: BoolArray  # (C,) candidates that a fall leads to


@jit()
def reachable(
    candidates: Candidates,
    faces: Faces,
    height: float,
    growth: GrowthConfig,
    stands: BoolArray,
) -> tuple[BoolArray, BoolArray]:
    """See the plain `reachable`, of which the third result is `stands`, to be set."""
    r, n = candidates.r, len(candidates.r)
    allowed, is_steep = np.empty(n, np.bool_), np.empty(n, np.bool_)
    marks = np.zeros((4, n), np.bool_)
    walk = _Walk(np.arange(n), marks[0], np.arange(n), marks[1], marks[2], marks[3])
    for c in range(n):
        tile = np.uintp(candidates.tile[c])
        allowed[c], is_steep[c] = r[c] < REACH and not faces.is_face[tile], faces.is_steep[tile]
        walk.is_raised[c] = allowed[c] and candidates.z[c] + height > RAISED
    steep, down = _step_along(candidates, allowed, is_steep, walk)
    for aside in range(1, N_ASIDE + 1):
        _step_aside(candidates, allowed, is_steep, aside, walk)
    _step_in_front(candidates, steep, is_steep, walk)
    _step_in_front(candidates, down, is_steep, walk)
    is_terrain = allowed.copy()
    _leave_out_not_entered(candidates, walk, is_terrain, stands)
    parent, n_seeds = walk.parent, np.zeros(n, np.int64)
    for c in range(n):
        walk.is_fallen[c] &= is_terrain[c] and is_terrain[c - 1]
        if walk.is_fallen[c]:
            _join(parent, c - 1, c)
    for c in range(n):
        parent[c] = _root(parent, c)
        is_near = allowed[c] and r[c] < growth.seed_range
        if is_near and abs(candidates.z[c] + height) < growth.seed_height_tolerance:
            n_seeds[parent[c]] += 1
    is_terrain &= n_seeds[parent] >= MIN_SEEDS
    return _sides_of(candidates, is_terrain, walk.is_fallen)


@jit()
def _sides_of(
    candidates: Candidates, reached: BoolArray, is_fallen: BoolArray
) -> tuple[BoolArray, BoolArray]:
    """Candidates that are `reached`: those before falls, and those behind and below one."""
    offsets, behind = candidates.offsets, np.zeros_like(reached)
    for m in range(len(offsets) - 1):
        edge = -np.inf
        for c in range(offsets[m], offsets[m + 1]):
            if is_fallen[c] and reached[c]:
                edge = candidates.z[c - 1]
            behind[c] = reached[c] and candidates.z[c] < edge - STEEP
    return reached & ~behind, behind


@jit()
def _step(walk: _Walk, a: int, b: int) -> None:
    """Take a step between two candidates."""
    _join(walk.parent, a, b)
    if walk.is_raised[a] and walk.is_raised[b]:
        _join(walk.part, a, b)
    elif walk.is_raised[a]:
        walk.is_entry[a] = True
    elif walk.is_raised[b]:
        walk.is_entry[b] = True


@jit()
def _mark_foot(walk: _Walk, a: int, b: int) -> None:
    """Mark the one of two candidates that is raised, if the other is not."""
    if walk.is_raised[a] != walk.is_raised[b]:
        walk.is_foot[a if walk.is_raised[a] else b] = True


@jit()
def _leave_out_not_entered(
    candidates: Candidates, walk: _Walk, is_terrain: BoolArray, stands: BoolArray
) -> None:
    """See the plain `_entered`. A part of raised terrain is reached as a whole, or not at all."""
    offsets, is_before = candidates.offsets, np.zeros(len(is_terrain), np.bool_)
    for m in range(len(offsets) - 1):
        sees_lower = False
        for c in range(offsets[m + 1] - 1, offsets[m] - 1, -1):
            is_before[c] = sees_lower and walk.is_raised[c]
            sees_lower |= is_terrain[c] and not walk.is_raised[c]
    entry = _widths(candidates, walk.part, walk.is_entry)
    foot = _widths(candidates, walk.part, walk.is_foot)
    before = _widths(candidates, walk.part, is_before)
    for c in range(len(is_terrain)):
        if walk.is_raised[c]:
            part = _root(walk.part, c)
            is_terrain[c] = entry[part] >= MIN_ENTRY
            has_foot = min(foot[part], before[part]) >= MIN_ENTRY
            stands[c] = has_foot and not is_terrain[c]


@jit()
def _widths(candidates: Candidates, part: IntArray, marked: BoolArray) -> FloatArray:
    """Width of the segments with a `marked` candidate, by the nearest one, at the root of a part.

    (C,), in m.
    """
    r, offsets = candidates.r, candidates.offsets
    width, last = np.zeros(len(r)), np.zeros(len(r), np.int64)
    for m in range(len(offsets) - 1):
        for c in range(offsets[m], offsets[m + 1]):
            if marked[c]:
                root = _root(part, c)
                # One more than the segment, as 0 is none.
                if last[root] != m + 1:
                    width[root] += arc_of(r[c], len(offsets) - 1)
                    last[root] = m + 1
    return width


@jit()
def _step_along(
    candidates: Candidates, allowed: BoolArray, is_steep: BoolArray, walk: _Walk
) -> tuple[IntArray, IntArray]:
    """Step between neighbours of a segment.

    Returns the far ends of the steep and long steps, and those of falls and of the steps among the
    others that lead down.
    """
    r, z, offsets = candidates.r, candidates.z, candidates.offsets
    is_end, is_end_down = np.zeros(len(r), np.bool_), np.zeros(len(r), np.bool_)
    for m in range(len(offsets) - 1):
        for c in range(offsets[m] + 1, offsets[m + 1]):
            dr, rise = r[c] - r[c - 1], z[c] - z[c - 1]
            if not (allowed[c] and allowed[c - 1]):
                continue
            if dr > largest_gap(r[c]):
                is_taken = dr <= longest_gap(r[c]) and _goes_on(candidates, offsets[m], c)
            else:
                over_steep, is_taken = is_steep[c - 1] or is_steep[c], can_step(dr, rise, STEEP)
                if is_taken and is_gentle(rise, over_steep):
                    _step(walk, c - 1, c)
                    continue
                is_sheer = over_steep or not can_step(dr, rise, math.inf)
                if is_sheer and (is_taken or not falls(dr, rise)):
                    _mark_foot(walk, c - 1, c)
            walk.is_fallen[c] = not is_taken and falls(dr, rise)
            is_end[c] = is_taken
            is_end_down[c] = walk.is_fallen[c] or (is_taken and rise < 0.0)
    return np.flatnonzero(is_end), np.flatnonzero(is_end_down)


@jit()
def _goes_on(candidates: Candidates, first: int, c: int) -> bool:
    """Whether the step to candidate `c`, in the segment from `first` on, goes on as before."""
    r, z, before = candidates.r, candidates.z, c - 1
    dr = r[c] - r[c - 1]
    while before >= first and r[before] > r[c - 1] - 0.5 * dr:
        before -= 1
    if before < first:
        return False
    slope_before = (z[c - 1] - z[before]) / (r[c - 1] - r[before])
    return bool(goes_on((z[c] - z[c - 1]) / dr, slope_before))


@jit()
def _step_in_front(
    candidates: Candidates, steep: IntArray, is_steep: BoolArray, walk: _Walk
) -> None:
    """Take the steep and long steps in a front; `steep` (S,) are their far ends, in order.

    Falls that are not in one are none.
    """
    offsets, n_segments = candidates.offsets, len(candidates.offsets) - 1
    starts = np.searchsorted(steep, offsets)
    segment = np.searchsorted(offsets, steep, side='right') - 1
    front = np.arange(len(steep))
    for aside in range(1, N_ASIDE + 1):
        for k in range(len(steep)):
            beside = (segment[k] + aside) % n_segments
            _join_front(candidates, steep, k, starts[beside], starts[beside + 1], front)
    width = np.zeros(len(steep))
    for k in range(len(steep)):
        front[k] = _root(front, k)
        width[front[k]] += arc_of(candidates.r[steep[k] - 1], n_segments)
    for k in range(len(steep)):
        over_steep = is_steep[steep[k] - 1] or is_steep[steep[k]]
        is_wide = width[front[k]] >= least_width(over_steep)
        if walk.is_fallen[steep[k]]:
            walk.is_fallen[steep[k]] = is_wide
        elif is_wide:
            _step(walk, steep[k] - 1, steep[k])


@jit()
def _join_front(
    candidates: Candidates, steep: IntArray, k: int, first: int, stop: int, front: IntArray
) -> None:
    """Join step `k` with those of `first` to `stop` that are side by side with it."""
    r, z, near, far = candidates.r, candidates.z, steep[k] - 1, steep[k]
    while first < stop and r[steep[first]] < r[near]:
        first += 1
    for other in range(first, min(first + 2, stop)):
        a, b = steep[other] - 1, steep[other]
        overlaps = min(z[a], z[b]) <= max(z[near], z[far])
        overlaps &= min(z[near], z[far]) <= max(z[a], z[b])
        if overlaps and r[a] <= r[far]:
            _join(front, k, other)


@jit()
def _step_aside(
    candidates: Candidates, allowed: BoolArray, is_steep: BoolArray, aside: int, walk: _Walk
) -> None:
    """Step from each candidate to the next ones in range of the segment so many further on."""
    r, z, offsets = candidates.r, candidates.z, candidates.offsets
    n_segments = len(offsets) - 1
    for m in range(n_segments):
        beside = (m + aside) % n_segments
        first, stop = offsets[beside], offsets[beside + 1]
        behind = first
        for c in range(offsets[m], offsets[m + 1]):
            while behind < stop and r[behind] < r[c]:
                behind += 1
            if not allowed[c]:
                continue
            across, gap = aside * arc_of(r[c], n_segments), 0.5 * largest_gap(r[c])
            for there in range(max(behind - 1, first), min(behind + 1, stop)):
                dr = abs(r[there] - r[c])
                # Most are joined already; of raised ones it also matters what leads to them.
                is_done = walk.parent[c] == walk.parent[there]
                if is_done and not (walk.is_raised[c] or walk.is_raised[there]):
                    continue
                if allowed[there] and dr <= gap:
                    distance = math.sqrt(dr * dr + across * across)
                    rise, over_steep = z[there] - z[c], is_steep[c] or is_steep[there]
                    can_be = can_step(distance, rise, math.inf)
                    if can_be and is_gentle(rise, over_steep):
                        _step(walk, c, there)
                    elif over_steep or not can_be:
                        _mark_foot(walk, c, there)


@jit()
def _root(parent: IntArray, c: int) -> int:
    while parent[c] != c:
        parent[c] = parent[parent[c]]
        c = parent[c]
    return c


@jit()
def _join(parent: IntArray, a: int, b: int) -> None:
    a, b = _root(parent, a), _root(parent, b)
    parent[max(a, b)] = min(a, b)
