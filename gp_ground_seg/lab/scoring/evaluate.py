"""Methods over scans whose truth is known: scores by scan, and their sums."""

from __future__ import annotations

import copy
import itertools
import math
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from operator import attrgetter
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from gp_ground_seg.core.backend import Backend, make_backend
from gp_ground_seg.core.errors import DataError, PointCloudError, shown
from gp_ground_seg.core.frame import BoolArray, FloatArray, Label
from gp_ground_seg.core.parameters.config import Config, RuntimeConfig
from gp_ground_seg.core.pipeline.sensor_pose import SensorPose
from gp_ground_seg.core.result import FitReport
from gp_ground_seg.core.segmenter import GroundSegmenter
from gp_ground_seg.data.semantic_kitti import Frame, read_entries, read_points
from gp_ground_seg.lab.scale.cluster import HERE, Progress, Runner
from gp_ground_seg.lab.scoring import metrics
from gp_ground_seg.lab.scoring.metrics import (
    CONVENTIONS,
    GROUNDGRID,
    Calibration,
    Confusion,
    HeightError,
    Labels,
    Sums,
)
from gp_ground_seg.lab.scoring.objects import (
    LOW_THINGS,
    CutScan,
    ObjectCounts,
    Objects,
    Shares,
    count_false_cells,
    count_objects,
    cut_objects,
    labelled_objects,
    pool_objects,
    pool_shares,
)

OURS = 'gp_ground_seg'
PATCHWORKPP = 'patchworkpp'
TITLES = {PATCHWORKPP: 'Patchwork++'}
"""Names of methods in tables, where they differ from those in files."""
ALL = 'all'
Points = npt.NDArray[np.floating]


@dataclass(frozen=True)
class MethodResult:
    """Labels of a scan of N points, and the surface under it."""

    label: Labels  # (N,)
    ground_z: FloatArray  # (N,) height of the ground under each point [m]; NaN = no model
    p_ground: npt.NDArray[np.floating] | None = None  # (N,), where the method has probabilities
    return_std: FloatArray | None = None  # (N,) of a ground return about `ground_z` [m]
    ground_std: FloatArray | None = None  # (N,) of the ground about `ground_z` [m]
    stages: dict[str, float] = field(default_factory=dict)  # seconds
    pose: SensorPose | None = None
    fit: FitReport | None = None
    height: FloatArray | None = None  # (N,) over the surface, where the method has one [m]


class Method(Protocol):
    """Something that labels scans, one sequence after the other."""

    name: str
    depends_on_past: bool  # whether the labels of a scan depend on the scans before it

    def reset(self) -> None:
        """Forget what was learned from earlier scans."""

    def run(self, points: Points) -> None:
        """Segment a scan of (N, 4) x, y, z, intensity: the part that is timed."""

    def result(self) -> MethodResult:
        """Return the result of the last scan."""


class OurMethod:
    """`GroundSegmenter` as a method; `last` is its last result."""

    depends_on_past = False

    def __init__(
        self,
        config: Config,
        name: str = OURS,
        make: Callable[[RuntimeConfig], Backend] = make_backend,
    ) -> None:
        self.name, self._make = name, make
        self._segmenter = GroundSegmenter(config, backend=make(config.runtime))

    def __reduce__(self) -> tuple[Any, ...]:
        """Send the configuration to a worker."""
        return type(self), (self._segmenter.config, self.name, self._make)

    def reset(self) -> None:
        """Do nothing: each scan is segmented by itself."""

    def run(self, points: Points) -> None:
        """Segment a scan."""
        self.last = self._segmenter.segment(points)

    def result(self) -> MethodResult:
        """Return the result of the last scan."""
        last = self.last
        stages = {stage: s for stage, s in last.timings.items() if stage != 'total'}
        return MethodResult(
            last.label, last.ground_z, last.p_ground, last.return_std, last.ground_std,
            stages, last.pose, last.fit, last.height,
        )  # fmt: skip


@dataclass(frozen=True)
class KnownScan:
    """A scan of N points whose truth is known."""

    sequence: str  # or another group of scans that belong together
    index: str  # name within it
    points: npt.NDArray[Any]  # (N, >=3) x, y, z [m], and intensity
    truths: dict[str, Labels]
    """True `Label` (N,) by convention, the one that counts first; UNKNOWN does not count."""
    semantic: npt.NDArray[np.integer] | None = None  # (N,) classes, if known
    ground_z: npt.NDArray[np.floating] | None = None  # (N,) true height of the ground [m]
    is_ground: BoolArray | None = None  # (N,) points under which the surface is compared with it
    objects: Objects | None = None  # what stands on the ground, if known
    std: str = 'return_std'
    """Field of `MethodResult` that the errors of the height are compared with: heights of ground
    returns scatter by `return_std`, exact heights by `ground_std`."""
    cluster: str = ''  # scans that the bootstrap draws together; by default the sequence
    cut: CutScan | None = None  # what of it is segmented once more, to count low things


@dataclass(frozen=True)
class RingScore(Sums):
    """Scores within one ring of horizontal range."""

    confusion: Confusion = field(default_factory=Confusion)
    height: HeightError = field(default_factory=HeightError)
    calibration: Calibration = field(default_factory=Calibration)


@dataclass(frozen=True)
class ScanScore:
    """How one method did on one scan."""

    sequence: str
    index: str
    seconds: float  # without reading
    stages: dict[str, float] = field(default_factory=dict)  # seconds, if the method reports them
    confusions: dict[str, Confusion] = field(default_factory=dict)  # as `KnownScan.truths`
    height: HeightError = field(default_factory=HeightError)
    rings: tuple[RingScore, ...] = ()  # by `metrics.RING_TITLES`, where the truth is known
    objects: ObjectCounts = field(default_factory=dict)
    shares: Shares = field(default_factory=dict)
    pose: SensorPose | None = None  # of our method
    fit: FitReport | None = None
    cluster: str = ''  # as in `KnownScan`
    n_points: int = 0
    n_changed: int = 0  # of them with another label than by the first method

    @property
    def confusion(self) -> Confusion:
        """Counts in the convention that counts."""
        return next(iter(self.confusions.values()), Confusion())

    @property
    def calibration(self) -> Calibration:
        """Sum over the rings; empty if the method has no probabilities."""
        return sum((ring.calibration for ring in self.rings), Calibration())


@dataclass(frozen=True)
class MethodScore:
    """How one method, or one variant of ours, did on all scans, in their order.

    The properties are sums over the scans.
    """

    name: str
    scans: tuple[ScanScore, ...]

    @property
    def title(self) -> str:
        """Name in tables."""
        return TITLES.get(self.name, self.name)

    @property
    def has_labels(self) -> bool:
        """Whether the ground of the scans is known."""
        return any(scan.confusions for scan in self.scans)

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
        """Counts in the convention that counts."""
        return sum((scan.confusion for scan in self.scans), Confusion())

    @property
    def iou(self) -> float:
        """Intersection over union of `confusion`."""
        return self.confusion.iou

    @property
    def rings(self) -> tuple[RingScore, ...]:
        """Scores by ring."""
        of_scans = [scan.rings for scan in self.scans]
        return tuple(sum(ring, RingScore()) for ring in zip(*of_scans, strict=True))

    @property
    def objects(self) -> ObjectCounts:
        """Counts of objects."""
        return pool_objects([scan.objects for scan in self.scans])

    @property
    def shares(self) -> Shares:
        """Low things called ground, and false cells."""
        return pool_shares([scan.shares for scan in self.scans])

    @property
    def calibration(self) -> Calibration:
        """Probabilities against the truth."""
        return sum((scan.calibration for scan in self.scans), Calibration())

    @property
    def height(self) -> HeightError:
        """Height errors."""
        return sum((scan.height for scan in self.scans), HeightError())

    def seconds(self, average: Callable[[list[float]], float] = statistics.median) -> float:
        """Average time per scan; NaN without scans."""
        return average([scan.seconds for scan in self.scans]) if self.scans else math.nan

    @property
    def median_stages(self) -> dict[str, float]:
        """Median seconds of each stage."""
        names = self.scans[0].stages
        return {name: statistics.median(s.stages[name] for s in self.scans) for name in names}


def pool(name: str, scores: Sequence[MethodScore]) -> MethodScore:
    """Put the scans of several scores together."""
    return MethodScore(name, tuple(scan for score in scores for scan in score.scans))


def load_kitti(frame: Frame, cut: float = 0.0) -> KnownScan:
    """Read a labelled frame; the ground whose height counts is what is labelled ground.

    Objects are cut at the height `cut` [m] to count low things; with 0 none are.
    """
    if frame.labels_path is None:
        raise DataError(f'{frame.points_path}: has no labels')
    points = read_points(frame.points_path, frame.columns)
    entries = read_entries(frame.labels_path, len(points))
    semantic = (entries & 0xFFFF).astype(np.uint16)
    z = points[:, 2].astype(np.float64)
    truths = {rule.key: rule.truth(semantic, points[:, 2]) for rule in CONVENTIONS}
    is_ground = truths[GROUNDGRID.key] == Label.GROUND
    objects = labelled_objects(points, entries, is_ground)
    names = shown(frame.sequence), shown(frame.index)
    low = cut_objects(points, objects.class_of >= 0, is_ground, cut) if cut else None
    return KnownScan(*names, points, truths, semantic, z, is_ground, objects, cut=low)


def as_it_is(scan: KnownScan) -> KnownScan:
    """Return a scan that is in memory already."""
    return scan


def score_methods(
    items: Sequence[Any],
    methods: Sequence[Method],
    load: Callable[[Any], KnownScan] = load_kitti,
    *,
    each_alone: bool = False,
    clock: Callable[[], float] = time.perf_counter,
    runner: Runner = HERE,
) -> list[MethodScore]:
    """Run methods alternately on the same scans and score each run, in the order of `methods`.

    Which method goes first changes from scan to scan. Each runs once without counting:
    compilation and first allocations are not its speed. `items`, grouped by sequence, are loaded
    one by one. Methods are reset before each sequence, or with `each_alone` before each scan.

    Of scans with a `KnownScan.cut`, which all have or none, copies of the methods run on it, in
    the same order, without being timed.
    """
    score = partial(_score_block, load, methods, each_alone, clock)
    has_past = not each_alone and any(method.depends_on_past for method in methods)
    parts = runner.run(score, items, attrgetter('sequence') if has_past else None)
    scans = [tuple(itertools.chain(*blocks)) for blocks in zip(*parts, strict=True)]
    return [MethodScore(m.name, found) for m, found in zip(methods, scans, strict=True)]


def _score_block(
    load: Callable[[Any], KnownScan],
    methods: Sequence[Method],
    each_alone: bool,
    clock: Callable[[], float],
    items: Sequence[Any],
    progress: Progress,
) -> list[list[ScanScore]]:
    """Scores of some scans, by method."""
    scores: list[list[ScanScore]] = [[] for _ in methods]
    sequence = None
    for k, item in enumerate(progress(items)):
        scan = load(item)
        if k == 0:
            # What a method learns from cut scans it must not know in the whole ones.
            copies = (
                [copy.copy(method) for method in methods] if scan.cut else [None] * len(methods)
            )
            for method in methods:
                _run(method, scan)
        forgets = each_alone or scan.sequence != sequence
        sequence = scan.sequence
        seconds = {}
        for method in methods if k % 2 == 0 else reversed(methods):
            if forgets:
                method.reset()
            start = clock()
            _run(method, scan)
            seconds[method] = clock() - start
        results = [method.result() for method in methods]
        for method, other, result, found in zip(methods, copies, results, scores, strict=True):
            shares = _low_things(scan, other, forgets=forgets)
            found.append(_score(scan, result, seconds[method], results[0].label, shares))
    return scores


def _run(method: Method, scan: KnownScan) -> None:
    try:
        method.run(scan.points)
    except PointCloudError as error:
        raise PointCloudError(f'{scan.sequence}/{scan.index}: {method.name}: {error}') from error


def _low_things(scan: KnownScan, method: Method | None, *, forgets: bool) -> Shares:
    """Run a method on what is left of a cut scan, and count the low things called ground."""
    if scan.cut is None or method is None:
        return {}
    if forgets:
        method.reset()
    _run(method, replace(scan, points=scan.points[scan.cut.is_kept]))
    return {LOW_THINGS: scan.cut.count(method.result().label)}


def _score(
    scan: KnownScan, result: MethodResult, seconds: float, first: Labels, shares: Shares
) -> ScanScore:
    label, max_nlpd = result.label, _max_nlpd(scan, result)
    if scan.semantic is not None and result.height is not None:
        shares = shares | count_false_cells(scan.points, label, result.height, scan.semantic)
    return ScanScore(
        scan.sequence, scan.index, seconds, result.stages,
        {key: metrics.count_confusion(label, truth) for key, truth in scan.truths.items()},
        _height_error(scan, result, slice(None), max_nlpd),
        _score_rings(scan, result, max_nlpd),
        {} if scan.objects is None else count_objects(scan.points, label, scan.objects),
        shares, result.pose, result.fit, scan.cluster or scan.sequence,
        len(label), int((label != first).sum()),
    )  # fmt: skip


def _height_error(
    scan: KnownScan, result: MethodResult, inside: BoolArray | slice, max_nlpd: float
) -> HeightError:
    """Error of the surface under the ground points `inside` a part of the scan."""
    if scan.ground_z is None or scan.is_ground is None:
        return HeightError()
    ground = scan.is_ground[inside]
    std = getattr(result, scan.std)
    return metrics.height_error(
        scan.ground_z[inside][ground],
        result.ground_z[inside][ground],
        None if std is None else std[inside][ground],
        max_nlpd,
    )


def _max_nlpd(scan: KnownScan, result: MethodResult) -> float:
    """Largest NLPD that counts in a scan."""
    std = getattr(result, scan.std)
    if scan.ground_z is None or scan.is_ground is None or std is None:
        return math.inf
    error = (result.ground_z - scan.ground_z)[scan.is_ground]
    return metrics.largest_nlpd(metrics.negative_log_density(error, std[scan.is_ground]))


def _score_rings(scan: KnownScan, result: MethodResult, max_nlpd: float) -> tuple[RingScore, ...]:
    truth = next(iter(scan.truths.values()), None)
    if truth is None:
        return ()
    confusions = metrics.count_rings(result.label, truth, scan.points)
    ring = metrics.ring_of(scan.points)
    found = []
    for k, confusion in enumerate(confusions):
        inside, calibration = ring == k, Calibration()
        if result.p_ground is not None:
            calibration = metrics.count_calibration(result.p_ground[inside], truth[inside])
        height = _height_error(scan, result, inside, max_nlpd)
        found.append(RingScore(confusion, height, calibration))
    return tuple(found)
