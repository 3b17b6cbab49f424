"""Compiled twin of `gp_ground_seg.core.pipeline.roughness`."""

from __future__ import annotations

import math

import numpy as np

from gp_ground_seg.core.frame import CellArray, FloatArray, IntArray, Tiles
from gp_ground_seg.core.jit import jit
from gp_ground_seg.core.pipeline.roughness import (
    MOST_OVER_WIDE,
    N_LEVELS,
    NEAR,
    ROUGHNESS,
    SQUARE_EDGES,
    WIDE,
    Window,
)


@jit(entry=True)
def set_roughness(
    tiles: Tiles,
    sums: IntArray,
    units: float,
    block_to_row: CellArray,
    counts: CellArray,
    roughness: FloatArray,
) -> None:
    """Roughness of the ground in each occupied tile, into `roughness` (T + 1,) [m].

    Parameters
    ----------
    tiles : Tiles
        Tiles of the points.
    sums : (T + 1, 2) int64
        For each occupied tile the number of returns near the surface and the sum of their squared
        heights; the last row is for points in no tile.
    units : float
        Whole units of squared heights for 1 m^2.
    block_to_row, counts : ((sqrt(T) + 2)^2,) int32, (levels * (K + 1),) int32
        Working arrays with arbitrary content; K tiles are occupied.
    roughness : (T + 1,) float64
        Of the occupied tiles the roughness, 0 where no return is near the surface; the last one,
        for points in no tile, is NaN.
    """
    # Of the occupied tiles in their order: those of all tiles would lie far apart in memory.
    known, level, of_frame = _known_levels(tiles, sums, units)
    n_sides = int(math.sqrt(len(roughness) - 1))
    near = _levels_about(known, level, n_sides, NEAR, of_frame, block_to_row, counts)
    wide = _levels_about(known, level, n_sides, WIDE, of_frame, block_to_row, counts)
    for tile in tiles.occupied:
        roughness[np.uintp(tile)] = 0.0
    for k in range(len(known)):
        most = MOST_OVER_WIDE * ROUGHNESS[np.uintp(wide[k])]
        roughness[np.uintp(known[k])] = min(ROUGHNESS[np.uintp(near[k])], most)
    roughness[len(roughness) - 1] = math.nan


@jit()
def _known_levels(tiles: Tiles, sums: IntArray, units: float) -> tuple[CellArray, CellArray, int]:
    """Tiles with a return near the surface, the level of each (K,), and the median of these."""
    counts, n_known = np.zeros(N_LEVELS, np.int32), 0
    known, level = np.empty((2, len(tiles.occupied)), np.int32)
    for tile in tiles.occupied:
        number = sums[np.uintp(tile), 0]
        if number > 0:
            square = np.float64(sums[np.uintp(tile), 1]) / (units * np.float64(number))
            found = 0
            for k in range(len(SQUARE_EDGES)):
                found += np.int64(square >= SQUARE_EDGES[k])
            known[n_known], level[n_known] = tile, found
            counts[found] += 1
            n_known += 1
    return known[:n_known], level[:n_known], _level_at(counts, 0.5)


@jit()
def _levels_about(
    tile: CellArray,
    level: CellArray,
    n_sides: int,
    window: Window,
    of_frame: int,
    block_to_row: CellArray,
    counts: CellArray,
) -> CellArray:
    """Level in the window about each of the tiles (K,) of known `level`, (K,)."""
    shift, n_rows = window.shift, 1
    # Blocks in a square with one more at each side, so that each has eight around it.
    width = (n_sides - 1 >> shift) + 3
    block_to_row[: width * width] = 0
    own, row_to_block = np.empty((2, len(tile) + 1), np.int32)
    for k in range(len(tile)):
        column = tile[k] // n_sides
        row = tile[k] - column * n_sides
        block = np.uintp(((column >> shift) + 1) * width + (row >> shift) + 1)
        if block_to_row[block] == 0:
            block_to_row[block], row_to_block[n_rows] = n_rows, block
            n_rows += 1
        own[k] = block_to_row[block]
    # Row 0 is that of blocks without such a tile. One dimension, as views of rows take longer than
    # the sums.
    counts[: n_rows * N_LEVELS] = 0
    for k in range(len(tile)):
        counts[np.uintp(own[k] * N_LEVELS + level[k])] += 1
    about, level_of_row = np.empty(N_LEVELS, np.int32), np.empty(n_rows, np.int32)
    for n in range(1, n_rows):
        about[:] = 0
        about[np.uintp(of_frame)] = window.prior
        for step in range(-width, width + 1, width):
            for beside in range(row_to_block[n] + step - 1, row_to_block[n] + step + 2):
                first = block_to_row[np.uintp(beside)] * N_LEVELS
                if first > 0:
                    for j in range(N_LEVELS):
                        about[j] += counts[np.uintp(first + j)]
        level_of_row[n] = _level_at(about, window.share)
    for k in range(len(tile)):
        own[k] = level_of_row[np.uintp(own[k])]
    return own


@jit()
def _level_at(counts: CellArray, share: float) -> int:
    """Level that a `share` of the tiles, counted by level, does not exceed; 0 without any."""
    most, cumulative, level = share * (counts.sum() - 1), counts[0], 0
    while cumulative <= most:
        level += 1
        cumulative += counts[np.uintp(level)]
    return level
