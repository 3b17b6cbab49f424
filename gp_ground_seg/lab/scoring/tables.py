"""Tables of an evaluation, and the numbers of each scan; ours is the first of the methods."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Any

from gp_ground_seg.core.parameters.config import Config
from gp_ground_seg.lab.scoring import metrics, objects, report
from gp_ground_seg.lab.scoring.comparison import (
    INTERVAL,
    difference_table,
    interval_note,
    interval_text,
    iou_measure,
    without_one_table,
)
from gp_ground_seg.lab.scoring.evaluate import (
    ALL,
    FIT,
    KEYS,
    POSE,
    Scores,
    each,
    sums,
    title_of,
    with_all,
)
from gp_ground_seg.lab.scoring.metrics import Measure, height_ratios, label_ratios, ratio
from gp_ground_seg.lab.scoring.report import (
    Column,
    Report,
    Table,
    centimetres,
    milliseconds,
    percent,
)

if TYPE_CHECKING:
    from pandas import DataFrame, Series

RATIO_TITLES = {'f1': 'F1', 'iou': 'IoU'}
SHARE_TITLES = {
    objects.LOW_THINGS: ('low returns', percent('as ground')),
    'road_cells': ('road cells', percent('false', form='.3f')),
    'ground_cells': ('ground cells', percent('false', form='.3f')),
}
"""Columns of `scoring.objects.SHARES`: of what is counted, and of what of it is wrong."""


def evaluation(
    scores: Scores, config: Config, n_workers: int = 0, cut: float = objects.CUT_HEIGHT
) -> Report:
    """Report of our method with `config`, and of at most one other method on the same scans.

    Scans without labels have tables of time and of differing labels only. `cut` is the height at
    which objects were cut [m].
    """
    tables: dict[str, Table] = {}
    has_labels = bool(scores.conventions)
    if has_labels:
        tables |= {rule.key: _convention_table(scores, rule) for rule in metrics.CONVENTIONS}
    for other in scores.methods[1:]:
        if has_labels:
            tables['differences'] = _iou_differences(scores, other)
        if has_labels and len(scores.sequences) > 2:
            tables['without_one'] = without_one_table(scores, other)
        tables['measures'] = difference_table(scores, other)
    if has_labels:
        tables['rings'] = _ring_table(scores)
        tables['objects'] = object_table(scores)
        tables['low_things'] = _share_table(scores, cut)
        tables['probabilities'] = _calibration_table(scores)
        tables['heights'] = _height_table(scores)
    tables['times'] = _time_table(scores, n_workers)
    stages = {name: median_stages(scores, name) for name in scores.methods}
    reliability = reliability_rows(scores)
    return make_report(tables, scores, config, reliability=reliability, stages=stages)


def make_report(tables: dict[str, Table], scores: Scores, base: Config, **facts: Any) -> Report:
    """Report of scored variants; `base` is what they change, the first is of our method."""
    given = {'config_changes': report.changed_parameters(base), 'config': base.nested()}
    return Report(
        tables, scan_rows(scores), scores.rows['scans'][0]['backend'], {**given, **facts}
    )


def scan_rows(scores: Scores) -> list[dict[str, Any]]:
    """Every number of each scan of each method; heights in metres, angles in radians."""
    bins, counts_of = (
        dict(iter(frame.groupby([*KEYS], sort=False))) for frame in (scores.bins, scores.objects)
    )
    heights = 'n_points', 'n_without_model', 'median_absolute'
    kept = *KEYS, 'seconds', 'points', 'n_changed', *FIT, *(f'sensor_{name}' for name in POSE)
    rows = []
    for own in scores.rows['scans']:
        key = tuple(own[name] for name in KEYS)
        row = {name: own[name] for name in kept if name in own}
        for convention in scores.conventions:
            counts = {name: own[f'{convention}_{name}'] for name in metrics.COUNTS}
            found = counts | label_ratios(counts)
            row |= {f'{convention}_{name}': value for name, value in found.items()}
        if own.get('n_points'):
            found = {name: own[name] for name in heights} | height_ratios(own)
            row |= {f'{name}_all': value for name, value in found.items()}
        if key in bins and bins[key]['n'].any():
            row['ece'] = metrics.calibration_error(bins[key])
        for name in objects.SHARES:
            if f'{name}_n' in own:
                row[name] = {'n': own[f'{name}_n'], 'n_wrong': own[f'{name}_wrong']}
        if key in counts_of:
            row['objects'] = {
                name: part.set_index('range')[[*objects.OBJECT_COUNTS]].to_dict('index')
                for name, part in counts_of[key].groupby('class', sort=False)
            }
        rows.append(row)
    return rows


def _beside(found: list[Series], methods: list[str]) -> dict[Column, Any]:
    """Columns of the IoU of the other methods, and of ours minus it."""
    columns: dict[Column, Any] = {}
    for name, iou in zip(methods[1:], found[1:], strict=True):
        columns[percent(f'{title_of(name)} IoU', f'{name}_iou')] = iou
        columns[percent('difference', f'difference_to_{name}', '+.2f')] = found[0] - iou
    return columns


def _convention_table(scores: Scores, convention: metrics.Convention) -> Table:
    found = each(sums(with_all(scores.scans), 'sequence'), scores.methods)
    ratios, *others = (label_ratios(own, f'{convention.key}_') for own in found)
    columns = {
        Column('sequence'): found[0].index,
        Column('frames', 'd'): found[0]['n_scans'],
        **{percent(RATIO_TITLES.get(name, name), name): own for name, own in ratios.items()},
        **_beside([own['iou'] for own in (ratios, *others)], scores.methods),
    }
    title = f'{convention.title} convention: {convention.rule}  [%]'
    return Table(columns, title, n_sums=1)


def _iou_differences(scores: Scores, other: str) -> Table:
    """Differences of the IoU over all sequences: by convention, and by range."""
    cases = {
        f'all, {rule.title} convention': (scores.scans, iou_measure(rule.key))
        for rule in metrics.CONVENTIONS
    }
    for title in metrics.RING_TITLES:
        cases[title] = scores.rings[scores.rings['range'] == title], iou_measure()
    found = [measure.of(sums(frame)) for frame, measure in cases.values()]
    iou, peer = ([own[name] for own in found] for name in (scores.methods[0], other))
    columns = {
        Column('points'): cases,
        percent('IoU', 'iou'): iou,
        percent(f'{title_of(other)} IoU', 'peer_iou'): peer,
        percent('difference', form='+.2f'): [a - b for a, b in zip(iou, peer, strict=True)],
        INTERVAL: [
            interval_text(scores, other, measure, frame) for frame, measure in cases.values()
        ],
    }
    title = f'IoU minus that of {title_of(other)}  [%]; {interval_note(scores)}'
    return Table(columns, title)


def _ring_table(scores: Scores) -> Table:
    every = each(sums(scores.rings, 'range'), scores.methods)
    n_errors = every[0][['fp', 'fn']].sum().sum()
    found = [own.loc[[*metrics.RING_TITLES]] for own in every]
    ratios = [label_ratios(own) for own in found]
    errors = found[0]['fp'] + found[0]['fn']
    columns = {
        Column('range'): found[0].index,
        Column('points', '_d'): found[0][[*metrics.COUNTS]].sum(axis='columns'),
        Column('errors', '_d'): errors,
        percent('of errors', 'share_of_errors'): ratio(errors, n_errors),
        percent('precision'): ratios[0]['precision'],
        percent('recall'): ratios[0]['recall'],
        percent('IoU', 'iou'): ratios[0]['iou'],
        **_beside([own['iou'] for own in ratios], scores.methods),
    }
    return Table(columns, 'Horizontal range (GroundGrid convention)  [%]')


def object_table(scores: Scores) -> Table:
    """Lay out what of objects each method calls ground, by class and range."""
    rows = with_all(scores.objects, 'range')
    places = [
        (name, band) for name in objects.CLASSES if (rows['class'] == name).any()
        for band in (*objects.BAND_TITLES, ALL)
    ]  # fmt: skip
    pooled = sums(rows, 'class', 'range')
    found = [pooled.loc[[(method, *place) for place in places]] for method in scores.methods]
    measure = Measure(('n_ground',), ('n_returns',))
    lost = [own['n_lost'].where(own['n_objects'] > 0) for own in found]
    columns: dict[Column, Any] = {
        Column('class'): [name for name, _ in places],
        Column('range'): [band for _, band in places],
        Column('returns', '_d'): found[0]['n_returns'],
        percent('as ground', 'share_ground'): measure.of(found[0]),
    }
    title = (
        f'Objects: returns on them from {objects.MIN_HEIGHT:g} m above the local ground, and the '
        f'share called ground [%]; objects with at least {objects.MIN_RETURNS} such returns, and '
        'how many of them are lost: more than half of these returns called ground'
    )
    parts = dict(iter(rows.groupby(['class', 'range'])))
    for peer, own in zip(scores.methods[1:], found[1:], strict=True):
        columns[percent('peer', f'{peer}_share_ground')] = measure.of(own)
        columns[INTERVAL] = [interval_text(scores, peer, measure, parts[k]) for k in places]
        title += f'; peer: {title_of(peer)}; {interval_note(scores)}'
    columns |= {Column('objects', '_d'): found[0]['n_objects'], Column('lost', '_d'): lost[0]}
    for peer, count in zip(scores.methods[1:], lost[1:], strict=True):
        columns[Column('peer lost', '_d', f'{peer}_lost')] = count
    return Table(columns, title, _object_notes(scores))


def _object_notes(scores: Scores) -> list[str]:
    """Say why objects or returns are missing."""
    notes = []
    whole = sums(scores.scans)
    if not whole[['n_returns', 'n_unknown']].any(axis=None):
        notes = ['no return on an object: no class of objects in the labels']
    elif not whole['n_objects'].any():
        notes = ['no object with enough returns: only classes, if labels have no instances']
    if n_unknown := whole['n_unknown'].iloc[0]:
        shown = Column('', '_d').show(n_unknown)
        notes.append(f'{shown} returns on objects do not count: no labels of the ground near them')
    return notes


def _share_table(scores: Scores, cut: float) -> Table:
    """Low things and false cells by sequence and pooled, with the columns that ours has."""
    found = each(sums(with_all(scores.scans), 'sequence'), scores.methods)
    columns: dict[Column, Any] = {Column('sequence'): found[0].index}
    for name, (title, column) in SHARE_TITLES.items():
        if f'{name}_n' in scores.scans:
            columns[Column(title, '_d', name)] = found[0][f'{name}_n']
            for method, own in zip(['', *scores.methods[1:]], found, strict=True):
                key = f'{method}_{name}_wrong'.lstrip('_')
                title = 'peer' if method else column.title
                share = ratio(own[f'{name}_wrong'], own[f'{name}_n'])
                columns[dataclasses.replace(column, title=title, key=key)] = share
    low = (
        f'low: returns left of objects that are cut at {cut:g} m, more than '
        f'{objects.LOW_OVER:g} m over the ground and within {objects.LOW_RANGE:g} m, and the '
        'share called ground; '
    )
    title = (
        f'Low things and false cells  [%]; {low if cut else ""}cells of {objects.FALSE_SIZE:g} m '
        f'within {objects.FALSE_RANGE:g} m that hold labelled road or ground, false: a return of '
        f'it is called obstacle and is {objects.FALSE_OVER:g} m or more over the surface'
    )
    title += f'; peer: {title_of(scores.methods[1])}' if scores.methods[1:] else ''
    return Table(columns, title, n_sums=1)


def _calibration_table(scores: Scores) -> Table:
    """Errors of the probabilities by sequence and pooled."""
    bins = dict(iter(_bins(scores).groupby('sequence', sort=False)))
    columns = {
        Column('sequence'): bins,
        Column('points', '_d'): [own['n'].sum() for own in bins.values()],
        Column('ECE', '.4f', 'ece'): [metrics.calibration_error(own) for own in bins.values()],
    }
    title = (
        'Probabilities (GroundGrid convention): expected calibration error over '
        f'{metrics.N_BINS} bins'
    )
    return Table(columns, title, n_sums=1)


def _bins(scores: Scores) -> DataFrame:
    """Sum up the bins of probability of ours, by sequence and pooled."""
    own = scores.of(scores.methods[:1]).bins
    return sums(with_all(own), 'sequence', 'bin').reset_index()


def reliability_rows(scores: Scores) -> list[dict[str, Any]]:
    """Share of ground and mean probability in each bin of probability, by sequence and pooled."""
    if not scores.conventions:
        return []
    bins = _bins(scores)
    columns = {
        'sequence': bins['sequence'],
        'from': metrics.BIN_EDGES[bins['bin']],
        'to': metrics.BIN_EDGES[bins['bin'] + 1],
        'points': bins['n'],
        'mean_p': ratio(bins['p'], bins['n']),
        'share_ground': ratio(bins['n_ground'], bins['n']),
    }
    return [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]


def _height_table(scores: Scores) -> Table:
    """Errors of the surface under points labelled ground, by sequence and pooled."""
    rows = with_all(scores.scans)
    ours, *others = each(sums(rows, 'sequence'), scores.methods)
    ratios = height_ratios(ours)
    medians = rows.groupby(['method', 'sequence'], sort=False)['median_absolute'].median()
    columns = {
        Column('sequence'): ours.index,
        Column('points', '_d'): ours['n_points'],
        percent('no model', 'share_without_model'): share_without_model(ours),
        centimetres('bias'): ratios['bias'],
        centimetres('RMSE', 'rmse'): ratios['rmse'],
        centimetres('median', 'median_absolute'): medians[scores.methods[0]],
        percent('in 1 std', 'within_1', '.1f'): ratios['within_1'],
        percent('in 2 std', 'within_2', '.1f'): ratios['within_2'],
        **{
            centimetres(f'{title_of(peer)} RMSE', f'{peer}_rmse'): height_ratios(own)['rmse']
            for peer, own in zip(scores.methods[1:], others, strict=True)
        },
    }
    title = (
        'Height of the ground under returns labelled ground, those without a model left out [cm]; '
        'shares within one and two standard deviations  [%]'
    )
    return Table(columns, title, n_sums=1)


def share_without_model(found: DataFrame) -> Series:
    """Share of the points of true ground under which the surface has no height."""
    return ratio(found['n_without_model'], found['n_points'] + found['n_without_model'])


def _time_table(scores: Scores, n_workers: int) -> Table:
    seconds = scores.scans.groupby('method', sort=False)['seconds']
    median = seconds.median()
    columns = {
        Column('method'): [title_of(name) for name in scores.methods],
        milliseconds('median'): median,
        milliseconds('mean'): seconds.mean(),
        Column('ours / this', '.2f', 'ratio'): median.iloc[0] / median,
    }
    times = median_stages(scores, scores.methods[0])
    stages = ', '.join(f'{name} {1e3 * s:.1f}' for name, s in times.items())
    words = f'{n_workers} worker' + 's' * (n_workers > 1)
    beside = f', {words} beside one another' if n_workers else ''
    title = f'Time per frame, reading left out{beside}  [ms]'
    return Table(columns, title, [f'stages: {stages}', *_learning_note(scores)])


def median_stages(scores: Scores, method: str) -> dict[str, float]:
    """Median seconds of each stage of a method, empty if it reports none."""
    own = scores.times[scores.times['method'] == method]
    found: dict[str, float] = own.drop(columns=[*KEYS]).median().to_dict() if len(own) else {}
    return found


def _learning_note(scores: Scores) -> list[str]:
    """Say how many evaluations the learning of ours took, and whether it has converged."""
    ours = scores.of(scores.methods[:1]).scans
    learned = ours[ours['n_evaluations'] > 0]
    if not len(learned):
        return []
    numbers, n_converged = learned['n_evaluations'], (learned['status'] == 'converged').sum()
    return [
        f'learning: {numbers.median():.0f} evaluations (median), at most '
        f'{numbers.max():.0f}; {n_converged} of {len(learned)} frames converged'
    ]
