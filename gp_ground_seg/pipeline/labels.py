"""Stage 6: labels from the height of each point over the surface, and p_ground."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from gp_ground_seg.frame import (
    NOT_FINITE,
    BoolArray,
    Faces,
    FloatArray,
    GroundSurface,
    IntArray,
    Label,
    Labelled,
    PolarGrid,
    Scan,
)
from gp_ground_seg.parameters.config import Config, LabelConfig

FINEST_UNITS = 2.0**40
"""Most of `square_units`."""


def label_points(scan: Scan, faces: Faces, surface: GroundSurface, config: Config) -> Labelled:
    """Label points by their height over the surface (paper, Algorithm 2, line 14).

    The paper's one tolerance is a band here that follows the local roughness, is
    narrower in a cell with an obstacle, and is wide below the surface: obstacles
    stand on the ground, not below it. Of a vertical face only
    returns near its lowest one are ground; none are where its base is occluded.

    Parameters
    ----------
    scan : Scan
        Points, cells and tiles.
    faces : Faces
        Vertical faces.
    surface : GroundSurface
        Height of the ground.
    config : Config
        Tolerances.
    """
    grid, tiles, label = scan.grid, scan.tiles, config.label
    z = scan.xyz[:, 2].astype(np.float64)
    height = z - surface.at(grid)[0]
    tile, inside = np.maximum(tiles.tile, 0), grid.inside
    in_face = faces.is_face[tile] & inside
    roughness = local_roughness(height, grid, in_face, label.obstacle_min_height)
    band = ground_band(roughness, bin_has_obstacle(height, grid, label), label).ravel()
    margin = np.minimum(band[np.maximum(grid.cell, 0)] - height, height + label.below_tolerance)
    over_base = np.maximum(height, z - np.where(in_face, tiles.lowest_z[tile], 0.0))
    # With a limit below zero no return of the tile is ground; the margin stays a distance.
    tolerance = config.faces.tolerance
    limit = np.where(faces.has_occluded_base[tile], -tolerance, tolerance)
    margin = np.where(in_face, np.minimum(margin, limit - over_base), margin)
    margin[~inside] = np.nan
    result = np.where(margin >= 0.0, Label.GROUND, Label.OBSTACLE).astype(np.uint8)
    result[grid.cell == NOT_FINITE] = Label.UNKNOWN
    return Labelled(result, height, margin, roughness)


def ground_band(roughness: FloatArray, has_obstacle: BoolArray, label: LabelConfig) -> FloatArray:
    """Largest height of ground over the surface in each cell, (M, n_bins) [m].

    Parameters
    ----------
    roughness : (M, n_bins) float64
        See `local_roughness` [m].
    has_obstacle : (M, n_bins) bool
        See `bin_has_obstacle`.
    label : LabelConfig
        Tolerances.
    """
    free = label.ground_tolerance + label.roughness_gain * roughness
    beside = label.obstacle_tolerance + label.obstacle_roughness_gain * roughness
    result = np.where(has_obstacle, np.minimum(free, beside), free)
    return np.minimum(result, label.obstacle_min_height)


def bin_has_obstacle(height: FloatArray, grid: PolarGrid, label: LabelConfig) -> BoolArray:
    """Whether an obstacle stands in each cell, (M, n_bins) bool.

    The base of a wall lies within any tolerance that ground needs; the returns above it
    show the wall. Returns above ``label.obstacle_max_height`` may overhang.
    """
    result = np.zeros(grid.n_segments * grid.n_bins, dtype=np.bool_)
    shows = (height >= label.obstacle_min_height) & (height <= label.obstacle_max_height)
    result[grid.cell[shows & grid.inside]] = True
    return result.reshape(grid.n_segments, grid.n_bins)


def local_roughness(
    height: FloatArray, grid: PolarGrid, in_face: BoolArray, max_height: float
) -> FloatArray:
    """Root mean square height over the surface in each cell and the eight around it.

    Parameters
    ----------
    height : (N,) float64
        Heights over the surface [m]; NaN where there is none.
    grid : PolarGrid
        Cells of the points.
    in_face : (N,) bool
        Points of vertical faces, which are no roughness of the ground.
    max_height : float
        Largest distance from the surface that counts [m].

    Returns
    -------
    (M, n_bins) float64
        Roughness [m]; 0 where there are no points.
    """
    counts = (height < max_height) & (height >= -max_height) & grid.inside & ~in_face
    cell = grid.cell[counts]
    size = grid.n_segments * grid.n_bins
    number = np.bincount(cell, minlength=size)
    units = square_units(len(height), max_height)
    whole = np.floor(height[counts] ** 2 * units + 0.5)
    squares = np.bincount(cell, weights=whole, minlength=size)
    near_number = sum_neighbourhood(number.reshape(grid.n_segments, -1))
    mean = sum_neighbourhood(squares.reshape(grid.n_segments, -1))
    mean /= units * np.maximum(near_number, 1.0)
    result: FloatArray = np.sqrt(mean)
    return result


def square_units(n_points: int, max_height: float) -> float:
    """Whole units that squared heights are rounded to [1/m^2].

    The order in which whole numbers are summed does not matter. The sum over all points fits
    into 63 bits even if each is `max_height` [m] from the surface.
    """
    largest = max(n_points, 1) * max_height**2
    return min(FINEST_UNITS, 2.0 ** math.floor(62.0 - math.log2(largest)))


def sum_neighbourhood(table: FloatArray | IntArray) -> FloatArray:
    """Sum over each cell and the eight around it; segments form a ring, bins do not."""
    ring = np.roll(table, 1, axis=0) + table + np.roll(table, -1, axis=0)
    result: FloatArray = ring.astype(np.float64)
    result[:, 1:] += ring[:, :-1]
    result[:, :-1] += ring[:, 1:]
    return result


def ground_probability(
    margin: FloatArray, ground_std: FloatArray, roughness: FloatArray, noise: float
) -> npt.NDArray[np.float32]:
    """Probability that each point is ground.

    The height of a point over the surface is uncertain by the standard deviation of the
    surface, the noise and the roughness together. The result is the probability that it
    lies within the band of ground.

    Parameters
    ----------
    margin : (N,) float64
        See `Labelled.margin` [m].
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
