"""``experiment``: the experiments of docs/, each a function from scans to tables."""

from __future__ import annotations

import argparse
import inspect
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

from gp_ground_seg.cli import options
from gp_ground_seg.cli.evaluate import OF_FRAMES, ROOT, frames_from_options, print_report
from gp_ground_seg.core.errors import DataError
from gp_ground_seg.core.parameters.config import Config
from gp_ground_seg.lab import experiments, table1
from gp_ground_seg.lab.cluster import Runner
from gp_ground_seg.lab.scenes import CROWDED, score_scenes, simulated_frames
from gp_ground_seg.lab.scoring.report import Report
from gp_ground_seg.lab.simulation import DRIVES, LOW, SCENES, SENSORS, STEEP

THREE = ('hdl-64e', 'vlp-16', 'os1-128')
EXAMPLES = """\
  gp-ground-seg experiment ablation KITTI_ROOT
  gp-ground-seg experiment scenes --sensors vlp-16 --scenes kerb
  gp-ground-seg experiment NAME --help          describes one of them
"""
SIMULATED = ('--simulated', 'simulated scans instead of ROOT', options.FLAG)
NO_PEER = ('--no-peer', 'leave Patchwork++ out (pip install pypatchworkpp)', options.FLAG)


class Experiment(NamedTuple):
    """A function from scans, parameters and a runner to tables; its docstring is the help.

    With `sensors` it simulates scans, by default of these and in these scenes.
    """

    run: Callable[..., Report]
    sensors: Sequence[str] = ()
    scenes: Sequence[str] = (*DRIVES,)
    n_seeds: int = 1  # scenes of each kind
    places: Sequence[float] = (0.0,)  # of the sensor in each scene [m]
    labelled: bool = True  # whether it takes labelled frames
    is_timed: bool = False  # then it runs in one process
    takes_config: bool = True  # whether its parameters can be set

    @property
    def has_peer(self) -> bool:
        """Whether Patchwork++ can run beside it."""
        return 'with_peer' in inspect.signature(self.run).parameters


EXPERIMENTS = {
    'ablation': Experiment(
        experiments.compare_models, THREE[:1], [experiments.SCENE], 10, experiments.PLACES
    ),
    'steps': Experiment(experiments.compare_steps, takes_config=False),
    'pseudo-inputs': Experiment(experiments.compare_pseudo_inputs, is_timed=True),
    'scenes': Experiment(
        score_scenes, THREE, (*DRIVES, *LOW, *STEEP), 3, places=(0.0, 6.0), labelled=False
    ),
    'objects': Experiment(score_scenes, [*SENSORS], CROWDED, n_seeds=2, labelled=False),
    'table1': Experiment(table1.table1, is_timed=True),
    'speed': Experiment(experiments.measure_speed, is_timed=True),
}
"""Experiments by name. A new one is a row here and its function."""


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Declare the command and a command below it for each of `EXPERIMENTS`."""
    description = 'Repeat an experiment of docs/: configurations scored over scans.'
    parser = options.new_parser(subparsers, 'experiment', description, EXAMPLES)
    names = parser.add_subparsers(metavar='NAME', required=True, dest='experiment')
    for name, experiment in EXPERIMENTS.items():
        description = inspect.getdoc(experiment.run) or name
        source = ' KITTI_ROOT' if experiment.labelled else ' --sensors vlp-16'
        example = f'  gp-ground-seg experiment {name}{source} --json {name}.json'
        purpose = description.splitlines()[0].removesuffix('.')
        child = options.new_parser(names, name, f'{description}\n', example, purpose)
        # What is not asked for: no labelled frames, no simulated scans, one process.
        child.set_defaults(run=run, root=None, simulated=not experiment.labelled)
        child.set_defaults(workers=None, scheduler=None)
        if experiment.labelled:
            count = {'nargs': '?'} if experiment.sensors else {}
            options.add(child, (*ROOT[:2], {**ROOT[2], **count}), *OF_FRAMES)
        if experiment.labelled and experiment.sensors:
            options.add(child, SIMULATED)
        if experiment.sensors:
            n_seeds = f'scenes of each kind (default: {experiment.n_seeds})'
            options.add(child, ('--seeds', n_seeds, options.NUMBER))
            for option, known, default in (
                ('--sensors', SENSORS, experiment.sensors),
                ('--scenes', SCENES, experiment.scenes),
            ):
                text = f'some of {",".join(known)} (default: {",".join(default)})'
                kind = {'metavar': 'LIST', 'type': options.some_of(known)}
                options.add(child, (option, text, kind))
        options.add(child, *[NO_PEER] * experiment.has_peer)
        options.add(child, options.MARKDOWN, options.TO_JSON, options.FORCE)
        if not experiment.is_timed:
            options.add_cluster(child)
        if experiment.takes_config:
            options.add_config(child)


def run(arguments: argparse.Namespace) -> int:
    """Measure, write the file, print the tables."""
    name, experiment = arguments.experiment, EXPERIMENTS[arguments.experiment]
    if arguments.simulated == (arguments.root is not None):
        raise DataError(f'{name}: give either ROOT or --simulated')
    others = ('sequences', 'frame_step') if arguments.simulated else ('sensors', 'scenes', 'seeds')
    for option in others:
        if vars(arguments).get(option) is not None:
            words = option.replace('_', '-')
            raise DataError(f'--{words}: is for the other kind of scans, see --simulated')
    config = options.read_config(arguments) if experiment.takes_config else Config()
    measure: Callable[..., Report] = experiment.run
    with_peer = experiment.has_peer and not arguments.no_peer
    if experiment.has_peer:
        measure = partial(measure, with_peer=with_peer)

    def measured(runner: Runner) -> Report:
        if not arguments.simulated:
            return measure(frames_from_options(arguments), config, runner)
        scans: Sequence[Any] = simulated_frames(
            arguments.sensors or experiment.sensors,
            arguments.scenes or experiment.scenes,
            arguments.seeds or experiment.n_seeds,
            experiment.places,
        )
        return measure(scans, config, runner)

    packages = ['pypatchworkpp'] * with_peer
    print_report(arguments, name, measured, packages, experiment=name)
    return 0
