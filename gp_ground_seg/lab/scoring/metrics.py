"""Conventions of ground; labels, probabilities and heights scored against the truth."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from gp_ground_seg.core.errors import PointCloudError
from gp_ground_seg.core.frame import FloatArray, Label

if TYPE_CHECKING:
    from typing_extensions import Self

Labels = npt.NDArray[np.uint8]

RATIOS = ('precision', 'recall', 'f1', 'accuracy', 'iou')
"""Ratios of a `Confusion`, by name of its property."""


def range_titles(edges: Sequence[float]) -> tuple[str, ...]:
    """Names of the bands of range between edges [m], the last of which may be infinite."""
    return tuple(
        f'> {low:g} m' if math.isinf(high) else f'{low:g}-{high:g} m'
        for low, high in itertools.pairwise(edges)
    )


RING_EDGES = (0.0, 10.0, 20.0, 30.0, 40.0, 50.0, math.inf)
"""Edges of the rings of horizontal range [m]; each holds its inner edge, not its outer one."""
RING_TITLES = range_titles(RING_EDGES)

BIN_EDGES = np.linspace(0.0, 1.0, 16)
"""Edges of the bins of probability in the expected calibration error."""
N_BINS = len(BIN_EDGES) - 1

SENSOR_HEIGHT = 1.73
"""Height of the sensor [m] in SemanticKITTI. The truth is a property of the data:
it must not move with ``sensor.height``, which is a parameter of the method."""
LOW_VEGETATION_Z = -0.75 * SENSOR_HEIGHT
"""Height [m, sensor frame] below which Patchwork's evaluation counts vegetation as ground."""

UNLABELLED, OUTLIER, VEGETATION = 0, 1, 70
GROUND_CLASSES = (40, 44, 48, 49, 60, 72)


@dataclass(frozen=True)
class Convention:
    """A way to read semantic classes as ground and not ground."""

    key: str  # in files
    title: str  # in tables
    rule: str
    left_out: tuple[int, ...]  # classes whose points do not count
    low_vegetation_z: float = -math.inf  # below it vegetation is ground [m, sensor frame]

    def truth(self, semantic: npt.NDArray[np.integer], z: npt.NDArray[np.floating]) -> Labels:
        """Return the true `Label` (N,) by class and height (N,); UNKNOWN does not count."""
        ground = np.isin(semantic, GROUND_CLASSES)
        ground |= (semantic == VEGETATION) & (z < self.low_vegetation_z)
        truth = np.where(ground, Label.GROUND, Label.OBSTACLE).astype(np.uint8)
        truth[np.isin(semantic, self.left_out)] = Label.UNKNOWN
        return truth


GROUNDGRID = Convention(
    'groundgrid', 'GroundGrid', 'vegetation left out', (UNLABELLED, OUTLIER, VEGETATION)
)
"""Steinke et al., "GroundGrid: LiDAR Point Cloud Ground Segmentation and Terrain Estimation",
RA-L 2024. Our headline."""

PATCHWORK = Convention(
    'patchwork',
    'Patchwork',
    f'vegetation below {LOW_VEGETATION_Z:.2f} m is ground, above it an obstacle',
    (UNLABELLED, OUTLIER),
    LOW_VEGETATION_Z,
)
"""Lim et al., "Patchwork: Concentric Zone-Based Region-Wise Ground Segmentation With Ground
Likelihood Estimation Using a 3D LiDAR Sensor", RA-L 2021. The threshold, -3/4 of the sensor's
height, is that of its published evaluation code."""

CONVENTIONS = (GROUNDGRID, PATCHWORK)


@dataclass(frozen=True)
class Sums:
    """A dataclass of counts and sums, which add up."""

    def __add__(self, other: Self) -> Self:
        """Add the sums of both."""
        names = [entry.name for entry in dataclasses.fields(self)]
        sums = {name: getattr(self, name) + getattr(other, name) for name in names}
        return dataclasses.replace(self, **sums)


@dataclass(frozen=True)
class Confusion(Sums):
    """Points by true and given label, ground being positive; ratios over nothing are NaN."""

    tp: int = 0
    fp: int = 0
    fn: int = 0
    tn: int = 0

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
        return ratio(*self.iou_sums)

    @property
    def iou_sums(self) -> tuple[int, int]:
        """TP, and TP + FP + FN."""
        return self.tp, self.tp + self.errors

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
    """Compare by horizontal range of `points` (N, >=2) [m], one `Confusion` for each ring.

    A point without a finite range is in no ring.
    """
    ring, n_rings = ring_of(points), len(RING_TITLES)
    scored = (ring < n_rings) & ((truth == Label.GROUND) | (truth == Label.OBSTACLE))
    given, ground = label == Label.GROUND, truth == Label.GROUND
    code = 4 * ring + 2 * given + ground
    counts = np.bincount(code[scored], minlength=4 * n_rings).reshape(n_rings, 4)
    return tuple(Confusion(int(tp), int(fp), int(fn), int(tn)) for tn, fn, fp, tp in counts)


def ring_of(points: npt.NDArray[np.floating]) -> npt.NDArray[np.intp]:
    """Index of the ring that each of the points (N, >=2) is in, (N,).

    A point without a finite range has the index after the last one.
    """
    x, y = points[:, :2].astype(np.float64).T
    reach = np.hypot(x, y)
    ring: npt.NDArray[np.intp] = np.digitize(reach, RING_EDGES[1:-1])
    return np.where(np.isfinite(reach), ring, len(RING_TITLES))


def check_lengths(n_points: int, **values: Any) -> None:
    """Raise `PointCloudError` for an array without one value per point; None is left out."""
    for name, array in values.items():
        if array is not None and array.shape != (n_points,):
            raise PointCloudError(
                f'{name} of shape {array.shape} for {n_points} points: must be ({n_points},)'
            )


@dataclass(frozen=True)
class Calibration(Sums):
    """Probabilities of ground against the truth, as sums; ratios over nothing are NaN.

    Sums by bin of probability, (N_BINS,); a bin holds its lower edge, the last one 1 as well.
    """

    n_points: npt.NDArray[np.int64] = field(
        default_factory=lambda: np.zeros(N_BINS, dtype=np.int64)
    )
    n_ground: npt.NDArray[np.int64] = field(
        default_factory=lambda: np.zeros(N_BINS, dtype=np.int64)
    )
    sum_p: FloatArray = field(default_factory=lambda: np.zeros(N_BINS))

    @property
    def n_total(self) -> int:
        """Points with a probability."""
        return int(self.n_points.sum())

    def by_bin(self, sums: npt.NDArray[Any]) -> FloatArray:
        """Return `n_ground` or `sum_p` over the points of each bin, (N_BINS,)."""
        return np.where(self.n_points > 0, sums, np.nan) / np.maximum(self.n_points, 1)

    @property
    def ece(self) -> float:
        """Expected calibration error: mean over points of their bin's |share of ground - mean p|.

        Guo et al., "On Calibration of Modern Neural Networks", ICML 2017, for the
        probability of one class of two.
        """
        return ratio(float(np.abs(self.n_ground - self.sum_p).sum()), self.n_total)


def count_calibration(p_ground: npt.NDArray[np.floating], truth: Labels) -> Calibration:
    """Compare probabilities of ground, (N,), with true labels, (N,).

    Points whose probability is NaN or whose truth is UNKNOWN do not count.
    """
    check_lengths(len(truth), p_ground=p_ground)
    known = ~np.isnan(p_ground)
    if not ((p_ground[known] >= 0.0) & (p_ground[known] <= 1.0)).all():
        raise PointCloudError('p_ground: a probability is outside [0, 1]')
    known &= (truth == Label.GROUND) | (truth == Label.OBSTACLE)
    ground, p = truth[known] == Label.GROUND, p_ground[known].astype(np.float64)
    bin_of = np.searchsorted(BIN_EDGES[1:-1], p, side='right')
    return Calibration(
        n_points=np.bincount(bin_of, minlength=N_BINS),
        n_ground=np.bincount(bin_of[ground], minlength=N_BINS),
        sum_p=np.bincount(bin_of, p, minlength=N_BINS).astype(np.float64),
    )


FINEST_STD = 1e-3
"""Least standard deviation in the predictive density [m]: no sensor resolves a millimetre, and the
density of a handful of returns that happen to agree would outweigh all others."""
TRIMMED = 1e-3
"""Share of the points of a frame that the mean negative log density leaves out, those with the
lowest density: five returns that lie metres below the ground would decide it."""


@dataclass(frozen=True)
class HeightError(Sums):
    """Errors of the surface under points whose ground height is known; over no points NaN.

    Points without a surface do not count. The error is estimate minus truth.
    """

    n_points: int = 0
    n_without_model: int = 0
    sum_error: float = 0.0  # [m]
    sum_squared_error: float = 0.0  # [m^2]
    sum_squared_deviation: float = 0.0  # of the truth from its mean in the frame [m^2]
    n_with_std: int = 0  # points whose standard deviation is known
    n_within_1: int = 0  # of these the ones with an error of at most one standard deviation
    n_within_2: int = 0
    # Negative logs of the predictive density per metre, but for the worst `TRIMMED` of a frame
    sum_nlpd: float = 0.0
    n_nlpd: int = 0
    medians: tuple[float, ...] = ()  # median absolute error of each frame [m]

    @property
    def median_absolute(self) -> float:
        """Median over the frames of the median absolute error [m]."""
        return float(np.median(self.medians)) if self.medians else math.nan

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

    @property
    def within_1(self) -> float:
        """Share within one standard deviation; 0.683 of a normal distribution."""
        return ratio(self.n_within_1, self.n_with_std)

    @property
    def within_2(self) -> float:
        """Share within two standard deviations; 0.954 of a normal distribution."""
        return ratio(self.n_within_2, self.n_with_std)

    @property
    def nlpd(self) -> float:
        """Mean negative log predictive density (Rasmussen and Williams, 2006, section 2.5).

        The worst `TRIMMED` of each frame is left out.
        """
        return ratio(self.sum_nlpd, self.n_nlpd)


def height_error(
    truth: npt.NDArray[np.floating],
    estimate: npt.NDArray[np.floating],
    std: npt.NDArray[np.floating] | None = None,
    max_nlpd: float | None = None,
) -> HeightError:
    """Compare true with estimated heights of the ground, (n,) [m]; NaN where there is no model.

    `std` are the standard deviations of the differences, (n,) [m], if there are any. `max_nlpd` is
    that of the frame, if these points are a part of it.
    """
    known = np.isfinite(estimate)
    y = truth[known].astype(np.float64)
    error = estimate[known] - y
    spread = np.full(len(y), np.nan) if std is None else std[known]
    nlpd = negative_log_density(error, spread)
    counts = nlpd <= (largest_nlpd(nlpd) if max_nlpd is None else max_nlpd)
    return HeightError(
        n_points=len(y),
        n_without_model=len(truth) - len(y),
        sum_error=float(error.sum()),
        # Of a product of vectors the last digits depend on the number of threads.
        sum_squared_error=float(np.square(error).sum()),
        sum_squared_deviation=float(np.sum((y - y.mean()) ** 2)) if len(y) else 0.0,
        n_with_std=int(np.isfinite(spread).sum()),
        n_within_1=int((np.abs(error) <= spread).sum()),
        n_within_2=int((np.abs(error) <= 2.0 * spread).sum()),
        sum_nlpd=float(nlpd[counts].sum()),
        n_nlpd=int(counts.sum()),
        medians=(float(np.median(np.abs(error))),) if len(y) else (),
    )


def negative_log_density(error: FloatArray, std: FloatArray) -> FloatArray:
    """Negative log of the normal density of errors, (n,) [m]; NaN where `std` is."""
    fine = np.maximum(std, FINEST_STD)
    result: FloatArray = 0.5 * np.log(2.0 * np.pi * fine**2) + 0.5 * (error / fine) ** 2
    return result


def largest_nlpd(nlpd: FloatArray) -> float:
    """Return the largest one that is not among the worst `TRIMMED` of a frame, (n,)."""
    known = np.sort(nlpd[~np.isnan(nlpd)])
    return float(known[-1 - int(TRIMMED * len(known))]) if len(known) else math.inf
