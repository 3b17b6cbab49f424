"""``experiment``: the experiments of docs/, each a list of configurations scored over frames."""

from __future__ import annotations

import argparse
import re
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from gp_ground_seg.cli.evaluate import (
    FRAME_OPTIONS,
    add_json_options,
    frames_from_options,
    progress,
    staged_options,
)
from gp_ground_seg.cli.options import (
    add_config_options,
    config_from_options,
    parse_setting,
    positive,
    some_of,
)
from gp_ground_seg.errors import ConfigError, DataError
from gp_ground_seg.evaluation.environment import describe_environment
from gp_ground_seg.evaluation.table import fold
from gp_ground_seg.experiments import ablation, sensor_pose, simulated_scenes
from gp_ground_seg.experiments.cross_validation import cross_validate
from gp_ground_seg.experiments.table1 import DEFAULT_CHOICES, Choice, table1
from gp_ground_seg.experiments.variants import Report
from gp_ground_seg.parameters.schema import ParameterValue
from gp_ground_seg.simulation import SCENES, SENSORS

DEFAULT_SENSORS = ('hdl-64e', 'vlp-16', 'os1-128')

OF_FRAMES, OF_SIMULATED = tuple(FRAME_OPTIONS), ('seeds', 'scenes')
OPTIONS: dict[str, dict[str, Any]] = {
    'root': {'metavar': 'ROOT', 'help': 'folder in SemanticKITTI layout'},
    'simulated': {'action': 'store_true', 'help': 'simulated scans instead of ROOT'},
    **FRAME_OPTIONS,
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
        'help': 'measure this departure instead, and the parameters that switch it off '
                '(may be repeated)',
    },
    'frames': {
        'metavar': 'SEQ/IDX:SEG,SEG', 'nargs': '+',
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
            help=re.split(r'\.(?:\s|$)', experiment.description)[0],
            description=experiment.description,
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        for option in experiment.options:
            if option == 'root':
                is_optional = 'simulated' in experiment.options
                own.add_argument('root', nargs='?' if is_optional else None, **OPTIONS[option])
            else:
                own.add_argument(_flag(option), **OPTIONS[option])
        own.add_argument('--markdown', action='store_true', help='print the tables as Markdown')
        add_json_options(own)
        add_config_options(own)
        own.set_defaults(run=run)
        if name == 'scenes':
            own.set_defaults(preset=None)


def run(arguments: argparse.Namespace) -> int:
    """Measure, write the file, print the tables."""
    experiment = EXPERIMENTS[arguments.experiment]
    if 'simulated' in experiment.options:
        _check_source(arguments)
    with staged_options(arguments, 'json') as parts:
        report = experiment.run(arguments)
        has_peer = not getattr(arguments, 'no_peer', True)
        environment = describe_environment(*(['pypatchworkpp'] if has_peer else []))
        if 'json' in parts:
            options = {name: getattr(arguments, name) for name in experiment.options}
            report.facts.update(experiment=arguments.experiment, options=options)
            report.write(parts['json'], environment)
    tables = report.tables.values()
    print('\n\n'.join(t.markdown() if arguments.markdown else t.text() for t in tables))
    machine = environment.machine(report.fit.n_threads, report.fit.backend)
    print(f'\n{machine if arguments.markdown else fold(machine)}')
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


def _ablation(arguments: argparse.Namespace) -> Report:
    config = config_from_options(arguments)
    if arguments.simulated:
        bar = progress('ablation', 'scan')
        return ablation.compare_models_simulated(arguments.seeds or 10, config, bar)
    return ablation.compare_models(frames_from_options(arguments), config, progress('ablation'))


def _departures(arguments: argparse.Namespace) -> Report:
    config = config_from_options(arguments)
    departures = [parse_departure(text) for text in arguments.switch or []]
    return ablation.compare_departures(
        frames_from_options(arguments), departures or ablation.DEPARTURES, config,
        progress('departures'),
    )  # fmt: skip


def parse_departure(text: str) -> ablation.Departure:
    """Read ``TITLE: NAME=VALUE NAME=VALUE``; ConfigError if it is not of that form."""
    title, _, switch = text.rpartition(': ')
    settings = switch.split()
    if not title.strip() or not settings:
        raise ConfigError(f'--switch {text!r}: must be TITLE: NAME=VALUE ...')
    return ablation.Departure(title.strip(), dict(map(parse_setting, settings)))


def _scenes(arguments: argparse.Namespace) -> Report:
    configs = {}
    for sensor in arguments.sensors or DEFAULT_SENSORS:
        preset = arguments.preset or simulated_scenes.PRESET_OF[sensor]
        configs[sensor] = config_from_options(
            argparse.Namespace(**{**vars(arguments), 'preset': preset})
        )
    return simulated_scenes.score_scenes(
        configs, arguments.scenes or list(SCENES), arguments.seeds or 3,
        not arguments.no_peer, progress('scenes', 'scan'),
    )  # fmt: skip


def _cross_validation(arguments: argparse.Namespace) -> Report:
    grid, fixed = split_settings(arguments.settings)
    config = config_from_options(argparse.Namespace(**{**vars(arguments), 'settings': fixed}))
    bar = progress('cross-validation')
    return cross_validate(frames_from_options(arguments), config, grid, bar)


def split_settings(settings: Sequence[str]) -> tuple[dict[str, list[ParameterValue]], list[str]]:
    """Parameters to search with their values, and the settings of one value.

    Raises ConfigError if nothing is to be searched, or something twice.
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
        scenes, bar = arguments.scenes or list(SCENES), progress('sensor-pose', 'scan')
        return sensor_pose.score_simulated_poses(
            arguments.seeds or 1, config, scenes, progress=bar
        )
    return sensor_pose.score_poses(frames_from_options(arguments), config, progress('sensor-pose'))


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
gp_ground_seg/experiments/ablation.py; --switch measures another without touching it:
  --switch 'tight gate: growth.max_std=1'
""",
        ('root', *OF_FRAMES, 'switch'),
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
Measure the paper's Table I on segments of labelled frames.
""",
        ('root', 'frames', 'repeats'),
        _table1,
    ),
}
"""Experiments by name. A new one is a row here and a function that returns a `Report`."""
