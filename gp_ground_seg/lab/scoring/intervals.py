"""How sure a difference of two scores is: the bootstrap over sequences.

Frames of a sequence show the same street and are not independent, so that whole sequences are
drawn (cluster bootstrap; Efron and Tibshirani, "An Introduction to the Bootstrap", 1993). With six
sequences an interval is rough, and rather too narrow than too wide.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from gp_ground_seg.core.frame import FloatArray
from gp_ground_seg.lab.scoring.evaluate import MethodScore
from gp_ground_seg.lab.scoring.report import Column

CONFIDENCE, N_DRAWS, SEED = 0.95, 10_000, 0
N_BLOCKS, MIN_BLOCK = 10, 5
"""Most blocks of a single sequence, and the least number of frames in each."""
INTERVAL = Column('95 % interval', key='interval')
"""Column of `interval_text`."""

Sums = Callable[[MethodScore], tuple[float, float]]
"""A ratio, such as an IoU, as numerator and denominator; each is a sum over scans."""


class Interval(NamedTuple):
    """A confidence interval of a difference."""

    low: float
    high: float

    @property
    def is_tie(self) -> bool:
        """Whether it holds 0."""
        return self.low <= 0.0 <= self.high


def clusters(score: MethodScore) -> list[MethodScore]:
    """Return what is drawn: the sequences, or of a single one blocks of successive frames."""
    parts, n = score.parts(), len(score.scans)
    if len(parts) > 1:
        return parts
    n_blocks = max(min(N_BLOCKS, n // MIN_BLOCK), 1)
    edges = [n * k // n_blocks for k in range(n_blocks + 1)]
    return [MethodScore(score.name, score.scans[a:b]) for a, b in itertools.pairwise(edges)]


def iou_sums(score: MethodScore) -> tuple[float, float]:
    """Return the IoU in the convention that counts, as a ratio."""
    return score.confusion.tp, score.confusion.tp + score.confusion.errors


def mse_sums(score: MethodScore) -> tuple[float, float]:
    """Return the mean squared error of the height, as a ratio."""
    return score.height.sum_squared_error, score.height.n_points


def difference_interval(
    ones: Sequence[MethodScore],
    others: Sequence[MethodScore],
    sums: Sums = iou_sums,
    rng: np.random.Generator | None = None,
) -> Interval | None:
    """Interval of the pooled ratio of one method minus that of another.

    Both are given by cluster, on the same scans; None with fewer than two clusters, or where a
    ratio is over nothing. For `mse_sums` it is the difference of the roots, the RMSE. `rng`
    draws; by default in the same way each time.
    """
    n = len(ones)
    if n < 2:
        return None
    rng = np.random.default_rng(SEED) if rng is None else rng
    times_drawn = rng.multinomial(n, np.full(n, 1.0 / n), size=N_DRAWS)

    def ratios(scores: Sequence[MethodScore]) -> FloatArray:
        above, below = (times_drawn @ np.array([sums(s) for s in scores], dtype=np.float64)).T
        result: FloatArray = np.divide(above, below, where=below > 0, out=np.full(N_DRAWS, np.nan))
        return np.sqrt(result) if sums is mse_sums else result

    difference = ratios(ones) - ratios(others)
    if np.isnan(difference).any():
        return None
    tail = 0.5 * (1.0 - CONFIDENCE)
    return Interval(*np.quantile(difference, [tail, 1.0 - tail]).tolist())


def interval_text(
    ones: Sequence[MethodScore], others: Sequence[MethodScore], sums: Sums = iou_sums
) -> str | None:
    """`difference_interval` in percent or cm, as in ``-0.10 to +0.25 tie``; None without one."""
    found = difference_interval(ones, others, sums)
    if found is None:
        return None
    words = ' to '.join(f'{100.0 * end:+.2f}' for end in found)
    return f'{words} tie' if found.is_tie else words


def interval_note(clusters: str) -> str:
    """Say what an interval is, for the title of a table; `clusters` as in ``6 sequences``."""
    return f'95 % interval: bootstrap over the {clusters}; tie: it holds 0'
