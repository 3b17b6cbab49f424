"""Tables of an evaluation, and the numbers of each scan; ours is the first of the scores."""

from __future__ import annotations

import dataclasses
import itertools
import statistics
from collections.abc import Sequence
from functools import partial
from typing import Any

from gp_ground_seg.core.parameters.config import Config
from gp_ground_seg.lab.scoring import metrics, report
from gp_ground_seg.lab.scoring.comparison import (
    INTERVAL,
    Measure,
    counts_of_all,
    difference_table,
    interval_note,
    interval_text,
    without_one_table,
)
from gp_ground_seg.lab.scoring.evaluate import ALL, MethodScore
from gp_ground_seg.lab.scoring.metrics import Confusion
from gp_ground_seg.lab.scoring.objects import (
    BAND_TITLES,
    CUT_HEIGHT,
    FALSE_OVER,
    FALSE_RANGE,
    FALSE_SIZE,
    LOW_OVER,
    LOW_RANGE,
    LOW_THINGS,
    MIN_HEIGHT,
    MIN_RETURNS,
    ObjectCount,
    Share,
)
from gp_ground_seg.lab.scoring.report import Column, Report, Row, Table, percent

RATIO_TITLES = {'f1': 'F1', 'iou': 'IoU'}
SHARE_TITLES = {
    LOW_THINGS: ('low returns', percent('as ground')),
    'road_cells': ('road cells', percent('false', form='.3f')),
    'ground_cells': ('ground cells', percent('false', form='.3f')),
}
"""Columns of `scoring.objects.SHARES`: of what is counted, and of what of it is wrong."""


def evaluation(
    scores: Sequence[MethodScore],
    config: Config,
    n_workers: int = 0,
    cut: float = CUT_HEIGHT,
) -> Report:
    """Report of our method with `config`, and of at most one other method on the same scans.

    Scans without labels have tables of time and of differing labels only. `cut` is the height at
    which objects were cut [m].
    """
    ours, *others = scores
    tables: dict[str, Table] = {}
    if ours.has_labels:
        tables |= {one.key: _convention_table(scores, one) for one in metrics.CONVENTIONS}
    for other in others:
        if ours.has_labels:
            tables['differences'] = _iou_differences(ours, other)
        if ours.has_labels and len(ours.sequences) > 2:
            tables['without_one'] = without_one_table(ours, other)
        tables['measures'] = difference_table(ours, other)
    if ours.has_labels:
        tables['rings'] = _ring_table(scores)
        tables['objects'] = object_table(scores)
        tables['low_things'] = _share_table(scores, cut)
        tables['probabilities'] = _calibration_table(ours)
        tables['heights'] = _height_table(scores)
    tables['times'] = _time_table(scores, n_workers)
    return make_report(
        tables, scores, config,
        reliability=reliability_rows(ours),
        stages={score.name: score.median_stages for score in scores},
    )  # fmt: skip


def make_report(
    tables: dict[str, Table], scores: Sequence[MethodScore], base: Config, **facts: Any
) -> Report:
    """Report of scored variants; `base` is what they change, the first is of our method."""
    fit = scores[0].scans[-1].fit
    assert fit is not None
    given = {'config_changes': report.changed_parameters(base), 'config': base.nested()}
    return Report(tables, scan_rows(scores), fit, {**given, **facts})


def scan_rows(scores: Sequence[MethodScore]) -> list[dict[str, Any]]:
    """Every number of each scan of each method; heights in metres, angles in radians."""
    rows = []
    scans = [(score.name, scan) for score in scores for scan in score.scans]
    of_labels = ('tp', 'fp', 'fn', 'tn', *metrics.RATIOS)
    of_height = (
        'n_points', 'n_without_model', 'rmse', 'median_absolute', 'bias', 'smse',
        'within_1', 'within_2', 'nlpd',
    )  # fmt: skip
    for method, scan in scans:
        row: dict[str, Any] = {'method': method, 'sequence': scan.sequence}
        row |= {'index': scan.index, 'seconds': scan.seconds}
        row |= {'points': scan.n_points, 'n_changed': scan.n_changed}
        for key, confusion in scan.confusions.items():
            row |= {f'{key}_{name}': getattr(confusion, name) for name in of_labels}
        if scan.height.n_points:
            row |= {f'{name}_all': getattr(scan.height, name) for name in of_height}
        if scan.calibration.n_total:
            row['ece'] = scan.calibration.ece
        row |= {name: dataclasses.asdict(share) for name, share in scan.shares.items()}
        if scan.objects:
            row['objects'] = {
                name: dict(zip(BAND_TITLES, map(dataclasses.asdict, bands), strict=True))
                for name, bands in scan.objects.items()
            }
        if scan.fit is not None and scan.pose is not None:
            pose = scan.pose
            row |= {'status': scan.fit.status, 'n_evaluations': scan.fit.n_evaluations}
            row |= {'n_segments': scan.fit.n_segments}
            row |= {'sensor_height': pose.height, 'sensor_height_estimated': pose.height_estimated}
            row |= {'sensor_roll': pose.roll, 'sensor_pitch': pose.pitch}
        rows.append(row)
    return rows


def _beside(peers: Sequence[MethodScore], iou: float, others: Sequence[Confusion]) -> Row:
    """Cells of the IoU of each peer, and of ours minus it."""
    cells: Row = []
    for peer, found in zip(peers, others, strict=True):
        cells.append((percent(f'{peer.title} IoU', f'{peer.name}_iou'), found.iou))
        cells.append(
            (percent('difference', f'difference_to_{peer.name}', '+.2f'), iou - found.iou)
        )
    return cells


def _convention_table(scores: Sequence[MethodScore], convention: metrics.Convention) -> Table:
    rows: list[Row] = []
    for parts in zip(*(score.by_sequence() for score in scores), strict=True):
        found, *others = (score.pooled(convention.key) for _, score in parts)
        ratios = {name: getattr(found, name) for name in metrics.RATIOS}
        rows.append(
            [
                (Column('sequence'), parts[0][0]),
                (Column('frames', 'd'), len(parts[0][1].scans)),
                *((percent(RATIO_TITLES.get(n, n), n), value) for n, value in ratios.items()),
                *_beside(scores[1:], found.iou, others),
            ]
        )
    title = f'{convention.title} convention: {convention.rule}  [%]'
    return Table(rows, title, n_sums=1)


def _iou_differences(ours: MethodScore, peer: MethodScore) -> Table:
    """Differences of the IoU over all sequences: by convention, and by range."""

    def of_convention(key: str, score: MethodScore) -> tuple[float, float]:
        return score.pooled(key).iou_sums

    def of_ring(k: int, score: MethodScore) -> tuple[float, float]:
        return score.rings[k].confusion.iou_sums

    cases: dict[str, Measure] = {
        f'all, {one.title} convention': partial(of_convention, one.key)
        for one in metrics.CONVENTIONS
    }
    cases |= {title: partial(of_ring, k) for k, title in enumerate(metrics.RING_TITLES)}
    rows: list[Row] = []
    for title, sums in cases.items():
        iou, other = (metrics.ratio(*sums(score)) for score in (ours, peer))
        rows.append(
            [
                (Column('points'), title),
                (percent('IoU', 'iou'), iou),
                (percent(f'{peer.title} IoU', 'peer_iou'), other),
                (percent('difference', form='+.2f'), iou - other),
                (INTERVAL, interval_text(ours, peer, sums)),
            ]
        )
    return Table(rows, f'IoU minus that of {peer.title}  [%]; {interval_note(ours)}')


def _ring_table(scores: Sequence[MethodScore]) -> Table:
    n_errors = scores[0].confusion.errors
    rows: list[Row] = []
    rings = zip(*(score.rings for score in scores), strict=True)
    for title, parts in zip(metrics.RING_TITLES, rings, strict=True):
        ring, *others = (part.confusion for part in parts)
        rows.append(
            [
                (Column('range'), title),
                (Column('points', '_d'), ring.points),
                (Column('errors', '_d'), ring.errors),
                (percent('of errors', 'share_of_errors'), metrics.ratio(ring.errors, n_errors)),
                (percent('precision'), ring.precision),
                (percent('recall'), ring.recall),
                (percent('IoU', 'iou'), ring.iou),
                *_beside(scores[1:], ring.iou, others),
            ]
        )
    return Table(rows, 'Horizontal range (GroundGrid convention)  [%]')


def object_table(scores: Sequence[MethodScore]) -> Table:
    """Lay out what of objects each method calls ground, by class and range."""
    counts = [
        {name: [*bands, sum(bands, ObjectCount())] for name, bands in score.objects.items()}
        for score in scores
    ]
    rows: list[Row] = []
    for name, (k, band) in itertools.product(counts[0], enumerate([*BAND_TITLES, ALL])):
        ours, *others = (found[name][k] for found in counts)
        peers = list(zip(scores[1:], others, strict=True))
        sums = partial(_object_sums, name, k)
        rows.append(
            [
                (Column('class'), name),
                (Column('range'), band),
                (Column('returns', '_d'), ours.n_returns),
                (percent('as ground', 'share_ground'), ours.share_ground),
                *((percent('peer', f'{p.name}_share_ground'), c.share_ground) for p, c in peers),
                *((INTERVAL, interval_text(scores[0], peer, sums)) for peer, _ in peers),
                (Column('objects', '_d'), ours.n_objects),
                (Column('lost', '_d'), _n_lost(ours)),
                *((Column('peer lost', '_d', f'{p.name}_lost'), _n_lost(c)) for p, c in peers),
            ]
        )
    title = (
        f'Objects: returns on them from {MIN_HEIGHT:g} m above the local ground, and the share '
        f'called ground [%]; objects with at least {MIN_RETURNS} such returns, and how many of '
        'them are lost: more than half of these returns called ground'
    )
    if len(scores) > 1:
        title += f'; peer: {scores[1].title}; {interval_note(scores[0])}'
    return Table(rows, title, _object_notes([counts_of_all(score) for score in scores]))


def _object_notes(counts: Sequence[ObjectCount]) -> list[str]:
    """Say why objects or returns of each method, ours first, are missing."""
    notes = []
    if not any(count.n_returns or count.n_unknown for count in counts):
        notes = ['no return on an object: no class of objects in the labels']
    elif not any(count.n_objects for count in counts):
        notes = ['no object with enough returns: only classes, if labels have no instances']
    if n_unknown := counts[0].n_unknown:
        shown = Column('', '_d').show(n_unknown)
        notes.append(f'{shown} returns on objects do not count: no labels of the ground near them')
    return notes


def _n_lost(count: ObjectCount) -> int | None:
    return count.n_lost if count.n_objects else None


def _object_sums(name: str, k: int, score: MethodScore) -> tuple[float, float]:
    """Return how many returns of a class in a band, at the end in all, are ground, and all."""
    bands = score.objects.get(name, ())
    found = sum(bands if k == len(BAND_TITLES) else bands[k : k + 1], ObjectCount())
    return found.n_ground, found.n_returns


def _share_table(scores: Sequence[MethodScore], cut: float) -> Table:
    """Low things and false cells by sequence and pooled, with the columns that ours has."""
    rows: list[Row] = []
    for parts in zip(*(score.by_sequence() for score in scores), strict=True):
        row: Row = [(Column('sequence'), parts[0][0])]
        for name, (title, column) in SHARE_TITLES.items():
            if name in scores[0].shares:
                ours, *others = (score.shares.get(name, Share()) for _, score in parts)
                row.append((Column(title, '_d', name), ours.n))
                row.append((dataclasses.replace(column, key=f'{name}_wrong'), ours.ratio))
                for peer, found in zip(scores[1:], others, strict=True):
                    key = f'{peer.name}_{name}_wrong'
                    row.append((dataclasses.replace(column, title='peer', key=key), found.ratio))
        rows.append(row)
    low = (
        f'low: returns left of objects that are cut at {cut:g} m, more than {LOW_OVER:g} m over '
        f'the ground and within {LOW_RANGE:g} m, and the share called ground; '
    )
    title = (
        f'Low things and false cells  [%]; {low if cut else ""}cells of {FALSE_SIZE:g} m within '
        f'{FALSE_RANGE:g} m that hold labelled road or ground, false: a return of it is called '
        f'obstacle and is {FALSE_OVER:g} m or more over the surface'
    )
    title += f'; peer: {scores[1].title}' if len(scores) > 1 else ''
    return Table(rows, title, n_sums=1)


def _calibration_table(score: MethodScore) -> Table:
    """Errors of the probabilities by sequence and pooled."""
    rows: list[Row] = [
        [
            (Column('sequence'), name),
            (Column('points', '_d'), part.calibration.n_total),
            (Column('ECE', '.4f', 'ece'), part.calibration.ece),
        ]
        for name, part in score.by_sequence()
    ]
    title = (
        'Probabilities (GroundGrid convention): expected calibration error over '
        f'{metrics.N_BINS} bins'
    )
    return Table(rows, title, n_sums=1)


def _height_table(scores: Sequence[MethodScore]) -> Table:
    """Errors of the surface under points labelled ground, by sequence and pooled."""
    rows: list[Row] = []
    for parts in zip(*(score.by_sequence() for score in scores), strict=True):
        found, *others = (score.height for _, score in parts)
        without = metrics.ratio(found.n_without_model, found.n_points + found.n_without_model)
        rows.append(
            [
                (Column('sequence'), parts[0][0]),
                (Column('points', '_d'), found.n_points),
                (percent('no model', 'share_without_model'), without),
                (report.centimetres('bias'), found.bias),
                (report.centimetres('RMSE', 'rmse'), found.rmse),
                (report.centimetres('median', 'median_absolute'), found.median_absolute),
                (percent('in 1 std', 'within_1', '.1f'), found.within_1),
                (percent('in 2 std', 'within_2', '.1f'), found.within_2),
                *(
                    (report.centimetres(f'{peer.title} RMSE', f'{peer.name}_rmse'), height.rmse)
                    for peer, height in zip(scores[1:], others, strict=True)
                ),
            ]
        )
    title = (
        'Height of the ground under returns labelled ground, those without a model left out [cm]; '
        'shares within one and two standard deviations  [%]'
    )
    return Table(rows, title, n_sums=1)


def _time_table(scores: Sequence[MethodScore], n_workers: int) -> Table:
    ours = scores[0].seconds()
    rows: list[Row] = [
        [
            (Column('method'), score.title),
            (report.milliseconds('median'), score.seconds()),
            (report.milliseconds('mean'), score.seconds(statistics.fmean)),
            (Column('ours / this', '.2f', 'ratio'), ours / score.seconds()),
        ]
        for score in scores
    ]
    stages = ', '.join(f'{name} {1e3 * s:.1f}' for name, s in scores[0].median_stages.items())
    words = f'{n_workers} worker' + 's' * (n_workers > 1)
    beside = f', {words} beside one another' if n_workers else ''
    title = f'Time per frame, reading left out{beside}  [ms]'
    return Table(rows, title, notes=[f'stages: {stages}', *_learning_note(scores[0])])


def _learning_note(score: MethodScore) -> list[str]:
    """Say how many evaluations the learning took, and whether it has converged."""
    fits = [scan.fit for scan in score.scans if scan.fit is not None and scan.fit.n_evaluations]
    if not fits:
        return []
    n_converged = sum(fit.status == 'converged' for fit in fits)
    numbers = [fit.n_evaluations for fit in fits]
    return [
        f'learning: {statistics.median(numbers):.0f} evaluations (median), at most '
        f'{max(numbers)}; {n_converged} of {len(fits)} frames converged'
    ]


def reliability_rows(score: MethodScore) -> list[dict[str, Any]]:
    """Share of ground and mean probability in each bin of probability, by sequence and pooled."""
    rows = []
    low, high = (metrics.BIN_EDGES[k : k + metrics.N_BINS].tolist() for k in (0, 1))
    keys = ('from', 'to', 'points', 'mean_p', 'share_ground')
    for sequence, part in score.by_sequence():
        found = part.calibration
        bins = (found.n_points, found.by_bin(found.sum_p), found.by_bin(found.n_ground))
        for row in zip(low, high, *(values.tolist() for values in bins), strict=True):
            rows.append({'sequence': sequence, **dict(zip(keys, row, strict=True))})
    return rows
