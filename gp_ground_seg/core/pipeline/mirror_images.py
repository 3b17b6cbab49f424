"""Stage 2: mirror images of things on a wet road, or in a polished floor.

A ray that the road reflects is taken to have gone straight on: its return lies as far below the
road as what it met stands above, at the same place in plan. Such a ray seems to pass below ground
that is seen nearer, which no ray can, while over the edge of a ditch, a dock or stairs rays pass
above it. Images that are raised again to what they are images of are no ground.

Where images are the lowest returns of most cells, the plane of the ground is looked for past them.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from gp_ground_seg.core.frame import (
    BoolArray,
    Candidates,
    FloatArray,
    IntArray,
    PointArray,
    Scan,
    Values,
)
from gp_ground_seg.core.jit import shared
from gp_ground_seg.core.parameters.config import SensorConfig
from gp_ground_seg.core.pipeline.ground_plane import GroundPlane, crossed_at, tolerance_at
from gp_ground_seg.core.pipeline.low_sensor import is_seen_from_sensor, is_seen_steeply
from gp_ground_seg.core.pipeline.points import Direction
from gp_ground_seg.core.pipeline.sensor_pose import SensorPose

DEEP = 0.15
"""Depth below the plane from which a return may be an image [m]: more than that of a kerb."""
BELOW_SIGHT = 0.03
"""Depth at which a ray must pass below ground that is seen nearer [m], to tell a wet road."""
OVER_SIGHT = 0.05
"""Height up to which a ray to an image passes over ground that is seen nearer, where the road is
known to be wet [m]: noise. Of rays that meet the road side by side some come back from the road,
others from what they are mirrored to."""
NEAREST, GROUND_REACH, IMAGE_REACH = 1.0, 40.0, 60.0
"""Range from which returns may be images, up to which ground tells them, and up to which they are
told [m]: nearer there may be the robot itself."""
N_ASIDE = 4
"""Segments on each side whose ground tells the images of a segment."""
WET_SHARE, WET_REACH = 0.1, 20.0
"""Images among the candidates for each on the plane, both up to this range [m], from which a road
is wet: of dry scans the most was 0.07, of wet ones the least 0.14."""
MIRRORED = 0.7
"""Share of what is deep below a mirror that is seen through returns on it: of dry scans the most
was 0.57, of wet ones, but for those of rough ground, the least 0.81."""
RING, LEAST_RANGE, N_BEHIND = 0.03, 0.1, 8
"""Width of the rings in which these returns are looked for, in parts of the range, and least range
that is told [m]: in that where a ray to an image crosses the mirror or the next on either side,
and in one of those behind these, up to this number behind the first."""
IsWet = Callable[[Candidates, float, float], bool]


class MirrorImages(NamedTuple):
    """Which returns are mirror images, and how high what they are images of is over them."""

    points: IntArray  # (I,) indices
    rise: FloatArray  # (I,) [m]

    def raised(self, xyz: PointArray) -> PointArray:
        """Points (N, 3), each image where what it is an image of is."""
        result: PointArray = xyz.copy('K')
        result[self.points, 2] += self.rise.astype(result.dtype)
        return result

    def left_out(self, scan: Scan) -> Scan:
        """Scan of the points `raised` without candidates that are images."""
        x, y = scan.xyz[self.points, :2].T
        candidates = scan.candidates
        # A candidate has the place of its return; both coordinates as one number.
        is_image = np.isin(candidates.x + 1j * candidates.y, x + 1j * y)
        return scan._replace(candidates=candidates.where(~is_image))


def find_mirror_images(
    scan: Scan, pose: SensorPose, sensor: SensorConfig, is_wet: IsWet
) -> MirrorImages:
    """Find the mirror images of a scan in the level frame: none unless the road is wet.

    Where rays start must be known: at the origin of the cloud, or above or below it at that of the
    parameters, and above the plane. Else there are none. `is_wet` is that of this module, or
    compiled.
    """
    none = MirrorImages(np.zeros(0, dtype=np.int64), np.zeros(0))
    x, y, up = (pose.rotation @ (sensor.origin_x, sensor.origin_y, sensor.origin_z)).tolist()
    if not is_seen_from_sensor(pose) or (x, y) != (0.0, 0.0):
        return none
    grid, plane_z = scan.grid, -pose.height
    if not (up > plane_z and is_wet(scan.candidates, plane_z, up)):
        return none
    inside = np.flatnonzero(grid.inside)
    r, z = grid.r[inside].astype(np.float64), scan.xyz[inside, 2].astype(np.float64)
    slope, cell = slope_of_sight(r, z, up), grid.cell[inside].astype(np.int64)
    is_ground = (r < GROUND_REACH) & is_on_plane(r, z, plane_z)
    shape = grid.n_segments, grid.n_bins
    nearer = _nearer_about(slope[is_ground], cell[is_ground], shape, N_ASIDE)[cell]
    found = is_image(r, z, slope, nearer, plane_z, up, -OVER_SIGHT)
    return MirrorImages(inside[found], -2.0 * (z[found] + pose.height))


def is_wet(candidates: Candidates, plane_z: float, sensor_z: float) -> bool:
    """Whether many candidates are images; heights are those of the ground and the sensor [m]."""
    near = np.flatnonzero((candidates.r >= NEAREST) & (candidates.r < WET_REACH))
    r, z = candidates.r[near], candidates.z[near]
    is_ground = is_on_plane(r, z, plane_z)
    most_if_dry = WET_SHARE * np.count_nonzero(is_ground)
    # Even if all that is deep were an image, the road would be dry.
    if np.count_nonzero(z < plane_z - DEEP) <= most_if_dry:
        return False
    slope = slope_of_sight(r, z, sensor_z)
    nearer = _nearer_in_segment(slope, is_ground, candidates.segment[near])
    found = is_image(r, z, slope, nearer, plane_z, sensor_z, BELOW_SIGHT)
    return bool(np.count_nonzero(found) > most_if_dry)


def in_sight(candidates: Candidates, sensor_z: float) -> Candidates:
    """Candidates below the sensor to which no ray passes below a nearer one beside it.

    Mirror images may be the lowest returns of most cells: a plane through these is that of a
    ceiling, or of nothing.
    """
    slope = slope_of_sight(candidates.r, candidates.z, sensor_z)
    shape = candidates.n_segments, int(candidates.bin.max(initial=0)) + 1
    cell = candidates.segment * shape[1] + candidates.bin
    tells = np.flatnonzero((candidates.r >= NEAREST) & (slope < 0.0))
    nearer = _nearer_about(slope[tells], cell[tells], shape, 1)[cell]
    return candidates.where((slope < 0.0) & (slope >= nearer))


@np.errstate(invalid='ignore', over='ignore')
def is_mirror(plane: GroundPlane, scan: Scan, origin: Direction) -> bool:
    """Whether much is deep below a plane, and most of it is seen through returns on the plane.

    Of rays that meet a wet floor side by side some come back from it, others from what they are
    mirrored to, and it goes on behind. Rays below a table cross its plane where there is none; the
    land ends where rays pass over an edge. `origin` is where rays start [m].
    """
    if origin[:2] != (0.0, 0.0) or not is_seen_steeply(plane):
        return False
    grid, candidates = scan.grid, scan.candidates
    near = np.flatnonzero((candidates.r >= NEAREST) & (candidates.r < WET_REACH))
    r, over = candidates.r[near], plane.below(candidates.x, candidates.y, candidates.z)[near]
    deep, n_ground = over < -DEEP, np.count_nonzero(np.abs(over) <= tolerance_at(r))
    if np.count_nonzero(deep) <= WET_SHARE * n_ground:
        return False
    crossing = crossed_at(r[deep], over[deep], plane.below(*origin))
    # Points in no cell have no place on the plane: NaN, or a range beyond the last edge.
    farthest = min(math.exp((N_BEHIND + 1) * RING) * float(crossing.max()), float(grid.edges[-1]))
    is_on_it = np.abs(plane.below(*scan.xyz.T)) <= tolerance_at(grid.r)
    on_it = np.flatnonzero(is_on_it & (grid.r < farthest))
    # Empty behind the last ring, and so before the first.
    n_rings = _ring_at(grid.edges[-1]) + N_BEHIND + 2
    has_return = np.zeros((grid.n_segments, n_rings), dtype=np.bool_)
    has_return[grid.cell[on_it] // grid.n_bins, _ring_at(grid.r[on_it])] = True
    segment, ring = candidates.segment[near[deep]], _ring_at(crossing)
    beside, behind = (
        np.any([has_return[segment, ring + step] for step in steps], axis=0)
        for steps in (range(-1, 2), range(2, N_BEHIND + 1))
    )
    n_images = np.count_nonzero(beside & behind)
    return bool(n_images > max(WET_SHARE * n_ground, MIRRORED * len(crossing)))


def _ring_at(r: Values) -> Any:
    """Return the number of the ring at a range [m]; each is wider by `RING` than the last."""
    return (np.log(np.maximum(r, LEAST_RANGE) / LEAST_RANGE) / RING).astype(np.int64)


@shared
def is_on_plane(r: Values, z: Values, plane_z: float) -> Values:
    """Whether returns are of the ground that tells images."""
    return (r >= NEAREST) & (np.abs(z - plane_z) <= tolerance_at(r))


@shared
def slope_of_sight(r: Values, z: Values, sensor_z: float) -> Values:
    """Slope of the line of sight to a return at a range and a height [m]."""
    return (z - sensor_z) / np.maximum(r, NEAREST)


@shared
def is_image(
    r: Values,
    z: Values,
    slope: Values,
    nearer: Values,
    plane_z: float,
    sensor_z: float,
    least: float,
) -> Values:
    """Whether a return is deep, and `least` below the line of sight to ground that is nearer.

    `slope` and `nearer` are the slopes of the lines of sight to it and to that ground, -inf where
    there is none; `least` is measured at the plane [m].
    """
    # Only a line of sight that points down meets the plane: at its height over its slope.
    may_be = (z < plane_z - DEEP) & (r >= NEAREST) & (r < IMAGE_REACH) & (nearer < 0.0)
    return may_be & ((nearer - slope) * (sensor_z - plane_z) > -least * nearer)


def _nearer_in_segment(slope: FloatArray, is_ground: BoolArray, segment: IntArray) -> FloatArray:
    """Highest slope to ground that is nearer in the segment of each candidate, (C,); else -inf."""
    if len(slope) == 0:
        return slope
    # The slopes of each segment are above all of the one before it.
    apart = 2.0 * float(np.abs(slope).max()) + 1.0
    base = apart * segment
    highest = np.maximum.accumulate(np.where(is_ground, slope + base, base - apart / 2.0))
    result = np.full(len(slope), -np.inf)
    result[1:] = highest[:-1] - base[1:]
    result[result <= -apart / 2.0] = -np.inf
    return result


def _nearer_about(
    slope: FloatArray, cell: IntArray, shape: tuple[int, int], n_aside: int
) -> FloatArray:
    """Highest slope to ground in a nearer bin, there or in `n_aside` segments on either side.

    `slope` and `cell`, (G,), are those of the ground, `shape` the numbers of segments and bins.
    Returns that of each cell; -inf where there is no such ground.
    """
    own: FloatArray = np.full(shape, -np.inf)
    np.maximum.at(own.reshape(-1), cell, slope)
    highest = own
    for aside in range(1, n_aside + 1):
        both = np.maximum(np.roll(own, aside, axis=0), np.roll(own, -aside, axis=0))
        highest = np.maximum(highest, both)
    before: FloatArray = np.full(shape, -np.inf)
    np.maximum.accumulate(highest[:, :-1], axis=1, out=before[:, 1:])
    return before.reshape(-1)
