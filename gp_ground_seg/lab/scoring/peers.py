"""What ours is compared with: Patchwork++, and a surface without a Gaussian process."""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from scipy.spatial import KDTree

from gp_ground_seg.core.backend import make_backend
from gp_ground_seg.core.errors import ConfigError, require
from gp_ground_seg.core.frame import FloatArray, Frame, Label, PointArray
from gp_ground_seg.core.parameters.config import Config, SensorConfig
from gp_ground_seg.core.parameters.schema import AUTO
from gp_ground_seg.lab.scoring import evaluate


class PatchworkppMethod:
    """Patchwork++ (Lee, Lim, Myung, IROS 2022) from PyPI, with its published parameters.

    Its thresholds adapt over a sequence. It takes the sensor to be at the origin: `origin` [m] is
    where the sensor is in the cloud's frame. The default `sensor_height` [m] is that of KITTI.
    """

    name = evaluate.PATCHWORKPP
    depends_on_past = True

    def __init__(
        self, sensor_height: float | None = None, origin: Sequence[float] = (0.0, 0.0, 0.0)
    ) -> None:
        self._module = require('pypatchworkpp', 'pypatchworkpp')
        self._mount: evaluate.Mount = sensor_height, origin
        self.reset()

    @classmethod
    def of_sensor(cls, sensor: SensorConfig) -> PatchworkppMethod:
        """Give it the place of the sensor as far as the parameters say it."""
        origin = sensor.origin_x, sensor.origin_y, sensor.origin_z
        if sensor.height == AUTO:
            return cls(None, origin)
        height = sensor.height + sensor.origin_z
        if height <= 0.0:
            raise ConfigError(
                f'{cls.name}: takes the sensor to be above the ground; with sensor.height = '
                f'{sensor.height:g} set sensor.origin_z above {0.0 - sensor.height:g}'
            )
        return cls(height, origin)

    def __reduce__(self) -> tuple[Any, ...]:
        """Send a worker what to make it of."""
        return type(self), self._mount

    def reset(self, scan: evaluate.KnownScan | None = None) -> None:
        """Start anew with its default thresholds, and the mount of the scan if that is known."""
        sensor_height, origin = (scan and scan.mount) or self._mount
        self._origin = np.array(origin)
        with _c_stdout_silenced():  # it greets on standard output, which is for tables
            parameters = self._module.Parameters()
            if sensor_height is not None:
                parameters.sensor_height = sensor_height
            self._uprightness = float(parameters.uprightness_thr)
            self._estimator = self._module.patchworkpp(parameters)

    def run(self, points: PointArray) -> None:
        """Segment a scan."""
        if self._origin.any():
            points = points.copy()
            points[:, :3] -= self._origin
        self._points = points
        self._estimator.estimateGround(points)

    def result(self) -> evaluate.MethodResult:
        """Labels, and the plane of the nearest upright patch: it has no other surface."""
        label = np.full(len(self._points), Label.OBSTACLE, dtype=np.uint8)
        label[self._estimator.getGroundIndices()] = Label.GROUND
        centre = np.asarray(self._estimator.getCenters(), dtype=np.float64).reshape(-1, 3)
        normal = np.asarray(self._estimator.getNormals(), dtype=np.float64).reshape(-1, 3)
        upright = np.abs(normal[:, 2]) > self._uprightness
        centre, normal = centre[upright], normal[upright]
        if not len(centre):
            return evaluate.MethodResult(label, np.full(len(label), np.nan))
        xy = self._points[:, :2].astype(np.float64)
        xy[~np.isfinite(xy).all(axis=1)] = np.nan
        _, nearest = KDTree(centre[:, :2]).query(np.nan_to_num(xy))
        centre, normal = centre[nearest], normal[nearest]
        fall = np.sum((xy - centre[:, :2]) * normal[:, :2], axis=1) / normal[:, 2]
        return evaluate.MethodResult(label, np.asarray(centre[:, 2] - fall + self._origin[2]))


@contextlib.contextmanager
def _c_stdout_silenced() -> Iterator[None]:
    """Keep what C++ code writes to standard output away from it."""
    sys.stdout.flush()
    kept = os.dup(1)
    try:
        with open(os.devnull, 'wb') as sink:
            os.dup2(sink.fileno(), 1)
            yield
    finally:
        os.dup2(kept, 1)
        os.close(kept)


INTERPOLATION = 'interpolation, our labels'
MAX_SLOPE, TOLERANCE = 0.15, 0.1
"""A lowest point is ground up to this slope from the one before, and this much more [m]; the best
of six pairs on a third of the labelled frames."""


class InterpolationMethod(evaluate.OurMethod):
    """Our method without a Gaussian process: lowest points joined by straight lines.

    Nothing is learned. Of each segment `ground_points` are interpolated; the surface is the median
    of three segments. All else, such as its standard deviation and its end, is that of ours.
    """

    def __init__(self, config: Config, name: str = INTERPOLATION) -> None:
        backend: Any = make_backend(config.runtime)
        estimate = backend.estimate_surface

        def interpolate(frame: Frame, *others: Any) -> tuple[Any, ...]:
            surface, *scales = estimate(frame, *others)
            lines = np.empty_like(surface.mean)
            for segment, line in enumerate(lines):
                part = slice(*frame.candidates.offsets[segment : segment + 2])
                r, z = frame.candidates.r[part], frame.candidates.z[part]
                line[:] = np.interp(frame.knots, *ground_points(r, z, frame.prior_mean))
            mean = np.median([np.roll(lines, k, axis=0) for k in (-1, 0, 1)], axis=0)
            mean[np.isnan(surface.mean)] = np.nan
            return surface._replace(mean=mean), *scales

        backend.estimate_surface = interpolate
        super().__init__(config.replace(**{'learning.mode': 'fixed'}), name, backend)


def ground_points(r: FloatArray, z: FloatArray, start: float) -> tuple[list[float], list[float]]:
    """Ranges and heights of the ground point at range 0, `start`, and of those that follow it."""
    ranges, heights = [0.0], [start]
    for r_k, z_k in zip(r.tolist(), z.tolist(), strict=True):
        if abs(z_k - heights[-1]) <= MAX_SLOPE * (r_k - ranges[-1]) + TOLERANCE:
            ranges.append(r_k)
            heights.append(z_k)
    return ranges, heights
