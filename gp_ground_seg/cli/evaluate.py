"""``evaluate``: score the segmentation against labels; what `bench` and `experiment` share."""

from __future__ import annotations

import argparse
import itertools
import math
import statistics
from collections.abc import Sequence
from contextlib import ExitStack, closing
from typing import Any

from gp_ground_seg.cli import options
from gp_ground_seg.core.frame import Label
from gp_ground_seg.data.files import as_path
from gp_ground_seg.data.semantic_kitti import Frame, labelled_frames
from gp_ground_seg.lab.experiments.variants import make_report
from gp_ground_seg.lab.scoring import evaluate as methods
from gp_ground_seg.lab.scoring import metrics
from gp_ground_seg.lab.scoring import report as tables
from gp_ground_seg.lab.scoring.evaluate import PATCHWORKPP, MethodScore
from gp_ground_seg.lab.scoring.intervals import INTERVAL, Sums, interval_note, interval_text
from gp_ground_seg.lab.scoring.object_table import object_table
from gp_ground_seg.lab.scoring.patchworkpp import PatchworkppMethod
from gp_ground_seg.lab.scoring.report import Cell, Column, Table, percent

DESCRIPTION = """\
Segment labelled frames and score the labels in both conventions of the field: precision,
recall, F1, accuracy, IoU, time per frame. Count vehicles, persons and cyclists that are
lost: the share of their returns from 0.3 m above the local ground that is labelled ground,
and the objects with more than half of these returns labelled ground. Objects are the
instances of the labels (their upper 16 bits).

Patchwork++ (--peer patchworkpp) has its published parameters. If you give the height or the
place of the sensor (sensor.height, sensor.origin_x, ...), it gets them too.
"""
EXAMPLES = """\
  gp-ground-seg evaluate KITTI_ROOT
  gp-ground-seg evaluate KITTI_ROOT --sequences 00,08 --json scores.json
  gp-ground-seg evaluate KITTI_ROOT --set label.ground_tolerance=0.15
  gp-ground-seg evaluate KITTI_ROOT --peer patchworkpp
  gp-ground-seg evaluate KITTI_ROOT --worst 9 --per-frame frames.csv
  gp-ground-seg evaluate s3://bucket/kitti --workers 8

KITTI_ROOT holds sequences/00/{velodyne/*.bin,labels/*.label} (SemanticKITTI). With --workers
the scores are the same; the times are not, because frames are computed at the same time.
"""

ROOT = ('root', 'folder in SemanticKITTI layout', {'metavar': 'ROOT'})
OF_FRAMES = (
    ('--sequences', 'sequences, as in 00,08 (default: all)', {'metavar': 'LIST'}),
    ('--frame-step', 'every Nth frame of a sequence only', options.NUMBER),
    *options.SCAN_LAYOUT,
)
COUNTS_AS = {Label.GROUND: 'ground', Label.OBSTACLE: 'obstacle', Label.UNKNOWN: 'left out'}
RATIO_TITLES = {'f1': 'F1', 'iou': 'IoU'}


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Declare the command."""
    parser = options.new_parser(subparsers, 'evaluate', DESCRIPTION, EXAMPLES)
    options.add(
        parser,
        ROOT,
        *OF_FRAMES,
        ('--per-frame', 'write the numbers of each frame (.csv, .parquet)', {'metavar': 'FILE'}),
        ('--worst', 'list the N frames with the lowest IoU', options.NUMBER),
        ('--peer', 'run this method on the same frames, alternately', {'choices': [PATCHWORKPP]}),
        options.MARKDOWN,
        options.TO_JSON,
        options.FORCE,
    )  # fmt: skip
    options.add_cluster(parser)
    options.add_config(parser)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Evaluate, write the files, print the tables."""
    config = options.read_config(arguments)
    files = {'json': 'every number', 'per_frame': 'each frame'}
    if arguments.per_frame is not None:
        tables.check_rows_file(arguments.per_frame)
    with options.staged_options(arguments, *files) as parts, ExitStack() as stack:
        items = frames_from_options(arguments)
        chosen: list[methods.Method] = [stack.enter_context(closing(methods.OurMethod(config)))]
        if arguments.peer is not None:
            chosen.append(PatchworkppMethod.of_sensor(config.sensor))
        runner = stack.enter_context(options.runner(arguments, 'evaluate'))
        scores = methods.score_methods(items, methods.load_kitti, chosen, runner=runner)
        report = make_report(
            score_tables(scores, arguments.worst, runner.n_workers), scores, config,
            data=arguments.root, reliability=reliability_rows(scores[0]),
            stages={score.name: score.median_stages for score in scores},
        )  # fmt: skip
        environment = tables.describe_environment(*(['pypatchworkpp'] if arguments.peer else []))
        environment['n_workers'] = runner.n_workers
        if 'json' in parts:
            report.write(parts['json'], environment)
        if 'per_frame' in parts:
            tables.write_rows(report.rows, parts['per_frame'])
    print(f'{_headline(scores)}\n')
    lines = [tables.parameters_line(report.facts['config_changes'])]
    lines.append(tables.machine_line(environment, report.fit))
    print(tables.written(report.tables.values(), lines, markdown=arguments.markdown))
    for name in parts:
        print(f'{files[name]}: {getattr(arguments, name)}')
    return 0


def _headline(scores: Sequence[MethodScore]) -> str:
    ious = [f'{one.title} {100.0 * one.iou:.2f} %' for one in scores]
    times = [f'{one.title} {1e3 * one.seconds():.1f} ms' for one in scores]
    frames, sequences = len(scores[0].scans), len(scores[0].sequences)
    pooled = f'{options.count(frames, "frame")} of {options.count(sequences, "sequence")}'
    iou, seconds = (', '.join(own).removeprefix(methods.OURS).strip() for own in (ious, times))
    return f'IoU {iou}  (GroundGrid convention, {pooled})\n{seconds} per frame  (median)'


def score_tables(
    scores: Sequence[MethodScore], n_worst: int | None, n_workers: int = 0
) -> dict[str, Table]:
    """Tables of an evaluation by name, ours first in `scores`."""
    objects = object_table(scores, options.count(len(scores[0].sequences), 'sequence'))
    return {
        **{one.key: _convention_table(scores, one) for one in metrics.CONVENTIONS},
        **({'differences': _difference_table(*scores)} if len(scores) > 1 else {}),
        'rings': _ring_table(scores),
        'classes': _class_table(scores[0]),
        'objects': objects,
        'probabilities': _calibration_table(scores[0]),
        'heights': _height_table(scores),
        **({'worst': _worst_table(scores[0], n_worst)} if n_worst else {}),
        'times': _time_table(scores, n_workers),
    }


def _peer_columns(peers: Sequence[MethodScore]) -> list[Column]:
    columns = []
    for peer in peers:
        columns.append(percent(f'{peer.title} IoU', f'{peer.name}_iou'))
        columns.append(percent('difference', f'difference_to_{peer.name}', '+.2f'))
    return columns


def _with_peers(iou: float, peers: Sequence[metrics.Confusion]) -> list[Cell]:
    return [cell for its in peers for cell in (its.iou, iou - its.iou)]


def _convention_table(scores: Sequence[MethodScore], convention: metrics.Convention) -> Table:
    rows: list[list[Cell]] = []
    for parts in zip(*(score.by_sequence() for score in scores), strict=True):
        found, *its = (own.pooled(convention.key) for _, own in parts)
        sequence, ours = parts[0]
        ratios = [getattr(found, name) for name in metrics.RATIOS]
        rows.append([sequence, len(ours.scans), *ratios, *_with_peers(found.iou, its)])
    columns = [Column('sequence'), Column('frames', 'd')]
    columns += [percent(RATIO_TITLES.get(name, name), name) for name in metrics.RATIOS]
    title = f'{convention.title} convention: {convention.rule}  [%]'
    return Table([*columns, *_peer_columns(scores[1:])], rows, title, n_sums=1)


def _difference_table(ours: MethodScore, peer: MethodScore) -> Table:
    """Differences of the IoU over all sequences: by convention, and by range."""

    def of_convention(key: str) -> Sums:
        return lambda score: _iou_sums(score.pooled(key))

    def of_ring(k: int) -> Sums:
        return lambda score: _iou_sums(score.rings[k])

    cases = {f'all, {one.title} convention': of_convention(one.key) for one in metrics.CONVENTIONS}
    cases |= {title: of_ring(k) for k, title in enumerate(metrics.RING_TITLES)}
    rows: list[list[Cell]] = []
    for title, sums in cases.items():
        own, its = (metrics.ratio(*sums(score)) for score in (ours, peer))
        rows.append([title, own - its, interval_text(ours.parts(), peer.parts(), sums)])
    note = interval_note(options.count(len(ours.sequences), 'sequence'))
    title = f'IoU minus that of {peer.title}  [%]; {note}'
    columns = [Column('points'), percent('difference', form='+.2f'), INTERVAL]
    return Table(columns, rows, title)


def _iou_sums(found: metrics.Confusion) -> tuple[float, float]:
    return found.tp, found.tp + found.errors


def _ring_table(scores: Sequence[MethodScore]) -> Table:
    columns = [Column('range'), Column('points', '_d'), Column('errors', '_d')]
    columns += [percent('of errors', 'share_of_errors'), percent('precision'), percent('recall')]
    n_errors = scores[0].confusion.errors
    rows = [
        [title, ring.points, ring.errors, metrics.ratio(ring.errors, n_errors), ring.precision,
         ring.recall, ring.iou, *_with_peers(ring.iou, its)]
        for title, ring, *its in zip(metrics.RING_TITLES, *(s.rings for s in scores), strict=True)
    ]  # fmt: skip
    columns = [*columns, percent('IoU', 'iou'), *_peer_columns(scores[1:])]
    return Table(columns, rows, 'Horizontal range (GroundGrid convention)  [%]')


def _class_table(score: MethodScore) -> Table:
    """Classes by what they count as, and in that by their number of errors."""
    found = metrics.class_errors(score.classes)
    n_errors = score.confusion.errors
    n_points = sum(one.n_points for one in found)
    rows: list[list[Cell]] = [
        [
            metrics.class_name(one.number),
            COUNTS_AS[one.truth],
            one.n_points,
            one.n_points / n_points,
            one.n_ground / one.n_points,
            one.missed / one.n_points if one.truth is Label.GROUND else None,
            one.false / one.n_points if one.truth is Label.OBSTACLE else None,
            None if one.truth is Label.UNKNOWN else metrics.ratio(one.errors, n_errors),
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


def _calibrations(score: MethodScore) -> dict[str, metrics.Calibration]:
    """Return the sums by sequence and of all; our method has probabilities for every scan."""
    parts = score.by_sequence()
    return {name: own.calibration for name, own in parts if own.calibration is not None}


def _calibration_table(score: MethodScore) -> Table:
    """Errors of the probabilities by sequence and pooled."""
    rows: list[list[Cell]] = [
        [name, one.n_total, one.ece, one.brier] for name, one in _calibrations(score).items()
    ]
    columns = [Column('sequence'), Column('points', '_d'), Column('ECE', '.4f', 'ece')]
    title = (
        'Probabilities (GroundGrid convention): expected calibration error over '
        f'{metrics.N_BINS} bins, Brier score'
    )
    return Table([*columns, Column('Brier', '.4f', 'brier')], rows, title, n_sums=1)


def _height_table(scores: Sequence[MethodScore]) -> Table:
    """Errors of the surface under points labelled ground, by sequence and pooled."""
    rows: list[list[Cell]] = []
    for parts in zip(*(score.by_sequence() for score in scores), strict=True):
        found, *its = (own.height for _, own in parts)
        without = metrics.ratio(found.n_without_model, found.n_points + found.n_without_model)
        ours = [found.n_points, without, found.bias, found.rmse, found.median_absolute]
        rows.append([parts[0][0], *ours, *(one.rmse for one in its)])
    columns = [Column('sequence'), Column('points', '_d')]
    columns += [percent('no model', 'share_without_model'), tables.centimetres('bias')]
    columns += [tables.centimetres('RMSE', 'rmse')]
    columns += [tables.centimetres('median', 'median_absolute')]
    columns += [tables.centimetres(f'{one.title} RMSE', f'{one.name}_rmse') for one in scores[1:]]
    title = (
        'Height of the ground under returns labelled ground, those without a model left out  [cm]'
    )
    return Table(columns, rows, title, n_sums=1)


def _worst_table(score: MethodScore, n_worst: int) -> Table:
    """Frames with the lowest IoU, and the class that costs them most."""
    rows: list[list[Cell]] = []
    known = [scan for scan in score.scans if not math.isnan(scan.confusion.iou)]
    for scan in sorted(known, key=lambda scan: scan.confusion.iou)[:n_worst]:
        found, main = scan.confusion, metrics.class_errors(scan.classes)[0]
        name, share = metrics.class_name(main.number), metrics.ratio(main.errors, found.errors)
        rows.append([scan.sequence, scan.index, found.iou, found.fp, found.fn, name, share])
    columns = [Column('sequence'), Column('frame'), percent('IoU', 'iou')]
    columns += [Column('false', '_d'), Column('missed', '_d'), Column('most errors on')]
    title = 'Frames with the lowest IoU (GroundGrid convention)  [%]'
    return Table([*columns, percent('of errors', 'share_of_errors')], rows, title)


def _time_table(scores: Sequence[MethodScore], n_workers: int) -> Table:
    ours = scores[0].seconds()
    rows: list[list[Cell]] = [
        [one.title, one.seconds(), one.seconds(statistics.fmean), ours / one.seconds()]
        for one in scores
    ]
    columns = [Column('method'), tables.milliseconds('median'), tables.milliseconds('mean')]
    columns.append(Column('ours / this', '.2f', 'ratio'))
    stages = ', '.join(f'{name} {1e3 * s:.1f}' for name, s in scores[0].median_stages.items())
    beside = f', {options.count(n_workers, "worker")} beside one another' if n_workers else ''
    title = f'Time per frame, reading left out{beside}  [ms]'
    return Table(columns, rows, title, [f'stages: {stages}'])


def reliability_rows(score: MethodScore) -> list[dict[str, Any]]:
    """Share of ground and mean probability in each bin of probability, by sequence and pooled."""
    rows = []
    low, high = (metrics.BIN_EDGES[k : k + metrics.N_BINS].tolist() for k in (0, 1))
    keys = ('from', 'to', 'points', 'mean_p', 'share_ground')
    for sequence, found in _calibrations(score).items():
        bins = (found.n_points, found.by_bin(found.sum_p), found.by_bin(found.n_ground))
        for row in zip(low, high, *(values.tolist() for values in bins), strict=True):
            rows.append({'sequence': sequence, **dict(zip(keys, row, strict=True))})
    return rows


def frames_from_options(arguments: argparse.Namespace) -> list[Frame]:
    """Labelled frames of the options, grouped by sequence."""
    names = arguments.sequences
    chosen = None if names is None else [name for name in names.split(',') if name]
    root, layout = as_path(arguments.root), options.scan_layout(arguments)
    frames = labelled_frames(root, chosen, layout)
    groups = itertools.groupby(frames, key=lambda frame: frame.sequence)
    return [one for _, group in groups for one in [*group][:: arguments.frame_step or 1]]
