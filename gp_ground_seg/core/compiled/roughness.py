"""Compiled twin of `gp_ground_seg.core.pipeline.roughness`.

The tiles of a block, and of nine blocks, are counted by level in the bytes of `N_WORDS` words, so
that one addition counts eight levels: nine blocks have at most 144 tiles.
"""

import math
from typing import Any

import numpy as np

from gp_ground_seg.core.frame import BoolArray, CellArray, FloatArray, IntArray, Tiles
from gp_ground_seg.core.jit import jit
from gp_ground_seg.core.pipeline import roughness as plain

N_WORDS = plain.N_LEVELS // 8
_ONES, _HIGHEST = np.uint64(0x0101010101010101), np.uint64(56)
_LANES, _LOW_BYTES = np.uint64(0x0001000100010001), np.uint64(0x00FF00FF00FF00FF)


@jit()
def set_roughness(
    tiles: Tiles,
    sums: IntArray,
    is_face: BoolArray,
    units: float,
    shift: int,
    roughness: FloatArray,
) -> None:
    """Roughness of the ground in each tile, into `roughness` (T + 1,), zeros before [m].

    It stays as it is if no return is near the surface, and for points in no tile. For each tile
    `sums` (T + 1,) have the number of returns near the surface in the bits from `shift` on, and
    below the sum of their squared heights in `units` for 1 m^2; those of faces do not count.
    """
    square, n_known = np.full(len(sums) - 1, plain.UNKNOWN), 0
    for t in range(len(square)):
        number = sums[t] >> shift
        if number > 0 and not is_face[t]:
            square[t] = np.float64(sums[t] - (number << shift)) / (units * np.float64(number))
            n_known += 1
    if n_known == 0:
        return
    level, counts = levels_of(square, plain.SQUARE_EDGES)
    of_frame, n_sides = level_at(counts, n_known, 0.5), int(math.sqrt(len(tiles.at)))
    near = levels_about(tiles.place, level, n_sides, plain.NEAR, of_frame)
    wide = levels_about(tiles.place, level, n_sides, plain.WIDE, of_frame)
    for t in range(len(level)):
        most = plain.MOST_OVER_WIDE * plain.ROUGHNESS[np.uintp(wide[t])]
        roughness[t] = min(plain.ROUGHNESS[np.uintp(near[t])], most)


@jit()
def levels_of(square: FloatArray, edges: FloatArray) -> tuple[CellArray, IntArray]:
    """Level of each square between the `edges`, or `UNKNOWN_LEVEL`, and how many have each."""
    level, counts = (
        np.full(len(square), plain.UNKNOWN_LEVEL, np.int32),
        np.zeros(plain.N_LEVELS, np.int64),
    )
    for k in range(len(square)):
        level[k] += np.int32(square[k] != plain.UNKNOWN)
    # Edge by edge, as the inner loop has vector instructions.
    for edge in edges:
        for k in range(len(square)):
            level[k] += np.int32(square[k] >= edge)
    for k in range(len(square)):
        if level[k] != plain.UNKNOWN_LEVEL:
            counts[np.uintp(level[k])] += 1
    return level, counts


@jit()
def levels_about(
    place: CellArray, level: CellArray, n_sides: int, window: plain.Window, prior_level: int
) -> CellArray:
    """See the plain `levels_about`."""
    shift, n_rows = window.shift, 1
    # Blocks in a square with one more at each side, so that each has eight around it.
    width = (n_sides - 1 >> shift) + 3
    block_to_row, block = np.zeros(width * width, np.int32), np.empty(len(place), np.int32)
    own, row_to_block = np.empty(len(place) + 1, np.int32), np.empty(len(place) + 1, np.int32)
    for k in range(len(place)):
        # A division of whole numbers has no vector instruction.
        column = np.int32((place[k] + 0.5) / n_sides)
        row = place[k] - column * np.int32(n_sides)
        block[k] = ((column >> shift) + 1) * width + (row >> shift) + 1
    for k in range(len(place)):
        b = np.uintp(block[k])
        if block_to_row[b] == 0:
            block_to_row[b], row_to_block[n_rows] = n_rows, b
            n_rows += 1
        own[k] = block_to_row[b]
    # Row 0 is that of blocks without such a tile. One dimension, as views of rows take longer than
    # the sums.
    counts = np.zeros(n_rows * N_WORDS, np.uint64)
    for k in range(len(place)):
        if level[k] != plain.UNKNOWN_LEVEL:
            counts[np.uintp(own[k] * N_WORDS + level[k] // 8)] += _byte(1, level[k])
    prior, level_of_row = np.zeros(N_WORDS, np.uint64), np.empty(n_rows, np.int32)
    prior[prior_level // 8] = _byte(window.prior, prior_level)
    for n in range(1, n_rows):
        a, b, c, d = prior[0], prior[1], prior[2], prior[3]
        for step in range(-width, width + 1, width):
            for beside in range(row_to_block[n] + step - 1, row_to_block[n] + step + 2):
                first = np.uintp(block_to_row[np.uintp(beside)] * N_WORDS)
                a, b = a + counts[first], b + counts[first + np.uintp(1)]
                c, d = c + counts[first + np.uintp(2)], d + counts[first + np.uintp(3)]
        level_of_row[n] = _level_in((a, b, c, d), window.share)
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
def _level_in(words: tuple[Any, ...], share: float) -> int:
    """Do what `level_at` does, of counts in bytes, without a branch."""
    total, cumulative, level = np.uint64(0), np.uint64(0), np.uint64(0)
    for word in words:
        # The highest byte of this product is the sum of all.
        total += word * _ONES >> _HIGHEST
    most = np.uint64(256 + math.floor(share * (np.int64(total) - 1))) * _LANES
    for word in words:
        sums = (word + cumulative) * _ONES
        cumulative = sums >> _HIGHEST
        # Every other byte in a lane of two, the higher of which is 1 if the sum is at most `most`.
        for odd in (np.uint64(0), np.uint64(8)):
            is_below = (most - (sums >> odd & _LOW_BYTES)) >> np.uint64(8) & _LANES
            level += is_below * _LANES >> np.uint64(48)
    return int(level)
