"""The passes over all points that lead to labels, compiled; twins in `faces`, `labelling`."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from gp_ground_seg.compiled import compiled
from gp_ground_seg.labelling import SQUARE_UNITS
from gp_ground_seg.labels import Label
from gp_ground_seg.point_passes import CellArray
from gp_ground_seg.polar_grid import NOT_FINITE, OUTSIDE, FloatArray, IntArray

BoolArray = npt.NDArray[np.bool_]

# Plain integers: compiled code knows no enumerations.
_UNKNOWN, _GROUND, _OBSTACLE = int(Label.UNKNOWN), int(Label.GROUND), int(Label.OBSTACLE)
N_SUMS = 10
"""Sums per tile: number, x, y, z and their six products."""


@compiled
def assign_tiles(
    xyz: FloatArray,
    cell: CellArray,
    half: float,
    per_metre: float,
    side: int,
    tile: CellArray,
    foot_z: FloatArray,
) -> None:
    """Tile of each point, and the lowest height of each tile into a table of infinities."""
    held = np.uintp(0)
    low = foot_z[0]
    for i in range(len(cell)):
        if cell[i] < 0:
            tile[i] = OUTSIDE
            continue
        column = min(int((xyz[i, 0] + half) * per_metre), side - 1)
        row = min(int((xyz[i, 1] + half) * per_metre), side - 1)
        own = np.uintp(column * side + row)
        tile[i] = own
        if own != held:
            foot_z[held] = low
            held = own
            low = foot_z[held]
        low = min(low, xyz[i, 2])
    foot_z[held] = low


@compiled
def mark_tall(
    start: int,
    stop: int,
    xyz: FloatArray,
    tile: CellArray,
    foot_z: FloatArray,
    min_height: float,
    max_height: float,
    tall: BoolArray,
) -> None:
    """Mark the tiles with returns well above the lowest; threads only ever write True."""
    for i in range(start, stop):
        if tile[i] != OUTSIDE:
            own = np.uintp(tile[i])
            above_foot = xyz[i, 2] - foot_z[own]
            if min_height < above_foot <= max_height:
                tall[own] = True


@compiled
def judge_faces(
    xyz: FloatArray,
    tile: CellArray,
    foot_z: FloatArray,
    tall: BoolArray,
    max_height: float,
    max_normal_z: float,
    fewest_returns: int,
    is_face: BoolArray,
) -> None:
    """Do what `gp_ground_seg.faces.find_faces` does with the tall tiles."""
    slot = np.empty(len(tall), dtype=np.int32)
    n_tall = 0
    for k in range(len(tall)):
        if tall[k]:
            slot[k] = n_tall
            n_tall += 1
    sums = np.zeros((n_tall, N_SUMS))
    # Sums about a point of the tile: about the sensor, rounding would eat the scatter.
    origin = np.zeros((n_tall, 3))
    for i in range(len(tile)):
        own = tile[i]
        if own == OUTSIDE or not tall[own] or xyz[i, 2] - foot_z[own] > max_height:
            continue
        k = slot[own]
        if sums[k, 0] == 0.0:
            origin[k, 0], origin[k, 1], origin[k, 2] = xyz[i, 0], xyz[i, 1], foot_z[own]
        x, y, z = xyz[i, 0] - origin[k, 0], xyz[i, 1] - origin[k, 1], xyz[i, 2] - origin[k, 2]
        sums[k, 0] += 1.0
        sums[k, 1] += x
        sums[k, 2] += y
        sums[k, 3] += z
        sums[k, 4] += x * x
        sums[k, 5] += y * y
        sums[k, 6] += z * z
        sums[k, 7] += x * y
        sums[k, 8] += x * z
        sums[k, 9] += y * z
    for t in range(len(tall)):
        if not tall[t]:
            continue
        s = sums[slot[t]]
        n = s[0]
        if n < fewest_returns:
            continue
        xx, yy, zz = s[4] - s[1] * s[1] / n, s[5] - s[2] * s[2] / n, s[6] - s[3] * s[3] / n
        xy, xz, yz = s[7] - s[1] * s[2] / n, s[8] - s[1] * s[3] / n, s[9] - s[2] * s[3] / n
        vertical = max(xx * yy - xy * xy, 0.0)
        trace = vertical + max(yy * zz - yz * yz, 0.0) + max(xx * zz - xz * xz, 0.0)
        is_face[t] = trace > 0.0 and math.sqrt(vertical / trace) <= max_normal_z


@compiled
def survey_heights(
    share: int,
    start: int,
    stop: int,
    xyz: FloatArray,
    cell: CellArray,
    r: FloatArray,
    tile: CellArray,
    is_face: BoolArray,
    near: FloatArray,
    level: FloatArray,
    slope: FloatArray,
    min_height: float,
    max_height: float,
    height: FloatArray,
    number: IntArray,
    squares: IntArray,
    stands: BoolArray,
) -> None:
    """Heights of some points over the surface; sums for the roughness; what stands in a bin.

    Points `start` to `stop`, summed up in tables ``[share]``. Squares are summed in
    whole numbers: the sum does not depend on its order, nor on the number of threads.
    `near`, `level` and `slope` are the cells' near ends and the surface's pieces there.
    """
    for i in range(start, stop):
        if cell[i] < 0:
            height[i] = np.nan
            continue
        own = np.uintp(cell[i])
        h = xyz[i, 2] - (level[own] + slope[own] * max(r[i] - near[own], 0.0))
        height[i] = h
        if h >= min_height:
            if h <= max_height:
                stands[share, own] = True
        elif h >= -min_height and not is_face[np.uintp(tile[i])]:
            number[share, own] += 1
            squares[share, own] += int(h * h * SQUARE_UNITS + 0.5)


@compiled
def label_by_height(
    start: int,
    stop: int,
    xyz: FloatArray,
    cell: CellArray,
    tile: CellArray,
    height: FloatArray,
    is_face: BoolArray,
    foot_z: FloatArray,
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
            over_foot = max(height[i], xyz[i, 2] - foot_z[np.uintp(tile[i])])
            own = min(own, face_tolerance - over_foot)
        margin[i] = own
        label[i] = _GROUND if own >= 0.0 else _OBSTACLE
