"""Compiled twin of `gp_ground_seg.core.pipeline.relief`.

Tables of squares have one more at each side, so that each square has eight around it.
"""

from __future__ import annotations

import numpy as np

from gp_ground_seg.core.compiled.land import reachable
from gp_ground_seg.core.frame import (
    BoolArray,
    Candidates,
    CellArray,
    FloatArray,
    IntArray,
    PointArray,
)
from gp_ground_seg.core.jit import jit
from gp_ground_seg.core.parameters.config import GrowthConfig
from gp_ground_seg.core.pipeline.relief import (
    FADED,
    MIN_RAISED,
    MIN_WEIGHT,
    N_ROUNDS,
    N_SIDES,
    RAISED,
    faded,
    from_first_middle,
    height_in,
    height_of,
    middle_of,
    piece_of,
    plane_of,
    robust_weight,
    square_of,
)

_WIDTH = N_SIDES + 2
_N_SQUARES = _WIDTH * _WIDTH
_N_SUMS = 9


@jit(entry=True)
def find_relief(
    candidates: Candidates,
    is_face: BoolArray,
    height: float,
    growth: GrowthConfig,
    pieces: FloatArray,
    z: FloatArray,
) -> bool:
    """Set the pieces of the relief, and heights of candidates over it; return whether it is level.

    Where it is, nothing is set.
    """
    before, behind = reachable(candidates, is_face, height, growth)
    land, is_known = _land_of(candidates, before, height)
    below, is_known_below = land, np.zeros(_N_SQUARES, np.bool_)
    if behind.any():
        below, is_known_below = _land_of(candidates, behind, height)
    if max(_highest(land, is_known), _highest(below, is_known_below)) <= FADED:
        return True
    is_behind = np.zeros(_N_SQUARES, np.bool_)
    if is_known_below.any():
        is_behind = _behind_of(candidates, before, is_known, behind, is_known_below)
        _set_pieces(below, is_known_below, is_behind, pieces)
    _set_pieces(land, is_known, ~is_behind, pieces)
    for c in range(len(z)):
        z[c] = candidates.z[c] - height_at(pieces, candidates.x[c], candidates.y[c])
    return False


@jit()
def _land_of(
    candidates: Candidates, chosen: BoolArray, height: float
) -> tuple[FloatArray, BoolArray]:
    """See the plain `_land_of`."""
    land, is_known, number = _fit_planes(candidates, chosen, height)
    _leave_out_small(land, is_known, number)
    return land, is_known


@jit()
def _highest(land: FloatArray, is_known: BoolArray) -> float:
    """Greatest height or depth of the land that is known [m]."""
    highest = 0.0
    for k in range(_N_SQUARES):
        highest = max(highest, abs(land[k])) if is_known[k] else highest
    return highest


@jit()
def _set_pieces(
    land: FloatArray, is_known: BoolArray, chosen: BoolArray, pieces: FloatArray
) -> None:
    """Set the `chosen` ones of the pieces by the land, and let it be known all over."""
    _fill(land, is_known)
    for k in range(_N_SQUARES):
        land[k] = faded(land[k])
    for i in range(N_SIDES - 1):
        for j in range(N_SIDES - 1):
            k = _place(i, j)
            if chosen[k]:
                corners = land[k], land[k + _WIDTH], land[k + 1], land[k + 1 + _WIDTH]
                level, along_u, along_v, twist = piece_of(*corners, i, j)
                pieces[i, j, 0], pieces[i, j, 1] = level, along_u
                pieces[i, j, 2], pieces[i, j, 3] = along_v, twist


@jit()
def _behind_of(
    candidates: Candidates,
    before: BoolArray,
    is_known: BoolArray,
    behind: BoolArray,
    is_known_below: BoolArray,
) -> BoolArray:
    """Which pieces are of the land behind falls, (squares,). See the plain `_is_behind`."""
    share, is_seen = np.zeros(_N_SQUARES), np.zeros(_N_SQUARES, np.bool_)
    for c in range(len(before)):
        x, y = candidates.x[c], candidates.y[c]
        square = _place(int(square_of(x)), int(square_of(y)))
        piece = _place(int(from_first_middle(x)), int(from_first_middle(y)))
        if before[c] and is_known[square]:
            share[piece], is_seen[piece] = 1.0, True
        elif behind[c] and is_known_below[square]:
            is_seen[piece] = True
    # Of those without land, all that are as near to land before falls get a share of it.
    _fill(share, is_seen)
    result: BoolArray = is_seen & (share == 0.0)
    return result


@jit()
def height_at(pieces: FloatArray, x: float, y: float) -> float:
    """Height of the relief at a place [m]."""
    u, v = from_first_middle(x), from_first_middle(y)
    height: float = height_in(pieces[np.uintp(u), np.uintp(v)], u, v)
    return height


@jit()
def find_places(
    x: PointArray, y: PointArray, u: FloatArray, v: FloatArray, piece: CellArray
) -> None:
    """Set `u`, `v` and the piece, counted over all, of places (P,) [m], in a loop of vectors."""
    n = np.int32(N_SIDES - 1)
    for i in range(len(x)):
        along_u, along_v = from_first_middle(np.float64(x[i])), from_first_middle(np.float64(y[i]))
        u[i], v[i], piece[i] = along_u, along_v, np.int32(along_u) * n + np.int32(along_v)


@jit()
def _place(i: int, j: int) -> int:
    return (i + 1) * _WIDTH + j + 1


@jit()
def _fit_planes(
    candidates: Candidates, reached: BoolArray, height: float
) -> tuple[FloatArray, BoolArray, IntArray]:
    """Heights of the land, which are known, and numbers of candidates, of all squares.

    See the plain `fit_planes`.
    """
    x, y, z = candidates.x, candidates.y, candidates.z
    square, number = np.empty(len(x), np.int64), np.zeros(_N_SQUARES, np.int64)
    for c in range(len(x)):
        square[c] = _place(int(square_of(x[c])), int(square_of(y[c])))
        number[square[c]] += reached[c]
    weight, plane = np.empty(len(x)), np.zeros((_N_SQUARES, 5))
    for c in range(len(x)):
        weight[c] = 1.0 / number[square[c]] if reached[c] else 0.0
    land, is_known = np.zeros(_N_SQUARES), np.zeros(_N_SQUARES, np.bool_)
    for _ in range(N_ROUNDS):
        sums = _sums_around(x, y, z, height, weight, square)
        for k in range(_N_SQUARES):
            if number[k] > 0:
                _set_plane(sums[k], plane[k])
        for c in range(len(x)):
            if reached[c]:
                there = height_of(plane[square[c]], x[c], y[c])
                weight[c] = robust_weight(z[c] + height - there) / number[square[c]]
    for i in range(N_SIDES):
        for j in range(N_SIDES):
            k = _place(i, j)
            # Most squares have no land about them.
            if sums[k, 0] >= MIN_WEIGHT:
                _set_plane(sums[k], plane[k])
                is_known[k] = True
                land[k] = height_of(plane[k], middle_of(i), middle_of(j))
    return land, is_known, number


@jit()
def _set_plane(sums: FloatArray, plane: FloatArray) -> None:
    """Set mean and slopes of a plane by its sums (9,)."""
    plane[0], plane[1], plane[2], plane[3], plane[4] = plane_of(sums)


@jit()
def _sums_around(
    x: FloatArray,
    y: FloatArray,
    z: FloatArray,
    height: float,
    weight: FloatArray,
    square: IntArray,
) -> FloatArray:
    """Weighted sums of `plane_of` over each square and the eight around it, (squares, 9)."""
    own = np.zeros(_N_SQUARES * _N_SUMS)
    for c in range(len(x)):
        w, over, first = weight[c], z[c] + height, square[c] * _N_SUMS
        if w > 0.0:
            own[first] += w
            own[first + 1] += w * x[c]
            own[first + 2] += w * y[c]
            own[first + 3] += w * over
            own[first + 4] += w * (x[c] * x[c])
            own[first + 5] += w * (x[c] * y[c])
            own[first + 6] += w * (y[c] * y[c])
            own[first + 7] += w * (x[c] * over)
            own[first + 8] += w * (y[c] * over)
    # What stays arbitrary is that of squares at the border, which nothing needs.
    rows, around = np.empty(len(own)), np.empty(len(own))
    column, row = np.uintp(_WIDTH * _N_SUMS), np.uintp(_N_SUMS)
    for k in range(column, np.uintp(len(own)) - column):
        rows[k] = own[k - column] + own[k] + own[k + column]
    for k in range(column, np.uintp(len(own)) - column):
        around[k] = rows[k - row] + rows[k] + rows[k + row]
    return around.reshape(_N_SQUARES, _N_SUMS)


@jit()
def _leave_out_small(land: FloatArray, is_known: BoolArray, number: IntArray) -> None:
    """See the plain `leave_out_small`."""
    is_seen, part = np.zeros(_N_SQUARES, np.bool_), np.empty(_N_SQUARES, np.int64)
    for start in range(_N_SQUARES):
        n = stop = 0
        if is_known[start] and abs(land[start]) > RAISED and not is_seen[start]:
            part[0], is_seen[start], stop = start, True, 1
        while n < stop:
            for step in (-_WIDTH, -1, 1, _WIDTH):
                k = part[n] + step
                if is_known[k] and abs(land[k]) > RAISED and not is_seen[k]:
                    part[stop], is_seen[k] = k, True
                    stop += 1
            n += 1
        n_occupied = 0
        for n in range(stop):
            n_occupied += number[part[n]] > 0
        if n_occupied < MIN_RAISED:
            for n in range(stop):
                is_known[part[n]] = False


@jit()
def _fill(land: FloatArray, is_known: BoolArray) -> None:
    """See the plain `filled`."""
    ring, following = np.empty(_N_SQUARES, np.int64), np.empty(_N_SQUARES, np.int64)
    is_waiting, mean = np.zeros(_N_SQUARES, np.bool_), np.empty(_N_SQUARES)
    n = 0
    for i in range(N_SIDES):
        for j in range(N_SIDES):
            k = _place(i, j)
            is_waiting[k] = not is_known[k]
            if is_known[k]:
                ring[n] = k
                n += 1
            else:
                land[k] = 0.0
    while n > 0:
        n_following = 0
        for q in range(n):
            for step in range(-_WIDTH, _WIDTH + 1, _WIDTH):
                for k in range(ring[q] + step - 1, ring[q] + step + 2):
                    if is_waiting[k]:
                        is_waiting[k] = False
                        following[n_following] = k
                        n_following += 1
        for q in range(n_following):
            mean[q] = _mean_around(land, is_known, following[q])
        for q in range(n_following):
            land[following[q]], is_known[following[q]] = mean[q], True
        ring, following, n = following, ring, n_following


@jit()
def _mean_around(land: FloatArray, is_known: BoolArray, k: int) -> float:
    """Mean of the known heights in the eight squares around one."""
    number, total = 0, 0.0
    for here in range(k - 1, k + 2):
        near, far = here - _WIDTH, here + _WIDTH
        # Of one side to the other first, as in the plain `three_by_three`.
        total += (land[near] + land[here]) + land[far]
        for there in (near, here, far):
            number += is_known[there]
    mean: float = total / number
    return mean
