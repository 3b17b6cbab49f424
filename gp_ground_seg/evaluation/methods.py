"""Methods that can be scored behind one small interface, and how they are run side by side."""

from __future__ import annotations

import contextlib
import os
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Protocol, TypeVar

import numpy as np
import numpy.typing as npt
from scipy.spatial import KDTree

from gp_ground_seg.errors import MissingDependencyError, PointCloudError
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
    """What a method says of a scan of N points.

    Attributes
    ----------
    label : (N,) uint8
        `Label` of each point.
    p_ground : (N,) float or None
        Probability of ground; None if the method has none.
    stages : dict of str to float
        Seconds by stage; empty if they are not known.
    pose, fit : SensorPose or None, FitReport or None
        Of our own method.
    """

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
    """`GroundSegmenter` as a method.

    Parameters
    ----------
    config : Config
        Its parameters.
    name : str
        Name by which its scores are kept.
    """

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

    Only its estimation is timed, not the fetching of the indices. Its adaptive
    thresholds are learned over a sequence.

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


class Scan(Protocol):
    """A scan in memory: where it is from, and x, y, z, intensity of its points, (N, 4)."""

    @property
    def sequence(self) -> str:
        """Sequence, or another group of scans that belong together."""

    @property
    def index(self) -> str:
        """Name within the sequence."""

    @property
    def points(self) -> npt.NDArray[np.float32]:
        """Points."""


_Item = TypeVar('_Item')
_Scan = TypeVar('_Scan', bound=Scan)
_Score = TypeVar('_Score')
Progress = Callable[[Sequence[_Item]], Iterable[_Item]]
"""Wraps items to show how far the work is, as tqdm does."""


def run_methods(
    items: Sequence[_Item],
    load: Callable[[_Item], _Scan],
    methods: Sequence[Method],
    score: Callable[[_Scan, Method, float], _Score],
    *,
    each_alone: bool = False,
    clock: Callable[[], float] = time.perf_counter,
    progress: Progress[_Item] = iter,
) -> dict[str, list[_Score]]:
    """Run methods alternately on the same scans and score each run.

    Which method goes first changes from scan to scan. Before the first scan counts, each method
    has run on it once: compilation and first allocations are not its speed.

    Parameters
    ----------
    items : sequence
        What is loaded, grouped by sequence.
    load : callable
        Loads an item: one scan at a time is in memory.
    methods : sequence of Method
        Each with a name of its own.
    score : callable
        Score from the scan, the method that has just run on it, and its seconds.
    each_alone : bool
        Whether methods forget before every scan, not only before every sequence.
    clock, progress : callable
        Source of seconds; wraps the items.

    Returns
    -------
    dict of str to list
        Scores of each method, by name.

    Raises
    ------
    DataError
        If a scan cannot be loaded.
    PointCloudError
        If a method refuses a scan.
    """
    scores: dict[str, list[_Score]] = {method.name: [] for method in methods}
    if items:
        first = load(items[0])
        for method in methods:
            _run(method, first)
    sequence = None
    for k, item in enumerate(progress(items)):
        scan = load(item)
        forgets = each_alone or scan.sequence != sequence
        sequence = scan.sequence
        for method in methods if k % 2 == 0 else reversed(methods):
            if forgets:
                method.reset()
            start = clock()
            _run(method, scan)
            seconds = clock() - start
            scores[method.name].append(score(scan, method, seconds))
    return scores


def _run(method: Method, scan: Scan) -> None:
    try:
        method.run(scan.points)
    except PointCloudError as error:
        raise PointCloudError(f'{scan.sequence}/{scan.index}: {method.name}: {error}') from error
