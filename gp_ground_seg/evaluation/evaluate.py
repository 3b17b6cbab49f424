"""Methods over labelled frames: scores by frame, and the tables made of them."""

from __future__ import annotations

import functools
import heapq
import math
import operator
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import numpy.typing as npt

from gp_ground_seg.data.semantic_kitti import (
    Frame,
    list_frames,
    list_sequences,
    read_labels,
    read_points,
)
from gp_ground_seg.errors import DataError
from gp_ground_seg.evaluation.calibration import Calibration, count_calibration
from gp_ground_seg.evaluation.methods import TITLES, Method, Progress, run_methods
from gp_ground_seg.evaluation.metrics import (
    CONVENTIONS,
    GROUNDGRID,
    ClassCount,
    Confusion,
    count_classes,
    count_confusion,
    count_rings,
)

Labels = npt.NDArray[np.uint8]


@dataclass(frozen=True)
class LabelledScan:
    """A labelled frame in memory: (N, 4) float32 points [m] and (N,) semantic classes."""

    frame: Frame
    points: npt.NDArray[np.float32]
    semantic: npt.NDArray[np.uint16]

    @property
    def sequence(self) -> str:
        """Sequence of the frame."""
        return self.frame.sequence

    @property
    def index(self) -> str:
        """Index of the frame."""
        return self.frame.index


@dataclass(frozen=True)
class FrameScore:
    """How one method did on one frame.

    Attributes
    ----------
    sequence, index : str
        Which frame.
    seconds : float
        Time of the segmentation alone, without reading.
    stages : dict of str to float
        Seconds by stage, empty if the method does not tell.
    confusions : dict of str to Confusion
        By key of the convention.
    classes : dict of int to ClassCount
        By number of the semantic class.
    rings : tuple of Confusion
        By `RING_TITLES`, GroundGrid convention.
    calibration : Calibration or None
        Of the method's probabilities, if it has any, GroundGrid convention.
    facts : dict of str to float or str
        What else is known of the frame, as the sensor height found [m].
    """

    sequence: str
    index: str
    seconds: float
    stages: dict[str, float] = field(default_factory=dict)
    confusions: dict[str, Confusion] = field(default_factory=dict)
    classes: dict[int, ClassCount] = field(default_factory=dict)
    rings: tuple[Confusion, ...] = ()
    calibration: Calibration | None = None
    facts: dict[str, float | str] = field(default_factory=dict)


@dataclass(frozen=True)
class MethodScore:
    """How one method did on all frames, in the order they were run."""

    name: str
    frames: tuple[FrameScore, ...]

    @property
    def title(self) -> str:
        """Name in tables."""
        return TITLES.get(self.name, self.name)

    @property
    def sequences(self) -> list[str]:
        """Names of the sequences, in the order they were run."""
        return list(dict.fromkeys(frame.sequence for frame in self.frames))

    def of(self, sequence: str | None) -> list[FrameScore]:
        """Frames of one sequence, or all."""
        return [frame for frame in self.frames if sequence in (None, frame.sequence)]

    def pooled(self, convention: str, sequence: str | None = None) -> Confusion:
        """Sum of the counts over one sequence, or over all."""
        return sum((frame.confusions[convention] for frame in self.of(sequence)), Confusion())

    def classes(self) -> dict[int, ClassCount]:
        """Sum of the counts by class over all frames, by ascending class number."""
        total: dict[int, ClassCount] = {}
        for frame in self.frames:
            for number, count in frame.classes.items():
                before = total.get(number, ClassCount(0, 0))
                total[number] = ClassCount(*map(operator.add, before, count))
        return dict(sorted(total.items()))

    def rings(self) -> tuple[Confusion, ...]:
        """Sum of the counts by ring over all frames."""
        by_ring = zip(*(frame.rings for frame in self.frames), strict=True)
        return tuple(sum(ring, Confusion()) for ring in by_ring)

    def calibration(self, sequence: str | None = None) -> Calibration | None:
        """Sum over one sequence, or over all; None unless every frame has one."""
        chosen = [frame.calibration for frame in self.of(sequence)]
        found = [one for one in chosen if one is not None]
        if not found or len(found) < len(chosen):
            return None
        return functools.reduce(operator.add, found)

    def seconds(self, average: Callable[[list[float]], float] = statistics.median) -> float:
        """Average time per frame; NaN without frames."""
        return average([frame.seconds for frame in self.frames]) if self.frames else math.nan

    def median_stages(self) -> dict[str, float]:
        """Median seconds of each stage."""
        names = dict.fromkeys(stage for frame in self.frames for stage in frame.stages)
        return {
            name: statistics.median(f.stages[name] for f in self.frames if name in f.stages)
            for name in names
        }


Observer = Callable[[str, LabelledScan, FrameScore, Labels], None]
"""Called as a frame is scored with the name of the method, the frame, its score, its labels."""


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


def load_labelled(frame: Frame) -> LabelledScan:
    """Read points and classes of a labelled frame.

    Raises
    ------
    DataError
        If it has no labels, or a file cannot be read or does not fit.
    """
    if frame.labels_path is None:
        raise DataError(f'{frame.points_path}: has no labels')
    points = read_points(frame.points_path)
    return LabelledScan(frame, points, read_labels(frame.labels_path, len(points)))


def evaluate(
    frames: Sequence[Frame],
    methods: Sequence[Method],
    clock: Callable[[], float] = time.perf_counter,
    progress: Progress[Frame] = iter,
    observe: Observer | None = None,
) -> list[MethodScore]:
    """Score methods on the same labelled frames; parameters and errors as `run_methods`.

    `observe` is called as soon as a frame is scored: scores alone are kept.
    """

    def score(scan: LabelledScan, method: Method, seconds: float) -> FrameScore:
        found, label = score_frame(scan, method, seconds)
        if observe is not None:
            observe(method.name, scan, found, label)
        return found

    scores = run_methods(frames, load_labelled, methods, score, clock=clock, progress=progress)
    return [MethodScore(name, tuple(found)) for name, found in scores.items()]


def score_frame(scan: LabelledScan, method: Method, seconds: float) -> tuple[FrameScore, Labels]:
    """Score what `method` has made of `scan`, and return it with the labels."""
    result = method.result()
    label, p_ground = result.label, result.p_ground
    truth = {one.key: one.truth(scan.semantic, scan.points[:, 2]) for one in CONVENTIONS}
    facts: dict[str, float | str] = {}
    if result.fit is not None and result.pose is not None:
        facts = {
            'status': result.fit.status,
            'n_segments': result.fit.n_segments,
            'sensor_height': result.pose.height,
            'sensor_height_estimated': 'yes' if result.pose.height_estimated else 'no',
            'sensor_roll': result.pose.roll,
            'sensor_pitch': result.pose.pitch,
        }
    groundgrid = truth[GROUNDGRID.key]
    score = FrameScore(
        sequence=scan.sequence,
        index=scan.index,
        seconds=seconds,
        stages=result.stages,
        confusions={key: count_confusion(label, one) for key, one in truth.items()},
        classes=count_classes(label, scan.semantic),
        rings=count_rings(label, groundgrid, scan.points),
        calibration=None if p_ground is None else count_calibration(p_ground, groundgrid),
        facts=facts,
    )
    return score, label


@dataclass(frozen=True)
class KeptFrame:
    """A frame, its score and the labels it got, (N,) uint8."""

    scan: LabelledScan
    score: FrameScore
    label: Labels


class WorstFrames:
    """Keeps the `n` frames on which `method` has the lowest IoU (GroundGrid convention)."""

    def __init__(self, method: str, n: int) -> None:
        self._method = method
        self._n = n
        self._n_seen = 0
        self._heap: list[tuple[float, int, KeptFrame]] = []

    def observe(self, method: str, scan: LabelledScan, score: FrameScore, label: Labels) -> None:
        """Take a frame just scored; one without a defined IoU is passed over."""
        iou = score.confusions[GROUNDGRID.key].iou
        if method != self._method or math.isnan(iou):
            return
        self._n_seen += 1
        heapq.heappush(self._heap, (-iou, -self._n_seen, KeptFrame(scan, score, label)))
        if len(self._heap) > self._n:
            heapq.heappop(self._heap)

    def found(self) -> list[KeptFrame]:
        """Return the frames, the worst first."""
        return [kept for *_, kept in sorted(self._heap, key=lambda entry: entry[:2], reverse=True)]
