"""``evaluate``: score the segmentation against labels."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterable, Sequence
from typing import Any

from tqdm import tqdm

from gp_ground_seg.cli.evaluation_text import evaluation_text
from gp_ground_seg.cli.options import add_config_options, config_from_options
from gp_ground_seg.config import Config
from gp_ground_seg.datasets.semantic_kitti import Frame
from gp_ground_seg.datasets.staging import staged_file
from gp_ground_seg.evaluation.environment import describe_environment
from gp_ground_seg.evaluation.evaluate import evaluate, labelled_frames
from gp_ground_seg.evaluation.methods import PATCHWORKPP, Method, OurMethod, PatchworkppMethod
from gp_ground_seg.evaluation.report import report, write_json
from gp_ground_seg.evaluation.scores import MethodScore

EXAMPLES = """\
examples:
  gp-ground-seg evaluate KITTI_ROOT
  gp-ground-seg evaluate KITTI_ROOT --sequences 00,08 --json scores.json
  gp-ground-seg evaluate KITTI_ROOT --set label.ground_tolerance=0.15
  gp-ground-seg evaluate KITTI_ROOT --peer patchworkpp

KITTI_ROOT holds sequences/00/{velodyne/*.bin,labels/*.label} (SemanticKITTI).
"""


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Declare the command."""
    parser = subparsers.add_parser(
        'evaluate',
        help='score against SemanticKITTI labels',
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
    parser.add_argument('--force', action='store_true', help='overwrite the JSON file')
    parser.add_argument(
        '--peer', choices=(PATCHWORKPP,), help='run this one on the same frames, alternately'
    )
    add_config_options(parser)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Evaluate, write the JSON, print the tables."""
    config = config_from_options(arguments)
    if arguments.json is None:
        scores, document = _measure(arguments, config)
    else:
        # Around the measurement: a target that is refused is so before the work.
        with staged_file(arguments.json, force=arguments.force) as part:
            scores, document = _measure(arguments, config)
            write_json(document, part)
    print(evaluation_text(scores, document))
    if arguments.json is not None:
        print(f'\nevery number: {arguments.json}')
    return 0


def _measure(
    arguments: argparse.Namespace, config: Config
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
        scores = evaluate(frames, methods, progress=_progress_bar)
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
