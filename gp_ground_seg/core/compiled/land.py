"""Which candidates are land: compiled twin of `gp_ground_seg.core.pipeline.relief.reachable`."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from gp_ground_seg.core.frame import BoolArray, Candidates, IntArray
from gp_ground_seg.core.jit import jit
from gp_ground_seg.core.parameters.config import GrowthConfig
from gp_ground_seg.core.pipeline.relief import (
    GENTLE,
    MIN_ENTRY,
    MIN_SEEDS,
    MIN_WIDTH,
    N_ASIDE,
    RAISED,
    REACH,
    STEEP,
    arc_of,
    can_step,
    falls,
    goes_on,
    largest_gap,
    longest_gap,
)


class _Walk(NamedTuple):
    """What the steps taken so far lead to."""

    parent: IntArray  # (C,) a tree for each group of candidates that steps join
    is_raised: BoolArray  # (C,) candidates that are raised
    part: IntArray  # (C,) as `parent`, by steps between raised candidates alone
    is_entry: BoolArray  # (C,) raised candidates that a step from one that is not leads to
    is_fallen: BoolArray  # (C,) candidates that a fall leads to


@jit()
def reachable(
    candidates: Candidates, is_face: BoolArray, height: float, growth: GrowthConfig
) -> tuple[BoolArray, BoolArray]:
    """See the plain `reachable`."""
    r, n = candidates.r, len(candidates.r)
    allowed, is_raised = np.empty(n, np.bool_), np.empty(n, np.bool_)
    for c in range(n):
        allowed[c] = r[c] < REACH and not is_face[np.uintp(candidates.tile[c])]
        is_raised[c] = candidates.z[c] + height > RAISED
    walk = _Walk(_trees(n), is_raised, _trees(n), np.zeros(n, np.bool_), np.zeros(n, np.bool_))
    steep, down = _step_along(candidates, allowed, walk)
    for aside in range(1, N_ASIDE + 1):
        _step_aside(candidates, allowed, aside, walk)
    _step_in_front(candidates, steep, walk)
    _step_in_front(candidates, down, walk)
    is_land = allowed.copy()
    _leave_out_not_entered(candidates, walk, is_land)
    parent, n_seeds = walk.parent, np.zeros(n, np.int64)
    for c in range(n):
        if walk.is_fallen[c] and is_land[c] and is_land[c - 1]:
            _join(parent, c - 1, c)
        else:
            walk.is_fallen[c] = False
    for c in range(n):
        parent[c] = _root(parent, c)
        is_near = allowed[c] and r[c] < growth.seed_range
        if is_near and abs(candidates.z[c] + height) < growth.seed_height_tolerance:
            n_seeds[parent[c]] += 1
    for c in range(n):
        is_land[c] &= n_seeds[parent[c]] >= MIN_SEEDS
    return _sides_of(candidates, is_land, walk.is_fallen)


@jit()
def _sides_of(
    candidates: Candidates, reached: BoolArray, is_fallen: BoolArray
) -> tuple[BoolArray, BoolArray]:
    """Candidates that are `reached`: those before falls, and those behind and below one."""
    offsets, before, behind = candidates.offsets, reached.copy(), np.zeros_like(reached)
    for m in range(len(offsets) - 1):
        edge = -np.inf
        for c in range(offsets[m], offsets[m + 1]):
            if is_fallen[c] and reached[c]:
                edge = candidates.z[c - 1]
            is_behind = candidates.z[c] < edge - STEEP
            before[c], behind[c] = reached[c] and not is_behind, reached[c] and is_behind
    return before, behind


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
def _leave_out_not_entered(candidates: Candidates, walk: _Walk, reached: BoolArray) -> None:
    """See the plain `_entered`. A part of raised land is reached as a whole, or not at all."""
    r, n, offsets = candidates.r, len(reached), candidates.offsets
    width, last = np.zeros(n), np.zeros(n, np.int64)
    for m in range(len(offsets) - 1):
        for c in range(offsets[m], offsets[m + 1]):
            if walk.is_entry[c]:
                part = _root(walk.part, c)
                # One more than the segment, as 0 is none.
                if last[part] != m + 1:
                    width[part] += arc_of(r[c], len(offsets) - 1)
                    last[part] = m + 1
    for c in range(n):
        reached[c] &= not walk.is_raised[c] or width[_root(walk.part, c)] >= MIN_ENTRY


@jit()
def _step_along(
    candidates: Candidates, allowed: BoolArray, walk: _Walk
) -> tuple[IntArray, IntArray]:
    """Step between neighbours of a segment.

    Returns the far ends of the steep and long steps, and those of falls and of the steps among the
    others that lead down.
    """
    r, z, offsets = candidates.r, candidates.z, candidates.offsets
    steep, n = np.empty(len(r), np.int64), 0
    down, n_down = np.empty(len(r), np.int64), 0
    for m in range(len(offsets) - 1):
        for c in range(offsets[m] + 1, offsets[m + 1]):
            dr, rise = r[c] - r[c - 1], z[c] - z[c - 1]
            if not (allowed[c] and allowed[c - 1]):
                continue
            if dr > largest_gap(r[c]):
                is_taken = dr <= longest_gap(r[c]) and _goes_on(candidates, offsets[m], c)
            else:
                is_taken = can_step(dr, rise, STEEP)
                if is_taken and abs(rise) <= GENTLE:
                    _step(walk, c - 1, c)
                    continue
            walk.is_fallen[c] = not is_taken and falls(dr, rise)
            if is_taken:
                steep[n] = c
                n += 1
            if walk.is_fallen[c] or (is_taken and rise < 0.0):
                down[n_down] = c
                n_down += 1
    return steep[:n], down[:n_down]


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
def _step_in_front(candidates: Candidates, steep: IntArray, walk: _Walk) -> None:
    """Take the steep and long steps in a front; `steep` (S,) are their far ends, in order.

    Falls that are not in one are none.
    """
    offsets, n_segments = candidates.offsets, len(candidates.offsets) - 1
    starts, segment = np.zeros(n_segments + 1, np.int64), np.empty(len(steep), np.int64)
    k = 0
    for m in range(n_segments):
        while k < len(steep) and steep[k] < offsets[m + 1]:
            segment[k] = m
            k += 1
        starts[m + 1] = k
    front = _trees(len(steep))
    for aside in range(1, N_ASIDE + 1):
        for k in range(len(steep)):
            beside = (segment[k] + aside) % n_segments
            _join_front(candidates, steep, k, starts[beside], starts[beside + 1], front)
    width = np.zeros(len(steep))
    for k in range(len(steep)):
        front[k] = _root(front, k)
        width[front[k]] += arc_of(candidates.r[steep[k] - 1], n_segments)
    for k in range(len(steep)):
        is_wide = width[front[k]] >= MIN_WIDTH
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
def _step_aside(candidates: Candidates, allowed: BoolArray, aside: int, walk: _Walk) -> None:
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
                    if can_step(distance, z[there] - z[c], GENTLE):
                        _step(walk, c, there)


@jit()
def _trees(n: int) -> IntArray:
    """Trees of one member each."""
    parent = np.empty(n, np.int64)
    for c in range(n):
        parent[c] = c
    return parent


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
