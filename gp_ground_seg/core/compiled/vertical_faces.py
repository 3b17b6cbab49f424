"""Compiled twin of `gp_ground_seg.core.pipeline.vertical_faces`.

In three calls: `select_tall` lists the tiles with a high return, `sum_returns` sums over the
returns in them, the lowest and those above apart, `decide_faces` decides from the sums.
Coordinates are rounded so that the sums are exact in any order.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from gp_ground_seg.core.frame import OUTSIDE, CellArray, Faces, FloatArray, PointArray, Tiles
from gp_ground_seg.core.jit import jit
from gp_ground_seg.core.parameters.config import FacesConfig, LabelConfig
from gp_ground_seg.core.pipeline.vertical_faces import (
    SUMS,
    UNITS_PER_METRE,
    face_height,
    is_base_occluded,
    is_vertical,
)

# Each tall tile has two rows, for the lowest returns and for those above: their sums and the
# greatest height. The first row also holds `_TO_UNITS` less the origin of x and y, and the origin
# of z.
_TOP, _TO_UNITS_X, _TO_UNITS_Y, _BASE = SUMS, SUMS + 1, SUMS + 2, SUMS + 3
N_COLUMNS = SUMS + 4
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
    sums : (rows, N_COLUMNS) float64
        Sums of each row.
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
        if height > face_height(label):
            tile_to_row[t] = 2 * n_tall
            row_to_tile[n_tall] = tile
            n_tall += 1
        else:
            tile_to_row[t] = NOT_TALL
    return n_tall


@jit(entry=True)
def sum_returns(
    columns: PointArray,
    tiles: Tiles,
    tile_size: float,
    label: LabelConfig,
    n_tall: int,
    buffers: FaceSums,
) -> None:
    """Sum over the returns, (3, N), in tall tiles."""
    sums = buffers.sums
    _clear_sums(tiles.extremes, tile_size, n_tall, buffers.row_to_tile, sums)
    foot_height, max_height = label.ground_tolerance, label.obstacle_max_height
    x, y, z, tile = columns[0], columns[1], columns[2], tiles.tile
    for i in range(len(tile)):
        if tile[i] == OUTSIDE:
            continue
        k = buffers.tile_to_row[np.uintp(tile[i])]
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
    n_tall: int,
    config: FacesConfig,
    label: LabelConfig,
    buffers: FaceSums,
    faces: Faces,
) -> None:
    """Decide from the sums which tiles hold a face, into `faces`."""
    for t in range(len(faces.is_face)):
        faces.is_face[t] = faces.has_occluded_base[t] = False
    for k in range(n_tall):
        low, high = buffers.sums[2 * k], buffers.sums[2 * k + 1]
        top = max(low[_TOP], high[_TOP])
        if top > face_height(label) and is_vertical(low, high, config):
            t = buffers.row_to_tile[k]
            faces.is_face[t] = True
            faces.has_occluded_base[t] = is_base_occluded(low, high, config)
