"""Scans of a scene: one turn of the sensor, a drive, a SemanticKITTI sequence."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from gp_ground_seg.data.atomic_output import staged_folder
from gp_ground_seg.errors import ConfigError, DataError
from gp_ground_seg.frame import FloatArray
from gp_ground_seg.simulation.objects import (
    Kind,
    KindArray,
    nearest_solid,
    reflectance,
    semantic_kitti_labels,
)
from gp_ground_seg.simulation.raycast import first_hit
from gp_ground_seg.simulation.scenes import Scene
from gp_ground_seg.simulation.sensor import SensorModel
from gp_ground_seg.simulation.terrain import Terrain

FRAME_PERIOD = 0.1
"""Time of one turn of the sensor [s]."""
REFLECTION_MIN_DEPTH = 0.1
"""A mirrored point less deep below the ground than this is the road itself to any sensor [m]."""
INTENSITY_STD = 0.05
PLUMB_LINE = 200.0
"""How far above a point the search for the ground below it starts, for a tilted sensor [m]."""


@dataclass(frozen=True)
class SimulatedScan:
    """A scan with the truth about every point; arrays are ordered as `SensorModel.directions`.

    All of it is measured at one instant: the motion during a turn is left out. Rays without a
    return are absent.
    """

    points: npt.NDArray[np.float32]
    """x forward, y left, z up in the sensor frame [m], intensity in [0, 1], (N, 4)."""
    ring: npt.NDArray[np.uint16]
    """Beam of each point, 0 = highest, (N,)."""
    is_ground: npt.NDArray[np.bool_]
    """Whether the ray hit the terrain, (N,)."""
    ground_z: FloatArray
    """Exact terrain height under (or over) each point along the sensor's z axis, sensor frame [m],
    (N,). Over a vertical step it is that of one side."""
    kind: KindArray
    """`Kind` that the ray hit, (N,)."""
    time: float
    """Time since the start of the drive [s]."""
    position: FloatArray
    """Position of the sensor in the world [m], (3,)."""
    rotation: FloatArray
    """Matrix (3, 3) that turns vectors of the sensor frame into the world's."""


def simulate_scan(
    scene: Scene,
    sensor: SensorModel,
    rng: np.random.Generator,
    x: float = 0.0,
    y: float = 0.0,
    yaw: float = 0.0,
    time: float = 0.0,
) -> SimulatedScan:
    """Scan the scene from one place.

    The vehicle is at `x`, `y` [m], heads to `yaw` [rad], and the sensor is `sensor.height` above
    the ground there. Every ray has its own random numbers, drawn from `rng` whether or not it hits
    anything: the same generator state gives the same noise in another scene. `time` [s] is only
    passed on to the scan.
    """
    n_rays = sensor.n_rays
    phase = rng.uniform(0.0, 2.0 * np.pi / sensor.n_columns)
    mirror_draw, drop_draw = rng.random(n_rays), rng.random(n_rays)
    range_noise, intensity_noise = rng.standard_normal(n_rays), rng.standard_normal(n_rays)

    beams = sensor.directions(phase)
    rotation = sensor.rotation(yaw)
    direction = beams @ rotation.T
    position = np.array([x, y, float(scene.terrain.height(x, y)) + sensor.height])
    origin = np.broadcast_to(position, direction.shape)

    distance = first_hit(scene.terrain, origin, direction, sensor.max_range)
    solid_distance, solid_kind = nearest_solid(scene.solids, position, direction)
    blocked = solid_distance < distance
    distance = np.where(blocked, solid_distance, distance)
    kind = np.where(blocked, solid_kind, Kind.TERRAIN).astype(np.uint8)
    _mirror(scene, origin, direction, distance, kind, mirror_draw)

    measured = distance + sensor.range_std * range_noise
    kept = np.flatnonzero(
        (measured >= sensor.min_range)
        & (measured <= sensor.max_range)
        & (drop_draw >= sensor.dropout)
    )
    kind = kind[kept]
    points = np.empty((len(kept), 4), dtype=np.float32)
    points[:, :3] = beams[kept] * measured[kept, None]
    points[:, 3] = np.clip(reflectance(kind) + INTENSITY_STD * intensity_noise[kept], 0.0, 1.0)
    return SimulatedScan(
        points=points,
        ring=sensor.rings()[kept],
        is_ground=kind == Kind.TERRAIN,
        ground_z=ground_below(scene.terrain, points, position, rotation),
        kind=kind,
        time=time,
        position=position,
        rotation=rotation,
    )


def _mirror(
    scene: Scene,
    origin: FloatArray,
    direction: FloatArray,
    distance: FloatArray,
    kind: KindArray,
    draw: FloatArray,
) -> None:
    """Move hits on wet road to the mirror images of solids, in place.

    The measured range is the length of the whole path of the light, so that the image is
    straight on along the ray, below the ground.
    """
    ray = np.flatnonzero((kind == Kind.TERRAIN) & np.isfinite(distance))
    foot = origin[ray] + distance[ray, None] * direction[ray]
    reflectivity = np.zeros(len(ray))
    for patch in scene.wet_patches:
        wet = np.hypot(foot[:, 0] - patch.x, foot[:, 1] - patch.y) <= patch.radius
        reflectivity[wet] = np.maximum(reflectivity[wet], patch.reflectivity)
    mirrored = draw[ray] < reflectivity
    ray, foot = ray[mirrored], foot[mirrored]

    slope = scene.terrain.gradient(foot[:, :2])
    normal = np.column_stack([-slope, np.ones(len(slope))])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    across = np.sum(direction[ray] * normal, axis=1, keepdims=True)
    onward, _ = nearest_solid(scene.solids, foot, direction[ray] - 2.0 * across * normal)
    found = np.isfinite(onward)
    ray, total = ray[found], distance[ray[found]] + onward[found]
    image = origin[ray] + total[:, None] * direction[ray]
    deep = image[:, 2] < scene.terrain.height(image[:, 0], image[:, 1]) - REFLECTION_MIN_DEPTH
    distance[ray[deep]], kind[ray[deep]] = total[deep], Kind.REFLECTION


def ground_below(
    terrain: Terrain, points: npt.NDArray[np.floating], position: FloatArray, rotation: FloatArray
) -> FloatArray:
    """Exact terrain height along the sensor's z axis under each point, sensor frame, (N,) [m].

    `points`, (N, >= 3) [m], are in the sensor frame; see `SimulatedScan` for the others. Where a
    tilted axis meets the terrain more than once, it is the highest.
    """
    local = points[:, :3].astype(np.float64)
    world = local @ rotation.T + position
    up = rotation[:, 2]
    if up[2] == 1.0:
        below: FloatArray = terrain.height(world[:, 0], world[:, 1]) - position[2]
        return below
    down = np.broadcast_to(-up, world.shape)
    fall = first_hit(terrain, world + PLUMB_LINE * up, down, 2.0 * PLUMB_LINE)
    ground_z: FloatArray = local[:, 2] + PLUMB_LINE - fall
    return ground_z


def simulate_drive(
    scene: Scene, sensor: SensorModel, n_frames: int, speed: float, seed: int
) -> Iterator[SimulatedScan]:
    """Drive along x from the origin at `speed` [m/s], ten scans a second.

    The sensor stays `sensor.height` above the ground under it and does not follow its slope.
    `seed` is that of all noise; the scene has its own. Raises ConfigError if a value is out of
    range.
    """
    if n_frames < 1 or not np.isfinite(speed):
        raise ConfigError(
            f'drive: n_frames = {n_frames}, speed = {speed}: must be >= 1 and finite'
        )
    rng = np.random.default_rng(seed)
    return (
        simulate_scan(scene, sensor, rng, x=speed * k * FRAME_PERIOD, time=k * FRAME_PERIOD)
        for k in range(n_frames)
    )


def write_semantic_kitti(scans: Iterable[SimulatedScan], root: str | Path, sequence: str) -> Path:
    """Write ``root/sequences/<sequence>/{velodyne/*.bin, labels/*.label, times.txt}``.

    The sequence appears whole or not at all; missing parent folders are made. Returns its folder.
    Raises DataError if the name is not that of a folder, the sequence exists, there is no scan,
    or the folder cannot be written.
    """
    root = Path(root)
    if not sequence or sequence in ('.', '..') or Path(sequence).name != sequence:
        raise DataError(f'sequence {sequence!r}: must be the name of one folder')
    target = root / 'sequences' / sequence
    if target.exists() or target.is_symlink():
        raise DataError(f'{target}: exists; remove it or choose another sequence')
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise DataError(f'{target}: {error.strerror or error}') from error
    with staged_folder(target, force=False, is_ours=lambda _: False) as folder:
        _write(scans, folder)
    return target


def _write(scans: Iterable[SimulatedScan], folder: Path) -> None:
    (folder / 'velodyne').mkdir(parents=True)
    (folder / 'labels').mkdir()
    times = []
    for k, scan in enumerate(scans):
        points = scan.points.astype('<f4')
        labels = semantic_kitti_labels(scan.kind).astype('<u4')
        (folder / 'velodyne' / f'{k:06d}.bin').write_bytes(points.tobytes())
        (folder / 'labels' / f'{k:06d}.label').write_bytes(labels.tobytes())
        times.append(scan.time)
    if not times:
        raise DataError(f'sequence {folder.name}: no scan to write')
    text = ''.join(f'{time:e}\n' for time in times)
    (folder / 'times.txt').write_text(text, encoding='utf-8')
