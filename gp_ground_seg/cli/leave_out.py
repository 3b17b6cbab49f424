"""``leave-out``: choose parameters, and score them where they were not chosen."""

from __future__ import annotations

import argparse
import dataclasses
import sys
from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack

from tqdm import tqdm

from gp_ground_seg.backend import make_backend
from gp_ground_seg.cli.experiment_text import machine_text, wrapped
from gp_ground_seg.cli.frame_options import add_frame_options, frames_from_options
from gp_ground_seg.cli.leave_out_report import (
    choice_table,
    leave_out_data,
    leave_out_table,
    leave_out_title,
)
from gp_ground_seg.cli.options import add_config_options, config_from_options, parse_setting
from gp_ground_seg.cli.tables import format_table
from gp_ground_seg.data.atomic_output import staged_file
from gp_ground_seg.data.semantic_kitti import Frame
from gp_ground_seg.errors import ConfigError
from gp_ground_seg.evaluation.environment import describe_environment
from gp_ground_seg.evaluation.report import changed_parameters, write_json
from gp_ground_seg.experiments.leave_out import leave_one_out
from gp_ground_seg.parameters.schema import ParameterValue

DESCRIPTION = """\
Choose parameters by pooled IoU (GroundGrid convention) on all sequences but one, and
score them on that one; so for every sequence. A parameter set to several values is
searched, one parameter after the other until none can be bettered, starting from the
values given otherwise; a parameter set to one value is just set. Each configuration
segments every frame once, however many searches ask for it.
"""

EXAMPLES = """\
examples:
  gp-ground-seg leave-out KITTI_ROOT --set label.ground_tolerance=0.05,0.1,0.15
  gp-ground-seg leave-out KITTI_ROOT --frame-step 3 --json left-out.json \\
      --set faces.tolerance=0.05,0.1 --set growth.max_standardised_residual=2,2.5,3
"""


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Declare the command."""
    parser = subparsers.add_parser(
        'leave-out',
        description=DESCRIPTION,
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add_frame_options(parser)
    parser.add_argument('--json', metavar='FILE', help='write every number to this file as well')
    parser.add_argument('--force', action='store_true', help='overwrite this file')
    add_config_options(parser)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Search, write the file, print the tables."""
    grid, fixed = split_settings(arguments.settings)
    config = config_from_options(argparse.Namespace(**{**vars(arguments), 'settings': fixed}))
    with ExitStack() as stack:
        # Around the search: a target that is refused is so before the work.
        target = None
        if arguments.json is not None:
            target = stack.enter_context(staged_file(arguments.json, force=arguments.force))
        frames = frames_from_options(arguments)
        result = leave_one_out(frames, config, grid, progress=_progress_bar())
        backend = make_backend(config.runtime)
        environment = describe_environment()
        machine = machine_text(environment, backend.n_threads, backend.name)
        backend.close()
        if target is not None:
            document = {
                'data': arguments.root,
                'n_frames': len(frames),
                'config_changes': changed_parameters(config),
                'tried': grid,
                'environment': dataclasses.asdict(environment),
                **leave_out_data(result),
            }
            write_json(document, target)
    header, rows = leave_out_table(result)
    print(f'{wrapped(leave_out_title(result))}\n')
    print(f'{format_table(header, rows, rule_before=len(rows) - 1)}\n')
    print('Values chosen; - 00: without sequence 00')
    print(f'{format_table(*choice_table(result))}\n\n{wrapped(f"machine: {machine}")}')
    if arguments.json is not None:
        print(f'written: {arguments.json}')
    return 0


def split_settings(settings: Sequence[str]) -> tuple[dict[str, list[ParameterValue]], list[str]]:
    """Parameters to search with their values, and the settings of one value.

    Raises
    ------
    ConfigError
        If nothing is to be searched, or something twice.
    """
    grid: dict[str, list[ParameterValue]] = {}
    fixed = []
    for setting in settings:
        name, _, text = setting.partition('=')
        if ',' not in text:
            fixed.append(setting)
            continue
        if name.strip() in grid:
            raise ConfigError(f'--set {setting}: {name.strip()} is searched twice')
        words = [word for word in text.split(',') if word]
        grid[name.strip()] = [parse_setting(f'{name}={word}')[1] for word in words]
    if not grid:
        raise ConfigError('leave-out: nothing to choose, give --set NAME=VALUE,VALUE,...')
    return grid, fixed


def _progress_bar() -> Callable[[Sequence[Frame]], Iterable[Frame]]:
    n_bars = 0

    def bar(frames: Sequence[Frame]) -> Iterable[Frame]:
        nonlocal n_bars
        n_bars += 1
        # `disable=None`: no bar where standard error is not a terminal.
        shown: Iterable[Frame] = tqdm(
            frames, unit='frame', desc=f'configuration {n_bars}', file=sys.stderr,
            disable=None, leave=False,
        )  # fmt: skip
        return shown

    return bar
