"""Upright faces: walls, fences, kerbs and car sides, by the shape of their returns.

A band about the ground cannot tell the foot of a wall from the ground before it.
The returns above the foot can: together they are a surface that stands upright.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from gp_ground_seg.config import FacesConfig
from gp_ground_seg.polar_grid import OUTSIDE, FloatArray, PolarGrid

FEWEST_RETURNS = 4
"""Returns that a tile needs to have an orientation."""


@dataclass(frozen=True)
class Faces:
    """Which square tiles of the plane an upright face stands in.

    Attributes
    ----------
    tile : (N,) int32
        Tile of each point, or `OUTSIDE`.
    foot_z : (T,) float64
        Height of the lowest point of each tile [m]; infinite in empty ones.
    is_face : (T,) bool
        Whether the returns of the tile are an upright face.
    """

    tile: npt.NDArray[np.int32]
    foot_z: FloatArray
    is_face: npt.NDArray[np.bool_]


def tiles_per_side(r_max: float, faces: FacesConfig) -> int:
    """Tiles along a side of the square that holds the polar grid."""
    return int(np.ceil(2.0 * r_max / faces.cell_size))


def find_faces(xyz: FloatArray, grid: PolarGrid, faces: FacesConfig, max_height: float) -> Faces:
    """Find the tiles that an upright face stands in.

    A tile is a candidate if a return lies more than ``faces.min_height`` above the
    lowest. The covariance of its returns tells their orientation; see `uprightness`.

    Parameters
    ----------
    xyz : (N, 3) float64
        Points [m].
    grid : PolarGrid
        Bins of the points; those outside belong to no tile.
    faces : FacesConfig
        Size of the tiles and what counts as a face.
    max_height : float
        Height above the lowest return up to which returns are looked at [m];
        what is higher overhangs.
    """
    half = float(grid.edges[-1])
    side = tiles_per_side(half, faces)
    inside = grid.inside
    tile = np.full(len(xyz), OUTSIDE, dtype=np.int32)
    column, row = ((xyz[inside, :2] + half) * (1.0 / faces.cell_size)).astype(np.int64).T
    tile[inside] = np.minimum(column, side - 1) * side + np.minimum(row, side - 1)

    own, points = tile[inside], xyz[inside]
    foot_z = np.full(side * side, np.inf)
    np.minimum.at(foot_z, own, points[:, 2])
    above_foot = points[:, 2] - foot_z[own]
    low = above_foot <= max_height
    is_tall = np.zeros(side * side, dtype=np.bool_)
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
    is_face = np.zeros(side * side, dtype=np.bool_)
    is_upright = uprightness(scatter) <= faces.max_normal_z
    is_face[tall] = is_upright & (count >= FEWEST_RETURNS)
    return Faces(tile, foot_z, is_face)


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
