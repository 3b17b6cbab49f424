"""``scenes``: scores on simulated scenes, flat and rough, for several sensors."""

from __future__ import annotations

import argparse
import dataclasses
import shlex
import sys
from collections.abc import Iterable, Sequence
from contextlib import ExitStack
from typing import Any

from tqdm import tqdm

from gp_ground_seg.cli.argument_types import positive, some_of
from gp_ground_seg.cli.experiment_text import machine_text, markdown_table, wrapped
from gp_ground_seg.cli.options import add_config_options, config_from_options
from gp_ground_seg.cli.scenes_report import scenes_behind, scenes_data, scenes_table, scenes_title
from gp_ground_seg.cli.tables import format_table
from gp_ground_seg.data.atomic_output import staged_file
from gp_ground_seg.evaluation.environment import describe_environment
from gp_ground_seg.evaluation.methods import OURS, PATCHWORKPP
from gp_ground_seg.evaluation.report import changed_parameters, write_json
from gp_ground_seg.experiments.scene_scores import SceneScan, scene_scans, score_scenes
from gp_ground_seg.parameters.config import Config
from gp_ground_seg.simulation import SCENES, SENSORS

PRESET_OF = {
    'hdl-64e': 'hdl64',
    'hdl-32e': 'hdl32',
    'vlp-16': 'vlp16',
    'os1-128': 'os1_128',
    'mid-360': 'mid360',
}
"""Preset that goes with each simulated sensor."""
DEFAULT_SENSORS = ('hdl-64e', 'vlp-16', 'os1-128')
N_SEEDS = 3

DESCRIPTION = """\
Segment simulated scans of flat and of rough ground and compare with exact labels and
ground heights, beside Patchwork++ on the same clouds. Each sensor has the parameters
of its preset unless --preset names one for all; Patchwork++ has its published
parameters and is told the sensor's true height.
"""

EXAMPLES = """\
examples:
  gp-ground-seg scenes
  gp-ground-seg scenes --sensors hdl-64e --scenes rough,ramp,ditch,crest,kerb --seeds 5
  gp-ground-seg scenes --preset default --set growth.seed_range=30 --json scenes.json
"""


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Declare the command."""
    parser = subparsers.add_parser(
        'scenes',
        help='score on simulated scenes, beside Patchwork++',
        description=DESCRIPTION,
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        '--sensors', metavar='LIST', type=some_of(SENSORS), default=list(DEFAULT_SENSORS),
        help=f'some of {",".join(SENSORS)} (default: {",".join(DEFAULT_SENSORS)})',
    )  # fmt: skip
    parser.add_argument(
        '--scenes', metavar='LIST', type=some_of(SCENES), default=list(SCENES),
        help=f'some of {",".join(SCENES)} (default: all)',
    )  # fmt: skip
    parser.add_argument(
        '--seeds', metavar='N', type=positive, default=N_SEEDS,
        help=f'scenes of each kind, each seen from two places (default: {N_SEEDS})',
    )  # fmt: skip
    parser.add_argument('--no-peer', action='store_true', help='leave Patchwork++ out')
    parser.add_argument('--json', metavar='FILE', help='write every number to this file as well')
    parser.add_argument('--markdown', metavar='FILE', help='write the table to this file as well')
    parser.add_argument('--force', action='store_true', help='overwrite these files')
    add_config_options(parser)
    parser.set_defaults(run=run, preset=None)


def run(arguments: argparse.Namespace) -> int:
    """Measure, write the files, print the table."""
    configs = {sensor: _config(arguments, sensor) for sensor in arguments.sensors}
    with ExitStack() as stack:
        # Around the measurement: a target that is refused is so before the work.
        targets = {
            name: stack.enter_context(staged_file(path, force=arguments.force))
            for name in ('json', 'markdown')
            if (path := getattr(arguments, name)) is not None
        }
        scans = scene_scans(arguments.sensors, arguments.scenes, arguments.seeds)
        ours, peer, fit = score_scenes(
            scans, configs, with_peer=not arguments.no_peer, progress=_progress_bar
        )
        header, rows = scenes_table(ours, peer)
        title = scenes_title(ours, bool(peer))
        verdict = scenes_behind(ours, peer) if peer else ''
        environment = describe_environment(*(['pypatchworkpp'] if peer else []))
        machine = f'machine: {machine_text(environment, fit.n_threads, fit.backend)}'
        if 'json' in targets:
            document = {
                'command': _command(arguments),
                'config_changes': {
                    sensor: changed_parameters(config) for sensor, config in configs.items()
                },
                'n_threads': fit.n_threads,
                'backend': fit.backend,
                'environment': dataclasses.asdict(environment),
                'methods': {OURS: scenes_data(ours)}
                | ({PATCHWORKPP: scenes_data(peer)} if peer else {}),
            }
            write_json(document, targets['json'])
        if 'markdown' in targets:
            parts = [f'`{_command(arguments)}`', title, markdown_table(header, rows, n_left=2)]
            parts += [part for part in (verdict, machine) if part]
            targets['markdown'].write_text('\n\n'.join(parts) + '\n', encoding='utf-8')
    print(f'{wrapped(title)}\n{format_table(header, rows, n_left=2)}\n')
    for line in (verdict, machine):
        if line:
            print(wrapped(line))
    for name in targets:
        print(f'written: {getattr(arguments, name)}')
    return 0


def _config(arguments: argparse.Namespace, sensor: str) -> Config:
    """Parameters for a sensor: its preset's unless one is named."""
    preset = arguments.preset or PRESET_OF[sensor]
    return config_from_options(argparse.Namespace(**{**vars(arguments), 'preset': preset}))


def _command(arguments: argparse.Namespace) -> str:
    words = ['gp-ground-seg', 'scenes']
    if arguments.sensors != list(DEFAULT_SENSORS):
        words += ['--sensors', ','.join(arguments.sensors)]
    if arguments.scenes != list(SCENES):
        words += ['--scenes', ','.join(arguments.scenes)]
    if arguments.seeds != N_SEEDS:
        words += ['--seeds', str(arguments.seeds)]
    words += ['--no-peer'] if arguments.no_peer else []
    words += ['--preset', arguments.preset] if arguments.preset else []
    words += ['--config', arguments.config] if arguments.config else []
    for setting in arguments.settings:
        words += ['--set', setting]
    return shlex.join(words)


def _progress_bar(scans: Sequence[SceneScan]) -> Iterable[SceneScan]:
    # `disable=None`: no bar where standard error is not a terminal.
    bar: Iterable[Any] = tqdm(
        scans, unit='scan', desc='scenes', file=sys.stderr, disable=None, leave=False
    )
    return bar
