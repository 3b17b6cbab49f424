"""``ablation``: what the length-scale model and the learning are worth."""

from __future__ import annotations

import argparse
import dataclasses
import shlex
import sys
from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack
from typing import Any, TypeVar

from tqdm import tqdm

from gp_ground_seg.cli.ablation_report import (
    frames_data,
    frames_table,
    frames_title,
    synthetic_data,
    synthetic_table,
    synthetic_title,
)
from gp_ground_seg.cli.experiment_text import config_words, machine_text, markdown_table, wrapped
from gp_ground_seg.cli.options import add_config_options, config_from_options
from gp_ground_seg.cli.tables import format_table
from gp_ground_seg.data.atomic_output import staged_file
from gp_ground_seg.data.semantic_kitti import Frame
from gp_ground_seg.errors import DataError
from gp_ground_seg.evaluation.environment import describe_environment
from gp_ground_seg.evaluation.evaluate import labelled_frames
from gp_ground_seg.evaluation.report import changed_parameters, write_json
from gp_ground_seg.experiments.ablation import METHODS, ablate
from gp_ground_seg.experiments.ablation_synthetic import METHODS as SYNTHETIC_METHODS
from gp_ground_seg.experiments.ablation_synthetic import ablate_synthetic
from gp_ground_seg.parameters.config import Config
from gp_ground_seg.result import FitReport

DESCRIPTION = """\
Compare length-scale models and ways to learn on the same data.

On labelled frames (ROOT): a constant length-scale, the lines' gradients (Z), and
the latent process (Z-L), each without and with learning over the whole frame, Z-L
also with learning in each segment alone. IoU is that of the GroundGrid convention.
Height errors are those of the surface under all points labelled ground that have a
model: root mean square (RMSE), the median over the frames of the median distance,
and the standardised mean squared error (SMSE), the squares summed over all frames
over those of the heights about each frame's mean.

With --synthetic: simulated scans of a smooth road that ends in rubble, height
errors against the exact ground, on the road and in the rubble.
"""

EXAMPLES = """\
examples:
  gp-ground-seg ablation KITTI_ROOT
  gp-ground-seg ablation KITTI_ROOT --sequences 03,10 --frame-step 5 --json ablation.json
  gp-ground-seg ablation --synthetic --markdown synthetic.md
"""

_Item = TypeVar('_Item')


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Declare the command."""
    parser = subparsers.add_parser(
        'ablation',
        description=DESCRIPTION,
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument('root', metavar='ROOT', nargs='?', help='folder in SemanticKITTI layout')
    parser.add_argument('--synthetic', action='store_true', help='simulated scans instead')
    parser.add_argument(
        '--sequences', metavar='LIST', help='sequences, as in 00,08 (default: all there are)'
    )
    parser.add_argument(
        '--frame-step', metavar='N', type=_positive, help='every Nth frame of a sequence only'
    )
    parser.add_argument(
        '--seeds', metavar='N', type=_positive, help='simulated scenes (default: 10)'
    )
    parser.add_argument('--json', metavar='FILE', help='write every number to this file as well')
    parser.add_argument('--markdown', metavar='FILE', help='write the table to this file as well')
    parser.add_argument('--force', action='store_true', help='overwrite these files')
    add_config_options(parser)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Measure, write the files, print the table."""
    config = config_from_options(arguments)
    _check(arguments)
    with ExitStack() as stack:
        # Around the measurement: a target that is refused is so before the work.
        targets = {
            name: stack.enter_context(staged_file(path, force=arguments.force))
            for name in ('json', 'markdown')
            if (path := getattr(arguments, name)) is not None
        }
        if arguments.synthetic:
            synthetic = ablate_synthetic(
                arguments.seeds or 10, SYNTHETIC_METHODS, config, progress=_progress_bar('scan')
            )
            header, rows = synthetic_table(synthetic)
            title = synthetic_title(synthetic)
            fit, methods = synthetic[-1].fit, {r.title: synthetic_data(r) for r in synthetic}
        else:
            results = ablate(_frames(arguments), METHODS, config, progress=_progress_bar('frame'))
            header, rows = frames_table(results)
            title = frames_title(results)
            fit, methods = results[-1].fit, {r.title: frames_data(r) for r in results}
        machine = machine_text(describe_environment(), fit.n_threads, fit.backend)
        if 'json' in targets:
            write_json(_document(arguments, config, fit, methods), targets['json'])
        if 'markdown' in targets:
            text = (
                f'`{_command(arguments)}`\n\n{title}\n\n{markdown_table(header, rows)}\n\n'
                f'machine: {machine}\n'
            )
            targets['markdown'].write_text(text, encoding='utf-8')
    print(f'{wrapped(title)}\n{format_table(header, rows)}\n\n{wrapped(f"machine: {machine}")}')
    for name in targets:
        print(f'written: {getattr(arguments, name)}')
    return 0


def _check(arguments: argparse.Namespace) -> None:
    """Refuse options that contradict one another."""
    if arguments.synthetic == (arguments.root is not None):
        raise DataError('ablation: give either ROOT or --synthetic')
    own = ('seeds',) if not arguments.synthetic else ('sequences', 'frame_step')
    for name in own:
        if getattr(arguments, name) is not None:
            kind = 'labelled frames' if arguments.synthetic else '--synthetic'
            raise DataError(f'--{name.replace("_", "-")}: is for {kind} only')


def _positive(word: str) -> int:
    number = int(word) if word.isdecimal() else 0
    if number < 1:
        raise argparse.ArgumentTypeError(f'{word!r}: must be a whole number, at least 1')
    return number


def _frames(arguments: argparse.Namespace) -> list[Frame]:
    sequences = None
    if arguments.sequences is not None:
        sequences = [name for name in arguments.sequences.split(',') if name]
    frames = labelled_frames(arguments.root, sequences)
    grouped: dict[str, list[Frame]] = {}
    for frame in frames:
        grouped.setdefault(frame.sequence, []).append(frame)
    step = arguments.frame_step or 1
    return [frame for group in grouped.values() for frame in group[::step]]


def _progress_bar(unit: str) -> Callable[[Sequence[_Item]], Iterable[_Item]]:
    def bar(items: Sequence[_Item]) -> Iterable[_Item]:
        # `disable=None`: no bar where standard error is not a terminal.
        shown: Iterable[_Item] = tqdm(
            items, unit=unit, desc='ablation', file=sys.stderr, disable=None, leave=False
        )
        return shown

    return bar


def _command(arguments: argparse.Namespace) -> str:
    words = ['gp-ground-seg', 'ablation']
    words.append('--synthetic' if arguments.synthetic else 'KITTI_ROOT')
    for name in ('sequences', 'frame_step', 'seeds'):
        if (value := getattr(arguments, name)) is not None:
            words += [f'--{name.replace("_", "-")}', str(value)]
    return shlex.join([*words, *config_words(arguments)])


def _document(
    arguments: argparse.Namespace, config: Config, fit: FitReport, methods: dict[str, Any]
) -> dict[str, Any]:
    return {
        'command': _command(arguments),
        'data': 'simulator' if arguments.synthetic else arguments.root,
        'config_changes': changed_parameters(config),
        'config': config.nested(),
        'method_changes': SYNTHETIC_METHODS if arguments.synthetic else METHODS,
        'n_threads': fit.n_threads,
        'backend': fit.backend,
        'environment': dataclasses.asdict(describe_environment()),
        'methods': methods,
    }
