"""Compiled twin of `gp_ground_seg.core.pipeline.roughness`."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from gp_ground_seg.core.frame import CellArray, FloatArray, IntArray, Tiles
from gp_ground_seg.core.jit import jit
from gp_ground_seg.core.pipeline.roughness import (
    MOST_OVER_WIDE,
    N_LEVELS,
    NEAR,
    ROUGHNESS,
    SQUARE_EDGES,
    UNKNOWN_LEVEL,
    WIDE,
    Window,
)


class RoughnessBuffers(NamedTuple):
    """Working arrays of `set_roughness`.

    Attributes
    ----------
    sums : (T + 1, 2) int64
        For each occupied tile the number of returns near the surface and the sum of their squared
        heights in whole units; the last row is for points in no tile.
    level : (T,) int32
        Level of roughness of each occupied tile, or `UNKNOWN_LEVEL`.
    near, wide : (T,) int32
        Level about each occupied tile of known level in the two windows.
    block_to_row : (T,) int32
        Row of each block of tiles in the table of counts, 0 for those without a known level.
    """

    sums: IntArray
    level: CellArray
    near: CellArray
    wide: CellArray
    block_to_row: CellArray


@jit(entry=True)
def set_roughness(
    tiles: Tiles, units: float, buffers: RoughnessBuffers, roughness: FloatArray
) -> None:
    """Roughness of the ground in each occupied tile, into `roughness` (T + 1,) [m]."""
    level, near, wide = buffers.level, buffers.near, buffers.wide
    of_frame = _set_levels(tiles, units, buffers.sums, level)
    _set_levels_about(tiles, NEAR, of_frame, level, buffers.block_to_row, near)
    _set_levels_about(tiles, WIDE, of_frame, level, buffers.block_to_row, wide)
    for tile in tiles.occupied:
        t = np.uintp(tile)
        roughness[t] = 0.0
        if level[t] != UNKNOWN_LEVEL:
            most = MOST_OVER_WIDE * ROUGHNESS[np.uintp(wide[t])]
            roughness[t] = min(ROUGHNESS[np.uintp(near[t])], most)


@jit()
def _set_levels(tiles: Tiles, units: float, sums: IntArray, level: CellArray) -> int:
    """Set the level of each occupied tile, and return the median of those that are known."""
    counts = np.zeros(N_LEVELS, np.int32)
    for tile in tiles.occupied:
        t = np.uintp(tile)
        level[t] = UNKNOWN_LEVEL
        if sums[t, 0] > 0:
            square = np.float64(sums[t, 1]) / (units * np.float64(sums[t, 0]))
            found = 0
            for k in range(len(SQUARE_EDGES)):
                found += np.int64(square >= SQUARE_EDGES[k])
            level[t] = found
            counts[found] += 1
    return _level_at(counts, 0.5)


@jit()
def _set_levels_about(
    tiles: Tiles,
    window: Window,
    of_frame: int,
    level: CellArray,
    block_to_row: CellArray,
    result: CellArray,
) -> None:
    """Level in the window about each tile of known level, into `result` (T,)."""
    n_sides, shift = int(math.sqrt(len(level))), window.shift
    # Blocks in a square with one more at each side, so that each has eight around it.
    width, n_rows = (n_sides - 1 >> shift) + 3, 1
    block_to_row[: width * width] = 0
    row_to_block = np.empty(len(tiles.occupied) + 1, np.int64)
    for tile in tiles.occupied:
        if level[np.uintp(tile)] != UNKNOWN_LEVEL:
            column = tile // n_sides
            row = tile - column * n_sides
            block = np.uintp(((column >> shift) + 1) * width + (row >> shift) + 1)
            if block_to_row[block] == 0:
                block_to_row[block], row_to_block[n_rows] = n_rows, block
                n_rows += 1
            result[np.uintp(tile)] = block_to_row[block]
    # Row 0 stays empty: blocks without such a tile. One dimension, as views of rows take longer
    # than the sums.
    counts = np.zeros(n_rows * N_LEVELS, np.int32)
    for tile in tiles.occupied:
        t = np.uintp(tile)
        if level[t] != UNKNOWN_LEVEL:
            counts[np.uintp(result[t] * N_LEVELS + level[t])] += 1
    about, level_of_row = np.empty(N_LEVELS, np.int32), np.empty(n_rows, np.int32)
    for n in range(1, n_rows):
        about[:] = 0
        about[np.uintp(of_frame)] = window.prior
        for step in range(-width, width + 1, width):
            for beside in range(row_to_block[n] + step - 1, row_to_block[n] + step + 2):
                first = block_to_row[np.uintp(beside)] * N_LEVELS
                for k in range(N_LEVELS):
                    about[k] += counts[np.uintp(first + k)]
        level_of_row[n] = _level_at(about, window.share)
    for tile in tiles.occupied:
        t = np.uintp(tile)
        if level[t] != UNKNOWN_LEVEL:
            result[t] = level_of_row[np.uintp(result[t])]


@jit()
def _level_at(counts: CellArray, share: float) -> int:
    """Level that a `share` of the tiles, counted by level, does not exceed; 0 without any."""
    most, cumulative, level = share * (counts.sum() - 1), counts[0], 0
    while cumulative <= most:
        level += 1
        cumulative += counts[np.uintp(level)]
    return level
