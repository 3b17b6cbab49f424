"""Compiled twin of `gp_ground_seg.core.pipeline.labels`, in five calls.

`fit_pieces` prepares the surface of each cell, `survey` measures the heights of the points over
it, `set_bands` turns their sums into bands, `label_by_bands` labels the points, and `settle`
changes labels near obstacles by votes.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from gp_ground_seg.core.frame import (
    NOT_FINITE,
    BoolArray,
    CellArray,
    Faces,
    FloatArray,
    GroundSurface,
    IntArray,
    Label,
    Labelled,
    Scan,
    Tiles,
    line_between,
)
from gp_ground_seg.core.jit import jit
from gp_ground_seg.core.parameters.config import LabelConfig
from gp_ground_seg.core.pipeline.labels import (
    N_LAYERS,
    VOTE_UNITS,
    band_margin,
    cell_variance,
    face_margin,
    ground_band,
    is_near,
    layer_of,
    roughness_of,
    settled_margin,
    shows_obstacle,
    vote_of,
    whole_units,
)

# Plain integers, as compiled code has no enumerations.
_UNKNOWN, _GROUND, _OBSTACLE = int(Label.UNKNOWN), int(Label.GROUND), int(Label.OBSTACLE)
OBSTACLE_FLAG = 2**32
"""Added to the number of returns near the surface for each that shows an obstacle: more than there
are points."""
VOTER_FLAG = 2**38
"""Added to the sum of votes for each voter: more than the votes of all of them."""


class LabelBuffers(NamedTuple):
    """Working arrays of the labels; the last row of each is for points in no cell.

    Attributes
    ----------
    pieces : (M * n_bins + 1, 2) float64
        Surface in each cell, level and slope over range.
    sums : (M * n_bins + 1, 3) int64
        For each cell the number of points near the surface, with `OBSTACLE_FLAG` added for
        each that shows an obstacle, and the sums of heights and squared heights in whole units:
        the order of the points does not matter.
    band : (M * n_bins + 1,) float64
        Largest height of ground [m].
    units : float
        Whole units of heights and their squares [1/m, 1/m^2].
    """

    pieces: FloatArray
    sums: IntArray
    band: FloatArray
    units: float


@jit(entry=True)
def fit_pieces(surface: GroundSurface, buffers: LabelBuffers) -> None:
    """Line of the surface across each cell; NaN in the last row."""
    knots, mean, pieces = surface.knots, surface.mean, buffers.pieces
    n_bins = len(knots) - 1
    for m in range(len(mean)):
        for n in range(n_bins):
            piece = line_between(knots[n], knots[n + 1], mean[m, n], mean[m, n + 1])
            pieces[m * n_bins + n, 0], pieces[m * n_bins + n, 1] = piece
    pieces[len(pieces) - 1, 0] = pieces[len(pieces) - 1, 1] = math.nan


@jit(entry=True)
def survey(
    scan: Scan,
    is_face: BoolArray,
    config: LabelConfig,
    height: FloatArray,
    buffers: LabelBuffers,
) -> None:
    """Heights of the points over the surface, and the sums for roughness."""
    pieces, sums, nearest = buffers.pieces, buffers.sums, scan.grid.edges[0]
    for k in range(len(sums)):
        sums[k, 0] = sums[k, 1] = sums[k, 2] = 0
    z, tile, cell, r = scan.xyz.T[2], scan.tiles.tile, scan.grid.cell, scan.grid.r
    for i in range(len(cell)):
        c = np.uintp(cell[i] if cell[i] >= 0 else len(pieces) - 1)
        away = max(np.float64(r[i]), nearest)
        h = np.float64(z[i]) - (pieces[c, 0] + pieces[c, 1] * away)
        height[i] = h
        if shows_obstacle(h, config):
            sums[c, 0] += OBSTACLE_FLAG
        elif is_near(h, config) and not is_face[np.uintp(tile[i])]:
            sums[c, 0] += 1
            sums[c, 1] += int(whole_units(h, buffers.units))
            sums[c, 2] += int(whole_units(h * h, buffers.units))


@jit(entry=True)
def set_bands(
    config: LabelConfig,
    by_roughness: bool,
    sigma_n: float,
    surface_std: FloatArray,
    buffers: LabelBuffers,
    roughness: FloatArray,
) -> None:
    """Roughness and band of each cell from the sums."""
    n_segments, n_bins = roughness.shape
    # Columns 0 and n_bins + 1 stay empty: there is nothing beside the first and last bin.
    number = np.empty(n_bins + 2, np.int64)
    heights = np.empty(n_bins + 2, np.int64)
    squares = np.empty(n_bins + 2, np.int64)
    for m in range(n_segments):
        for n in range(n_bins + 2):
            number[n] = heights[n] = squares[n] = 0
        for k in range(-1, 2):
            first = (m + k + n_segments) % n_segments * n_bins
            for n in range(n_bins):
                number[n + 1] += buffers.sums[first + n, 0]
                heights[n + 1] += buffers.sums[first + n, 1]
                squares[n + 1] += buffers.sums[first + n, 2]
        for n in range(n_bins):
            flagged = number[n] + number[n + 1] + number[n + 2]
            n_near, n_obstacles = flagged & (OBSTACLE_FLAG - 1), flagged >> 32
            height = heights[n] + heights[n + 1] + heights[n + 2]
            square = squares[n] + squares[n + 1] + squares[n + 2]
            variance = cell_variance(surface_std[m, n], surface_std[m, n + 1], sigma_n)
            rough = roughness_of(n_near, height, square, buffers.units, variance)
            band = config.ground_tolerance
            if by_roughness:
                band = ground_band(n_near, rough, n_obstacles, config, sigma_n)
            buffers.band[m * n_bins + n] = band
            roughness[m, n] = rough
    buffers.band[n_segments * n_bins] = math.nan


class VoteBuffers(NamedTuple):
    """Working arrays of the votes, see `gp_ground_seg.core.pipeline.labels.mean_votes`.

    Attributes
    ----------
    rows : (T + 1,) int32
        Row of each tile in the table of votes, 0 if none is about it; the last one is for points
        in no tile.
    voters : (N,) int32
        Points in tiles with an obstacle; there are fewer.
    places : (N,) int32
        Layer of each of them, counted over all rows.
    """

    rows: CellArray
    voters: CellArray
    places: CellArray


@jit(entry=True)
def label_by_bands(
    scan: Scan,
    faces: Faces,
    config: LabelConfig,
    depth: float,
    band: FloatArray,
    has_obstacle: BoolArray,
    result: Labelled,
) -> None:
    """Label the points from their heights in `result`, and find tiles of obstacles.

    Ground reaches `depth` below the surface. `has_obstacle` (T,) becomes true where a return near
    the surface is no ground.
    """
    z, tile, cell = scan.xyz.T[2], scan.tiles.tile, scan.grid.cell
    height, label, margins = result.height, result.label, result.margin
    for i in range(len(cell)):
        n, h = cell[i], height[i]
        margin = band_margin(h, band[np.uintp(n if n >= 0 else len(band) - 1)], depth)
        t = np.uintp(tile[i] if n >= 0 else 0)
        if faces.is_face[t]:
            over_lowest = np.float64(z[i]) - np.float64(scan.tiles.extremes[t, 0])
            is_occluded = faces.has_occluded_base[t]
            margin = face_margin(margin, over_lowest, is_occluded, config.ground_tolerance)
        margins[i] = margin
        otherwise = _UNKNOWN if n == NOT_FINITE else _OBSTACLE
        label[i] = _GROUND if margin >= 0.0 else otherwise
        if margin < 0.0 and is_near(h, config):
            has_obstacle[t] = True


@jit(entry=True)
def settle(
    scan: Scan,
    lowest: float,
    has_obstacle: BoolArray,
    config: LabelConfig,
    buffers: VoteBuffers,
    result: Labelled,
) -> None:
    """Change margins and labels of the returns near an obstacle by the mean votes about them.

    `lowest` is that of `lowest_of` [m].
    """
    settled, n_rows = _number_tiles(scan.tiles, has_obstacle, buffers.rows)
    votes = np.zeros((n_rows, N_LAYERS), np.int64)
    n_voters = _vote(scan, lowest, len(settled), config, result, buffers, votes.reshape(-1))
    sums = _sum_around(settled, scan.tiles, buffers.rows, votes)
    margins, unit = result.margin, config.ground_tolerance / VOTE_UNITS
    for n in range(n_voters):
        i, place = np.uintp(buffers.voters[n]), buffers.places[n]
        layer, total = place % N_LAYERS, 0
        for step in range(N_LAYERS - 1, N_LAYERS + 2):
            total += sums[np.uintp(place - layer + (layer + step) % N_LAYERS)]
        number = total // VOTER_FLAG
        mean = (total - number * VOTER_FLAG) / number - VOTE_UNITS
        margins[i] = settled_margin(margins[i], mean * unit)
        result.label[i] = _GROUND if margins[i] >= 0.0 else _OBSTACLE


@jit(part=True)
def _number_tiles(tiles: Tiles, has_obstacle: BoolArray, rows: CellArray) -> tuple[CellArray, int]:
    """Give rows to tiles with an obstacle, from 1 on, then to those around.

    Returns the tiles of the first rows, and the number of all. Row 0 is for the other tiles, and
    gets no votes.
    """
    n_sides, n_rows = int(math.sqrt(len(has_obstacle))), 1
    settled = np.empty(len(tiles.occupied) + 1, np.int32)
    rows[:] = 0
    for tile in tiles.occupied:
        if has_obstacle[np.uintp(tile)]:
            settled[n_rows], rows[np.uintp(tile)] = tile, n_rows
            n_rows += 1
    settled = settled[:n_rows]
    for tile in settled[1:]:
        column, row = tile // n_sides, tile % n_sides
        for x in range(max(column - 1, 0), min(column + 2, n_sides)):
            for y in range(max(row - 1, 0), min(row + 2, n_sides)):
                t = np.uintp(x * n_sides + y)
                if rows[t] == 0 and tiles.extremes[t, 0] < math.inf:
                    rows[t] = n_rows
                    n_rows += 1
    return settled, n_rows


@jit(part=True)
def _vote(
    scan: Scan,
    lowest: float,
    n_settled: int,
    config: LabelConfig,
    result: Labelled,
    buffers: VoteBuffers,
    votes: IntArray,
) -> int:
    """Add up the votes in each layer, whole numbers; return the number of voters to settle."""
    tolerance, rows, n = config.ground_tolerance, buffers.rows, 0
    z, tile = scan.xyz.T[2], scan.tiles.tile
    for i in range(len(tile)):
        row = rows[np.uintp(tile[i] if tile[i] >= 0 else len(rows) - 1)]
        if row > 0 and is_near(result.height[i], config):
            over_lowest = np.float64(z[i]) - lowest
            place = row * N_LAYERS + int(layer_of(over_lowest, tolerance))
            vote = vote_of(result.margin[i], tolerance)
            votes[np.uintp(place)] += VOTER_FLAG + int(vote + VOTE_UNITS)
            if row < n_settled:
                buffers.voters[n], buffers.places[n] = i, place
                n += 1
    return n


@jit(part=True)
def _sum_around(settled: CellArray, tiles: Tiles, rows: CellArray, votes: IntArray) -> IntArray:
    """Sum the votes of each settled tile and the eight around it, layer by layer."""
    n_sides, sums = int(math.sqrt(len(rows))), np.zeros((len(settled), N_LAYERS), np.int64)
    for k in range(1, len(settled)):
        column, row, about = settled[k] // n_sides, settled[k] % n_sides, sums[k]
        for x in range(max(column - 1, 0), min(column + 2, n_sides)):
            for y in range(max(row - 1, 0), min(row + 2, n_sides)):
                k_beside = rows[np.uintp(x * n_sides + y)]
                if k_beside > 0:
                    beside = votes[np.uintp(k_beside)]
                    for layer in range(N_LAYERS):
                        about[layer] += beside[layer]
    return sums.reshape(-1)
