"""Methods over scans whose truth is known: scores by scan, and their sums."""

from __future__ import annotations

import itertools
import logging
import math
import statistics
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from gp_ground_seg.core.backend import Backend, make_backend
from gp_ground_seg.core.errors import DataError, PointCloudError
from gp_ground_seg.core.frame import BoolArray, FloatArray, Label
from gp_ground_seg.core.parameters.config import Config, RuntimeConfig
from gp_ground_seg.core.pipeline.sensor_pose import SensorPose
from gp_ground_seg.core.result import FitReport
from gp_ground_seg.core.segmenter import GroundSegmenter
from gp_ground_seg.data.semantic_kitti import Frame, read_entries, read_points
from gp_ground_seg.lab.scale.cluster import HERE, Progress, Runner, depends_on_past
from gp_ground_seg.lab.scoring import metrics
from gp_ground_seg.lab.scoring.metrics import CONVENTIONS, GROUNDGRID, Confusion, Labels
from gp_ground_seg.lab.scoring.objects import (
    ObjectCounts,
    Objects,
    count_objects,
    labelled_objects,
    pool_objects,
)

_LOGGER = logging.getLogger('gp_ground_seg')
OURS = 'gp_ground_seg'
PATCHWORKPP = 'patchworkpp'
TITLES = {PATCHWORKPP: 'Patchwork++'}
"""Names of methods in tables, where they differ from those in files."""
ALL = 'all'
Points = npt.NDArray[np.floating]


@dataclass(frozen=True)
class MethodResult:
    """What a method says of a scan."""

    label: Labels  # (N,)
    ground_z: FloatArray  # (N,) height of the ground under each point [m]; NaN = no model
    p_ground: npt.NDArray[np.floating] | None = None  # (N,), where it has probabilities
    return_std: FloatArray | None = None  # (N,) of a ground return about `ground_z` [m]
    stages: dict[str, float] = field(default_factory=dict)  # seconds
    pose: SensorPose | None = None
    fit: FitReport | None = None


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

    def __init__(
        self,
        config: Config,
        name: str = OURS,
        make: Callable[[RuntimeConfig], Backend] = make_backend,
    ) -> None:
        self.name, self.depends_on_past, self._make = name, depends_on_past(config), make
        self._segmenter = GroundSegmenter(config, backend=make(config.runtime))

    def __reduce__(self) -> tuple[Any, ...]:
        """Send a worker what to make it of; it has one thread there, as there are many."""
        config = self._segmenter.config.replace(**{'runtime.n_threads': 1})
        return type(self), (config, self.name, self._make)

    def reset(self) -> None:
        """Forget what was learned."""
        self._segmenter.reset()

    def run(self, points: Points) -> None:
        """Segment a scan."""
        self.last = self._segmenter.segment(points)

    @property
    def stages(self) -> dict[str, float]:
        """Seconds of each stage of the last scan."""
        timings = self.last.timings
        return {stage: timings[stage] for stage in timings if stage != 'total'}

    def result(self) -> MethodResult:
        """Return all there is of the last scan."""
        own = self.last
        return MethodResult(
            own.label, own.ground_z, own.p_ground, own.return_std, self.stages, own.pose, own.fit
        )

    def close(self) -> None:
        """End the worker threads."""
        self._segmenter.close()


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


@dataclass(frozen=True)
class ScanScore:
    """How one method did on one scan."""

    sequence: str
    index: str
    seconds: float  # without reading
    stages: dict[str, float] = field(default_factory=dict)  # seconds, if the method reports them
    confusions: dict[str, Confusion] = field(default_factory=dict)  # as `KnownScan.truths`
    height: metrics.HeightError | None = None  # where the truth is known
    classes: dict[int, metrics.ClassCount] = field(default_factory=dict)
    rings: tuple[Confusion, ...] = ()  # by `RING_TITLES`
    calibration: metrics.Calibration | None = None  # where the method has probabilities
    objects: ObjectCounts = field(default_factory=dict)
    pose: SensorPose | None = None  # of our own method
    fit: FitReport | None = None

    @property
    def confusion(self) -> Confusion:
        """Counts in the convention that counts."""
        return next(iter(self.confusions.values()), Confusion())


@dataclass(frozen=True)
class MethodScore:
    """How one method, or one variant of ours, did on all scans, in their order."""

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

    def parts(self) -> list[MethodScore]:
        """Return the part of each sequence."""
        return [self.of(name) for name in self.sequences]

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
    def classes(self) -> dict[int, metrics.ClassCount]:
        """Sum of the counts by class, by ascending class number."""
        numbers = sorted({number for scan in self.scans for number in scan.classes})
        counts = {n: [s.classes[n] for s in self.scans if n in s.classes] for n in numbers}
        return {
            n: metrics.ClassCount(*map(sum, zip(*own, strict=True))) for n, own in counts.items()
        }

    @property
    def rings(self) -> tuple[Confusion, ...]:
        """Sum of the counts by ring."""
        of_scans = [scan.rings for scan in self.scans]
        return tuple(sum(ring, Confusion()) for ring in zip(*of_scans, strict=True))

    @property
    def objects(self) -> ObjectCounts:
        """Sum of the counts of objects."""
        return pool_objects([scan.objects for scan in self.scans])

    @property
    def calibration(self) -> metrics.Calibration | None:
        """Sum over the scans; None unless every scan has one."""
        found = [scan.calibration for scan in self.scans if scan.calibration is not None]
        if not found or len(found) < len(self.scans):
            return None
        return sum(found[1:], found[0])

    @property
    def height(self) -> metrics.HeightError:
        """Pooled height error."""
        return metrics.pool_height_errors([s.height for s in self.scans if s.height is not None])

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


def load_kitti(frame: Frame) -> KnownScan:
    """Read a labelled frame; the ground whose height counts is what is labelled ground."""
    if frame.labels_path is None:
        raise DataError(f'{frame.points_path}: has no labels')
    points = read_points(frame.points_path, frame.layout)
    entries = read_entries(frame.labels_path, len(points))
    semantic = (entries & 0xFFFF).astype(np.uint16)
    z = points[:, 2].astype(np.float64)
    truths = {one.key: one.truth(semantic, points[:, 2]) for one in CONVENTIONS}
    is_ground = truths[GROUNDGRID.key] == Label.GROUND
    objects = labelled_objects(points, entries, is_ground)
    return KnownScan(frame.sequence, frame.index, points, truths, semantic, z, is_ground, objects)


def score_methods(
    items: Sequence[Any],
    load: Callable[[Any], KnownScan],
    methods: Sequence[Method],
    *,
    each_alone: bool = False,
    clock: Callable[[], float] = time.perf_counter,
    runner: Runner = HERE,
    watch: Callable[[KnownScan], None] | None = None,
) -> list[MethodScore]:
    """Run methods alternately on the same scans and score each run, in the order of `methods`.

    Which method goes first changes from scan to scan. Each runs once without counting:
    compilation and first allocations are not its speed. `items`, grouped by sequence, are loaded
    one by one. Methods are reset before each sequence, or with `each_alone` before each scan.
    `watch` is called with each scan after all methods have run on it.
    """
    score = partial(_score_block, load, methods, each_alone, clock, watch)
    has_past = not each_alone and any(method.depends_on_past for method in methods)
    parts = runner.run(score, items, _sequence_of if has_past else None)
    scans = [tuple(itertools.chain(*own)) for own in zip(*parts, strict=True)]
    return [MethodScore(one.name, own) for one, own in zip(methods, scans, strict=True)]


def _sequence_of(item: Any) -> str:
    name: str = item.sequence
    return name


def _score_block(
    load: Callable[[Any], KnownScan],
    methods: Sequence[Method],
    each_alone: bool,
    clock: Callable[[], float],
    watch: Callable[[KnownScan], None] | None,
    items: Sequence[Any],
    progress: Progress,
) -> list[list[ScanScore]]:
    """Scores of some scans, by method."""
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
        if watch is not None:
            watch(scan)
    return list(scores.values())


def _run(method: Method, scan: KnownScan) -> None:
    try:
        method.run(scan.points)
    except PointCloudError as error:
        raise PointCloudError(f'{scan.sequence}/{scan.index}: {method.name}: {error}') from error


def _score(scan: KnownScan, method: Method, seconds: float) -> ScanScore:
    result = method.result()
    label, p_ground = result.label, result.p_ground
    truth = next(iter(scan.truths.values()), None)
    height = None
    if scan.ground_z is not None:
        own = scan.is_ground
        std = None if result.return_std is None else result.return_std[own]
        height = metrics.height_error(scan.ground_z[own], result.ground_z[own], std)
    return ScanScore(
        scan.sequence, scan.index, seconds, result.stages,
        {key: metrics.count_confusion(label, one) for key, one in scan.truths.items()},
        height,
        {} if scan.semantic is None else metrics.count_classes(label, scan.semantic),
        () if truth is None else metrics.count_rings(label, truth, scan.points),
        None if p_ground is None or truth is None else metrics.count_calibration(p_ground, truth),
        {} if scan.objects is None else count_objects(scan.points, label, scan.objects),
        result.pose, result.fit,
    )  # fmt: skip
