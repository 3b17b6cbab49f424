"""Stage 2: mirror images of things on a wet road.

A ray that the road reflects is taken to have gone straight on: its return lies as far below the
road as what it met stands above, at the same place in plan. Such a ray seems to pass below ground
that is seen nearer, which no ray can, while over the edge of a ditch, a dock or stairs rays pass
above it. Images that are raised again to what they are images of are no ground.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from gp_ground_seg.core.frame import BoolArray, FloatArray, IntArray, PointArray, Scan
from gp_ground_seg.core.parameters.config import SensorConfig
from gp_ground_seg.core.pipeline.ground_plane import tolerance_at
from gp_ground_seg.core.pipeline.low_sensor import is_seen_from_sensor
from gp_ground_seg.core.pipeline.sensor_pose import SensorPose

DEEP = 0.15
"""Depth below the plane from which a return may be an image [m]: more than that of a kerb."""
BELOW_SIGHT = 0.03
"""Depth at which a ray must pass below ground that is seen nearer [m]."""
NEAREST, GROUND_REACH, IMAGE_REACH = 1.0, 40.0, 60.0
"""Range from which returns may be images, up to which ground tells them, and up to which they are
told [m]: nearer there may be the robot itself."""
N_ASIDE = 4
"""Segments on each side whose ground tells the images of a segment."""
WET_SHARE, WET_REACH = 0.12, 20.0
"""Images among the candidates, for each on the plane up to this range [m], from which a road is
wet. Of dry scans the most was 0.085, of wet ones the least 0.17."""


class MirrorImages(NamedTuple):
    """Which returns are mirror images, and how high what they are images of is over them."""

    points: IntArray  # (I,) indices
    rise: FloatArray  # (I,) [m]

    def raised(self, xyz: PointArray) -> PointArray:
        """Points (N, 3), each image where what it is an image of is."""
        result: PointArray = xyz.copy()
        result[self.points, 2] += self.rise.astype(result.dtype)
        return result


def find_mirror_images(scan: Scan, pose: SensorPose, sensor: SensorConfig) -> MirrorImages:
    """Find the mirror images of a scan in the level frame: none unless the road is wet.

    Where rays start must be known: at the origin of the cloud, or above or below it at that of the
    parameters. Else there are none.
    """
    none = MirrorImages(np.zeros(0, dtype=np.int64), np.zeros(0))
    x, y, up = (pose.rotation @ (sensor.origin_x, sensor.origin_y, sensor.origin_z)).tolist()
    if not is_seen_from_sensor(pose) or (x, y) != (0.0, 0.0):
        return none
    candidates, grid = scan.candidates, scan.grid
    heights = -pose.height, up
    near_plane = np.abs(candidates.z + pose.height) <= tolerance_at(candidates.r)
    least = WET_SHARE * np.count_nonzero(near_plane & (candidates.r < WET_REACH))
    # Most scans end here.
    if np.count_nonzero(candidates.z + pose.height < -DEEP) <= least:
        return none
    cell = candidates.segment * grid.n_bins + candidates.bin
    shape = grid.n_segments, grid.n_bins
    if np.count_nonzero(_is_image(cell, candidates.r, candidates.z, heights, shape, 0)) <= least:
        return none
    inside = np.flatnonzero(grid.inside)
    cell, z = grid.cell[inside].astype(np.int64), scan.xyz[inside, 2].astype(np.float64)
    is_image = _is_image(cell, grid.r[inside].astype(np.float64), z, heights, shape, N_ASIDE)
    return MirrorImages(inside[is_image], -2.0 * (z[is_image] + pose.height))


def _is_image(
    cell: IntArray,
    r: FloatArray,
    z: FloatArray,
    heights: tuple[float, float],
    shape: tuple[int, int],
    n_aside: int,
) -> BoolArray:
    """Whether returns (P,) in cells lie below the lines of sight to ground that is nearer.

    `heights` are those of the plane of the ground and of the sensor [m], `shape` the numbers of
    segments and bins; the ground of `n_aside` segments on each side counts.
    """
    plane_z, sensor_z = heights
    slope = (z - sensor_z) / np.maximum(r, NEAREST)
    on_plane = np.abs(z - plane_z) <= tolerance_at(r)
    on_plane &= (r >= NEAREST) & (r < GROUND_REACH)
    own: FloatArray = np.full(shape, -np.inf)
    np.maximum.at(own.reshape(-1), cell[on_plane], slope[on_plane])
    highest = own
    for aside in range(1, n_aside + 1):
        both = np.maximum(np.roll(own, aside, axis=0), np.roll(own, -aside, axis=0))
        highest = np.maximum(highest, both)
    before: FloatArray = np.full(shape, -np.inf)
    np.maximum.accumulate(highest[:, :-1], axis=1, out=before[:, 1:])
    nearer = before.reshape(-1)[cell]
    may_be = np.flatnonzero((z < plane_z - DEEP) & (r >= NEAREST) & (r < IMAGE_REACH))
    may_be = may_be[(nearer[may_be] > -np.inf) & (nearer[may_be] < 0.0)]
    # A line of sight meets the plane at a range of the height over its slope.
    nearer, below = nearer[may_be], sensor_z - plane_z
    result = np.zeros(len(z), dtype=np.bool_)
    result[may_be] = (nearer - slope[may_be]) * below > -BELOW_SIGHT * nearer
    return result
