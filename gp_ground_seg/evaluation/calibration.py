"""Reliability of the probabilities of ground."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from gp_ground_seg.errors import PointCloudError
from gp_ground_seg.evaluation.metrics import Confusion
from gp_ground_seg.frame import Label

N_BINS = 15
"""Bins of equal width in the expected calibration error."""
N_STEPS = 1000
"""Thresholds tried are the multiples of 1 / N_STEPS from 0 to 1."""

BIN_EDGES = np.linspace(0.0, 1.0, N_BINS + 1)
THRESHOLDS = np.arange(N_STEPS + 1) / N_STEPS

IntArray = npt.NDArray[np.int64]
FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Calibration:
    """Probabilities of ground against the truth, as sums: those of frames add up.

    A ratio over no points is NaN.

    Attributes
    ----------
    n_points, n_ground : (N_BINS,) int64
        Points, and those of them that are ground, by bin of their probability; a bin
        holds its lower edge, the last one 1 as well.
    sum_p : (N_BINS,) float64
        Sum of their probabilities.
    sum_squared_error : float
        Sum of (probability - truth)^2, truth 1 for ground and 0 for obstacles.
    ground_by_step, obstacles_by_step : (N_STEPS + 1,) int64
        Points by the highest of `THRESHOLDS` that their probability reaches.
    ground_without, obstacles_without : int
        Points without a probability: in no bin, and never labelled ground.
    """

    n_points: IntArray
    n_ground: IntArray
    sum_p: FloatArray
    sum_squared_error: float
    ground_by_step: IntArray
    obstacles_by_step: IntArray
    ground_without: int
    obstacles_without: int

    def __add__(self, other: Calibration) -> Calibration:
        """Add the sums of both."""
        names = [field.name for field in dataclasses.fields(self)]
        return Calibration(*(getattr(self, name) + getattr(other, name) for name in names))

    @property
    def n_total(self) -> int:
        """Points with a probability."""
        return int(self.n_points.sum())

    @property
    def mean_p(self) -> FloatArray:
        """Mean probability in each bin, (N_BINS,); NaN where it is empty."""
        return _ratio(self.sum_p, self.n_points)

    @property
    def share_ground(self) -> FloatArray:
        """Share of ground in each bin, (N_BINS,); NaN where it is empty."""
        return _ratio(self.n_ground, self.n_points)

    @property
    def ece(self) -> float:
        """Expected calibration error: mean over points of their bin's |share of ground - mean p|.

        Guo et al., "On Calibration of Modern Neural Networks", ICML 2017, for the
        probability of one class of two.
        """
        if not self.n_total:
            return math.nan
        return float(np.abs(self.n_ground - self.sum_p).sum() / self.n_total)

    @property
    def brier(self) -> float:
        """Brier score, the mean of (p - truth)^2."""
        return self.sum_squared_error / self.n_total if self.n_total else math.nan

    def confusion_at(self, step: int) -> Confusion:
        """Return the counts if ground were what reaches the threshold ``THRESHOLDS[step]``."""
        tp = int(self.ground_by_step[step:].sum())
        fp = int(self.obstacles_by_step[step:].sum())
        n_ground = int(self.ground_by_step.sum()) + self.ground_without
        n_obstacles = int(self.obstacles_by_step.sum()) + self.obstacles_without
        return Confusion(tp=tp, fp=fp, fn=n_ground - tp, tn=n_obstacles - fp)

    @property
    def best_step(self) -> int:
        """Step whose threshold has the highest IoU; the lowest of several."""
        tp = self.ground_by_step[::-1].cumsum()[::-1]
        fp = self.obstacles_by_step[::-1].cumsum()[::-1]
        n_ground = self.ground_by_step.sum() + self.ground_without
        return int(np.argmax(tp / np.maximum(n_ground + fp, 1)))


def _ratio(part: IntArray | FloatArray, whole: IntArray) -> FloatArray:
    ratio = np.full(len(whole), np.nan)
    np.divide(part, whole, out=ratio, where=whole > 0)
    return ratio


def count_calibration(
    p_ground: npt.NDArray[np.floating], truth: npt.NDArray[np.uint8]
) -> Calibration:
    """Compare probabilities with the truth.

    Parameters
    ----------
    p_ground : (N,) float
        Probability that each point is ground; NaN = not known.
    truth : (N,) uint8
        True `Label` of each point; where it is UNKNOWN the point does not count.

    Raises
    ------
    PointCloudError
        If the lengths differ or a probability is outside [0, 1].
    """
    if p_ground.shape != truth.shape:
        raise PointCloudError(
            f'p_ground of shape {p_ground.shape} for {len(truth)} points: must be ({len(truth)},)'
        )
    scored = (truth == Label.GROUND) | (truth == Label.OBSTACLE)
    ground = truth[scored] == Label.GROUND
    p = p_ground[scored].astype(np.float64)
    known = np.isfinite(p)
    without = ground[~known]
    ground, p = ground[known], p[known]
    if np.isinf(p_ground).any() or (len(p) and not (p.min() >= 0.0 and p.max() <= 1.0)):
        raise PointCloudError('p_ground: a probability is outside [0, 1]')
    bin_of = np.searchsorted(BIN_EDGES[1:-1], p, side='right')
    step = np.searchsorted(THRESHOLDS, p, side='right') - 1
    return Calibration(
        n_points=np.bincount(bin_of, minlength=N_BINS),
        n_ground=np.bincount(bin_of[ground], minlength=N_BINS),
        sum_p=np.bincount(bin_of, p, minlength=N_BINS).astype(np.float64),
        sum_squared_error=float(np.sum((p - ground) ** 2)),
        ground_by_step=np.bincount(step[ground], minlength=N_STEPS + 1),
        obstacles_by_step=np.bincount(step[~ground], minlength=N_STEPS + 1),
        ground_without=int(without.sum()),
        obstacles_without=int(len(without) - without.sum()),
    )
