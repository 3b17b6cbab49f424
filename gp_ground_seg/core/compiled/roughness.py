"""Compiled twin of `gp_ground_seg.core.pipeline.roughness`."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

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


@jit()
def set_roughness(
    tiles: Tiles,
    sums: IntArray,
    units: float,
    roughness: FloatArray,
) -> None:
    """Roughness of the ground in each tile, into `roughness` (T + 1,), zeros before [m].

    Parameters
    ----------
    tiles : Tiles
        Tiles of the points.
    sums : (T + 1, 2) int64
        For each tile the number of returns near the surface and the sum of their squared heights;
        the last row is for points in no tile.
    units : float
        Whole units of squared heights for 1 m^2.
    roughness : (T + 1,) float64
        Stays as it is where no return is near the surface, and for points in no tile.
    """
    known, level, of_frame = _known_levels(sums, units)
    n_sides, place = int(math.sqrt(len(tiles.at))), np.empty(len(known), np.int32)
    for k in range(len(known)):
        place[k] = tiles.place[np.uintp(known[k])]
    near = _levels_about(place, level, n_sides, NEAR, of_frame)
    wide = _levels_about(place, level, n_sides, WIDE, of_frame)
    for k in range(len(known)):
        most = MOST_OVER_WIDE * ROUGHNESS[np.uintp(wide[k])]
        roughness[np.uintp(known[k])] = min(ROUGHNESS[np.uintp(near[k])], most)


@jit()
def _known_levels(sums: IntArray, units: float) -> tuple[CellArray, CellArray, int]:
    """Tiles with a return near the surface, the level of each (K,), and the median of these."""
    counts, n_known = np.zeros(N_LEVELS, np.int64), 0
    n_tiles = len(sums) - 1
    known, level = np.empty(n_tiles, np.int32), np.empty(n_tiles, np.int32)
    for t in range(n_tiles):
        number = sums[t, 0]
        if number > 0:
            square = np.float64(sums[t, 1]) / (units * np.float64(number))
            found = 0
            for k in range(len(SQUARE_EDGES)):
                found += np.int64(square >= SQUARE_EDGES[k])
            known[n_known], level[n_known] = t, found
            counts[found] += 1
            n_known += 1
    return known[:n_known], level[:n_known], _level_at(counts, n_known, 0.5)


@jit()
def _levels_about(
    place: CellArray, level: CellArray, n_sides: int, window: Window, of_frame: int
) -> CellArray:
    """Level in the window about the tiles at each `place` (K,), of known `level`, (K,)."""
    shift, n_rows = window.shift, 1
    # Blocks in a square with one more at each side, so that each has eight around it.
    width = (n_sides - 1 >> shift) + 3
    block_to_row = np.zeros(width * width, np.int32)
    own, row_to_block = np.empty(len(place) + 1, np.int32), np.empty(len(place) + 1, np.int32)
    for k in range(len(place)):
        column = place[k] // n_sides
        row = place[k] - column * n_sides
        block = np.uintp(((column >> shift) + 1) * width + (row >> shift) + 1)
        if block_to_row[block] == 0:
            block_to_row[block], row_to_block[n_rows] = n_rows, block
            n_rows += 1
        own[k] = block_to_row[block]
    # Row 0 is that of blocks without such a tile. Nine blocks have at most 144 tiles.
    counts = np.zeros((n_rows, N_LEVELS), np.uint8)
    for k in range(len(place)):
        counts[np.uintp(own[k]), np.uintp(level[k])] += 1
    about, level_of_row = np.empty(N_LEVELS, np.uint8), np.empty(n_rows, np.int32)
    for n in range(1, n_rows):
        about[:] = 0
        about[of_frame] = window.prior
        for step in range(-width, width + 1, width):
            for neighbour in range(row_to_block[n] + step - 1, row_to_block[n] + step + 2):
                row = np.uintp(block_to_row[np.uintp(neighbour)])
                for number in range(N_LEVELS):
                    about[number] += counts[row, number]
        level_of_row[n] = _level_at(about, int(about.sum()), window.share)
    for k in range(len(place)):
        own[k] = level_of_row[np.uintp(own[k])]
    return own


@jit()
def _level_at(counts: npt.NDArray[np.integer], n: int, share: float) -> int:
    """Level that a `share` of `n` tiles, counted by level, does not exceed; 0 without any."""
    most, cumulative, level = share * (n - 1), counts[0], 0
    while cumulative <= most:
        level += 1
        cumulative += counts[np.uintp(level)]
    return level
