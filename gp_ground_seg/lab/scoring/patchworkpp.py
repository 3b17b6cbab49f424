"""Patchwork++ as a method to compare with."""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from scipy.spatial import KDTree

from gp_ground_seg.core.errors import ConfigError, require
from gp_ground_seg.core.frame import Label
from gp_ground_seg.core.parameters.config import SensorConfig
from gp_ground_seg.core.parameters.schema import AUTO
from gp_ground_seg.lab.scoring.evaluate import PATCHWORKPP, MethodResult, Points


class PatchworkppMethod:
    """Patchwork++ (Lee, Lim, Myung, IROS 2022) from PyPI, with its published parameters.

    Its thresholds adapt over a sequence. It takes the sensor to be at the origin, that many metres
    above the ground: `origin` [m] is where the sensor is in the cloud's frame, and the default
    `sensor_height` [m] that of KITTI.
    """

    name = PATCHWORKPP
    depends_on_past = True

    def __init__(
        self, sensor_height: float | None = None, origin: Sequence[float] = (0.0, 0.0, 0.0)
    ) -> None:
        self._module = require('pypatchworkpp', 'pypatchworkpp')
        self._sensor_height, self._origin = sensor_height, np.array(origin)
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
        return type(self), (self._sensor_height, self._origin)

    def reset(self) -> None:
        """Start anew with its default thresholds."""
        with _c_stdout_silenced():  # it greets on standard output, which is for tables
            parameters = self._module.Parameters()
            if self._sensor_height is not None:
                parameters.sensor_height = self._sensor_height
            self._uprightness = float(parameters.uprightness_thr)
            self._estimator = self._module.patchworkpp(parameters)

    def run(self, points: Points) -> None:
        """Segment a scan."""
        if self._origin.any():
            points = points.copy()
            points[:, :3] -= self._origin
        self._points = points
        self._estimator.estimateGround(points)

    def result(self) -> MethodResult:
        """Labels, and the plane of the nearest upright patch: it has no other surface."""
        label = np.full(len(self._points), Label.OBSTACLE, dtype=np.uint8)
        label[self._estimator.getGroundIndices()] = Label.GROUND
        centre = np.asarray(self._estimator.getCenters(), dtype=np.float64).reshape(-1, 3)
        normal = np.asarray(self._estimator.getNormals(), dtype=np.float64).reshape(-1, 3)
        upright = np.abs(normal[:, 2]) > self._uprightness
        centre, normal = centre[upright], normal[upright]
        if not len(centre):
            return MethodResult(label, np.full(len(label), np.nan))
        xy = self._points[:, :2].astype(np.float64)
        xy[~np.isfinite(xy).all(axis=1)] = np.nan
        _, nearest = KDTree(centre[:, :2]).query(np.nan_to_num(xy))
        centre, normal = centre[nearest], normal[nearest]
        fall = np.sum((xy - centre[:, :2]) * normal[:, :2], axis=1) / normal[:, 2]
        return MethodResult(label, np.asarray(centre[:, 2] - fall + self._origin[2]))


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
