"""LiDARs, spinning or without rings, and their scans of a scene."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from numpy.random import Generator
from scipy.spatial.transform import Rotation

from gp_ground_seg.core.frame import FloatArray
from gp_ground_seg.lab.simulation import objects
from gp_ground_seg.lab.simulation.objects import Kind, KindArray
from gp_ground_seg.lab.simulation.scenes import Scene
from gp_ground_seg.lab.simulation.terrain import Terrain, first_hit

REFLECTION_MIN_DEPTH = 0.1  # a mirrored point less deep below the ground is the road itself [m]
STANCE = 1.0  # half the length and width of a vehicle on its wheels [m]
PLUMB_LINE = 200.0  # of a tilted sensor: the search for the ground starts that far above [m]

# Multiples of these fill the unit square evenly: the powers of the plastic number, the
# two-dimensional counterpart of the golden ratio.
_PLASTIC = 1.32471795724474602596
_STRIDES = np.array([1.0 / _PLASTIC, 1.0 / _PLASTIC**2])


@dataclass(frozen=True)
class SensorModel:
    """A spinning LiDAR and how it is mounted."""

    name: str
    elevations: tuple[float, ...]  # of each beam [rad], highest first
    n_columns: int  # firings per turn
    min_range: float  # nothing nearer is reported [m]
    max_range: float  # nor anything farther [m]
    range_std: float  # standard deviation of the range noise, along the ray [m]
    height: float  # above the ground under the sensor [m]
    dropout: float = 0.02  # probability that a return is lost
    # Tilt against the vehicle [rad] (REP-103):
    roll: float = 0.0  # positive lowers the right side
    pitch: float = 0.0  # positive lowers the nose
    # Where the rays start in a cloud with the axes of the vehicle [m]; None: the cloud is in
    # the frame of the sensor itself.
    origin: tuple[float, float, float] | None = None
    others: tuple[SensorModel, ...] = ()  # merged into the same cloud; each has an `origin`

    @property
    def height_of_cloud(self) -> float:
        """Height of the origin of the cloud above the ground under the sensor [m]."""
        return self.height - self.origin[2] if self.origin else self.height

    def directions(self, phase: float) -> FloatArray:
        """Return the unit vectors of all rays in the sensor frame, (R, 3).

        Ring by ring from the highest beam down; within a ring counter-clockwise from the
        azimuth `phase` [rad], 0 = straight ahead, as in KITTI's files.
        """
        turn = phase + np.arange(self.n_columns) * (2.0 * math.pi / self.n_columns)
        azimuth, elevation = np.broadcast_arrays(turn, np.asarray(self.elevations)[:, None])
        flat = np.cos(elevation)
        rays = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], -1)
        return rays.reshape(-1, 3)

    def rotation(self) -> FloatArray:
        """Matrix (3, 3) from the sensor frame to that of the vehicle."""
        return np.asarray(Rotation.from_euler('YX', [self.pitch, self.roll]).as_matrix())


@dataclass(frozen=True)
class ScatterModel(SensorModel):
    """A LiDAR without rings: rays fill the field between two `elevations`; `n_columns` is 1."""

    n_points: int = 20_000  # rays of one scan

    def directions(self, phase: float) -> FloatArray:
        """Return the unit vectors of all rays, (n_points, 3); `phase` changes all of them."""
        turns = phase / (2.0 * math.pi)
        spread = (np.arange(self.n_points)[:, None] * _STRIDES + [turns, 7.0 * turns]) % 1.0
        azimuth = 2.0 * math.pi * spread[:, 0]
        high, low = np.sin(self.elevations)
        # Evenly over the sphere, not over the angle.
        up = high + (low - high) * spread[:, 1]
        flat = np.sqrt(1.0 - up**2)
        return np.column_stack([flat * np.cos(azimuth), flat * np.sin(azimuth), up])


def _beams(*blocks: tuple[float, float, int]) -> tuple[float, ...]:
    """Elevations [rad] of blocks of evenly spaced beams: (highest, lowest [deg], number)."""
    degrees = np.concatenate([np.linspace(high, low, n) for high, low, n in blocks])
    return tuple(np.radians(degrees).tolist())


# Fields of view, ranges and accuracies are those of the makers' data sheets, columns those at
# 10 turns a second. Heights are typical mounts: KITTI's car for the HDL-64E, nuScenes' roof for
# the HDL-32E, field robots for the VLP-16 and the Mid-360.
_BLOCKS = (2.0, -8.33, 32), (-8.83, -24.33, 32)
HDL_64E = SensorModel('hdl-64e', _beams(*_BLOCKS), 2000, 0.9, 120.0, 0.02, 1.73)
HDL_32E = SensorModel('hdl-32e', _beams((10.67, -30.67, 32)), 2170, 0.9, 100.0, 0.02, 1.84)
VLP_16 = SensorModel('vlp-16', _beams((15.0, -15.0, 16)), 1800, 0.5, 100.0, 0.03, 0.8)
OS1_128 = SensorModel('os1-128', _beams((22.5, -22.5, 128)), 1024, 0.8, 120.0, 0.015, 1.8)
MID_360 = ScatterModel(
    'mid-360', (math.radians(52.0), math.radians(-7.0)), 1, 0.1, 40.0, range_std=0.02, height=0.5
)
VLP_32C = SensorModel(
    'vlp-32c',
    _beams(
        *((up, up, 1) for up in (15.0, 10.333, 7.0, 4.667, 3.333, 2.333)), (1.667, -4.0, 18),
        *((up, up, 1) for up in (-4.667, -5.333, -6.148, -7.254, -8.843, -11.31, -15.639, -25.0)),
    ),
    1800, 1.0, 200.0, range_std=0.03, height=1.9,
)  # fmt: skip
# As on Argoverse 2's cars: the frame of the cloud is on the ground below the rear axle.
_UPSIDE_DOWN = replace(VLP_32C, height=1.6, roll=math.pi, origin=(1.35, 0.0, 1.6))
# A Pandar64's beams are densest about the horizon.
PANDAR64 = replace(
    HDL_64E, name='pandar64', n_columns=1800, height=2.06,
    elevations=_beams((15.0, 3.0, 5), (2.0, -6.0, 49), (-7.0, -14.0, 8), (-19.0, -25.0, 2)),
)  # fmt: skip
SENSORS = {
    sensor.name: sensor
    for sensor in (
        HDL_64E, HDL_32E, VLP_16, OS1_128, MID_360,
        replace(HDL_64E, name='hdl-64e-vehicle', origin=(0.0, 0.0, HDL_64E.height)),
        VLP_32C,
        replace(VLP_32C, name='vlp-32c-pair', origin=(1.35, 0.0, 1.9), others=(_UPSIDE_DOWN,)),
        replace(VLP_32C, name='vlp-32c-31', elevations=VLP_32C.elevations[:-1]),
        PANDAR64,
        replace(VLP_16, name='vlp-16-low', height=0.15, min_range=0.1),
    )
}  # fmt: skip
"""LiDARs and their mounts by name; ``-vehicle`` and ``-pair``: clouds with z = 0 on the ground;
``vlp-32c-31``: without its steepest beam, which the roof of a car may hide."""


@dataclass(frozen=True)
class SimulatedScan:
    """A scan with the truth about every point; arrays are ordered as `SensorModel.directions`.

    All of it is measured at one instant: the motion during a turn is left out. Rays without a
    return are absent.
    """

    points: npt.NDArray[np.float32]  # (N, 4) x forward, y left, z up [m], intensity in [0, 1]
    is_ground: npt.NDArray[np.bool_]  # (N,) whether the ray hit the terrain
    # (N,) exact height of the terrain under (or over) each point along the sensor's z axis, sensor
    # frame [m]; over a vertical step that of one side.
    ground_z: FloatArray
    kind: KindArray  # (N,) `Kind` that the ray hit
    object_id: npt.NDArray[np.int32]  # (N,) number of the vehicle or person hit, 0: of neither
    position: FloatArray  # (3,) of the origin of the cloud's frame in the world [m]
    rotation: FloatArray  # (3, 3) turns vectors of the cloud's frame into the world's


def simulate_scan(
    scene: Scene, sensor: SensorModel, rng: Generator, x: float = 0.0
) -> SimulatedScan:
    """Scan the scene with the (first) sensor over the place `x` [m] of the drive.

    `rng` draws numbers for each ray, whether or not it hits anything: the same generator state
    gives the same noise in another scene.
    """
    vehicle = _rotation_of_vehicle(scene, x)
    ground = float(scene.terrain.height(x, 0.0))
    ahead, left, _ = sensor.origin or (0.0, 0.0, 0.0)
    position = [x, 0.0, ground] + vehicle @ [-ahead, -left, sensor.height_of_cloud]
    rotation = vehicle if sensor.origin else vehicle @ sensor.rotation()
    parts = [_cast(scene, lidar, rng, position, vehicle) for lidar in (sensor, *sensor.others)]
    points, kind, object_id = (np.concatenate(columns) for columns in zip(*parts, strict=True))
    ground_z = _ground_below(scene.terrain, points, position, rotation)
    is_ground = kind == Kind.TERRAIN
    return SimulatedScan(points, is_ground, ground_z, kind, object_id, position, rotation)


def _rotation_of_vehicle(scene: Scene, x: float) -> FloatArray:
    """Matrix (3, 3) from the frame of the vehicle at the place `x` [m] to the world's.

    A vehicle that leans stands on the ground at four places: ahead, behind, left and right.
    """
    if not scene.leans:
        return np.eye(3)
    at = STANCE * np.array([[1, 0], [-1, 0], [0, 1], [0, -1]])
    ahead, behind, left, right = scene.terrain.height(x + at[:, 0], at[:, 1]).tolist()
    forward = np.array([2.0 * STANCE, 0.0, ahead - behind])
    up = np.cross(forward, [0.0, 2.0 * STANCE, left - right])
    forward, up = (axis / np.linalg.norm(axis) for axis in (forward, up))
    return np.column_stack([forward, np.cross(up, forward), up])


def _cast(
    scene: Scene, sensor: SensorModel, rng: Generator, position: FloatArray, vehicle: FloatArray
) -> tuple[npt.NDArray[np.float32], KindArray, npt.NDArray[np.int32]]:
    """Points, kinds and objects that one sensor sees.

    `position` is of the cloud's frame, `vehicle` turns vectors of the vehicle into the world's.
    """
    beams = sensor.directions(rng.uniform(0.0, 2.0 * math.pi / sensor.n_columns))
    n_rays = len(beams)
    mirror_draw, drop_draw = rng.random(n_rays), rng.random(n_rays)
    range_noise, intensity_noise = rng.standard_normal(n_rays), rng.standard_normal(n_rays)

    direction = beams @ sensor.rotation().T
    start = np.zeros(3)
    if sensor.origin:
        beams, start = direction, np.array(sensor.origin)
    position, direction = position + vehicle @ start, direction @ vehicle.T
    origin = np.broadcast_to(position, direction.shape)

    distance = first_hit(scene.terrain, origin, direction, sensor.max_range)
    solid_distance, solid = objects.nearest_solid(scene.solids, position, direction)
    blocked = solid_distance < distance
    distance = np.where(blocked, solid_distance, distance)
    # The last row of each table is of rays that meet no solid.
    solid = np.where(blocked, solid, -1)
    kind = np.array([*(hit.kind for hit in scene.solids), Kind.TERRAIN], dtype=np.uint8)[solid]
    object_id = np.append(objects.number_objects(scene.solids), np.int32(0))[solid]
    _mirror(scene, origin, direction, distance, kind, mirror_draw)

    measured = distance + sensor.range_std * range_noise
    is_in_range = (measured >= sensor.min_range) & (measured <= sensor.max_range)
    kept = np.flatnonzero(is_in_range & (drop_draw >= sensor.dropout))
    kind = kind[kept]
    points = np.empty((len(kept), 4), dtype=np.float32)
    points[:, :3] = beams[kept] * measured[kept, None] + start
    points[:, 3] = np.clip(objects.REFLECTANCE[kind] + 0.05 * intensity_noise[kept], 0.0, 1.0)
    return points, kind, object_id[kept]


def _mirror(
    scene: Scene,
    origin: FloatArray,
    direction: FloatArray,
    distance: FloatArray,
    kind: KindArray,
    draw: FloatArray,
) -> None:
    """Move hits on wet road, in place, to the mirror images of solids, farther along the ray.

    In deep water rays that are mirrored into the sky have no return.
    """
    ray = np.flatnonzero((kind == Kind.TERRAIN) & np.isfinite(distance))
    foot = origin[ray] + distance[ray, None] * direction[ray]
    reflectivity, is_deep = np.zeros(len(ray)), np.zeros(len(ray), dtype=np.bool_)
    for patch in scene.wet_patches:
        wet = np.hypot(foot[:, 0] - patch.x, foot[:, 1] - patch.y) <= patch.radius
        reflectivity[wet] = np.maximum(reflectivity[wet], patch.reflectivity)
        is_deep |= wet & patch.is_deep
    mirrored = draw[ray] < reflectivity
    ray, foot, is_deep = ray[mirrored], foot[mirrored], is_deep[mirrored]

    slope = scene.terrain.gradient(foot[:, :2])
    normal = np.column_stack([-slope, np.ones(len(slope))])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    across = np.sum(direction[ray] * normal, axis=1, keepdims=True)
    onward, _ = objects.nearest_solid(scene.solids, foot, direction[ray] - 2.0 * across * normal)
    found = np.isfinite(onward)
    distance[ray[is_deep & ~found]] = np.inf
    ray, total = ray[found], distance[ray[found]] + onward[found]
    image = origin[ray] + total[:, None] * direction[ray]
    deep = image[:, 2] < scene.terrain.height(image[:, 0], image[:, 1]) - REFLECTION_MIN_DEPTH
    distance[ray[deep]], kind[ray[deep]] = total[deep], Kind.REFLECTION


def _ground_below(
    terrain: Terrain, points: npt.NDArray[np.floating], position: FloatArray, rotation: FloatArray
) -> FloatArray:
    """`SimulatedScan.ground_z`; where a tilted axis meets the terrain often, the highest."""
    local = points[:, :3].astype(np.float64)
    world = local @ rotation.T + position
    up = rotation[:, 2]
    if up[2] == 1.0:
        return np.asarray(terrain.height(world[:, 0], world[:, 1]) - position[2])
    down = np.broadcast_to(-up, world.shape)
    fall = first_hit(terrain, world + PLUMB_LINE * up, down, 2.0 * PLUMB_LINE)
    return np.asarray(local[:, 2] + PLUMB_LINE - fall)
