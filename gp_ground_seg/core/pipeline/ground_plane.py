"""Stage 2: the plane of the ground around the sensor, from the lowest points of one scan."""

import math
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np

from gp_ground_seg.core.frame import BoolArray, Candidates, FloatArray, IntArray, Values
from gp_ground_seg.core.jit import choose, shared
from gp_ground_seg.core.parameters.config import SENSOR_HEIGHTS
from gp_ground_seg.core.pipeline.lowest_points import (
    N_CELLS,
    N_RINGS,
    N_SECTORS,
    RING_EDGES,
    LowestPoints,
    is_new,
    lowest_points,
    nearness,
)

NEAR, ENOUGH_NEAR = 8.0, 12
"""Range [m] and least number of the points that the height is measured at: kerbs and verges
lift or lower the plane as a whole."""
MIN_HEIGHT, MAX_HEIGHT = SENSOR_HEIGHTS
"""Heights of the origin over a plane that can be the ground [m]; in the frame of a vehicle the
ground may lie above it."""
CLEARLY_OFF = 2.0
"""Distance from a plane, in tolerances, from which a point may be evidence against it."""
LEAST_REACH = 1.5
"""Range to which rays may not cross the ground in any direction [m]: edges of a jetty may be that
near."""
REFUTATION = 8.0
"""Weight of a ray that crosses the plane over that of a point on it at `MIDDLE`."""
APART = 0.3
"""Distance of two levels, at least [m]."""
OTHER_SHARE = 0.1
"""Score of another level, by points off the best one, over that of the best one from which it
counts: little is seen of a path between platforms, or of the top of a dock."""
TIGHT = 0.65
"""Support of another level, over its levelness and the weights of all points within the tolerance,
from which it may be the own one: desks and cars are of many heights."""
OWN = 0.4
"""`asideness` of another level, over that of the best one, below which it is the own one: 0.00 to
0.40 on paths and docks, mostly more of roofs in a jam, and of images below a wet road."""
STRAY = 0.05
"""Share of the points of a level that may lie farther in a direction than it reaches."""
LEVEL, STRAIGHT = 1.15, 0.1
"""Support of a level plane, by that of a tilted one with as many points: where a level one does as
well, the tilt explains nothing. Tilt up to which levels are level [rad]: shelves on one side."""
CLEAR_TILT = 0.045
"""Tilt from which roll and pitch that are auto level the scan [rad]: camber and a vehicle's own
lean stay below it."""

Plane = tuple[float, float, float]
"""Height, slope_x, slope_y: the plane ``z = -height + slope_x x + slope_y y``."""

N_TRIPLES = 192
"""Planes tried through three cells each."""
N_LEVEL = 64
"""Level planes tried, at most."""
RESOLUTION = 4096.0
"""Support by a point at `MIDDLE` exactly on a plane; that of each is a whole number, so that sums
are exact."""
N_FIRST, N_REFINEMENTS = 2, 13
"""Steps of `refine` before planes are scored, and of the best one."""
GRAIN = 2.0**-14
"""Planes are rounded to this before they are scored: the backends differ by less, and so score the
same ones."""
MIN_CELLS = 12
"""Occupied cells from which a scan has a plane."""

AZIMUTHS = np.arange(0.5, 60.0) * (2.0 * np.pi / 60)
"""Normals of the sides of a convex hull: a path that is seen far has narrow hulls."""


class GroundPlane(NamedTuple):
    """The plane z = -height + slope_x x + slope_y y, and how well it is seen."""

    height: float = 0.0  # how far below the sensor it is, along z [m]
    slope_x: float = 0.0  # rise per metre
    slope_y: float = 0.0  # rise per metre
    # as `height`, for the parallel plane through the middle of the near cells [m]
    near_height: float = 0.0
    # share of the cells that lie on it, or on the other level, if there are more
    support: float = 0.0
    coverage: float = 0.0  # share of all sectors around the sensor with such a cell
    reach: float = 0.0  # range within which nine of ten of these cells are [m]
    # angle at which the sensor sees nine of ten of these below the plane through it that is
    # parallel to this one, at most [rad]: on a slope not that below the horizon
    depression: float = 0.0
    # Difference of the angles of depression, seen from the sensor, of these cells [rad], a tenth
    # of them left out at either end: the lowest beam alone, on walls, makes a cone that looks
    # like a plane.
    spread: float = 0.0
    # share of the sectors with any cell whose nearest is clearly over it, and below the sensor
    overhung: float = 0.0
    n_support: int = 0  # how many cells lie on it
    # cells clearly below it, but those that lie alone, for each cell on it: 0 on a road in a jam
    undercut: float = 0.0
    # as `height`, of the parallel level with the next best score [m]; infinite if there is none
    other_height: float = math.inf
    is_below_sensor: bool = False  # whether it is seen as from a sensor at the origin

    def below(self, x: FloatArray | float, y: FloatArray | float, z: FloatArray | float) -> Any:
        """How far below points it is, along z [m]."""
        return distance(x, y, z, self[:3])

    @property
    def normal(self) -> FloatArray:
        """Upward unit normal, (3,)."""
        normal = np.array([-self.slope_x, -self.slope_y, 1.0])
        return normal / math.sqrt(self.slope_x**2 + self.slope_y**2 + 1.0)


def find_planes(
    candidates: Candidates, max_slope: float, fit: Callable[..., Any] | None = None
) -> Iterator[GroundPlane]:
    """Yield planes that many of the lowest points lie on and few rays cross, the best first.

    Consensus (Fischler & Bolles, CACM 1981) over planes through a fixed, evenly spread
    choice of three cells and level planes through one, then a redescending M-estimator
    (Beaton & Tukey, Technometrics 1974) from the best of them. Each after the first is by the
    points that are left. `max_slope` is that of the steepest plane to look for, as rise per
    metre; `fit` is `fit_plane`, compiled.
    """
    cells, find = lowest_points(candidates), fit or fit_plane
    is_left = np.ones(len(cells.z), dtype=np.bool_)
    while (found := GroundPlane(*find(cells, max_slope, is_left))).n_support > 0:
        yield found


STEPS = 1.2207440846057596 ** -np.arange(1.0, 4.0)
SPREAD = (0.5 + np.arange(1, N_TRIPLES + 1)[:, None] * STEPS) % 1.0
"""Which three cells, as shares of their number, (N_TRIPLES, 3): evenly spread in the unit cube, by
the recurrence R3, whose steps are powers of the root of x^4 = x + 1 (Roberts, 2018)."""


@shared
def fit_plane(cells: LowestPoints, max_slope: float, is_left: BoolArray) -> tuple[float, ...]:
    """Fields of the best `GroundPlane` in their order, but the last; `n_support` 0 without one.

    It is chosen by the points that are left, (C,), of which those on it are then taken.
    """
    planes, weight = hypotheses(cells, max_slope), cells.weight * is_left
    first, score, _ = best_of(planes, cells, weight, 0.0)
    plane, other_height = own_level(cells, first, score, max_slope)
    is_left[np.abs(distance(cells.x, cells.y, cells.z, plane) * cells.inverse) <= 1.0] = False
    return described(cells, plane, other_height)


@shared
def own_level(
    cells: LowestPoints, best: Plane, best_score: float, max_slope: float
) -> tuple[Plane, float]:
    """Plane of the level that the robot stands on, and height of another level or infinity.

    It is the plane with the best score, or a parallel one that is not refuted and goes on to where
    the robot stands, as the best one does not. Points that are nearer to a tight other level do
    not refine it; the crests of waves are not tight.
    """
    x, y, z, inverse = cells.x, cells.y, cells.z, cells.inverse
    # Points of the best plane, and those that lie alone, are of no other level.
    d = np.abs(distance(x, y, z, best))
    is_left = (d * inverse > 1.0) & ~cells.is_alone
    weight = cells.weight * is_left
    others = other_levels(best, cells, is_left)
    other, _, support = best_of(others, cells, weight, OTHER_SHARE * best_score)
    from_other = np.abs(distance(x, y, z, other))
    whole = weight[from_other * inverse <= 1.0].sum()
    is_tight = support > TIGHT * RESOLUTION * levelness(other[1], other[2]) * whole
    if is_tight:
        is_own = asideness(cells, other, best) < OWN * asideness(cells, best, other)
        if is_own:
            best, other, d, from_other = other, best, from_other, d
        # What lies below the best plane may be images on a wet road.
        inverse = inverse * ((d <= from_other) | (not is_own and other[0] > best[0]))
    planes = np.array([best, (best[0], 0.0, 0.0)])
    refine(x, y, z, inverse, planes[:1], max_slope, N_REFINEMENTS)
    best = planes[0, 0], planes[0, 1], planes[0, 2]
    if CLEAR_TILT < math.hypot(best[1], best[2]) < STRAIGHT:
        # Low shelves on one side tilt a plane, without more support than a level one has.
        refine(0.0 * x, 0.0 * y, z, inverse, planes[1:], max_slope, N_REFINEMENTS)
        best = best_of(planes, cells, cells.weight, 0.0)[0]
    return best, other[0] if is_tight else math.inf


@shared
def hypotheses(cells: LowestPoints, max_slope: float) -> FloatArray:
    """Level planes through one of the points, and refined ones through three, (P, 3).

    Where little ground is seen, no three points of it may be on its plane. Few points have none.
    """
    n, n_level = len(cells.z), min(len(cells.z), N_LEVEL)
    if n < MIN_CELLS:
        return np.zeros((0, 3))
    height, flat = -cells.z[np.arange(n_level) * n // n_level], np.zeros(n_level)
    level = np.column_stack((height, flat, flat))
    tilted = planes_through(cells, (SPREAD * n).astype(np.int64).T)
    level = level[is_possible(level.T, max_slope)]
    tilted = tilted[is_possible(tilted.T, max_slope)]
    refine(cells.x, cells.y, cells.z, cells.inverse, tilted, max_slope, N_FIRST)
    return np.asarray(np.floor(np.concatenate((level, tilted)) / GRAIN + 0.5) * GRAIN)


@shared
def other_levels(best: Plane, cells: LowestPoints, is_left: BoolArray) -> FloatArray:
    """Planes through some of the points, clearly over or below the best one, (P, 3).

    They are parallel to it, and level if its tilt may come from lying on several levels.
    """
    tilts = np.array([1.0, 0.0])[: 1 + (math.hypot(best[1], best[2]) < STRAIGHT)]
    points = np.flatnonzero(is_left)[:: 1 + len(tilts) * np.count_nonzero(is_left) // N_LEVEL]
    tilt = np.repeat(tilts, len(points))
    points = np.concatenate((points, points))[: len(tilt)]
    slope_x, slope_y = best[1] * tilt, best[2] * tilt
    height = slope_x * cells.x[points] + slope_y * cells.y[points] - cells.z[points]
    may_be = (np.abs(height - best[0]) > APART) & (height > min(best[0], 0.0))
    return np.column_stack((height, slope_x, slope_y))[may_be & (height <= MAX_HEIGHT)]


@shared
def planes_through(cells: LowestPoints, points: IntArray) -> FloatArray:
    """Planes through three `points` each, (3, P), as (P, 3); NaN if they are on a line."""
    i, j, k = points[0], points[1], points[2]
    x1, y1, z1 = cells.x[j] - cells.x[i], cells.y[j] - cells.y[i], cells.z[j] - cells.z[i]
    x2, y2, z2 = cells.x[k] - cells.x[i], cells.y[k] - cells.y[i], cells.z[k] - cells.z[i]
    area = x1 * y2 - x2 * y1
    area[area == 0.0] = np.nan
    slope_x, slope_y = (z1 * y2 - z2 * y1) / area, (x1 * z2 - x2 * z1) / area
    height = slope_x * cells.x[i] + slope_y * cells.y[i] - cells.z[i]
    return np.column_stack((height, slope_x, slope_y))


@shared
def is_possible(plane: Any, max_slope: float) -> Any:
    """Whether a plane can be the ground."""
    height, slope_x, slope_y = plane[0], plane[1], plane[2]
    is_gentle = slope_x * slope_x + slope_y * slope_y <= max_slope * max_slope
    return is_gentle & (height >= MIN_HEIGHT) & (height <= MAX_HEIGHT)


@shared
def asideness(cells: LowestPoints, own: Plane, other: Plane) -> float:
    """How little a level goes on to where the robot stands: 0 to 2.

    It is the share of points of another level that lie in the convex hull of its own and the
    robot: a path has none between it and the platforms on both sides, and lies between these. 1 is
    added if the robot is not in the hull of its own points, and nearer to that of the other ones.
    A point below it counts where its ray crosses it: on roofs between which a road is seen.
    """
    over, inverse = distance(cells.x, cells.y, cells.z, own), cells.inverse
    d = np.abs(over * inverse)
    from_other = np.abs(distance(cells.x, cells.y, cells.z, other) * inverse)
    x, y = crossing_of(cells.x, over, own), crossing_of(cells.y, over, own)
    is_own, is_other = (d <= 1.0) & (d <= from_other), (from_other <= 1.0) & (from_other < d)
    if not (is_own.any() and is_other.any()):
        return 1.0
    is_between, nearest, nearest_other = is_other.copy(), math.inf, math.inf
    for azimuth in AZIMUTHS:
        along = math.cos(azimuth) * x + math.sin(azimuth) * y
        reach, reach_other = reach_of(along[is_own]), reach_of(along[is_other])
        is_between &= along <= max(reach, 0.0)
        nearest, nearest_other = min(nearest, reach), min(nearest_other, reach_other)
    between, whole = cells.weight[is_between].sum(), cells.weight[is_other].sum()
    return float(between / max(whole, 1.0) + (nearest < min(nearest_other, 0.0)))


@shared
def reach_of(along: FloatArray) -> float:
    """How far points reach in a direction, but `STRAY` of them."""
    return float(np.sort(along)[math.ceil((1.0 - STRAY) * (len(along) - 1))])


@shared
def best_of(
    planes: FloatArray, cells: LowestPoints, weight: FloatArray, least: float
) -> tuple[Plane, float, float]:
    """Plane with the best score above `least`, its score, and its support: NaN, 0, 0 without one.

    The score is the support, times the share of it in all evidence. It is at most the support, so
    that few planes need their refutation.
    """
    best, best_score, best_support = (math.nan, math.nan, math.nan), 0.0, 0.0
    left = supports_of(planes, cells, weight)
    while len(left) > 0:
        p = np.argmax(left)
        support = left[p]
        if support <= max(best_score, least):
            break
        plane = (planes[p, 0], planes[p, 1], planes[p, 2])
        score = support * support / (support + refutation_of(plane, cells))
        if score > max(best_score, least):
            best, best_score, best_support = plane, score, support
        left[p] = -1.0
    return best, best_score, best_support


def supports_of(planes: FloatArray, cells: LowestPoints, weight: FloatArray) -> FloatArray:
    """Support of planes (P, 3) by the points near them, (P,)."""
    plane: Any = planes.T[:, :, None]
    support = support_by(cells.x, cells.y, cells.z, cells.inverse, weight, plane)
    supports: FloatArray = levelness(planes[:, 1], planes[:, 2]) * support.sum(axis=1)
    return supports


@shared
def levelness(slope_x: Values, slope_y: Values) -> Values:
    """Fourth power of the cosine of a plane's tilt: a hillside is not better than the valley.

    That of a level plane is `LEVEL`.
    """
    square = 1.0 / (1.0 + slope_x * slope_x + slope_y * slope_y)
    return choose(square == 1.0, LEVEL, square * square)


@shared
def distance(x: Values, y: Values, z: Values, plane: Plane) -> Values:
    """Height of a point over a plane, along z [m]."""
    height, slope_x, slope_y = plane
    return z - (slope_x * x + slope_y * y - height)


@shared
def support_by(
    x: Values, y: Values, z: Values, inverse: Values, weight: Values, plane: Plane
) -> Values:
    """Support of a plane by a point; a whole number, so that sums are exact in any order.

    It is convex in the distance: no plane between two levels has more than both of these.
    """
    near = 1.0 - np.abs(distance(x, y, z, plane) * inverse)
    return np.floor(choose(near > 0.0, RESOLUTION * weight * near * near, 0.0))


@shared
def crossing_of(r: Values, height: Values, plane: Plane) -> Values:
    """Range at which the ray to a point that is so high over a plane crosses it [m].

    A ray on one side of it all the way, as that of a ceiling, is taken to cross it where it ends.
    """
    return r * plane[0] / (plane[0] - np.minimum(height, 0.0)) if plane[0] > 0.0 else r


@shared
def refutation_of(plane: Plane, cells: LowestPoints) -> float:
    """Weight of the rays that cross a plane where it should have stopped them; a whole number.

    These are rays to points clearly below it that do not lie alone. In a sector the plane is taken
    to reach as far as its farthest point, at least `LEAST_REACH`: over the edge of a dike or a
    dock rays pass. A cell with a point on the plane has stopped rays: what crosses there is a
    mirror image on a wet road. Roofs of cars, and tables, are crossed next to the sensor.
    """
    r, cell, height = cells.r, cells.cell, distance(cells.x, cells.y, cells.z, plane)
    is_seen, reach = np.zeros(N_CELLS, dtype=np.bool_), np.full(N_SECTORS, LEAST_REACH)
    sector, is_on = cell // N_RINGS, np.abs(height * cells.inverse) < 1.0
    # The farthest is the last of a sector.
    is_seen[cell[is_on]], reach[sector[is_on]] = True, np.maximum(r[is_on], LEAST_REACH)
    below = np.flatnonzero((height * cells.inverse < -CLEARLY_OFF) & ~cells.is_alone)
    crossing, sector = crossing_of(r[below], height[below], plane), sector[below]
    ring = np.searchsorted(RING_EDGES[1:-1], crossing, side='right')
    counts = (crossing < reach[sector]) & ~is_seen[sector * N_RINGS + ring]
    return float(np.floor(REFUTATION * RESOLUTION * nearness(crossing[counts])).sum())


def refine(
    x: FloatArray, y: FloatArray, z: FloatArray, inverse: FloatArray,
    planes: FloatArray, max_slope: float, n_steps: int,
) -> None:  # fmt: skip
    """Weighted least squares with Tukey's weights of the plane before, again and again.

    Of `planes`, (P, 3), one that drifts off to a plane that cannot be the ground stays as it is.
    """
    plane: Any = planes.T
    for _ in range(n_steps):
        weight = tukey_weight(x, y, z, inverse, plane[:, :, None])
        along_x, along_y = weight * x, weight * y
        flat = weight.sum(axis=1), weight @ x, weight @ y
        square = along_x @ x, along_x @ y, along_y @ y
        moments = (*flat, *square, weight @ z, along_x @ z, along_y @ z)
        plane = np.stack(solve_plane(moments, plane))
    stays = is_possible(plane, max_slope)
    planes[stays] = plane.T[stays]


@shared
def tukey_weight(x: Values, y: Values, z: Values, inverse: Values, plane: Plane) -> Values:
    """Weight of a point by its distance from a plane."""
    d = distance(x, y, z, plane) * inverse
    root = 1.0 - 0.5 * d * d
    root = choose(root > 0.0, root, 0.0) * inverse
    return root * root


@shared
def solve_plane(moments: Any, plane: Any) -> tuple[Values, Values, Values]:
    """Plane of least squares; `plane` where it is not determined.

    `moments` are the weighted sums of 1, x, y, x x, x y, y y, z, x z and y z.
    """
    w, wx, wy, wxx, wxy, wyy, wz, wxz, wyz = moments
    height, slope_x, slope_y = plane
    has_points = w > 0.0
    w = choose(has_points, w, 1.0)
    mx, my, mz = wx / w, wy / w, wz / w
    cxx, cxy, cyy = wxx / w - mx * mx, wxy / w - mx * my, wyy / w - my * my
    cxz, cyz = wxz / w - mx * mz, wyz / w - my * mz
    determinant = cxx * cyy - cxy * cxy
    is_wide = determinant > 1e-3
    determinant = choose(is_wide, determinant, 1.0)
    slope_x = choose(is_wide, (cxz * cyy - cyz * cxy) / determinant, slope_x)
    slope_y = choose(is_wide, (cyz * cxx - cxz * cxy) / determinant, slope_y)
    # The points may be too close together to determine the slopes, but not the height.
    return choose(has_points, slope_x * mx + slope_y * my - mz, height), slope_x, slope_y


@shared
def described(cells: LowestPoints, plane: Plane, other_height: float) -> tuple[float, ...]:
    """Measure how well a plane is seen; return what `fit_plane` does."""
    height, sector, inverse = plane[0], cells.cell // N_RINGS, cells.inverse
    d, is_first = distance(cells.x, cells.y, cells.z, plane), is_new(sector)
    is_over = (d * inverse > CLEARLY_OFF) & (cells.z < 0.0) & is_first
    is_below = (d * inverse < -CLEARLY_OFF) & ~cells.is_alone
    # Floor at the foot of a wall lies alone.
    z = np.where(np.abs(d * inverse) > 1.0, cells.lowest_z, cells.z)
    d = distance(cells.x, cells.y, z, plane)
    is_on = np.abs(d * inverse) <= 1.0
    n = int(np.count_nonzero(is_on))
    if n == 0:
        return *plane, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0, 0.0, other_height
    other = distance(cells.x, cells.y, z, (other_height, plane[1], plane[2]))
    most = max(n, int(np.count_nonzero(np.abs(other * inverse) <= 1.0)))
    d, z, r = d[is_on], z[is_on], cells.r[is_on]
    few, many, near = n // 10, 9 * n // 10, d[r < NEAR]
    drop = np.sort(np.arctan2(-z, r))
    lift = np.sort(near)[len(near) // 2] if len(near) >= ENOUGH_NEAR else 0.0
    coverage = np.count_nonzero(is_new(sector[is_on])) / N_SECTORS
    depression = np.sort(np.arctan2(height - d, r))[many]
    overhung = np.count_nonzero(is_over) / np.count_nonzero(is_first)
    return (
        *plane, height - lift, most / len(cells.z), coverage, np.sort(r)[many], depression,
        drop[many] - drop[few], overhung, n, np.count_nonzero(is_below) / n, other_height,
    )  # fmt: skip
