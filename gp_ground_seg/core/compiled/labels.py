"""Compiled twin of `gp_ground_seg.core.pipeline.labels`.

Tables of tiles have one row more, for points in no tile.
"""

from __future__ import annotations

import math

import numpy as np

from gp_ground_seg.core.compiled.relief import find_places
from gp_ground_seg.core.compiled.roughness import set_roughness
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
    foot_of_face,
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
def label_points(
    scan: Scan,
    faces: Faces,
    surface: GroundSurface,
    relief: Relief,
    is_level: bool,
    config: LabelConfig,
    depth: float,
    units: float,
    lowest: float,
    by_roughness: bool,
    result: Labelled,
) -> None:
    """Height, label and margin of each point, into `result`.

    Here `Scan.xyz` is (3, N). `is_level` says whether the relief is level; `depth`, `units` and
    `lowest` are those of `depth_of_ground`, `sum_units` and `lowest_of`; `by_roughness` is the
    rule of the parameters.
    """
    tiles, n_tiles = scan.tiles, len(scan.tiles.place)
    sums, bands = np.zeros((n_tiles + 1, 2), np.int64), np.zeros(n_tiles + 1)
    feet = np.empty(n_tiles + 1)
    has_obstacle = np.zeros(n_tiles + 1, np.bool_)
    pieces = _fit_pieces(surface)
    _survey(scan, faces.is_face, pieces, relief, is_level, units, result.height, sums)
    if by_roughness:
        set_roughness(tiles, sums, units, bands)
    for t in range(n_tiles + 1):
        feet[t], bands[t] = foot_of_face(bands[t], config), ground_band(bands[t], config)
    _label_by_bands(scan, faces, feet, depth, bands, has_obstacle, result)
    if by_roughness:
        _vote(scan, lowest, has_obstacle, config, result)


@jit()
def _fit_pieces(surface: GroundSurface) -> FloatArray:
    """Line of the surface across each cell, level and slope over range, (M * n_bins + 1, 2).

    The last row is for points in no cell, and NaN.
    """
    knots, mean = surface.knots, surface.mean
    n_bins = len(knots) - 1
    pieces = np.empty((len(mean) * n_bins + 1, 2))
    for m in range(len(mean)):
        for n in range(n_bins):
            piece = line_between(knots[n], knots[n + 1], mean[m, n], mean[m, n + 1])
            pieces[m * n_bins + n, 0], pieces[m * n_bins + n, 1] = piece
    pieces[len(pieces) - 1, 0] = pieces[len(pieces) - 1, 1] = math.nan
    return pieces


@jit()
def _survey(
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

    For `pieces` see `_fit_pieces`, for `sums` `gp_ground_seg.core.compiled.roughness`.
    """
    x, y, tile = scan.xyz[0], scan.xyz[1], scan.tiles.tile
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
    z, r, cell = scan.xyz[2][block], scan.grid.r[block], scan.grid.cell[block]
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


@jit()
def _label_by_bands(
    scan: Scan,
    faces: Faces,
    feet: FloatArray,
    depth: float,
    bands: FloatArray,
    has_obstacle: BoolArray,
    result: Labelled,
) -> None:
    """Label the points from their heights in `result`, and find tiles of obstacles.

    Ground reaches `depth` below the surface, `bands` (T + 1,) above it, and `feet` (T + 1,) above
    the lowest return of a face [m]. `has_obstacle` becomes true where a return near the surface is
    no ground.
    """
    z, tile, cell = scan.xyz[2], scan.tiles.tile, scan.grid.cell
    is_face, is_occluded, extremes = faces.is_face, faces.has_occluded_base, scan.tiles.extremes
    height, label, margins = result.height, result.label, result.margin
    for i in range(len(tile)):
        t = np.uintp(tile[i] if tile[i] >= 0 else len(bands) - 1)
        margin = band_margin(height[i], bands[t], depth)
        if is_face[t]:
            over_lowest = np.float64(z[i]) - np.float64(extremes[t, 0])
            margin = face_margin(margin, over_lowest, is_occluded[t], feet[t])
        margins[i] = margin
        if margin < 0.0 and is_near(height[i]):
            has_obstacle[t] = True
    # A loop of its own: without a branch it has vector instructions.
    for i in range(len(cell)):
        otherwise = _UNKNOWN if cell[i] == NOT_FINITE else _OBSTACLE
        label[i] = _GROUND if margins[i] >= 0.0 else otherwise


@jit()
def _vote(
    scan: Scan,
    lowest: float,
    has_obstacle: BoolArray,
    config: LabelConfig,
    result: Labelled,
) -> None:
    """Change margins and labels of the returns near an obstacle by the mean votes about them.

    `lowest` is that of `lowest_of` [m].
    """
    rows, around, n_rows = _number_tiles(scan.tiles, has_obstacle)
    votes = np.zeros((n_rows, N_LAYERS), np.int64)
    voters, places = _count_votes(
        scan, lowest, rows, len(around), config, result, votes.reshape(-1)
    )
    sums = _sum_around(around, votes)
    margins, unit = result.margin, config.ground_tolerance / VOTE_UNITS
    for n in range(len(voters)):
        i, place = np.uintp(voters[n]), places[n]
        layer, total = place % N_LAYERS, 0
        for step in range(N_LAYERS - 1, N_LAYERS + 2):
            total += sums[np.uintp(place - layer + (layer + step) % N_LAYERS)]
        number = total // VOTER_FLAG
        mean = (total - number * VOTER_FLAG) / number - VOTE_UNITS
        margins[i] = margin_after_vote(margins[i], mean * unit)
        result.label[i] = _GROUND if margins[i] >= 0.0 else _OBSTACLE


@jit(part=True)
def _number_tiles(tiles: Tiles, has_obstacle: BoolArray) -> tuple[CellArray, CellArray, int]:
    """Give rows in the table of votes to tiles with an obstacle, from 1 on, then to those around.

    Returns the row of each tile, (T + 1,), for each of the first rows those around it and its own,
    (R, 9), and the number of rows. Row 0 is for the other tiles, and gets no votes.
    """
    at, n_tiles, n_rows = tiles.at, len(tiles.place), 1
    n_sides, rows = int(math.sqrt(len(at))), np.zeros(n_tiles + 1, np.int32)
    for t in range(n_tiles):
        if has_obstacle[t]:
            rows[t] = n_rows
            n_rows += 1
    around = np.zeros((n_rows, 9), np.int32)
    for t in range(n_tiles):
        if not has_obstacle[t]:
            continue
        column, row, n = tiles.place[t] // n_sides, tiles.place[t] % n_sides, 0
        for x in range(max(column - 1, 0), min(column + 2, n_sides)):
            for y in range(max(row - 1, 0), min(row + 2, n_sides)):
                beside = at[np.uintp(x * n_sides + y)]
                if beside >= 0:
                    if rows[np.uintp(beside)] == 0:
                        rows[np.uintp(beside)] = n_rows
                        n_rows += 1
                    around[rows[t], n] = rows[np.uintp(beside)]
                    n += 1
    return rows, around, n_rows


@jit(part=True)
def _count_votes(
    scan: Scan,
    lowest: float,
    rows: CellArray,
    n_obstacle_rows: int,
    config: LabelConfig,
    result: Labelled,
    votes: IntArray,
) -> tuple[CellArray, CellArray]:
    """Add up the votes in each layer, whole numbers.

    Returns the voters in tiles with an obstacle, and the place of the layer of each in `votes`.
    """
    tolerance, n = config.ground_tolerance, 0
    z, tile = scan.xyz[2], scan.tiles.tile
    voters, places = np.empty(len(tile), np.int32), np.empty(len(tile), np.int32)
    for i in range(len(tile)):
        row = rows[np.uintp(tile[i] if tile[i] >= 0 else len(rows) - 1)]
        if row > 0 and is_near(result.height[i]):
            over_lowest = np.float64(z[i]) - lowest
            place = row * N_LAYERS + int(layer_of(over_lowest, tolerance))
            vote = vote_of(result.margin[i], tolerance)
            votes[np.uintp(place)] += VOTER_FLAG + int(vote + VOTE_UNITS)
            if row < n_obstacle_rows:
                voters[n], places[n] = i, place
                n += 1
    return voters[:n], places[:n]


@jit(part=True)
def _sum_around(around: CellArray, votes: IntArray) -> IntArray:
    """Sum the votes of each tile with an obstacle and the eight around it, layer by layer."""
    sums = np.zeros((len(around), N_LAYERS), np.int64)
    for k in range(1, len(around)):
        own = sums[k]
        for n in range(9):
            beside = votes[np.uintp(around[k, n])]
            for layer in range(N_LAYERS):
                own[layer] += beside[layer]
    return sums.reshape(-1)
