"""The passes over all points that lead to labels, compiled; twins in `faces`, `labelling`."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from gp_ground_seg.compiled import compiled, inlined
from gp_ground_seg.hidden_feet import hides_foot_compiled
from gp_ground_seg.labelling import SQUARE_UNITS
from gp_ground_seg.labels import Label
from gp_ground_seg.polar_grid import NOT_FINITE, OUTSIDE, FloatArray, IntArray, PointArray
from gp_ground_seg.rulers import CellArray

BoolArray = npt.NDArray[np.bool_]

# Plain integers: compiled code knows no enumerations.
_UNKNOWN, _GROUND, _OBSTACLE = int(Label.UNKNOWN), int(Label.GROUND), int(Label.OBSTACLE)
# Of each tall tile two rows of sums, its lowest returns and those above: number, x, y, z, their
# squares, x y, x z, y z; the highest. Then, in the first row, where x, y and z are counted from.
_TOP, _ORIGIN_X, _ORIGIN_Y, _FOOT = 10, 11, 12, 13
N_COLUMNS = 14
SKIPPED = -1
"""Slot of a tile that has nothing tall."""


@compiled
def judge_faces(
    columns: PointArray,
    tile: CellArray,
    extremes: PointArray,
    touched: CellArray,
    tile_size: float,
    min_height: float,
    max_height: float,
    max_normal_z: float,
    fewest_returns: int,
    tolerance: float,
    max_foot_distance: float,
    max_foot_density: float,
    slots: CellArray,
    sums: FloatArray,
    is_face: BoolArray,
    is_footless: BoolArray,
) -> None:
    """Do what `gp_ground_seg.faces.find_faces` does.

    `slots` (2 T,) and `sums` (2 T, N_COLUMNS) are room to work in.
    """
    n_slots = _take_tall(extremes, touched, tile_size, min_height, slots, sums)
    for i in range(len(tile)):
        if tile[i] == OUTSIDE:
            continue
        k = slots[np.uintp(tile[i])]
        if k == SKIPPED:
            continue
        low = sums[np.uintp(k)]
        z = np.float64(columns[2, i]) - low[_FOOT]
        if z > max_height:
            continue
        x = np.float64(columns[0, i]) - low[_ORIGIN_X]
        y = np.float64(columns[1, i]) - low[_ORIGIN_Y]
        # No branch: whether a return is one of the lowest is anybody's guess.
        s = sums[np.uintp(k + np.int32(z > tolerance))]
        s[0] += 1.0
        s[1] += x
        s[2] += y
        s[3] += z
        s[4] += x * x
        s[5] += y * y
        s[6] += z * z
        s[7] += x * y
        s[8] += x * z
        s[9] += y * z
        s[_TOP] = max(s[_TOP], z)
    s = np.empty(N_COLUMNS)
    for slot in range(n_slots):
        t = slots[len(extremes) + slot]
        low, high = sums[2 * slot], sums[2 * slot + 1]
        for c in range(_TOP):
            s[c] = low[c] + high[c]
        n, top = s[0], max(low[_TOP], high[_TOP])
        if top <= min_height or n < fewest_returns:
            continue
        xx, yy, zz = s[4] - s[1] * s[1] / n, s[5] - s[2] * s[2] / n, s[6] - s[3] * s[3] / n
        xy, xz, yz = s[7] - s[1] * s[2] / n, s[8] - s[1] * s[3] / n, s[9] - s[2] * s[3] / n
        vertical = max(xx * yy - xy * xy, 0.0)
        trace = vertical + max(yy * zz - yz * yz, 0.0) + max(xx * zz - xz * xz, 0.0)
        if trace > 0.0 and math.sqrt(vertical / trace) <= max_normal_z:
            is_face[t] = True
            is_footless[t] = hides_foot_compiled(
                low, high, top, tolerance, max_foot_distance, max_foot_density
            )


@inlined
def _take_tall(
    extremes: PointArray,
    touched: CellArray,
    tile_size: float,
    min_height: float,
    slots: CellArray,
    sums: FloatArray,
) -> int:
    """Make room for the sums of every tall tile; their number.

    Sums are taken about a point of the tile: about the sensor, rounding would eat the
    scatter.
    """
    n_slots = 0
    n_sides = int(math.sqrt(len(extremes)))
    half = 0.5 * n_sides * tile_size
    for own in touched:
        t = np.uintp(own)
        foot = np.float64(extremes[t, 0])
        is_tall = np.float64(extremes[t, 1]) - foot > min_height
        if not is_tall:
            slots[t] = SKIPPED
            continue
        slots[t] = 2 * n_slots
        slots[len(extremes) + n_slots] = own
        for row in (2 * n_slots, 2 * n_slots + 1):
            sums[row] = 0.0
        sums[2 * n_slots, _ORIGIN_X] = (own // n_sides) * tile_size - half
        sums[2 * n_slots, _ORIGIN_Y] = (own % n_sides) * tile_size - half
        sums[2 * n_slots, _FOOT] = foot
        n_slots += 1
    return n_slots


@compiled
def level_and_slope(knots: FloatArray, mean: FloatArray, pieces: FloatArray) -> None:
    """Surface in each cell as ``pieces[k, 0] + pieces[k, 1] * r``; NaN in the last row.

    Parameters
    ----------
    knots : (K,) float64
        Ranges of the knots [m].
    mean : (M, K) float64
        Height at the knots, linear between them [m].
    pieces : (M * (K - 1) + 1, 2) float64
        Result; the last row is for the points of no cell.
    """
    n_bins = len(knots) - 1
    for m in range(len(mean)):
        for n in range(n_bins):
            slope = (mean[m, n + 1] - mean[m, n]) / (knots[n + 1] - knots[n])
            pieces[m * n_bins + n, 0] = mean[m, n] - slope * knots[n]
            pieces[m * n_bins + n, 1] = slope
    pieces[len(pieces) - 1] = np.nan


@compiled
def survey_heights(
    share: int,
    start: int,
    stop: int,
    columns: PointArray,
    cell: CellArray,
    r: PointArray,
    tile: CellArray,
    is_face: BoolArray,
    pieces: FloatArray,
    nearest: float,
    min_height: float,
    max_height: float,
    height: FloatArray,
    sums: IntArray,
) -> None:
    """Heights of some points over the surface; sums for the roughness; what stands in a bin.

    Points `start` to `stop`, summed up in tables ``[share]``, which start empty and have a
    last row for points of no cell: number, squares, whether an obstacle stands there.
    Squares are summed in whole numbers: the sum does not depend on its order, nor on the
    number of threads. For `pieces` see `level_and_slope`; nearer than `nearest` the
    surface is level.
    """
    own_sums = sums[share]
    own_sums[:] = 0
    for i in range(start, stop):
        own = np.uintp(cell[i] if cell[i] >= 0 else len(pieces) - 1)
        away = max(np.float64(r[i]), nearest)
        h = np.float64(columns[2, i]) - (pieces[own, 0] + pieces[own, 1] * away)
        height[i] = h
        if h >= min_height:
            if h <= max_height:
                own_sums[own, 2] = 1
        elif h >= -min_height and not is_face[np.uintp(tile[i])]:
            own_sums[own, 0] += 1
            own_sums[own, 1] += int(h * h * SQUARE_UNITS + 0.5)


@compiled
def bands(
    sums: IntArray,
    ground_tolerance: float,
    roughness_gain: float,
    obstacle_tolerance: float,
    obstacle_roughness_gain: float,
    obstacle_min_height: float,
    roughness: FloatArray,
    band: FloatArray,
) -> None:
    """Do what `labelling.root_mean_square` and `labelling.band` do, of the sums of all shares.

    Parameters
    ----------
    sums : (shares, M * n_bins + 1, 3) int64
        What `survey_heights` found; the first share becomes the sum of all.
    ground_tolerance, roughness_gain, obstacle_tolerance, obstacle_roughness_gain : float
        Tolerances, see `gp_ground_seg.config.LabelConfig`.
    obstacle_min_height : float
        Widest band [m].
    roughness : (M, n_bins) float64
        Result [m].
    band : (M * n_bins + 1,) float64
        Result [m]; the last is NaN.
    """
    n_segments, n_bins = roughness.shape
    total = sums[0]
    for share in range(1, len(sums)):
        for k in range(n_segments * n_bins):
            for c in range(3):
                total[k, c] += sums[share, k, c]
    ring = np.empty((n_bins + 2, 2))
    ring[0] = ring[n_bins + 1] = 0.0
    for m in range(n_segments):
        before = (m - 1 if m > 0 else n_segments - 1) * n_bins
        after = (m + 1 if m + 1 < n_segments else 0) * n_bins
        for n in range(n_bins):
            own = m * n_bins + n
            for c in range(2):
                ring[n + 1, c] = total[before + n, c] + total[own, c] + total[after + n, c]
        for n in range(n_bins):
            number = ring[n, 0] + ring[n + 1, 0] + ring[n + 2, 0]
            squares = ring[n, 1] + ring[n + 1, 1] + ring[n + 2, 1]
            own_roughness = math.sqrt(squares / (SQUARE_UNITS * max(number, 1.0)))
            free = ground_tolerance + roughness_gain * own_roughness
            if total[m * n_bins + n, 2] > 0:
                free = min(free, obstacle_tolerance + obstacle_roughness_gain * own_roughness)
            roughness[m, n] = own_roughness
            band[m * n_bins + n] = min(free, obstacle_min_height)
    band[len(band) - 1] = np.nan


@compiled
def label_by_height(
    start: int,
    stop: int,
    columns: PointArray,
    cell: CellArray,
    tile: CellArray,
    height: FloatArray,
    is_face: BoolArray,
    is_footless: BoolArray,
    tile_extremes: PointArray,
    band: FloatArray,
    below_tolerance: float,
    face_tolerance: float,
    label: npt.NDArray[np.uint8],
    margin: FloatArray,
) -> None:
    """Do what `gp_ground_seg.labelling.label_points` does for points `start` to `stop`."""
    for i in range(start, stop):
        n, h = cell[i], height[i]
        # The last row of the band is NaN, for the points of no cell.
        own = min(band[np.uintp(n if n >= 0 else len(band) - 1)] - h, h + below_tolerance)
        t = np.uintp(tile[i] if n >= 0 else 0)
        if is_face[t]:
            over_foot = max(h, np.float64(columns[2, i]) - np.float64(tile_extremes[t, 0]))
            reach = -face_tolerance if is_footless[t] else face_tolerance
            own = min(own, reach - over_foot)
        margin[i] = own
        label[i] = _GROUND if own >= 0.0 else (_UNKNOWN if n == NOT_FINITE else _OBSTACLE)
