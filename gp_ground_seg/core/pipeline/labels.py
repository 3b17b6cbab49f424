"""Stage 6: labels from the height of each point over the surface, and p_ground."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from gp_ground_seg.core.frame import (
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
from gp_ground_seg.core.parameters.config import Config, LabelConfig

FINEST_UNITS = 2.0**40
"""Most of `square_units`."""


def label_points(scan: Scan, faces: Faces, surface: GroundSurface, config: Config) -> Labelled:
    """Label points by their height over the surface (paper, Algorithm 2, line 14).

    A point within the paper's tolerance is ground; above it, the returns about the cell decide
    (see `ground_band`); and below the surface there is no obstacle. Of a vertical face only
    returns near its lowest one are ground; none are where its base is occluded.
    """
    grid, tiles, label = scan.grid, scan.tiles, config.label
    z = scan.xyz[:, 2].astype(np.float64)
    height = z - surface.at(grid)[0]
    tile, inside = np.maximum(tiles.tile, 0), grid.inside
    in_face = faces.is_face[tile] & inside
    near = local_heights(height, grid, in_face, label)
    tolerance = label.ground_tolerance
    if label.rule == 'predictive':
        band = ground_band(near, config)[np.maximum(grid.cell, 0)]
        margin = np.minimum(band - height, height + label.obstacle_max_height)
    else:
        margin = tolerance - np.abs(height)
    over_base = np.maximum(height, z - np.where(in_face, tiles.lowest_z[tile], 0.0))
    # With a limit below zero no return of the tile is ground; the margin stays a distance.
    limit = np.where(faces.has_occluded_base[tile], -tolerance, tolerance)
    margin = np.where(in_face, np.minimum(margin, limit - over_base), margin)
    margin[~inside] = np.nan
    result = np.where(margin >= 0.0, Label.GROUND, Label.OBSTACLE).astype(np.uint8)
    result[grid.cell == NOT_FINITE] = Label.UNKNOWN
    roughness = near.roughness.reshape(grid.n_segments, grid.n_bins)
    return Labelled(result, height, margin, roughness)


class LocalHeights(NamedTuple):
    """Heights over the surface of the returns in each cell and the eight around it.

    Each is (M * n_bins,).
    """

    # Returns within ``label.obstacle_min_height`` of the surface, but for those of faces.
    n_near: FloatArray
    roughness: FloatArray  # their root mean square height [m]; 0 where there are none
    n_obstacles: FloatArray  # returns from that height to ``label.obstacle_max_height``


def ground_band(near: LocalHeights, config: Config) -> FloatArray:
    """Largest height of ground over the surface in each cell, (M * n_bins,) [m].

    The height of a ground return is normally distributed about the surface, with the local
    roughness and the noise; returns of obstacles are spread evenly over height, as densely as
    those that are too high for ground. Up to the band a return is more likely ground. One more
    obstacle return is counted than there is: that none was seen does not exclude any.
    """
    label = config.label
    variance = near.roughness**2 + config.observation.sigma_n**2
    obstacles_per_metre = (near.n_obstacles + 1.0) / (
        label.obstacle_max_height - label.obstacle_min_height
    )
    ground_per_metre = np.maximum(near.n_near, 1.0) / np.sqrt(2.0 * np.pi * variance)
    log_ratio = np.log(ground_per_metre / obstacles_per_metre)
    likely = np.sqrt(2.0 * variance * np.maximum(log_ratio, 0.0))
    result: FloatArray = np.minimum(
        np.maximum(likely, label.ground_tolerance), label.obstacle_min_height
    )
    return result


def local_heights(
    height: FloatArray, grid: PolarGrid, in_face: BoolArray, label: LabelConfig
) -> LocalHeights:
    """Count the returns about each cell.

    `height` (N,) is over the surface [m], NaN where there is none; points `in_face` (N,), of
    vertical faces, are no roughness of the ground.
    """
    low, high = label.obstacle_min_height, label.obstacle_max_height
    units = square_units(len(height), low)

    def total(counts: BoolArray, weights: FloatArray | None = None) -> FloatArray:
        table = np.bincount(grid.cell[counts], weights, grid.n_segments * grid.n_bins)
        return sum_neighbourhood(table.reshape(grid.n_segments, grid.n_bins)).ravel()

    is_near = (height < low) & (height >= -low) & grid.inside & ~in_face
    n_near = total(is_near)
    squares = total(is_near, np.floor(height[is_near] ** 2 * units + 0.5))
    roughness = np.sqrt(squares / (units * np.maximum(n_near, 1.0)))
    return LocalHeights(n_near, roughness, total((height >= low) & (height <= high) & grid.inside))


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

    For `margin` (N,) see `Labelled.margin` [m]; `ground_std` and `roughness` (N,) are those at the
    point, `noise` is a standard deviation [m]. Returns (N,), at least 0.5 where the margin is not
    negative; 0 where it is NaN.
    """
    from scipy.special import ndtr

    spread = np.sqrt(ground_std**2 + roughness**2 + noise**2)
    result: npt.NDArray[np.float32] = np.nan_to_num(ndtr(margin / spread)).astype(np.float32)
    return result
