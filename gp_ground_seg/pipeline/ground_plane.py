"""The plane of the ground around the sensor, from the lowest points of one scan."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from gp_ground_seg.frame import FloatArray, IntArray
from gp_ground_seg.jit import compiled
from gp_ground_seg.pipeline.low_cells import N_SECTORS, LowCells

NEAR, ENOUGH_NEAR = 8.0, 12
"""Range within which the ground tells the height, if it has so many cells [m]: kerbs and verges
lift or lower the plane as a whole."""
FAR = 10.0
"""Range that the ground reaches outdoors, and walls and ceilings of rooms seldom [m]."""
MIN_HEIGHT, MAX_HEIGHT = 0.05, 20.0
"""Heights of the sensor over a plane that can be the ground [m]."""
CLEARLY_BELOW = 2.0
"""Distance below the plane, in tolerances, from which a cell speaks against it."""
PENALTY = 1.0
"""What a cell clearly below the plane takes from its score: of a street and the roofs of cars,
or of a floor and tables, the ground is the lower one."""

N_TRIPLES = 192
"""Planes tried through three cells each."""
N_LEVEL = 64
"""Level planes tried, at most."""
MIN_AREA = 0.1
"""Twice the area, seen from above, from which three cells make a plane [m^2]."""
LOOSER = 1.1
"""How much steeper than what was looked for a refined plane may be."""
RESOLUTION = 4096.0
"""Score of a cell right on a plane; scores of cells are whole numbers."""
N_REFINEMENTS = 12
MIN_CELLS = 3


@dataclass(frozen=True)
class GroundPlane:
    """The plane z = -height + slope_x x + slope_y y.

    Attributes
    ----------
    height : float
        How far below the sensor it is, along z [m].
    slope_x, slope_y : float
        Rise per metre.
    near_height : float
        The same as `height` for the parallel plane through the middle of the near cells [m].
    support : float
        Share of the cells that lie on it, in [0, 1].
    coverage : float
        Share of all sectors around the sensor with such a cell, in [0, 1].
    far_coverage : float
        Share of the sectors with any cell that have such a cell `FAR` away, in [0, 1].
    reach : float
        Range within which nine of ten of these cells are [m].
    spread : float
        Difference of the angles of depression of these cells [rad], a tenth of them left out
        at either end: the lowest beam alone, on walls, makes a cone that looks like a plane.
    residual : float
        Root mean square of the distances along z of these cells to it [m].
    n_cells, n_support : int
        How many cells there were, and how many lie on it.
    """

    height: float
    slope_x: float
    slope_y: float
    near_height: float
    support: float
    coverage: float
    far_coverage: float
    reach: float
    spread: float
    residual: float
    n_cells: int
    n_support: int

    @property
    def normal(self) -> tuple[float, float, float]:
        """Unit normal that points to the sensor's side."""
        length = math.sqrt(self.slope_x**2 + self.slope_y**2 + 1.0)
        return -self.slope_x / length, -self.slope_y / length, 1.0 / length

    @property
    def up(self) -> FloatArray:
        """The same as an array, (3,)."""
        return np.array(self.normal)


def find_plane(cells: LowCells, max_slope: float) -> GroundPlane | None:
    """Find the plane that most cells lie on and few below; None if there is none.

    Consensus (Fischler & Bolles, CACM 1981) over planes through a fixed, evenly spread
    choice of three cells and level planes through one, then a redescending M-estimator
    (Beaton & Tukey, Technometrics 1974) from the best of them.

    Parameters
    ----------
    cells : LowCells
        Where the ground may be.
    max_slope : float
        Steepest plane to look for, as rise per metre.
    """
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
        # Nothing holds the refined plane: what was found is no ground.
        height, slope_x, slope_y = best
    return _describe(cells, float(height), float(slope_x), float(slope_y))


def _describe(
    cells: LowCells, height: float, slope_x: float, slope_y: float
) -> GroundPlane | None:
    """Plane with what speaks for it; None if no cell lies on it."""
    distance = cells.z - (slope_x * cells.x + slope_y * cells.y - height)
    on_it = np.abs(distance) <= cells.tolerance
    n_on_it = int(np.count_nonzero(on_it))
    if n_on_it == 0:
        return None
    r, sector = cells.r[on_it], cells.sector[on_it]
    drop = np.sort(-cells.z[on_it] / r)
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
        spread=math.atan(drop[most]) - math.atan(drop[few]),
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


def _hypotheses(cells: LowCells, max_slope: float) -> FloatArray:
    """Planes that may be the ground, (H, 3): height, slope_x, slope_y."""
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


def _score(planes: FloatArray, cells: LowCells) -> npt.NDArray[np.int64]:
    """Support less penalty of each plane, (H,); in whole numbers, which add up in any order."""
    height, slope_x, slope_y = (column[:, None] for column in planes.T)
    # Times the inverse, as the twin does it: even the last bit of a score is the same.
    d = (cells.z - (slope_x * cells.x + slope_y * cells.y - height)) * (1.0 / cells.tolerance)
    gain = np.where(np.abs(d) < 1.0, RESOLUTION * (1.0 - d * d), 0.0).astype(np.int64)
    loss = np.where(d < -CLEARLY_BELOW, int(PENALTY * RESOLUTION), 0)
    total: npt.NDArray[np.int64] = (gain - loss).sum(axis=1)
    return total


def _refine(plane: FloatArray, cells: LowCells) -> tuple[float, float, float]:
    """Weighted least squares with Tukey's weights of the plane before, again and again."""
    height, slope_x, slope_y = plane
    x, y, z, tolerance = cells.x, cells.y, cells.z, cells.tolerance
    for _ in range(N_REFINEMENTS):
        d = (z - (slope_x * x + slope_y * y - height)) / tolerance
        weight = np.maximum(1.0 - 0.5 * d * d, 0.0) ** 2 / tolerance**2
        columns = 1.0, x, y, x * x, x * y, y * y, z, x * z, y * z
        w, wx, wy, wxx, wxy, wyy, wz, wxz, wyz = (float(np.sum(weight * v)) for v in columns)
        height, slope_x, slope_y = solve_plane(
            w, wx, wy, wxx, wxy, wyy, wz, wxz, wyz, height, slope_x, slope_y
        )
    return height, slope_x, slope_y


@compiled
def solve_plane(
    w: float,
    wx: float,
    wy: float,
    wxx: float,
    wxy: float,
    wyy: float,
    wz: float,
    wxz: float,
    wyz: float,
    height: float,
    slope_x: float,
    slope_y: float,
) -> tuple[float, float, float]:
    """Plane of least squares from weighted moments; the one given where they do not fix it."""
    if w <= 0.0:
        return height, slope_x, slope_y
    mx, my, mz = wx / w, wy / w, wz / w
    cxx, cxy, cyy = wxx / w - mx * mx, wxy / w - mx * my, wyy / w - my * my
    cxz, cyz = wxz / w - mx * mz, wyz / w - my * mz
    determinant = cxx * cyy - cxy * cxy
    if determinant > 1e-3:
        slope_x = (cxz * cyy - cyz * cxy) / determinant
        slope_y = (cyz * cxx - cxz * cxy) / determinant
    # Too narrow to tell the slopes: the height alone.
    return slope_x * mx + slope_y * my - mz, slope_x, slope_y
