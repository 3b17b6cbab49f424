"""The passes over all points that lead to labels, compiled; the twin is `labelling`."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from gp_ground_seg.compiled.growth_compiled import N_STAGES
from gp_ground_seg.compiled.meeting import Board, all_done, claim, enlist, n_taken
from gp_ground_seg.frame import NOT_FINITE, CellArray, FloatArray, IntArray, Label, PointArray
from gp_ground_seg.jit import compiled
from gp_ground_seg.pipeline.labelling import SQUARE_UNITS

BoolArray = npt.NDArray[np.bool_]

# Plain integers: compiled code knows no enumerations.
_UNKNOWN, _GROUND, _OBSTACLE = int(Label.UNKNOWN), int(Label.GROUND), int(Label.OBSTACLE)
# Stages, after those of `gp_ground_seg.compiled.growth_compiled.estimate_surface`.
_LEVELLING = N_STAGES
_SURVEYING = _LEVELLING + 1
_STANDS = 2**32  # more than there are points
BLOCK = 2048
"""Points labelled at a time."""


@compiled
def label_scan(
    share: int,
    n_shares: int,
    board: Board,
    columns: PointArray,
    cell: CellArray,
    r: PointArray,
    tile: CellArray,
    tile_extremes: PointArray,
    is_face: BoolArray,
    is_footless: BoolArray,
    knots: FloatArray,
    mean: FloatArray,
    ground_tolerance: float,
    roughness_gain: float,
    obstacle_tolerance: float,
    obstacle_roughness_gain: float,
    min_height: float,
    max_height: float,
    below_tolerance: float,
    face_tolerance: float,
    pieces: FloatArray,
    sums: IntArray,
    band: FloatArray,
    height: FloatArray,
    roughness: FloatArray,
    label: npt.NDArray[np.uint8],
    margin: FloatArray,
) -> None:
    """Do what `gp_ground_seg.pipeline.labelling` does, in four stages.

    Parameters
    ----------
    share, n_shares, board
        See `gp_ground_seg.compiled.meeting`.
    knots : (K,) float64
        Ranges of the knots [m].
    mean : (M, K) float64
        Height at the knots, linear between them [m].
    pieces : (M * (K - 1) + 1, 2) float64
        Room for the surface in each cell, level and slope over range; and for NaN, in the
        last row, for the points of no cell.
    sums : (n_shares, M * (K - 1) + 1, 2) int64
        Room for what `_survey` finds.
    band : (M * (K - 1) + 1,) float64
        Room for the band of each cell.
    """
    share = enlist(board, share, n_shares)
    if share < 0:
        return
    n_segments, n_bins, n_points = len(mean), len(knots) - 1, len(cell)
    pieces[n_segments * n_bins] = np.nan
    n_blocks = (n_points + BLOCK - 1) // BLOCK

    stage = np.int64(_LEVELLING)
    m = claim(board, stage, share, n_shares, n_segments)
    while m >= 0:
        _level_and_slope(knots, mean[m], pieces[m * n_bins : (m + 1) * n_bins])
        m = claim(board, stage, share, n_shares, n_segments)
    if not all_done(board, stage, share, n_shares, n_segments):
        return

    stage += 1
    block = claim(board, stage, share, n_shares, n_blocks)
    if block >= 0:
        sums[share] = 0
    while block >= 0:
        own = slice(block * BLOCK, min((block + 1) * BLOCK, n_points))
        _survey(columns[2, own], cell[own], r[own], tile[own], is_face, pieces, knots[0],
                min_height, max_height, height[own], sums[share])  # fmt: skip
        block = claim(board, stage, share, n_shares, n_blocks)
    if not all_done(board, stage, share, n_shares, n_blocks):
        return

    stage += 1
    number, squares = np.empty(n_bins + 2, np.int64), np.empty(n_bins + 2, np.int64)
    stands = np.empty(n_bins, np.int64)
    m = claim(board, stage, share, n_shares, n_segments)
    while m >= 0:
        _add_up(m, board, n_shares, sums, number, squares, stands)
        own = slice(m * n_bins, (m + 1) * n_bins)
        _bands(number, squares, stands, ground_tolerance, roughness_gain, obstacle_tolerance,
               obstacle_roughness_gain, min_height, roughness[m], band[own])  # fmt: skip
        m = claim(board, stage, share, n_shares, n_segments)
    # Whoever comes first or last: it is always the same.
    band[n_segments * n_bins] = np.nan
    if not all_done(board, stage, share, n_shares, n_segments):
        return

    stage += 1
    block = claim(board, stage, share, n_shares, n_blocks)
    while block >= 0:
        own = slice(block * BLOCK, min((block + 1) * BLOCK, n_points))
        _label(columns[2, own], cell[own], tile[own], height[own], is_face, is_footless,
               tile_extremes, band, below_tolerance, face_tolerance, label[own],
               margin[own])  # fmt: skip
        block = claim(board, stage, share, n_shares, n_blocks)
    all_done(board, stage, share, n_shares, n_blocks)


@compiled
def _level_and_slope(knots: FloatArray, mean: FloatArray, pieces: FloatArray) -> None:
    """Surface in the cells of a segment as ``pieces[n, 0] + pieces[n, 1] * r``."""
    for n in range(len(pieces)):
        slope = (mean[n + 1] - mean[n]) / (knots[n + 1] - knots[n])
        pieces[n, 0] = mean[n] - slope * knots[n]
        pieces[n, 1] = slope


@compiled
def _survey(
    z: PointArray,
    cell: CellArray,
    r: PointArray,
    tile: CellArray,
    is_face: BoolArray,
    pieces: FloatArray,
    nearest: float,
    min_height: float,
    max_height: float,
    height: FloatArray,
    sums: IntArray,
) -> None:
    """Heights of some points over the surface; sums for the roughness; what stands in a bin.

    ``sums[k]`` are the number of the points near the surface, with `_STANDS` added for
    each that stands on it, and the squared heights. Whole numbers: the sums do not depend
    on their order, nor on who takes which points. Nearer than `nearest` the surface is
    level.
    """
    for i in range(len(cell)):
        own = np.uintp(cell[i] if cell[i] >= 0 else len(pieces) - 1)
        away = max(np.float64(r[i]), nearest)
        h = np.float64(z[i]) - (pieces[own, 0] + pieces[own, 1] * away)
        height[i] = h
        if h >= min_height:
            if h <= max_height:
                sums[own, 0] += _STANDS
        elif h >= -min_height and not is_face[np.uintp(tile[i])]:
            sums[own, 0] += 1
            sums[own, 1] += int(h * h * SQUARE_UNITS + 0.5)


@compiled
def _add_up(
    m: int,
    board: Board,
    n_shares: int,
    sums: IntArray,
    number: IntArray,
    squares: IntArray,
    stands: IntArray,
) -> None:
    """Add up what all shares found in segment `m` and those beside it.

    ``number[n + 1]`` and ``squares[n + 1]`` are those of bin n; before the first and behind
    the last there is nothing. ``stands[n]`` counts what stands in the segment itself.
    """
    n_bins = len(stands)
    n_segments = len(sums[0]) // n_bins
    number[:] = 0
    squares[:] = 0
    stands[:] = 0
    for share in range(n_shares):
        if n_taken(board, _SURVEYING, share, n_shares) == 0:
            continue
        for k in range(-1, 2):
            first = (m + k + n_segments) % n_segments * n_bins
            for n in range(n_bins):
                number[n + 1] += sums[share, first + n, 0] & (_STANDS - 1)
                squares[n + 1] += sums[share, first + n, 1]
        for n in range(n_bins):
            stands[n] += sums[share, m * n_bins + n, 0] >> 32


@compiled
def _bands(
    number: IntArray,
    squares: IntArray,
    stands: IntArray,
    ground_tolerance: float,
    roughness_gain: float,
    obstacle_tolerance: float,
    obstacle_roughness_gain: float,
    widest: float,
    roughness: FloatArray,
    band: FloatArray,
) -> None:
    """Do what `labelling.root_mean_square` and `labelling.band` do for a segment."""
    for n in range(len(band)):
        own = max(number[n] + number[n + 1] + number[n + 2], 1)
        total = squares[n] + squares[n + 1] + squares[n + 2]
        roughness[n] = np.float64(total) / (SQUARE_UNITS * np.float64(own))
    for n in range(len(band)):
        roughness[n] = math.sqrt(roughness[n])
        free = ground_tolerance + roughness_gain * roughness[n]
        beside = obstacle_tolerance + obstacle_roughness_gain * roughness[n]
        free = beside if (stands[n] > 0) & (beside < free) else free
        band[n] = free if free < widest else widest


@compiled
def _label(
    z: PointArray,
    cell: CellArray,
    tile: CellArray,
    height: FloatArray,
    is_face: BoolArray,
    is_footless: BoolArray,
    tile_extremes: PointArray,
    band: FloatArray,
    below_tolerance: float,
    face_tolerance: float,
    label: npt.NDArray[np.uint8],
    margin: FloatArray,
) -> None:
    """Do what `gp_ground_seg.pipeline.labelling.label_points` does for some points."""
    for i in range(len(cell)):
        n, h = cell[i], height[i]
        # The last row of the band is NaN, for the points of no cell.
        own = min(band[np.uintp(n if n >= 0 else len(band) - 1)] - h, h + below_tolerance)
        t = np.uintp(tile[i] if n >= 0 else 0)
        if is_face[t]:
            over_foot = max(h, np.float64(z[i]) - np.float64(tile_extremes[t, 0]))
            reach = -face_tolerance if is_footless[t] else face_tolerance
            own = min(own, reach - over_foot)
        margin[i] = own
        label[i] = _GROUND if own >= 0.0 else (_UNKNOWN if n == NOT_FINITE else _OBSTACLE)
