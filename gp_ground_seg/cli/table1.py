"""``table1``: the paper's Table I on segments of real frames."""

from __future__ import annotations

import argparse
import csv
import re
import shlex
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path

from tqdm import tqdm

from gp_ground_seg.cli.experiment_text import config_words, machine_text, markdown_table, wrapped
from gp_ground_seg.cli.options import add_config_options, config_from_options
from gp_ground_seg.cli.tables import format_table
from gp_ground_seg.data.atomic_output import staged_files
from gp_ground_seg.data.semantic_kitti import Frame
from gp_ground_seg.evaluation.environment import describe_environment
from gp_ground_seg.experiments.table1 import DEFAULT_CHOICES, MODELS, Choice, Row, Table1, table1
from gp_ground_seg.parameters.config import Config

CSV_NAME, MARKDOWN_NAME = 'table1.csv', 'table1.md'

DESCRIPTION = """\
The paper's Table I: for segments of labelled frames the numbers of ground
candidates and pseudo-inputs, the variances learned over the frame by the paper's
method Z-L (latent length-scales), and the standardised mean squared error (SMSE)
and time per frame of Z-L and of Z (length-scales from the lines' gradients).

SMSE is given twice: at the inliers that the surface was made from, as the paper
seems to do, and at the points labelled ground that are not candidates, which is
what counts.
"""

EXAMPLES = """\
examples:
  gp-ground-seg table1 --kitti KITTI_ROOT
  gp-ground-seg table1 --kitti KITTI_ROOT --output results
  gp-ground-seg table1 --kitti KITTI_ROOT --frames 08/000005:151,152 05/000006

Without segments a frame gives the adjacent pair whose labelled ground varies most
in height.
"""

_VARIANCES = ('sigma_f^2', 'sigma_n^2', 'sigma_f_bar^2', 'sigma_l_bar^2', 'sigma_n_bar^2')
_CHOICE = re.compile(r'(?P<sequence>[^/:]+)/(?P<index>[^/:]+)(:(?P<segments>\d+(,\d+)*))?')


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Declare the command."""
    parser = subparsers.add_parser(
        'table1',
        description=DESCRIPTION,
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        '--kitti', metavar='ROOT', required=True, help='folder in SemanticKITTI layout'
    )
    parser.add_argument(
        '--frames',
        metavar='SEQ/IDX[:SEG,SEG]',
        nargs='+',
        type=_choice,
        default=list(DEFAULT_CHOICES),
        help=f'frames and segments (default: {" ".join(map(_choice_text, DEFAULT_CHOICES))})',
    )
    parser.add_argument(
        '--repeats', metavar='N', type=_positive, default=9, help='timed runs of each (default: 9)'
    )
    parser.add_argument(
        '--output', metavar='DIR', help=f'write {CSV_NAME} and {MARKDOWN_NAME} to this folder'
    )
    parser.add_argument('--force', action='store_true', help='overwrite them')
    add_config_options(parser)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Measure, write the files, print the table."""
    config = config_from_options(arguments)
    if arguments.output is None:
        table = _measure(arguments, config)
    else:
        with staged_files(
            arguments.output, (CSV_NAME, MARKDOWN_NAME), force=arguments.force
        ) as folder:
            table = _measure(arguments, config)
            _write_csv(table, folder / CSV_NAME)
            text = _markdown(table, arguments)
            (folder / MARKDOWN_NAME).write_text(text, encoding='utf-8')
    print(_text(table, arguments))
    if arguments.output is not None:
        target = Path(arguments.output)
        print(f'\nwritten: {target / CSV_NAME}, {target / MARKDOWN_NAME}')
    return 0


def _choice(word: str) -> Choice:
    match = _CHOICE.fullmatch(word)
    if match is None:
        raise argparse.ArgumentTypeError(f'{word!r}: must be as in 08/000005 or 08/000005:151,152')
    segments = match['segments'].split(',') if match['segments'] else []
    return Choice(match['sequence'], match['index'], tuple(int(segment) for segment in segments))


def _choice_text(choice: Choice) -> str:
    segments = ','.join(str(segment) for segment in choice.segments)
    return f'{choice.sequence}/{choice.index}' + (f':{segments}' if segments else '')


def _positive(word: str) -> int:
    number = int(word) if word.isdecimal() else 0
    if number < 1:
        raise argparse.ArgumentTypeError(f'{word!r}: must be a whole number, at least 1')
    return number


def _measure(arguments: argparse.Namespace, config: Config) -> Table1:
    return table1(
        arguments.kitti, arguments.frames, config, arguments.repeats, progress=_progress_bar
    )


def _progress_bar(frames: Sequence[Frame]) -> Iterable[Frame]:
    # `disable=None`: no bar where standard error is not a terminal.
    bar: Iterable[Frame] = tqdm(
        frames, unit='frame', desc='table1', file=sys.stderr, disable=None, leave=False
    )
    return bar


def _place(row: Row) -> str:
    return f'{row.frame.sequence}/{row.frame.index}:{row.segment}'


def _per_method(row: Row, *names: str, form: str) -> list[str]:
    """Cells of attributes of both methods, attribute by attribute."""
    return [
        format(getattr(row.methods[method], name), form) for name in names for method in MODELS
    ]


def _text(table: Table1, arguments: argparse.Namespace) -> str:
    variances = [
        [_place(row), f'{row.n_candidates}/{row.n_pseudo_inputs}', *_variance_cells(row)]
        for row in table.rows
    ]
    errors = [
        [
            _place(row),
            *_per_method(row, 'n_inliers', form='d'),
            *_per_method(row, 'smse_in_sample', form='#.4g'),
            str(row.n_held_out),
            *_per_method(row, 'smse_held_out', form='#.4g'),
            *_per_method(row, 'seconds', form='.4f'),
        ]
        for row in table.rows
    ]
    error_header = ['segment', 'inlier Z-L', 'Z', 'SMSE Z-L', 'Z', 'held out', 'SMSE Z-L', 'Z']
    return '\n\n'.join(
        (
            'Variances learned over the frame by Z-L  [m^2; of f_bar and n_bar without unit]\n'
            + format_table(['segment', 'n_PG/n_L', *_VARIANCES], variances),
            'SMSE at the inliers, and at held-out points labelled ground; seconds per frame\n'
            + format_table([*error_header, 't Z-L [s]', 't Z [s]'], errors),
            f'{_timing_note(arguments)}\n{wrapped(_machine(table))}',
        )
    )


def _variance_cells(row: Row) -> list[str]:
    return [f'{value:#.4g}' for value in row.methods['Z-L'].variances]


def _timing_note(arguments: argparse.Namespace) -> str:
    return f'times: median of {arguments.repeats} runs on the whole frame, reading left out'


def _machine(table: Table1) -> str:
    fit = table.fit
    return f'machine: {machine_text(describe_environment(), fit.n_threads, fit.backend)}'


def _markdown(table: Table1, arguments: argparse.Namespace) -> str:
    words = ['gp-ground-seg', 'table1', '--kitti', 'KITTI_ROOT']
    if arguments.frames != list(DEFAULT_CHOICES):
        words += ['--frames', *map(_choice_text, arguments.frames)]
    command = shlex.join([*words, *config_words(arguments)])
    header = ['segment', 'n_PG / n_L', *_VARIANCES]
    header += ['SMSE Z-L, in sample', 'SMSE Z, in sample']
    header += ['SMSE Z-L, held out', 'SMSE Z, held out', 't Z-L [s]', 't Z [s]']
    rows = [
        [
            _place(row),
            f'{row.n_candidates} / {row.n_pseudo_inputs}',
            *_variance_cells(row),
            *_per_method(row, 'smse_in_sample', 'smse_held_out', form='#.4g'),
            *_per_method(row, 'seconds', form='.4f'),
        ]
        for row in table.rows
    ]
    return (
        f'`{command}`\n\n{markdown_table(header, rows)}\n\n'
        f'{_timing_note(arguments)}; {_machine(table)}\n'
    )


def _write_csv(table: Table1, path: Path) -> None:
    header = ['sequence', 'frame', 'segment', 'n_candidates', 'n_pseudo_inputs', 'n_held_out']
    header += [name.replace('^2', '_squared') for name in _VARIANCES]
    names = ('n_inliers', 'smse_in_sample', 'smse_held_out', 'seconds')
    header += [f'{name}_{method}' for name in names for method in ('z_l', 'z')]
    with path.open('w', encoding='utf-8', newline='') as file:
        writer = csv.writer(file)
        writer.writerow(header)
        for row in table.rows:
            place = [row.frame.sequence, row.frame.index, row.segment]
            counts = [row.n_candidates, row.n_pseudo_inputs, row.n_held_out]
            variances = row.methods['Z-L'].variances.tolist()
            both = [getattr(row.methods[method], name) for name in names for method in MODELS]
            writer.writerow([*place, *counts, *variances, *both])
