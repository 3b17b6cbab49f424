"""Stage 4: which candidates are terrain: those that can be reached on foot from near the sensor.

Steps lead along the segments and from one to the next. A bank is reached all along its foot, a car
hardly, and what stands on the ground by few steps or by none.
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
    Values,
)
from gp_ground_seg.core.jit import choose, shared
from gp_ground_seg.core.parameters.config import GrowthConfig

REACH = 60.0
"""Range up to which terrain is looked for [m]."""
GAP, GAP_GROWTH = 1.0, 0.12
"""Longest step along a segment next to the sensor [m], and its growth with range [m/m]; half as
long between segments."""
MAX_SLOPE, STEP_TOLERANCE = 0.84, 0.06
"""Steepest step, of 40 degrees, and what it may rise beyond that by roughness and noise [m]."""
GENTLE, STEEP, MIN_WIDTH = 0.3, 0.8, 6.0
"""Largest rise or fall of any step [m]; that of a step along a segment, if neighbouring segments
have such a step too, over this width: more than the length of a car [m]. Such a front may also go
down by any height, see `falls`: no object is lower than the ground that it stands on. It may go on
with the slope before it by any height too: few beams see a hillside in high steps."""
LONG_GROWTH, MIN_SLOPE, SAME_SLOPE = 0.4, 0.06, 0.08
"""Growth with range of the longest step along a segment that goes on with the slope of the terrain
before it [m/m], in such a front too; least slope of one, and difference to that before."""
N_ASIDE, OBLIQUE = 2, 2.0
"""Segments on each side that a step may lead to; how oblique a front may be: difference in range
of steps side by side, by the distance of their segments."""
MIN_SEEDS = 8
"""Candidates near the sensor, at the expected height, from which others can be reached."""
RAISED, MIN_ENTRY, MANY_TIMES = 0.3, 1.5, 3.0
"""Height from which terrain is raised [m]; width over which steps must lead up to it [m], as few
lead to a car. A raised part that fewer lead to is an object, if it is seen so wide before lower
ground, and so many times as wide as steps lead to it: with 1 parts of mounds and terraces are.
Most beds and boxes have no such steps."""
EVEN, OWN, HIDES, BLIND = 0.12, 0.11, 0.22, 5.0
"""Largest rise of an even step; height up to which the own level is seen, and that from which what
is nearer than that, within this range, hides it unless even steps lead there [m]."""
SQUARE = 2.0
"""Side of the squares that the relief of the terrain is in [m]."""
MIN_FALL = math.sqrt(2.0) * SQUARE
"""Least distance between the two sides of a fall [m]: no square has terrain of both."""


def reachable(
    candidates: Candidates, faces: Faces, height: float, growth: GrowthConfig
) -> tuple[BoolArray, BoolArray]:
    """Which of the candidates can be reached from enough seeds near the sensor, on foot.

    Vertical faces are no terrain. Gentle steps are taken anywhere, steep and long ones only in a
    front, side by side with others, as few lead to a car, and none over returns as steep as a face
    (`Faces.is_steep`). A front may mix falls and steps down. A fall is taken only between terrain:
    what is seen over a hedge is below its top. The plane near the sensor is `height` [m] below the
    origin.

    Returns those, and those that stand on the ground, see `_entered`, two (C,).
    """
    candidates = candidates._replace(z=candidates.z + height)
    allowed = ~faces.is_face[candidates.tile] & (candidates.r < REACH)
    is_seed = allowed & (candidates.r < growth.seed_range)
    is_seed &= np.abs(candidates.z) < growth.seed_height_tolerance
    steps, is_steep = _steps(candidates, allowed), faces.is_steep[candidates.tile]
    first, second, is_fall = steps.first, steps.second, steps.is_fall
    rise, is_near = candidates.z[second] - candidates.z[first], ~steps.is_long & ~is_fall
    is_along = candidates.segment[second] == candidates.segment[first]
    over_steep = is_steep[first] | is_steep[second]
    taken, is_even, can_be = (
        is_near & can_step(steps.length, rise, most) for most in (gentle(over_steep), EVEN, STEEP)
    )
    is_steep_step = ~(taken | over_steep) & (steps.is_long | (can_be & is_along))
    for wanted in (is_steep_step, is_fall | (is_steep_step & (rise < 0.0))):
        taken[wanted] |= _in_front(candidates, first[wanted])
    is_terrain, stands = _entered(candidates, allowed, steps, taken & ~is_fall)
    taken &= ~is_fall | (is_terrain[first] & is_terrain[second])
    is_reached = is_terrain & _reached(is_seed, first[taken], second[taken])
    is_own = allowed & (candidates.z < OWN)
    number = np.append(0, np.cumsum(is_own))
    sees_own = number[1:] > number[candidates.offsets[candidates.segment]]
    leads = sees_own | _reached(is_own, first[is_even], second[is_even])
    stands |= ~leads & hides(candidates.r, candidates.z, is_reached, growth)
    return is_reached, stands


def _reached(is_seed: BoolArray, first: IntArray, second: IntArray) -> BoolArray:
    """Candidates that steps lead to from enough seeds, (C,)."""
    group = _groups(len(is_seed), first, second)
    result: BoolArray = (np.bincount(group[is_seed], minlength=len(group)) >= MIN_SEEDS)[group]
    return result


def _entered(
    candidates: Candidates, allowed: BoolArray, steps: _Steps, taken: BoolArray
) -> tuple[BoolArray, BoolArray]:
    """Candidates that may be terrain, and those that stand on the ground, two (C,).

    Steps (S,) may be `taken`. A hillside is entered all along its foot, a car, if at all, where
    the step to a sill or a bonnet happens to be gentle. Raised candidates that few steps lead up
    to are no terrain. They stand on the ground if it is seen behind them, over a greater width:
    what is behind a wall, up to where nothing is seen, may be the upper one of two levels.
    """
    first, second = steps.first, steps.second
    is_raised, n_segments = allowed & (candidates.z > RAISED), len(candidates.offsets) - 1
    both = is_raised[first] & is_raised[second] & taken
    part = _groups(len(allowed), first[both], second[both])

    def width_of(entries: IntArray) -> FloatArray:
        entries = np.unique(entries)
        # A segment with several entries counts once, by the nearest.
        key = part[entries] * n_segments + candidates.segment[entries]
        nearest = entries[np.unique(key, return_index=True)[1]]
        width = np.zeros(len(allowed))
        np.add.at(width, part[nearest], arc_of(candidates.r[nearest], n_segments))
        return width[part]

    upper = np.where(is_raised[first], first, second)
    entry = width_of(upper[taken & (is_raised[first] != is_raised[second])])
    low, last = np.flatnonzero(allowed & ~is_raised), np.full(n_segments, -1)
    last[candidates.segment[low]] = low
    before = np.flatnonzero(is_raised & (np.arange(len(allowed)) < last[candidates.segment]))
    # Where nothing is seen just before them, no step can lead there.
    before = before[before > 0]
    is_near = candidates.r[before] - candidates.r[before - 1] <= largest_gap(candidates.r[before])
    is_near &= candidates.segment[before] == candidates.segment[before - 1]
    feet = before[is_near & (part[before] != part[before - 1])]
    stands = is_raised & has_few_entries(entry, width_of(feet))
    return allowed & (~is_raised | (entry >= MIN_ENTRY)), stands


def _in_front(candidates: Candidates, near: IntArray) -> BoolArray:
    """Which steep steps, from the candidates `near` (S,) to the next, are in a front, (S,).

    Two steps are side by side if they are in segments at most `N_ASIDE` apart, and overlap in
    height and, to within `OBLIQUE` times the distance of the segments, in range.
    """
    n_segments, segment = len(candidates.offsets) - 1, candidates.segment[near]
    r, z = candidates.r, candidates.z
    begin, end = r[near], r[near + 1]
    low, high = np.minimum(z[near], z[near + 1]), np.maximum(z[near], z[near + 1])
    apart, n, pairs = 2.0 * float(r.max(initial=0.0)) + 1.0, len(near), []
    for aside in range(1, N_ASIDE + 1):
        beside = (segment + aside) % n_segments * apart
        gap = OBLIQUE * aside * arc_of(begin, n_segments)
        nearest, farthest = np.maximum(begin - gap, 0.0), np.minimum(end + gap, 0.5 * apart)
        first = np.searchsorted(segment * apart + end, beside + nearest)
        stop = np.searchsorted(segment * apart + begin, beside + farthest, side='right')
        number = stop - first
        one = np.repeat(np.arange(n), number)
        other = np.arange(len(one)) + (stop - np.cumsum(number))[one]
        overlaps = (low[other] <= high[one]) & (low[one] <= high[other])
        pairs.append(np.stack([one, other])[:, overlaps])
    front = _groups(n, *np.concatenate(pairs, axis=1))
    # A segment with several steps counts once, by the nearest.
    once = np.unique(front * n_segments + segment, return_index=True)[1]
    width = np.bincount(front[once], arc_of(begin[once], n_segments))
    result: BoolArray = (width >= MIN_WIDTH)[front]
    return result


def _groups(n: int, first: IntArray, second: IntArray) -> IntArray:
    """Group of each of `n` members, (n,), of which those of a pair are in one group."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    graph = coo_array((np.ones(len(first), dtype=np.bool_), (first, second)), shape=(n, n))
    group: IntArray = connected_components(graph, directed=False)[1]
    return group


class _Steps(NamedTuple):
    """Steps between neighbours among the allowed candidates, which may be too steep."""

    first: IntArray  # (S,) candidates at the near end, and
    second: IntArray  # (S,) at the other one
    length: FloatArray  # (S,) m
    is_long: BoolArray  # (S,) longer or higher than others, and as steep as the terrain before it
    is_fall: BoolArray  # (S,) see `falls`


def _steps(candidates: Candidates, allowed: BoolArray) -> _Steps:
    """List the steps to the next candidate of a segment, and to those in the segments beside.

    These are the two next to it in range; there no step is long, and none a fall. The slope before
    a long step is that from the last candidate that is half of it before it.
    """
    r, z, segment = candidates.r, candidates.z, candidates.segment
    n_segments, n = len(candidates.offsets) - 1, len(r)
    apart = 2.0 * float(r.max(initial=0.0)) + 1.0  # of one segment's ranges and the next one's
    key = segment * apart + r
    dr, rise = np.diff(r), np.diff(z)
    before = np.searchsorted(key, key[:-1] - 0.5 * dr, side='right') - 1
    has_before = (before >= 0) & (segment[before] == segment[:-1])
    is_far = dr > largest_gap(r[1:])
    is_odd = is_far | ~can_step(dr, rise, STEEP)
    with np.errstate(divide='ignore', invalid='ignore'):
        slope_before = (z[:-1] - z[before]) / (r[:-1] - r[before])
        is_as_before = has_before & goes_on(rise / dr, slope_before)
    is_long = is_odd & (dr <= longest_gap(r[1:])) & is_as_before
    is_fall = is_odd & ~is_long & falls(dr, rise)
    is_step = allowed[1:] & allowed[:-1] & (~is_far | is_long | is_fall)
    along = np.flatnonzero(is_step & (segment[1:] == segment[:-1]))
    parts = [(along, along + 1, dr[along])]
    for aside in range(1, N_ASIDE + 1):
        beside = (segment + aside) % n_segments
        behind = np.searchsorted(key, beside * apart + r)
        across = aside * arc_of(r, n_segments)
        for there in (behind - 1, np.minimum(behind, n - 1)):
            dr = np.abs(r[there] - r)
            is_near = (segment[there] == beside) & (dr <= 0.5 * largest_gap(r))
            is_near &= allowed & allowed[there]
            length = np.sqrt(dr * dr + across * across)
            parts.append((np.flatnonzero(is_near), there[is_near], length[is_near]))
    first, second, length = map(np.concatenate, zip(*parts, strict=True))
    n_aside = len(first) - len(along)
    is_long, is_fall = (np.pad(kind[along], (0, n_aside)) for kind in (is_long, is_fall))
    return _Steps(first, second, length, is_long, is_fall)


@shared
def hides(r: Values, z: Values, is_reached: Values, growth: GrowthConfig) -> Values:
    """Whether a candidate, `z` over the own level [m], stands if no even steps lead to it.

    Of those that are higher than seeds only if it is no terrain either.
    """
    is_low = z < growth.seed_height_tolerance
    return (r > GAP) & (r < BLIND) & (z > HIDES) & (is_low | ~is_reached)


@shared
def has_few_entries(entry: Values, before: Values) -> Values:
    """Whether raised candidates stand on the ground: steps lead up to them over a width `entry`.

    They are seen over the width `before` in front of lower ground [m].
    """
    return (entry < MIN_ENTRY) & (before >= np.maximum(MIN_ENTRY, MANY_TIMES * entry))


@shared
def largest_gap(r: Values) -> Values:
    """Longest step along a segment at a range [m]."""
    return GAP + GAP_GROWTH * r


@shared
def longest_gap(r: Values) -> Values:
    """Longest step that goes on with the slope of the terrain before it, at a range [m]."""
    return GAP + LONG_GROWTH * r


@shared
def goes_on(slope: Values, before: Values) -> Values:
    """Whether a step of this slope goes on with that before it."""
    is_slope = (np.abs(slope) >= MIN_SLOPE) & (np.abs(slope) <= MAX_SLOPE)
    return is_slope & (np.abs(slope - before) <= SAME_SLOPE)


@shared
def falls(distance: Values, rise: Values) -> Values:
    """Whether a step leads down over an edge: deeper than a steep one, and than level terrain."""
    is_deep = (rise < -STEEP) & (rise < -MIN_SLOPE * distance)
    return is_deep & (distance > MIN_FALL)


@shared
def arc_of(r: Values, n_segments: int) -> Values:
    """Width of a segment at a range [m]."""
    return 2.0 * math.pi / n_segments * r


@shared
def gentle(over_steep: Values) -> Values:
    """Largest rise or fall of a step that is taken without others side by side with it [m].

    Over returns that are too steep for terrain it rises or falls by noise alone.
    """
    return choose(over_steep, STEP_TOLERANCE, GENTLE)


@shared
def can_step(distance: Values, rise: Values, most: Values) -> Values:
    """Whether a step of this length and rise [m] is one on foot."""
    return np.abs(rise) <= np.minimum(MAX_SLOPE * distance + STEP_TOLERANCE, most)


def with_standing(faces: Faces, tile: CellArray, stands: BoolArray) -> Faces:
    """Faces, and tiles of which all candidates stand on the ground: they show none.

    `tile` and `stands` (C,) are of the candidates.
    """
    shows_none = np.zeros_like(faces.is_face)
    shows_none[tile[stands]] = True
    shows_none[tile[~stands]] = False
    return Faces(faces.is_face | shows_none, faces.has_occluded_base | shows_none, faces.is_steep)


@shared
def mark_beyond_edges(candidates: Candidates, height: float, least: float, faces: Faces) -> None:
    """Mark the tiles of what stands on lower terrain, behind the edge of the own level.

    The own level, `height` [m] below the origin, ends where no ground is seen before a candidate
    that is lower by `least` [m]. From there on a face has an occluded base, and what rays pass on
    both sides is on top of something, which is a face.
    """
    r, offsets, segment, beyond = candidates.r, candidates.offsets, 0, -1
    for c in np.flatnonzero(candidates.z < -height - least):
        while offsets[segment + 1] <= c:
            segment += 1
        is_first, tile = c == offsets[segment], candidates.tile[c]
        if beyond == segment or r[c] - (0.0 if is_first else r[c - 1]) > longest_gap(r[c]):
            is_top = is_passed(candidates, segment, c, -1) and is_passed(candidates, segment, c, 1)
            # An origin on the ground is not where the rays start.
            faces.is_face[tile] |= is_top and height > least
            faces.has_occluded_base[tile] = faces.is_face[tile]
            beyond = beyond if is_first else segment


@shared
def is_passed(candidates: Candidates, segment: int, c: np.intp, side: int) -> bool:
    """Whether a ray on one side, -1 or 1, passes candidate `c`, no higher, and goes on beyond it.

    That is one in another segment, within `MIN_WIDTH`.
    """
    r, z, offsets = candidates.r, candidates.z, candidates.offsets
    n_segments, beyond = len(offsets) - 1, r[c] + longest_gap(r[c])
    for aside in range(1, int(MIN_WIDTH / arc_of(r[c], n_segments)) + 1):
        beside = (segment + side * aside) % n_segments
        far = offsets[beside] + np.searchsorted(r[offsets[beside] : offsets[beside + 1]], beyond)
        if far < offsets[beside + 1] and z[far] * r[c] <= (z[c] + STEP_TOLERANCE) * r[far]:
            return True
    return False
