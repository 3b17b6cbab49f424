"""What counts as ground, and how labels and heights are scored against the truth."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from gp_ground_seg.frame import Label

Labels = npt.NDArray[np.uint8]

RATIOS = ('precision', 'recall', 'f1', 'accuracy', 'iou')
"""Ratios of a `Confusion`, by name of its property."""

RING_EDGES = (0.0, 10.0, 20.0, 30.0, 40.0, 50.0, math.inf)
"""Edges of the rings of horizontal range [m]; each holds its inner edge, not its outer one."""
RING_TITLES = tuple(
    f'> {low:g} m' if math.isinf(high) else f'{low:g}-{high:g} m'
    for low, high in itertools.pairwise(RING_EDGES)
)

SENSOR_HEIGHT = 1.73
"""Height of the sensor [m] in SemanticKITTI. The truth is a property of the data:
it must not move with ``sensor.height``, which is a parameter of the method."""
LOW_VEGETATION_Z = -0.75 * SENSOR_HEIGHT
"""Height [m, sensor frame] below which Patchwork's evaluation counts vegetation as ground."""


class SemanticClass(IntEnum):
    """Class of a point in SemanticKITTI (Behley et al., ICCV 2019), low 16 bits of a label."""

    UNLABELLED = 0
    OUTLIER = 1
    CAR = 10
    BICYCLE = 11
    BUS = 13
    MOTORCYCLE = 15
    ON_RAILS = 16
    TRUCK = 18
    OTHER_VEHICLE = 20
    PERSON = 30
    BICYCLIST = 31
    MOTORCYCLIST = 32
    ROAD = 40
    PARKING = 44
    SIDEWALK = 48
    OTHER_GROUND = 49
    BUILDING = 50
    FENCE = 51
    OTHER_STRUCTURE = 52
    LANE_MARKING = 60
    VEGETATION = 70
    TRUNK = 71
    TERRAIN = 72
    POLE = 80
    TRAFFIC_SIGN = 81
    OTHER_OBJECT = 99
    MOVING_CAR = 252
    MOVING_BICYCLIST = 253
    MOVING_PERSON = 254
    MOVING_MOTORCYCLIST = 255
    MOVING_ON_RAILS = 256
    MOVING_BUS = 257
    MOVING_TRUCK = 258
    MOVING_OTHER_VEHICLE = 259


GROUND_CLASSES = (
    SemanticClass.ROAD,
    SemanticClass.PARKING,
    SemanticClass.SIDEWALK,
    SemanticClass.OTHER_GROUND,
    SemanticClass.LANE_MARKING,
    SemanticClass.TERRAIN,
)


def class_name(number: int) -> str:
    """Name of a class in words; ``class 77`` where SemanticKITTI has no such number."""
    try:
        return SemanticClass(number).name.lower().replace('_', ' ')
    except ValueError:
        return f'class {number}'


@dataclass(frozen=True)
class Convention:
    """A way to read semantic classes as ground and not ground.

    Attributes
    ----------
    key, title, rule : str
        Name in files, name in tables, and what it does, in a few words.
    left_out : tuple of int
        Classes whose points do not count.
    low_vegetation_z : float
        Vegetation below this height [m, sensor frame] is ground.
    """

    key: str
    title: str
    rule: str
    left_out: tuple[int, ...]
    low_vegetation_z: float = -math.inf

    def truth(self, semantic: npt.NDArray[np.integer], z: npt.NDArray[np.floating]) -> Labels:
        """Return the true `Label` of each point, UNKNOWN where it does not count, (N,) uint8.

        `semantic` (N,) are classes, `z` (N,) heights in the sensor frame [m].
        """
        ground = np.isin(semantic, GROUND_CLASSES)
        ground |= (semantic == SemanticClass.VEGETATION) & (z < self.low_vegetation_z)
        truth = np.where(ground, Label.GROUND, Label.OBSTACLE).astype(np.uint8)
        truth[np.isin(semantic, self.left_out)] = Label.UNKNOWN
        return truth


GROUNDGRID = Convention(
    'groundgrid',
    'GroundGrid',
    'vegetation left out',
    (SemanticClass.UNLABELLED, SemanticClass.OUTLIER, SemanticClass.VEGETATION),
)
"""Steinke et al., "GroundGrid: LiDAR Point Cloud Ground Segmentation and Terrain Estimation",
RA-L 2024. Our headline."""

PATCHWORK = Convention(
    'patchwork',
    'Patchwork',
    f'vegetation below {LOW_VEGETATION_Z:.2f} m is ground, above it an obstacle',
    (SemanticClass.UNLABELLED, SemanticClass.OUTLIER),
    LOW_VEGETATION_Z,
)
"""Lim et al., "Patchwork: Concentric Zone-Based Region-Wise Ground Segmentation With Ground
Likelihood Estimation Using a 3D LiDAR Sensor", RA-L 2021. The threshold, -3/4 of the sensor's
height, is that of its published evaluation code."""

CONVENTIONS = (GROUNDGRID, PATCHWORK)


@dataclass(frozen=True)
class Confusion:
    """Points by true and given label, ground being positive; ratios over nothing are NaN."""

    tp: int = 0
    fp: int = 0
    fn: int = 0
    tn: int = 0

    def __add__(self, other: Confusion) -> Confusion:
        """Add the counts of both."""
        return Confusion(
            self.tp + other.tp, self.fp + other.fp, self.fn + other.fn, self.tn + other.tn
        )

    @property
    def precision(self) -> float:
        """TP / (TP + FP)."""
        return ratio(self.tp, self.tp + self.fp)

    @property
    def recall(self) -> float:
        """TP / (TP + FN)."""
        return ratio(self.tp, self.tp + self.fn)

    @property
    def f1(self) -> float:
        """2 TP / (2 TP + FP + FN)."""
        return ratio(2 * self.tp, 2 * self.tp + self.errors)

    @property
    def accuracy(self) -> float:
        """(TP + TN) / (TP + FP + FN + TN)."""
        return ratio(self.tp + self.tn, self.points)

    @property
    def iou(self) -> float:
        """TP / (TP + FP + FN)."""
        return ratio(self.tp, self.tp + self.errors)

    @property
    def points(self) -> int:
        """TP + FP + FN + TN."""
        return self.tp + self.tn + self.errors

    @property
    def errors(self) -> int:
        """FP + FN."""
        return self.fp + self.fn


def ratio(part: float, whole: float) -> float:
    """Return `part` / `whole`, NaN where `whole` is zero."""
    return part / whole if whole else math.nan


def count_confusion(label: Labels, truth: Labels) -> Confusion:
    """Compare given with true labels, (N,) each.

    A given UNKNOWN counts as not ground; where the truth is UNKNOWN the point does not count.
    """
    return count_rings(label, truth, np.zeros((len(label), 2)))[0]


def count_rings(
    label: Labels, truth: Labels, points: npt.NDArray[np.floating]
) -> tuple[Confusion, ...]:
    """Compare as `count_confusion` by horizontal range, one `Confusion` for each ring.

    `points` (N, >=2) are x, y, ... in the sensor frame [m]; one without a finite range is in
    no ring.
    """
    x, y = points[:, :2].astype(np.float64).T
    reach = np.hypot(x, y)
    n_rings = len(RING_TITLES)
    scored = np.isfinite(reach) & ((truth == Label.GROUND) | (truth == Label.OBSTACLE))
    given, ground = label == Label.GROUND, truth == Label.GROUND
    code = 4 * np.digitize(reach, RING_EDGES[1:-1]) + 2 * given + ground
    counts = np.bincount(code[scored], minlength=4 * n_rings).reshape(n_rings, 4)
    return tuple(Confusion(int(tp), int(fp), int(fn), int(tn)) for tn, fn, fp, tp in counts)


class ClassCount(NamedTuple):
    """Points of one semantic class, and how many of them were labelled ground."""

    n_points: int
    n_ground: int


def count_classes(label: Labels, semantic: npt.NDArray[np.integer]) -> dict[int, ClassCount]:
    """Count the points of each semantic class that occurs, by ascending class number."""
    points = np.bincount(semantic)
    ground = np.bincount(semantic[label == Label.GROUND], minlength=len(points))
    return {
        int(number): ClassCount(int(points[number]), int(ground[number]))
        for number in np.flatnonzero(points)
    }


class ClassErrors(NamedTuple):
    """Points of one class: what they count as, and the ground missed and invented on them."""

    number: int
    truth: Label
    n_points: int
    n_ground: int
    missed: int
    false: int

    @property
    def errors(self) -> int:
        """Both kinds."""
        return self.missed + self.false


def class_errors(classes: Mapping[int, ClassCount]) -> list[ClassErrors]:
    """Errors by class in the GroundGrid convention, the largest first."""
    found = []
    for number, (n_points, n_ground) in classes.items():
        truth = Label(int(GROUNDGRID.truth(np.array([number]), np.zeros(1))[0]))
        missed = n_points - n_ground if truth is Label.GROUND else 0
        false = n_ground if truth is Label.OBSTACLE else 0
        found.append(ClassErrors(number, truth, n_points, n_ground, missed, false))
    return sorted(found, key=lambda one: (-one.errors, -one.n_points, one.number))


@dataclass(frozen=True)
class HeightError:
    """Errors of the surface under points whose ground height is known; over no points NaN.

    Attributes
    ----------
    n_points, n_without_model : int
        Points with a surface, which count, and points without one, which do not.
    sum_error, sum_squared_error : float
        Sum of estimate minus truth [m], and of its squares [m^2].
    sum_squared_deviation : float
        Of the true heights from their mean [m^2]; pooled, from the mean of each frame.
    median_absolute : float
        Median distance of the estimate from the truth [m]; pooled, the median over the frames.
    """

    n_points: int
    n_without_model: int
    sum_error: float
    sum_squared_error: float
    sum_squared_deviation: float
    median_absolute: float

    @property
    def rmse(self) -> float:
        """Root mean squared error [m]."""
        return math.sqrt(ratio(self.sum_squared_error, self.n_points))

    @property
    def bias(self) -> float:
        """Mean error [m]; negative where the surface is too low."""
        return ratio(self.sum_error, self.n_points)

    @property
    def smse(self) -> float:
        """Standardised mean squared error, mean((y - mu)^2) / var(y) (paper, section IV)."""
        return ratio(self.sum_squared_error, self.sum_squared_deviation)


def height_error(
    truth: npt.NDArray[np.floating], estimate: npt.NDArray[np.floating]
) -> HeightError:
    """Compare true with estimated heights of the ground, (n,) [m]; NaN where there is no model."""
    known = np.isfinite(estimate)
    y = truth[known].astype(np.float64)
    error = estimate[known] - y
    return HeightError(
        n_points=len(y),
        n_without_model=len(truth) - len(y),
        sum_error=float(error.sum()),
        sum_squared_error=float(error @ error),
        sum_squared_deviation=float(np.sum((y - y.mean()) ** 2)) if len(y) else 0.0,
        median_absolute=float(np.median(np.abs(error))) if len(y) else math.nan,
    )


def pool_height_errors(errors: Sequence[HeightError]) -> HeightError:
    """Sum up the errors of several frames."""
    medians = [one.median_absolute for one in errors if one.n_points]
    return HeightError(
        n_points=sum(one.n_points for one in errors),
        n_without_model=sum(one.n_without_model for one in errors),
        sum_error=math.fsum(one.sum_error for one in errors),
        sum_squared_error=math.fsum(one.sum_squared_error for one in errors),
        sum_squared_deviation=math.fsum(one.sum_squared_deviation for one in errors),
        median_absolute=float(np.median(medians)) if medians else math.nan,
    )
