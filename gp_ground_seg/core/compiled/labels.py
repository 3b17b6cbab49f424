"""Compiled twin of `gp_ground_seg.core.pipeline.labels`, in four calls.

`fit_pieces` prepares the surface of each cell, `survey` measures the heights of the points over
it, `label_by_bands` labels the points by the roughness of the ground (see
`gp_ground_seg.core.compiled.roughness`), and `vote` changes labels near obstacles by votes.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from gp_ground_seg.core.compiled.relief import find_places
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
    face_margin,
    ground_band,
    is_near,
    layer_of,
    margin_after_vote,
    vote_of,
    whole_units,
)
from gp_ground_seg.core.pipeline.relief import Relief, height_in

# Plain integers, as compiled code has no enumerations.
_UNKNOWN, _GROUND, _OBSTACLE = int(Label.UNKNOWN), int(Label.GROUND), int(Label.OBSTACLE)
BLOCK = 512
"""Points measured at a time, so that their places in the relief stay in the nearest cache."""
VOTER_FLAG = 2**38
"""Added to the sum of votes for each voter: more than the votes of all of them."""


@jit(entry=True)
def fit_pieces(surface: GroundSurface, pieces: FloatArray) -> None:
    """Line of the surface across each cell, level and slope over range, (M * n_bins + 1, 2).

    The last row is for points in no cell, and NaN.
    """
    knots, mean = surface.knots, surface.mean
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
    pieces: FloatArray,
    relief: Relief,
    is_level: bool,
    units: float,
    height: FloatArray,
    sums: IntArray,
) -> None:
    """Heights of the points over the surface, and the sums for the roughness of tiles.

    For `pieces` see `fit_pieces`, for `sums` `gp_ground_seg.core.compiled.roughness`.
    """
    for occupied in scan.tiles.occupied:
        sums[np.uintp(occupied), 0] = sums[np.uintp(occupied), 1] = 0
    x, y, tile = scan.xyz.T[0], scan.xyz.T[1], scan.tiles.tile
    land = relief.pieces.reshape(-1, 4)
    u, v, piece = np.zeros(BLOCK), np.zeros(BLOCK), np.zeros(BLOCK, np.int32)
    for first in range(0, len(tile), BLOCK):
        block = slice(first, min(first + BLOCK, len(tile)))
        if not is_level:
            find_places(x[block], y[block], u, v, piece)
        _measure(scan, block, pieces, land, u, v, piece, height[block])
        _add_squares(tile[block], height[block], is_face, units, sums)


@jit(part=True)
def _measure(
    scan: Scan,
    block: slice,
    pieces: FloatArray,
    land: FloatArray,
    u: FloatArray,
    v: FloatArray,
    piece: CellArray,
    height: FloatArray,
) -> None:
    """Heights of the points of a block over the surface and the land."""
    z, r, cell = scan.xyz.T[2][block], scan.grid.r[block], scan.grid.cell[block]
    nearest, outside = scan.grid.edges[0], len(pieces) - 1
    for i in range(len(height)):
        c = np.uintp(cell[i] if cell[i] >= 0 else outside)
        p = np.uintp(piece[i] if cell[i] >= 0 else 0)
        over = np.float64(z[i]) - height_in(land[p], u[i], v[i])
        height[i] = over - (pieces[c, 0] + pieces[c, 1] * max(np.float64(r[i]), nearest))


@jit(part=True)
def _add_squares(
    tile: CellArray, height: FloatArray, is_face: BoolArray, units: float, sums: IntArray
) -> None:
    """Add the returns near the surface to the sums of their tiles."""
    outside = len(sums) - 1
    for i in range(len(height)):
        t = np.uintp(tile[i] if tile[i] >= 0 else outside)
        if is_near(height[i]) and not is_face[t]:
            sums[t, 0] += 1
            sums[t, 1] += int(whole_units(height[i] * height[i], units))


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
    bands: FloatArray,
    has_obstacle: BoolArray,
    result: Labelled,
) -> None:
    """Label the points from their heights in `result`, and find tiles of obstacles.

    Ground reaches `depth` below the surface. `has_obstacle` (T,) becomes true where a return near
    the surface is no ground. `bands` (T + 1,) is the roughness of the ground in each tile [m], and
    becomes the largest height of ground there; the last one is for points in no tile.
    """
    for occupied in scan.tiles.occupied:
        bands[np.uintp(occupied)] = ground_band(bands[np.uintp(occupied)], config)
    z, tile, cell = scan.xyz.T[2], scan.tiles.tile, scan.grid.cell
    is_face, is_occluded, extremes = faces.is_face, faces.has_occluded_base, scan.tiles.extremes
    height, label, margins = result.height, result.label, result.margin
    for i in range(len(cell)):
        n, h = cell[i], height[i]
        t = np.uintp(tile[i] if n >= 0 else len(bands) - 1)
        margin = band_margin(h, bands[t], depth)
        if n >= 0 and is_face[t]:
            over_lowest = np.float64(z[i]) - np.float64(extremes[t, 0])
            margin = face_margin(margin, over_lowest, is_occluded[t], config.ground_tolerance)
        margins[i] = margin
        otherwise = _UNKNOWN if n == NOT_FINITE else _OBSTACLE
        label[i] = _GROUND if margin >= 0.0 else otherwise
        if margin < 0.0 and is_near(h):
            has_obstacle[t] = True


@jit(entry=True)
def vote(
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
    obstacle_tiles, n_rows = _number_tiles(scan.tiles, has_obstacle, buffers.rows)
    votes = np.zeros((n_rows, N_LAYERS), np.int64)
    n_voters = _vote(scan, lowest, len(obstacle_tiles), config, result, buffers, votes.reshape(-1))
    sums = _sum_around(obstacle_tiles, scan.tiles, buffers.rows, votes)
    margins, unit = result.margin, config.ground_tolerance / VOTE_UNITS
    for n in range(n_voters):
        i, place = np.uintp(buffers.voters[n]), buffers.places[n]
        layer, total = place % N_LAYERS, 0
        for step in range(N_LAYERS - 1, N_LAYERS + 2):
            total += sums[np.uintp(place - layer + (layer + step) % N_LAYERS)]
        number = total // VOTER_FLAG
        mean = (total - number * VOTER_FLAG) / number - VOTE_UNITS
        margins[i] = margin_after_vote(margins[i], mean * unit)
        result.label[i] = _GROUND if margins[i] >= 0.0 else _OBSTACLE


@jit(part=True)
def _number_tiles(tiles: Tiles, has_obstacle: BoolArray, rows: CellArray) -> tuple[CellArray, int]:
    """Give rows to tiles with an obstacle, from 1 on, then to those around.

    Returns the tiles of the first rows, and the number of all. Row 0 is for the other tiles, and
    gets no votes.
    """
    n_sides, n_rows = int(math.sqrt(len(has_obstacle))), 1
    obstacle_tiles = np.empty(len(tiles.occupied) + 1, np.int32)
    rows[:] = 0
    for tile in tiles.occupied:
        if has_obstacle[np.uintp(tile)]:
            obstacle_tiles[n_rows], rows[np.uintp(tile)] = tile, n_rows
            n_rows += 1
    obstacle_tiles = obstacle_tiles[:n_rows]
    for tile in obstacle_tiles[1:]:
        column, row = tile // n_sides, tile % n_sides
        for x in range(max(column - 1, 0), min(column + 2, n_sides)):
            for y in range(max(row - 1, 0), min(row + 2, n_sides)):
                t = np.uintp(x * n_sides + y)
                if rows[t] == 0 and tiles.extremes[t, 0] < math.inf:
                    rows[t] = n_rows
                    n_rows += 1
    return obstacle_tiles, n_rows


@jit(part=True)
def _vote(
    scan: Scan,
    lowest: float,
    n_obstacle_tiles: int,
    config: LabelConfig,
    result: Labelled,
    buffers: VoteBuffers,
    votes: IntArray,
) -> int:
    """Add up the votes in each layer, whole numbers; return how many are in obstacle tiles."""
    tolerance, rows, n = config.ground_tolerance, buffers.rows, 0
    z, tile = scan.xyz.T[2], scan.tiles.tile
    for i in range(len(tile)):
        row = rows[np.uintp(tile[i] if tile[i] >= 0 else len(rows) - 1)]
        if row > 0 and is_near(result.height[i]):
            over_lowest = np.float64(z[i]) - lowest
            place = row * N_LAYERS + int(layer_of(over_lowest, tolerance))
            vote = vote_of(result.margin[i], tolerance)
            votes[np.uintp(place)] += VOTER_FLAG + int(vote + VOTE_UNITS)
            if row < n_obstacle_tiles:
                buffers.voters[n], buffers.places[n] = i, place
                n += 1
    return n


@jit(part=True)
def _sum_around(
    obstacle_tiles: CellArray, tiles: Tiles, rows: CellArray, votes: IntArray
) -> IntArray:
    """Sum the votes of each tile with an obstacle and the eight around it, layer by layer."""
    n_sides, sums = int(math.sqrt(len(rows))), np.zeros((len(obstacle_tiles), N_LAYERS), np.int64)
    for k in range(1, len(obstacle_tiles)):
        column, row, about = obstacle_tiles[k] // n_sides, obstacle_tiles[k] % n_sides, sums[k]
        for x in range(max(column - 1, 0), min(column + 2, n_sides)):
            for y in range(max(row - 1, 0), min(row + 2, n_sides)):
                k_beside = rows[np.uintp(x * n_sides + y)]
                if k_beside > 0:
                    beside = votes[np.uintp(k_beside)]
                    for layer in range(N_LAYERS):
                        about[layer] += beside[layer]
    return sums.reshape(-1)
