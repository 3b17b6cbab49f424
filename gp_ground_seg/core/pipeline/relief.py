"""Stage 4: the relief of the terrain, over which lines and surfaces are found.

The surface of a segment is a function of range with a level prior. Along one segment the foot of
a bank is like that of a wall; in plan it is not, as a bank is wide and deep. So candidates that
can be reached on foot from the ground near the sensor are found first, in steps along segments and
between them. Planes through those in 3 by 3 squares, each fitted robustly, are the relief: it has
the height of banks and hills, and fades where the terrain is as high as the prior mean.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from gp_ground_seg.core.frame import (
    BoolArray,
    Candidates,
    CellArray,
    Faces,
    FloatArray,
    IntArray,
    PointArray,
    Values,
    as_index,
)
from gp_ground_seg.core.jit import choose, shared
from gp_ground_seg.core.parameters.config import Config

REACH = 60.0
"""Half the side of the relief, and range up to which it follows the terrain [m]; beyond, it is as
high as at its border."""
SIDE = 2.0
"""Side of a square [m]."""
N_SIDES = round(2.0 * REACH / SIDE)
"""Squares along a side of the relief."""

GAP, GAP_GROWTH = 1.0, 0.12
"""Longest step along a segment next to the sensor [m], and its growth with range [m/m]; half as
long between segments."""
MAX_SLOPE, STEP_TOLERANCE = 0.84, 0.06
"""Steepest step, of 40 degrees, and what it may rise beyond that by roughness and noise [m]."""
GENTLE, STEEP, MIN_WIDTH = 0.3, 0.8, 6.0
"""Largest rise or fall of any step [m]; that of a step along a segment, if neighbouring segments
have such a step too, over this width: more than the length of a car [m]. Such a front may also go
down by any height, see `falls`: no object is lower than the ground that it stands on."""
LONG_GROWTH, MIN_SLOPE, SAME_SLOPE = 0.4, 0.06, 0.08
"""Growth with range of the longest step along a segment that goes on with the slope of the terrain
before it [m/m], in such a front too; least slope of one, and difference to that before."""
N_ASIDE = 2
"""Segments on each side that a step may lead to."""
MIN_SEEDS = 8
"""Candidates near the sensor, at the expected height, from which others can be reached."""

N_ROUNDS = 3
"""Fits of the planes, each weighted by the residuals of the one before."""
ROBUST_SCALE = 0.15
"""Residual at which a candidate counts half [m]."""
RIDGE = 0.5
"""Variance that is added to those of x and y [m^2]: planes through few places are more level."""
MIN_WEIGHT = 1.5
"""Least weight of a plane, where a square with candidates counts one."""
RAISED, MIN_ENTRY = 0.3, 1.5
"""Height from which terrain is raised [m]; width over which steps must lead up to it [m], as few
lead to a car. A raised part that fewer lead to is an object, if its foot is seen so wide."""
FADED, FADE_WIDTH = 0.15, 0.3
"""Height of the terrain up to which the relief is level [m]; within this much more it grows to it
[m]."""


class Relief(NamedTuple):
    """Height of the terrain over the prior mean, in plan."""

    # (N_SIDES - 1, N_SIDES - 1, 4) pieces between the middles of four squares, see `piece_of`
    pieces: FloatArray

    @property
    def is_level(self) -> bool:
        """Whether the height is 0 everywhere."""
        return not self.pieces.any()

    @classmethod
    def level(cls) -> Relief:
        """Relief of level terrain."""
        return cls(np.zeros((N_SIDES - 1, N_SIDES - 1, 4)))

    @classmethod
    def of(cls, height: FloatArray) -> Relief:
        """Relief by its height in the middle of each square, (N_SIDES, N_SIDES) [m]."""
        corners = height[:-1, :-1], height[1:, :-1], height[:-1, 1:], height[1:, 1:]
        return cls(np.stack(piece_of(*corners), axis=-1))

    def at(self, x: PointArray, y: PointArray) -> PointArray:
        """Height at places (P,) that are finite, (P,) [m], in their precision."""
        u, v = (from_first_middle(place, x.dtype.type) for place in (x, y))
        # One index: with two it takes three times as long.
        place = u.astype(np.int64) * (N_SIDES - 1) + v.astype(np.int64)
        pieces = self.pieces.reshape(-1, 4).astype(x.dtype)
        result: PointArray = height_in(pieces.take(place, axis=0).T, u, v)
        return result

    def at_knots(self, knots: FloatArray, n_segments: int) -> PointArray:
        """Height at ranges `knots` (K,) in the middle of each segment, (M, K) [m]."""
        azimuth = 2.0 * np.pi * (np.arange(n_segments)[:, None] + 0.5) / n_segments - np.pi
        x, y = (knots * np.cos(azimuth)).ravel(), (knots * np.sin(azimuth)).ravel()
        return self.at(x, y).reshape(n_segments, len(knots))


def find_relief(
    candidates: Candidates, faces: Faces, height: float, config: Config
) -> tuple[Relief, Candidates, Faces]:
    """Relief over a plane `height` [m] below the origin, and the candidates over the relief.

    Vertical faces are no terrain. What is behind a fall has a relief of its own, so that the
    relief before it is flat up to the edge. The third is `faces` with what stands on the ground.
    """
    if not config.surface.look_aside:
        return Relief.level(), candidates, faces
    growth, over_plane = config.growth, candidates._replace(z=candidates.z + height)
    allowed = ~faces.is_face[candidates.tile] & (candidates.r < REACH)
    is_seed = allowed & (candidates.r < growth.seed_range)
    is_seed &= np.abs(over_plane.z) < growth.seed_height_tolerance
    is_steep = faces.is_steep[candidates.tile]
    *reached, stands = reachable(over_plane, allowed, is_steep, is_seed)
    faces = with_standing(faces, candidates.tile, stands)
    sides = [over_plane.where(side) for side in reached]
    terrains = [fit_planes(side.x, side.y, side.z) for side in sides if len(side.r)]
    if not any((np.abs(terrain[is_known]) > FADED).any() for terrain, is_known in terrains):
        return Relief.level(), candidates, faces
    relief = Relief.of(faded(filled(*terrains[0])))
    if len(terrains) == 2 and terrains[1][1].any():
        behind = Relief.of(faded(filled(*terrains[1])))
        is_behind = _is_behind(sides, terrains)[..., None]
        relief = Relief(np.where(is_behind, behind.pieces, relief.pieces))
    z = candidates.z - relief.at(candidates.x, candidates.y)
    return relief, candidates._replace(z=z), faces


def with_standing(faces: Faces, tile: CellArray, stands: BoolArray) -> Faces:
    """Faces, and tiles of which all candidates stand on the ground.

    `tile` and `stands` (C,) are of the candidates.
    """
    is_face = np.zeros_like(faces.is_face)
    is_face[tile[stands]] = True
    is_face[tile[~stands]] = False
    return faces._replace(is_face=faces.is_face | is_face)


def _is_behind(sides: list[Candidates], terrains: list[tuple[FloatArray, BoolArray]]) -> BoolArray:
    """Which pieces of the relief are nearer to terrain behind falls than to terrain before them.

    As a mask, (N_SIDES - 1, N_SIDES - 1). Pieces with terrain of both are of that before.
    """
    share = np.zeros((N_SIDES - 1, N_SIDES - 1))
    is_seen = np.zeros(share.shape, dtype=np.bool_)
    for is_before, side, (_, is_known) in zip((1.0, 0.0), sides, terrains, strict=True):
        known = is_known[as_index(square_of(side.x)), as_index(square_of(side.y))]
        u, v = (as_index(from_first_middle(p[known], np.float64)) for p in (side.x, side.y))
        share[u, v] += is_before
        is_seen[u, v] = True
    # Of those without terrain, all that are as near to terrain before falls get a share of it.
    result: BoolArray = is_seen.any() & (filled(share, is_seen) == 0.0)
    return result


def reachable(
    candidates: Candidates, allowed: BoolArray, is_steep: BoolArray, is_seed: BoolArray
) -> tuple[BoolArray, BoolArray, BoolArray]:
    """Which of the candidates can be reached from enough seeds in steps over `allowed` ones.

    Gentle steps are taken anywhere, steep and long ones only in a front, side by side with others:
    few lead to a car. Near returns that are steeper than terrain (`is_steep`, (C,)) no step is
    gentle. A front may mix falls and steps down. A fall is taken only between terrain: what is
    seen over a hedge is below its top. Heights of the candidates are over the plane near the
    sensor.

    Returns those before falls in their segment, those behind and below one, and those that stand
    on the ground, see `_entered`, three (C,): across a ditch the terrain is that before it.
    """
    steps = _steps(candidates, allowed)
    first, second, is_fall = steps.first, steps.second, steps.is_fall
    rise = candidates.z[second] - candidates.z[first]
    over_steep, is_near = is_steep[first] | is_steep[second], ~steps.is_long & ~is_fall
    can_be = is_near & can_step(steps.length, rise, math.inf)
    taken = can_be & is_gentle(rise, over_steep)
    is_sheer = is_near & ~taken & (over_steep | ~can_be)
    is_steep_step = steps.is_long | (can_be & (second == first + 1) & (np.abs(rise) <= STEEP))
    is_steep_step &= ~taken
    for wanted in (is_steep_step, is_fall | (is_steep_step & (rise < 0.0))):
        taken[wanted] |= _in_front(candidates, first[wanted], over_steep[wanted])
    is_terrain, stands = _entered(candidates, allowed, steps, taken & ~is_fall, is_sheer)
    taken &= ~is_fall | (is_terrain[first] & is_terrain[second])
    group = _groups(len(allowed), first[taken], second[taken])
    is_reached = (np.bincount(group[is_seed], minlength=len(group)) >= MIN_SEEDS)[group]
    is_fallen = np.zeros(len(allowed), dtype=np.bool_)
    is_fallen[second[taken & is_fall]] = True
    is_fallen &= is_reached
    number = np.cumsum(is_fallen)
    edge = np.append(0, np.flatnonzero(is_fallen))[number] - 1
    is_behind = number > np.append(0, number)[candidates.offsets][candidates.segment]
    is_behind &= candidates.z < candidates.z[edge] - STEEP
    is_reached &= is_terrain
    return is_reached & ~is_behind, is_reached & is_behind, stands


def _entered(
    candidates: Candidates,
    allowed: BoolArray,
    steps: _Steps,
    taken: BoolArray,
    is_sheer: BoolArray,
) -> tuple[BoolArray, BoolArray]:
    """Candidates that may be terrain, and those that stand on the ground, two (C,).

    Steps (S,) are `taken`, or too steep, `is_sheer`. A hillside is entered all along its foot, a
    car, if at all, where the step to a sill or a bonnet happens to be gentle. Raised candidates
    that few steps lead up to are no terrain. They stand on the ground if it is seen before them,
    where they are sheer, and behind them. What is behind a wall, up to where nothing is seen, may
    be the upper one of two levels.
    """
    first, second = steps.first, steps.second
    is_raised, n_segments = allowed & (candidates.z > RAISED), len(candidates.offsets) - 1
    both = is_raised[first] & is_raised[second] & taken
    part = _groups(len(allowed), first[both], second[both])

    def is_wide(entries: IntArray) -> BoolArray:
        entries = np.unique(entries)
        # A segment with several entries counts once, by the nearest.
        key = part[entries] * n_segments + candidates.segment[entries]
        nearest = entries[np.unique(key, return_index=True)[1]]
        arcs = arc_of(candidates.r[nearest], n_segments)
        result: BoolArray = np.bincount(part[nearest], arcs, len(allowed))[part] >= MIN_ENTRY
        return result

    upper = np.where(is_raised[first], first, second)
    leads_up = is_raised[first] != is_raised[second]
    is_entered = is_wide(upper[leads_up & taken])
    low, last = np.flatnonzero(allowed & ~is_raised), np.full(n_segments, -1)
    last[candidates.segment[low]] = low
    is_before_low = is_raised & (np.arange(len(allowed)) < last[candidates.segment])
    stands = is_raised & ~is_entered
    stands &= is_wide(upper[leads_up & is_sheer]) & is_wide(np.flatnonzero(is_before_low))
    return allowed & (~is_raised | is_entered), stands


def _in_front(candidates: Candidates, near: IntArray, over_steep: BoolArray) -> BoolArray:
    """Which steep steps, from the candidates `near` (S,) to the next, are in a front, (S,).

    Such a front is wider where they are `over_steep` (S,) returns, see `least_width`. Two steps
    are side by side if they are in segments at most `N_ASIDE` apart and overlap in range and in
    height: of a segment, the first that ends no nearer than the other begins, or the one behind
    it.
    """
    n_segments, segment = len(candidates.offsets) - 1, candidates.segment[near]
    r, z = candidates.r, candidates.z
    begin, end = r[near], r[near + 1]
    low, high = np.minimum(z[near], z[near + 1]), np.maximum(z[near], z[near + 1])
    apart = 2.0 * float(r.max(initial=0.0)) + 1.0
    key, n, pairs = segment * apart + end, len(near), []
    for aside in range(1, N_ASIDE + 1):
        beside = (segment + aside) % n_segments
        first = np.searchsorted(key, beside * apart + begin)
        for place in (first, first + 1):
            other = np.minimum(place, n - 1)
            is_beside = (place < n) & (segment[other] == beside) & (begin[other] <= end)
            is_beside &= (low[other] <= high) & (low <= high[other])
            pairs.append(np.stack([np.arange(n), other])[:, is_beside])
    front = _groups(n, *np.concatenate(pairs, axis=1))
    width = np.bincount(front, arc_of(begin, n_segments))
    result: BoolArray = width[front] >= least_width(over_steep)
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
    is_long: BoolArray  # (S,) longer than `largest_gap`, with the slope of the terrain before it
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
    is_far, can_be = dr > largest_gap(r[1:]), can_step(dr, rise, STEEP)
    with np.errstate(divide='ignore', invalid='ignore'):
        slope_before = (z[:-1] - z[before]) / (r[:-1] - r[before])
        is_long = has_before & (dr <= longest_gap(r[1:])) & goes_on(rise / dr, slope_before)
    is_long &= is_far
    is_fall = ~is_long & (is_far | ~can_be) & falls(dr, rise)
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
    """Whether a step leads down over an edge: deeper than a steep one, and than level terrain.

    What the edge hides is longer than a square, so that no piece has terrain of both sides.
    """
    is_deep = (rise < -STEEP) & (rise < -MIN_SLOPE * distance)
    return is_deep & (distance > math.sqrt(2.0) * SIDE)


@shared
def arc_of(r: Values, n_segments: int) -> Values:
    """Width of a segment at a range [m]."""
    return 2.0 * math.pi / n_segments * r


@shared
def can_step(distance: Values, rise: Values, most: float) -> Values:
    """Whether a step of this length and rise [m] is one on foot."""
    return np.abs(rise) <= np.minimum(MAX_SLOPE * distance + STEP_TOLERANCE, most)


@shared
def is_gentle(rise: Values, over_steep: Values) -> Values:
    """Whether a step may be taken without others side by side with it.

    Over returns that are too steep for terrain it rises or falls by noise alone.
    """
    return np.abs(rise) <= choose(over_steep, STEP_TOLERANCE, GENTLE)


@shared
def least_width(over_steep: Values) -> Values:
    """Width from which on a front is one of terrain [m]."""
    return choose(over_steep, 2.0, 1.0) * MIN_WIDTH


def fit_planes(x: FloatArray, y: FloatArray, z: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Height of the terrain in the middle of each square, by the places (P,) in and around it.

    The places in a square share a weight of one, so that those near the sensor are not all. Then
    each counts less with its distance to the plane of its own square.

    Returns the heights [m] and which of them are determined, two (N_SIDES, N_SIDES); heights that
    are not determined are arbitrary.
    """
    i, j = square_of(x).astype(np.int64), square_of(y).astype(np.int64)
    square, shape = i * N_SIDES + j, (N_SIDES, N_SIDES)
    number = np.bincount(square)[square]
    weight, products = 1.0 / number, (np.ones_like(x), x, y, z, x * x, x * y, y * y, x * z, y * z)
    for _ in range(N_ROUNDS):
        sums = (np.bincount(square, weight * p, N_SIDES * N_SIDES) for p in products)
        around = [three_by_three(total.reshape(shape)) for total in sums]
        plane = plane_of(around)
        there = [table[i, j] for table in plane]
        weight = robust_weight(z - height_of(there, x, y)) / number
    middle = middle_of(np.arange(N_SIDES))
    terrain: FloatArray = height_of(plane, middle[:, None], middle)
    is_known: BoolArray = around[0] >= MIN_WEIGHT
    return terrain, is_known


def three_by_three(table: npt.NDArray[Any]) -> FloatArray:
    """Sum over each square and the eight around it, (N_SIDES, N_SIDES)."""
    padded = np.zeros([n + 2 for n in table.shape])  # `np.pad` takes as long as all the rest
    padded[1:-1, 1:-1] = table
    rows = padded[:-2] + padded[1:-1] + padded[2:]
    result: FloatArray = rows[:, :-2] + rows[:, 1:-1] + rows[:, 2:]
    return result


def filled(terrain: FloatArray, is_known: BoolArray) -> FloatArray:
    """Terrain with each unknown height the mean of those known around it, ring by ring."""
    terrain = np.where(is_known, terrain, 0.0)
    while is_known.any() and not is_known.all():
        number = three_by_three(is_known)
        mean = three_by_three(terrain) / np.maximum(number, 1.0)
        is_next = ~is_known & (number > 0.0)
        terrain[is_next] = mean[is_next]
        is_known = is_known | is_next
    return terrain


@shared
def square_of(place: Values) -> Values:
    """Square along x or y in which a place [m] lies, at most the last; a float."""
    beyond = np.floor((place + REACH) / SIDE)
    return np.minimum(np.maximum(beyond, 0.0), N_SIDES - 1.0)


@shared
def middle_of(square: Values) -> Values:
    """Where the middle of a square lies along x or y [m]."""
    return (square + 0.5) * SIDE - REACH


@shared
def from_first_middle(place: Values, number: Callable[[float], Values]) -> Values:
    """Squares from the middle of the first one to a place [m], along x or y, within the relief.

    `number` is the type of the place.
    """
    beyond = (place + number(REACH)) * number(1.0 / SIDE) - number(0.5)
    return np.minimum(np.maximum(beyond, number(0.0)), number(N_SIDES - 1.0 - 1e-5))


@shared
def piece_of(a: Values, b: Values, c: Values, d: Values) -> tuple[Values, Values, Values, Values]:
    """Factors of 1, u, v and u v in the height between four middles, u and v from the first.

    That height is `a` there, `b` one square on along u, `c` along v, and `d` along both.
    """
    return a, b - a, c - a, (a - b) - (c - d)


@shared
def height_in(piece: Values, u: Values, v: Values) -> Values:
    """Height at a place, from `from_first_middle`, in the four factors of `piece_of` [m]."""
    u, v = u - np.floor(u), v - np.floor(v)
    return piece[0] + piece[1] * u + (piece[2] + piece[3] * u) * v


@shared
def plane_of(sums: Values) -> tuple[Values, Values, Values, Values, Values]:
    """Plane through places, by weighted sums of 1, x, y, z, xx, xy, yy, xz and yz.

    Returns their mean (three), and slopes along x and y; those of one place, or across a single
    ring, are level.
    """
    n, x, y, z = sums[0], sums[1], sums[2], sums[3]
    xx, xy, yy, xz, yz = sums[4], sums[5], sums[6], sums[7], sums[8]
    safe = np.maximum(n, 1e-9)
    mean_x, mean_y, mean_z = x / safe, y / safe, z / safe
    var_x, var_y = xx / safe - mean_x * mean_x, yy / safe - mean_y * mean_y
    var_xy = xy / safe - mean_x * mean_y
    var_xz, var_yz = xz / safe - mean_x * mean_z, yz / safe - mean_y * mean_z
    var_x, var_y = var_x + RIDGE, var_y + RIDGE
    determinant = var_x * var_y - var_xy * var_xy
    slope_x = (var_xz * var_y - var_yz * var_xy) / determinant
    slope_y = (var_yz * var_x - var_xz * var_xy) / determinant
    return mean_x, mean_y, mean_z, slope_x, slope_y


@shared
def height_of(plane: Values, x: Values, y: Values) -> Values:
    """Height at a place of the plane that `plane_of` gives [m]."""
    return plane[2] + plane[3] * (x - plane[0]) + plane[4] * (y - plane[1])


@shared
def robust_weight(residual: Values) -> Values:
    """Weight of a place at a distance [m] from its plane: Cauchy's."""
    share = residual / ROBUST_SCALE
    return 1.0 / (1.0 + share * share)


@shared
def faded(terrain: Values) -> Values:
    """Height of the relief where the terrain is so high [m]: level where it is low."""
    share = (np.abs(terrain) - FADED) / FADE_WIDTH
    share = np.minimum(np.maximum(share, 0.0), 1.0)
    return terrain * share * share * (3.0 - 2.0 * share)
