"""Stage 3: vertical faces (walls, fences, sides of cars) by the scatter of their returns.

A band about the ground cannot separate the base of a wall from the ground before it. The
returns above the base can: together they form a vertical surface. The base of a face is
occluded where something stands before it, or where the rings of the sensor miss the strip of
ground in its tile; the lowest return of the tile then belongs to the face.
"""

from __future__ import annotations

import math

import numpy as np

from gp_ground_seg.core.frame import OUTSIDE, BoolArray, Faces, FloatArray, IntArray, Scan
from gp_ground_seg.core.parameters.config import Config

MIN_RETURNS = 4
"""Returns that a tile needs to have an orientation."""
FLATNESS = 1e-9
"""Scatter across a line, in parts of that along it, or of each return [m^2], which is none: as
wide as coordinates are rounded to. What is left is rounding, and has no orientation."""
FOOT_SHARE = 0.2
"""Part of the least height of a face whose returns are its foot, the lowest ones."""
UNITS_PER_METRE = 2.0**16
"""Coordinates are rounded to units of 15 um: squares and products within a tile, and sums of two
hundred thousand of them, are then exact, so that their order does not matter."""


def find_faces(scan: Scan, config: Config) -> Faces:
    """Find the tiles that hold a vertical face.

    A tile is examined if a return lies more than ``label.obstacle_min_height`` above the lowest.
    The scatter of its returns determines their orientation, see `normal_z`; those higher than
    ``label.obstacle_max_height`` above the lowest may overhang, and are left out.
    """
    tiles, faces, label = scan.tiles, config.faces, config.label
    inside = tiles.tile != OUTSIDE
    own, points = tiles.tile[inside], scan.xyz[inside].astype(np.float64)
    n_tiles = len(tiles.extremes)
    n_sides = math.isqrt(n_tiles)
    # Relative to a point of the tile: about the sensor, rounding would exceed the scatter.
    for i, place in enumerate(np.divmod(own, n_sides)):
        origin = place * faces.cell_size - 0.5 * n_sides * faces.cell_size
        points[:, i] -= np.rint(origin * UNITS_PER_METRE) / UNITS_PER_METRE
    above = points[:, 2] - tiles.lowest_z[own]
    points[:, 2] = above
    points = np.rint(points * UNITS_PER_METRE) / UNITS_PER_METRE
    low = above <= label.obstacle_max_height
    is_tall = np.zeros(n_tiles, dtype=np.bool_)
    is_tall[own[low & (above > label.obstacle_min_height)]] = True

    used = low & is_tall[own]
    tall, row = np.unique(own[used], return_inverse=True)
    chosen = points[used]
    count = np.bincount(row, minlength=len(tall)).astype(np.float64)
    mean = np.empty((len(tall), 3))
    for i in range(3):
        mean[:, i] = np.bincount(row, chosen[:, i], minlength=len(tall)) / count
    centred = chosen - mean[row]
    scatter = np.empty((len(tall), 3, 3))
    for i in range(3):
        for j in range(3):
            product = centred[:, i] * centred[:, j]
            scatter[:, i, j] = np.bincount(row, product, minlength=len(tall))
    is_face = np.zeros(n_tiles, dtype=np.bool_)
    is_vertical = normal_z(scatter) < faces.max_normal_z
    is_face[tall] = is_vertical & (count >= MIN_RETURNS)
    has_occluded_base = np.zeros(n_tiles, dtype=np.bool_)
    is_foot = above[used] <= FOOT_SHARE * label.obstacle_min_height
    occluded = is_base_occluded(row, centred, is_foot, len(tall), faces.max_foot_distance)
    has_occluded_base[tall] = occluded & is_face[tall]
    return Faces(is_face, has_occluded_base)


def normal_z(scatter: FloatArray) -> FloatArray:
    """Vertical part of the unit normal of points with the given scatter, in closed form.

    The adjugate of the scatter matrix is the sum of the outer products of its
    eigenvectors, each weighted by the product of the other two eigenvalues: the
    normal of a plane, the direction of least scatter, has nearly all the weight. The
    share of the vertical in its trace is the squared vertical part of the normal.
    Of a pole, both horizontal directions count; of a shapeless cluster, all three.

    `scatter`, (T, 3, 3), holds scatter (or covariance) matrices. Returns (T,): 0 for vertical
    planes and poles, 1 for level planes, and 1 where there is no scatter, or only along a line.
    """
    xx, yy, zz = scatter[:, 0, 0], scatter[:, 1, 1], scatter[:, 2, 2]
    xy, xz, yz = scatter[:, 0, 1], scatter[:, 0, 2], scatter[:, 1, 2]
    vertical = np.maximum(xx * yy - xy * xy, 0.0)
    trace = vertical + np.maximum(yy * zz - yz * yz, 0.0) + np.maximum(xx * zz - xz * xz, 0.0)
    known = trace > FLATNESS * (xx + yy + zz) ** 2
    result = np.ones(len(scatter))
    result[known] = np.sqrt(vertical[known] / trace[known])
    return result


def is_base_occluded(
    row: IntArray, xyz: FloatArray, is_foot: BoolArray, n_rows: int, max_foot_distance: float
) -> BoolArray:
    """Whether the lowest returns of each face are its own, not ground before it.

    Ground would lie off the plane of the returns above.

    `row` (P,) is the face of each return, of `n_rows` faces T, `xyz` (P, 3) the returns, relative
    to any point of their tile [m], `is_foot` (P,) whether they are at the foot of their face.
    Returns (T,), False where fewer than two returns are above the foot.
    """

    def total(values: FloatArray, chosen: BoolArray) -> FloatArray:
        return np.bincount(row[chosen], values[chosen], minlength=n_rows).astype(np.float64)

    n_foot, n_above = (np.bincount(row[part], minlength=n_rows) for part in (is_foot, ~is_foot))
    number = np.maximum(n_above, 1)
    x = xyz[:, 0] - (total(xyz[:, 0], ~is_foot) / number)[row]
    y = xyz[:, 1] - (total(xyz[:, 1], ~is_foot) / number)[row]
    along, across = total(x * x - y * y, ~is_foot), 2.0 * total(x * y, ~is_foot)
    foot_along, foot_across = total(x * x - y * y, is_foot), 2.0 * total(x * y, is_foot)
    # Mean square along the direction in which the returns above scatter least.
    size = np.hypot(along, across)
    # Of returns in one place the direction would be rounding: all directions count alike.
    has_direction = size > FLATNESS * number
    aligned = (foot_along * along + foot_across * across) / np.where(has_direction, size, 1.0)
    aligned[~has_direction] = 0.0
    square = 0.5 * (total(x * x + y * y, is_foot) - aligned)
    is_in_plane = square <= n_foot * max_foot_distance**2
    result: BoolArray = is_in_plane & (n_above >= 2) & (max_foot_distance > 0.0)
    return result
