"""The passes that find upright faces, compiled; the twins are `faces` and `hidden_feet`."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from gp_ground_seg.compiled.meeting import Board, all_done, claim, enlist, n_taken
from gp_ground_seg.compiled.point_passes import SORTING, empty_tiles
from gp_ground_seg.frame import OUTSIDE, CellArray, FloatArray, PointArray
from gp_ground_seg.jit import compiled, inlined
from gp_ground_seg.pipeline.faces import FEWEST_RETURNS, UNITS_PER_METRE
from gp_ground_seg.pipeline.hidden_feet import hides_foot_compiled

BoolArray = npt.NDArray[np.bool_]

# Of each tall tile two rows of sums, its lowest returns and those above: number, x, y, z, their
# squares, x y, x z, y z; the highest. Then, in the first row, `_TO_UNITS` less where x and y are
# counted from, and where z is.
_TOP, _TO_UNITS_X, _TO_UNITS_Y, _FOOT = 10, 11, 12, 13
N_COLUMNS = 14
SKIPPED = -1
"""Slot of a tile that has nothing tall."""
MERGING, SUMMING, JUDGING = SORTING + 1, SORTING + 2, SORTING + 3
BLOCK = 1024
"""Points summed up at a time."""
_SLOTS = 64
"""Tiles judged at a time."""
# Adding this to a number and taking it away again leaves whole units.
_TO_UNITS = 1.5 * 2.0**52 / UNITS_PER_METRE


@compiled
def judge_faces(
    share: int,
    n_shares: int,
    board: Board,
    columns: PointArray,
    tile: CellArray,
    extremes: PointArray,
    touched: CellArray,
    tile_size: float,
    min_height: float,
    max_height: float,
    max_normal_z: float,
    tolerance: float,
    max_foot_distance: float,
    max_foot_density: float,
    slots: CellArray,
    sums: FloatArray,
    is_face: BoolArray,
    is_footless: BoolArray,
) -> None:
    """Do what `gp_ground_seg.pipeline.faces.find_faces` does, in the stages after `SORTING`.

    Whoever comes late, as the thread that was about something else, helps with what is
    left. Coordinates are rounded so that their sums are exact: they do not depend on who
    takes which points.

    Parameters
    ----------
    share, n_shares, board
        See `gp_ground_seg.compiled.meeting`.
    columns : (3, N) float32 or float64
        Points [m].
    tile : (N,) int32
        Tile of each point.
    extremes, touched
        Tables of all shares that `point_passes.sort_points` left; those of share 0 become
        those of all points.
    slots : (2 T + 1,) int32
        Room for the sums' row of each tile, then the tile of each pair of rows; in the end
        the number of those.
    sums : (n_shares, 2 T, N_COLUMNS) float64
        Room for sums.
    is_face, is_footless : (T,) bool
        Result.
    """
    share = enlist(board, share, n_shares)
    if share < 0:
        return
    n_tiles = len(is_face)
    stage, n_blocks = np.int64(MERGING), np.int64(1)
    if claim(board, stage, share, n_shares, n_blocks) == 0:
        _merge_tiles(board, n_shares, extremes, touched)
        slots[2 * n_tiles] = _take_tall(extremes[0], touched[0], min_height, slots, n_tiles)
        is_face[:] = False
        is_footless[:] = False
    if not all_done(board, stage, share, n_shares, n_blocks):
        return
    n_slots = slots[2 * n_tiles]

    stage = np.int64(SUMMING)
    n_blocks = (len(tile) + BLOCK - 1) // BLOCK
    block = claim(board, stage, share, n_shares, n_blocks)
    if block >= 0:
        _empty(extremes[0], tile_size, n_slots, slots, sums[share])
    while block >= 0:
        own = slice(block * BLOCK, min((block + 1) * BLOCK, len(tile)))
        x, y, z = columns[0, own], columns[1, own], columns[2, own]
        _sum_up(x, y, z, tile[own], slots, max_height, tolerance, sums[share])
        block = claim(board, stage, share, n_shares, n_blocks)
    if not all_done(board, stage, share, n_shares, n_blocks):
        return

    stage = np.int64(JUDGING)
    n_blocks = (n_slots + _SLOTS - 1) // _SLOTS
    low, high = np.empty(N_COLUMNS), np.empty(N_COLUMNS)
    block = claim(board, stage, share, n_shares, n_blocks)
    while block >= 0:
        for slot in range(block * _SLOTS, min((block + 1) * _SLOTS, n_slots)):
            _add_shares(board, n_shares, 2 * slot, sums, low)
            _add_shares(board, n_shares, 2 * slot + 1, sums, high)
            top = max(low[_TOP], high[_TOP])
            if top <= min_height or not _is_upright(low, high, max_normal_z):
                continue
            t = slots[n_tiles + slot]
            is_face[t] = True
            is_footless[t] = hides_foot_compiled(
                low, high, top, tolerance, max_foot_distance, max_foot_density
            )
        block = claim(board, stage, share, n_shares, n_blocks)
    all_done(board, stage, share, n_shares, n_blocks)


@compiled
def _merge_tiles(board: Board, n_shares: int, extremes: PointArray, touched: CellArray) -> None:
    """Reduce the tables of all shares into the first, and their touched tiles."""
    if n_taken(board, SORTING, 0, n_shares) == 0:
        # Others took all points, or there are none.
        empty_tiles(extremes[0], touched[0])
    n_touched = touched[0, 0]
    for share in range(1, n_shares):
        if n_taken(board, SORTING, share, n_shares) == 0:
            continue
        for place in range(1, touched[share, 0] + 1):
            k = np.uintp(touched[share, place])
            if extremes[0, k, 0] > extremes[0, k, 1]:
                n_touched += 1
                touched[0, n_touched] = touched[share, place]
            extremes[0, k, 0] = min(extremes[0, k, 0], extremes[share, k, 0])
            extremes[0, k, 1] = max(extremes[0, k, 1], extremes[share, k, 1])
    touched[0, 0] = n_touched


@compiled
def _take_tall(
    extremes: PointArray, touched: CellArray, min_height: float, slots: CellArray, n_tiles: int
) -> int:
    """Give a slot to every tall tile; their number."""
    n_slots = 0
    for place in range(1, touched[0] + 1):
        t = np.uintp(touched[place])
        if np.float64(extremes[t, 1]) - np.float64(extremes[t, 0]) > min_height:
            slots[t] = 2 * n_slots
            slots[n_tiles + n_slots] = touched[place]
            n_slots += 1
        else:
            slots[t] = SKIPPED
    return n_slots


@compiled
def _empty(
    extremes: PointArray, tile_size: float, n_slots: int, slots: CellArray, sums: FloatArray
) -> None:
    """Make the sums of every slot empty.

    They are taken about a point of the tile: about the sensor, rounding would eat the
    scatter.
    """
    n_tiles = (len(slots) - 1) // 2
    n_sides = int(math.sqrt(n_tiles))
    half = 0.5 * n_sides * tile_size
    for slot in range(n_slots):
        t = slots[n_tiles + slot]
        for row in (2 * slot, 2 * slot + 1):
            for c in range(_TOP + 1):
                sums[row, c] = 0.0
        sums[2 * slot, _TO_UNITS_X] = _TO_UNITS - ((t // n_sides) * tile_size - half)
        sums[2 * slot, _TO_UNITS_Y] = _TO_UNITS - ((t % n_sides) * tile_size - half)
        sums[2 * slot, _FOOT] = extremes[t, 0]


@compiled
def _sum_up(
    x: PointArray,
    y: PointArray,
    z: PointArray,
    tile: CellArray,
    slots: CellArray,
    max_height: float,
    tolerance: float,
    sums: FloatArray,
) -> None:
    for i in range(len(tile)):
        if tile[i] == OUTSIDE:
            continue
        k = slots[np.uintp(tile[i])]
        if k == SKIPPED:
            continue
        low = sums[np.uintp(k)]
        above = np.float64(z[i]) - low[_FOOT]
        if above > max_height:
            continue
        dx = (np.float64(x[i]) + low[_TO_UNITS_X]) - _TO_UNITS
        dy = (np.float64(y[i]) + low[_TO_UNITS_Y]) - _TO_UNITS
        dz = (above + _TO_UNITS) - _TO_UNITS
        # No branch: whether a return is one of the lowest is anybody's guess.
        s = sums[np.uintp(k + np.int32(above > tolerance))]
        s[0] += 1.0
        s[1] += dx
        s[2] += dy
        s[3] += dz
        s[4] += dx * dx
        s[5] += dy * dy
        s[6] += dz * dz
        s[7] += dx * dy
        s[8] += dx * dz
        s[9] += dy * dz
        s[_TOP] = max(s[_TOP], above)


@inlined
def _add_shares(
    board: Board, n_shares: int, row: int, sums: FloatArray, total: FloatArray
) -> None:
    """Add up a row over all shares."""
    for c in range(_TOP + 1):
        total[c] = 0.0
    for share in range(n_shares):
        if n_taken(board, SUMMING, share, n_shares) > 0:
            for c in range(_TOP):
                total[c] += sums[share, row, c]
            total[_TOP] = max(total[_TOP], sums[share, row, _TOP])


@compiled
def _is_upright(low: FloatArray, high: FloatArray, max_normal_z: float) -> bool:
    """Tell whether the returns of a tile are an upright face, see `faces.uprightness`."""
    n, x, y, z = low[0] + high[0], low[1] + high[1], low[2] + high[2], low[3] + high[3]
    if n < FEWEST_RETURNS:
        return False
    xx = low[4] + high[4] - x * x / n
    yy = low[5] + high[5] - y * y / n
    zz = low[6] + high[6] - z * z / n
    xy = low[7] + high[7] - x * y / n
    xz = low[8] + high[8] - x * z / n
    yz = low[9] + high[9] - y * z / n
    vertical = max(xx * yy - xy * xy, 0.0)
    trace = vertical + max(yy * zz - yz * yz, 0.0) + max(xx * zz - xz * xz, 0.0)
    return trace > 0.0 and math.sqrt(vertical / trace) <= max_normal_z
