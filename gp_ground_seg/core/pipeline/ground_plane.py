"""Stage 2: the plane of the ground around the sensor, from the lowest points of one scan."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from gp_ground_seg.core.frame import Candidates, FloatArray, IntArray
from gp_ground_seg.core.parameters.config import SENSOR_HEIGHTS
from gp_ground_seg.core.pipeline.tilt import Direction

N_SECTORS = 36
NEAREST, FARTHEST = 0.5, 40.0
"""Horizontal ranges of the points that the plane is fitted to [m]: nearer there is the vehicle
itself, farther the ground may curve."""
RING_RATIO = 1.25
"""Outer over inner radius of a ring: the weight of a cell does not depend on the height of the
sensor, and near ground weighs more than far."""
TOLERANCE, TOLERANCE_GROWTH = 0.08, 0.015
"""Distance to a plane that a point still supports [m], and its growth with range: noise,
kerbs and camber bring ground off a plane."""
MAX_Z = 65.0
"""Height above or below the sensor from which a point is not the ground near it [m]."""

N_RINGS = math.ceil(math.log(FARTHEST / NEAREST) / math.log(RING_RATIO))
RING_EDGES = NEAREST * RING_RATIO ** np.arange(N_RINGS + 1.0)
_NONE = -1

NEAR, ENOUGH_NEAR = 8.0, 12
"""Range [m] and least number of the points that the height is measured at: kerbs and verges
lift or lower the plane as a whole."""
FAR = 10.0
"""Range that the ground reaches outdoors, and walls and ceilings of rooms seldom [m]."""
MIN_HEIGHT, MAX_HEIGHT = SENSOR_HEIGHTS
"""Heights of the origin over a plane that can be the ground [m]; in the frame of a vehicle the
ground may lie above it."""
CLEARLY_BELOW = 2.0
"""Distance below the plane, in tolerances, from which a point is evidence against it."""
PENALTY = 1.0
"""Loss of score for each point clearly below the plane: of a street and the roofs of cars,
or of a floor and tables, the ground is the lower one."""

N_TRIPLES = 192
"""Planes tried through three cells each."""
N_LEVEL = 64
"""Level planes tried, at most."""
MIN_AREA = 0.1
"""Twice the area, seen from above, from which three cells make a plane [m^2]."""
LOOSER = 1.1
"""Largest slope of a refined plane over that of the hypotheses."""
RESOLUTION = 4096.0
"""Score of a point exactly on a plane; scores are whole numbers, whose sum is exact."""
N_REFINEMENTS = 12
MIN_CELLS = 3


class LowestPoints(NamedTuple):
    """Lowest point of each occupied cell: sectors by rings, rings wider the farther they are."""

    x: FloatArray  # (C,) [m]
    y: FloatArray  # (C,) [m]
    z: FloatArray  # (C,) along the axis that is taken to be up [m]
    r: FloatArray  # (C,) horizontal range [m]
    tolerance: FloatArray  # (C,) distance to the plane that the point still supports [m]
    sector: IntArray  # (C,) sector of each cell, 0 to `N_SECTORS` - 1


@lru_cache(maxsize=4)
def segment_directions(n_segments: int) -> FloatArray:
    """Cosine and sine of the azimuth of the middle of each segment, (2, n_segments)."""
    azimuth = (np.arange(n_segments) + 0.5) * (2.0 * np.pi / n_segments) - np.pi
    table = np.stack([np.cos(azimuth), np.sin(azimuth)])
    table.setflags(write=False)
    return table


def lowest_points(candidates: Candidates) -> LowestPoints:
    """Lowest ground candidate of each cell, in sectors by rings.

    Of equally low ones the nearest counts, then that of the first segment, so that the
    order of the points does not matter. A point's azimuth is taken to be that of the middle of
    its segment.
    """
    lowest = _lowest(candidates.offsets, candidates.r, candidates.z)
    cell = np.flatnonzero(lowest != _NONE)
    index = lowest[cell]
    segment = np.searchsorted(candidates.offsets, index, side='right') - 1
    cosine, sine = segment_directions(len(candidates.offsets) - 1)
    r = candidates.r[index]
    return LowestPoints(
        x=r * cosine[segment],
        y=r * sine[segment],
        z=candidates.z[index],
        r=r,
        tolerance=TOLERANCE + TOLERANCE_GROWTH * r,
        sector=cell // N_RINGS,
    )


def _lowest(offsets: IntArray, r: FloatArray, z: FloatArray) -> IntArray:
    """Index of the lowest candidate of each cell, sector by sector, or `_NONE`."""
    near = np.flatnonzero((r >= RING_EDGES[0]) & (r < RING_EDGES[-1]) & (np.abs(z) < MAX_Z))
    n_segments = len(offsets) - 1
    segment = np.repeat(np.arange(n_segments), np.diff(offsets))[near]
    ring = np.searchsorted(RING_EDGES, r[near], side='right') - 1
    cell = (segment * N_SECTORS // n_segments) * N_RINGS + ring
    order = np.lexsort((segment, r[near], z[near], cell))
    occupied, first = np.unique(cell[order], return_index=True)
    lowest = np.full(N_SECTORS * N_RINGS, _NONE)
    lowest[occupied] = near[order[first]]
    return lowest


class GroundPlane(NamedTuple):
    """The plane z = -height + slope_x x + slope_y y."""

    height: float  # how far below the origin of the cloud it is, along z [m]
    slope_x: float  # rise per metre
    slope_y: float  # rise per metre
    # as `height`, for the parallel plane through the middle of the near cells [m]
    near_height: float
    support: float  # share of the cells that lie on it
    coverage: float  # share of all sectors around the sensor with such a cell
    far_coverage: float  # share of the sectors with any cell that have such a cell `FAR` away
    reach: float  # range within which nine of ten of these cells are [m]
    # Difference of the angles of depression, seen from the sensor, of these cells [rad], a tenth
    # of them left out at either end: the lowest beam alone, on walls, makes a cone that looks
    # like a plane.
    spread: float
    residual: float  # root mean square of the distances along z of these cells to it [m]
    n_cells: int  # how many cells there were
    n_support: int  # how many of them lie on it

    @property
    def depth(self) -> float:
        """Mean number of cells that lie on it, one behind the other, of the sectors with any."""
        return self.n_support / (self.coverage * N_SECTORS)

    def below(self, x: FloatArray | float, y: FloatArray | float, z: FloatArray | float) -> Any:
        """How far below points it is, along z [m]."""
        return z - (self.slope_x * x + self.slope_y * y - self.height)

    @property
    def normal(self) -> Direction:
        """Upward unit normal."""
        length = math.sqrt(self.slope_x**2 + self.slope_y**2 + 1.0)
        return -self.slope_x / length, -self.slope_y / length, 1.0 / length

    @property
    def up(self) -> FloatArray:
        """The same as an array, (3,)."""
        return np.array(self.normal)


def fit_plane(candidates: Candidates, max_slope: float, origin: Direction) -> GroundPlane | None:
    """Fit the plane that most of the lowest points lie on and few below; None without one.

    Consensus (Fischler & Bolles, CACM 1981) over planes through a fixed, evenly spread
    choice of three cells and level planes through one, then a redescending M-estimator
    (Beaton & Tukey, Technometrics 1974) from the best of them. `max_slope` is that of the
    steepest plane to look for, as rise per metre; `origin` is where the sensor is [m].
    """
    cells = lowest_points(candidates)
    if len(cells.z) < MIN_CELLS:
        return None
    hypotheses = _hypotheses(cells, max_slope)
    if len(hypotheses) == 0:
        return None
    best = hypotheses[int(np.argmax(_score(hypotheses, cells)))]
    height, slope_x, slope_y = _refine(best, cells)
    if not (
        MIN_HEIGHT <= height <= MAX_HEIGHT
        and slope_x * slope_x + slope_y * slope_y <= (LOOSER * max_slope) ** 2
    ):
        # The refinement has drifted off to a plane that cannot be the ground.
        height, slope_x, slope_y = best
    return _describe(cells, (float(height), float(slope_x), float(slope_y)), origin)


def _describe(
    cells: LowestPoints, plane: tuple[float, float, float], origin: Direction
) -> GroundPlane | None:
    """Plane with the evidence for it; None if no point lies on it."""
    height, slope_x, slope_y = plane
    x, y, z = origin
    distance = cells.z - (slope_x * cells.x + slope_y * cells.y - height)
    on_it = np.abs(distance) <= cells.tolerance
    n_on_it = int(np.count_nonzero(on_it))
    if n_on_it == 0:
        return None
    r, sector = cells.r[on_it], cells.sector[on_it]
    away = np.hypot(cells.x[on_it] - x, cells.y[on_it] - y)
    depression = np.sort(np.arctan2(z - cells.z[on_it], away))
    near = np.sort(distance[on_it][r < NEAR])
    few, most = n_on_it // 10, (9 * n_on_it) // 10
    return GroundPlane(
        height=height,
        slope_x=slope_x,
        slope_y=slope_y,
        near_height=height - (float(near[len(near) // 2]) if len(near) >= ENOUGH_NEAR else 0.0),
        support=n_on_it / len(distance),
        coverage=_n_different(sector) / N_SECTORS,
        far_coverage=_n_different(sector[r >= FAR]) / _n_different(cells.sector),
        reach=float(np.sort(r)[most]),
        spread=float(depression[most] - depression[few]),
        residual=float(np.sqrt(np.mean(distance[on_it] ** 2))),
        n_cells=len(distance),
        n_support=n_on_it,
    )


def _n_different(sector: IntArray) -> int:
    return int(np.count_nonzero(np.bincount(sector, minlength=N_SECTORS)))


def _spread(n: int) -> FloatArray:
    """Return n points evenly spread in the unit cube, (n, 3): the additive recurrence R3.

    Its steps are powers of the root of x^4 = x + 1 (Roberts, 2018).
    """
    root = 1.2207440846057596
    steps = root ** -np.arange(1.0, 4.0)
    points: FloatArray = (0.5 + np.arange(1, n + 1)[:, None] * steps) % 1.0
    return points


SPREAD = _spread(N_TRIPLES)
"""Which three cells, as shares of their number, (N_TRIPLES, 3)."""


def _hypotheses(cells: LowestPoints, max_slope: float) -> FloatArray:
    """Planes through three points or level through one, (H, 3): height, slope_x, slope_y."""
    n = len(cells.z)
    level = np.zeros((min(n, N_LEVEL), 3))
    level[:, 0] = -cells.z[np.arange(len(level)) * n // len(level)]
    i, j, k = (SPREAD * n).astype(np.int64).T
    x1, y1, z1 = (v[j] - v[i] for v in (cells.x, cells.y, cells.z))
    x2, y2, z2 = (v[k] - v[i] for v in (cells.x, cells.y, cells.z))
    area = x1 * y2 - x2 * y1
    wide = np.flatnonzero(np.abs(area) > MIN_AREA)
    i, area = i[wide], area[wide]
    slope_x = (z1[wide] * y2[wide] - z2[wide] * y1[wide]) / area
    slope_y = (x1[wide] * z2[wide] - x2[wide] * z1[wide]) / area
    height = slope_x * cells.x[i] + slope_y * cells.y[i] - cells.z[i]
    found = np.concatenate([level, np.column_stack([height, slope_x, slope_y])])
    possible = (
        (found[:, 0] >= MIN_HEIGHT)
        & (found[:, 0] <= MAX_HEIGHT)
        & (found[:, 1] * found[:, 1] + found[:, 2] * found[:, 2] <= max_slope * max_slope)
    )
    kept: FloatArray = found[possible]
    return kept


def _score(planes: FloatArray, cells: LowestPoints) -> IntArray:
    """Support less penalty of each plane, (H,); in whole numbers, which add up in any order."""
    height, slope_x, slope_y = (column[:, None] for column in planes.T)
    # Times the inverse, as the twin does it: even the last bit of a score is the same.
    d = (cells.z - (slope_x * cells.x + slope_y * cells.y - height)) * (1.0 / cells.tolerance)
    gain = np.where(np.abs(d) < 1.0, RESOLUTION * (1.0 - d * d), 0.0).astype(np.int64)
    loss = np.where(d < -CLEARLY_BELOW, int(PENALTY * RESOLUTION), 0)
    total: IntArray = (gain - loss).sum(axis=1)
    return total


def _refine(plane: FloatArray, points: LowestPoints) -> tuple[float, float, float]:
    """Weighted least squares with Tukey's weights of the plane before, again and again."""
    height, slope_x, slope_y = (float(value) for value in plane)
    x, y, z, tolerance = points.x, points.y, points.z, points.tolerance
    columns = np.stack([np.ones(len(x)), x, y, x * x, x * y, y * y, z, x * z, y * z])
    for _ in range(N_REFINEMENTS):
        d = (z - (slope_x * x + slope_y * y - height)) / tolerance
        weight = np.maximum(1.0 - 0.5 * d * d, 0.0) ** 2 / tolerance**2
        w, wx, wy, wxx, wxy, wyy, wz, wxz, wyz = (weight * columns).sum(axis=1).tolist()
        height, slope_x, slope_y = solve_plane(
            (w, wx, wy, wxx, wxy, wyy, wz, wxz, wyz), (height, slope_x, slope_y)
        )
    return height, slope_x, slope_y


def solve_plane(
    moments: tuple[float, float, float, float, float, float, float, float, float],
    plane: tuple[float, float, float],
) -> tuple[float, float, float]:
    """Plane of least squares: height, slope_x, slope_y; `plane` where it is not determined.

    `moments` are the weighted sums of 1, x, y, x x, x y, y y, z, x z and y z.
    """
    w, wx, wy, wxx, wxy, wyy, wz, wxz, wyz = moments
    height, slope_x, slope_y = plane
    if w <= 0.0:
        return height, slope_x, slope_y
    mx, my, mz = wx / w, wy / w, wz / w
    cxx, cxy, cyy = wxx / w - mx * mx, wxy / w - mx * my, wyy / w - my * my
    cxz, cyz = wxz / w - mx * mz, wyz / w - my * mz
    determinant = cxx * cyy - cxy * cxy
    if determinant > 1e-3:
        slope_x = (cxz * cyy - cyz * cxy) / determinant
        slope_y = (cyz * cxx - cxz * cxy) / determinant
    # The points may be too close together to determine the slopes, but not the height.
    return slope_x * mx + slope_y * my - mz, slope_x, slope_y
