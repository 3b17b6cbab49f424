"""``evaluate``: score the segmentation against labels."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from tqdm import tqdm

from gp_ground_seg.cli.evaluation_text import evaluation_text
from gp_ground_seg.cli.options import add_config_options, config_from_options
from gp_ground_seg.cli.worst_sheet import write_worst_sheet
from gp_ground_seg.data.atomic_output import staged_file
from gp_ground_seg.data.semantic_kitti import Frame
from gp_ground_seg.errors import DataError
from gp_ground_seg.evaluation.environment import describe_environment
from gp_ground_seg.evaluation.evaluate import evaluate, labelled_frames
from gp_ground_seg.evaluation.frames_csv import write_frames_csv
from gp_ground_seg.evaluation.methods import (
    OURS,
    PATCHWORKPP,
    Method,
    OurMethod,
    PatchworkppMethod,
)
from gp_ground_seg.evaluation.report import report, write_json
from gp_ground_seg.evaluation.scores import MethodScore
from gp_ground_seg.evaluation.worst import WorstFrames
from gp_ground_seg.parameters.config import Config
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
"""What is in the file that each option asks for."""


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
    parser.add_argument(
        '--sequences', metavar='LIST', help='sequences, as in 00,08 (default: all there are)'
    )
    parser.add_argument('--json', metavar='FILE', help='write every number to this file as well')
    parser.add_argument('--frames-csv', metavar='FILE', help='write one line per frame (CSV)')
    parser.add_argument(
        '--sheet', metavar='FILE', help='draw the worst frames from above, errors coloured (PNG)'
    )
    parser.add_argument(
        '--reliability', metavar='FILE', help='draw share of ground over p_ground (PNG)'
    )
    parser.add_argument(
        '--worst',
        metavar='N',
        type=_positive,
        help=f'frames on the sheet (default: {N_WORST}, at most {MAX_WORST})',
    )
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
    with ExitStack() as stack:
        # Around the measurement: a target that is refused is so before the work.
        targets = {
            title: (path, stack.enter_context(staged_file(path, force=arguments.force)))
            for name, title in FILES.items()
            if (path := getattr(arguments, name)) is not None
        }
        worst = WorstFrames(OURS, arguments.worst or N_WORST) if arguments.sheet else None
        scores, document = _measure(arguments, config, worst)
        parts = {title: part for title, (_, part) in targets.items()}
        if FILES['json'] in parts:
            write_json(document, parts[FILES['json']])
        if FILES['frames_csv'] in parts:
            write_frames_csv(scores, parts[FILES['frames_csv']])
        if worst is not None:
            write_worst_sheet(worst.found(), len(scores[0].frames), parts[FILES['sheet']])
        if FILES['reliability'] in parts:
            _write_reliability(scores[0], parts[FILES['reliability']])
    print(evaluation_text(scores, document))
    if targets:
        print()
    for title, (path, _) in targets.items():
        print(f'{title}: {path}')
    return 0


def _write_reliability(score: MethodScore, path: Path) -> None:
    found = {name: score.calibration(name) for name in score.sequences}
    pooled = score.calibration()
    if pooled is None:
        raise DataError('--reliability: this segmentation has no probabilities')
    sequences = {name: one for name, one in found.items() if one is not None}
    plot_reliability(pooled, sequences, path, f'Reliability, {len(score.frames)} frames')


def _positive(word: str) -> int:
    number = int(word) if word.isdecimal() else 0
    if not 1 <= number <= MAX_WORST:
        raise argparse.ArgumentTypeError(f'{word!r}: must be a whole number from 1 to {MAX_WORST}')
    return number


def _measure(
    arguments: argparse.Namespace, config: Config, worst: WorstFrames | None
) -> tuple[list[MethodScore], dict[str, Any]]:
    sequences = None
    if arguments.sequences is not None:
        sequences = [name for name in arguments.sequences.split(',') if name]
    frames = labelled_frames(arguments.root, sequences)
    ours = OurMethod(config)
    methods: list[Method] = [ours]
    packages = []
    if arguments.peer == PATCHWORKPP:
        methods.append(PatchworkppMethod())
        packages.append('pypatchworkpp')
    try:
        scores = evaluate(
            frames, methods, progress=_progress_bar, observe=worst.see if worst else None
        )
        fit = ours.fit
    finally:
        ours.close()
    document = report(
        scores,
        config,
        describe_environment(*packages),
        n_threads=fit.n_threads,
        backend=fit.backend,
        data=arguments.root,
    )
    return scores, document


def _progress_bar(frames: Sequence[Frame]) -> Iterable[Frame]:
    # `disable=None`: no bar where standard error is not a terminal.
    bar: Iterable[Frame] = tqdm(
        frames, unit='frame', desc='evaluate', file=sys.stderr, disable=None, leave=False
    )
    return bar
