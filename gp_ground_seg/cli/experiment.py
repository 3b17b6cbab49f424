"""``experiment``: the experiments of docs/, each a list of configurations scored over frames."""

from __future__ import annotations

import argparse
import dataclasses
import shlex
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from gp_ground_seg.cli.evaluate import frames_from_options, progress, staged_options
from gp_ground_seg.cli.options import (
    DEFAULT_PRESET,
    add_config_options,
    config_from_options,
    parse_setting,
    positive,
    some_of,
)
from gp_ground_seg.errors import ConfigError, DataError
from gp_ground_seg.evaluation.environment import describe_environment
from gp_ground_seg.evaluation.table import fold, write_json
from gp_ground_seg.experiments.ablation import (
    DEPARTURES,
    Departure,
    compare_departures,
    compare_models,
    compare_models_simulated,
)
from gp_ground_seg.experiments.cross_validation import cross_validate
from gp_ground_seg.experiments.sensor_pose import score_poses, score_simulated_poses
from gp_ground_seg.experiments.simulated_scenes import PRESET_OF, score_scenes
from gp_ground_seg.experiments.table1 import DEFAULT_CHOICES, Choice, table1
from gp_ground_seg.experiments.variants import Report
from gp_ground_seg.parameters.schema import ParameterValue
from gp_ground_seg.simulation import SCENES, SENSORS

DEFAULT_SENSORS = ('hdl-64e', 'vlp-16', 'os1-128')

OF_FRAMES, OF_SIMULATED = ('sequences', 'frame_step'), ('seeds', 'scenes')
OPTIONS: dict[str, dict[str, Any]] = {
    'root': {'metavar': 'ROOT', 'help': 'folder in SemanticKITTI layout'},
    'simulated': {'action': 'store_true', 'help': 'simulated scans instead of ROOT'},
    'sequences': {'metavar': 'LIST', 'help': 'sequences, as in 00,08 (default: all there are)'},
    'frame_step': {
        'metavar': 'N', 'type': positive, 'help': 'every Nth frame of a sequence only'
    },
    'seeds': {'metavar': 'N', 'type': positive, 'help': 'simulated scenes of each kind'},
    'scenes': {
        'metavar': 'LIST', 'type': some_of(SCENES),
        'help': f'simulated scenes, some of {",".join(SCENES)} (default: all)',
    },
    'sensors': {
        'metavar': 'LIST', 'type': some_of(SENSORS),
        'help': f'some of {",".join(SENSORS)} (default: {",".join(DEFAULT_SENSORS)})',
    },
    'no_peer': {'action': 'store_true', 'help': 'leave Patchwork++ out'},
    'switch': {
        'metavar': 'TITLE: NAME=VALUE ...', 'action': 'append',
        'help': 'a further departure and the parameters that switch it off (may be repeated)',
    },
    'only_given': {'action': 'store_true', 'help': 'those of --switch only, not the list'},
    'frames': {
        'metavar': 'SEQ/IDX[:SEG,SEG]', 'nargs': '+',
        'help': f'frames and segments (default: {" ".join(DEFAULT_CHOICES)})',
    },
    'repeats': {
        'metavar': 'N', 'type': positive, 'help': 'timed runs of each method (default: 9)'
    },
}  # fmt: skip


class Experiment(NamedTuple):
    """An experiment: what it is for, the `OPTIONS` it has, and how it is run."""

    description: str
    options: tuple[str, ...]
    run: Callable[[argparse.Namespace], Report]


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Declare the command and a command below it for each of `EXPERIMENTS`."""
    parser = subparsers.add_parser(
        'experiment',
        description='Repeat an experiment of docs/: configurations scored over frames.',
        epilog='`gp-ground-seg experiment NAME --help` describes one of them.',
    )
    names = parser.add_subparsers(metavar='NAME', required=True, dest='experiment')
    for name, experiment in EXPERIMENTS.items():
        own = names.add_parser(
            name,
            help=experiment.description.partition('.')[0],
            description=experiment.description,
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        for option in experiment.options:
            if option == 'root':
                is_optional = 'simulated' in experiment.options
                own.add_argument('root', nargs='?' if is_optional else None, **OPTIONS[option])
            else:
                own.add_argument(_flag(option), **OPTIONS[option])
        own.add_argument('--json', metavar='FILE', help='write every number to this file')
        own.add_argument('--csv', metavar='FILE', help='write a line for each scan or segment')
        own.add_argument('--markdown', metavar='FILE', help='write the tables to this file')
        own.add_argument('--force', action='store_true', help='overwrite these files')
        add_config_options(own)
        own.set_defaults(run=run)
        if name == 'scenes':
            own.set_defaults(preset=None)


def run(arguments: argparse.Namespace) -> int:
    """Measure, write the files, print the tables."""
    experiment = EXPERIMENTS[arguments.experiment]
    if 'simulated' in experiment.options:
        _check_source(arguments)
    with staged_options(arguments, 'json', 'csv', 'markdown') as parts:
        report = experiment.run(arguments)
        has_peer = not getattr(arguments, 'no_peer', True)
        environment = describe_environment(*(['pypatchworkpp'] if has_peer else []))
        machine = environment.machine(report.fit.n_threads, report.fit.backend)
        command = _command(arguments)
        if 'json' in parts:
            document = {
                'command': command,
                'n_threads': report.fit.n_threads,
                'backend': report.fit.backend,
                'environment': dataclasses.asdict(environment),
                **report.facts,
                **{name: table.json() for name, table in report.tables.items()},
                report.rows_name: report.rows.json(),
            }
            write_json(document, parts['json'])
        if 'csv' in parts:
            parts['csv'].write_text(report.rows.csv(), encoding='utf-8')
        if 'markdown' in parts:
            tables = [table.markdown() for table in report.tables.values()]
            text = '\n\n'.join([f'`{command}`', *tables, machine]) + '\n'
            parts['markdown'].write_text(text, encoding='utf-8')
    print('\n\n'.join(table.text() for table in report.tables.values()))
    print(f'\n{fold(machine)}')
    for name in parts:
        print(f'written: {getattr(arguments, name)}')
    return 0


def _flag(option: str) -> str:
    return f'--{option.replace("_", "-")}'


def _check_source(arguments: argparse.Namespace) -> None:
    """Refuse options that contradict one another."""
    if arguments.simulated == (arguments.root is not None):
        raise DataError(f'{arguments.experiment}: give either ROOT or --simulated')
    for name in OF_FRAMES if arguments.simulated else OF_SIMULATED:
        if getattr(arguments, name, None) is not None:
            kind = 'labelled frames' if arguments.simulated else '--simulated'
            raise DataError(f'{_flag(name)}: is for {kind} only')


def _command(arguments: argparse.Namespace) -> str:
    """Command line that measures the same, without names of files."""
    words = ['gp-ground-seg', 'experiment', arguments.experiment]
    for option in EXPERIMENTS[arguments.experiment].options:
        value = getattr(arguments, option)
        if option == 'root':
            words += ['KITTI_ROOT'] if value is not None else []
        elif value is True:
            words.append(_flag(option))
        elif isinstance(value, list) and option == 'switch':
            words += [word for one in value for word in (_flag(option), one)]
        elif isinstance(value, list):
            words += [_flag(option), *(value if option == 'frames' else [','.join(value)])]
        elif value:
            words += [_flag(option), str(value)]
    if arguments.preset not in (None, DEFAULT_PRESET):
        words += ['--preset', arguments.preset]
    words += ['--config', arguments.config] if arguments.config else []
    words += [word for setting in arguments.settings for word in ('--set', setting)]
    return shlex.join(words)


def _ablation(arguments: argparse.Namespace) -> Report:
    config = config_from_options(arguments)
    if arguments.simulated:
        return compare_models_simulated(
            arguments.seeds or 10, config, progress('ablation', 'scan')
        )
    return compare_models(frames_from_options(arguments), config, progress('ablation'))


def _departures(arguments: argparse.Namespace) -> Report:
    config = config_from_options(arguments)
    departures = [] if arguments.only_given else [*DEPARTURES]
    departures += map(parse_departure, arguments.switch or [])
    if not departures:
        raise ConfigError('--only-given: none given, give --switch TITLE: NAME=VALUE')
    frames = frames_from_options(arguments)
    return compare_departures(frames, departures, config, progress('departures'))


def parse_departure(text: str) -> Departure:
    """Read ``TITLE: NAME=VALUE NAME=VALUE``.

    Raises
    ------
    ConfigError
        If it is not of that form.
    """
    title, _, switch = text.rpartition(': ')
    settings = switch.split()
    if not title.strip() or not settings:
        raise ConfigError(f'--switch {text!r}: must be TITLE: NAME=VALUE ...')
    return Departure(title.strip(), dict(map(parse_setting, settings)))


def _scenes(arguments: argparse.Namespace) -> Report:
    configs = {}
    for sensor in arguments.sensors or DEFAULT_SENSORS:
        options = {**vars(arguments), 'preset': arguments.preset or PRESET_OF[sensor]}
        configs[sensor] = config_from_options(argparse.Namespace(**options))
    return score_scenes(
        configs, arguments.scenes or list(SCENES), arguments.seeds or 3,
        not arguments.no_peer, progress('scenes', 'scan'),
    )  # fmt: skip


def _cross_validation(arguments: argparse.Namespace) -> Report:
    grid, fixed = split_settings(arguments.settings)
    config = config_from_options(argparse.Namespace(**{**vars(arguments), 'settings': fixed}))
    return cross_validate(
        frames_from_options(arguments), config, grid, progress('cross-validation')
    )


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
        raise ConfigError('cross-validation: nothing to choose, give --set NAME=VALUE,VALUE,...')
    return grid, fixed


def _sensor_pose(arguments: argparse.Namespace) -> Report:
    config = config_from_options(arguments)
    if arguments.simulated:
        scenes = arguments.scenes or list(SCENES)
        bar = progress('sensor-pose', 'scan')
        return score_simulated_poses(arguments.seeds or 1, config, scenes, progress=bar)
    return score_poses(frames_from_options(arguments), config, progress('sensor-pose'))


def _table1(arguments: argparse.Namespace) -> Report:
    config = config_from_options(arguments)
    try:
        choices = [Choice.parse(word) for word in arguments.frames or DEFAULT_CHOICES]
    except ValueError as error:
        raise DataError(f'--frames {error}') from error
    return table1(arguments.root, choices, config, arguments.repeats or 9, progress('table1'))


EXPERIMENTS = {
    'ablation': Experiment(
        """\
Compare length-scale models and ways to learn. On labelled frames: a constant length-scale,
the gradients of the lines (Z), and the latent process (Z-L); with --simulated on a smooth
road that ends in rubble, by exact heights.
""",
        ('root', 'simulated', *OF_FRAMES, 'seeds'),
        _ablation,
    ),
    'departures': Experiment(
        """\
Undo one departure from the paper after the other. They are the rows of
gp_ground_seg/experiments/ablation.py; --switch measures others without touching it:
  --only-given --switch 'tight gate: growth.max_std=1'
""",
        ('root', *OF_FRAMES, 'switch', 'only_given'),
        _departures,
    ),
    'scenes': Experiment(
        """\
Score simulated scans by exact labels and heights, beside Patchwork++. Each sensor has the
parameters of its preset unless --preset names one for all; Patchwork++ has its published
parameters and the true height of the sensor.
""",
        ('sensors', 'scenes', 'seeds', 'no_peer'),
        _scenes,
    ),
    'cross-validation': Experiment(
        """\
Choose parameters on all sequences but one, and score them on that one. Parameters with
several values are searched by pooled IoU, one after the other until no change of one is
better: --set label.ground_tolerance=0.05,0.1
""",
        ('root', *OF_FRAMES),
        _cross_validation,
    ),
    'sensor-pose': Experiment(
        """\
Compare the segmentation with height and tilt of the sensor told and estimated. On labelled
frames of KITTI's car as they are, turned by 3 degrees, and turned over; with --simulated
from three sensors at four heights.
""",
        ('root', 'simulated', *OF_FRAMES, *OF_SIMULATED),
        _sensor_pose,
    ),
    'table1': Experiment(
        """\
Measure the paper's Table I on segments of labelled frames. A frame without segments gives
the adjacent pair whose labelled ground varies most in height.
""",
        ('root', 'frames', 'repeats'),
        _table1,
    ),
}
"""Experiments by name. A new one is a row here and a function that returns a `Report`."""
