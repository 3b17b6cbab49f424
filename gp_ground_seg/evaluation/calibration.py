"""Reliability of the probabilities of ground."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from gp_ground_seg.errors import PointCloudError
from gp_ground_seg.evaluation.metrics import Confusion, Labels, ratio
from gp_ground_seg.frame import FloatArray, Label

BIN_EDGES = np.linspace(0.0, 1.0, 16)
"""Edges of the bins of probability in the expected calibration error."""
N_BINS = len(BIN_EDGES) - 1
N_STEPS = 1000
THRESHOLDS = np.arange(N_STEPS + 1) / N_STEPS
"""Probabilities that are tried as the least one of ground."""

Counts = npt.NDArray[np.int64]


@dataclass(frozen=True)
class Calibration:
    """Probabilities of ground against the truth, as sums; ratios over nothing are NaN.

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

    n_points: Counts
    n_ground: Counts
    sum_p: FloatArray
    sum_squared_error: float
    ground_by_step: Counts
    obstacles_by_step: Counts
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
        """Mean probability in each bin, (N_BINS,)."""
        return self._by_bin(self.sum_p)

    @property
    def share_ground(self) -> FloatArray:
        """Share of ground in each bin, (N_BINS,)."""
        return self._by_bin(self.n_ground)

    def _by_bin(self, sums: Counts | FloatArray) -> FloatArray:
        return np.where(self.n_points > 0, sums, np.nan) / np.maximum(self.n_points, 1)

    @property
    def ece(self) -> float:
        """Expected calibration error: mean over points of their bin's |share of ground - mean p|.

        Guo et al., "On Calibration of Modern Neural Networks", ICML 2017, for the
        probability of one class of two.
        """
        return ratio(float(np.abs(self.n_ground - self.sum_p).sum()), self.n_total)

    @property
    def brier(self) -> float:
        """Brier score, the mean of (p - truth)^2."""
        return ratio(self.sum_squared_error, self.n_total)

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


def count_calibration(p_ground: npt.NDArray[np.floating], truth: Labels) -> Calibration:
    """Compare probabilities of ground, (N,), NaN where unknown, with true labels, (N,).

    Where the truth is UNKNOWN the point does not count. Raises PointCloudError if the lengths
    differ or a probability is outside [0, 1].
    """
    if p_ground.shape != truth.shape:
        raise PointCloudError(
            f'p_ground of shape {p_ground.shape} for {len(truth)} points: must be ({len(truth)},)'
        )
    if not (np.isnan(p_ground) | ((p_ground >= 0.0) & (p_ground <= 1.0))).all():
        raise PointCloudError('p_ground: a probability is outside [0, 1]')
    scored = (truth == Label.GROUND) | (truth == Label.OBSTACLE)
    ground, p = truth[scored] == Label.GROUND, p_ground[scored].astype(np.float64)
    known = ~np.isnan(p)
    without, ground, p = ground[~known], ground[known], p[known]
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
