"""Compiled twin of `gp_ground_seg.core.pipeline.labels`.

Tables of tiles have one row more, for points in no tile.
"""

import math

import numpy as np

from gp_ground_seg.core.compiled.relief import find_places
from gp_ground_seg.core.compiled.roughness import set_roughness
from gp_ground_seg.core.frame import (
    NOT_FINITE,
    BoolArray,
    CellArray,
    Faces,
    IntArray,
    Label,
    Labelled,
    PointArray,
    Scan,
    Tiles,
)
from gp_ground_seg.core.jit import jit
from gp_ground_seg.core.parameters.config import LabelConfig
from gp_ground_seg.core.pipeline import labels as plain
from gp_ground_seg.core.pipeline.relief import height_in
from gp_ground_seg.core.pipeline.vertical_faces import is_flat

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
    pieces: PointArray,
    relief: PointArray,
    is_level: bool,
    nearest: float,
    config: LabelConfig,
    highest: float,
    units: float,
    shift: int,
    lowest: float,
    by_roughness: bool,
    result: Labelled,
) -> None:
    """Height, label and margin of each point, into `result`.

    Here `Scan.xyz` is (3, N). `pieces` are those of `linear_pieces`, from the range `nearest` on,
    `relief` those of the relief, and `is_level` says whether it is level; `highest`, `units`,
    `shift` and `lowest` are those of `highest_ground`, `sum_units`, `number_shift` and
    `lowest_of`; `by_roughness` is the rule of the parameters.
    """
    n_tiles, number = len(scan.tiles.place), result.height.dtype.type
    tables, roughness = (pieces, relief, is_level, number(nearest)), np.zeros(n_tiles + 1)
    near_tile, sums = _survey(scan, *tables, highest, units, shift, result.height)
    if by_roughness:
        set_roughness(scan.tiles, sums, faces.is_face, units, shift, roughness)
    # Of each tile: the band of ground, and the top of ground in other cells and in flat ones.
    limits, kind = np.empty((n_tiles + 1, 3), number), np.empty(len(scan.extent), np.int32)
    for t in range(n_tiles + 1):
        limits[t, 0] = plain.ground_band(roughness[t], highest, config)
        limits[t, 1] = limits[t, 2] = math.inf
        if faces.is_face[t]:
            low, is_occluded = np.float64(scan.tiles.extremes[t, 0]), faces.has_occluded_base[t]
            limits[t, 1] = plain.top_of_face(roughness[t], low, is_occluded, config)
            limits[t, 2] = limits[t, 1] if is_occluded else math.inf
    for c in range(len(kind)):
        kind[c] = 2 if is_flat(scan.extent[c], config.ground_tolerance) else 1
    depth = config.obstacle_max_height if by_roughness else config.ground_tolerance
    _set_margins(scan, limits.reshape(-1), kind, number(depth), result)
    if by_roughness:
        _vote(scan, near_tile, lowest, config, result.margin)
    for i in range(len(result.label)):
        otherwise = np.uint8(_UNKNOWN) if scan.grid.cell[i] == NOT_FINITE else np.uint8(_OBSTACLE)
        result.label[i] = np.uint8(_GROUND) if result.margin[i] >= number(0.0) else otherwise


@jit()
def _survey(
    scan: Scan,
    pieces: PointArray,
    relief: PointArray,
    is_level: bool,
    nearest: float,
    highest: float,
    units: float,
    shift: int,
    height: PointArray,
) -> tuple[CellArray, IntArray]:
    """Set the height of each point; return tiles of those near the surface, and their sums.

    Tiles of others are the last one. For the sums see `set_roughness`.
    """
    near_tile = np.empty(len(height), np.int32)
    sums, flag = np.zeros(len(scan.tiles.place) + 1, np.int64), np.int64(1) << shift
    x, y, z = scan.xyz[0], scan.xyz[1], scan.xyz[2]
    u, v, piece = np.zeros(BLOCK, z.dtype), np.zeros(BLOCK, z.dtype), np.zeros(BLOCK, np.int32)
    terms = np.empty(BLOCK, np.int64)
    for first in range(0, len(z), BLOCK):
        block = slice(first, min(first + BLOCK, len(z)))
        if not is_level:
            find_places(x[block], y[block], u, v, piece)
        r, cell = scan.grid.r[block], scan.grid.cell[block]
        _measure(z[block], r, cell, nearest, pieces, relief, u, v, piece, height[block])
        tile = scan.tiles.tile[block]
        _add_squares(height[block], tile, highest, units, flag, near_tile[block], terms, sums)
    return near_tile, sums


@jit()
def _measure(
    z: PointArray,
    r: PointArray,
    cell: CellArray,
    nearest: float,
    pieces: PointArray,
    relief: PointArray,
    u: PointArray,
    v: PointArray,
    piece: CellArray,
    height: PointArray,
) -> None:
    """Heights of the points of a block over the surface and the relief."""
    outside = np.int32(len(pieces) // 2 - 1)
    for i in range(len(z)):
        c = np.uintp(2) * np.uintp(cell[i] if cell[i] >= 0 else outside)
        p = np.uintp(4) * np.uintp(piece[i] if cell[i] >= 0 else np.int32(0))
        own = relief[p], relief[p + np.uintp(1)], relief[p + np.uintp(2)], relief[p + np.uintp(3)]
        under = pieces[c] + pieces[c + np.uintp(1)] * max(r[i], nearest)
        height[i] = z[i] - under - height_in(own, u[i], v[i])


@jit()
def _add_squares(
    height: PointArray,
    tile: CellArray,
    highest: float,
    units: float,
    flag: int,
    near_tile: CellArray,
    terms: IntArray,
    sums: IntArray,
) -> None:
    """Set tiles of the points of a block, and add their terms to the sums. See `_survey`."""
    outside, quarter = np.int32(len(sums) - 1), len(height) // 4
    for i in range(len(height)):
        h = np.float64(height[i])
        is_low = plain.is_near(h, highest)
        near_tile[i] = tile[i] if is_low else outside
        terms[i] = flag + np.int64(plain.whole_units(h * h, units)) if is_low else 0
    # In four places in turn: points side by side share a tile, and would wait for each other.
    for k in range(quarter):
        for i in (k, k + quarter, k + 2 * quarter, k + 3 * quarter):
            sums[np.uintp(near_tile[np.uintp(i)])] += terms[np.uintp(i)]
    for i in range(4 * quarter, len(height)):
        sums[np.uintp(near_tile[i])] += terms[i]


@jit()
def _set_margins(
    scan: Scan, limits: PointArray, kind: CellArray, depth: float, to: Labelled
) -> None:
    """Set the margins of the points; `limits` are three of each tile, `kind` is that of a cell."""
    z, tile, cell = scan.xyz[2], scan.tiles.tile, scan.grid.cell
    last, three = np.int32(len(limits) // 3 - 1), np.uintp(3)
    for i in range(len(tile)):
        t = three * np.uintp(tile[i] if tile[i] >= 0 else last)
        top = limits[t + np.uintp(kind[np.uintp(max(cell[i], np.int32(0)))])]
        to.margin[i] = plain.margin_of(to.height[i], z[i], limits[t], top, depth)


@jit()
def _vote(
    scan: Scan, near_tile: CellArray, lowest: float, config: LabelConfig, margins: PointArray
) -> None:
    """Change the margins of the returns near an obstacle by the mean votes about them.

    `lowest` is that of `lowest_of` [m].
    """
    tolerance, outside = config.ground_tolerance, len(scan.tiles.place)
    has_obstacle = np.zeros(outside + 1, np.bool_)
    for i in range(len(near_tile)):
        has_obstacle[np.uintp(near_tile[i] if margins[i] < 0.0 else outside)] = True
    has_obstacle[outside] = False
    rows, around, n_rows = _number_tiles(scan.tiles, has_obstacle)
    voters, n = np.empty(len(near_tile) + 1, np.int32), 0
    for i in range(len(near_tile)):
        voters[np.uintp(n)] = i
        n += np.int64(rows[np.uintp(near_tile[i])] > 0)
    voters, places = voters[:n], np.empty(n, np.int32)
    # The sum of the votes in each layer of each row, whole numbers.
    votes = np.zeros(n_rows * plain.N_LAYERS, np.int64)
    for k in range(n):
        i = np.uintp(voters[k])
        layer = np.int32(plain.layer_of(np.float64(scan.xyz[2, i]) - lowest, tolerance))
        places[k] = rows[np.uintp(near_tile[i])] * np.int32(plain.N_LAYERS) + layer
        vote = plain.vote_of(np.float64(margins[i]), tolerance)
        votes[np.uintp(places[k])] += VOTER_FLAG + np.int64(vote + plain.VOTE_UNITS)
    sums = _sum_around(around, votes)
    for k in range(n):
        layer = places[k] % plain.N_LAYERS
        if places[k] >= len(sums):
            continue
        i, total = np.uintp(voters[k]), 0
        for step in range(plain.N_LAYERS - 1, plain.N_LAYERS + 2):
            total += sums[np.uintp(places[k] - layer + (layer + step) % plain.N_LAYERS)]
        number = total // VOTER_FLAG
        mean = (total - number * VOTER_FLAG) / number - plain.VOTE_UNITS
        margins[i] = plain.margin_after_vote(
            np.float64(margins[i]), mean * (tolerance / plain.VOTE_UNITS)
        )


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
def _sum_around(around: CellArray, votes: IntArray) -> IntArray:
    """Sum the votes of each tile with an obstacle and the eight around it, layer by layer."""
    sums = np.zeros(len(around) * plain.N_LAYERS, np.int64)
    for k in range(1, len(around)):
        own = sums[k * plain.N_LAYERS : (k + 1) * plain.N_LAYERS]
        for n in range(9):
            first = around[k, n] * plain.N_LAYERS
            beside = votes[first : first + plain.N_LAYERS]
            for layer in range(plain.N_LAYERS):
                own[layer] += beside[layer]
    return sums
