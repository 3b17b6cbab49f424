"""The tables of an evaluation."""

from __future__ import annotations

import statistics
from collections.abc import Iterable, Sequence

from gp_ground_seg.evaluation.calibration import BIN_EDGES, N_BINS, THRESHOLDS
from gp_ground_seg.evaluation.evaluate import ALL, MethodScore
from gp_ground_seg.evaluation.metrics import (
    CONVENTIONS,
    RATIOS,
    RING_TITLES,
    Convention,
    class_errors,
    class_name,
    ratio,
)
from gp_ground_seg.evaluation.table import Cell, Column, Table, milliseconds, percent
from gp_ground_seg.frame import Label

COUNTS_AS = {Label.GROUND: 'ground', Label.OBSTACLE: 'obstacle', Label.UNKNOWN: 'left out'}
RATIO_TITLES = {'f1': 'F1', 'iou': 'IoU'}


def score_tables(scores: Sequence[MethodScore]) -> dict[str, Table]:
    """Tables of an evaluation by name, ours first in `scores`."""
    tables = {one.key: _convention_table(scores, one) for one in CONVENTIONS}
    tables |= {'rings': _ring_table(scores), 'classes': _class_table(scores[0])}
    if (table := _calibration_table(scores[0])) is not None:
        tables['probabilities'] = table
    return tables | {'times': _time_table(scores)}


def _peer_columns(peers: Sequence[MethodScore]) -> list[Column]:
    columns = []
    for peer in peers:
        columns.append(percent(f'{peer.title} IoU', f'{peer.name}_iou'))
        columns.append(percent('difference', f'difference_to_{peer.name}', '+.2f'))
    return columns


def _with_peers(iou: float, peers: Iterable[float]) -> list[Cell]:
    return [cell for its in peers for cell in (its, iou - its)]


def _convention_table(scores: Sequence[MethodScore], convention: Convention) -> Table:
    ours, *peers = scores
    rows = []
    for sequence in (*ours.sequences, None):
        found, *its = (score.of(sequence).pooled(convention.key) for score in scores)
        row: list[Cell] = [sequence or ALL, len(ours.of(sequence).scans)]
        row += [getattr(found, name) for name in RATIOS]
        rows.append([*row, *_with_peers(found.iou, (one.iou for one in its))])
    columns = [Column('sequence'), Column('frames', 'd')]
    columns += [percent(RATIO_TITLES.get(name, name), name) for name in RATIOS]
    title = f'{convention.title} convention: {convention.rule}  [%]'
    return Table([*columns, *_peer_columns(peers)], rows, title, n_sums=1)


def _ring_table(scores: Sequence[MethodScore]) -> Table:
    columns = [Column('range'), Column('points', '_d'), Column('errors', '_d')]
    columns += [percent('of errors', 'share_of_errors'), percent('precision'), percent('recall')]
    n_errors = scores[0].confusion.errors
    rows = [
        [title, ring.points, ring.errors, ratio(ring.errors, n_errors), ring.precision,
         ring.recall, ring.iou, *_with_peers(ring.iou, (one.iou for one in its))]
        for title, ring, *its in zip(RING_TITLES, *(s.rings for s in scores), strict=True)
    ]  # fmt: skip
    columns = [*columns, percent('IoU', 'iou'), *_peer_columns(scores[1:])]
    return Table(columns, rows, 'Horizontal range (GroundGrid convention)  [%]')


def _class_table(score: MethodScore) -> Table:
    """Classes by what they count as, and in that by their number of errors."""
    found = class_errors(score.classes)
    n_errors = score.confusion.errors
    n_points = sum(one.n_points for one in found)
    rows: list[list[Cell]] = [
        [
            class_name(one.number),
            COUNTS_AS[one.truth],
            one.n_points,
            one.n_points / n_points,
            one.n_ground / one.n_points,
            one.missed / one.n_points if one.truth is Label.GROUND else None,
            one.false / one.n_points if one.truth is Label.OBSTACLE else None,
            None if one.truth is Label.UNKNOWN else ratio(one.errors, n_errors),
        ]
        for one in sorted(found, key=lambda one: list(COUNTS_AS).index(one.truth))
    ]
    columns = [Column('class'), Column('counts as', key='counts_as'), Column('points', '_d')]
    columns += [percent('of points', 'share_of_points'), percent('as ground', 'share_as_ground')]
    columns += [percent('missed'), percent('false'), percent('of errors', 'share_of_errors')]
    title = (
        'Classes (GroundGrid convention): share of all points; of the class, what was labelled '
        'ground, what is missed ground and what is false ground; share of all errors  [%]'
    )
    return Table(columns, rows, title)


def _calibration_table(score: MethodScore) -> Table | None:
    """Errors of the probabilities by sequence and pooled; None if there are none."""
    rows: list[list[Cell]] = []
    for sequence in (*score.sequences, None):
        found = score.of(sequence).calibration
        if found is None:
            return None
        best = found.confusion_at(found.best_step).iou if found.n_total else None
        threshold = float(THRESHOLDS[found.best_step]) if found.n_total else None
        iou = score.of(sequence).iou
        cells = [found.n_total, found.ece, found.brier, iou, best, threshold]
        rows.append([sequence or ALL, *cells])
    columns = [Column('sequence'), Column('points', '_d'), Column('ECE', '.4f', 'ece')]
    columns += [Column('Brier', '.4f', 'brier'), percent('IoU of labels', 'iou')]
    columns += [percent('best IoU', 'best_iou'), Column('at p_ground', '.3f', 'best_threshold')]
    title = (
        f'Probabilities (GroundGrid convention): expected calibration error over {N_BINS} bins, '
        'Brier score; IoU [%] of the labels, and if ground were all points from the best '
        'threshold on'
    )
    return Table(columns, rows, title, n_sums=1)


def _time_table(scores: Sequence[MethodScore]) -> Table:
    ours = scores[0].seconds()
    rows: list[list[Cell]] = [
        [one.title, one.seconds(), one.seconds(statistics.fmean), ours / one.seconds()]
        for one in scores
    ]
    columns = [Column('method'), milliseconds('median'), milliseconds('mean')]
    columns.append(Column('ours / this', '.2f', 'ratio'))
    stages = ', '.join(f'{name} {1e3 * s:.1f}' for name, s in scores[0].median_stages.items())
    return Table(columns, rows, 'Time per frame, reading left out  [ms]', [f'stages: {stages}'])


def reliability_table(score: MethodScore) -> Table:
    """Share of ground and mean probability in each bin of probability, by sequence and pooled."""
    rows: list[list[Cell]] = []
    for sequence in (*score.sequences, None):
        if (found := score.of(sequence).calibration) is not None:
            bins = (
                BIN_EDGES[:-1],
                BIN_EDGES[1:],
                found.n_points,
                found.mean_p,
                found.share_ground,
            )
            columns = (one.tolist() for one in bins)
            rows += [[sequence or ALL, *cells] for cells in zip(*columns, strict=True)]
    names = ('sequence', 'from', 'to', 'points', 'mean_p', 'share_ground')
    return Table([Column(name) for name in names], rows)


def frame_table(scores: Sequence[MethodScore]) -> Table:
    """One row for each frame of each method; what only some methods tell is empty for others."""
    rows: list[dict[str, Cell]] = []
    for score in scores:
        for scan in score.scans:
            row: dict[str, Cell] = {'method': score.name, 'sequence': scan.sequence}
            row['frame'] = scan.index
            row['points'] = sum(count.n_points for count in scan.classes.values())
            for key, confusion in scan.confusions.items():
                for name in ('tp', 'fp', 'fn', 'tn', *RATIOS):
                    row[f'{key}_{name}'] = getattr(confusion, name)
            main = next(iter(class_errors(scan.classes)), None)
            row['main_error_class'] = class_name(main.number) if main and main.errors else ''
            row['ms'] = 1e3 * scan.seconds
            if scan.fit is not None and scan.pose is not None:
                row |= {'status': scan.fit.status, 'n_segments': scan.fit.n_segments}
                row |= {'sensor_height': scan.pose.height}
                row |= {'sensor_height_estimated': 'yes' if scan.pose.height_estimated else 'no'}
                row |= {'sensor_roll': scan.pose.roll, 'sensor_pitch': scan.pose.pitch}
            rows.append(row)
    names = list(dict.fromkeys(name for row in rows for name in row))
    return Table([Column(name) for name in names], [[row.get(n) for n in names] for row in rows])
