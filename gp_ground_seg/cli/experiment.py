"""``experiment``: the experiments of docs/, each a list of configurations scored over frames."""

from __future__ import annotations

import argparse
import re
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

from gp_ground_seg.cli import options
from gp_ground_seg.cli.evaluate import OF_FRAMES, ROOT, frames_from_options
from gp_ground_seg.core.errors import ConfigError, DataError
from gp_ground_seg.core.parameters.config import Config
from gp_ground_seg.lab.experiments import ablation, coverage, lost, sensor_pose, stepwise, variants
from gp_ground_seg.lab.experiments.table1 import table1
from gp_ground_seg.lab.experiments.variants import (
    load_simulated,
    score_simulated,
    simulated_frames,
)
from gp_ground_seg.lab.scale.cluster import Runner
from gp_ground_seg.lab.scoring.evaluate import load_kitti
from gp_ground_seg.lab.scoring.report import Report, describe_environment, machine_line, written
from gp_ground_seg.lab.simulation import DRIVES, SCENES, SENSORS

Option = tuple[str, str, dict[str, Any]]

DEFAULT_SENSORS = ('hdl-64e', 'vlp-16', 'os1-128')
SURVEYED = ('hdl-64e', 'hdl-32e', 'vlp-16', 'os1-128', 'mid-360')  # by `coverage`

ONE_PROCESS = ('table1',)  # it measures times
EXAMPLES = """\
  gp-ground-seg experiment ablation KITTI_ROOT
  gp-ground-seg experiment scenes --sensors vlp-16 --scenes kerb
  gp-ground-seg experiment NAME --help          describes one of them
"""

OPTIONAL_ROOT = (*ROOT[:2], {'metavar': 'ROOT', 'nargs': '?'})
SIMULATED = ('--simulated', 'simulated scans instead of ROOT', options.FLAG)
SEEDS = ('--seeds', 'simulated scenes of each kind', options.NUMBER)


def _some_of(option: str, known: Iterable[str], default: Iterable[str]) -> Option:
    """Option that takes names of scenes or sensors."""
    text = f'some of {",".join(known)} (default: {",".join(default)})'
    return option, text, {'metavar': 'LIST', 'type': options.some_of(known)}


SCENE_LIST = _some_of('--scenes', SCENES, DRIVES)
CROWDED_LIST = _some_of('--scenes', SCENES, lost.SCENES)
SENSOR_LIST = _some_of('--sensors', SENSORS, DEFAULT_SENSORS)
EVERY_SENSOR = _some_of('--sensors', SENSORS, SURVEYED)
EVERY_MOUNT = _some_of('--sensors', SENSORS, ['all'])
NO_PEER = ('--no-peer', 'leave Patchwork++ out', options.FLAG)


class Experiment(NamedTuple):
    """An experiment: what it is for, its options, and how it is run."""

    description: str
    options: tuple[Option, ...]
    run: Callable[[argparse.Namespace, Config, Runner], Report]


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Declare the command and a command below it for each of `EXPERIMENTS`."""
    description = 'Repeat an experiment of docs/: configurations scored over frames.'
    parser = options.new_parser(subparsers, 'experiment', description, EXAMPLES)
    names = parser.add_subparsers(metavar='NAME', required=True, dest='experiment')
    for name, experiment in EXPERIMENTS.items():
        purpose = re.split(r'\.(?:\s|$)', experiment.description)[0]
        source = ' KITTI_ROOT' if experiment.options[0][0] == 'root' else ' --sensors vlp-16'
        example = f'  gp-ground-seg experiment {name}{source} --json {name}.json'
        own = options.new_parser(names, name, experiment.description, example, purpose)
        options.add(own, *experiment.options, options.MARKDOWN, options.TO_JSON, options.FORCE)
        if name in ONE_PROCESS:
            own.set_defaults(workers=None, scheduler=None)
        else:
            options.add_cluster(own)
        options.add_config(own)
        own.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Measure, write the file, print the tables."""
    experiment = EXPERIMENTS[arguments.experiment]
    if SIMULATED in experiment.options:
        _check_source(arguments)
    config = options.read_config(arguments)
    with options.staged_options(arguments, 'json') as parts:
        with options.runner(arguments, arguments.experiment) as runner:
            report = experiment.run(arguments, config, runner)
            n_workers = runner.n_workers
        has_peer = not getattr(arguments, 'no_peer', True)
        environment = describe_environment(*(['pypatchworkpp'] if has_peer else []))
        environment['n_workers'] = n_workers
        if 'json' in parts:
            given = {name: getattr(arguments, name) for name in map(_name, experiment.options)}
            report.facts.update(experiment=arguments.experiment, options=given)
            report.write(parts['json'], environment)
    lines = [machine_line(environment, report.fit)]
    print(written(report.tables.values(), lines, markdown=arguments.markdown))
    return 0


def _name(option: Option) -> str:
    return option[0].lstrip('-').replace('-', '_')


def _check_source(arguments: argparse.Namespace) -> None:
    """Refuse options that contradict one another."""
    if arguments.simulated == (arguments.root is not None):
        raise DataError(f'{arguments.experiment}: give either ROOT or --simulated')
    for option in OF_FRAMES if arguments.simulated else (SEEDS, SCENE_LIST, EVERY_SENSOR):
        if getattr(arguments, _name(option), None) is not None:
            kind = 'labelled frames' if arguments.simulated else '--simulated'
            raise DataError(f'{option[0]}: is for {kind} only')


def _ablation(arguments: argparse.Namespace, config: Config, runner: Runner) -> Report:
    if not arguments.simulated:
        return ablation.compare_models(frames_from_options(arguments), load_kitti, config, runner)
    seeds = arguments.seeds or 10
    frames = simulated_frames(['hdl-64e'], [ablation.SCENE], seeds, ablation.PLACES)
    return ablation.compare_models(frames, load_simulated, config, runner)


def _departures(arguments: argparse.Namespace, config: Config, runner: Runner) -> Report:
    return ablation.compare_departures(frames_from_options(arguments), config, runner)


def _steps(arguments: argparse.Namespace, config: Config, runner: Runner) -> Report:
    if config != Config():
        raise ConfigError('steps: goes from the preset paper to the defaults, give no parameters')
    frames = frames_from_options(arguments)
    return stepwise.score_steps(frames, not arguments.no_peer, runner)


def _wrong_values(arguments: argparse.Namespace, config: Config, runner: Runner) -> Report:
    return stepwise.score_wrong_values(frames_from_options(arguments), config, runner)


def _scenes(arguments: argparse.Namespace, config: Config, runner: Runner) -> Report:
    sensors, scenes = arguments.sensors or DEFAULT_SENSORS, arguments.scenes or list(DRIVES)
    frames = simulated_frames(sensors, scenes, arguments.seeds or 3, variants.SCENE_PLACES)
    return score_simulated(frames, variants.scene_tables, config, not arguments.no_peer, runner)


def _objects(arguments: argparse.Namespace, config: Config, runner: Runner) -> Report:
    sensors, scenes = arguments.sensors or list(SENSORS), arguments.scenes or lost.SCENES
    frames = simulated_frames(sensors, scenes, arguments.seeds or 2, (0.0,))
    return score_simulated(frames, lost.lost_tables, config, not arguments.no_peer, runner)


def _coverage(arguments: argparse.Namespace, config: Config, runner: Runner) -> Report:
    if not arguments.simulated:
        frames = frames_from_options(arguments)
        return coverage.compare_coverage(frames, load_kitti, config, coverage.LABELLED, runner)
    sensors, scenes = arguments.sensors or list(SURVEYED), arguments.scenes or list(DRIVES)
    scans = simulated_frames(sensors, scenes, arguments.seeds or 2, (0.0,))
    return coverage.compare_coverage(scans, load_simulated, config, coverage.SIMULATED, runner)


def _sensor_pose(arguments: argparse.Namespace, config: Config, runner: Runner) -> Report:
    if not arguments.simulated:
        frames, mounts = frames_from_options(arguments), sensor_pose.MOUNTS
        return sensor_pose.score_poses(frames, sensor_pose.load_turned, mounts, config, runner)
    scenes, mounts = arguments.scenes or list(DRIVES), sensor_pose.SIMULATED_MOUNTS
    scans = simulated_frames(DEFAULT_SENSORS, scenes, arguments.seeds or 1, (0.0,))
    return sensor_pose.score_poses(scans, sensor_pose.load_mounted, mounts, config, runner)


def _table1(arguments: argparse.Namespace, config: Config, _: Runner) -> Report:
    bar = options.progress('table1')
    return table1(arguments.root, config, options.scan_layout(arguments), bar)


EXPERIMENTS = {
    'ablation': Experiment(
        """\
Compare length-scale models and ways to learn: a constant length-scale, the gradients of the
lines (Z), and the latent process (Z-L), and beside them a surface that is interpolated
between lowest points, on labelled frames; with --simulated on a smooth road that ends in
rubble, by exact labels and heights.
""",
        (OPTIONAL_ROOT, SIMULATED, *OF_FRAMES, SEEDS),
        _ablation,
    ),
    'departures': Experiment(
        """\
Switch off one departure from the paper after the other. They are the rows of
gp_ground_seg/lab/experiments/ablation.py; `evaluate --against` measures any other change.
""",
        (ROOT, *OF_FRAMES),
        _departures,
    ),
    'coverage': Experiment(
        """\
Compare errors of the ground's height with their standard deviations: how many lie within one
and two, by sequence and range. On labelled frames that of the returns (return_std), with
--simulated that of the ground (ground_std) by exact heights.
""",
        (OPTIONAL_ROOT, SIMULATED, *OF_FRAMES, EVERY_SENSOR, SCENE_LIST, SEEDS),
        _coverage,
    ),
    'steps': Experiment(
        """\
Go from the paper's method to the defaults, one step after the other, beside Patchwork++ and a
surface that is interpolated, with our labels.
""",
        (ROOT, *OF_FRAMES, NO_PEER),
        _steps,
    ),
    'wrong-values': Experiment(
        """\
Give hyper-parameters that are wrong by factors of 3 and 10, with and without learning.
""",
        (ROOT, *OF_FRAMES),
        _wrong_values,
    ),
    'scenes': Experiment(
        """\
Score simulated scans by exact labels and heights, beside Patchwork++ with its published
parameters and the true height of the sensor. All sensors have one set of parameters.
""",
        (SENSOR_LIST, SCENE_LIST, SEEDS, NO_PEER),
        _scenes,
    ),
    'objects': Experiment(
        """\
Count vehicles, persons and cyclists of simulated scans that are called ground, beside
Patchwork++ with its published parameters and the true height and place of the sensor. All
sensors have one set of parameters.
""",
        (EVERY_MOUNT, CROWDED_LIST, SEEDS, NO_PEER),
        _objects,
    ),
    'sensor-pose': Experiment(
        """\
Compare the segmentation with height and tilt of the sensor given and estimated. On labelled
frames of KITTI's car as they are, and turned by 3 degrees; with --simulated from three
sensors at four heights.
""",
        (OPTIONAL_ROOT, SIMULATED, *OF_FRAMES, SEEDS, SCENE_LIST),
        _sensor_pose,
    ),
    'table1': Experiment(
        """\
Measure the paper's Table I on segments of labelled frames.
""",
        (ROOT, *options.SCAN_LAYOUT),
        _table1,
    ),
}
"""Experiments by name. A new one is a row here and a function that returns a `Report`."""
