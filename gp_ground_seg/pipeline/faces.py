"""Upright faces: walls, fences, kerbs and car sides, by the shape of their returns.

A band about the ground cannot tell the foot of a wall from the ground before it.
The returns above the foot can: together they are a surface that stands upright.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from gp_ground_seg.frame import OUTSIDE, Faces, FloatArray, Tiles
from gp_ground_seg.parameters.config import FacesConfig
from gp_ground_seg.pipeline.hidden_feet import hides_foot

FEWEST_RETURNS = 4
"""Returns that a tile needs to have an orientation."""
UNITS_PER_METRE = 2.0**16
"""In whole units of 15 um, squares and products of coordinates within a tile, and sums of two
hundred thousand of them, are exact: they come out the same in any order."""


def find_faces(
    xyz: npt.NDArray[np.floating], tiles: Tiles, faces: FacesConfig, max_height: float
) -> Faces:
    """Find the tiles that an upright face stands in.

    A tile is a candidate if a return lies more than ``faces.min_height`` above the
    lowest. The covariance of its returns tells their orientation; see `uprightness`.
    Coordinates are rounded to `UNITS_PER_METRE`.

    Parameters
    ----------
    xyz : (N, 3) float32 or float64
        Points [m].
    tiles : Tiles
        Tiles of the points.
    faces : FacesConfig
        What counts as a face.
    max_height : float
        Height above the lowest return up to which returns are looked at [m];
        what is higher overhangs.
    """
    inside = tiles.tile != OUTSIDE
    own, points = tiles.tile[inside], xyz[inside].astype(np.float64)
    n_tiles = len(tiles.extremes)
    n_sides = math.isqrt(n_tiles)
    # About the sensor, rounding would eat the scatter.
    for i, place in enumerate(np.divmod(own, n_sides)):
        origin = place * faces.cell_size - 0.5 * n_sides * faces.cell_size
        points[:, i] -= np.rint(origin * UNITS_PER_METRE) / UNITS_PER_METRE
    above_foot = points[:, 2] - tiles.foot_z[own]
    points[:, 2] = above_foot
    points = np.rint(points * UNITS_PER_METRE) / UNITS_PER_METRE
    low = above_foot <= max_height
    is_tall = np.zeros(n_tiles, dtype=np.bool_)
    is_tall[own[low & (above_foot > faces.min_height)]] = True

    tall, counted = np.unique(own[low & is_tall[own]], return_inverse=True)
    chosen = points[low & is_tall[own]]
    count = np.bincount(counted, minlength=len(tall)).astype(np.float64)
    mean = np.empty((len(tall), 3))
    for i in range(3):
        mean[:, i] = np.bincount(counted, chosen[:, i], minlength=len(tall)) / count
    centred = chosen - mean[counted]
    scatter = np.empty((len(tall), 3, 3))
    for i in range(3):
        for j in range(3):
            product = centred[:, i] * centred[:, j]
            scatter[:, i, j] = np.bincount(counted, product, minlength=len(tall))
    is_face = np.zeros(n_tiles, dtype=np.bool_)
    is_upright = uprightness(scatter) <= faces.max_normal_z
    is_face[tall] = is_upright & (count >= FEWEST_RETURNS)
    above_own = above_foot[low & is_tall[own]]
    is_footless = np.zeros(n_tiles, dtype=np.bool_)
    is_footless[tall] = hides_foot(counted, centred, above_own, len(tall), faces) & is_face[tall]
    return Faces(tiles, is_face, is_footless)


def uprightness(scatter: FloatArray) -> FloatArray:
    """Vertical part of the unit normal of points with the given scatter, in closed form.

    The adjugate of the scatter matrix is the sum of the outer products of its
    eigenvectors, each weighted by the product of the other two eigenvalues: the
    normal of a plane, the direction of least scatter, has nearly all the weight. The
    share of the vertical in its trace is the squared vertical part of the normal.
    Of a pole, both horizontal directions count; of a shapeless cluster, all three.

    Parameters
    ----------
    scatter : (T, 3, 3) float64
        Scatter (or covariance) matrices.

    Returns
    -------
    (T,) float64
        0 for upright planes and poles, 1 for level planes; 1 where there is no scatter.
    """
    xx, yy, zz = scatter[:, 0, 0], scatter[:, 1, 1], scatter[:, 2, 2]
    xy, xz, yz = scatter[:, 0, 1], scatter[:, 0, 2], scatter[:, 1, 2]
    vertical = np.maximum(xx * yy - xy * xy, 0.0)
    trace = vertical + np.maximum(yy * zz - yz * yz, 0.0) + np.maximum(xx * zz - xz * xz, 0.0)
    known = trace > 0.0
    share = vertical[known] / trace[known]
    result = np.ones(len(scatter))
    result[known] = np.sqrt(share)
    return result
