"""Methods that can be evaluated, behind one small interface."""

from __future__ import annotations

import contextlib
import importlib.metadata
import os
import sys
from collections.abc import Iterator
from typing import Protocol

import numpy as np
import numpy.typing as npt
from scipy.spatial import KDTree

from gp_ground_seg.errors import MissingDependencyError
from gp_ground_seg.frame import Label
from gp_ground_seg.parameters.config import Config
from gp_ground_seg.result import FitReport
from gp_ground_seg.segmenter import GroundSegmenter

OURS = 'gp_ground_seg'
PATCHWORKPP = 'patchworkpp'


class Method(Protocol):
    """Something that labels scans, one sequence after the other."""

    name: str

    def start_sequence(self) -> None:
        """Forget what was learnt from earlier frames."""

    def run(self, points: npt.NDArray[np.float32]) -> None:
        """Segment a scan of (N, 4) x, y, z, intensity: the part that is timed."""

    def label(self) -> npt.NDArray[np.uint8]:
        """Labels of the scan last run, (N,)."""

    def p_ground(self) -> npt.NDArray[np.floating] | None:
        """Probability of ground of each point of the scan last run, (N,); None if it has none."""

    def stages(self) -> dict[str, float]:
        """Seconds by stage of the scan last run; empty if it does not tell."""

    def facts(self) -> dict[str, float | str]:
        """Tell what else is known of the scan last run, by name; empty if nothing."""


class OurMethod:
    """`GroundSegmenter` as a method.

    Parameters
    ----------
    config : Config
        Its parameters.
    """

    name = OURS

    def __init__(self, config: Config) -> None:
        self._config = config
        self._segmenter: GroundSegmenter | None = None

    def start_sequence(self) -> None:
        """Start a segmenter without a past."""
        self.close()
        self._segmenter = GroundSegmenter(self._config)

    def run(self, points: npt.NDArray[np.float32]) -> None:
        """Segment a scan."""
        assert self._segmenter is not None, 'start_sequence comes first'
        self._result = self._segmenter.segment(points)

    def label(self) -> npt.NDArray[np.uint8]:
        """Labels of the scan last run."""
        return self._result.label

    def p_ground(self) -> npt.NDArray[np.float32]:
        """Probability of ground of each point of the scan last run."""
        return self._result.p_ground

    def stages(self) -> dict[str, float]:
        """Seconds by stage of the scan last run."""
        return {stage: s for stage, s in self._result.timings.items() if stage != 'total'}

    def facts(self) -> dict[str, float | str]:
        """How the learning ended, segments with a ground model, the sensor's pose [m, rad]."""
        pose = self._result.pose
        return {
            'status': self.fit.status,
            'n_segments': float(self.fit.n_segments),
            'sensor_height': pose.height,
            'sensor_height_estimated': 'yes' if pose.height_estimated else 'no',
            'sensor_roll': pose.roll,
            'sensor_pitch': pose.pitch,
        }

    @property
    def fit(self) -> FitReport:
        """Fit report of the scan last run: backend and threads are in it."""
        return self._result.fit

    def close(self) -> None:
        """End the worker threads."""
        if self._segmenter is not None:
            self._segmenter.close()
            self._segmenter = None


class PatchworkppMethod:
    """Patchwork++ (Lee, Lim, Myung, IROS 2022) from PyPI, with its published parameters.

    Only its estimation is timed, not the fetching of the indices. Its adaptive
    thresholds are learnt over a sequence, so each sequence gets a new one.

    Parameters
    ----------
    sensor_height : float, optional
        Height of the sensor [m]; its published one, that of KITTI, by default.

    Raises
    ------
    MissingDependencyError
        If pypatchworkpp is not installed.
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
        self.version = importlib.metadata.version('pypatchworkpp')

    def start_sequence(self) -> None:
        """Start with its default thresholds."""
        with _c_stdout_silenced():  # it greets on standard output, where our tables go
            parameters = self._module.Parameters()
            if self._sensor_height is not None:
                parameters.sensor_height = self._sensor_height
            self._uprightness = float(parameters.uprightness_thr)
            self._estimator = self._module.patchworkpp(parameters)

    def run(self, points: npt.NDArray[np.float32]) -> None:
        """Segment a scan."""
        self._n_points = len(points)
        self._estimator.estimateGround(points)

    def label(self) -> npt.NDArray[np.uint8]:
        """Labels of the scan last run."""
        label = np.full(self._n_points, Label.OBSTACLE, dtype=np.uint8)
        label[self._estimator.getGroundIndices()] = Label.GROUND
        return label

    def ground_z(self, points: npt.NDArray[np.floating]) -> npt.NDArray[np.float64]:
        """Height of its ground under points of the scan last run, as good as can be had.

        It has no surface of its own, but a plane for each patch that it looks at: here
        the plane of the nearest patch counts, of those it takes for upright.

        Parameters
        ----------
        points : (n, >=2) float
            Where to ask [m].

        Returns
        -------
        (n,) float64
            z in the sensor frame [m]; NaN if it found no plane.
        """
        centre = np.asarray(self._estimator.getCenters(), dtype=np.float64).reshape(-1, 3)
        normal = np.asarray(self._estimator.getNormals(), dtype=np.float64).reshape(-1, 3)
        upright = np.abs(normal[:, 2]) > self._uprightness
        centre, normal = centre[upright], normal[upright]
        if not len(centre):
            return np.full(len(points), np.nan)
        xy = points[:, :2].astype(np.float64)
        _, nearest = KDTree(centre[:, :2]).query(xy)
        centre, normal = centre[nearest], normal[nearest]
        fall = np.sum((xy - centre[:, :2]) * normal[:, :2], axis=1) / normal[:, 2]
        ground_z: npt.NDArray[np.float64] = centre[:, 2] - fall
        return ground_z

    def p_ground(self) -> None:
        """Nothing: it decides without."""
        return None

    def stages(self) -> dict[str, float]:
        """Nothing: it tells only its total."""
        return {}

    def facts(self) -> dict[str, float | str]:
        """Nothing."""
        return {}


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
