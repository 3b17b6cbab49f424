"""Methods that can be scored, behind one small interface."""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
import numpy.typing as npt
from scipy.spatial import KDTree

from gp_ground_seg.errors import MissingDependencyError
from gp_ground_seg.frame import FloatArray, Label
from gp_ground_seg.parameters.config import Config
from gp_ground_seg.pipeline.sensor_pose import SensorPose
from gp_ground_seg.result import FitReport
from gp_ground_seg.segmenter import GroundSegmenter

OURS = 'gp_ground_seg'
PATCHWORKPP = 'patchworkpp'
TITLES = {PATCHWORKPP: 'Patchwork++'}
"""Names of methods in tables, where they differ from those in files."""

Points = npt.NDArray[np.floating]


@dataclass(frozen=True)
class MethodResult:
    """Labels (N,) and, where the method has them, probabilities (N,) and seconds by stage."""

    label: npt.NDArray[np.uint8]
    p_ground: npt.NDArray[np.floating] | None = None
    stages: dict[str, float] = field(default_factory=dict)
    pose: SensorPose | None = None
    fit: FitReport | None = None


class Method(Protocol):
    """Something that labels scans, one sequence after the other."""

    name: str

    def reset(self) -> None:
        """Forget what was learned from earlier scans."""

    def run(self, points: Points) -> None:
        """Segment a scan of (N, 4) x, y, z, intensity: the part that is timed."""

    def result(self) -> MethodResult:
        """Return the result of the last scan."""

    def ground_z(self) -> FloatArray:
        """Height of the ground under each point of the last scan, (N,) [m]; NaN = no model."""

    def close(self) -> None:
        """End worker threads."""


class OurMethod:
    """`GroundSegmenter` as a method."""

    def __init__(self, config: Config, name: str = OURS) -> None:
        self.name = name
        self._segmenter = GroundSegmenter(config)

    def reset(self) -> None:
        """Forget what was learned."""
        self._segmenter.reset()

    def run(self, points: Points) -> None:
        """Segment a scan."""
        self._result = self._segmenter.segment(points)

    def result(self) -> MethodResult:
        """Labels, probabilities, stages, pose and fit of the last scan."""
        last = self._result
        stages = {stage: seconds for stage, seconds in last.timings.items() if stage != 'total'}
        return MethodResult(last.label, last.p_ground, stages, last.pose, last.fit)

    def ground_z(self) -> FloatArray:
        """Height of the surface under each point."""
        return self._result.ground_z

    def close(self) -> None:
        """End the worker threads."""
        self._segmenter.close()


class PatchworkppMethod:
    """Patchwork++ (Lee, Lim, Myung, IROS 2022) from PyPI, with its published parameters.

    Only its estimation is timed, not the fetching of the indices. Its adaptive thresholds are
    learned over a sequence. The published sensor height [m], that of KITTI, is its default.
    Raises MissingDependencyError if pypatchworkpp is not installed.
    """

    name = PATCHWORKPP

    def __init__(self, sensor_height: float | None = None) -> None:
        try:
            import pypatchworkpp
        except ImportError as error:
            raise MissingDependencyError(
                'the peer patchworkpp needs pypatchworkpp: pip install pypatchworkpp'
            ) from error
        self._module = pypatchworkpp
        self._sensor_height = sensor_height
        self.reset()

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
        self._points = points
        self._estimator.estimateGround(points)

    def result(self) -> MethodResult:
        """Labels of the last scan."""
        label = np.full(len(self._points), Label.OBSTACLE, dtype=np.uint8)
        label[self._estimator.getGroundIndices()] = Label.GROUND
        return MethodResult(label)

    def ground_z(self) -> FloatArray:
        """Height of the plane of the nearest upright patch: it has no surface of its own."""
        centre = np.asarray(self._estimator.getCenters(), dtype=np.float64).reshape(-1, 3)
        normal = np.asarray(self._estimator.getNormals(), dtype=np.float64).reshape(-1, 3)
        upright = np.abs(normal[:, 2]) > self._uprightness
        centre, normal = centre[upright], normal[upright]
        if not len(centre):
            return np.full(len(self._points), np.nan)
        xy = self._points[:, :2].astype(np.float64)
        _, nearest = KDTree(centre[:, :2]).query(xy)
        centre, normal = centre[nearest], normal[nearest]
        fall = np.sum((xy - centre[:, :2]) * normal[:, :2], axis=1) / normal[:, 2]
        return np.asarray(centre[:, 2] - fall)

    def close(self) -> None:
        """Do nothing: it has no threads."""


@contextlib.contextmanager
def _c_stdout_silenced() -> Iterator[None]:
    """Keep what C++ code writes to standard output away from it."""
    sys.stdout.flush()
    kept = os.dup(1)
    sink = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(sink, 1)
        yield
    finally:
        os.dup2(kept, 1)
        os.close(sink)
        os.close(kept)
