"""Methods over scans whose truth is known, and their scores: frames of pandas.

A row has sums, which `groupby` adds up: a table is sums over some rows, then ratios of them.
"""

from __future__ import annotations

import copy
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from operator import attrgetter
from typing import Any, NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from gp_ground_seg.core.backend import Backend
from gp_ground_seg.core.errors import PointCloudError, shown
from gp_ground_seg.core.frame import FloatArray, Label, PointArray
from gp_ground_seg.core.parameters.config import Config
from gp_ground_seg.core.result import Segmentation
from gp_ground_seg.core.segmenter import GroundSegmenter
from gp_ground_seg.data.semantic_kitti import VEGETATION, Entries, Frame
from gp_ground_seg.lab.cluster import HERE, Progress, Runner
from gp_ground_seg.lab.scoring import metrics, objects
from gp_ground_seg.lab.scoring.objects import OBJECT_COUNTS, CutScan, Objects
from gp_ground_seg.lab.scoring.report import DataFrame, frame_of, require_pandas

OURS = 'gp_ground_seg'
PATCHWORKPP = 'Patchwork++'
FIT = ('mode', 'status', 'n_evaluations', 'n_segments', 'n_pseudo_inputs', 'backend')
POSE = ('height', 'height_estimated', 'roll', 'pitch')
"""What is reported of the learning and of the sensor in a scan of ours; angles in radians."""
STAGE = 'stage_'
"""Beginning of the columns with the seconds of a stage of ours."""
Mount = tuple[float | None, Sequence[float]]
"""Height of a sensor over the ground, if known, and its place in the frame of the cloud [m]."""

ALL = 'all'
KEYS = ('method', 'sequence', 'index')
"""Columns of every frame. Method and sequence are in the order of the methods and the scans."""
COLUMNS: dict[str, tuple[str, ...]] = {
    'scans': KEYS,
    'rings': (*KEYS, 'range', *metrics.COUNTS),
    'objects': (*KEYS, 'class', *OBJECT_COUNTS),
}
"""Columns that each frame has, even without rows."""

Rows = dict[str, list[dict[str, Any]]]
"""Rows of each frame."""


@dataclass(frozen=True)
class MethodResult:
    """Labels of a scan of N points, and the surface under it.

    Its names, and more of them, are those of our `Segmentation`.
    """

    label: metrics.Labels  # (N,)
    ground_z: FloatArray  # (N,) height of the ground under each point [m]; NaN = no model


class Method(Protocol):
    """Something that labels scans, one sequence after the other."""

    name: str
    depends_on_past: bool = False  # whether the labels of a scan depend on the scans before it

    def reset(self, scan: KnownScan) -> None:
        """Forget what was learned from earlier scans, if anything is; `scan` is the next."""
        return

    def run(self, points: PointArray) -> None:
        """Segment a scan of (N, 4) x, y, z, intensity: the part that is timed."""

    def result(self) -> MethodResult | Segmentation:
        """Return the result of the last scan."""


class OurMethod(Method):
    """`GroundSegmenter` as a method; `last` is its last result."""

    def __init__(self, config: Config, name: str = OURS, backend: Backend | None = None) -> None:
        self.name, self._segmenter = name, GroundSegmenter(config, backend=backend)

    def __reduce__(self) -> tuple[Any, ...]:
        """Send the configuration to a worker."""
        return type(self), (self._segmenter.config, self.name)

    def run(self, points: PointArray) -> None:
        """Segment a scan."""
        self.last = self._segmenter.segment(points)

    def result(self) -> Segmentation:
        """Return the result of the last scan."""
        return self.last


@dataclass(frozen=True)
class KnownScan:
    """A scan of N points whose truth is known."""

    sequence: str  # or another group of scans that belong together
    index: str  # name within it
    points: npt.NDArray[Any]  # (N, >=3) x, y, z [m], and intensity
    truth: metrics.Labels | None = None  # (N,) true `Label`, if known; UNKNOWN does not count
    semantic: npt.NDArray[np.integer] | None = None  # (N,) classes, if known
    # (N,) true height of the ground [m], with which the surface under true ground is compared
    ground_z: PointArray | None = None
    objects: Objects | None = None  # what stands on the ground, if known
    std: str = 'return_std'
    """Field of `Segmentation` that the errors of the height are compared with: heights of ground
    returns scatter by `return_std`, exact heights by `ground_std`."""
    cluster: str = ''  # scans that the bootstrap draws together; by default the sequence
    mount: Mount | None = None  # that a method with a past is told, if it differs by scan
    cut: CutScan | None = None  # what of it is segmented once more, to count low things


def load_kitti(frame: Frame, cut: float = 0.0) -> KnownScan:
    """Read a labelled frame; the ground whose height counts is what is labelled ground.

    Objects are cut at the height `cut` [m] to count low things; with 0 none are.
    """
    names = shown(frame.sequence), shown(frame.index)
    return labelled_scan(*names, frame.points, frame.entries, cut)


def labelled_scan(
    sequence: str, index: str, points: PointArray, entries: Entries, cut: float = 0.0
) -> KnownScan:
    """Return a scan whose truth are the entries of a ``.label`` file, (N,); see `load_kitti`."""
    semantic = (entries & 0xFFFF).astype(np.uint16)
    z = points[:, 2].astype(np.float64)
    truth = metrics.true_labels(semantic)
    is_ground = truth == Label.GROUND
    found = objects.labelled_objects(points, entries, is_ground)
    can_be_cut = (found.class_of >= 0) & (semantic != VEGETATION)
    low = objects.cut_objects(points, can_be_cut, is_ground, cut) if cut else None
    return KnownScan(sequence, index, points, truth, semantic, z, found, cut=low)


def score_methods(
    items: Sequence[Any],
    methods: Sequence[Method],
    load: Callable[[Any], KnownScan] = load_kitti,
    *,
    each_alone: bool = False,
    runner: Runner = HERE,
) -> Scores:
    """Run methods alternately on the same scans and score each run.

    Which method goes first changes from scan to scan. Each runs once without counting:
    compilation and first allocations are not its speed. `items`, grouped by sequence, are loaded
    one by one. Methods are reset before each sequence, or with `each_alone` before each scan.

    Of scans with a `KnownScan.cut`, which all have or none, copies of the methods run on it, in
    the same order, without being timed.
    """
    require_pandas()  # before any scan is read
    score = partial(score_rows, load, methods, each_alone=each_alone)
    has_past = not each_alone and any(method.depends_on_past for method in methods)
    return make_scores(runner.run(score, items, attrgetter('sequence') if has_past else None))


def score_rows(
    load: Callable[[Any], KnownScan],
    methods: Sequence[Method],
    items: Sequence[Any],
    progress: Progress,
    *,
    each_alone: bool,
) -> Rows:
    """Rows of some scans, by frame."""
    rows: Rows = {name: [] for name in COLUMNS}
    sequence = None
    for k, item in enumerate(progress(items)):
        scan = load(item)
        if k == 0:
            # What a method learns from cut scans it must not know in the whole ones.
            copies = [copy.copy(method) for method in methods]
            for method in methods:
                _run(method, scan)
        forgets = each_alone or scan.sequence != sequence
        sequence = scan.sequence
        seconds = {}
        for method in methods if k % 2 == 0 else reversed(methods):
            if forgets:
                method.reset(scan)
            start = time.perf_counter()
            _run(method, scan)
            seconds[method] = time.perf_counter() - start
        results = [method.result() for method in methods]
        for method, other, result in zip(methods, copies, results, strict=True):
            own = score_scan(scan, result)
            own['scans'][0] |= {
                'seconds': seconds[method],
                'n_changed': int((result.label != results[0].label).sum()),
                **_low_things(scan, other, forgets=forgets),
            }
            keys = {'method': method.name, 'sequence': scan.sequence, 'index': scan.index}
            for name, found in own.items():
                rows[name] += (keys | row for row in found)
    return rows


def _run(method: Method, scan: KnownScan) -> None:
    try:
        method.run(scan.points)
    except PointCloudError as error:
        raise PointCloudError(f'{scan.sequence}/{scan.index}: {method.name}: {error}') from error


def _low_things(scan: KnownScan, method: Method, *, forgets: bool) -> dict[str, int]:
    """Run a method on what is left of a cut scan, and count the low things called ground."""
    if scan.cut is None:
        return {}
    if forgets:
        method.reset(scan)
    _run(method, replace(scan, points=scan.points[scan.cut.is_kept]))
    return scan.cut.count_ground(method.result().label)


def score_scan(scan: KnownScan, result: MethodResult | Segmentation) -> Rows:
    """Rows of a scan, by frame. What else is counted of a labelled scan gets its line here."""
    label, rows = result.label, Rows()
    sums: dict[str, Any] = {'cluster': scan.cluster or scan.sequence, 'n_scans': 1}
    sums['points'] = len(label)
    if scan.truth is not None:
        sums |= metrics.count_labels(label, scan.truth)
        rows['rings'] = metrics.count_rings(label, scan.truth, scan.points)
    if scan.ground_z is not None:
        ground, std = scan.truth == Label.GROUND, getattr(result, scan.std, None)
        sums |= metrics.height_sums(
            scan.ground_z[ground], result.ground_z[ground], None if std is None else std[ground]
        )
    if scan.objects is not None:
        rows['objects'] = objects.count_objects(scan.points, label, scan.objects)
        things = [row for row in rows['objects'] if row['class'] != objects.PLANTS]
        sums |= {name: sum(row[name] for row in things) for name in OBJECT_COUNTS}
    if isinstance(result, Segmentation):
        if scan.semantic is not None:
            sums |= objects.count_false_cells(scan.points, label, result.height, scan.semantic)
        sums |= {name: getattr(result.fit, name) for name in FIT}
        sums |= {f'sensor_{name}': getattr(result.pose, name) for name in POSE}
        stages = {name: s for name, s in result.timings.items() if name != 'total'}
        sums |= {f'{STAGE}{name}': seconds for name, seconds in stages.items()}
    return {'scans': [sums], **rows}


class Scores(NamedTuple):
    """How methods did on the same scans; one frame for what is grouped alike."""

    # sums of each scan: `COUNTS`, of `metrics.height_sums`, `OBJECT_COUNTS`, shares; seconds,
    # those of the stages, pose, fit; what a method does not have is NaN
    scans: DataFrame
    rings: DataFrame  # `COUNTS` of each ring of a scan
    objects: DataFrame  # `OBJECT_COUNTS` of each scan, by class

    @property
    def methods(self) -> list[str]:
        """Names of the methods, in order."""
        return list(self.scans['method'].unique())

    @property
    def peer(self) -> str:
        """Name of the method that the first one is compared with, if there is one."""
        return ''.join(self.methods[1:2])

    @property
    def sequences(self) -> list[str]:
        """Names of the sequences, in order."""
        return list(self.scans['sequence'].unique())

    @property
    def has_truth(self) -> bool:
        """Whether the scans are labelled."""
        return 'tp' in self.scans

    def of(self, sequences: Sequence[str]) -> Scores:
        """Return the part of some sequences."""
        return Scores(*(frame[frame['sequence'].isin(sequences)] for frame in self))


def make_scores(parts: Iterable[Rows]) -> Scores:
    """Make frames of rows, in the order of the methods."""
    parts = [*parts]
    rows = {name: [row for part in parts for row in part.get(name, ())] for name in COLUMNS}
    methods = list(dict.fromkeys(row['method'] for row in rows['scans']))
    for own in rows.values():
        own.sort(key=lambda row: methods.index(row['method']))
    return Scores(*(frame_of(own, COLUMNS[name]) for name, own in rows.items()))


def sums(frame: DataFrame, *by: str) -> DataFrame:
    """Sum up the rows of each method, or of each group in it, in the order of the rows."""
    return frame.groupby(['method', *by], sort=False).sum(numeric_only=True)
