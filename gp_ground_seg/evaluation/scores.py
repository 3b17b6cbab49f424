"""Counts of right and wrong labels, and the ratios drawn from them."""

from __future__ import annotations

import functools
import math
import operator
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from gp_ground_seg.frame import Label

if TYPE_CHECKING:
    from gp_ground_seg.evaluation.calibration import Calibration

RATIOS = ('precision', 'recall', 'f1', 'accuracy', 'iou')
"""Ratios of a `Confusion`, by name of its property."""


@dataclass(frozen=True)
class Confusion:
    """Points by true and given label; ground is the positive class.

    A ratio with nothing in its denominator is NaN.

    Attributes
    ----------
    tp, fp, fn, tn : int
        Ground labelled ground, other points labelled ground, ground not
        labelled ground, other points not labelled ground.
    """

    tp: int = 0
    fp: int = 0
    fn: int = 0
    tn: int = 0

    def __add__(self, other: Confusion) -> Confusion:
        """Add the counts of both."""
        return Confusion(
            self.tp + other.tp,
            self.fp + other.fp,
            self.fn + other.fn,
            self.tn + other.tn,
        )

    @property
    def precision(self) -> float:
        """TP / (TP + FP)."""
        return _ratio(self.tp, self.tp + self.fp)

    @property
    def recall(self) -> float:
        """TP / (TP + FN)."""
        return _ratio(self.tp, self.tp + self.fn)

    @property
    def f1(self) -> float:
        """2 TP / (2 TP + FP + FN)."""
        return _ratio(2 * self.tp, 2 * self.tp + self.errors)

    @property
    def accuracy(self) -> float:
        """(TP + TN) / (TP + FP + FN + TN)."""
        right = self.tp + self.tn
        return _ratio(right, right + self.errors)

    @property
    def iou(self) -> float:
        """TP / (TP + FP + FN)."""
        return _ratio(self.tp, self.tp + self.errors)

    @property
    def points(self) -> int:
        """TP + FP + FN + TN."""
        return self.tp + self.fp + self.fn + self.tn

    @property
    def errors(self) -> int:
        """FP + FN."""
        return self.fp + self.fn


def _ratio(part: int, whole: int) -> float:
    return part / whole if whole else math.nan


def count_confusion(label: npt.NDArray[np.uint8], truth: npt.NDArray[np.uint8]) -> Confusion:
    """Compare given with true labels.

    Parameters
    ----------
    label : (N,) uint8
        Given `Label` of each point. UNKNOWN is not ground: a point that a
        method does not decide on must not flatter it.
    truth : (N,) uint8
        True `Label` of each point; where it is UNKNOWN the point does not count.
    """
    given = label == Label.GROUND
    ground, obstacle = truth == Label.GROUND, truth == Label.OBSTACLE
    return Confusion(
        tp=int(np.count_nonzero(given & ground)),
        fp=int(np.count_nonzero(given & obstacle)),
        fn=int(np.count_nonzero(~given & ground)),
        tn=int(np.count_nonzero(~given & obstacle)),
    )


@dataclass(frozen=True)
class ClassCount:
    """Points of one semantic class.

    Attributes
    ----------
    points : int
        How many there are.
    labelled_ground : int
        How many of them were labelled ground.
    """

    points: int = 0
    labelled_ground: int = 0

    def __add__(self, other: ClassCount) -> ClassCount:
        """Add the counts of both."""
        return ClassCount(self.points + other.points, self.labelled_ground + other.labelled_ground)

    @property
    def share_ground(self) -> float:
        """Share of the points labelled ground."""
        return _ratio(self.labelled_ground, self.points)


def count_classes(
    label: npt.NDArray[np.uint8], semantic: npt.NDArray[np.integer]
) -> dict[int, ClassCount]:
    """Count the points of each semantic class that occurs, by ascending class number."""
    points = np.bincount(semantic)
    ground = np.bincount(semantic[label == Label.GROUND], minlength=len(points))
    return {
        int(number): ClassCount(int(points[number]), int(ground[number]))
        for number in np.flatnonzero(points)
    }


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
        By ring of `gp_ground_seg.evaluation.rings`, GroundGrid convention.
    calibration : Calibration or None
        Of the method's probabilities, if it has any, GroundGrid convention.
    facts : dict of str to float or str
        What else the method tells of the frame, as the sensor's height it found [m].
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
    def sequences(self) -> list[str]:
        """Names of the sequences, in the order they were run."""
        return list(dict.fromkeys(frame.sequence for frame in self.frames))

    def pooled(self, convention: str, sequence: str | None = None) -> Confusion:
        """Sum of the counts over one sequence, or over all."""
        chosen = (f for f in self.frames if sequence is None or f.sequence == sequence)
        return sum((frame.confusions[convention] for frame in chosen), Confusion())

    def classes(self) -> dict[int, ClassCount]:
        """Sum of the counts by class over all frames, by ascending class number."""
        total: dict[int, ClassCount] = {}
        for frame in self.frames:
            for number, count in frame.classes.items():
                total[number] = total.get(number, ClassCount()) + count
        return dict(sorted(total.items()))

    def rings(self) -> tuple[Confusion, ...]:
        """Sum of the counts by ring over all frames."""
        by_ring = zip(*(frame.rings for frame in self.frames), strict=True)
        return tuple(sum(ring, Confusion()) for ring in by_ring)

    def calibration(self, sequence: str | None = None) -> Calibration | None:
        """Sum over one sequence, or over all; None unless every frame has one."""
        chosen = [f.calibration for f in self.frames if sequence in (None, f.sequence)]
        found = [one for one in chosen if one is not None]
        if not found or len(found) < len(chosen):
            return None
        return functools.reduce(operator.add, found)

    @property
    def median_seconds(self) -> float:
        """Median time per frame."""
        return _median(frame.seconds for frame in self.frames)

    @property
    def mean_seconds(self) -> float:
        """Mean time per frame."""
        seconds = [frame.seconds for frame in self.frames]
        return math.fsum(seconds) / len(seconds) if seconds else math.nan

    def median_stage_seconds(self) -> dict[str, float]:
        """Median time of each stage."""
        stages = dict.fromkeys(stage for frame in self.frames for stage in frame.stages)
        return {
            stage: _median(f.stages[stage] for f in self.frames if stage in f.stages)
            for stage in stages
        }


def _median(values: Iterable[float]) -> float:
    found = list(values)
    return float(np.median(found)) if found else math.nan
