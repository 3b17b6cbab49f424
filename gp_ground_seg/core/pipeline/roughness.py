"""Stage 6: roughness of the ground in each tile.

A low thing fills few tiles; rough ground, and ground that the surface does not follow, fill most of
those about it. So the roughness of a tile is an order statistic of the tiles about it, in two
windows. In the near one it is that of the rougher tiles: ground is seldom equally rough. In the
wide one it is the median, and bounds the other: a thing that fills the near window does not fill
the wide one. Where few tiles are seen, the median of the frame counts as some more.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from gp_ground_seg.core.frame import FloatArray, IntArray, Tiles

SQUARE_EDGES = 1e-4 * 2.0 ** (0.25 * np.arange(48))
"""Mean square heights between the levels of roughness [m^2]: eight levels for each factor of two
of the roughness, from 1 cm to 59 cm."""
ROUGHNESS = np.concatenate([[0.01], np.sqrt(SQUARE_EDGES) * 2.0**0.0625])
"""Roughness of each level [m]: the geometric mean of its edges."""
UNKNOWN_LEVEL = -1
"""Level of a tile without a return near the surface."""


class Window(NamedTuple):
    """Three by three blocks of tiles about the block of a tile."""

    side: int  # tiles along a side of a block
    share: float  # part of the tiles that are at most as rough as the result
    prior: int  # tiles as rough as the median of the frame that count beside those seen


NEAR, WIDE = Window(2, 0.75, 4), Window(4, 0.5, 16)
"""Windows of 3 m and of 6 m, for tiles of 0.5 m."""
MOST_OVER_WIDE = 3.2
"""Largest roughness of a tile over that of the wide window."""


def ground_roughness(
    tiles: Tiles, n_near: IntArray, squares: FloatArray, units: float
) -> FloatArray:
    """Roughness of the ground in each tile, (T,) [m]; 0 in tiles without a return near the surface.

    Parameters
    ----------
    tiles : Tiles
        Tiles of the points.
    n_near : (T,) int64
        Returns near the surface, of no vertical face.
    squares : (T,) float64
        Sum of their squared heights over the surface, in whole units.
    units : float
        Units for 1 m^2.
    """
    n_sides, roughness = math.isqrt(len(tiles.extremes)), np.zeros(len(tiles.extremes))
    known = np.flatnonzero(n_near)
    if len(known) == 0:
        return roughness
    level = np.searchsorted(SQUARE_EDGES, squares[known] / (units * n_near[known]), side='right')
    counts = np.bincount(level, minlength=len(ROUGHNESS))
    of_frame = int(_level_at(counts[None, :], 0.5)[0])
    near, wide = (
        ROUGHNESS[_levels_about(known, level, n_sides, window, of_frame)]
        for window in (NEAR, WIDE)
    )
    roughness[known] = np.minimum(near, MOST_OVER_WIDE * wide)
    return roughness


def _levels_about(
    tile: IntArray, level: IntArray, n_sides: int, window: Window, of_frame: int
) -> IntArray:
    """Level about each of the tiles (K,) of known `level`; `of_frame` is the median of them."""
    column, row = np.divmod(tile, n_sides)
    # Blocks in a square with one more at each side, so that each has eight around it.
    width = -(-n_sides // window.side) + 2
    place = (column // window.side + 1) * width + row // window.side + 1
    blocks, own = np.unique(place, return_inverse=True)
    block_to_row = np.full(width * width, len(blocks))
    block_to_row[blocks] = np.arange(len(blocks))
    # The last row stays empty: blocks without tiles.
    counts = np.zeros((len(blocks) + 1, len(ROUGHNESS)), dtype=np.int64)
    np.add.at(counts, (own, level), 1)
    around = (np.arange(-1, 2)[:, None] * width + np.arange(-1, 2)).ravel()
    total = counts[block_to_row[blocks[:, None] + around]].sum(axis=1)
    total[:, of_frame] += window.prior
    result: IntArray = _level_at(total, window.share)[own]
    return result


def _level_at(counts: IntArray, share: float) -> IntArray:
    """Level that a `share` of the tiles of each row does not exceed.

    `counts`, (R, levels), are the numbers of tiles by level.
    """
    cumulative = counts.cumsum(axis=1)
    result: IntArray = (cumulative <= share * (cumulative[:, -1:] - 1)).sum(axis=1)
    return result
