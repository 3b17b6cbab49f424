"""Stage 6: roughness of the ground in each tile.

A low object fills few tiles; rough ground, and ground that the surface does not follow, fill
most of those around it. So the roughness of a tile is an order statistic of the tiles around it,
in two windows. In the near one it is that of the rougher tiles: ground is seldom equally rough. In
the wide one it is the median, and bounds the other: an object that fills the near window does not
fill the wide one. Where few tiles are seen, the median of the frame counts as some more.
"""

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from gp_ground_seg.core.frame import CellArray, FloatArray, IntArray, Tiles, as_index

EDGES = 0.01 * 1.14 ** np.arange(31)
SQUARE_EDGES = EDGES * EDGES
"""Roughness between its levels, 14 % from one to the next, and the mean squares [m, m^2]."""
ROUGHNESS = np.concatenate([[0.01], EDGES * math.sqrt(1.14)])
"""Roughness of each level: the geometric mean of its edges [m]."""
N_LEVELS, UNKNOWN_LEVEL = len(ROUGHNESS), -1
UNKNOWN = -1.0
"""Square of a roughness, or of a scatter, that is not known [m^2]."""


class Window(NamedTuple):
    """Three by three blocks of tiles about the block of a tile."""

    shift: int  # a block has 2^shift tiles along a side
    share: float  # part of the tiles that are at most as rough as the result
    prior: int  # tiles of a given level that count beside those seen


NEAR, WIDE = Window(1, 0.8, 4), Window(2, 0.5, 16)
"""Windows of 3 m and of 6 m, for tiles of 0.5 m."""
MOST_OVER_WIDE = 3.4
"""Largest roughness of a tile over that of the wide window."""


def ground_roughness(tiles: Tiles, sums: FloatArray, units: float) -> FloatArray:
    """Roughness of the ground about each tile, (T + 1,) [m]; 0 if no return is near the surface.

    Parameters
    ----------
    tiles : Tiles
        Tiles of the points.
    sums : (2, T) float64
        Number of the returns near the surface that are of no vertical face, and the sum of their
        squared heights over the surface, in whole units.
    units : float
        Units for 1 m^2.

    The last one, for points in no tile, is 0.
    """
    roughness, is_known = np.zeros(len(tiles.place) + 1), sums[0] > 0
    if not is_known.any():
        return roughness
    n_near, squares = sums[:, is_known]
    level = np.full(len(tiles.place), UNKNOWN_LEVEL)
    level[is_known] = np.searchsorted(SQUARE_EDGES, squares / (units * n_near), side='right')
    counts = np.bincount(level[is_known], minlength=N_LEVELS)
    of_frame = int(level_at(counts[None, :], 0.5)[0])
    near, wide = (
        ROUGHNESS[levels_about(tiles.place, level, tiles.n_sides, window, of_frame)]
        for window in (NEAR, WIDE)
    )
    roughness[:-1] = np.minimum(near, MOST_OVER_WIDE * wide)
    return roughness


def levels_about(
    places: CellArray, level: IntArray, n_sides: int, window: Window, prior_level: int
) -> IntArray:
    """Level about each tile at `places` (K,), of those of which it is known, (K,).

    `level` (K,) is their own, or `UNKNOWN_LEVEL`; `prior_level` that of the tiles of the prior.
    """
    column, row = np.divmod(as_index(places), n_sides)
    # Blocks in a square with one more at each side, so that each has eight around it.
    width = (n_sides - 1 >> window.shift) + 3
    place = ((column >> window.shift) + 1) * width + (row >> window.shift) + 1
    has_tiles = np.zeros(width * width, dtype=np.bool_)
    has_tiles[place] = True
    blocks = np.flatnonzero(has_tiles)
    # The last row stays empty: blocks without tiles.
    shape = len(blocks) + 1, N_LEVELS
    block_to_row = np.full(width * width, len(blocks))
    block_to_row[blocks] = np.arange(len(blocks))
    own, is_known = block_to_row[place], level != UNKNOWN_LEVEL
    entry = own[is_known] * N_LEVELS + level[is_known]
    # Nine blocks have few tiles, and small numbers are added faster.
    counts = np.bincount(entry, minlength=shape[0] * N_LEVELS).reshape(shape).astype(np.int16)
    total = np.zeros((len(blocks), N_LEVELS), dtype=np.int16)
    for step in (np.arange(-1, 2)[:, None] * width + np.arange(-1, 2)).ravel():
        total += counts.take(block_to_row[blocks + step], axis=0)
    total[:, prior_level] += window.prior
    result: IntArray = level_at(total, window.share)[own]
    return result


def level_at(counts: npt.NDArray[np.integer], share: float) -> IntArray:
    """Level that a `share` of the tiles of each row does not exceed.

    `counts`, (R, levels), are the numbers of tiles by level, of any type of whole numbers.
    """
    cumulative = counts.cumsum(axis=1, dtype=counts.dtype)
    most = np.floor(share * (cumulative[:, -1:] - 1)).astype(counts.dtype)
    result: IntArray = np.count_nonzero(cumulative <= most, axis=1)
    return result
