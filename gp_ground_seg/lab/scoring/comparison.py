"""How two methods differ on the same scans, and how sure that is.

The interval of a difference is a bootstrap over clusters of scans (Efron and Tibshirani, "An
Introduction to the Bootstrap", 1993): the frames of a sequence show the same street and are not
independent, so that sequences are drawn as a whole. With six sequences an interval is rough, and
rather too narrow than too wide.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np
import scipy.special

from gp_ground_seg.core.frame import FloatArray
from gp_ground_seg.lab.scoring import report
from gp_ground_seg.lab.scoring.evaluate import MethodScore, ScanScore
from gp_ground_seg.lab.scoring.metrics import ratio
from gp_ground_seg.lab.scoring.objects import SHARES, ObjectCount, Share
from gp_ground_seg.lab.scoring.report import Column, Table, percent

CONFIDENCE, N_DRAWS, SEED = 0.95, 10_000, 0
N_BLOCKS, MIN_BLOCK = 10, 5
"""Most blocks of a single sequence, and the least number of frames in each."""
NONE = 'none'
"""Row in which no sequence is left out."""
N_NAMED = 3
"""Frames that are named because they differ most."""
INTERVAL = Column('95 % interval', key='interval')
"""Column of `interval_text`."""

Measure = Callable[[MethodScore], tuple[float, float]]
"""A ratio, such as an IoU, as numerator and denominator; each is a sum over scans."""


class Interval(NamedTuple):
    """A confidence interval of a difference."""

    low: float
    high: float

    @property
    def is_tie(self) -> bool:
        """Whether it holds 0."""
        return self.low <= 0.0 <= self.high

    def text(self, column: Column) -> str:
        """Return it in the unit of a column, as in ``-0.10 to +0.25 tie``."""
        signed = replace(column, format=f'+{column.format}')
        return f'{signed.show(self.low)} to {signed.show(self.high)}' + ' tie' * self.is_tie


def clusters(score: MethodScore) -> list[MethodScore]:
    """Return the scans that are drawn together; of one cluster, blocks of successive frames."""
    names = list(dict.fromkeys(scan.cluster or scan.sequence for scan in score.scans))
    if len(names) > 1:
        parts: dict[str, list[ScanScore]] = {name: [] for name in names}
        for scan in score.scans:
            parts[scan.cluster or scan.sequence].append(scan)
        return [MethodScore(score.name, tuple(scans)) for scans in parts.values()]
    n = len(score.scans)
    n_blocks = max(min(N_BLOCKS, n // MIN_BLOCK), 1)
    edges = [n * k // n_blocks for k in range(n_blocks + 1)]
    return [MethodScore(score.name, score.scans[a:b]) for a, b in itertools.pairwise(edges)]


def iou_sums(score: MethodScore) -> tuple[float, float]:
    """Return the IoU in the convention that counts, as a ratio."""
    return score.confusion.iou_sums


def mse_sums(score: MethodScore) -> tuple[float, float]:
    """Return the mean squared error of the height, as a ratio."""
    return score.height.sum_squared_error, score.height.n_points


def difference_interval(
    ours: MethodScore,
    other: MethodScore,
    sums: Measure = iou_sums,
    rng: np.random.Generator | None = None,
) -> Interval | None:
    """Interval of the pooled ratio of one method minus that of another on the same scans.

    None with fewer than two clusters, or where a ratio is over nothing. For `mse_sums` it is the
    difference of the roots, the RMSE. `rng` draws; by default in the same way each time.
    """
    parts = clusters(ours), clusters(other)
    n = len(parts[0])
    if n < 2:
        return None
    rng = np.random.default_rng(SEED) if rng is None else rng
    times_drawn = rng.multinomial(n, np.full(n, 1.0 / n), size=N_DRAWS)

    def ratios(scores: list[MethodScore]) -> FloatArray:
        above, below = (times_drawn @ np.array([sums(s) for s in scores], dtype=np.float64)).T
        result: FloatArray = np.divide(above, below, where=below > 0, out=np.full(N_DRAWS, np.nan))
        return np.sqrt(result) if sums is mse_sums else result

    difference = ratios(parts[0]) - ratios(parts[1])
    if np.isnan(difference).any():
        return None
    tail = 0.5 * (1.0 - CONFIDENCE)
    return Interval(*np.quantile(difference, [tail, 1.0 - tail]).tolist())


def interval_text(ours: MethodScore, other: MethodScore, sums: Measure = iou_sums) -> str | None:
    """`difference_interval` in percent or cm; None without one."""
    found = difference_interval(ours, other, sums)
    return None if found is None else found.text(percent(''))


def interval_note(score: MethodScore) -> str:
    """Say what the intervals of differences to this method are, for the title of a table."""
    parts = clusters(score)
    if len(parts) < 2:
        return 'no intervals: they need two sequences, or ten frames of one'
    kind = 'sequences' if len(parts) == len(score.sequences) else 'scenes'
    if len({scan.cluster or scan.sequence for scan in score.scans}) == 1:
        kind = 'blocks of successive frames'
    return f'95 % interval: bootstrap over {len(parts)} {kind}; tie: it holds 0'


def without_one_table(ours: MethodScore, other: MethodScore) -> Table:
    """Compare the IoU of two methods with each of three or more sequences left out.

    The interval is a jackknife-t: wider than the bootstrap's, and the more honest with six
    sequences (Efron and Tibshirani, 1993, chapter 11).
    """
    names, differences = ours.sequences, []
    rows: list[report.Row] = []
    for left_out in [*names, NONE]:
        kept = [name for name in names if name != left_out]
        iou, peer = (score.of(*kept).iou for score in (ours, other))
        differences.append(iou - peer)
        cells = (percent('IoU', 'iou'), iou), (percent(f'{other.title} IoU', 'peer_iou'), peer)
        difference = percent('difference', form='+.2f')
        rows.append([(Column('left out'), left_out), *cells, (difference, iou - peer)])
    *without, whole = differences
    n = len(names)
    reach = math.sqrt((n - 1) ** 2 / n * np.var(without, ddof=1))
    reach *= float(scipy.special.stdtrit(n - 1, 0.5 + 0.5 * CONFIDENCE))
    interval = Interval(whole - reach, whole + reach).text(percent(''))
    title = (
        f'IoU without one sequence  [%]; 95 % interval of the difference by jackknife: {interval}'
    )
    return Table(rows, title, n_sums=1)


def counts_of_all(score: MethodScore) -> ObjectCount:
    """Sum up the objects of all classes in all bands."""
    return sum(itertools.chain(*score.objects.values()), ObjectCount())


def share_sums(name: str, score: MethodScore) -> tuple[float, float]:
    """Return one of `SHARES` as a ratio."""
    found = score.shares.get(name, Share())
    return found.n_wrong, found.n


MEASURES: tuple[tuple[Column, Measure], ...] = (
    (percent('IoU [%]'), iou_sums),
    (percent('precision [%]'),
     lambda s: (s.confusion.tp, s.confusion.tp + s.confusion.fp)),
    (percent('recall [%]'), lambda s: (s.confusion.tp, s.confusion.tp + s.confusion.fn)),
    (percent('returns on objects called ground [%]'),
     lambda s: (counts_of_all(s).n_ground, counts_of_all(s).n_returns)),
    (percent('objects lost [%]'),
     lambda s: (counts_of_all(s).n_lost, counts_of_all(s).n_objects)),
    *((percent(f'{title} [%]'), partial(share_sums, name)) for name, title in SHARES.items()),
    (report.centimetres('RMSE of the height [cm]'), mse_sums),
    (percent('heights within 1 std, ideally 68.3 [%]'),
     lambda s: (s.height.n_within_1, s.height.n_with_std)),
    (percent('heights within 2 std, ideally 95.4 [%]'),
     lambda s: (s.height.n_within_2, s.height.n_with_std)),
    (report.milliseconds('time per frame, mean [ms]'),
     lambda s: (sum(scan.seconds for scan in s.scans), len(s.scans))),
)  # fmt: skip
"""Measures that are compared: their columns, and each as a ratio of sums over scans."""


def difference_table(ours: MethodScore, other: MethodScore) -> Table:
    """Compare two methods by each of `MEASURES`; those without data in the scans are left out."""
    rows: list[report.Row] = []
    for column, sums in MEASURES:
        value, peer = (ratio(*sums(score)) for score in (ours, other))
        if math.isnan(value) and math.isnan(peer):
            continue
        if sums is mse_sums:
            value, peer = math.sqrt(value), math.sqrt(peer)
        interval = difference_interval(ours, other, sums)
        signed = replace(column, title='difference', key='', format=f'+{column.format}')
        rows.append(
            [
                (Column('measure'), column.title),
                (replace(column, title='given', key=''), value),
                (replace(column, title=other.title, key='peer'), peer),
                (signed, value - peer),
                (INTERVAL, None if interval is None else interval.text(column)),
            ]
        )
    title = f'Given minus {other.title}; {interval_note(ours)}'
    return Table(rows, title, [_changed_note(other)])


def _changed_note(other: MethodScore) -> str:
    """Say how many points have another label than by the first method, and where most."""
    n_changed = sum(scan.n_changed for scan in other.scans)
    n_points = sum(scan.n_points for scan in other.scans)
    shares = {
        f'{scan.sequence}/{scan.index}': ratio(scan.n_changed, scan.n_points)
        for scan in other.scans
    }
    most = sorted(shares, key=lambda name: -shares[name])[:N_NAMED]
    named = ', '.join(f'{name} ({shares[name]:.2%})' for name in most)
    return f'points with two labels: {ratio(n_changed, n_points):.2%}; most in {named}'
