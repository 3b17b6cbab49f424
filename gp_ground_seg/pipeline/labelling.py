"""Labels from the distance of each point to the surface, and what stands about it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from gp_ground_seg.frame import (
    NOT_FINITE,
    BoolArray,
    Faces,
    FloatArray,
    Label,
    PointArray,
    PolarGrid,
)
from gp_ground_seg.parameters.config import LabelConfig

SQUARE_UNITS = 2.0**40
"""Squared heights are summed in whole multiples of 1 / this [1/m^2]."""


@dataclass(frozen=True)
class LabelTask:
    """Points to label, and what is known of them before there is a surface.

    Attributes
    ----------
    xyz : (N, 3) float32 or float64
        Points of a level frame [m].
    grid : PolarGrid
        Their bins.
    faces : Faces
        Upright faces.
    label : LabelConfig
        Bands.
    face_tolerance : float
        See `label_points` [m].
    """

    xyz: PointArray
    grid: PolarGrid
    faces: Faces
    label: LabelConfig
    face_tolerance: float


def label_points(
    z: FloatArray,
    height: FloatArray,
    grid: PolarGrid,
    faces: Faces,
    roughness: FloatArray,
    label: LabelConfig,
    face_tolerance: float,
) -> tuple[npt.NDArray[np.uint8], FloatArray]:
    """Label points by their height over the surface (paper, Algorithm 2, line 14).

    The paper's one tolerance is a band here that follows the local roughness, is
    narrower in a bin that an obstacle stands in, and is open downwards: obstacles
    stand on the ground, not below it. Of an upright face only the foot is ground, and
    nothing where the foot is not seen.

    Parameters
    ----------
    z : (N,) float64
        Heights in the sensor frame [m].
    height : (N,) float64
        Heights over the surface [m]; NaN where there is none.
    grid : PolarGrid
        Bins of the points.
    faces : Faces
        Upright faces.
    roughness : (M, n_bins) float64
        See `local_roughness` [m].
    label : LabelConfig
        Tolerances.
    face_tolerance : float
        Largest height of a ground point above the foot of a face [m].

    Returns
    -------
    label : (N,) uint8
        `Label` of each point; UNKNOWN for points that are not finite.
    margin : (N,) float64
        By how much the point is ground: its distance to the nearer edge of the
        band [m], negative for obstacles, NaN where there is no surface.
    """
    inside = grid.inside
    own_band = band(roughness, stands_in_bin(height, grid, label), label).ravel()
    margin = np.minimum(
        own_band[np.maximum(grid.cell, 0)] - height, height + label.below_tolerance
    )
    tile = np.maximum(faces.tiles.tile, 0)
    in_face = faces.is_face[tile] & inside
    over_foot = np.maximum(height, z - np.where(in_face, faces.tiles.foot_z[tile], 0.0))
    # A foot that is not seen lies lower than the lowest return by more than the tolerance.
    reach = np.where(faces.is_footless[tile], -face_tolerance, face_tolerance)
    margin = np.where(in_face, np.minimum(margin, reach - over_foot), margin)
    margin[~inside] = np.nan
    result = np.where(margin >= 0.0, Label.GROUND, Label.OBSTACLE).astype(np.uint8)
    result[grid.cell == NOT_FINITE] = Label.UNKNOWN
    return result, margin


def band(roughness: FloatArray, stands: BoolArray, label: LabelConfig) -> FloatArray:
    """Largest height of ground over the surface in each bin, (M, n_bins) [m].

    Parameters
    ----------
    roughness : (M, n_bins) float64
        See `local_roughness` [m].
    stands : (M, n_bins) bool
        See `stands_in_bin`.
    label : LabelConfig
        Tolerances.
    """
    free = label.ground_tolerance + label.roughness_gain * roughness
    beside = label.obstacle_tolerance + label.obstacle_roughness_gain * roughness
    result = np.where(stands, np.minimum(free, beside), free)
    return np.minimum(result, label.obstacle_min_height)


def stands_in_bin(height: FloatArray, grid: PolarGrid, label: LabelConfig) -> BoolArray:
    """Tell which bins an obstacle stands in, (M, n_bins) bool.

    The foot of a wall lies within any tolerance that ground needs; the returns
    above it give it away. Higher returns say nothing of the foot: they overhang.
    """
    result = np.zeros(grid.n_segments * grid.n_bins, dtype=np.bool_)
    shows = (
        (height >= label.obstacle_min_height) & (height <= label.obstacle_max_height) & grid.inside
    )
    result[grid.cell[shows]] = True
    return result.reshape(grid.n_segments, grid.n_bins)


def local_roughness(
    height: FloatArray, grid: PolarGrid, faces: Faces, max_height: float
) -> FloatArray:
    """Root mean square height over the surface, in bins and their neighbours.

    Each bin with the eight around it: the segments are a ring, the bins are not.

    Parameters
    ----------
    height : (N,) float64
        Heights over the surface [m]; NaN where there is none.
    grid : PolarGrid
        Bins of the points.
    faces : Faces
        Upright faces; their points are no roughness of the ground.
    max_height : float
        Largest distance from the surface that counts [m].

    Returns
    -------
    (M, n_bins) float64
        Roughness [m]; 0 where there are no points.
    """
    counts = (
        (height < max_height)
        & (height >= -max_height)
        & grid.inside
        & ~faces.is_face[np.maximum(faces.tiles.tile, 0)]
    )
    cell = grid.cell[counts]
    size = grid.n_segments * grid.n_bins
    number = np.bincount(cell, minlength=size)
    whole = np.floor(height[counts] ** 2 * SQUARE_UNITS + 0.5)
    squares = np.bincount(cell, weights=whole, minlength=size)
    return root_mean_square(number, squares, grid.n_segments)


def root_mean_square(
    number: npt.NDArray[np.int64], squares: npt.NDArray[np.generic], n_segments: int
) -> FloatArray:
    """Root of the mean square over each bin and the eight around it, (M, n_bins).

    Parameters
    ----------
    number : (M * n_bins,) int64
        Number of heights in each bin.
    squares : (M * n_bins,) float64 or int64
        Sum of their squares in units of ``1 / SQUARE_UNITS`` square metres.
    n_segments : int
        Number of segments M.
    """
    shape = n_segments, -1
    all_number = _with_neighbours(number.astype(np.float64).reshape(shape))
    all_squares = _with_neighbours(squares.astype(np.float64).reshape(shape))
    mean = all_squares / (SQUARE_UNITS * np.maximum(all_number, 1.0))
    result: FloatArray = np.sqrt(mean)
    return result


def _with_neighbours(table: FloatArray) -> FloatArray:
    """Sum over each bin and the eight around it."""
    ring = np.roll(table, 1, axis=0) + table + np.roll(table, -1, axis=0)
    result: FloatArray = ring.copy()
    result[:, 1:] += ring[:, :-1]
    result[:, :-1] += ring[:, 1:]
    return result


def ground_probability(
    margin: FloatArray, ground_std: FloatArray, roughness: FloatArray, noise: float
) -> npt.NDArray[np.float32]:
    """Probability that each point is ground.

    The surface under the point is uncertain by its predictive standard deviation,
    the point itself by the noise and by the roughness about it; all together tell
    how likely it is that the point lies on its side of the band's edge.

    Parameters
    ----------
    margin : (N,) float64
        See `label_points` [m].
    ground_std, roughness : (N,) float64
        Standard deviation of the surface and roughness at the point [m].
    noise : float
        Standard deviation of the noise [m].

    Returns
    -------
    (N,) float32
        At least 0.5 where the margin is not negative; 0 where it is NaN.
    """
    from scipy.special import ndtr

    spread = np.sqrt(ground_std**2 + roughness**2 + noise**2)
    result: npt.NDArray[np.float32] = np.nan_to_num(ndtr(margin / spread)).astype(np.float32)
    return result
