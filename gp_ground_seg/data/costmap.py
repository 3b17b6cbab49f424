"""What a costmap takes of a segmented scan: the nearest obstacles, a grid of cells.

Places are two arrays x and y, (n,) each, in the plane of the map [m]; directions are `DIRECTIONS`
equal sectors, counter-clockwise from -x.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from gp_ground_seg.core import frame
from gp_ground_seg.core.errors import PointCloudError
from gp_ground_seg.core.frame import NOT_FINITE, BoolArray, FloatArray, Label, PointArray
from gp_ground_seg.core.ground_model import segment_of
from gp_ground_seg.core.parameters.config import ANY_HEIGHT, Config
from gp_ground_seg.core.pipeline.sensor_pose import LEAST_COSINE
from gp_ground_seg.core.result import Segmentation, cached_property
from gp_ground_seg.data import step_edges
from gp_ground_seg.data.point_cloud2 import read_xyz

DIRECTIONS = 720
FREE, OCCUPIED, UNKNOWN = 0, 100, -1
"""Values of cells, those of ``nav_msgs/OccupancyGrid``."""

# A plain integer: comparing with an enumeration is five times slower.
_OBSTACLE = int(Label.OBSTACLE)

Ranges = npt.NDArray[np.float32]
Places = tuple[PointArray, PointArray]


class Blocked(NamedTuple):
    """Places that are in the way, and what falls of the ground hide: no evidence is never free."""

    x: PointArray
    y: PointArray
    hides: Callable[[FloatArray, FloatArray], BoolArray]  # whether places are behind falls
    # (DIRECTIONS,) range of the first return, and of any, if it is behind a fall [m]
    first: Ranges
    behind: Ranges


@dataclass(frozen=True, eq=False)
class SegmentedCloud:
    """A cloud with its labels, and what of it is published under the parameters ``output``."""

    cloud: Any  # the input, a `CloudMessage`
    segmentation: Segmentation  # its labels
    config: Config
    xyz: PointArray | None = None  # (N, 3) of all points [m], where they have been read already

    @cached_property
    def points(self) -> PointArray:
        """Coordinates of all points in the frame of the cloud, (N, 3) [m]."""
        return read_xyz(self.cloud) if self.xyz is None else self.xyz

    @cached_property
    def is_ground(self) -> BoolArray:
        """Ground points, (N,) bool."""
        return self.segmentation.is_ground

    @cached_property
    def is_obstacle(self) -> BoolArray:
        """Obstacle points between the heights, (N,) bool.

        Heights are over the surface that the labels follow from. A point without a height, where
        there is no model, may stand in the way: it is one of them.
        """
        chosen: BoolArray = self.segmentation.label == _OBSTACLE
        output, height = self.config.output, self.segmentation.labelled.height
        if output.min_height > -ANY_HEIGHT:
            chosen &= ~(height < output.min_height)
        if output.max_height < ANY_HEIGHT:
            chosen &= ~(height > output.max_height)
        return chosen

    def places(self, chosen: BoolArray) -> Places:
        """Places of the `chosen` points, (N,) bool: their verticals meet z = 0 of the cloud."""
        index = np.flatnonzero(chosen)
        return self._in_plane(*(values.take(index) for values in self.points.T))

    @cached_property
    def blocked(self) -> Places | Blocked:
        """Places of the obstacles, and `Blocked` if ``output.max_step_down`` is not 0."""
        if self.config.output.max_step_down == 0.0:
            return self.places(self.is_obstacle)
        edges, pose, heading = self._found, self.segmentation.pose, self._rotation[:2, :2]
        stands = self.places(self.is_obstacle & ~edges.is_before)
        both = zip(stands, self._in_plane(*self._in_cloud(edges.points()).T), strict=True)
        x, y = (np.concatenate([a, b.astype(a.dtype)]) for a, b in both)
        ahead, left, _ = pose.origin
        level = np.full(step_edges.SECTORS, -pose.sensor_height)
        first, behind = (
            ranges_of(*self._in_plane(*self._in_cloud(step_edges.across_sectors(r, level)).T))[0]
            for r in (edges.first, edges.behind)
        )
        # In the plane of the cloud turned as the frame of the edges is.
        return Blocked(
            x, y, lambda x, y: edges.hides(*(heading @ np.stack([x - ahead, y - left]))),
            first, behind,
        )  # fmt: skip

    @cached_property
    def _rotation(self) -> FloatArray:
        """Matrix (3, 3) into the frame in which the ground that the robot stands on is level.

        A robot that pitches by less than what a scan is levelled for sees steps in level ground.
        """
        pose = self.segmentation.pose
        xyz = self._about_sensor(pose.rotation)[self.is_ground]
        return step_edges.standing_level(xyz, pose.sensor_height) @ pose.rotation

    @cached_property
    def _found(self) -> step_edges.Edges:
        found = self.segmentation
        limit, height = self.config.output.max_step_down, found.pose.sensor_height
        xyz, over = self._about_sensor(self._rotation), found.labelled.height
        # What lies below the surface, or without one below the robot, does not stand on it, and
        # tells how deep a drop is.
        over = np.where(np.isnan(over), xyz[:, 2] + height, over)
        stands = (found.label == _OBSTACLE) & ~(over < 0.0)
        xyz[found.grid.cell == NOT_FINITE] = np.nan
        return step_edges.find_edges(xyz, self.is_ground, stands, limit, height)

    def _about_sensor(self, turn: FloatArray) -> FloatArray:
        """All points about the sensor, where rays begin, turned by a matrix, (N, 3) [m]."""
        with np.errstate(over='ignore', invalid='ignore'):
            return np.asarray((self.points - np.array(self.segmentation.pose.origin)) @ turn.T)

    def _in_cloud(self, level: FloatArray) -> FloatArray:
        """Points of the frame of the edges in the frame of the cloud, (n, 3) [m]."""
        return np.asarray(level @ self._rotation + np.array(self.segmentation.pose.origin))

    def _in_plane(self, x: PointArray, y: PointArray, z: PointArray) -> Places:
        """Places of points of the cloud, (n,) each, as `places` gives them."""
        up_x, up_y, up_z = self.segmentation.pose.rotation[2].tolist()
        if abs(up_z) < LEAST_COSINE:
            raise PointCloudError(
                'the z axis of the cloud is level, so its plane is no map: transform the cloud '
                'into a level frame, or leave scan and occupancy without subscribers'
            )
        with np.errstate(over='ignore', invalid='ignore'):
            return x - up_x / up_z * z, y - up_y / up_z * z

    @property
    def heading(self) -> FloatArray:
        """Matrix (2, 2) from directions of the map to those of the level frame of the surface."""
        return self.segmentation.pose.rotation[:2, :2]


def direction_of(x: PointArray, y: PointArray) -> npt.NDArray[np.int16]:
    """Direction of each place seen from the origin, (n,) int16; any of one that is not finite."""
    # In place, and small: new memory takes longer than the arithmetic.
    turn = np.arctan2(y, x)
    turn *= DIRECTIONS / (2.0 * math.pi)
    turn += 0.5 * DIRECTIONS
    # These two, unlike clip, make a number of NaN.
    np.fmin(np.fmax(turn, 0.0, out=turn), DIRECTIONS - 1.0, out=turn)
    return turn.astype(np.int16)


@np.errstate(over='ignore', invalid='ignore')
def ranges_of(x: PointArray, y: PointArray) -> tuple[Ranges, Ranges]:
    """Range of the nearest and of the farthest place in each direction [m], (DIRECTIONS,) each.

    Infinite and minus infinite where there is none.
    """
    direction, r = direction_of(x, y), np.sqrt(x * x + y * y).astype(np.float32, copy=False)
    nearest = np.full(DIRECTIONS, np.inf, dtype=np.float32)
    farthest = -nearest
    np.fmin.at(nearest, direction, r)
    np.fmax.at(farthest, direction, r)
    return nearest, farthest


def scan_ranges(obstacles: Places | Blocked, returns: Places) -> Ranges:
    """Range of the nearest of the `obstacles` in each direction [m], (DIRECTIONS,).

    Infinite where there are other `returns` only, NaN where there is no return at all. With
    `Blocked` also NaN behind a first return below a fall, and instead of infinite behind any fall.
    """
    ranges, _ = ranges_of(*obstacles[:2])
    is_seen = np.isfinite(ranges)
    is_seen[direction_of(*returns)] = True
    ranges[~is_seen] = np.nan
    if isinstance(obstacles, Blocked):
        is_behind = step_edges.MARGIN * ranges > obstacles.first
        ranges[is_behind | (np.isinf(ranges) & (obstacles.behind < np.inf))] = np.nan
    return ranges


def reach_of_model(surface: frame.GroundSurface, heading: FloatArray, tolerance: float) -> Ranges:
    """Range up to which the ground is known to within `tolerance` [m], (DIRECTIONS,) [m].

    `heading` (2, 2) turns directions of the map into those of the level frame of `surface`.
    """
    is_known = np.logical_and.accumulate(surface.std <= tolerance, axis=1)
    reach = np.append(0.0, surface.knots)[is_known.sum(axis=1)]
    middle = (np.arange(DIRECTIONS) + 0.5) * (2.0 * math.pi / DIRECTIONS) - math.pi
    x, y = heading @ np.stack([np.cos(middle), np.sin(middle)])
    return np.asarray(reach[segment_of(x, y, len(reach))], dtype=np.float32)


@np.errstate(over='ignore')
def occupancy(
    ground: Places, obstacles: Places | Blocked, reach: Ranges, cell_size: float, grid_size: float
) -> npt.NDArray[np.int8]:
    """Cells of a square about the sensor, which is the origin of the places: (n, n) by y, x.

    A cell with an obstacle is `OCCUPIED`. One with a ground return is `FREE`, and so is one
    between the nearest and the farthest ground return of its direction, before the nearest
    obstacle and within `reach`, (DIRECTIONS,) [m]. All others are `UNKNOWN`, and so
    is what `Blocked` hides.
    """
    n_cells = math.ceil(grid_size / cell_size - 1e-6)
    direction, r = _cell_centres(n_cells, cell_size)
    nearest, farthest = ranges_of(*ground)
    until = np.minimum(np.minimum(farthest, ranges_of(*obstacles[:2])[0]), reach)
    is_passed = (r >= nearest[direction]) & (r <= until[direction])
    # Places beyond the square fall into a border of one cell.
    bordered = np.pad(np.where(is_passed, FREE, UNKNOWN).astype(np.int8), 1)
    for places, value in ((ground, FREE), (obstacles[:2], OCCUPIED)):
        column, row = (
            np.fmin(np.fmax(along / cell_size + (0.5 * n_cells + 1.0), 0.0), n_cells + 1.0)
            for along in places
        )
        bordered[row.astype(np.int32), column.astype(np.int32)] = value
    state = np.ascontiguousarray(bordered[1:-1, 1:-1])
    if isinstance(obstacles, Blocked):
        cells = np.argwhere(state == FREE)
        y, x = (cells.T + 0.5 * (1 - n_cells)) * cell_size
        state[tuple(cells[obstacles.hides(x, y)].T)] = UNKNOWN
    return state


@lru_cache(maxsize=2)
def _cell_centres(n_cells: int, cell_size: float) -> tuple[npt.NDArray[np.int16], Ranges]:
    """Direction and range [m] of the middle of every cell from that of the grid, (n, n) each."""
    along = (np.arange(n_cells) + 0.5 * (1 - n_cells)) * cell_size
    x, y = np.broadcast_arrays(along, along[:, None])
    return direction_of(x, y), np.hypot(x, y).astype(np.float32)
