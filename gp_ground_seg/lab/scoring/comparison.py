"""How two methods differ on the same scans, and how sure that is.

The interval of a difference is a bootstrap over clusters of scans (Efron and Tibshirani, "An
Introduction to the Bootstrap", 1993): the frames of a sequence show the same street and are not
independent, so that sequences are drawn as a whole. With six sequences an interval is rough, and
rather too narrow than too wide.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import scipy.special

from gp_ground_seg.core.frame import FloatArray
from gp_ground_seg.lab.scoring.evaluate import KEYS, Scores, sums, title_of
from gp_ground_seg.lab.scoring.metrics import (
    HEIGHT_MEASURES,
    LABEL_MEASURES,
    Measure,
    ratio,
)
from gp_ground_seg.lab.scoring.objects import SHARES
from gp_ground_seg.lab.scoring.report import Column, Table, centimetres, milliseconds, percent

if TYPE_CHECKING:
    from pandas import DataFrame

CONFIDENCE, N_DRAWS, SEED = 0.95, 10_000, 0
N_BLOCKS, MIN_BLOCK = 10, 5
"""Most blocks of a single sequence, and the least number of frames in each."""
NONE = 'none'
"""Row in which no sequence is left out."""
N_NAMED = 3
"""Frames that are named because they differ most."""
INTERVAL = Column('95 % interval', key='interval')
"""Column of `interval_text`."""


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


def iou_measure(convention: str = '') -> Measure:
    """Return the IoU in a convention; without one, in columns that are of one only."""
    return LABEL_MEASURES['iou'].prefixed(f'{convention}_' if convention else '')


RMSE = HEIGHT_MEASURES['rmse']


def clusters(scores: Scores) -> DataFrame:
    """Return sequence, index and cluster of each scan; of one cluster, blocks of scans."""
    scans = scores.scans
    found = scans.loc[scans['method'] == scores.methods[0], [*KEYS[1:], 'cluster']]
    if found['cluster'].nunique() > 1:
        return found
    n = len(found)
    n_blocks = max(min(N_BLOCKS, n // MIN_BLOCK), 1)
    ends = [n * k // n_blocks for k in range(1, n_blocks)]
    return found.assign(cluster=np.searchsorted(ends, np.arange(n), side='right'))


def difference_interval(
    scores: Scores,
    other: str,
    measure: Measure,
    frame: DataFrame | None = None,
    ours: str = '',
) -> Interval | None:
    """Interval of a measure of ours, by default the first method, minus that of another.

    It is of the pooled scans, or of the rows of another `frame` of the scores. None with fewer
    than two clusters, or where a ratio is over nothing. It draws in the same way each time.
    """
    of_scan = clusters(scores)
    names = of_scan['cluster'].unique()
    n = len(names)
    if n < 2:
        return None
    times_drawn = np.random.default_rng(SEED).multinomial(n, np.full(n, 1.0 / n), size=N_DRAWS)
    needed = [*dict.fromkeys([*measure.above, *measure.below])]
    rows = (scores.scans if frame is None else frame)[[*KEYS, *needed]]
    parts = sums(rows.merge(of_scan, on=[*KEYS[1:]]), 'cluster')

    def drawn(method: str) -> FloatArray:
        part = parts.loc[method].reindex(names, fill_value=0)[needed].to_numpy(dtype=np.float64)
        pooled = dict(zip(needed, (times_drawn @ part).T, strict=True))
        return np.asarray(measure.of(pooled))

    difference = drawn(ours or scores.methods[0]) - drawn(other)
    if np.isnan(difference).any():
        return None
    tail = 0.5 * (1.0 - CONFIDENCE)
    return Interval(*np.quantile(difference, [tail, 1.0 - tail]).tolist())


def interval_text(
    scores: Scores,
    other: str,
    measure: Measure,
    frame: DataFrame | None = None,
    ours: str = '',
) -> str | None:
    """`difference_interval` in percent or cm; None without one."""
    found = difference_interval(scores, other, measure, frame, ours)
    return None if found is None else found.text(percent(''))


def interval_note(scores: Scores) -> str:
    """Say what the intervals of differences are, for the title of a table."""
    names = {*clusters(scores)['cluster']}
    if (n := len(names)) < 2:
        return 'no intervals: they need two sequences, or ten frames of one'
    kind = 'sequences' if names == {*scores.sequences} else 'scenes'
    if scores.scans['cluster'].nunique() == 1:
        kind = 'blocks of successive frames'
    return f'95 % interval: bootstrap over {n} {kind}; tie: it holds 0'


def without_one_table(scores: Scores, other: str) -> Table:
    """Compare the IoU of two methods with each of three or more sequences left out.

    The interval is a jackknife-t: wider than the bootstrap's, and the more honest with six
    sequences (Efron and Tibshirani, 1993, chapter 11).
    """
    names, iou = scores.sequences, iou_measure(scores.conventions[0])
    parts = sums(scores.scans, 'sequence')
    ours, peer = (
        iou.of(own.sum() - own.reindex([*names, NONE], fill_value=0))
        for own in (parts.loc[method] for method in (scores.methods[0], other))
    )
    difference = ours - peer
    n, whole = len(names), float(difference[NONE])
    reach = math.sqrt((n - 1) ** 2 / n * difference[names].var())
    reach *= float(scipy.special.stdtrit(n - 1, 0.5 + 0.5 * CONFIDENCE))
    interval = Interval(whole - reach, whole + reach).text(percent(''))
    columns = {
        Column('left out'): difference.index,
        percent('IoU', 'iou'): ours,
        percent(f'{title_of(other)} IoU', 'peer_iou'): peer,
        percent('difference', form='+.2f'): difference,
    }
    title = (
        f'IoU without one sequence  [%]; 95 % interval of the difference by jackknife: {interval}'
    )
    return Table(columns, title, n_sums=1)


def measures(convention: str) -> dict[Column, Measure]:
    """Return what is compared by `difference_table`, in the convention that counts."""
    titles = {'IoU [%]': 'iou', 'precision [%]': 'precision', 'recall [%]': 'recall'}
    return {
        **{
            percent(title): LABEL_MEASURES[name].prefixed(f'{convention}_')
            for title, name in titles.items()
        },
        percent('returns on objects called ground [%]'): Measure(('n_ground',), ('n_returns',)),
        percent('objects lost [%]'): Measure(('n_lost',), ('n_objects',)),
        **{
            percent(f'{title} [%]'): Measure((f'{name}_wrong',), (f'{name}_n',))
            for name, title in SHARES.items()
        },
        centimetres('RMSE of the height [cm]'): RMSE,
        percent('heights within 1 std, ideally 68.3 [%]'): HEIGHT_MEASURES['within_1'],
        percent('heights within 2 std, ideally 95.4 [%]'): HEIGHT_MEASURES['within_2'],
        milliseconds('time per frame, mean [ms]'): Measure(('seconds',), ('n_scans',)),
    }


def difference_table(scores: Scores, other: str) -> Table:
    """Compare two methods by each of `measures`; those without data in the scans are left out."""
    pooled = sums(scores.scans)
    rows = []
    for unit, measure in measures(*scores.conventions[:1] or ['']).items():
        if not {*measure.above, *measure.below} <= {*pooled}:
            continue
        value, peer = measure.of(pooled)[[scores.methods[0], other]]
        if not (math.isnan(value) and math.isnan(peer)):
            interval = difference_interval(scores, other, measure)
            text = None if interval is None else interval.text(unit)
            rows.append((unit, value, peer, value - peer, text))
    units, *columns = zip(*rows, strict=True)
    formats, scales = (
        tuple(str(unit.format) for unit in units),
        tuple(unit.scale for unit in units),
    )
    titles = [
        Column('given', formats, scale=scales),
        Column(title_of(other), formats, 'peer', scales),
        Column('difference', tuple(f'+{form}' for form in formats), scale=scales),
        INTERVAL,
    ]
    found = {
        Column('measure'): [u.title for u in units],
        **dict(zip(titles, columns, strict=True)),
    }
    title = f'Given minus {title_of(other)}; {interval_note(scores)}'
    return Table(found, title, [_changed_note(scores.of([other]).scans)])


def _changed_note(scans: DataFrame) -> str:
    """Say how many points have another label than by the first method, and where most."""
    share = ratio(scans['n_changed'], scans['points'])
    most = share.sort_values(ascending=False, kind='stable').head(N_NAMED)
    where = scans['sequence'] + '/' + scans['index']
    named = ', '.join(f'{where[k]} ({value:.2%})' for k, value in most.items())
    whole = ratio(scans['n_changed'].sum(), scans['points'].sum())
    return f'points with two labels: {whole:.2%}; most in {named}'
