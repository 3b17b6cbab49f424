"""``evaluate``: score the segmentation against labels."""

from __future__ import annotations

import argparse
import dataclasses
import sys
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path
from typing import Any

from tqdm import tqdm

from gp_ground_seg.cli.options import add_config_options, config_from_options, count, positive
from gp_ground_seg.data.atomic_output import staged_file
from gp_ground_seg.data.semantic_kitti import Frame
from gp_ground_seg.errors import DataError
from gp_ground_seg.evaluation.environment import (
    changed_parameters,
    describe_environment,
    parameters_line,
)
from gp_ground_seg.evaluation.evaluate import (
    KeptScan,
    MethodScore,
    WorstFrames,
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
from gp_ground_seg.evaluation.metrics import GROUNDGRID, class_errors, class_name
from gp_ground_seg.evaluation.score_tables import frame_table, reliability_table, score_tables
from gp_ground_seg.evaluation.table import fold, write_json
from gp_ground_seg.plotting.birds_eye import SheetPanel, plot_error_sheet
from gp_ground_seg.plotting.charts import plot_reliability

EXAMPLES = """\
examples:
  gp-ground-seg evaluate KITTI_ROOT
  gp-ground-seg evaluate KITTI_ROOT --sequences 00,08 --json scores.json
  gp-ground-seg evaluate KITTI_ROOT --set label.ground_tolerance=0.15
  gp-ground-seg evaluate KITTI_ROOT --peer patchworkpp
  gp-ground-seg evaluate KITTI_ROOT --frames-csv frames.csv --sheet worst.png --worst 9
  gp-ground-seg evaluate KITTI_ROOT --reliability reliability.png

KITTI_ROOT holds sequences/00/{velodyne/*.bin,labels/*.label} (SemanticKITTI).
"""

N_WORST, MAX_WORST = 6, 60
FILES = {
    'json': 'every number',
    'frames_csv': 'one line per frame',
    'sheet': 'worst frames',
    'reliability': 'reliability diagram',
}
"""Options that write a file, and what is in it."""
LEAST_SHARE = 0.01
"""Classes with a smaller share of the errors of a frame are not named on the sheet."""


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Declare the command."""
    parser = subparsers.add_parser(
        'evaluate',
        description='Segment labelled frames and score the labels in both conventions '
        'of the field: precision, recall, F1, accuracy, IoU, time per frame.',
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument('root', metavar='ROOT', help='folder in SemanticKITTI layout')
    add_frame_options(parser)
    parser.add_argument('--json', metavar='FILE', help='write every number to this file as well')
    parser.add_argument('--frames-csv', metavar='FILE', help='write one line per frame (CSV)')
    parser.add_argument(
        '--sheet', metavar='FILE', help='draw the worst frames from above, errors coloured (PNG)'
    )
    parser.add_argument(
        '--reliability', metavar='FILE', help='draw share of ground over p_ground (PNG)'
    )
    parser.add_argument(
        '--worst', metavar='N', type=positive,
        help=f'frames on the sheet (default: {N_WORST}, at most {MAX_WORST})',
    )  # fmt: skip
    parser.add_argument('--force', action='store_true', help='overwrite the files written')
    parser.add_argument(
        '--peer', choices=(PATCHWORKPP,), help='run this one on the same frames, alternately'
    )
    add_config_options(parser)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Evaluate, write the files, print the tables."""
    config = config_from_options(arguments)
    if arguments.worst is not None and arguments.sheet is None:
        raise DataError('--worst: is for --sheet only')
    if arguments.worst is not None and arguments.worst > MAX_WORST:
        raise DataError(f'--worst {arguments.worst}: must be at most {MAX_WORST}')
    with staged_options(arguments, *FILES) as parts, ExitStack() as stack:
        frames = frames_from_options(arguments)
        ours = stack.enter_context(closing(OurMethod(config)))
        methods: list[Method] = [ours]
        if arguments.peer is not None:
            methods.append(PatchworkppMethod())
        worst = WorstFrames(OURS, arguments.worst or N_WORST)
        observe = worst.observe if 'sheet' in parts else None
        scores = score_methods(
            frames, load_kitti, methods, observe=observe, progress=progress('evaluate')
        )
        fit = scores[0].fit
        assert fit is not None
        environment = describe_environment(*(['pypatchworkpp'] if arguments.peer else []))
        changes = changed_parameters(config)
        tables = score_tables(scores)
        if 'json' in parts:
            document = {
                'data': arguments.root,
                'config_changes': changes,
                'config': config.nested(),
                'n_threads': fit.n_threads,
                'backend': fit.backend,
                'environment': dataclasses.asdict(environment),
                'stages': {score.name: score.median_stages for score in scores},
                **{name: table.json() for name, table in tables.items()},
                'reliability': reliability_table(scores[0]).json(),
                'by_frame': frame_table(scores).json(),
            }
            write_json(document, parts['json'])
        if 'frames_csv' in parts:
            parts['frames_csv'].write_text(frame_table(scores).csv(), encoding='utf-8')
        if 'sheet' in parts:
            _draw_sheet(worst.kept, len(frames), parts['sheet'])
        if 'reliability' in parts:
            _draw_reliability(scores[0], parts['reliability'])
    print('\n\n'.join([_headline(scores), *(table.text() for table in tables.values())]))
    print(f'\n{fold(parameters_line(changes))}')
    print(fold(environment.machine(fit.n_threads, fit.backend)))
    for name in parts:
        print(f'{FILES[name]}: {getattr(arguments, name)}')
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


def _draw_sheet(worst: Sequence[KeptScan], n_frames: int, path: Path) -> None:
    """Draw frames with their errors."""
    if not worst:
        raise DataError(f'no sheet of worst frames: nothing to score in {n_frames} frames')
    panels = []
    for kept in worst:
        scan, confusion = kept.scan, kept.score.confusion
        # The classes with most errors, as in ``missed terrain 68 %, false building 16 %``.
        causes = ', '.join(
            f'{"missed" if one.missed else "false"} {class_name(one.number)} '
            f'{one.errors / confusion.errors:.0%}'
            for one in class_errors(kept.score.classes)[:3]
            if one.errors > LEAST_SHARE * confusion.errors
        )
        errors = f'{confusion.fp} false, {confusion.fn} missed: {causes}'
        title = f'{scan.sequence} / {scan.index}    IoU {100.0 * confusion.iou:.2f} %'
        subtitle = errors if confusion.errors else 'no errors'
        panels.append(
            SheetPanel(title, subtitle, scan.points, kept.label, scan.truths[GROUNDGRID.key])
        )
    title = f'Worst {len(worst)} of {n_frames} frames, GroundGrid convention; x up, y left [m]'
    plot_error_sheet(panels, path, title)


def _draw_reliability(score: MethodScore, path: Path) -> None:
    pooled = score.calibration
    assert pooled is not None, 'our method has probabilities'
    found = {name: score.of(name).calibration for name in score.sequences}
    sequences = {name: one for name, one in found.items() if one is not None}
    plot_reliability(pooled, sequences, path, f'Reliability, {len(score.scans)} frames')


# What `experiment` and `bench` share with this command.


def add_frame_options(parser: argparse.ArgumentParser) -> None:
    """Add ``--sequences LIST`` and ``--frame-step N``."""
    parser.add_argument(
        '--sequences', metavar='LIST', help='sequences, as in 00,08 (default: all there are)'
    )
    parser.add_argument(
        '--frame-step', metavar='N', type=positive, help='every Nth frame of a sequence only'
    )


def frames_from_options(arguments: argparse.Namespace) -> list[Frame]:
    """Labelled frames of the options, grouped by sequence; errors as `labelled_frames`."""
    names = arguments.sequences
    chosen = None if names is None else [name for name in names.split(',') if name]
    grouped: dict[str, list[Frame]] = {}
    for frame in labelled_frames(arguments.root, chosen):
        grouped.setdefault(frame.sequence, []).append(frame)
    return [frame for group in grouped.values() for frame in group[:: arguments.frame_step or 1]]


@contextmanager
def staged_options(arguments: argparse.Namespace, *names: str) -> Iterator[dict[str, Path]]:
    """Yield a path to write for each of the options `names` that is given.

    The files take their names when the block ends well. A target that cannot be written
    is refused before the work: DataError.
    """
    with ExitStack() as stack:
        yield {
            name: stack.enter_context(staged_file(path, force=arguments.force))
            for name in names
            if (path := getattr(arguments, name)) is not None
        }


def progress(title: str, unit: str = 'frame') -> Any:
    """Wrap items in a progress bar on standard error, if that is a terminal."""

    def bar(items: Sequence[Any]) -> Iterable[Any]:
        shown: Iterable[Any] = tqdm(
            items, unit=unit, desc=title, file=sys.stderr, disable=None, leave=False
        )
        return shown

    return bar
