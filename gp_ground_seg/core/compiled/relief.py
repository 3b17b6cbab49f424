"""Compiled twin of `gp_ground_seg.core.pipeline.relief`.

Tables of squares have one more at each side, so that each square has eight around it.
"""

import numpy as np

from gp_ground_seg.core.compiled.terrain import reachable
from gp_ground_seg.core.frame import (
    BoolArray,
    Candidates,
    CellArray,
    Faces,
    FloatArray,
    IntArray,
    PointArray,
)
from gp_ground_seg.core.jit import jit
from gp_ground_seg.core.parameters.config import GrowthConfig
from gp_ground_seg.core.pipeline import relief as plain

_WIDTH = plain.N_SIDES + 2
_N_SQUARES = _WIDTH * _WIDTH
_N_SUMS = 9


@jit(entry=True)
def find_relief(
    candidates: Candidates,
    faces: Faces,
    height: float,
    growth: GrowthConfig,
    pieces: FloatArray,
    z: FloatArray,
    stands: BoolArray,
) -> None:
    """Set the pieces of the relief, and heights of candidates over it; not where it is level.

    `stands` (C,) becomes true of what stands on the ground.
    """
    reached = reachable(candidates, faces, height, growth, stands)
    terrain, is_known = _fit_planes(candidates, reached, height)
    if (np.abs(terrain) <= plain.FADED).all():
        return
    _fill(terrain, is_known)
    high = plain.faded(terrain).reshape(_WIDTH, _WIDTH)[1:-1, 1:-1]
    for i in range(plain.N_SIDES - 1):
        for j in range(plain.N_SIDES - 1):
            a, b, c, d = high[i, j], high[i + 1, j], high[i, j + 1], high[i + 1, j + 1]
            for k, value in enumerate(plain.piece_of(a, b, c, d)):
                pieces[i, j, k] = value
    for k in range(len(z)):
        u = plain.from_first_middle(candidates.x[k], np.float64)
        v = plain.from_first_middle(candidates.y[k], np.float64)
        z[k] = candidates.z[k] - plain.height_in(pieces[np.uintp(u), np.uintp(v)], u, v)


@jit()
def find_places(
    x: PointArray, y: PointArray, u: PointArray, v: PointArray, piece: CellArray
) -> None:
    """Set `u`, `v` and the piece, counted over all, of places (P,) [m], in a loop of vectors."""
    n, number = np.int32(plain.N_SIDES - 1), x.dtype.type
    for i in range(len(x)):
        u[i], v[i] = plain.from_first_middle(x[i], number), plain.from_first_middle(y[i], number)
        piece[i] = np.int32(u[i]) * n + np.int32(v[i])


@jit()
def _place(i: int, j: int) -> int:
    return (i + 1) * _WIDTH + j + 1


@jit()
def _fit_planes(
    candidates: Candidates, reached: BoolArray, height: float
) -> tuple[FloatArray, BoolArray]:
    """Heights of the terrain in all squares, 0 where unknown, and which are known.

    See the plain `fit_planes`.
    """
    x, y, z = candidates.x, candidates.y, candidates.z
    square, number = np.empty(len(x), np.int64), np.zeros(_N_SQUARES, np.int64)
    for c in range(len(x)):
        square[c] = _place(int(plain.square_of(x[c])), int(plain.square_of(y[c])))
        number[square[c]] += reached[c]
    weight, plane = np.empty(len(x)), np.zeros((_N_SQUARES, 5))
    for c in range(len(x)):
        weight[c] = 1.0 / number[square[c]] if reached[c] else 0.0
    terrain, is_known = np.zeros(_N_SQUARES), np.zeros(_N_SQUARES, np.bool_)
    for _ in range(plain.N_ROUNDS):
        sums = _sums_around(x, y, z, height, weight, square)
        for k in range(_N_SQUARES):
            if number[k] > 0:
                # Element by element: assigned tuples take seconds to compile.
                for i, value in enumerate(plain.plane_of(sums[k])):
                    plane[k, i] = value
        for c in range(len(x)):
            if reached[c]:
                there = plain.height_of(plane[square[c]], x[c], y[c])
                weight[c] = plain.robust_weight(z[c] + height - there) / number[square[c]]
    for i in range(plain.N_SIDES):
        for j in range(plain.N_SIDES):
            k = _place(i, j)
            # Most squares have no terrain about them.
            if sums[k, 0] >= plain.MIN_WEIGHT:
                is_known[k] = True
                terrain[k] = plain.height_of(
                    plain.plane_of(sums[k]), plain.middle_of(i), plain.middle_of(j)
                )
    return terrain, is_known


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
def _fill(terrain: FloatArray, is_known: BoolArray) -> None:
    """See the plain `filled`; unknown heights are 0 before."""
    is_waiting, mean = np.zeros(_N_SQUARES, np.bool_), np.empty(_N_SQUARES)
    for i in range(plain.N_SIDES):
        for j in range(plain.N_SIDES):
            is_waiting[_place(i, j)] = not is_known[_place(i, j)]
    ring = np.flatnonzero(is_known)
    while len(ring) > 0:
        following, n = np.empty(_N_SQUARES, np.int64), 0
        for q in range(len(ring)):
            for step in range(-_WIDTH, _WIDTH + 1, _WIDTH):
                for k in range(ring[q] + step - 1, ring[q] + step + 2):
                    if is_waiting[k]:
                        is_waiting[k] = False
                        following[n] = k
                        n += 1
        ring = following[:n]
        for q in range(n):
            mean[q] = _mean_around(terrain, is_known, ring[q])
        for q in range(n):
            terrain[ring[q]], is_known[ring[q]] = mean[q], True


@jit()
def _mean_around(terrain: FloatArray, is_known: BoolArray, k: int) -> float:
    """Mean of the known heights in the eight squares around one."""
    number, total = 0, 0.0
    for here in range(k - 1, k + 2):
        near, far = here - _WIDTH, here + _WIDTH
        # Of one side to the other first, as in the plain `three_by_three`.
        total += (terrain[near] + terrain[here]) + terrain[far]
        for there in (near, here, far):
            number += is_known[there]
    mean: float = total / number
    return mean
