"""``evaluate``: score the segmentation against labels; what `bench` and `experiment` share."""

from __future__ import annotations

import argparse
import itertools
import statistics
import sys
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from functools import partial
from pathlib import Path
from typing import Any

from tqdm import tqdm

from gp_ground_seg.cli.options import (
    add_config_options,
    config_from_options,
    count,
    new_parser,
    positive,
)
from gp_ground_seg.data.atomic_output import staged_file
from gp_ground_seg.data.semantic_kitti import Frame
from gp_ground_seg.errors import DataError
from gp_ground_seg.evaluation.calibration import BIN_EDGES, N_BINS, THRESHOLDS, Calibration
from gp_ground_seg.evaluation.environment import describe_environment, parameters_line
from gp_ground_seg.evaluation.evaluate import (
    KnownScan,
    MethodScore,
    Progress,
    ScanScore,
    labelled_frames,
    load_kitti,
    score_methods,
)
from gp_ground_seg.evaluation.methods import (
    OURS,
    PATCHWORKPP,
    Method,
    OurMethod,
    PatchworkppMethod,
)
from gp_ground_seg.evaluation.metrics import (
    CONVENTIONS,
    GROUNDGRID,
    RATIOS,
    RING_TITLES,
    Convention,
    Labels,
    class_errors,
    class_name,
    ratio,
)
from gp_ground_seg.evaluation.table import Cell, Column, Table, fold, milliseconds, percent
from gp_ground_seg.experiments.variants import make_report
from gp_ground_seg.frame import Label
from gp_ground_seg.plotting.birds_eye import SheetPanel, plot_error_sheet
from gp_ground_seg.plotting.charts import plot_reliability

DESCRIPTION = (
    'Segment labelled frames and score the labels in both conventions of the field: precision, '
    'recall, F1, accuracy, IoU, time per frame.'
)
EXAMPLES = """\
  gp-ground-seg evaluate KITTI_ROOT
  gp-ground-seg evaluate KITTI_ROOT --sequences 00,08 --json scores.json
  gp-ground-seg evaluate KITTI_ROOT --set label.ground_tolerance=0.15
  gp-ground-seg evaluate KITTI_ROOT --peer patchworkpp
  gp-ground-seg evaluate KITTI_ROOT --sheet worst.png --worst 9
  gp-ground-seg evaluate KITTI_ROOT --reliability reliability.png

KITTI_ROOT holds sequences/00/{velodyne/*.bin,labels/*.label} (SemanticKITTI).
"""

FRAME_OPTIONS: dict[str, dict[str, Any]] = {
    'sequences': {'metavar': 'LIST', 'help': 'sequences, as in 00,08 (default: all there are)'},
    'frame_step': {
        'metavar': 'N', 'type': positive, 'help': 'every Nth frame of a sequence only'
    },
}  # fmt: skip
N_WORST, MAX_WORST = 6, 60
LEAST_SHARE = 0.01
"""Classes with a smaller share of the errors of a frame are not named on the sheet."""
COUNTS_AS = {Label.GROUND: 'ground', Label.OBSTACLE: 'obstacle', Label.UNKNOWN: 'left out'}
RATIO_TITLES = {'f1': 'F1', 'iou': 'IoU'}

Scored = tuple[KnownScan, ScanScore, Labels]


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Declare the command."""
    parser = new_parser(subparsers, 'evaluate', DESCRIPTION, EXAMPLES)
    parser.add_argument('root', metavar='ROOT', help='folder in SemanticKITTI layout')
    for name, options in FRAME_OPTIONS.items():
        parser.add_argument(f'--{name.replace("_", "-")}', **options)
    for name, what in (
        ('--sheet', 'draw the worst frames from above, errors coloured (PNG)'),
        ('--reliability', 'draw share of ground over p_ground (PNG)'),
    ):
        parser.add_argument(name, metavar='FILE', help=what)
    parser.add_argument(
        '--worst', metavar='N', type=positive,
        help=f'frames on the sheet (default: {N_WORST}, at most {MAX_WORST})',
    )  # fmt: skip
    parser.add_argument(
        '--peer', choices=(PATCHWORKPP,), help='run this one on the same frames, alternately'
    )
    add_json_options(parser)
    add_config_options(parser)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Evaluate, write the files, print the tables."""
    config = config_from_options(arguments)
    if arguments.worst is not None and arguments.sheet is None:
        raise DataError('--worst: is for --sheet only')
    n_worst = arguments.worst or N_WORST
    if n_worst > MAX_WORST:
        raise DataError(f'--worst {n_worst}: must be at most {MAX_WORST}')
    worst: list[Scored] = []

    def keep_worst(method: str, scan: KnownScan, score: ScanScore, label: Labels) -> None:
        if method == OURS and score.confusion.tp + score.confusion.errors:
            worst.append((scan, score, label))
            worst.sort(key=lambda one: one[1].confusion.iou)
            del worst[n_worst:]

    files = {
        'json': 'every number', 'sheet': 'worst frames', 'reliability': 'reliability diagram',
    }  # fmt: skip
    with staged_options(arguments, *files) as parts, ExitStack() as stack:
        frames = frames_from_options(arguments)
        methods: list[Method] = [stack.enter_context(closing(OurMethod(config)))]
        if arguments.peer is not None:
            methods.append(PatchworkppMethod())
        scores = score_methods(
            frames, load_kitti, methods,
            observe=keep_worst if 'sheet' in parts else None, progress=progress('evaluate'),
        )  # fmt: skip
        report = make_report(
            score_tables(scores), scores, config,
            data=arguments.root, reliability=reliability_rows(scores[0]),
            stages={score.name: score.median_stages for score in scores},
        )  # fmt: skip
        environment = describe_environment(*(['pypatchworkpp'] if arguments.peer else []))
        if 'json' in parts:
            report.write(parts['json'], environment)
        if 'sheet' in parts:
            _draw_sheet(worst, len(frames), parts['sheet'])
        if 'reliability' in parts:
            _draw_reliability(scores[0], parts['reliability'])
    print('\n\n'.join([_headline(scores), *(table.text() for table in report.tables.values())]))
    print(f'\n{fold(parameters_line(report.facts["config_changes"]))}')
    print(fold(environment.machine(report.fit.n_threads, report.fit.backend)))
    for name in parts:
        print(f'{files[name]}: {getattr(arguments, name)}')
    return 0


def _headline(scores: Sequence[MethodScore]) -> str:
    ious = [f'{one.title} {100.0 * one.iou:.2f} %' for one in scores]
    times = [f'{one.title} {1e3 * one.seconds():.1f} ms' for one in scores]
    frames, sequences = len(scores[0].scans), len(scores[0].sequences)
    pooled = f'{count(frames, "frame")} of {count(sequences, "sequence")}'
    return (
        f'IoU {", ".join(ious).removeprefix(OURS).strip()}  (GroundGrid convention, {pooled})\n'
        f'{", ".join(times).removeprefix(OURS).strip()} per frame  (median)'
    )


def score_tables(scores: Sequence[MethodScore]) -> dict[str, Table]:
    """Tables of an evaluation by name, ours first in `scores`."""
    return {
        **{one.key: _convention_table(scores, one) for one in CONVENTIONS},
        'rings': _ring_table(scores),
        'classes': _class_table(scores[0]),
        'probabilities': _calibration_table(scores[0]),
        'times': _time_table(scores),
    }


def _peer_columns(peers: Sequence[MethodScore]) -> list[Column]:
    columns = []
    for peer in peers:
        columns.append(percent(f'{peer.title} IoU', f'{peer.name}_iou'))
        columns.append(percent('difference', f'difference_to_{peer.name}', '+.2f'))
    return columns


def _with_peers(iou: float, peers: Iterator[float]) -> list[Cell]:
    return [cell for its in peers for cell in (its, iou - its)]


def _convention_table(scores: Sequence[MethodScore], convention: Convention) -> Table:
    rows = []
    for parts in zip(*(score.by_sequence() for score in scores), strict=True):
        found, *its = (own.pooled(convention.key) for _, own in parts)
        sequence, ours = parts[0]
        row: list[Cell] = [sequence, len(ours.scans)]
        row += [getattr(found, name) for name in RATIOS]
        rows.append([*row, *_with_peers(found.iou, (one.iou for one in its))])
    columns = [Column('sequence'), Column('frames', 'd')]
    columns += [percent(RATIO_TITLES.get(name, name), name) for name in RATIOS]
    title = f'{convention.title} convention: {convention.rule}  [%]'
    return Table([*columns, *_peer_columns(scores[1:])], rows, title, n_sums=1)


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


def _calibration_table(score: MethodScore) -> Table:
    """Errors of the probabilities by sequence and pooled."""
    rows: list[list[Cell]] = []
    for sequence, own in score.by_sequence():
        found = _calibration(own)
        best = found.confusion_at(found.best_step).iou if found.n_total else None
        threshold = float(THRESHOLDS[found.best_step]) if found.n_total else None
        cells = [found.n_total, found.ece, found.brier, own.iou, best, threshold]
        rows.append([sequence, *cells])
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


def _calibration(score: MethodScore) -> Calibration:
    assert score.calibration is not None, 'our method has probabilities'
    return score.calibration


def reliability_rows(score: MethodScore) -> list[dict[str, Any]]:
    """Share of ground and mean probability in each bin of probability, by sequence and pooled."""
    rows = []
    for sequence, own in score.by_sequence():
        found = _calibration(own)
        bins = zip(itertools.pairwise(BIN_EDGES.tolist()), found.n_points.tolist(),
                   found.mean_p.tolist(), found.share_ground.tolist(), strict=True)  # fmt: skip
        for (low, high), n, mean, share in bins:
            row = {'sequence': sequence, 'from': low, 'to': high, 'points': n}
            rows.append({**row, 'mean_p': mean, 'share_ground': share})
    return rows


def _draw_sheet(worst: Sequence[Scored], n_frames: int, path: Path) -> None:
    """Draw frames with their errors."""
    if not worst:
        raise DataError(f'no sheet of worst frames: nothing to score in {n_frames} frames')
    panels = []
    for scan, score, label in worst:
        confusion = score.confusion
        # The classes with most errors, as in ``missed terrain 68 %, false building 16 %``.
        causes = ', '.join(
            f'{"missed" if one.missed else "false"} {class_name(one.number)} '
            f'{one.errors / confusion.errors:.0%}'
            for one in class_errors(score.classes)[:3]
            if one.errors > LEAST_SHARE * confusion.errors
        )
        errors = f'{confusion.fp} false, {confusion.fn} missed: {causes}'
        title = f'{scan.sequence} / {scan.index}    IoU {100.0 * confusion.iou:.2f} %'
        subtitle = errors if confusion.errors else 'no errors'
        truth = scan.truths[GROUNDGRID.key]
        panels.append(SheetPanel(title, subtitle, scan.points, label, truth))
    title = f'Worst {len(worst)} of {n_frames} frames, GroundGrid convention; x up, y left [m]'
    plot_error_sheet(panels, path, title)


def _draw_reliability(score: MethodScore, path: Path) -> None:
    sequences = {name: _calibration(score.of(name)) for name in score.sequences}
    title = f'Reliability, {len(score.scans)} frames'
    plot_reliability(_calibration(score), sequences, path, title)


# What `experiment` and `bench` share with this command.


def add_json_options(parser: argparse.ArgumentParser) -> None:
    """Add ``--json FILE`` and ``--force``."""
    parser.add_argument('--json', metavar='FILE', help='write every number to this file as well')
    parser.add_argument('--force', action='store_true', help='overwrite the files written')


def frames_from_options(arguments: argparse.Namespace) -> list[Frame]:
    """Labelled frames of the options, grouped by sequence; errors as `labelled_frames`."""
    names = arguments.sequences
    chosen = None if names is None else [name for name in names.split(',') if name]
    frames = labelled_frames(arguments.root, chosen)
    groups = itertools.groupby(frames, key=lambda frame: frame.sequence)
    return [one for _, group in groups for one in [*group][:: arguments.frame_step or 1]]


@contextmanager
def staged_options(arguments: argparse.Namespace, *names: str) -> Iterator[dict[str, Path]]:
    """Yield a path to write for each of the options `names` that is given.

    The files take their names when the block ends well; DataError if one cannot be written.
    """
    with ExitStack() as stack:
        yield {
            name: stack.enter_context(staged_file(path, force=arguments.force))
            for name in names
            if (path := getattr(arguments, name)) is not None
        }


def progress(title: str, unit: str = 'frame') -> Progress:
    """Wrap items in a progress bar on standard error, if that is a terminal."""
    return partial(tqdm, unit=unit, desc=title, file=sys.stderr, disable=None, leave=False)
