"""``experiment``: the experiments of docs/, each a function from scans to tables."""

from __future__ import annotations

import argparse
import inspect
from collections.abc import Callable, Sequence
from typing import NamedTuple

from gp_ground_seg.cli import options
from gp_ground_seg.cli.evaluate import OF_FRAMES, ROOT, frames_from_options, print_report
from gp_ground_seg.lab import experiments
from gp_ground_seg.lab.cluster import Runner
from gp_ground_seg.lab.scoring.report import Report
from gp_ground_seg.lab.simulation import DRIVES, LOW, SCENES, SENSORS, STEEP

THREE = ('hdl-64e', 'vlp-16', 'os1-128')
EXAMPLES = """\
  gp-ground-seg experiment ablation KITTI_ROOT
  gp-ground-seg experiment scenes --sensors vlp-16 --scenes kerb
  gp-ground-seg experiment NAME --help          describes one of them
"""


class Experiment(NamedTuple):
    """A function from scans, parameters and a runner to tables; its docstring is the help.

    With `sensors` it simulates scans, by default of these and in these scenes.
    """

    run: Callable[..., Report]
    sensors: Sequence[str] = ()
    scenes: Sequence[str] = ()
    n_seeds: int = 0  # scenes of each kind
    places: Sequence[float] = ()  # of the sensor in each scene [m]
    labelled: bool = True  # whether it takes labelled frames
    is_timed: bool = False  # then it runs in one process


EXPERIMENTS = {
    'ablation': Experiment(
        experiments.compare_models, THREE[:1], ['road_then_rubble'], 10, (0.0, 6.0, 12.0)
    ),
    'steps': Experiment(experiments.compare_steps),
    'pseudo-inputs': Experiment(experiments.compare_pseudo_inputs, is_timed=True),
    'scenes': Experiment(
        experiments.score_scenes, THREE, (*DRIVES, *LOW, *STEEP), 3, (0.0, 6.0), labelled=False
    ),
    'table1': Experiment(experiments.table1, is_timed=True),
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
        child.set_defaults(run=run, root=None, workers=None, scheduler=None)
        if experiment.labelled:
            count = {'nargs': '?'} if experiment.sensors else {}
            options.add(child, (*ROOT[:2], {**ROOT[2], **count}), *OF_FRAMES)
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
        options.add(child, options.MARKDOWN, options.TO_JSON, options.FORCE)
        if not experiment.is_timed:
            options.add_cluster(child)
        options.add_config(child)


def run(arguments: argparse.Namespace) -> int:
    """Measure, write the file, print the tables."""
    name, experiment = arguments.experiment, EXPERIMENTS[arguments.experiment]
    config, is_simulated = options.read_config(arguments), arguments.root is None
    others = ('sequences', 'frame_step') if is_simulated else ('sensors', 'scenes', 'seeds')
    kind = 'labelled' if is_simulated else 'simulated'
    options.refuse(arguments, others, f'is for {kind} scans')

    def measured(runner: Runner) -> Report:
        if not is_simulated:
            return experiment.run(frames_from_options(arguments), config, runner)
        scans = experiments.simulated_frames(
            arguments.sensors or experiment.sensors,
            arguments.scenes or experiment.scenes,
            arguments.seeds or experiment.n_seeds,
            experiment.places,
        )
        return experiment.run(scans, config, runner)

    print_report(arguments, name, measured, experiment=name)
    return 0
