"""Compiled twin of `gp_ground_seg.core.pipeline.terrain`."""

import math
from typing import NamedTuple

import numpy as np

from gp_ground_seg.core.frame import BoolArray, Candidates, Faces, FloatArray, IntArray
from gp_ground_seg.core.jit import jit
from gp_ground_seg.core.parameters.config import GrowthConfig
from gp_ground_seg.core.pipeline import terrain as plain


class _Walk(NamedTuple):
    """What the steps taken so far lead to."""

    parent: IntArray  # (C,) a tree for each group of candidates that steps join
    is_raised: BoolArray  # (C,) allowed candidates that are raised
    part: IntArray  # (C,) as `parent`, by steps between raised candidates alone
    even: IntArray  # (C,) as `parent`, by even steps
    is_entry: BoolArray  # (C,) raised candidates that a step from one that is not leads to
    is_fallen: BoolArray  # (C,) candidates that a fall leads to


@jit()
def reachable(
    candidates: Candidates, faces: Faces, height: float, growth: GrowthConfig, stands: BoolArray
) -> BoolArray:
    """See the plain `reachable`, of which the second result is `stands`, to be set."""
    r, n = candidates.r, len(candidates.r)
    parent, part, even = np.arange(n), np.arange(n), np.arange(n)
    allowed, is_steep = np.empty(n, np.bool_), np.empty(n, np.bool_)
    marks, is_seed, is_own = np.zeros((3, n), np.bool_), allowed.copy(), allowed.copy()
    walk = _Walk(parent, marks[0], part, even, marks[1], marks[2])
    for c in range(n):
        tile = np.uintp(candidates.tile[c])
        allowed[c] = r[c] < plain.REACH and not faces.is_face[tile]
        is_steep[c] = faces.is_steep[tile]
        walk.is_raised[c] = allowed[c] and candidates.z[c] + height > plain.RAISED
    steep, down = _step_along(candidates, allowed, is_steep, walk)
    for aside in range(1, plain.N_ASIDE + 1):
        _step_aside(candidates, allowed, is_steep, aside, walk)
    _step_in_front(candidates, steep, walk)
    _step_in_front(candidates, down, walk)
    is_terrain = allowed.copy()
    _leave_out_not_entered(candidates, walk, is_terrain, stands)
    for c in range(n):
        walk.is_fallen[c] &= is_terrain[c] and is_terrain[c - 1]
        if walk.is_fallen[c]:
            _join(parent, c - 1, c)
        over = candidates.z[c] + height
        is_seed[c] = allowed[c] and r[c] < growth.seed_range
        is_seed[c] &= abs(over) < growth.seed_height_tolerance
        is_own[c] = allowed[c] and over < plain.OWN
    result: BoolArray = is_terrain & _reached(parent, is_seed)
    is_even = _reached(even, is_own)
    for m in range(len(candidates.offsets) - 1):
        sees_own = False
        for c in range(candidates.offsets[m], candidates.offsets[m + 1]):
            sees_own |= is_own[c]
            if not (sees_own or is_even[c]):
                stands[c] |= plain.hides(r[c], candidates.z[c] + height, result[c], growth)
    return result


@jit()
def _reached(parent: IntArray, is_seed: BoolArray) -> BoolArray:
    """See the plain `_reached`; each candidate becomes the child of its root."""
    n_seeds = np.zeros(len(parent), np.int64)
    for c in range(len(parent)):
        parent[c] = _root(parent, c)
        n_seeds[parent[c]] += is_seed[c]
    result: BoolArray = n_seeds[parent] >= plain.MIN_SEEDS
    return result


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
def _leave_out_not_entered(
    candidates: Candidates, walk: _Walk, is_terrain: BoolArray, stands: BoolArray
) -> None:
    """See the plain `_entered`. A part of raised terrain is reached as a whole, or not at all."""
    r, offsets, is_before = candidates.r, candidates.offsets, np.zeros(len(is_terrain), np.bool_)
    for m in range(len(offsets) - 1):
        sees_lower = False
        for c in range(offsets[m + 1] - 1, offsets[m] - 1, -1):
            is_near = c > offsets[m] and r[c] - r[c - 1] <= plain.largest_gap(r[c])
            is_foot = is_near and _root(walk.part, c) != _root(walk.part, c - 1)
            is_before[c] = sees_lower and walk.is_raised[c] and is_foot
            sees_lower |= is_terrain[c] and not walk.is_raised[c]
    entry = _widths(candidates, walk.part, walk.is_entry)
    before = _widths(candidates, walk.part, is_before)
    for c in range(len(is_terrain)):
        if walk.is_raised[c]:
            part = _root(walk.part, c)
            is_terrain[c] = entry[part] >= plain.MIN_ENTRY
            stands[c] = plain.has_few_entries(entry[part], before[part])


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
                    width[root] += plain.arc_of(r[c], len(offsets) - 1)
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
            over_steep = is_steep[c - 1] or is_steep[c]
            is_taken = False
            if dr <= plain.largest_gap(r[c]):
                if plain.can_step(dr, rise, plain.EVEN):
                    _join(walk.even, c - 1, c)
                if plain.can_step(dr, rise, plain.gentle(over_steep)):
                    _step(walk, c - 1, c)
                    continue
                is_taken = plain.can_step(dr, rise, plain.STEEP)
            if not is_taken and dr <= plain.longest_gap(r[c]):
                is_taken = _goes_on(candidates, offsets[m], c)
            walk.is_fallen[c] = not is_taken and plain.falls(dr, rise)
            is_end[c] = is_taken and not over_steep
            is_end_down[c] = walk.is_fallen[c] or (is_end[c] and rise < 0.0)
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
    return bool(plain.goes_on((z[c] - z[c - 1]) / dr, slope_before))


@jit()
def _step_in_front(candidates: Candidates, steep: IntArray, walk: _Walk) -> None:
    """Take the steep and long steps in a front; `steep` (S,) are their far ends, in order.

    Falls that are not in one are none.
    """
    offsets, n_segments = candidates.offsets, len(candidates.offsets) - 1
    starts = np.searchsorted(steep, offsets)
    segment = np.searchsorted(offsets, steep, side='right') - 1
    front = np.arange(len(steep))
    for aside in range(1, plain.N_ASIDE + 1):
        for k in range(len(steep)):
            beside = (segment[k] + aside) % n_segments
            gap = plain.OBLIQUE * aside * plain.arc_of(candidates.r[steep[k] - 1], n_segments)
            _join_front(candidates, steep, k, gap, starts[beside : beside + 2], front)
    width, newest = np.zeros(len(steep)), np.full(len(steep), -1)
    for k in range(len(steep)):
        front[k] = _root(front, k)
        if newest[front[k]] != segment[k]:
            newest[front[k]] = segment[k]
            width[front[k]] += plain.arc_of(candidates.r[steep[k] - 1], n_segments)
    for k in range(len(steep)):
        is_wide = width[front[k]] >= plain.MIN_WIDTH
        if walk.is_fallen[steep[k]]:
            walk.is_fallen[steep[k]] = is_wide
        elif is_wide:
            _step(walk, steep[k] - 1, steep[k])


@jit()
def _join_front(
    candidates: Candidates, steep: IntArray, k: int, gap: float, bounds: IntArray, front: IntArray
) -> None:
    """Join step `k` with those within `bounds` that are side by side, to within `gap` [m]."""
    r, z, near, far = candidates.r, candidates.z, steep[k] - 1, steep[k]
    first, stop = bounds
    while first < stop and r[steep[first]] < r[near] - gap:
        first += 1
    while first < stop and r[steep[first] - 1] <= r[far] + gap:
        a, b = steep[first] - 1, steep[first]
        overlaps = min(z[a], z[b]) <= max(z[near], z[far])
        if overlaps and min(z[near], z[far]) <= max(z[a], z[b]):
            _join(front, k, first)
        first += 1


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
            across, gap = aside * plain.arc_of(r[c], n_segments), 0.5 * plain.largest_gap(r[c])
            for there in range(max(behind - 1, first), min(behind + 1, stop)):
                dr = abs(r[there] - r[c])
                # Most are joined already; of raised ones it also matters what leads to them.
                is_done = walk.parent[c] == walk.parent[there]
                is_done &= walk.even[c] == walk.even[there]
                if is_done and not (walk.is_raised[c] or walk.is_raised[there]):
                    continue
                if allowed[there] and dr <= gap:
                    distance = math.sqrt(dr * dr + across * across)
                    rise = z[there] - z[c]
                    if plain.can_step(distance, rise, plain.EVEN):
                        _join(walk.even, c, there)
                    over_steep = is_steep[c] or is_steep[there]
                    if plain.can_step(distance, rise, plain.gentle(over_steep)):
                        _step(walk, c, there)


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
