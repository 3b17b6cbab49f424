"""Stage 4: the relief of the terrain, over which lines and surfaces are found.

The surface of a segment is a function of range with a level prior. Along one segment the foot of
a bank is like that of a wall; in plan it is not, as a bank is wide and deep. So planes are fitted
robustly to the candidates that are terrain, each in 3 by 3 squares. They are the relief: it has
the height of banks and hills, and fades where the terrain is as high as the prior mean.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from gp_ground_seg.core.frame import BoolArray, Candidates, Faces, FloatArray, PointArray, Values
from gp_ground_seg.core.jit import shared
from gp_ground_seg.core.parameters.config import Config
from gp_ground_seg.core.pipeline.terrain import REACH, SQUARE, reachable, with_standing

N_SIDES = round(2.0 * REACH / SQUARE)
"""Squares along a side of the relief, which is as high beyond as at its border."""

N_ROUNDS = 3
"""Fits of the planes, each weighted by the residuals of the one before."""
ROBUST_SCALE = 0.15
"""Residual at which a candidate counts half [m]."""
RIDGE = 0.5
"""Variance that is added to those of x and y [m^2]: planes through few places are more level."""
MIN_WEIGHT = 1.5
"""Least weight of a plane, where a square with candidates counts one."""
FADED, FADE_WIDTH = 0.15, 0.3
"""Height of the terrain up to which the relief is level [m]; within this much more it grows to it
[m]."""


class Relief(NamedTuple):
    """Height of the terrain over the prior mean, in plan."""

    # (N_SIDES - 1, N_SIDES - 1, 4) pieces between the middles of four squares, see `piece_of`
    pieces: FloatArray

    @property
    def is_level(self) -> bool:
        """Whether the height is 0 everywhere."""
        return not self.pieces.any()

    @classmethod
    def level(cls) -> Relief:
        """Relief of level terrain."""
        return cls(np.zeros((N_SIDES - 1, N_SIDES - 1, 4)))

    @classmethod
    def of(cls, height: FloatArray) -> Relief:
        """Relief by its height in the middle of each square, (N_SIDES, N_SIDES) [m]."""
        corners = height[:-1, :-1], height[1:, :-1], height[:-1, 1:], height[1:, 1:]
        return cls(np.stack(piece_of(*corners), axis=-1))

    @np.errstate(invalid='ignore')
    def at(self, x: PointArray, y: PointArray) -> PointArray:
        """Height at places (P,), (P,) [m], in their precision; NaN where a place is NaN."""
        u, v = (from_first_middle(place, x.dtype.type) for place in (x, y))
        # One index: with two it takes three times as long.
        place = u.astype(np.int64) * (N_SIDES - 1) + v.astype(np.int64)
        pieces = self.pieces.reshape(-1, 4).astype(x.dtype)
        result: PointArray = height_in(pieces.take(place, axis=0, mode='clip').T, u, v)
        return result

    def at_knots(self, knots: FloatArray, n_segments: int) -> PointArray:
        """Height at ranges `knots` (K,) in the middle of each segment, (M, K) [m]."""
        azimuth = 2.0 * np.pi * (np.arange(n_segments)[:, None] + 0.5) / n_segments - np.pi
        x, y = (knots * np.cos(azimuth)).ravel(), (knots * np.sin(azimuth)).ravel()
        return self.at(x, y).reshape(n_segments, len(knots))


def find_relief(
    candidates: Candidates, faces: Faces, height: float, config: Config
) -> tuple[Relief, Candidates, Faces]:
    """Relief over a plane `height` [m] below the origin, and the candidates over the relief.

    The third is `faces` with what stands on the ground.
    """
    if not config.surface.look_aside:
        return Relief.level(), candidates, faces
    is_reached, stands = reachable(candidates, faces, height, config.growth)
    faces = with_standing(faces, candidates.tile, stands)
    reached = candidates.where(is_reached)
    terrain, is_known = fit_planes(reached.x, reached.y, reached.z + height)
    if not (np.abs(terrain[is_known]) > FADED).any():
        return Relief.level(), candidates, faces
    relief = Relief.of(faded(filled(terrain, is_known)))
    z = candidates.z - relief.at(candidates.x, candidates.y)
    return relief, candidates._replace(z=z), faces


def fit_planes(x: FloatArray, y: FloatArray, z: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Height of the terrain in the middle of each square, by the places (P,) in and around it.

    The places in a square share a weight of one, so that those near the sensor are not all. Then
    each counts less with its distance to the plane of its own square.

    Returns the heights [m] and which of them are determined, two (N_SIDES, N_SIDES); heights that
    are not determined are arbitrary.
    """
    i, j = square_of(x).astype(np.int64), square_of(y).astype(np.int64)
    square, shape = i * N_SIDES + j, (N_SIDES, N_SIDES)
    number = np.bincount(square)[square]
    weight, products = 1.0 / number, (np.ones_like(x), x, y, z, x * x, x * y, y * y, x * z, y * z)
    for _ in range(N_ROUNDS):
        sums = (np.bincount(square, weight * p, N_SIDES * N_SIDES) for p in products)
        around = [three_by_three(total.reshape(shape)) for total in sums]
        plane = plane_of(around)
        there = [table[i, j] for table in plane]
        weight = robust_weight(z - height_of(there, x, y)) / number
    middle = middle_of(np.arange(N_SIDES))
    terrain: FloatArray = height_of(plane, middle[:, None], middle)
    is_known: BoolArray = around[0] >= MIN_WEIGHT
    return terrain, is_known


def three_by_three(table: npt.NDArray[Any]) -> FloatArray:
    """Sum over each square and the eight around it, (N_SIDES, N_SIDES)."""
    padded = np.zeros([n + 2 for n in table.shape])  # `np.pad` takes as long as all the rest
    padded[1:-1, 1:-1] = table
    rows = padded[:-2] + padded[1:-1] + padded[2:]
    result: FloatArray = rows[:, :-2] + rows[:, 1:-1] + rows[:, 2:]
    return result


def filled(terrain: FloatArray, is_known: BoolArray) -> FloatArray:
    """Terrain with each unknown height the mean of those known around it, ring by ring."""
    terrain = np.where(is_known, terrain, 0.0)
    while is_known.any() and not is_known.all():
        number = three_by_three(is_known)
        mean = three_by_three(terrain) / np.maximum(number, 1.0)
        is_next = ~is_known & (number > 0.0)
        terrain[is_next] = mean[is_next]
        is_known = is_known | is_next
    return terrain


@shared
def square_of(place: Values) -> Values:
    """Square along x or y in which a place [m] lies, at most the last; a float."""
    beyond = np.floor((place + REACH) / SQUARE)
    return np.minimum(np.maximum(beyond, 0.0), N_SIDES - 1.0)


@shared
def middle_of(square: Values) -> Values:
    """Where the middle of a square lies along x or y [m]."""
    return (square + 0.5) * SQUARE - REACH


@shared
def from_first_middle(place: Values, number: Callable[[float], Values]) -> Values:
    """Squares from the middle of the first one to a place [m], along x or y, within the relief.

    `number` is the type of the place.
    """
    beyond = (place + number(REACH)) * number(1.0 / SQUARE) - number(0.5)
    return np.minimum(np.maximum(beyond, number(0.0)), number(N_SIDES - 1.0 - 1e-5))


@shared
def piece_of(a: Values, b: Values, c: Values, d: Values) -> tuple[Values, Values, Values, Values]:
    """Factors of 1, u, v and u v in the height between four middles, u and v from the first.

    That height is `a` there, `b` one square on along u, `c` along v, and `d` along both.
    """
    return a, b - a, c - a, (a - b) - (c - d)


@shared
def height_in(piece: Values, u: Values, v: Values) -> Values:
    """Height at a place, from `from_first_middle`, in the four factors of `piece_of` [m]."""
    u, v = u - np.floor(u), v - np.floor(v)
    return piece[0] + piece[1] * u + (piece[2] + piece[3] * u) * v


@shared
def plane_of(sums: Values) -> tuple[Values, Values, Values, Values, Values]:
    """Plane through places, by weighted sums of 1, x, y, z, xx, xy, yy, xz and yz.

    Returns their mean (three), and slopes along x and y; those of one place, or across a single
    ring, are level.
    """
    n, x, y, z = sums[0], sums[1], sums[2], sums[3]
    xx, xy, yy, xz, yz = sums[4], sums[5], sums[6], sums[7], sums[8]
    safe = np.maximum(n, 1e-9)
    mean_x, mean_y, mean_z = x / safe, y / safe, z / safe
    var_x, var_y = xx / safe - mean_x * mean_x, yy / safe - mean_y * mean_y
    var_xy = xy / safe - mean_x * mean_y
    var_xz, var_yz = xz / safe - mean_x * mean_z, yz / safe - mean_y * mean_z
    var_x, var_y = var_x + RIDGE, var_y + RIDGE
    determinant = var_x * var_y - var_xy * var_xy
    slope_x = (var_xz * var_y - var_yz * var_xy) / determinant
    slope_y = (var_yz * var_x - var_xz * var_xy) / determinant
    return mean_x, mean_y, mean_z, slope_x, slope_y


@shared
def height_of(plane: Values, x: Values, y: Values) -> Values:
    """Height at a place of the plane that `plane_of` gives [m]."""
    return plane[2] + plane[3] * (x - plane[0]) + plane[4] * (y - plane[1])


@shared
def robust_weight(residual: Values) -> Values:
    """Weight of a place at a distance [m] from its plane: Cauchy's."""
    share = residual / ROBUST_SCALE
    return 1.0 / (1.0 + share * share)


@shared
def faded(terrain: Values) -> Values:
    """Height of the relief where the terrain is so high [m]: level where it is low."""
    share = (np.abs(terrain) - FADED) / FADE_WIDTH
    share = np.minimum(np.maximum(share, 0.0), 1.0)
    return terrain * share * share * (3.0 - 2.0 * share)
