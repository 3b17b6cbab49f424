"""``ideas``: what each idea is worth, switched off one at a time."""

from __future__ import annotations

import argparse
import dataclasses
import shlex
import sys
from collections.abc import Iterable, Sequence
from contextlib import ExitStack
from typing import Any

from tqdm import tqdm

from gp_ground_seg.cli.ablation_report import frames_data, frames_title
from gp_ground_seg.cli.experiment_text import config_words, machine_text, markdown_table, wrapped
from gp_ground_seg.cli.frame_options import add_frame_options, frames_from_options
from gp_ground_seg.cli.options import add_config_options, config_from_options, parse_setting
from gp_ground_seg.cli.tables import format_table, percent
from gp_ground_seg.data.atomic_output import staged_file
from gp_ground_seg.data.semantic_kitti import Frame
from gp_ground_seg.errors import ConfigError
from gp_ground_seg.evaluation.environment import describe_environment
from gp_ground_seg.evaluation.report import changed_parameters, write_json
from gp_ground_seg.experiments.ablation import MethodResult
from gp_ground_seg.experiments.ideas import AS_GIVEN, IDEAS, Idea, IdeaResult, weigh_ideas

DESCRIPTION = """\
Switch off one idea after the other on the same labelled frames, and print what is lost.
The ideas are the rows of gp_ground_seg/experiments/ideas.py; --idea tries others without
touching it: a title, a colon, and the parameters that switch it off.
"""

EXAMPLES = """\
examples:
  gp-ground-seg ideas KITTI_ROOT
  gp-ground-seg ideas KITTI_ROOT --only-given --idea 'tight gate: growth.max_std=1'
  gp-ground-seg ideas KITTI_ROOT --frame-step 5 --markdown ideas.md
"""


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Declare the command."""
    parser = subparsers.add_parser(
        'ideas',
        description=DESCRIPTION,
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add_frame_options(parser)
    parser.add_argument(
        '--idea', metavar='TITLE: NAME=VALUE ...', action='append', default=[], dest='ideas',
        help='a further idea and the parameters that switch it off (may be repeated)',
    )  # fmt: skip
    parser.add_argument(
        '--only-given', action='store_true', help='those of --idea only, not the list'
    )
    parser.add_argument('--json', metavar='FILE', help='write every number to this file as well')
    parser.add_argument('--markdown', metavar='FILE', help='write the table to this file as well')
    parser.add_argument('--force', action='store_true', help='overwrite these files')
    add_config_options(parser)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Measure, write the files, print the table."""
    config = config_from_options(arguments)
    ideas = [*(() if arguments.only_given else IDEAS), *map(parse_idea, arguments.ideas)]
    if not ideas:
        raise ConfigError('--only-given: no idea given, give --idea TITLE: NAME=VALUE')
    with ExitStack() as stack:
        # Around the measurement: a target that is refused is so before the work.
        targets = {
            name: stack.enter_context(staged_file(path, force=arguments.force))
            for name in ('json', 'markdown')
            if (path := getattr(arguments, name)) is not None
        }
        frames = frames_from_options(arguments)
        given, results = weigh_ideas(frames, ideas, config, progress=_progress_bar)
        header, rows = ideas_table(given, results)
        title = _title(given)
        environment = describe_environment()
        machine = machine_text(environment, given.fit.n_threads, given.fit.backend)
        if 'json' in targets:
            document = {
                'command': _command(arguments),
                'config_changes': changed_parameters(config),
                'environment': dataclasses.asdict(environment),
                AS_GIVEN: frames_data(given),
                'ideas': {one.idea.title: _data(one) for one in results},
            }
            write_json(document, targets['json'])
        if 'markdown' in targets:
            parts = [f'`{_command(arguments)}`', title, markdown_table(header, rows, n_left=2)]
            text = '\n\n'.join([*parts, f'machine: {machine}\n'])
            targets['markdown'].write_text(text, encoding='utf-8')
    table = format_table(header, rows, n_left=2)
    print(f'{wrapped(title)}\n{table}\n\n{wrapped(f"machine: {machine}")}')
    for name in targets:
        print(f'written: {getattr(arguments, name)}')
    return 0


def parse_idea(text: str) -> Idea:
    """Read ``TITLE: NAME=VALUE NAME=VALUE``.

    Raises
    ------
    ConfigError
        If it is not of that form.
    """
    title, _, switch = text.rpartition(': ')
    settings = switch.split()
    if not title.strip() or not settings:
        raise ConfigError(f'--idea {text!r}: must be TITLE: NAME=VALUE ...')
    return Idea(title.strip(), dict(parse_setting(setting) for setting in settings))


def ideas_table(given: MethodResult, results: Sequence[IdeaResult]) -> tuple[list[str], Any]:
    """Header and rows: nothing switched, then each idea, those worth most first."""
    header = ['idea switched', '', 'IoU', 'worth', 'worst sequence', 'RMSE', 'time ratio']
    rows = [[AS_GIVEN, '', percent(given.pooled().iou), '', *_cells(given), '1.00']]
    for one in sorted(results, key=lambda result: -result.worth()):
        rows.append(
            [
                one.idea.title,
                'off' if one.idea.kept else 'on',
                percent(one.switched.pooled().iou),
                percent(one.worth(), sign=True),
                *_cells(one.switched),
                f'{one.time_ratio:.2f}',
            ]
        )
    return header, rows


def _title(given: MethodResult) -> str:
    frames = frames_title([given]).partition(';')[0]
    return (
        f'{frames}; IoU in the GroundGrid convention [%], RMSE of the height [cm]; worth: what '
        'having the idea adds to the IoU'
    )


def _cells(result: MethodResult) -> list[str]:
    worst = result.worst_sequence
    return [
        f'{percent(result.pooled(worst).iou)} ({worst})',
        f'{100.0 * result.height.rmse:.2f}',
    ]


def _data(one: IdeaResult) -> dict[str, Any]:
    return {
        'changes': dict(one.idea.changes),
        'kept': one.idea.kept,
        'worth': one.worth(),
        'time_ratio': one.time_ratio,
        **frames_data(one.switched),
    }


def _command(arguments: argparse.Namespace) -> str:
    words = ['gp-ground-seg', 'ideas', 'KITTI_ROOT']
    words += ['--sequences', arguments.sequences] if arguments.sequences else []
    words += ['--frame-step', str(arguments.frame_step)] if arguments.frame_step > 1 else []
    words += ['--only-given'] if arguments.only_given else []
    for idea in arguments.ideas:
        words += ['--idea', idea]
    return shlex.join([*words, *config_words(arguments)])


def _progress_bar(frames: Sequence[Frame]) -> Iterable[Frame]:
    # `disable=None`: no bar where standard error is not a terminal.
    bar: Iterable[Frame] = tqdm(
        frames, unit='frame', desc='ideas', file=sys.stderr, disable=None, leave=False
    )
    return bar
