"""The passes over all points, compiled; the numpy twins are in the modules named below."""

from __future__ import annotations

import math

import numpy as np

from gp_ground_seg.compiled.meeting import Board, all_done, claim, enlist, n_taken
from gp_ground_seg.compiled.rulers import Ruler
from gp_ground_seg.frame import (
    NO_TILE,
    NOT_FINITE,
    OUTSIDE,
    CellArray,
    FloatArray,
    IntArray,
    PointArray,
)
from gp_ground_seg.jit import compiled, inlined

SORTING = 0
"""Stage of `sort_points`."""
UNKNOWN = -1
"""Instead of the number of touched tiles: what is in the table may be anything."""
BLOCK = 512
"""Points sorted at a time: what is known of them stays in the nearest cache."""
_TAKEN = 4 * BLOCK
"""Points that a thread takes at a time."""


@compiled
def sort_points(
    share: int,
    n_shares: int,
    board: Board,
    flat: PointArray,
    step: int,
    target: PointArray,
    columns: PointArray,
    ranges: Ruler,
    turns: Ruler,
    tiles_per_metre: float,
    n_sides: int,
    cell: CellArray,
    r: PointArray,
    extremes: PointArray,
    numbers: CellArray,
    tile: CellArray,
    tile_extremes: PointArray,
    touched: CellArray,
) -> None:
    """Sort points into cells and tiles, with the extremes of each, in the stage `SORTING`.

    The twins are `polar_grid.build_polar_grid`, `reduce_cells` and `tiles.build_tiles`.
    If `step` is positive, points are first put from `flat` (see `points.flat_rows`) into
    `target`, which is the memory of `columns`. The tables ``[share]`` hold what a thread
    found in the points that it took, see `gp_ground_seg.compiled.meeting`, and have a last row for
    the points that are in none. Block by block: where the points lie, in loops without
    branches; then the extremes.
    """
    share = enlist(board, share, n_shares)
    if share < 0:
        return
    n_points = len(cell)
    n_blocks = (n_points + _TAKEN - 1) // _TAKEN
    own_extremes, own_numbers = extremes[share], numbers[share]
    own_tile_extremes, own_touched = tile_extremes[share], touched[share]
    own_r_entry = np.empty(BLOCK, dtype=np.int32)
    own_turn, own_turn_entry = np.empty(BLOCK, dtype=r.dtype), np.empty(BLOCK, dtype=np.int32)
    taken, n_own = np.empty(n_blocks, dtype=np.int64), 0
    stage = np.int64(SORTING)
    block = claim(board, stage, share, n_shares, n_blocks)
    # Not where others took all: they may have gone on to the next stage.
    if block >= 0:
        empty_cells(own_extremes, own_numbers)
        empty_tiles(own_tile_extremes, own_touched)
    while block >= 0:
        taken[n_own] = block
        n_own += 1
        stop = min((block + 1) * _TAKEN, n_points)
        for first in range(block * _TAKEN, stop, BLOCK):
            own = slice(first, min(first + BLOCK, stop))
            if step > 0:
                _spread(flat[first * step :], step, target[0, own], target[1, own],
                        target[2, own])  # fmt: skip
            x, y, z = columns[0, own], columns[1, own], columns[2, own]
            _measure_range(x, y, z, ranges, r[own], own_r_entry, cell[own])
            _measure_turn(x, y, ranges.edges[-1], turns.scale, tiles_per_metre, n_sides,
                          cell[own], own_turn, own_turn_entry, tile[own])  # fmt: skip
            _look_up(ranges, turns, r[own], own_r_entry, own_turn, own_turn_entry, cell[own])
            _widen_cells(z, cell[own], own_extremes, own_numbers)
            _widen_tiles(z, tile[own], own_tile_extremes, own_touched)
        block = claim(board, stage, share, n_shares, n_blocks)
    for block in taken[:n_own]:
        own = slice(block * _TAKEN, min((block + 1) * _TAKEN, n_points))
        _settle_lowest(columns[2, own], r[own], cell[own], tile[own], own_extremes, own_numbers)
    all_done(board, stage, share, n_shares, n_blocks)


@compiled
def empty_cells(extremes: PointArray, numbers: CellArray) -> None:
    """Make the tables of the cells those of no points."""
    for k in range(len(numbers)):
        extremes[k, 0] = extremes[k, 1] = np.inf
        extremes[k, 2] = -np.inf
        numbers[k, 0], numbers[k, 1] = 0, NO_TILE


@compiled
def empty_tiles(extremes: PointArray, touched: CellArray) -> None:
    """Make the tables of the tiles those of no points.

    Only what was touched before, if that is known: it is a tenth of them.
    """
    if touched[0] == UNKNOWN:
        for k in range(len(extremes)):
            extremes[k, 0], extremes[k, 1] = np.inf, -np.inf
    else:
        for place in range(1, touched[0] + 1):
            k = np.uintp(touched[place])
            extremes[k, 0], extremes[k, 1] = np.inf, -np.inf
        # It is written for the points in no tile, but never counted.
        extremes[len(extremes) - 1, 0], extremes[len(extremes) - 1, 1] = np.inf, -np.inf
    touched[0] = 0


@compiled
def _spread(flat: PointArray, step: int, x: PointArray, y: PointArray, z: PointArray) -> None:
    """Rows to columns. Steps that are known beforehand are read in whole vectors."""
    if step == 4:
        for i in range(len(x)):
            x[i], y[i], z[i] = flat[4 * i], flat[4 * i + 1], flat[4 * i + 2]
    elif step == 3:
        for i in range(len(x)):
            x[i], y[i], z[i] = flat[3 * i], flat[3 * i + 1], flat[3 * i + 2]
    else:
        for i in range(len(x)):
            x[i], y[i], z[i] = flat[i * step], flat[i * step + 1], flat[i * step + 2]


@compiled
def _measure_range(
    x: PointArray,
    y: PointArray,
    z: PointArray,
    ranges: Ruler,
    r: PointArray,
    entry: CellArray,
    cell: CellArray,
) -> None:
    """Range of each point and its entry in the table; ``cell`` 0, or why it has none."""
    number = x.dtype.type
    zero, infinity, nothing = number(0.0), number(np.inf), number(np.nan)
    start, end, per_metre = ranges.edges[0], ranges.edges[-1], number(ranges.scale)
    for i in range(len(r)):
        finite = (abs(x[i]) < infinity) & (abs(y[i]) < infinity) & (abs(z[i]) < infinity)
        own_r = math.sqrt(x[i] * x[i] + y[i] * y[i])
        inside = finite & (own_r < end)
        r[i] = own_r if finite else nothing
        cell[i] = 0 if inside else (OUTSIDE if finite else NOT_FINITE)
        beyond = (own_r - start) * per_metre
        entry[i] = np.int32(beyond if inside & (beyond > zero) else zero)


# Apart from the other: of many arrays the compiler does not find out that none overlap.
@compiled
def _measure_turn(
    x: PointArray,
    y: PointArray,
    farthest: float,
    scale: float,
    tiles_per_metre: float,
    n_sides: int,
    cell: CellArray,
    turn: PointArray,
    entry: CellArray,
    tile: CellArray,
) -> None:
    """Pseudo-angle of each point that has a cell, its entry in the table, and the tile."""
    number = x.dtype.type
    zero, two, four = number(0.0), number(2.0), number(4.0)
    half, per_metre, last = number(farthest), number(tiles_per_metre), number(n_sides - 1)
    per_turn = number(scale)
    for i in range(len(cell)):
        inside = cell[i] == 0
        own_x = x[i] if inside else zero
        own_y = y[i] if inside else zero
        size = abs(own_x) + abs(own_y)
        share = own_y / size if size > zero else zero
        left = -share if own_y < zero else four - share
        own_turn = two + share if own_x >= zero else left
        # Exactly 4 is the edge that ends the last segment: that is segment 0 again.
        own_turn = own_turn if own_turn < four else zero
        turn[i] = own_turn
        entry[i] = np.int32(own_turn * per_turn)
        column = np.int32(min((own_x + half) * per_metre, last))
        row = np.int32(min((own_y + half) * per_metre, last))
        tile[i] = column * np.int32(n_sides) + row if inside else OUTSIDE


@compiled
def _look_up(
    ranges: Ruler,
    turns: Ruler,
    r: PointArray,
    r_entry: CellArray,
    turn: PointArray,
    turn_entry: CellArray,
    cell: CellArray,
) -> None:
    """Cell of the points that have one: the bin of the table's entry, or the one after."""
    n_bins = np.int32(len(ranges.edges) - 1)
    zero, one = np.int32(0), np.int32(1)
    for i in range(len(cell)):
        k, q = np.uintp(r_entry[i]), np.uintp(turn_entry[i])
        n = ranges.bins[k] + (one if r[i] >= ranges.ends[k] else zero)
        m = turns.bins[q] + (one if turn[i] >= turns.ends[q] else zero)
        cell[i] = m * n_bins + n if cell[i] == 0 else cell[i]
    if not ranges.is_coarse and not turns.is_coarse:
        return
    for i in range(len(cell)):
        if cell[i] < 0:
            continue
        m, n = cell[i] // n_bins, cell[i] % n_bins
        while r[i] >= ranges.edges[np.uintp(n + 1)]:
            n += one
        while turn[i] >= turns.edges[np.uintp(m + 1)]:
            m += one
        cell[i] = m * n_bins + n


@compiled
def _widen_cells(z: PointArray, cell: CellArray, extremes: PointArray, numbers: CellArray) -> None:
    """Heights and number of the points of each cell, without a branch.

    Neighbours in the scan lie in the same cell, and each waits for the one before to be
    written: points half a block apart take turns.
    """
    half = len(z) // 2
    for i in range(half):
        for j in (i, i + half):
            _widen_cell(z[j], cell[j], extremes, numbers)
    for i in range(2 * half, len(z)):
        _widen_cell(z[i], cell[i], extremes, numbers)


@inlined
def _widen_cell(z: float, cell: int, extremes: PointArray, numbers: CellArray) -> None:
    k = np.uintp(cell if cell >= 0 else len(numbers) - 1)
    low, high = extremes[k, 0], extremes[k, 2]
    extremes[k, 0] = z if z < low else low
    extremes[k, 2] = z if z > high else high
    numbers[k, 0] += np.int32(1)


@compiled
def _widen_tiles(z: PointArray, tile: CellArray, extremes: PointArray, touched: CellArray) -> None:
    """Heights of the points of each tile, likewise; after their number, those touched."""
    half = len(z) // 2
    n_touched = touched[0]
    for i in range(half):
        for j in (i, i + half):
            n_touched = _widen_tile(z[j], tile[j], extremes, touched, n_touched)
    for i in range(2 * half, len(z)):
        n_touched = _widen_tile(z[i], tile[i], extremes, touched, n_touched)
    touched[0] = n_touched


@inlined
def _widen_tile(
    z: float, tile: int, extremes: PointArray, touched: CellArray, n_touched: int
) -> int:
    k = np.uintp(tile if tile >= 0 else len(extremes) - 1)
    low, high = extremes[k, 0], extremes[k, 1]
    # Written in any case, counted only where the tile was empty.
    touched[np.uintp(n_touched + 1)] = tile
    n_touched += np.int32((low > high) & (tile >= 0))
    extremes[k, 0] = z if z < low else low
    extremes[k, 1] = z if z > high else high
    return n_touched


@compiled
def _settle_lowest(
    z: PointArray,
    r: PointArray,
    cell: CellArray,
    tile: CellArray,
    extremes: PointArray,
    numbers: CellArray,
) -> None:
    """Range and tile of the lowest point of each cell: of few points, once it is known which."""
    outside = len(numbers) - 1
    # Put down in any case, counted only where it is the lowest: no branch to guess.
    found = np.empty(BLOCK + 1, dtype=np.int64)
    for first in range(0, len(z), BLOCK):
        n_found = 0
        for i in range(first, min(first + BLOCK, len(z))):
            k = np.uintp(cell[i] if cell[i] >= 0 else outside)
            found[np.uintp(n_found)] = i
            n_found += np.int64(z[i] == extremes[k, 0])
        for i in found[:n_found]:
            if cell[i] < 0:
                continue
            k = np.uintp(cell[i])
            own, low = r[i], extremes[k, 1]
            if own < low or (own == low and tile[i] < numbers[k, 1]):
                extremes[k, 1], numbers[k, 1] = own, tile[i]


@compiled
def collect_candidates(
    board: Board,
    extremes: PointArray,
    numbers: CellArray,
    widths: FloatArray,
    min_extent: float,
    offsets: IntArray,
    r: FloatArray,
    z: FloatArray,
    own_bin: IntArray,
    density: FloatArray,
    tile: CellArray,
) -> int:
    """Do what `polar_grid.ground_candidates` does, into arrays for all bins; their number.

    `extremes` and `numbers` are the tables of all shares that `sort_points` left.
    """
    n_shares, n_bins = len(numbers), len(widths)
    low = near = high = extremes.dtype.type(0.0)
    lowest_tile = NO_TILE
    c = 0
    for m in range(len(offsets) - 1):
        offsets[m] = c
        for n in range(n_bins):
            k = m * n_bins + n
            count = 0
            for share in range(n_shares):
                # What a thread did not come to is left from before.
                own = numbers[share, k, 0]
                if own == 0 or n_taken(board, SORTING, share, n_shares) == 0:
                    continue
                own_z, own_r = extremes[share, k, 0], extremes[share, k, 1]
                own_top, own_tile = extremes[share, k, 2], numbers[share, k, 1]
                if count == 0 or (own_z, own_r, own_tile) < (low, near, lowest_tile):
                    low, near, lowest_tile = own_z, own_r, own_tile
                high = own_top if count == 0 else max(high, own_top)
                count += own
            if count == 0:
                continue
            z[c], r[c], tile[c], own_bin[c] = low, near, lowest_tile, n
            extent = np.float64(high) - np.float64(low)
            density[c] = count / (widths[n] * max(extent, min_extent))
            c += 1
    offsets[len(offsets) - 1] = c
    return c
