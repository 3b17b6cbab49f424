"""Compiled twin of `gp_ground_seg.core.pipeline.roughness`.

The tiles of a block, and of nine blocks, are counted by level in the bytes of `N_WORDS` words, so
that one addition counts eight levels: nine blocks have at most 144 tiles.
"""

from __future__ import annotations

import math
from typing import Any

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
    UNKNOWN_LEVEL,
    WIDE,
    Window,
)

WordArray = npt.NDArray[np.uint64]
N_WORDS = N_LEVELS // 8
_ONES, _LOWEST_BYTE = np.uint64(0x0101010101010101), np.uint64(255)


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
        Stays as it is if no return is near the surface, and for points in no tile.
    """
    level, n_known, of_frame = _levels(sums, units)
    if n_known == 0:
        return
    n_sides = int(math.sqrt(len(tiles.at)))
    near = levels_about(tiles.place, level, n_sides, NEAR, of_frame)
    wide = levels_about(tiles.place, level, n_sides, WIDE, of_frame)
    for t in range(len(level)):
        most = MOST_OVER_WIDE * ROUGHNESS[np.uintp(wide[t])]
        roughness[t] = min(ROUGHNESS[np.uintp(near[t])], most)


@jit()
def _levels(sums: IntArray, units: float) -> tuple[CellArray, int, int]:
    """Level of each tile, (T,), of how many it is known, and the median of these."""
    counts, n_known, n_tiles = np.zeros(N_LEVELS, np.int64), 0, len(sums) - 1
    level = np.empty(n_tiles, np.int32)
    for t in range(n_tiles):
        number, level[t] = sums[t, 0], UNKNOWN_LEVEL
        if number > 0:
            square = np.float64(sums[t, 1]) / (units * np.float64(number))
            found = 0
            for k in range(len(SQUARE_EDGES)):
                found += np.int64(square >= SQUARE_EDGES[k])
            level[t] = found
            counts[found] += 1
            n_known += 1
    return level, n_known, level_at(counts, n_known, 0.5)


@jit()
def levels_about(
    place: CellArray, level: CellArray, n_sides: int, window: Window, prior_level: int
) -> CellArray:
    """See the plain `levels_about`."""
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
    # Row 0 is that of blocks without such a tile. One dimension, as views of rows take longer than
    # the sums.
    counts = np.zeros(n_rows * N_WORDS, np.uint64)
    for k in range(len(place)):
        if level[k] != UNKNOWN_LEVEL:
            counts[np.uintp(own[k] * N_WORDS + level[k] // 8)] += _byte(1, level[k])
    about, level_of_row = np.empty(N_WORDS, np.uint64), np.empty(n_rows, np.int32)
    for n in range(1, n_rows):
        for w in range(N_WORDS):
            about[w] = 0
        about[prior_level // 8] = _byte(window.prior, prior_level)
        for step in range(-width, width + 1, width):
            for beside in range(row_to_block[n] + step - 1, row_to_block[n] + step + 2):
                first = block_to_row[np.uintp(beside)] * N_WORDS
                for w in range(N_WORDS):
                    about[w] += counts[np.uintp(first + w)]
        level_of_row[n] = _level_in(about, window.share)
    for k in range(len(place)):
        own[k] = level_of_row[np.uintp(own[k])]
    return own


@jit()
def level_at(counts: IntArray, n: int, share: float) -> int:
    """Level that a `share` of `n` tiles, counted by level, does not exceed; 0 without any."""
    most, cumulative, level = share * (n - 1), counts[0], 0
    while cumulative <= most:
        level += 1
        cumulative += counts[np.uintp(level)]
    return level


@jit()
def _byte(value: int, level: int) -> Any:
    """Word with `value` in the byte of a level."""
    return np.uint64(value) << np.uint64(8 * (level % 8))


@jit()
def _sum_of_bytes(word: Any) -> Any:
    """Sum of the bytes of a word, at most 255."""
    # The highest byte of this product is the sum of all.
    return np.int64((word * _ONES) >> np.uint64(56))


@jit()
def _level_in(words: WordArray, share: float) -> int:
    """Do what `level_at` does, of counts in bytes."""
    total = 0
    for w in range(N_WORDS):
        total += _sum_of_bytes(words[w])
    most, w = math.floor(share * (total - 1)), 0
    while _sum_of_bytes(words[w]) <= most:
        most -= _sum_of_bytes(words[w])
        w += 1
    word, level = words[w], 8 * w
    while np.int64(word & _LOWEST_BYTE) <= most:
        most -= np.int64(word & _LOWEST_BYTE)
        word >>= np.uint64(8)
        level += 1
    return level
