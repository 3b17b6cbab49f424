"""Edges of drops: where the ground steps down by more than a robot can take.

Behind an edge with a drop of depth D at range r, a sensor at height h sees the lower ground from
``r (h + D) / h`` on. Nothing between is seen, and the surface there is interpolated. A fall is
such a pair of returns that follow each other in elevation, in one sector of azimuth. The first of
a sector is the ground that the robot stands on: the last drop before it is a fall, too.

No slope explains a fall if the ground before and behind it does not go down, and if it stands out
from the roughness of both. What lies behind is not known to be on the level of the robot: it is a
drop, or a ramp at least as steep as the line of sight over the edge. It is a drop if neighbouring
sectors have the edge, and a line of sight straight over it would be steeper than a ramp. A sensor
that looks down less sees the edge on both sides: it is straight between them.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from gp_ground_seg.core.frame import BoolArray, FloatArray, IntArray
from gp_ground_seg.core.ground_model import segment_of
from gp_ground_seg.core.pipeline.points import angles_of, rotation

SECTORS = 360
"""Sectors of azimuth, counter-clockwise from -x, that steps are looked for in."""
LEVEL, N_LEVELS = math.radians(0.1), 1 << 10
"""Step of elevation within which returns belong to one ring, and steps of a quarter turn [rad]."""
NEAREST, FARTHEST, REACH = 0.3, 150.0, 20.0
"""Least and greatest range of a return, and greatest range of an edge [m]: beyond, rings are too
far apart to tell a drop from a descent."""
LEAST_SHARE = 0.3
"""Least slope between the two returns of a step, as a share of the slope of the line of sight.
With a smaller one, the rings are farther apart than the part that the edge hides."""
MARGIN = 1.02  # largest ratio of the ranges of two returns that may be of one place

WEAK = 0.7
"""A step of this share of the largest allowed one counts, if neighbouring steps are larger: how
deep a hole is seen depends on which ring just passes its edge."""
N_ROUGHNESS = 2.5  # times the roughness of the ground is taken off the height of a step
BEFORE, BEHIND, WIDTH = 0.4, 1.5, 3
"""Window of the ground before a step, as a share of its range; factor from the beginning of a
window behind it to the end; sectors on each side that the windows take in."""
ON_SLOPE, MIN_DESCENT = 0.35, 0.02
"""A step is part of a descent if the ground before or behind it has at least this share of its
slope; least descent to the next ring behind [m]."""
N_NEAREST, NEXT, N_FITS = 3, 1.5, 12
"""Rings of the nearest ground that the robot stands on, factor from the range of one to that of
the next, and rounds of fitting a plane to it."""
WIDEST, SLOPE_NOISE, LEAST_ON_PLANE = 0.1, 0.006, 0.4
"""Slope by which ground may be off that plane in the first and in the last round; least share of
the ground that is off by less than twice the last."""

MAX_APART, SAME_EDGE, STAIR = 3, 0.12, 0.3
"""Most sectors from one step of an edge to the next, and the share of its range by which the edge
may recede from sector to sector, besides one step of stairs [m]."""
MIN_STEPS, MIN_WIDTH, MIN_STRONG = 3, 1.0, 0.25
"""Least number of steps of an edge, least width [m], and least share of steps that are larger than
the largest allowed one."""
STEEPEST, SHALLOWER = 0.21, 0.83
"""Slope of the steepest ramp that robots drive: a fall is none if it is steeper along the shortest
way over its edge; where that is never seen, than this share of the lowest line of sight."""
LEAST_FALL, LEAST_HIDDEN = 0.02, 0.3  # that hides ground, and least length of what is hidden [m]
FOOT = 0.01  # range of the ground that the robot stands on [m]
MAX_SLOPE = 0.3  # steepest slope that is seen to lead down from the robot
ON_LEVEL = 0.1  # noise: what is nearer to the level before a fall is ground, by any label [m]
BIN, N_BINS = 0.1, 500  # width [m] and number of the bins of range in which ground is hidden
SAMPLES, SPACING = 8, 0.04
"""Points along an edge in a sector, and their distance along the line between two of them [m]: at
`REACH` both are closer than the smallest cells of a map."""


class Edges(NamedTuple):
    """Nearest edge in each sector, and what no return tells to be on the level of the robot."""

    r: FloatArray  # (SECTORS,) range of the last ground before it [m]; infinite without one
    z: FloatArray  # (SECTORS,) height of that ground [m]; NaN without one
    goes_on: BoolArray  # (SECTORS,) whether it goes on in the next sector
    first: FloatArray  # (SECTORS,) range of the first return if it is behind a fall [m]
    behind: FloatArray  # (SECTORS,) range of the nearest return behind a fall [m]
    hidden: BoolArray  # (SECTORS, N_BINS) bins of range behind falls
    is_before: BoolArray  # (N,) returns of the level of the robot before falls

    @classmethod
    def none(cls, n_points: int) -> Edges:
        """Where the ground goes on in all directions."""
        r, first, behind = np.full((3, SECTORS), np.inf)
        shapes = SECTORS, (SECTORS, N_BINS), n_points
        goes_on, *masks = (np.zeros(shape, dtype=np.bool_) for shape in shapes)
        return cls(r, np.full(SECTORS, np.nan), goes_on, first, behind, *masks)

    def hides(self, x: FloatArray, y: FloatArray) -> BoolArray:
        """Whether places are behind falls."""
        bins = np.minimum(np.hypot(x, y) / BIN, N_BINS - 1).astype(np.int64)
        return np.asarray(self.hidden[segment_of(x, y, SECTORS), bins])

    def points(self) -> FloatArray:
        """Points along the edges, closer to each other than cells of a map are, (n, 3) [m]."""
        # Where an edge goes on nearer or farther, along the line between the two sectors.
        before = np.flatnonzero(self.goes_on)
        jump = self.r[(before + 1) % SECTORS] - self.r[before]
        number = (np.abs(jump) / SPACING).astype(np.int64)
        along, jump = np.repeat(before, number), np.repeat(jump, number)
        first = np.repeat(np.cumsum(number) - number, number)
        moved = (np.arange(len(along)) - first + 1.0) * np.copysign(SPACING, jump)
        ends = _place(along + 1.0, self.r[along] + moved, self.z[along])
        return np.concatenate([across_sectors(self.r, self.z), ends])


def across_sectors(r: FloatArray, z: FloatArray) -> FloatArray:
    """Points across the sectors at ranges `r`, (SECTORS,), where they are finite, (n, 3) [m]."""
    sector = np.repeat(np.flatnonzero(np.isfinite(r)), SAMPLES)
    turn = sector + (np.arange(len(sector)) % SAMPLES + 0.5) / SAMPLES
    return _place(turn, r[sector], z[sector])


def _place(turn: npt.NDArray[np.floating], r: FloatArray, z: FloatArray) -> FloatArray:
    """Points at azimuths in sectors from -x, (n, 3) [m]."""
    azimuth = turn * (2.0 * math.pi / SECTORS) - math.pi
    return np.stack([r * np.cos(azimuth), r * np.sin(azimuth), z], axis=-1)


class _Returns(NamedTuple):
    """Returns below the sensor, by sector, and in it from the lowest elevation up."""

    point: IntArray  # (n,) in the input; beyond it for the ground that the robot stands on
    sector: IntArray  # (n,)
    r: FloatArray  # (n,) horizontal range [m]
    is_ground: BoolArray  # (n,)
    stands: BoolArray  # (n,) what stands on the ground, off the level of the robot
    z: FloatArray  # (n,) height [m]
    sight: FloatArray  # (n,) downward slope of the line of sight


class _Steps(NamedTuple):
    """Steps down from a return to the next one, or to where the ground is no longer steep."""

    upper: IntArray  # (S,) last return before the step
    lower: IntArray  # (S,) return at its end
    sector: IntArray  # (S,)
    near: FloatArray  # (S,) range of the last return before it [m]
    fall: FloatArray  # (S,) height that the ground falls, less its roughness [m]
    slope: FloatArray  # (S,) downward slope of the line of sight over it
    is_on_slope: BoolArray  # (S,) whether the ground goes down before or behind it

    def where(self, kept: IntArray | BoolArray) -> _Steps:
        """Those of an index or a mask."""
        return _Steps._make(values[kept] for values in self)


def find_edges(
    xyz: FloatArray, is_ground: BoolArray, stands: BoolArray, max_step_down: float, height: float
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
    height : float
        Of the sensor over the ground that the robot stands on [m].

    Returns
    -------
    Edges
        In each sector the range up to which the ground is seen to go on before its nearest edge.
    """
    edges = Edges.none(len(xyz))
    returns = _sort(xyz, is_ground, stands, height)
    steps = _steps(returns, *_falls(returns, max_step_down), max_step_down)
    every, hiding = np.arange(SECTORS), steps.where(~steps.is_on_slope)
    _hide(edges, returns, hiding, max_step_down)
    edges.first[:] = _with_neighbours(edges.first)
    # Where the first return is behind a fall, and its line of sight less steep than a ramp.
    is_blind = np.isin(every, hiding.sector[(hiding.near == FOOT) & (hiding.slope < STEEPEST)])
    is_seen = ~is_blind[steps.sector] & (steps.near > FOOT)
    steps = steps.where((steps.fall > WEAK * max_step_down) & is_seen)
    if not len(steps.sector):
        return edges
    sector, lowest = np.unique(steps.sector, return_index=True)
    steps = steps.where(lowest)
    # Where the line of sight over the edge meets the upper ground, if that went on.
    far = np.maximum(steps.near, -returns.z[steps.upper] / steps.slope)
    near = np.full(SECTORS, np.inf)
    near[steps.sector] = steps.near
    steps = steps._replace(near=_with_neighbours(near)[steps.sector])
    gap, group = _group(steps, far, is_blind)
    # In each sector from a step up to the next of its edge: as near as the nearer of the two, or,
    # if it is blind, on the line between them.
    step = np.searchsorted(sector, every, side='right') - 1
    apart = np.maximum(gap[step], 1)
    on = np.minimum((every - sector[step]) % SECTORS, apart)
    before, behind = steps.near[step], np.roll(steps.near, -1)[step]
    whole, left, right = np.sin(2.0 * math.pi / SECTORS * np.stack([apart, apart - on, on]))
    straight = whole / (left / before + right / behind)
    r = np.where(is_blind, straight, np.where(on > 0, np.minimum(before, behind), before))
    for number in np.flatnonzero(np.bincount(group) >= MIN_STEPS):
        kept, members = (group[step] == number) & (on < apart), group == number
        ramp = _steepest_ramp(returns, np.where(kept, r, np.inf), height)
        if _is_edge(steps.where(members), r[kept & is_blind], ramp, max_step_down):
            edges.r[kept], edges.z[kept] = r[kept], returns.z[steps.upper[step[kept]]]
            edges.goes_on[kept] = gap[step[kept]] > 0
    # An edge of ground that an allowed step leads to is certain.
    edges.first[edges.z > -height - max_step_down] = np.inf
    return edges


def _with_neighbours(r: FloatArray) -> FloatArray:
    """Ranges in sectors; where noise hides the nearest fall from one, that of a neighbour [m]."""
    return np.asarray(np.minimum(r, np.median([np.roll(r, 1), r, np.roll(r, -1)], axis=0)))


def standing_level(xyz: FloatArray, height: float) -> FloatArray:
    """Matrix (3, 3) that turns level the plane that the robot stands on.

    `xyz` (N, 3) is ground about a sensor that is `height` above it [m]. The plane is the one
    through the place below the sensor on which most of the nearest ground lies; if that is not
    `LEAST_ON_PLANE` of it, as behind a drop, the matrix turns nothing.
    """
    x, y, z = xyz.T
    r, sector = np.maximum(np.hypot(x, y), NEAREST), segment_of(x, y, SECTORS)
    rings, nearest = [], np.zeros(SECTORS)
    for _ in range(N_NEAREST):
        beyond, nearest = NEXT * nearest, np.full(SECTORS, np.inf)
        far = np.where(r > beyond[sector], r, np.inf)
        np.minimum.at(nearest, sector, far)
        rings.append(np.flatnonzero((far == nearest[sector]) & (far < np.inf)))
    index = np.concatenate(rings)
    heading, rise = np.stack([x, y])[:, index] / r[index], (z[index] + height) / r[index]
    slope = np.zeros(2)
    for noise in np.geomspace(WIDEST, SLOPE_NOISE, N_FITS):
        # What is far off counts ever less: the ground on which the robot does not stand.
        weight = 1.0 / np.hypot(noise, rise - slope @ heading)
        slope = np.linalg.lstsq((heading * weight).T, rise * weight, rcond=None)[0]
    on_plane = abs(rise - slope @ heading) < 2.0 * SLOPE_NOISE
    if np.count_nonzero(on_plane) < LEAST_ON_PLANE * len(index):
        slope = np.zeros(2)
    up = np.array([*-slope, 1.0])
    return rotation(*angles_of(up / np.linalg.norm(up)))


def _hide(edges: Edges, returns: _Returns, steps: _Steps, max_step_down: float) -> None:
    """Enter what lies behind `steps`, which no slope explains, until the level is seen again."""
    z, r = returns.z, returns.r
    starts = np.searchsorted(returns.sector, np.arange(SECTORS + 1))
    for upper, lower, sector in zip(steps.upper, steps.lower, steps.sector, strict=True):
        depth = z[upper] - z[lower]
        if depth < min(LEAST_HIDDEN * returns.sight[lower], WEAK * max_step_down):
            continue
        before, behind = slice(starts[sector] + 1, upper + 1), slice(lower, starts[sector + 1])
        edges.is_before[returns.point[before]] |= abs(z[before] - z[0]) < ON_LEVEL
        is_back = returns.is_ground[behind] & (z[behind] > z[upper] - max_step_down)
        until = r[lower + is_back.argmax()] if is_back.any() else FARTHEST
        edges.hidden[sector, int(r[upper] / BIN) + 1 : int(until / BIN)] = True
        if depth > WEAK * max_step_down:
            nearest = edges.first if r[upper] == FOOT else edges.behind
            nearest[sector] = min(nearest[sector], r[lower])


def _sort(xyz: FloatArray, is_ground: BoolArray, stands: BoolArray, height: float) -> _Returns:
    foot = _place(np.arange(SECTORS) + 0.5, np.full(SECTORS, FOOT), np.full(SECTORS, -height))
    x, y, z = np.concatenate([xyz, foot]).T
    r, is_foot = np.hypot(x, y), np.arange(len(x)) >= len(xyz)
    r[is_foot] = FOOT
    kept = np.flatnonzero(((r > NEAREST) | is_foot) & (r < FARTHEST) & (z < 0.0) & (z > -FARTHEST))
    x, y, z, r = (values[kept] for values in (x, y, z, r))
    sector = segment_of(x, y, SECTORS)
    level = ((np.arctan2(z, r) + 0.5 * math.pi) / LEVEL).astype(np.int64)
    # In a ring near to far, where the upper ground and the lower have both returns of it.
    key = sector * N_LEVELS + np.where(is_foot[kept], 0, level)
    order = np.lexsort((r, key))
    kept, z, r = kept[order], z[order], r[order]
    # A surface that goes down behind an edge has the last of the ground before it above it.
    is_level = abs(z + height) < ON_LEVEL
    ground, stood = (np.pad(mask, (0, SECTORS))[kept] for mask in (is_ground, stands))
    return _Returns(kept, sector[order], r, ground | is_level, stood & ~is_level, z, -z / r)


def _falls(returns: _Returns, max_step_down: float) -> tuple[IntArray, IntArray, FloatArray]:
    """Last returns of the ground before falls, returns at their end, and slopes of the falls.

    They end at the next return, or, as on stairs nearby, where a steep way down exceeds the limit.
    Slopes are positive, and not much less than those of the lines of sight.
    """
    sector, z, r = returns.sector, returns.z, returns.r
    is_fall = (sector[1:] == sector[:-1]) & returns.is_ground[:-1] & ~returns.stands[1:]
    is_fall &= (r[1:] > r[:-1]) & (r[:-1] < REACH)
    end, begin = np.arange(len(r)), np.flatnonzero(is_fall)
    while len(begin):
        last = np.minimum(end[begin] + 1, len(r) - 1)
        goes_on = (
            (sector[last] == sector[begin]) & (last > end[begin]) & ~returns.stands[last]
            & (z[begin] - z[last] > MAX_SLOPE * (r[last] - r[begin]))
            & (z[begin] - z[end[begin]] <= max_step_down)
        )  # fmt: skip
        end[begin := begin[goes_on]] += 1
    is_steep = z - z[end] > max_step_down
    end = np.where(is_steep, end, np.arange(len(r)) + 1)
    upper = np.flatnonzero(is_fall & (is_steep[:-1] | (z[:-1] - z[1:] > LEAST_FALL)))
    slope = (z[upper] - z[end[upper]]) / (r[end[upper]] - r[upper])
    kept = (slope > LEAST_SHARE * returns.sight[upper + 1]) | (r[upper] == FOOT)
    if kept.any():
        kept &= ~_is_mirrored(returns, upper)
    return upper[kept], end[upper[kept]], slope[kept]


def _steps(
    returns: _Returns, upper: IntArray, deep: IntArray, slope: FloatArray, max_step_down: float
) -> _Steps:
    """Falls that are larger than the roughness allows, those from the foot than the limit."""
    sector, z, r = returns.sector, returns.z, returns.r
    lower, ground, is_first = upper + 1, _Ground.of(returns), r[upper] == FOOT
    begin = (1.0 - BEFORE) * r[upper] - NEAREST
    middle, level, slope_before, roughness = ground.window(sector[upper], begin, 1.001 * r[upper])
    # Where one ring is all that is seen before the step, it tells no roughness, and the slope is
    # that from the foot of the robot.
    is_alone, below = slope_before == 0.0, z[0] - z[upper]
    slope_before = np.where(is_alone, -below / r[upper], slope_before)
    descent = np.where(is_alone, below - ON_LEVEL, -slope_before * (r[upper] - middle))
    runs_down = (-slope_before >= ON_SLOPE * slope) & (descent > roughness)
    # The far wall of a trench makes one window rough: rough ground makes both so.
    begin = 1.1 * r[lower] + 0.5
    *_, near = ground.window(sector[upper], begin, BEHIND * begin)
    *_, far = ground.window(sector[upper], BEHIND * begin, BEHIND**2 * begin)
    behind = np.where(is_alone, np.maximum(near, far), np.minimum(near, far))
    roughness = np.maximum(roughness, behind)
    # What is seen behind it goes down as well, or leads back up to the level of the robot.
    goes_on = np.zeros(len(upper), dtype=np.bool_)
    for end in (BEHIND * r[lower], BEHIND**3 * r[lower], BEHIND**2 * r[lower]):
        *_, seen, std = ground.window(sector[upper], 0.95 * r[lower], end)
        descent = -seen * (end - r[lower])
        is_clear = descent > N_ROUGHNESS * roughness + MIN_DESCENT
        goes_on |= is_clear & (-seen >= ON_SLOPE * slope)
    leads_back = returns.is_ground[lower] & (seen > -MAX_SLOPE)
    top = z[lower] - seen * r[lower] - N_ROUGHNESS * std  # stairs have a slope, too
    leads_back &= top > z[upper] - max_step_down
    is_on_slope = np.where(is_first, leads_back, runs_down | goes_on) & (slope < MAX_SLOPE)

    fall = np.minimum(z[upper], level) - z[deep] - N_ROUGHNESS * roughness
    fall = np.where(is_first, z[upper] - z[deep], fall)
    sight = returns.sight[lower]
    steps = _Steps(upper, deep, sector[upper], r[upper], fall, sight, is_on_slope)
    return steps.where(fall > np.where(is_first, WEAK * max_step_down, LEAST_FALL))


def _is_mirrored(returns: _Returns, upper: IntArray) -> BoolArray:
    """Which steps, by their `upper` returns, are between a wet road and a mirror image below it.

    The road, or what stands on it, is then also seen between the two, or a steeper ray has gone
    farther and still deeper.
    """
    r, z, start = returns.r, returns.z, returns.sector * FARTHEST
    place = start + r
    farthest = np.where(place == np.maximum.accumulate(place), np.arange(len(r)), 0)
    before = np.maximum.accumulate(farthest)[upper]
    seen = np.sort(place[returns.is_ground | returns.stands])
    is_level = z[before] > z[upper] - ON_LEVEL
    begin = MARGIN * r[np.where(is_level, before, upper)] + 0.05
    end = r[upper + 1] / MARGIN - 0.15
    first, stop = (np.searchsorted(seen, start[upper] + place) for place in (begin, end))
    is_deeper = (r[before] > begin) & (z[before] < z[upper + 1] - ON_LEVEL)
    return np.asarray((stop > first) | is_deeper)


class _Ground(NamedTuple):
    """Sums over the ground returns of each sector, near to far."""

    key: FloatArray  # (n,) sector and range
    sums: FloatArray  # (6, n + 1) of 1, z, z^2, r, r^2 and r z of those before

    @classmethod
    def of(cls, returns: _Returns) -> _Ground:
        index = np.flatnonzero(returns.is_ground & (returns.r < 5.0 * REACH))
        key = returns.sector[index] * FARTHEST + returns.r[index]
        order = np.argsort(key, kind='stable')
        z, r = returns.z[index[order]], returns.r[index[order]]
        terms = np.stack([np.ones(len(r)), z, z * z, r, r * r, r * z])
        return cls(key[order], np.pad(np.cumsum(terms, axis=1), ((0, 0), (1, 0))))

    def window(
        self, sector: IntArray, begin: FloatArray, end: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Ground at ranges from `begin` to `end` [m] in and beside each sector, (S,) each.

        Mean range and height [m]; slope dz/dr of the line through it, and standard deviation about
        that line [m]; all 0 where nothing is seen.
        """
        total = np.zeros((len(self.sums), len(sector)))
        begin, end = np.maximum(begin, 0.0), np.minimum(end, 0.999 * FARTHEST)
        for aside in range(-WIDTH, WIDTH + 1):
            start = (sector + aside) % SECTORS * FARTHEST
            first, stop = (np.searchsorted(self.key, start + r) for r in (begin, end))
            total += self.sums[:, np.maximum(first, stop)] - self.sums[:, first]
        z, zz, r, rr, rz = total[1:] / np.maximum(total[0], 1.0)
        spread, both = np.maximum(rr - r * r, 0.0), rz - r * z
        slope = np.where(spread > 0.01, both / np.maximum(spread, 0.01), 0.0)
        std = np.sqrt(np.maximum(zz - z * z - slope * both, 0.0))
        return r, z, slope, std


def _group(steps: _Steps, far: FloatArray, is_blind: BoolArray) -> tuple[IntArray, IntArray]:
    """Sectors from each step to the next of its edge, or 0 at its end; number of its edge.

    Steps are by sector. The edge is between them and `far` [m]: those of an edge overlap, but for
    noise, and what it recedes from sector to sector. Sectors whose first return `is_blind`, behind
    a fall, do not count: an edge on both sides of them goes on through them.
    """
    sector, near = steps.sector, steps.near
    gap = (np.roll(sector, -1) - sector) % SECTORS
    n_seen = np.cumsum(np.tile(~is_blind, 2))
    apart: IntArray = n_seen[sector + gap] - n_seen[sector]
    outer = np.minimum(far, np.roll(far, -1)) * (1.0 + SAME_EDGE * apart) + STAIR
    is_near = (apart <= MAX_APART) & (gap > 0) & (2 * gap < SECTORS)
    joined: BoolArray = is_near & (np.maximum(near, np.roll(near, -1)) <= outer)
    ends = np.flatnonzero(~joined)
    # Numbers go up behind each end; what follows the last one belongs to the first edge.
    group: IntArray = np.cumsum(np.roll(~joined, 1))
    group = (group - group[:1]) % max(len(ends), 1)
    return np.where(joined, gap, 0), group


def _steepest_ramp(returns: _Returns, r: FloatArray, height: float) -> float:
    """Slope of the steepest ramp that an edge at ranges `r`, (SECTORS,), is told from [m]."""
    # A sensor that looks down less tells it when it is nearer, at this angle to both sides, if the
    # level is as wide as that.
    lowest = float(returns.sight[returns.r > FOOT].max())
    turn = round(SECTORS / (2.0 * math.pi) * math.acos(min(lowest / STEEPEST, 1.0)))
    is_level = returns.is_ground & (abs(returns.z + height) < ON_LEVEL) & (returns.r > FOOT)
    off = returns.sector[is_level] - r.argmin() + WIDTH
    is_wide = all(((off + aside) % SECTORS <= 2 * WIDTH).any() for aside in (turn, -turn))
    is_told = is_wide or r.min() < height / STEEPEST
    return STEEPEST if is_told else min(STEEPEST, SHALLOWER * lowest)


def _is_edge(steps: _Steps, unseen: FloatArray, ramp: float, max_step_down: float) -> bool:
    """Whether neighbouring steps are an edge that is wide enough, and no descent.

    `unseen` are its ranges in blind sectors [m], and `ramp` is the slope of the steepest ramp.
    """
    near, is_strong = steps.near, steps.fall > max_step_down
    # The same fall on the shortest way over the edge.
    is_steep = steps.slope * near > ramp * np.minimum(near, unseen.min(initial=np.inf))
    n_certain = np.count_nonzero(is_strong & is_steep & ~steps.is_on_slope)
    return bool(
        2.0 * math.pi / SECTORS * (near.sum() + unseen.sum()) >= MIN_WIDTH
        and n_certain >= MIN_STEPS
        and np.count_nonzero(is_strong) >= MIN_STRONG * len(near)
    )
