"""Methods over scans whose truth is known: scores by scan, and their sums."""

from __future__ import annotations

import functools
import math
import operator
import statistics
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from gp_ground_seg.data.semantic_kitti import (
    Frame,
    list_frames,
    list_sequences,
    read_labels,
    read_points,
)
from gp_ground_seg.errors import DataError, PointCloudError
from gp_ground_seg.evaluation.calibration import Calibration, count_calibration
from gp_ground_seg.evaluation.methods import TITLES, Method
from gp_ground_seg.evaluation.metrics import (
    CONVENTIONS,
    GROUNDGRID,
    ClassCount,
    Confusion,
    HeightError,
    Labels,
    count_classes,
    count_confusion,
    count_rings,
    height_error,
    pool_height_errors,
)
from gp_ground_seg.frame import BoolArray, Label
from gp_ground_seg.pipeline.sensor_pose import SensorPose
from gp_ground_seg.result import FitReport

ALL = 'all'
Progress = Callable[[Sequence[Any]], Iterable[Any]]
"""Wraps items to show how far the work is, as tqdm does."""


@dataclass(frozen=True)
class KnownScan:
    """A scan of N points whose truth is known.

    Attributes
    ----------
    sequence, index : str
        Sequence, or another group of scans that belong together; name within it.
    points : (N, >=3) float
        x, y, z [m], and intensity.
    truths : dict of str to (N,) uint8
        True `Label` by key of the convention, the one that counts first; UNKNOWN where a
        point does not count.
    semantic : (N,) int or None
        Semantic classes, if known.
    ground_z : (N,) float or None
        True height of the ground [m], at least where `parts` has the point.
    parts : dict of str to (N,) bool
        Points under which the surface is compared with `ground_z`, by name of the part.
    """

    sequence: str
    index: str
    points: npt.NDArray[Any]
    truths: dict[str, Labels]
    semantic: npt.NDArray[np.integer] | None = None
    ground_z: npt.NDArray[np.floating] | None = None
    parts: dict[str, BoolArray] = field(default_factory=dict)


@dataclass(frozen=True)
class ScanScore:
    """How one method did on one scan.

    Attributes
    ----------
    sequence, index : str
        Which scan.
    seconds : float
        Time of the segmentation alone, without reading.
    stages : dict of str to float
        Seconds by stage, empty if the method does not tell.
    confusions : dict of str to Confusion
        By key of the convention, the one that counts first.
    heights : dict of str to HeightError
        Of the surface, by part of the ground.
    classes : dict of int to ClassCount
        By number of the semantic class, where they are known.
    rings : tuple of Confusion
        By `RING_TITLES`.
    calibration : Calibration or None
        Of the probabilities, if there are any.
    pose, fit : SensorPose or None, FitReport or None
        Of our own method.
    """

    sequence: str
    index: str
    seconds: float
    stages: dict[str, float] = field(default_factory=dict)
    confusions: dict[str, Confusion] = field(default_factory=dict)
    heights: dict[str, HeightError] = field(default_factory=dict)
    classes: dict[int, ClassCount] = field(default_factory=dict)
    rings: tuple[Confusion, ...] = ()
    calibration: Calibration | None = None
    pose: SensorPose | None = None
    fit: FitReport | None = None

    @property
    def confusion(self) -> Confusion:
        """Counts in the convention that counts."""
        return next(iter(self.confusions.values()))


@dataclass(frozen=True)
class MethodScore:
    """How one method, or one variant of ours, did on all scans, in the order of the scans."""

    name: str
    scans: tuple[ScanScore, ...]

    @property
    def title(self) -> str:
        """Name in tables."""
        return TITLES.get(self.name, self.name)

    @property
    def sequences(self) -> list[str]:
        """Names of the sequences, in order."""
        return list(dict.fromkeys(scan.sequence for scan in self.scans))

    @property
    def fit(self) -> FitReport | None:
        """Fit report of the last scan: backend and threads are in it."""
        return self.scans[-1].fit

    def of(self, *sequences: str | None) -> MethodScore:
        """Return the part of some sequences; None stands for all."""
        if None in sequences:
            return self
        return MethodScore(self.name, tuple(s for s in self.scans if s.sequence in sequences))

    def pooled(self, convention: str) -> Confusion:
        """Sum of the counts in a convention."""
        return sum((scan.confusions[convention] for scan in self.scans), Confusion())

    @property
    def confusion(self) -> Confusion:
        """Sum of the counts in the convention that counts."""
        return sum((scan.confusion for scan in self.scans), Confusion())

    @property
    def iou(self) -> float:
        """Intersection over union of `confusion`."""
        return self.confusion.iou

    @property
    def ece(self) -> float:
        """Expected calibration error; NaN without probabilities."""
        calibration = self.calibration
        return math.nan if calibration is None else calibration.ece

    @property
    def worst_sequence(self) -> str:
        """Name of the sequence with the lowest IoU."""
        return min(self.sequences, key=lambda name: self.of(name).iou)

    @property
    def classes(self) -> dict[int, ClassCount]:
        """Sum of the counts by class, by ascending class number."""
        total: dict[int, ClassCount] = {}
        for scan in self.scans:
            for number, count in scan.classes.items():
                before = total.get(number, ClassCount(0, 0))
                total[number] = ClassCount(*map(operator.add, before, count))
        return dict(sorted(total.items()))

    @property
    def rings(self) -> tuple[Confusion, ...]:
        """Sum of the counts by ring."""
        by_ring = zip(*(scan.rings for scan in self.scans), strict=True)
        return tuple(sum(ring, Confusion()) for ring in by_ring)

    @property
    def calibration(self) -> Calibration | None:
        """Sum over the scans; None unless every scan has one."""
        found = [scan.calibration for scan in self.scans if scan.calibration is not None]
        if not found or len(found) < len(self.scans):
            return None
        return functools.reduce(operator.add, found)

    def height(self, part: str = ALL) -> HeightError:
        """Pooled height error of a part of the ground."""
        return pool_height_errors([scan.heights[part] for scan in self.scans])

    def seconds(self, average: Callable[[list[float]], float] = statistics.median) -> float:
        """Average time per scan; NaN without scans."""
        return average([scan.seconds for scan in self.scans]) if self.scans else math.nan

    @property
    def median_stages(self) -> dict[str, float]:
        """Median seconds of each stage."""
        names = dict.fromkeys(stage for scan in self.scans for stage in scan.stages)
        return {
            name: statistics.median(s.stages[name] for s in self.scans if name in s.stages)
            for name in names
        }


def pool(name: str, scores: Iterable[MethodScore]) -> MethodScore:
    """Put the scans of several scores together."""
    return MethodScore(name, tuple(scan for one in scores for scan in one.scans))


def labelled_frames(root: str | Path, sequences: Sequence[str] | None = None) -> list[Frame]:
    """Frames of the named sequences, or of all, in order; each has labels.

    Raises
    ------
    DataError
        If a sequence is not there or named twice, or a frame has no labels.
    """
    known = list_sequences(root)
    chosen = known if sequences is None else list(sequences)
    unknown = [name for name in chosen if name not in known]
    if unknown or not chosen:
        problem = f'no sequence {", ".join(unknown)}' if chosen else 'no sequence asked for'
        raise DataError(f'{root}: {problem}; sequences here: {", ".join(known)}')
    if len(set(chosen)) < len(chosen):
        raise DataError(f'sequences {", ".join(chosen)}: one is named twice')
    frames = {name: list_frames(root, name) for name in chosen}
    bare = {name: [f for f in found if f.labels_path is None] for name, found in frames.items()}
    for name, missing in bare.items():
        if missing:
            labelled = [other for other in chosen if not bare[other]]
            hint = f'; wholly labelled: {",".join(labelled)}' if labelled else ''
            raise DataError(
                f'{root}: {len(missing)} of {len(frames[name])} frames of sequence {name} have '
                f'no labels, the first is {missing[0].index}{hint}'
            )
    return [frame for name in chosen for frame in frames[name]]


def load_kitti(frame: Frame) -> KnownScan:
    """Read a labelled frame; the ground whose height counts is what is labelled ground.

    Raises
    ------
    DataError
        If it has no labels, or a file cannot be read or does not fit.
    """
    if frame.labels_path is None:
        raise DataError(f'{frame.points_path}: has no labels')
    points = read_points(frame.points_path)
    semantic = read_labels(frame.labels_path, len(points))
    z = points[:, 2].astype(np.float64)
    truths = {one.key: one.truth(semantic, points[:, 2]) for one in CONVENTIONS}
    parts = {ALL: truths[GROUNDGRID.key] == Label.GROUND}
    return KnownScan(frame.sequence, frame.index, points, truths, semantic, z, parts)


Observer = Callable[[str, KnownScan, ScanScore, Labels], None]
"""Called as a scan is scored with the name of the method, the scan, its score, its labels."""


def score_methods(
    items: Sequence[Any],
    load: Callable[[Any], KnownScan],
    methods: Sequence[Method],
    *,
    each_alone: bool = False,
    observe: Observer | None = None,
    clock: Callable[[], float] = time.perf_counter,
    progress: Progress = iter,
) -> list[MethodScore]:
    """Run methods alternately on the same scans and score each run.

    Which method goes first changes from scan to scan. Before the first scan counts, each method
    has run on it once: compilation and first allocations are not its speed. One scan at a time
    is in memory.

    Parameters
    ----------
    items : sequence
        What is loaded, such as frames, grouped by sequence.
    load : callable
        Loads an item.
    methods : sequence of Method
        Each with a name of its own.
    each_alone : bool
        Whether methods forget before every scan, not only before every sequence.
    observe : callable, optional
        Called as soon as a scan is scored: scores alone are kept.
    clock, progress : callable
        Source of seconds; wraps the items.

    Returns
    -------
    list of MethodScore
        In the order of `methods`.

    Raises
    ------
    DataError
        If a scan cannot be loaded.
    PointCloudError
        If a method refuses a scan.
    """
    scores: dict[str, list[ScanScore]] = {method.name: [] for method in methods}
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
            score, label = _score(scan, method, seconds)
            scores[method.name].append(score)
            if observe is not None:
                observe(method.name, scan, score, label)
    return [MethodScore(name, tuple(found)) for name, found in scores.items()]


def _run(method: Method, scan: KnownScan) -> None:
    try:
        method.run(scan.points)
    except PointCloudError as error:
        raise PointCloudError(f'{scan.sequence}/{scan.index}: {method.name}: {error}') from error


def _score(scan: KnownScan, method: Method, seconds: float) -> tuple[ScanScore, Labels]:
    result = method.result()
    label, p_ground = result.label, result.p_ground
    truth = next(iter(scan.truths.values()))
    heights = {}
    if scan.ground_z is not None and scan.parts:
        z, estimate = scan.ground_z, method.ground_z()
        heights = {name: height_error(z[own], estimate[own]) for name, own in scan.parts.items()}
    score = ScanScore(
        scan.sequence,
        scan.index,
        seconds,
        result.stages,
        {key: count_confusion(label, one) for key, one in scan.truths.items()},
        heights,
        {} if scan.semantic is None else count_classes(label, scan.semantic),
        count_rings(label, truth, scan.points),
        None if p_ground is None else count_calibration(p_ground, truth),
        result.pose,
        result.fit,
    )
    return score, label


@dataclass(frozen=True)
class KeptScan:
    """A scan, its score and the labels it got, (N,) uint8."""

    scan: KnownScan
    score: ScanScore
    label: Labels


class WorstFrames:
    """Keeps the `n` scans on which `method` has the lowest IoU, the worst first."""

    def __init__(self, method: str, n: int) -> None:
        self.kept: list[KeptScan] = []
        self._method = method
        self._n = n

    def observe(self, method: str, scan: KnownScan, score: ScanScore, label: Labels) -> None:
        """Take a scan just scored; one without a defined IoU is passed over."""
        if method == self._method and not math.isnan(score.confusion.iou):
            self.kept.append(KeptScan(scan, score, label))
            self.kept.sort(key=lambda one: one.score.confusion.iou)
            del self.kept[self._n :]
