"""``experiment``: the experiments of docs/, each a function from scans to tables."""

from __future__ import annotations

import argparse
import inspect
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

from gp_ground_seg.cli import options
from gp_ground_seg.cli.evaluate import OF_FRAMES, ROOT, frames_from_options
from gp_ground_seg.core.errors import DataError
from gp_ground_seg.lab.experiments import ablation
from gp_ground_seg.lab.experiments.scenes import CROWDED, score_objects, score_scenes
from gp_ground_seg.lab.experiments.speed import measure_speed
from gp_ground_seg.lab.experiments.table1 import table1
from gp_ground_seg.lab.experiments.variants import simulated_frames
from gp_ground_seg.lab.scoring.report import Report, describe_environment, machine_line, written
from gp_ground_seg.lab.simulation import DRIVES, LOW, SCENES, SENSORS, STEEP

Option = tuple[str, str, dict[str, Any]]

THREE = ('hdl-64e', 'vlp-16', 'os1-128')
EXAMPLES = """\
  gp-ground-seg experiment ablation KITTI_ROOT
  gp-ground-seg experiment scenes --sensors vlp-16 --scenes kerb
  gp-ground-seg experiment NAME --help          describes one of them
"""
SIMULATED = ('--simulated', 'simulated scans instead of ROOT', options.FLAG)
NO_PEER = (
    '--no-peer',
    'leave Patchwork++ out, which needs pip install pypatchworkpp',
    options.FLAG,
)


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

    @property
    def has_peer(self) -> bool:
        """Whether Patchwork++ can run beside it."""
        return 'with_peer' in inspect.signature(self.run).parameters

    @property
    def options(self) -> list[Option]:
        """Options of its scans, and ``--no-peer``."""
        found: list[Option] = []
        if self.labelled:
            optional = (*ROOT[:2], {**ROOT[2], 'nargs': '?'})
            found += [optional, SIMULATED] if self.sensors else [ROOT]
            found += OF_FRAMES
        return [*found, *self.simulated_options, *[NO_PEER] * self.has_peer]

    @property
    def simulated_options(self) -> list[Option]:
        """Options of simulated scans."""
        if not self.sensors:
            return []
        n_seeds = f'scenes of each kind (default: {self.n_seeds})'
        return [
            _some_of('--sensors', SENSORS, self.sensors),
            _some_of('--scenes', SCENES, self.scenes),
            ('--seeds', n_seeds, options.NUMBER),
        ]


EXPERIMENTS = {
    'ablation': Experiment(
        ablation.compare_models, ['hdl-64e'], [ablation.SCENE], 10, ablation.PLACES
    ),
    'steps': Experiment(ablation.compare_steps),
    'pseudo-inputs': Experiment(ablation.compare_pseudo_inputs, is_timed=True),
    'scenes': Experiment(
        score_scenes, THREE, (*DRIVES, *LOW, *STEEP), 3, places=(0.0, 6.0), labelled=False
    ),
    'objects': Experiment(score_objects, [*SENSORS], CROWDED, n_seeds=2, labelled=False),
    'table1': Experiment(table1, is_timed=True),
    'speed': Experiment(measure_speed, is_timed=True),
}
"""Experiments by name. A new one is a row here and its function."""


def _some_of(option: str, known: Iterable[str], default: Iterable[str]) -> Option:
    """Option that takes names of scenes or sensors."""
    text = f'some of {",".join(known)} (default: {",".join(default)})'
    return option, text, {'metavar': 'LIST', 'type': options.some_of(known)}


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
        options.add(child, *experiment.options, options.MARKDOWN, options.TO_JSON, options.FORCE)
        if experiment.is_timed:
            child.set_defaults(workers=None, scheduler=None)
        else:
            options.add_cluster(child)
        options.add_config(child)
        child.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Measure, write the file, print the tables."""
    experiment = EXPERIMENTS[arguments.experiment]
    _check_source(arguments, experiment)
    config = options.read_config(arguments)
    more: dict[str, Any] = {'with_peer': not arguments.no_peer} if experiment.has_peer else {}
    packages = ['pypatchworkpp'] if any(more.values()) else []
    with options.staged_json(arguments) as path:
        with options.runner(arguments, arguments.experiment) as runner:
            report = experiment.run(_scans(arguments, experiment), config, runner, **more)
            n_workers = runner.n_workers
        environment = describe_environment(*packages)
        environment['n_workers'] = n_workers
        if path is not None:
            given = {name: getattr(arguments, name) for name in map(_name, experiment.options)}
            report.facts.update(experiment=arguments.experiment, options=given)
            report.write(path, environment)
    lines = [machine_line(environment, report.backend)]
    print(written(report.tables.values(), lines, markdown=arguments.markdown))
    return 0


def _name(option: Option) -> str:
    return option[0].lstrip('-').replace('-', '_')


def _check_source(arguments: argparse.Namespace, experiment: Experiment) -> None:
    """Refuse options that contradict one another."""
    if not (experiment.labelled and experiment.sensors):
        return
    if arguments.simulated == (arguments.root is not None):
        raise DataError(f'{arguments.experiment}: give either ROOT or --simulated')
    refused = OF_FRAMES if arguments.simulated else experiment.simulated_options
    for option in refused:
        if getattr(arguments, _name(option)) is not None:
            kind = 'labelled frames' if arguments.simulated else '--simulated'
            raise DataError(f'{option[0]}: is for {kind} only')


def _scans(arguments: argparse.Namespace, experiment: Experiment) -> Sequence[Any]:
    """Return labelled frames, or scans to simulate."""
    if experiment.labelled and not getattr(arguments, 'simulated', False):
        return frames_from_options(arguments)
    return simulated_frames(
        arguments.sensors or experiment.sensors,
        arguments.scenes or experiment.scenes,
        arguments.seeds or experiment.n_seeds,
        experiment.places,
    )
