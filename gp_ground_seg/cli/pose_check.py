"""``pose-check``: what not knowing height and tilt of the sensor costs."""

from __future__ import annotations

import argparse
import shlex
import sys
from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack
from typing import TypeVar

from tqdm import tqdm

from gp_ground_seg.cli.experiment_text import config_words
from gp_ground_seg.cli.options import add_config_options, config_from_options
from gp_ground_seg.cli.pose_text import pose_tables
from gp_ground_seg.data.atomic_output import staged_file
from gp_ground_seg.errors import DataError
from gp_ground_seg.evaluation.evaluate import labelled_frames
from gp_ground_seg.experiments.pose_trials import check_frames, check_simulated
from gp_ground_seg.simulation import SCENES

DESCRIPTION = """\
Compare the segmentation with height and tilt of the sensor told, and found out.

On labelled frames of KITTI's car (ROOT): as they are, and turned by 3 degrees about
every horizontal axis. With --simulated: every scene of the simulator, seen by an
HDL-64E, a VLP-16 and an OS1-128 from 0.4, 1.2, 1.73 and 2.5 m, level and tilted.
Then all of them turned over, which should be refused.
"""

EXAMPLES = """\
examples:
  gp-ground-seg pose-check KITTI_ROOT
  gp-ground-seg pose-check KITTI_ROOT --sequences 08,10 --frame-step 5
  gp-ground-seg pose-check --simulated --markdown simulated.md
"""

_Item = TypeVar('_Item')


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Declare the command."""
    parser = subparsers.add_parser(
        'pose-check',
        description=DESCRIPTION,
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument('root', metavar='ROOT', nargs='?', help='folder in SemanticKITTI layout')
    parser.add_argument('--simulated', action='store_true', help='simulated scans instead')
    parser.add_argument(
        '--sequences', metavar='LIST', help='sequences, as in 00,08 (default: all there are)'
    )
    parser.add_argument(
        '--frame-step', metavar='N', type=_positive, help='every Nth frame of a sequence only'
    )
    parser.add_argument(
        '--seeds', metavar='N', type=_positive, help='simulated scenes of each name (default: 1)'
    )
    parser.add_argument(
        '--scenes', metavar='LIST', help='simulated scenes, as in flat,urban (default: all)'
    )
    parser.add_argument('--markdown', metavar='FILE', help='write the tables to this file as well')
    parser.add_argument('--force', action='store_true', help='overwrite this file')
    add_config_options(parser)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Measure, print the tables."""
    config = config_from_options(arguments)
    _check(arguments)
    with ExitStack() as stack:
        target = None
        if arguments.markdown is not None:
            target = stack.enter_context(staged_file(arguments.markdown, force=arguments.force))
        if arguments.simulated:
            scenes = _names(arguments.scenes) or tuple(SCENES)
            found = check_simulated(
                arguments.seeds or 1, config, scenes, progress=_progress_bar('scene')
            )
        else:
            frames = labelled_frames(arguments.root, _names(arguments.sequences))
            groups = dict.fromkeys(frame.sequence for frame in frames)
            step = arguments.frame_step or 1
            chosen = [
                frame for g in groups for frame in [f for f in frames if f.sequence == g][::step]
            ]
            found = check_frames(chosen, config, progress=_progress_bar('frame'))
        tables = pose_tables(*found)
        if target is not None:
            parts = [f'`{_command(arguments)}`', *(table.markdown for table in tables)]
            target.write_text('\n\n'.join(parts) + '\n', encoding='utf-8')
    print('\n\n'.join(table.text for table in tables))
    if arguments.markdown is not None:
        print(f'\nwritten: {arguments.markdown}')
    return 0


def _names(words: str | None) -> list[str] | None:
    return None if words is None else [name for name in words.split(',') if name]


def _check(arguments: argparse.Namespace) -> None:
    """Refuse options that contradict one another."""
    if arguments.simulated == (arguments.root is not None):
        raise DataError('pose-check: give either ROOT or --simulated')
    foreign = ('sequences', 'frame_step') if arguments.simulated else ('seeds', 'scenes')
    for name in foreign:
        if getattr(arguments, name) is not None:
            kind = 'labelled frames' if arguments.simulated else '--simulated'
            raise DataError(f'--{name.replace("_", "-")}: is for {kind} only')


def _positive(word: str) -> int:
    number = int(word) if word.isdecimal() else 0
    if number < 1:
        raise argparse.ArgumentTypeError(f'{word!r}: must be a whole number, at least 1')
    return number


def _progress_bar(unit: str) -> Callable[[Sequence[_Item]], Iterable[_Item]]:
    def bar(items: Sequence[_Item]) -> Iterable[_Item]:
        # `disable=None`: no bar where standard error is not a terminal.
        shown: Iterable[_Item] = tqdm(
            items, unit=unit, desc='pose-check', file=sys.stderr, disable=None, leave=False
        )
        return shown

    return bar


def _command(arguments: argparse.Namespace) -> str:
    words = ['gp-ground-seg', 'pose-check']
    words.append('--simulated' if arguments.simulated else 'KITTI_ROOT')
    for name in ('sequences', 'frame_step', 'seeds', 'scenes'):
        if (value := getattr(arguments, name)) is not None:
            words += [f'--{name.replace("_", "-")}', str(value)]
    return shlex.join([*words, *config_words(arguments)])
