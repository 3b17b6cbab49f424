"""The passes over all points that lead to labels, compiled; twins in `faces`, `labelling`."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from gp_ground_seg.compiled import compiled
from gp_ground_seg.hidden_feet import hides_foot_compiled
from gp_ground_seg.labelling import SQUARE_UNITS
from gp_ground_seg.labels import Label
from gp_ground_seg.point_passes import CellArray
from gp_ground_seg.polar_grid import NOT_FINITE, OUTSIDE, FloatArray, IntArray, PointArray

BoolArray = npt.NDArray[np.bool_]

# Plain integers: compiled code knows no enumerations.
_UNKNOWN, _GROUND, _OBSTACLE = int(Label.UNKNOWN), int(Label.GROUND), int(Label.OBSTACLE)
# Columns of what is known of a tile: sums (number, x, y, z and their six products; the six
# of the lowest returns; the highest), a point of it, its number, whether it is tall.
_ORIGIN_X, _ORIGIN_Y, _TILE, _IS_TALL = 17, 18, 19, 20
N_COLUMNS = 21
SKIPPED = -1
"""Slot of a tile that has nothing tall, or is another thread's."""


@compiled
def judge_faces(
    start: int,
    _stop: int,
    step: int,
    columns: PointArray,
    tile: CellArray,
    extremes: PointArray,
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
    """Do what `gp_ground_seg.faces.find_faces` does with every `step`-th tile.

    A tile's sums are taken by one thread in the order of the points: they do not
    depend on the number of threads. `slots` (step, T) and `sums` (step, T, N_COLUMNS)
    are room to work in.
    """
    n_slots = 0
    own_slots, own_sums = slots[start], sums[start]
    own_slots[:] = 0
    for i in range(len(tile)):
        if tile[i] == OUTSIDE:
            continue
        own = np.uintp(tile[i])
        k = own_slots[own]
        if k == SKIPPED:
            continue
        foot = np.float64(extremes[own, 0])
        if k == 0:
            if tile[i] % step != start or np.float64(extremes[own, 1]) - foot <= min_height:
                own_slots[own] = SKIPPED
                continue
            n_slots += 1
            own_slots[own] = k = n_slots
            own_sums[k - 1] = 0.0
            # Sums about a point of the tile: about the sensor, rounding would eat the scatter.
            own_sums[k - 1, _ORIGIN_X] = columns[0, i]
            own_sums[k - 1, _ORIGIN_Y] = columns[1, i]
            own_sums[k - 1, _TILE] = tile[i]
        s = own_sums[k - 1]
        z = np.float64(columns[2, i]) - foot
        if z > max_height:
            continue
        if z > min_height:
            s[_IS_TALL] = 1.0
        x, y = np.float64(columns[0, i]) - s[_ORIGIN_X], np.float64(columns[1, i]) - s[_ORIGIN_Y]
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
        if z <= tolerance:
            s[10] += 1.0
            s[11] += x
            s[12] += y
            s[13] += x * x
            s[14] += y * y
            s[15] += x * y
        s[16] = max(s[16], z)
    for k in range(n_slots):
        s = own_sums[k]
        n = s[0]
        if s[_IS_TALL] == 0.0 or n < fewest_returns:
            continue
        xx, yy, zz = s[4] - s[1] * s[1] / n, s[5] - s[2] * s[2] / n, s[6] - s[3] * s[3] / n
        xy, xz, yz = s[7] - s[1] * s[2] / n, s[8] - s[1] * s[3] / n, s[9] - s[2] * s[3] / n
        vertical = max(xx * yy - xy * xy, 0.0)
        trace = vertical + max(yy * zz - yz * yz, 0.0) + max(xx * zz - xz * xz, 0.0)
        if trace > 0.0 and math.sqrt(vertical / trace) <= max_normal_z:
            own_tile = int(s[_TILE])
            is_face[own_tile] = True
            is_footless[own_tile] = hides_foot_compiled(
                s, tolerance, max_foot_distance, max_foot_density
            )


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
    min_height: float,
    max_height: float,
    height: FloatArray,
    sums: IntArray,
    stands: BoolArray,
) -> None:
    """Heights of some points over the surface; sums for the roughness; what stands in a bin.

    Points `start` to `stop`, summed up in tables ``[share]``. Squares are summed in
    whole numbers: the sum does not depend on its order, nor on the number of threads.
    `pieces` are the cells' near ends, and level and slope of the surface from there.
    """
    for i in range(start, stop):
        if cell[i] < 0:
            height[i] = np.nan
            continue
        own = np.uintp(cell[i])
        h = np.float64(columns[2, i]) - (
            pieces[own, 1] + pieces[own, 2] * max(np.float64(r[i]) - pieces[own, 0], 0.0)
        )
        height[i] = h
        if h >= min_height:
            if h <= max_height:
                stands[share, own] = True
        elif h >= -min_height and not is_face[np.uintp(tile[i])]:
            sums[share, own, 0] += 1
            sums[share, own, 1] += int(h * h * SQUARE_UNITS + 0.5)


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
        n = cell[i]
        if n < 0:
            margin[i] = np.nan
            label[i] = _UNKNOWN if n == NOT_FINITE else _OBSTACLE
            continue
        own = min(band[np.uintp(n)] - height[i], height[i] + below_tolerance)
        if is_face[np.uintp(tile[i])]:
            over_foot = max(
                height[i],
                np.float64(columns[2, i]) - np.float64(tile_extremes[np.uintp(tile[i]), 0]),
            )
            reach = -face_tolerance if is_footless[np.uintp(tile[i])] else face_tolerance
            own = min(own, reach - over_foot)
        margin[i] = own
        label[i] = _GROUND if own >= 0.0 else _OBSTACLE
