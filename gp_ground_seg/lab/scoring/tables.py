"""Tables of an evaluation: measures of ours beside one other method, with intervals.

The interval of a difference is a bootstrap over sequences (Efron and Tibshirani, "An Introduction
to the Bootstrap", 1993): the frames of a sequence show the same street and are not independent,
so a sequence is drawn as a whole. Six sequences are few: the interval is rough, and rather too
narrow than too wide.
"""

from contextlib import suppress
from typing import Any

import numpy as np

from gp_ground_seg.core.parameters.config import Config
from gp_ground_seg.lab.scoring import metrics, objects, report
from gp_ground_seg.lab.scoring.evaluate import ALL, KEYS, STAGE, Scores, sums
from gp_ground_seg.lab.scoring.metrics import Measure, ratio, share
from gp_ground_seg.lab.scoring.report import DataFrame, Form, Report, Table

CONFIDENCE, N_DRAWS, SEED = 0.95, 10_000, 0
N_BLOCKS, MIN_BLOCK = 10, 5
"""Most blocks of a single sequence, and the least number of frames in each."""
FEW = 20
"""Below this number of clusters an interval is said to be rough."""
N_NAMED = 3
"""Frames that are named because they differ most."""

MEASURES: dict[str, Measure] = {
    **metrics.LABEL_MEASURES,
    'share_ground': share('n_ground', 'n_returns'),
    'share_lost': share('n_lost', 'n_objects'),
    **{name: share(f'{name}_wrong', f'{name}_n') for name in objects.SHARES},
    **metrics.HEIGHT_MEASURES,
}
"""What is measured of sums over scans."""
HEIGHTS = 'without_model', 'bias', 'rmse', 'median_absolute', 'within_1', 'within_2'
"""Measures of the heights that are shown."""
PEERS = (
    'iou', 'rmse', 'share_ground', 'n_lost', 'lost_vehicles', 'lost_persons', *objects.SHARES,
    *objects.LOW_CLASSES,
)  # fmt: skip
"""Columns that tables have of the peer too."""
COMPARED = {
    'iou': 'IoU [%]',
    'precision': 'precision [%]',
    'recall': 'recall [%]',
    'share_ground': 'returns on objects called ground [%]',
    'share_lost': 'objects lost [%]',
    **{name: f'{title} [%]' for name, title in objects.SHARES.items()},
    'rmse': 'RMSE of the height [cm]',
    'within_1': 'heights within 1 std, ideally 68.3 [%]',
    'within_2': 'heights within 2 std, ideally 95.4 [%]',
}
"""Measures of which the differences have an interval."""


def clusters(scores: Scores) -> DataFrame:
    """Return sequence, index and cluster of each scan; of one cluster, blocks of scans."""
    scans = scores.scans
    found = scans.loc[scans['method'] == scores.methods[0], [*KEYS[1:], 'cluster']]
    if found['cluster'].nunique() > 1:
        return found
    n = len(found)
    n_blocks = max(min(N_BLOCKS, n // MIN_BLOCK), 1)
    return found.assign(cluster=((np.arange(n) + 1) * n_blocks - 1) // n)


def interval_text(
    scores: Scores, other: str, measure: Measure, frame: DataFrame | None = None, ours: str = ''
) -> str | None:
    """Interval of a measure of ours, by default the first method, minus that of another.

    It is of the pooled scans, or of the rows of another `frame` of the scores, in percent or cm:
    ``-0.10 to +0.25 tie``. None with fewer than two clusters, or where a ratio is over nothing.
    It draws in the same way each time.
    """
    of_scan = clusters(scores)
    names = of_scan['cluster'].unique()
    n = len(names)
    if n < 2:
        return None
    times_drawn = np.random.default_rng(SEED).multinomial(n, np.full(n, 1.0 / n), size=N_DRAWS)
    rows = (scores.scans if frame is None else frame).drop(columns='cluster', errors='ignore')
    parts = sums(rows.merge(of_scan, on=[*KEYS[1:]]), 'cluster')

    def drawn(method: str) -> Any:
        part = parts.loc[method].reindex(names, fill_value=0)
        pooled = times_drawn @ part.to_numpy(dtype=np.float64)
        return measure(dict(zip(part, pooled.T, strict=True)))

    difference = drawn(ours or scores.methods[0]) - drawn(other)
    if np.isnan(difference).any():
        return None
    tail = 0.5 * (1.0 - CONFIDENCE)
    low, high = np.quantile(100.0 * difference, [tail, 1.0 - tail])
    return f'{low:+.2f} to {high:+.2f}{" tie" if low <= 0.0 <= high else ""}'


def interval_note(scores: Scores) -> str:
    """Say what the intervals of differences are, for the title of a table."""
    names = {*clusters(scores)['cluster']}
    if (n := len(names)) < 2:
        return 'no intervals: they need two sequences, or ten frames of one'
    kind = 'sequences' if names == {*scores.sequences} else 'scenes'
    if scores.scans['cluster'].nunique() == 1:
        kind = 'blocks of successive frames'
    few = ' (few: too narrow)' * (n < FEW)
    return f'95 % interval: bootstrap over {n} {kind}{few}; tie: 0 is in it'


def beside(found: DataFrame, scores: Scores) -> DataFrame:
    """Return the rows of ours, with the columns of `PEERS` of the peer after those of ours.

    `found` has the methods in the first level of its index. With ``iou`` the last column is the
    difference. Without a peer there is nothing to compare.
    """
    ours = found.loc[scores.methods[0]]
    if not scores.peer:
        return ours
    theirs = found.loc[scores.peer].filter(PEERS).add_prefix(report.PEER)
    both = ours.join(theirs).filter([part for name in ours for part in (name, report.PEER + name)])
    return both.assign(difference=both['iou'] - both['peer_iou']) if 'iou' in both else both


def with_measures(sums: DataFrame) -> DataFrame:
    """Return sums, and the `MEASURES` that they have."""
    columns = dict[str, Any]()
    for name, measure in MEASURES.items():
        with suppress(KeyError):  # no labels, no heights, no low things
            columns[name] = measure(sums)
    return sums.assign(**columns)


def measured(rows: DataFrame, *by: str) -> DataFrame:
    """Return the sums of each method, or of each group in it, with the `MEASURES` that they have.

    The median error of the height is that of the scans.
    """
    found = with_measures(sums(rows, *by))
    if 'median_absolute' in rows:
        groups = rows.groupby(['method', *by], sort=False)
        found['median_absolute'] = groups['median_absolute'].median()
    return found


def make_report(tables: dict[str, Table], scores: Scores, config: Config) -> Report:
    """Report of scored variants of `config`; its rows are the scans, with sums and measures."""
    rows = report.records(with_measures(scores.scans))
    return Report(tables, rows, str(scores.scans['backend'].iloc[0]), config)


def peer_note(scores: Scores, note: str = '') -> str:
    """Say in a title which method the peer is, and more of it."""
    return f'; peer: {scores.peer}{note}' if scores.peer else ''


def evaluation(scores: Scores, config: Config) -> Report:
    """Report of our method with `config`, and of at most one other method on the same scans.

    Scans without labels have tables of time and of differing labels only. A further measure of
    labelled scans is a column here.
    """
    minus = f' minus that of {scores.peer}' if scores.peer else ''
    layouts: tuple[tuple[Any, ...], ...] = (
        ('groundgrid', 'GroundGrid convention: vegetation left out [%]',
         scores.scans, 'sequence', ['n_scans', *metrics.LABEL_MEASURES]),
        ('low_things', 'Low objects and false cells [%]', scores.scans, 'sequence',
         [column for name in objects.SHARES for column in (f'{name}_n', name)]),
        ('heights', 'Height of the ground under returns labelled ground [cm]; shares without a '
         'model and within one and two standard deviations [%]',
         scores.scans, 'sequence', ['n_points', *HEIGHTS]),
        ('rings', f'IoU{minus} by horizontal range (GroundGrid convention) [%]',
         scores.rings, 'range', [*metrics.LABEL_MEASURES], 'iou'),
        ('objects', 'Objects: returns on them, and the share called ground [%]; objects, and '
         'those lost', scores.objects, 'class',
         ['n_returns', 'share_ground', 'n_objects', 'n_lost'], 'share_ground'),
    )  # fmt: skip
    tables = {
        name: _grouped(scores, title, frame, *more)
        for name, title, frame, *more in layouts
        if scores.has_truth and len(frame)
    }
    if scores.peer:
        tables['measures'] = difference_table(scores)
    return make_report({**tables, **time_tables(scores, scores.peer)}, scores, config)


def _grouped(
    scores: Scores, title: str, frame: DataFrame, by: str, columns: list[str], interval: str = ''
) -> Table:
    """Lay out measures of the groups of a frame, and of all but for classes of objects.

    The measure `interval` has one of the difference to the peer.
    """
    # The rows of all are each once more.
    parts = [frame] if by == 'class' else [frame, frame.assign(**{by: ALL})]
    rows = report.require_pandas().concat(parts, ignore_index=True)
    found = measured(rows, by)
    if 'n_lost' in found:
        found['n_lost'] = found['n_lost'].where(found['n_objects'] > 0)
    table = beside(found[[name for name in columns if name in found]], scores).reset_index()
    if by == 'class':
        order = [*objects.CLASSES].index
        table = table.sort_values('class', key=lambda own: own.map(order))
    title += peer_note(scores)
    if interval and scores.peer:
        groups, measure = (rows[rows[by] == name] for name in table[by]), MEASURES[interval]
        table['interval'] = [interval_text(scores, scores.peer, measure, own) for own in groups]
        title += f'; {COMPARED[interval].removesuffix(" [%]")}: {interval_note(scores)}'
    return Table(title, table)


def difference_table(scores: Scores) -> Table:
    """Compare two methods by `COMPARED`; measures without data in the scans are left out."""
    other = scores.peer
    found = measured(scores.scans).loc[[scores.methods[0], other]]
    found = found[[name for name in COMPARED if name in found]].dropna(axis='columns', how='all')
    table = found.T.set_axis(['given', 'peer'], axis='columns')
    table['difference'] = table['given'] - table['peer']
    table['interval'] = [interval_text(scores, other, MEASURES[name]) for name in table.index]
    table = table.rename(index=COMPARED).reset_index(names='measure')
    forms = {'given': Form('given', *report.SHARE), 'peer': Form(other, *report.SHARE)}
    title = f'Given minus {other}; {_changed_note(scores.scans, other)}; {interval_note(scores)}'
    return Table(title, table, forms)


def _changed_note(scans: DataFrame, other: str) -> str:
    """Say how many points have another label than by the first method, and where most."""
    own = scans[scans['method'] == other]
    changed = ratio(own['n_changed'], own['points'])
    most = changed.sort_values(ascending=False, kind='stable').head(N_NAMED)
    where = own['sequence'] + '/' + own['index']
    named = ', '.join(f'{where[k]} ({value:.2%})' for k, value in most.items())
    whole = ratio(own['n_changed'].sum(), own['points'].sum())
    return f'points with two labels: {whole:.2%}; most in {named}'


def time_tables(
    scores: Scores, peer: str = '', title: str = 'Time per frame, reading left out'
) -> dict[str, Table]:
    """Median and 99 % quantile of the time of each method, and the stages of ours.

    The ratio to a `peer` is the median of those frame by frame: it holds although the speed of
    the machine drifts.
    """
    scans = scores.scans
    runs = scans.assign(run=scans.groupby('method').cumcount())
    seconds = runs.pivot(index='run', columns='method', values='seconds')[scores.methods]
    table = seconds.median().to_frame('median').assign(p99=seconds.quantile(0.99))
    if peer:
        table['ratio'] = seconds.div(seconds[peer], axis='index').median()
        table['p99_ratio'] = table['p99'] / table['median'][peer]
    forms = {'ratio': Form(f'/ {peer}', '.2f')}
    forms['p99_ratio'] = Form(f'p99 / {peer} median', '.2f')
    stages = scans.filter(regex=f'^{STAGE}').dropna(how='all')  # of ours
    stages = stages.assign(rest=scans['seconds'] - stages.sum(axis='columns'))
    stages = stages.rename(columns=lambda name: name.removeprefix(STAGE))
    medians = stages.groupby(scans['method'], sort=False).median()
    of_stage = {name: Form(name, '.2f', 1e3) for name in medians}
    of_stage['method'] = Form('stage, median [ms]')
    return {
        'times': Table(title, table.reset_index(), forms),
        'stages': Table('Stages of a frame', medians.reset_index(), of_stage),
    }
