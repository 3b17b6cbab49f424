"""Ground segmentation of one LiDAR scan: the paper's Algorithm 2, stage by stage. Start here."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import math
import os
import textwrap
import threading
from collections.abc import Iterable, Iterator, Mapping
from itertools import chain, islice
from numbers import Real
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
import numpy.typing as npt

from gp_ground_seg.core.backend import Backend, make_backend
from gp_ground_seg.core.errors import LOGGER, ConfigError
from gp_ground_seg.core.frame import FloatArray, Frame, PointArray, Scan, usual_errors
from gp_ground_seg.core.gp.learning import Learned
from gp_ground_seg.core.parameters.config import Config, SensorConfig, config_of
from gp_ground_seg.core.parameters.schema import NO_BOX
from gp_ground_seg.core.pipeline import mirror_images
from gp_ground_seg.core.pipeline.ground_plane import CLEAR_TILT
from gp_ground_seg.core.pipeline.ground_view import (
    LOWER_ENDS,
    MAX_TILT,
    OTHER_AXES,
    UPRIGHT,
    View,
    clearest,
    is_below_sensor,
    is_ceiling,
    is_doubtful,
    objection_to_ground,
)
from gp_ground_seg.core.pipeline.lowest_points import tolerance_at
from gp_ground_seg.core.pipeline.points import (
    ENOUGH_POINTS,
    angles_of,
    moved,
    rotate,
    rotation,
    take_points,
    without_box,
)
from gp_ground_seg.core.pipeline.sensor_pose import (
    SensorPose,
    estimate_pose,
    for_sensor,
    given_pose,
    sensor_height_of,
    with_fallback,
)
from gp_ground_seg.core.result import Segmentation

MOST_PLANES = 4
"""Planes of a scan that are looked at for one that may be the ground, or a mirror."""


class GroundSegmenter:
    """Splits scans into ground and obstacles.

    It may be called from several threads, which then take turns, and in a forked process. It
    cannot be pickled: another process makes its own from the same `Config`.

    Parameters
    ----------
    config : Config, str, Path, dict or None
        Parameters; name of a preset; YAML file (a word with its suffix, or a Path); values by
        dotted name; None for the defaults. `configure` changes them between scans.
    backend : Backend, optional
        Backend to use until the parameters ``runtime`` change; by default one made from them.
    **parameters
        Further values, by name with ``_`` in place of the dot: ``sensor_height=1.73``.

    Raises
    ------
    ConfigError
        If a name is unknown, or a value is not accepted.
    MissingDependencyError
        If ``runtime.backend`` is numba and numba is not installed.
    """

    def __init__(
        self,
        config: Config | str | Path | Mapping[str, Any] | None = None,
        *,
        backend: Backend | None = None,
        **parameters: Any,
    ) -> None:
        keep_freed_memory()
        self._config = config_of(config, **parameters)
        self._backend = make_backend(self._config.runtime) if backend is None else backend
        self._warned: set[str] = set()
        self._lock, self._pid = threading.RLock(), os.getpid()

    @usual_errors()
    def segment(
        self,
        points: npt.ArrayLike,
        tilt: tuple[float, float] | None = None,
        origin: tuple[float, float, float] | None = None,
        fallback: SensorPose | None = None,
        box_frame: tuple[FloatArray, FloatArray] | None = None,
    ) -> Segmentation:
        """Label every point of a scan (paper, Algorithm 2).

        Parameters
        ----------
        points : (N, >=3) float array
            x forward, y left, z up in the sensor frame [m]; never written to. A point exactly at
            the origin of the cloud, or of the sensor, or in ``input.crop_box``, is no return: it
            is UNKNOWN, as NaN is.
        tilt : tuple of float, optional
            Roll and pitch of the sensor in this scan [rad], instead of ``sensor.roll``
            and ``sensor.pitch``.
        origin : tuple of float, optional
            Where the sensor was in the frame of this scan [m], instead of ``sensor.origin_x``,
            ``sensor.origin_y`` and ``sensor.origin_z``.
        fallback : SensorPose, optional
            Pose of the sensor in an earlier scan: where ``sensor.height`` is auto and this scan
            does not show the ground well, its height, and its angles where they are auto.
        box_frame : tuple of float arrays, optional
            Rotation (3, 3) and translation (3,) [m] from the frame of this scan into that of
            ``input.crop_box``; by default the box is in the frame of this scan.

        Raises
        ------
        PointCloudError
            If the array has another shape or type, or z clearly does not point up.
        ConfigError
            If `tilt` or `origin` has another number of values, or one that is not finite, or
            `fallback` is no `SensorPose`, or `box_frame` no rotation and translation.
        """
        with self._exclusive():
            timer, sensor = StageTimer(), self._config.sensor
            if tilt is not None:
                roll, pitch = _finite_numbers('tilt', tilt, 2)
                sensor = dataclasses.replace(sensor, roll=roll, pitch=pitch)
            if origin is not None:
                x, y, z = _finite_numbers('origin', origin, 3)
                sensor = dataclasses.replace(sensor, origin_x=x, origin_y=y, origin_z=z)
            if not (fallback is None or isinstance(fallback, SensorPose)):
                raise _refused('fallback', fallback, 'a SensorPose')
            xyz = take_points(points, (sensor.origin_x, sensor.origin_y, sensor.origin_z))
            box = self._config.input.crop_box
            if box != NO_BOX:
                xyz = without_box(xyz, box, _checked_frame(box_frame))
            result = self._segment(xyz, sensor, timer, fallback)
            for line in result.warnings:
                if line not in self._warned:  # by scans with these parameters
                    LOGGER.warning(line)
            self._warned.update(result.warnings)
            return result

    def _segment(
        self, xyz: PointArray, sensor: SensorConfig, timer: StageTimer, fallback: SensorPose | None
    ) -> Segmentation:
        """Do the stages of a scan, one after the other."""
        backend = self._backend
        # 1. Polar grid: the lowest point of each cell is a ground candidate.
        # 2. Sensor pose, from a plane through the candidates near the sensor: a tilted scan is
        #    levelled, mirror images are raised, and a low sensor has narrower gates.
        scan, pose, images, config = self._level(xyz, sensor, timer, fallback)
        height = pose.sensor_height
        # 3. Vertical faces: walls, fences, sides of cars.
        faces = backend.find_faces(scan, height, config)
        timer.mark('faces')
        # 4. Relief of the terrain; lines along each segment, over it, without lowest points of
        #    faces with occluded base; pseudo-inputs. The prior mean is the ground near the sensor.
        relief, candidates, shown = backend.find_relief(scan.candidates, faces, height, config)
        found = backend.extract_lines(candidates, faces, config)
        in_face = faces.is_face[found[0].tile]
        frame = Frame(*found, in_face, knots=scan.grid.edges, prior_mean=-height)
        timer.mark('lines')
        # 5. Observation and latent process: hyper-parameters theta, inliers and surface.
        is_fixed = config.learning.mode == 'fixed'
        learned = Learned.given(config) if is_fixed else backend.learn_frame(frame, config)
        timer.mark('learning')
        surface, log_length_scale, _ = backend.estimate_surface(frame, learned.theta, config)
        timer.mark('surface')
        # 6. Labels: ground up to the tolerance over the surface, or higher where it is rough; what
        #    stands on the ground is labelled as faces are.
        height = sensor_height_of(pose)
        labelled = backend.label_points(scan, shown, surface, relief, height, config)
        labelled.height[images.points] -= images.rise
        timer.mark('label')
        return Segmentation(
            labelled=labelled,
            timings=timer.seconds,
            learned=learned,
            backend=backend.name,
            grid=scan.grid,
            frame=frame,
            surface=surface,
            log_length_scale=log_length_scale,
            pose=pose,
            relief=relief,
            z=xyz[:, 2].copy(),
            config=config,
        )

    @property
    def config(self) -> Config:
        """Parameters of the next scan."""
        return self._config

    @property
    def backend(self) -> Backend:
        """Backend of the next scan."""
        return self._backend

    def configure(self, config: Config) -> None:
        """Use `config` from the next scan on."""
        with self._exclusive():
            if config.runtime != self._config.runtime:
                self.use_backend(make_backend(config.runtime))
            self._config = config
            self._warned.clear()

    def use_backend(self, backend: Backend) -> None:
        """Use `backend` from the next scan on."""
        with self._exclusive():
            self._backend = backend

    def _exclusive(self) -> threading.RLock:
        """Lock that callers from several threads hold in turn."""
        if self._pid != os.getpid():
            # In a forked process it may be held by a thread that does not exist here.
            self._lock, self._pid = threading.RLock(), os.getpid()
        return self._lock

    def _level(
        self, xyz: PointArray, sensor: SensorConfig, timer: StageTimer, fallback: SensorPose | None
    ) -> tuple[Scan, SensorPose, mirror_images.MirrorImages, Config]:
        """Scan in the level frame, about the sensor, with mirror images raised.

        Its angles are those given, estimated or of `fallback`.
        """
        backend, config, given = self._backend, self._config, given_pose(sensor)
        about = moved(xyz, given.origin)
        level = given.level(about)
        scan = backend.build_grid(level, config)
        timer.mark('grid')
        view, elsewhere = self._find_ground(level, scan)
        objection = objection_to_ground(scan, view)
        pose = estimate_pose(sensor, None if objection else view, elsewhere, objection)
        if fallback is not None:
            pose = with_fallback(pose, fallback, sensor)
        config = for_sensor(config, pose)
        is_turned = (pose.roll, pose.pitch) != (given.roll, given.pitch)
        if is_turned or config.grid != self._config.grid:
            scan = backend.build_grid(pose.level(about), config)
        if objection == LOWER_ENDS and pose.is_height_default:
            scan = scan._replace(candidates=scan.candidates.where(scan.candidates.r < 0.0))  # none
        images = mirror_images.find_mirror_images(scan, pose, view)
        if len(images.points) > 0:
            scan = images.left_out(backend.build_grid(images.raised(scan.xyz), config))
        timer.mark('pose')
        return scan, pose, images, config

    def _find_ground(self, level: PointArray, scan: Scan) -> tuple[View | None, View | None]:
        """View of the ground, and where it clearly lies if that is too far from z."""
        below = self._past_images(scan, self._look(scan))
        view = self._about_axes(level, below) if is_doubtful(below) else below
        if view is None or view.can_level:
            return view, None
        # The scan will not be levelled: the ground that matters is about level.
        return self._look(scan, max_tilt=CLEAR_TILT) or below, view if view.tells_tilt else None

    def _past_images(self, scan: Scan, below: View | None) -> View | None:
        """View of a mirror, if candidates that are no images of it show one; else `below`."""
        if below is not None:
            below = below._replace(is_mirror=_is_mirror(below, scan))
            if below.is_dry:
                return below
        left = scan._replace(candidates=mirror_images.in_sight(scan.candidates))
        for view in self._views(left):
            if _is_mirror(view, scan):
                # Again, without the images that were lowest in their cells.
                c = left.candidates
                off = np.abs(view.plane.below(c.x, c.y, c.z))
                near = left._replace(candidates=c.where(off < 2.0 * tolerance_at(c.r)))
                plane = (self._look(near) or view).plane
                # Those near the plane are too few to tell how steeply it is seen.
                is_below = is_below_sensor(plane, scan)
                again = View(plane._replace(is_below_sensor=is_below), UPRIGHT, is_mirror=True)
                # Walls close by have returns where any image would be, and show no plane.
                if _is_mirror(again, scan):
                    return again
        return below

    def _about_axes(self, xyz: PointArray, below: View | None) -> View | None:
        """View of the ground about z or another axis; that `below` z is doubtful."""
        sample = xyz[:: len(xyz) // ENOUGH_POINTS + 1]

        def look(turn: FloatArray, again: bool = True) -> View | None:
            view = self._look(self._backend.build_grid(rotate(sample, turn), self._config), turn)
            # Again in a frame in which the plane is level.
            return look(rotation(*angles_of(view.up)), False) if view and again else view

        if below is not None and below.is_steep:
            below = look(UPRIGHT) or below
        return clearest(below, map(look, OTHER_AXES)) if is_doubtful(below) else below

    def _look(
        self, scan: Scan, turn: FloatArray = UPRIGHT, max_tilt: float = MAX_TILT
    ) -> View | None:
        """Best plane of a scan that may be ground, or without one the best that is no ceiling."""
        views = self._views(scan, turn, max_tilt)
        first = next(views, None)
        return next((view for view in chain([first], views) if view and view.tells_height), first)

    def _views(
        self, scan: Scan, turn: FloatArray = UPRIGHT, max_tilt: float = MAX_TILT
    ) -> Iterator[View]:
        """Yield planes of a scan that `turn` has rotated, but ceilings, the best first."""
        planes = self._backend.find_planes(scan.candidates, math.tan(max_tilt))
        for plane in islice(planes, MOST_PLANES):
            if not is_ceiling(plane, scan):
                yield View(plane._replace(is_below_sensor=is_below_sensor(plane, scan)), turn)


def _is_mirror(view: View, scan: Scan) -> bool:
    """Whether much of what is below a plane is the image of what is over it."""
    # In a frame that is steep to the plane, the lowest points are not those of the ground.
    return (
        view.is_whole
        and not view.is_steep
        and mirror_images.mirror_share(view.plane, scan) >= mirror_images.MIRRORED
    )


def _finite_numbers(name: str, values: Iterable[float], count: int) -> tuple[float, ...]:
    """Return the `values` of an argument; raise a ConfigError if it has others than `count`."""
    with contextlib.suppress(TypeError, OverflowError):
        given = tuple(values)
        are_numbers = all(isinstance(v, Real) and not isinstance(v, bool) for v in given)
        if are_numbers and len(given) == count and all(map(math.isfinite, given)):
            return tuple(map(float, given))
    raise _refused(name, values, f'{count} finite numbers')


def _checked_frame(
    frame: tuple[FloatArray, FloatArray] | None,
) -> tuple[FloatArray, FloatArray] | None:
    """Return the `box_frame` of `segment`; raise a ConfigError if it is none."""
    if frame is None:
        return None
    with contextlib.suppress(TypeError, ValueError):
        turn, move = (np.asarray(part, dtype=np.float64) for part in frame)
        if (turn.shape, move.shape) == ((3, 3), (3,)) and np.isfinite([*turn, move]).all():
            return turn, move
    raise _refused('box_frame', frame, 'a rotation (3, 3) and a translation (3,)')


def _refused(name: str, value: object, wanted: str) -> ConfigError:
    shown = textwrap.shorten(repr(value), 100, placeholder=' ...')
    return ConfigError(f'{name} = {shown}: must be {wanted}')


def warm_up(config: Config | None = None, backend: Backend | None = None) -> Backend:
    """Compile or load all code that a frame needs, and return a backend that uses it.

    A small scan of single precision, the type of most sensors, is segmented, and hyper-parameters
    are learned whatever ``learning.mode`` is. Raises a MissingDependencyError if
    ``runtime.backend`` is numba and numba is not installed.
    """
    config = (config or Config()).replace(**{'learning.mode': 'every_frame'})
    segmenter = GroundSegmenter(config, backend=backend)
    azimuth, r = np.meshgrid(np.linspace(-3.0, 3.0, 400), np.geomspace(2.5, 30.0, 30))
    xyz = np.stack([r * np.cos(azimuth), r * np.sin(azimuth), np.full_like(r, -1.73)], axis=-1)
    wall = xyz[25] + [0.0, 0.0, 1.0]
    points = np.concatenate([xyz.reshape(-1, 3), wall]).astype(np.float32)
    segmenter.segment(points)
    return segmenter.backend


@functools.cache
def keep_freed_memory() -> None:
    """Have the process keep the memory of a frame for the next one.

    glibc gives freed memory back to the system, which clears thousands of pages anew for the next
    frame, 1 to 2 us each, but for blocks up to the largest that was freed before, at most 32 MB
    (mallopt(3), M_MMAP_THRESHOLD). The pages of this one are never touched.
    """
    np.empty(31 * 2**20, np.uint8)


class StageTimer:
    """Seconds of each stage, and in total."""

    def __init__(self) -> None:
        self._start = self._last = perf_counter()
        self.seconds: dict[str, float] = {}

    def mark(self, stage: str) -> None:
        """Record the seconds since the previous mark under `stage`."""
        now = perf_counter()
        self.seconds |= {stage: now - self._last, 'total': now - self._start}
        self._last = now
