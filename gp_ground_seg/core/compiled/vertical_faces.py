"""Compiled twin of `gp_ground_seg.core.pipeline.vertical_faces`.

In three calls: `select_tall` lists the tiles with a high return, `sum_returns` sums over the
returns of a part of the points in them, the lowest and those above apart, `decide_faces` decides
from the sums of all parts. Coordinates are rounded so that the sums are exact in any order.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from gp_ground_seg.core.compiled.threads import Part, points_of
from gp_ground_seg.core.frame import OUTSIDE, CellArray, Faces, FloatArray, PointArray, Tiles
from gp_ground_seg.core.jit import jit
from gp_ground_seg.core.parameters.config import FacesConfig, LabelConfig
from gp_ground_seg.core.pipeline.vertical_faces import (
    FLATNESS,
    FOOT_SHARE,
    MIN_RETURNS,
    UNITS_PER_METRE,
)

# Each tall tile has two rows of sums, for the lowest returns and for those above: number, x, y, z,
# their squares, x y, x z, y z; the greatest height. The first row also holds `_TO_UNITS` less
# the origin of x and y, and the origin of z.
_TOP, _TO_UNITS_X, _TO_UNITS_Y, _BASE = 10, 11, 12, 13
N_COLUMNS = 14
NOT_TALL = -1
"""Row of a tile without a tall return."""
# Adding this to a number and subtracting it again leaves whole units.
_TO_UNITS = 1.5 * 2.0**52 / UNITS_PER_METRE


class FaceSums(NamedTuple):
    """Rows of the tall tiles, and their sums.

    Attributes
    ----------
    tile_to_row : (T,) int32
        First of the two rows of each occupied tile, or `NOT_TALL`.
    row_to_tile : (T,) int32
        Tile of each pair of rows.
    sums : (n_parts, rows, N_COLUMNS) float64
        Sums of each part.
    """

    tile_to_row: CellArray
    row_to_tile: CellArray
    sums: FloatArray


@jit(entry=True)
def select_tall(
    tiles: Tiles, label: LabelConfig, tile_to_row: CellArray, row_to_tile: CellArray
) -> int:
    """Give each tall tile its rows (see `FaceSums`); return the number of tall tiles."""
    extremes, n_tall = tiles.extremes, 0
    for tile in tiles.occupied:
        t = np.uintp(tile)
        height = np.float64(extremes[t, 1]) - np.float64(extremes[t, 0])
        if height > label.obstacle_min_height:
            tile_to_row[t] = 2 * n_tall
            row_to_tile[n_tall] = tile
            n_tall += 1
        else:
            tile_to_row[t] = NOT_TALL
    return n_tall


@jit(entry=True)
def sum_returns(
    part: Part,
    columns: PointArray,
    tiles: Tiles,
    tile_size: float,
    label: LabelConfig,
    n_tall: int,
    room: FaceSums,
) -> None:
    """Sum over the returns of a part of the points, (3, N), in tall tiles."""
    sums = room.sums[part.number]
    _clear_sums(tiles.extremes, tile_size, n_tall, room.row_to_tile, sums)
    foot_height, max_height = FOOT_SHARE * label.obstacle_min_height, label.obstacle_max_height
    # Slices, because indices from 0 on need no check for negative ones.
    own = points_of(part, len(tiles.tile))
    x, y, z, tile = columns[0, own], columns[1, own], columns[2, own], tiles.tile[own]
    for i in range(len(tile)):
        if tile[i] == OUTSIDE:
            continue
        k = room.tile_to_row[np.uintp(tile[i])]
        if k == NOT_TALL:
            continue
        low = sums[np.uintp(k)]
        above = np.float64(z[i]) - low[_BASE]
        if above > max_height:
            continue
        dx = (np.float64(x[i]) + low[_TO_UNITS_X]) - _TO_UNITS
        dy = (np.float64(y[i]) + low[_TO_UNITS_Y]) - _TO_UNITS
        dz = (above + _TO_UNITS) - _TO_UNITS
        # No branch: whether a return is one of the lowest is unpredictable.
        s = sums[np.uintp(k + np.int32(above > foot_height))]
        s[0] += 1.0
        s[1] += dx
        s[2] += dy
        s[3] += dz
        s[4] += dx * dx
        s[5] += dy * dy
        s[6] += dz * dz
        s[7] += dx * dy
        s[8] += dx * dz
        s[9] += dy * dz
        s[_TOP] = max(s[_TOP], above)


@jit()
def _clear_sums(
    extremes: PointArray, tile_size: float, n_tall: int, row_to_tile: CellArray, sums: FloatArray
) -> None:
    n_sides = int(math.sqrt(len(row_to_tile)))
    half = 0.5 * n_sides * tile_size
    for k in range(n_tall):
        t = row_to_tile[k]
        for row in (2 * k, 2 * k + 1):
            for c in range(_TOP + 1):
                sums[row, c] = 0.0
        # About a point of the tile: about the sensor, rounding would exceed the scatter.
        sums[2 * k, _TO_UNITS_X] = _TO_UNITS - ((t // n_sides) * tile_size - half)
        sums[2 * k, _TO_UNITS_Y] = _TO_UNITS - ((t % n_sides) * tile_size - half)
        sums[2 * k, _BASE] = extremes[t, 0]


@jit(entry=True)
def decide_faces(
    n_parts: int,
    n_tall: int,
    config: FacesConfig,
    label: LabelConfig,
    room: FaceSums,
    faces: Faces,
) -> None:
    """Decide from the sums of all parts which tiles hold a face, into `faces`."""
    for t in range(len(faces.is_face)):
        faces.is_face[t] = faces.has_occluded_base[t] = False
    low, high = np.empty(N_COLUMNS), np.empty(N_COLUMNS)
    for k in range(n_tall):
        _add_parts(n_parts, 2 * k, room.sums, low)
        _add_parts(n_parts, 2 * k + 1, room.sums, high)
        top = max(low[_TOP], high[_TOP])
        if top > label.obstacle_min_height and _is_vertical(low, high, config.max_normal_z):
            t = room.row_to_tile[k]
            faces.is_face[t] = True
            faces.has_occluded_base[t] = _is_base_occluded(low, high, config.max_foot_distance)


@jit()
def _add_parts(n_parts: int, row: int, sums: FloatArray, total: FloatArray) -> None:
    for c in range(_TOP + 1):
        total[c] = 0.0
    for index in range(n_parts):
        for c in range(_TOP):
            total[c] += sums[index, row, c]
        total[_TOP] = max(total[_TOP], sums[index, row, _TOP])


@jit()
def _is_vertical(low: FloatArray, high: FloatArray, max_normal_z: float) -> bool:
    """Whether the returns of a tile form a vertical face, see `normal_z` of the twin."""
    n, x, y, z = low[0] + high[0], low[1] + high[1], low[2] + high[2], low[3] + high[3]
    if n < MIN_RETURNS:
        return False
    xx = low[4] + high[4] - x * x / n
    yy = low[5] + high[5] - y * y / n
    zz = low[6] + high[6] - z * z / n
    xy = low[7] + high[7] - x * y / n
    xz = low[8] + high[8] - x * z / n
    yz = low[9] + high[9] - y * z / n
    vertical = max(xx * yy - xy * xy, 0.0)
    trace = vertical + max(yy * zz - yz * yz, 0.0) + max(xx * zz - xz * xz, 0.0)
    if trace <= FLATNESS * (xx + yy + zz) ** 2:
        return False
    return math.sqrt(vertical / trace) < max_normal_z


@jit()
def _is_base_occluded(low: FloatArray, high: FloatArray, max_foot_distance: float) -> bool:
    """Whether the lowest returns are the face's own, see `is_base_occluded` of the twin."""
    n_low, n_high = low[0], high[0]
    if max_foot_distance <= 0.0 or n_high < 2.0:
        return False
    mean_x, mean_y = high[1] / n_high, high[2] / n_high
    xx = high[4] - n_high * mean_x * mean_x
    yy = high[5] - n_high * mean_y * mean_y
    xy = high[7] - n_high * mean_x * mean_y
    low_xx = low[4] - 2.0 * mean_x * low[1] + n_low * mean_x * mean_x
    low_yy = low[5] - 2.0 * mean_y * low[2] + n_low * mean_y * mean_y
    low_xy = low[7] - mean_x * low[2] - mean_y * low[1] + n_low * mean_x * mean_y
    size = math.sqrt((xx - yy) ** 2 + 4.0 * xy * xy)
    aligned = 0.0
    if size > FLATNESS * n_high:
        aligned = ((low_xx - low_yy) * (xx - yy) + 4.0 * low_xy * xy) / size
    square: float = 0.5 * (low_xx + low_yy - aligned)
    in_plane: bool = square <= n_low * max_foot_distance * max_foot_distance
    return in_plane
