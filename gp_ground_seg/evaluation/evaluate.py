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
from gp_ground_seg.evaluation.methods import TITLES, Method
from gp_ground_seg.evaluation.metrics import (
    CONVENTIONS,
    GROUNDGRID,
    Calibration,
    ClassCount,
    Confusion,
    HeightError,
    Labels,
    count_calibration,
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
    semantic, ground_z : (N,) int or None, (N,) float or None
        Semantic classes and true height of the ground [m], if known.
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
    seconds, stages : float, dict of str to float
        Time of the segmentation without reading, and by stage if the method measures it.
    confusions : dict of str to Confusion
        By key of the convention, the one that counts first.
    heights, classes : dict of str to HeightError, dict of int to ClassCount
        By part of the ground, and by number of the semantic class, as far as they are known.
    rings : tuple of Confusion
        By `RING_TITLES`.
    calibration, pose, fit : Calibration, SensorPose, FitReport or None
        Where the method has probabilities; of our own method.
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

    def of(self, *sequences: str) -> MethodScore:
        """Return the part of some sequences."""
        return MethodScore(self.name, tuple(s for s in self.scans if s.sequence in sequences))

    def by_sequence(self) -> list[tuple[str, MethodScore]]:
        """Return the parts of the sequences by name, and the whole as `ALL`."""
        return [*((name, self.of(name)) for name in self.sequences), (ALL, self)]

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
    def classes(self) -> dict[int, ClassCount]:
        """Sum of the counts by class, by ascending class number."""
        numbers = sorted({number for scan in self.scans for number in scan.classes})
        counts = {n: [s.classes[n] for s in self.scans if n in s.classes] for n in numbers}
        return {n: ClassCount(*map(sum, zip(*own, strict=True))) for n, own in counts.items()}

    @property
    def rings(self) -> tuple[Confusion, ...]:
        """Sum of the counts by ring."""
        by_ring = zip(*(scan.rings for scan in self.scans), strict=True)
        return tuple(sum(ring, Confusion()) for ring in by_ring)

    @property
    def calibration(self) -> Calibration | None:
        """Sum over the scans; None unless every scan has one."""
        found = [scan.calibration for scan in self.scans if scan.calibration is not None]
        complete = found and len(found) == len(self.scans)
        return functools.reduce(operator.add, found) if complete else None

    def height(self, part: str = ALL) -> HeightError:
        """Pooled height error of a part of the ground."""
        return pool_height_errors([scan.heights[part] for scan in self.scans])

    def seconds(self, average: Callable[[list[float]], float] = statistics.median) -> float:
        """Average time per scan; NaN without scans."""
        return average([scan.seconds for scan in self.scans]) if self.scans else math.nan

    @property
    def median_stages(self) -> dict[str, float]:
        """Median seconds of each stage."""
        names = self.scans[0].stages
        return {name: statistics.median(s.stages[name] for s in self.scans) for name in names}


def pool(name: str, scores: Iterable[MethodScore]) -> MethodScore:
    """Put the scans of several scores together."""
    return MethodScore(name, tuple(scan for one in scores for scan in one.scans))


def labelled_frames(root: str | Path, sequences: Sequence[str] | None = None) -> list[Frame]:
    """Frames of the named sequences, or of all, in order.

    Raises DataError if a sequence is not there or named twice, or a frame has no labels.
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
    labelled = ','.join(name for name in chosen if not bare[name])
    for name, missing in bare.items():
        if missing:
            raise DataError(
                f'{root}: {len(missing)} of {len(frames[name])} frames of sequence {name} have no '
                f'labels, the first is {missing[0].index}; wholly labelled: {labelled or "none"}'
            )
    return [frame for found in frames.values() for frame in found]


def load_kitti(frame: Frame) -> KnownScan:
    """Read a labelled frame; the ground whose height counts is what is labelled ground.

    Raises DataError if it has no labels, or a file cannot be read or does not fit.
    """
    if frame.labels_path is None:
        raise DataError(f'{frame.points_path}: has no labels')
    points = read_points(frame.points_path)
    semantic = read_labels(frame.labels_path, len(points))
    z = points[:, 2].astype(np.float64)
    truths = {one.key: one.truth(semantic, points[:, 2]) for one in CONVENTIONS}
    parts = {ALL: truths[GROUNDGRID.key] == Label.GROUND}
    return KnownScan(frame.sequence, frame.index, points, truths, semantic, z, parts)


def score_methods(
    items: Sequence[Any],
    load: Callable[[Any], KnownScan],
    methods: Sequence[Method],
    *,
    each_alone: bool = False,
    clock: Callable[[], float] = time.perf_counter,
    progress: Progress = iter,
) -> list[MethodScore]:
    """Run methods alternately on the same scans and score each run, in the order of `methods`.

    Which method goes first changes from scan to scan. Before the first scan counts, each method
    has run on it once: compilation and first allocations are not its speed. One scan at a time
    is in memory. Methods are reset before each sequence, or with `each_alone` before each scan.

    Parameters
    ----------
    items, load : sequence, callable
        What is loaded, such as frames, grouped by sequence, and by what.
    methods : sequence of Method
        Each with a name of its own.

    Raises
    ------
    PointCloudError
        If a method refuses a scan; what `load` raises is passed on.
    """
    scores: dict[str, list[ScanScore]] = {method.name: [] for method in methods}
    sequence = None
    for k, item in enumerate(progress(items)):
        scan = load(item)
        if k == 0:
            for method in methods:
                _run(method, scan)
        forgets = each_alone or scan.sequence != sequence
        sequence = scan.sequence
        for method in methods if k % 2 == 0 else reversed(methods):
            if forgets:
                method.reset()
            start = clock()
            _run(method, scan)
            scores[method.name].append(_score(scan, method, clock() - start))
    return [MethodScore(name, tuple(found)) for name, found in scores.items()]


def _run(method: Method, scan: KnownScan) -> None:
    try:
        method.run(scan.points)
    except PointCloudError as error:
        raise PointCloudError(f'{scan.sequence}/{scan.index}: {method.name}: {error}') from error


def _score(scan: KnownScan, method: Method, seconds: float) -> ScanScore:
    result = method.result()
    label, p_ground = result.label, result.p_ground
    truth = next(iter(scan.truths.values()))
    heights = {}
    if scan.ground_z is not None and scan.parts:
        z, estimate = scan.ground_z, method.ground_z()
        heights = {name: height_error(z[own], estimate[own]) for name, own in scan.parts.items()}
    return ScanScore(
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
