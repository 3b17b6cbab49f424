"""Edges of drops: where the ground steps down by more than a robot can take.

Behind an edge with a drop of depth D at range r, a sensor at height h sees the lower ground from
``r (h + D) / h`` on. Nothing between is seen, and the surface there is interpolated, no steeper
than the line of sight over the edge: at 10 m from 1.73 m, 10 degrees. So its slope does not tell
a drop from a ramp. The returns do. On a ramp that is less steep than the line of sight they
come all along the descent; at a drop two returns that follow each other in elevation have the
whole step between them, and the ground is level before and behind.

A step is such a pair in one sector of azimuth. Steps of neighbouring sectors are one edge, and it
is one only if three things hold. The fall stands out from the roughness of the ground on both
sides. Planes through the ground before and behind, carried on to the other side, leave a fall:
the one behind goes up to the edge of a long ramp. And few of the steps go on as a descent.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from gp_ground_seg.core.frame import BoolArray, FloatArray, IntArray
from gp_ground_seg.core.ground_model import segment_of

SECTORS = 360
"""Sectors of azimuth, counter-clockwise from -x, that steps are looked for in."""
LEVEL, N_LEVELS = math.radians(0.1), 1 << 10
"""Step of elevation within which returns belong to one ring, and steps of a quarter turn [rad]."""
NEAREST, FARTHEST, REACH = 0.3, 150.0, 20.0
"""Least and greatest range of a return, and greatest range of an edge [m]: beyond, rings are too
far apart to tell a drop from a descent."""
LEAST_SHARE = 0.4
"""Least slope between the two returns of a step, as a share of the slope of the line of sight.
With a smaller one, the rings are farther apart than the part that the edge hides."""
MARGIN = 1.02
"""Largest ratio of the ranges of two returns that may be of one place."""

WEAK = 0.7
"""A step of this share of the largest allowed one counts, if neighbouring steps are larger: how
deep a hole is seen depends on which ring just passes its edge."""
N_ROUGHNESS = 2.5
"""This many times the roughness of the ground is taken off the height of a step."""
BEFORE, BEHIND, WIDTH = 0.4, 1.5, 3
"""Window of the ground before a step, as a share of its range; factor from the beginning of a
window behind it to the end; sectors on each side that the windows take in."""
WINDOWS = 2.0, 3.0, 4.5, 6.75, 10.0
"""Where windows about the sensor begin [m]: where it is rough, a step must be larger."""
ON_SLOPE, MIN_DESCENT, MAX_ON_SLOPE = 0.35, 0.02, 0.2
"""A step is part of a descent if the ground before or behind it has at least this share of its
slope; least descent to the next ring behind [m]; largest share of such steps in an edge."""
NEXT_RINGS = 0.97, 0.85, 0.7
"""The slope behind a step is that to the returns whose lines of sight have these shares of the
slope of the line of sight at the step."""

MAX_APART, SAME_EDGE = 3, 0.12
"""Most sectors from one step of an edge to the next, and the share of its range by which the edge
may recede from sector to sector."""
MIN_STEPS, MIN_WIDTH, MIN_STRONG = 3, 1.0, 0.25
"""Least number of steps of an edge, least width [m], and least share of steps that are larger than
the largest allowed one."""
PLANE_STD, SLOPE_STD, N_STD = 0.05, 0.15, 2.0
"""Standard deviations of heights about a plane [m] and, before any ground is seen, of its slope;
a drop is certain if it is larger than this many standard deviations of the plane."""
SAMPLES, SPACING = 8, 0.04
"""Points along an edge in a sector, and their distance along the line between two of them [m]: at
`REACH` both are closer than the smallest cells of a map."""


class Edges(NamedTuple):
    """Nearest edge in each sector."""

    r: FloatArray  # (SECTORS,) range of the last ground before it [m]; infinite without one
    z: FloatArray  # (SECTORS,) height of that ground [m]; NaN without one
    goes_on: BoolArray  # (SECTORS,) whether it goes on in the next sector

    def points(self) -> FloatArray:
        """Points along the edges, closer to each other than cells of a map are, (n, 3) [m]."""
        sector = np.flatnonzero(np.isfinite(self.r))
        across = np.repeat(sector, SAMPLES)
        turn = across + np.tile((np.arange(SAMPLES) + 0.5) / SAMPLES, len(sector))
        # Where an edge goes on nearer or farther, along the line between the two sectors.
        before = np.flatnonzero(self.goes_on)
        jump = self.r[(before + 1) % SECTORS] - self.r[before]
        number = (np.abs(jump) / SPACING).astype(np.int64)
        along, jump = np.repeat(before, number), np.repeat(jump, number)
        first = np.repeat(np.cumsum(number) - number, number)
        moved = (np.arange(len(along)) - first + 1.0) * np.copysign(SPACING, jump)

        azimuth = np.append(turn, along + 1.0) * (2.0 * math.pi / SECTORS) - math.pi
        r = np.append(self.r[across], self.r[along] + moved)
        z = np.append(self.z[across], self.z[along])
        return np.stack([r * np.cos(azimuth), r * np.sin(azimuth), z], axis=-1)


class _Returns(NamedTuple):
    """Returns below the sensor, by sector, and in it from the lowest elevation up."""

    key: IntArray  # (n,) ``sector * N_LEVELS`` + step of elevation
    sector: IntArray  # (n,)
    xyz: FloatArray  # (3, n) [m]
    r: FloatArray  # (n,) horizontal range [m]
    is_ground: BoolArray  # (n,)
    n_standing: IntArray  # (n + 1,) how many before each stand on the ground

    z: FloatArray  # (n,) height [m]
    sight: FloatArray  # (n,) downward slope of the line of sight


class _Steps(NamedTuple):
    """Steps down between two returns that follow each other."""

    upper: IntArray  # (S,) last return before the step
    lower: IntArray  # (S,) first return behind it
    fall: FloatArray  # (S,) height that the ground falls, less its roughness [m]
    before: FloatArray  # (3, S) mean place of the ground before the step [m]
    is_on_slope: BoolArray  # (S,) whether the ground goes down before or behind it

    def where(self, kept: IntArray | BoolArray) -> _Steps:
        """Those of an index or a mask."""
        taken: list[Any] = [values[..., kept] for values in self]
        return _Steps(*taken)


def find_edges(
    xyz: FloatArray, is_ground: BoolArray, stands: BoolArray, max_step_down: float
) -> Edges:
    """Find where the ground steps down by more than `max_step_down`.

    Parameters
    ----------
    xyz : (N, 3) float64
        Points of a level frame whose origin is the sensor [m].
    is_ground : (N,) bool
        Points that are ground.
    stands : (N,) bool
        Points of what stands on the ground: it hides ground without being a drop.
    max_step_down : float
        Largest step that is none [m].

    Returns
    -------
    Edges
        In each sector the range up to which the ground is seen to go on before its nearest edge.
    """
    nowhere = np.zeros(SECTORS, dtype=np.bool_)
    edges = Edges(np.full(SECTORS, np.inf), np.full(SECTORS, np.nan), nowhere)
    returns = _sort(xyz, is_ground, stands)
    falls = _falls(returns, WEAK * max_step_down)
    if len(falls[0]) < MIN_STEPS:
        return edges
    steps = _steps(returns, *falls, WEAK * max_step_down)
    if len(steps.upper) < MIN_STEPS:
        return edges
    sector, near = returns.sector[steps.upper], returns.r[steps.upper]
    # Where the line of sight over the edge meets the upper ground, if that went on.
    far = np.maximum(near, -returns.z[steps.upper] / returns.sight[steps.lower])
    gap, group = _group(sector, near, far)
    for number in range(int(group.max()) + 1):
        members = np.flatnonzero(group == number)
        if not _is_edge(returns, steps.where(members), max_step_down):
            continue
        for a in members:
            # Up to the next step of the edge, as near as the nearer of the two.
            between = (sector[a] + np.arange(max(gap[a], 1))) % SECTORS
            edges.r[between] = min(near[a], near[(a + 1) % len(near)])
            edges.r[sector[a]] = near[a]
            edges.z[between] = returns.z[steps.upper[a]]
            edges.goes_on[between] = gap[a] > 0
    return edges


def _sort(xyz: FloatArray, is_ground: BoolArray, stands: BoolArray) -> _Returns:
    x, y, z = xyz.T
    r = np.hypot(x, y)
    kept = np.flatnonzero((r > NEAREST) & (r < FARTHEST) & (z < 0.0) & (z > -FARTHEST))
    x, y, z, r = (values[kept] for values in (x, y, z, r))
    sector = segment_of(x, y, SECTORS)
    level = ((np.arctan2(z, r) + 0.5 * math.pi) / LEVEL).astype(np.int64)
    key = sector * N_LEVELS + level
    # In a ring near to far, where the upper ground and the lower have both returns of it.
    order = np.lexsort((r, key))
    kept = kept[order]
    n_standing = np.concatenate([[0], np.cumsum(stands[kept])])
    places, r, z = np.stack([x, y, z])[:, order], r[order], z[order]
    ground = is_ground[kept]
    return _Returns(key[order], sector[order], places, r, ground, n_standing, z, -z / r)


def _falls(returns: _Returns, least: float) -> tuple[IntArray, FloatArray]:
    """Last returns of the ground before falls of more than `least` [m], and slopes of the falls.

    Each ends at the next return. Its slope is positive, and not much less than that of the line of
    sight.
    """
    sector, z, r = returns.sector, returns.z, returns.r
    stands = np.diff(returns.n_standing) > 0
    is_fall = (sector[1:] == sector[:-1]) & returns.is_ground[:-1] & ~stands[1:]
    is_fall &= (z[:-1] - z[1:] > least) & (r[1:] > r[:-1]) & (r[:-1] < REACH)
    upper = np.flatnonzero(is_fall)
    slope = (z[upper] - z[upper + 1]) / (r[upper + 1] - r[upper])
    kept = slope > LEAST_SHARE * returns.sight[upper + 1]
    if kept.any():
        kept &= ~_is_mirrored(returns, upper, least)
    return upper[kept], slope[kept]


def _steps(returns: _Returns, upper: IntArray, slope: FloatArray, least: float) -> _Steps:
    """Nearest step of each sector: a fall larger than `least` [m] and the roughness allow."""
    sector, z, r = returns.sector, returns.z, returns.r
    lower, ground = upper + 1, _Ground.of(returns)
    begin = (1.0 - BEFORE) * r[upper] - NEAREST
    before, slope_before, roughness = ground.window(sector[upper], begin, 1.001 * r[upper])
    runs_down = -slope_before >= ON_SLOPE * slope
    runs_down &= -slope_before * (r[upper] - np.hypot(before[0], before[1])) > roughness
    # The far wall of a trench makes one window rough: rough ground makes both so. Where one ring
    # is all that is seen before the step, it tells neither slope nor roughness.
    begin = 1.1 * r[lower] + 0.5
    _, _, near = ground.window(sector[upper], begin, BEHIND * begin)
    _, _, far = ground.window(sector[upper], BEHIND * begin, BEHIND**2 * begin)
    behind = np.where(slope_before == 0.0, np.maximum(near, far), np.minimum(near, far))
    roughness = np.maximum(np.maximum(roughness, behind), ground.roughness())
    following, known = _next_ring(returns, lower, NEXT_RINGS[0])
    descent = z[lower] - z[following]
    goes_on = known & (descent >= ON_SLOPE * slope * (r[following] - r[lower]))
    goes_on &= descent > N_ROUGHNESS * roughness + MIN_DESCENT

    fall = np.minimum(z[upper], before[2]) - z[lower] - N_ROUGHNESS * roughness
    steps = _Steps(upper, lower, fall, before, runs_down | goes_on).where(fall > least)
    order = np.lexsort((r[steps.upper], sector[steps.upper]))
    _, first = np.unique(sector[steps.upper[order]], return_index=True)
    return steps.where(order[first])


def _is_mirrored(returns: _Returns, upper: IntArray, least: float) -> BoolArray:
    """Which steps, by their `upper` returns, are between a wet road and a mirror image below it.

    The road, or what stands on it, is then also seen between the two, or a steeper ray has gone
    farther and still deeper.
    """
    r, z, start = returns.r, returns.z, returns.sector * FARTHEST
    on_road = returns.is_ground | (np.diff(returns.n_standing) > 0)
    seen = np.sort((start + r)[on_road])
    begin, end = MARGIN * r[upper] + 0.05, r[upper + 1] / MARGIN - 0.05
    first, stop = (np.searchsorted(seen, start[upper] + place) for place in (begin, end))
    place = start + r
    farthest = np.where(place == np.maximum.accumulate(place), np.arange(len(r)), 0)
    before = np.maximum.accumulate(farthest)[upper]
    result: BoolArray = stop > first
    return result | ((r[before] > begin) & (z[before] < z[upper + 1] - least))


def _next_ring(returns: _Returns, index: IntArray, share: float) -> tuple[IntArray, BoolArray]:
    """First return of the sector whose line of sight has `share` of the slope of that at `index`.

    Also whether there is one, behind that at `index`, and nothing that stands before it.
    """
    elevation = np.arctan(-share * returns.sight[index])
    level = ((elevation + 0.5 * math.pi) / LEVEL).astype(np.int64)
    sector, n = returns.sector[index], len(returns.key)
    place = np.searchsorted(returns.key, sector * N_LEVELS + level, side='right')
    result = np.minimum(place, n - 1)
    known = (place < n) & (returns.sector[result] == sector)
    known &= returns.r[result] > returns.r[index]
    known &= returns.n_standing[result + 1] <= returns.n_standing[index + 1]
    return result, known


class _Ground(NamedTuple):
    """Sums over the ground returns of each sector, near to far."""

    key: FloatArray  # (n,) sector and range
    sums: FloatArray  # (8, n + 1) of 1, x, y, z, z^2, r, r^2 and r z of those before

    @classmethod
    def of(cls, returns: _Returns) -> _Ground:
        index = np.flatnonzero(returns.is_ground & (returns.r < 5.0 * REACH))
        key = returns.sector[index] * FARTHEST + returns.r[index]
        order = np.argsort(key, kind='stable')
        (x, y, z), r = returns.xyz[:, index[order]], returns.r[index[order]]
        terms = np.stack([np.ones(len(r)), x, y, z, z * z, r, r * r, r * z])
        return cls(key[order], np.pad(np.cumsum(terms, axis=1), ((0, 0), (1, 0))))

    def roughness(self) -> float:
        """Median of the standard deviations in windows all around the sensor [m]."""
        begin, sector = np.meshgrid(WINDOWS, np.arange(0, SECTORS, 2 * WIDTH + 1))
        std = self.window(sector.ravel(), begin.ravel(), BEHIND * begin.ravel())[2]
        return float(np.median(std[std > 0.0])) if std.any() else 0.0

    def window(
        self, sector: IntArray, begin: FloatArray, end: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Ground at ranges from `begin` to `end` [m] in and beside each sector, (S,) each.

        Mean place, (3, S) [m]; slope dz/dr of the line through it, and standard deviation about
        that line [m]; all 0 where nothing is seen.
        """
        total = np.zeros((len(self.sums), len(sector)))
        begin, end = np.maximum(begin, 0.0), np.minimum(end, 0.999 * FARTHEST)
        for aside in range(-WIDTH, WIDTH + 1):
            start = (sector + aside) % SECTORS * FARTHEST
            first, stop = (np.searchsorted(self.key, start + r) for r in (begin, end))
            total += self.sums[:, np.maximum(first, stop)] - self.sums[:, first]
        x, y, z, zz, r, rr, rz = total[1:] / np.maximum(total[0], 1.0)
        spread, both = np.maximum(rr - r * r, 0.0), rz - r * z
        slope = np.where(spread > 0.01, both / np.maximum(spread, 0.01), 0.0)
        std = np.sqrt(np.maximum(zz - z * z - slope * both, 0.0))
        return np.stack([x, y, z]), slope, std


def _group(sector: IntArray, near: FloatArray, far: FloatArray) -> tuple[IntArray, IntArray]:
    """Sectors from each step to the next of its edge, or 0 at its end; number of its edge.

    Steps are by sector. The edge is between `near` and `far` [m]: those of an edge overlap, but
    for what it recedes from sector to sector.
    """
    gap = (np.roll(sector, -1) - sector) % SECTORS
    outer = np.minimum(far, np.roll(far, -1)) * (1.0 + SAME_EDGE * gap)
    joined = (gap <= MAX_APART) & (gap > 0) & (np.maximum(near, np.roll(near, -1)) <= outer)
    ends = np.flatnonzero(~joined)
    # Numbers go up behind each end; what follows the last one belongs to the first edge.
    group = np.cumsum(np.roll(~joined, 1))
    group = (group - group[0]) % max(len(ends), 1)
    return np.where(joined, gap, 0), group


def _is_edge(returns: _Returns, steps: _Steps, max_step_down: float) -> bool:
    """Whether neighbouring steps are an edge that is wide enough, and no descent."""
    n, upper, lower = len(steps.upper), steps.upper, steps.lower
    width = 2.0 * math.pi / SECTORS * returns.r[upper].sum()
    n_strong = np.count_nonzero(steps.fall > max_step_down)
    if n < MIN_STEPS or width < MIN_WIDTH or n_strong < max(MIN_STEPS, MIN_STRONG * n):
        return False
    if np.count_nonzero(steps.is_on_slope) > MAX_ON_SLOPE * n:
        return False
    behind = [lower]
    for share in NEXT_RINGS[1:]:
        following, known = _next_ring(returns, lower, share)
        behind.append(following[known])
    here, there = returns.xyz[:, upper], returns.xyz[:, lower]
    level = np.minimum(here[2], steps.before[2])
    lowest, unsure = _plane_at(returns.xyz[:, np.concatenate(behind)], here)
    from_behind = np.median(level - lowest - N_STD * unsure)
    carried_on, unsure = _plane_at(np.concatenate([here, steps.before], axis=1), there)
    from_before = np.median(np.minimum(carried_on, level) - N_STD * unsure - there[2])
    return bool(min(from_behind, from_before) > WEAK * max_step_down)


def _plane_at(points: FloatArray, places: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Height of the plane through `points` (3, P) at `places` (3, S), and its deviation, (S,) [m].

    The slope has a prior: it is level, to within `SLOPE_STD`. So few points, or points along a
    line, tell of the slope across as little as they show.
    """
    middle = points.mean(axis=1)
    x_y, z = points[:2] - middle[:2, None], points[2] - middle[2]
    covariance = np.linalg.inv(x_y @ x_y.T + (PLANE_STD / SLOPE_STD) ** 2 * np.eye(2))
    away = places[:2] - middle[:2, None]
    height = middle[2] + (covariance @ (x_y @ z)) @ away
    return height, PLANE_STD * np.sqrt(np.einsum('is,ij,js->s', away, covariance, away))
