"""``evaluate`` and ``experiment``: measure over labelled or simulated scans, print the tables."""

import inspect
import math
from argparse import Namespace
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from functools import partial
from pathlib import Path
from typing import Any

from gp_ground_seg.cli import options
from gp_ground_seg.core.errors import ConfigError, DataError, require, shown
from gp_ground_seg.core.parameters.config import config_of
from gp_ground_seg.core.parameters.schema import yaml_scalar
from gp_ground_seg.data import files, inputs, semantic_kitti
from gp_ground_seg.lab.cluster import Runner
from gp_ground_seg.lab.experiments import EXPERIMENTS, simulated_frames
from gp_ground_seg.lab.scoring import evaluate, report, tables
from gp_ground_seg.lab.scoring.objects import CUT_HEIGHT
from gp_ground_seg.lab.scoring.peers import PatchworkppMethod
from gp_ground_seg.lab.simulation import SCENES, SENSORS

DESCRIPTION = """\
Segment labelled frames and score the labels in the GroundGrid convention, which leaves
vegetation out: precision, recall, IoU, heights, time per frame. Count vehicles, persons and
cyclists that are lost, returns on low objects (cut at --cut) called ground, and false cells.
docs/accuracy.md says what these are. The last line is the result.

With --against a second set of parameters, or with --peer Patchwork++, runs in turns on the same
frames. Each difference has a bootstrap interval over the sequences, or over blocks of frames of
a single one; in a tie 0 is in it. With --against, ROOT may also be scans without labels, such
as a folder or a bag: the tables have the points with two labels, and the time.

Patchwork++ has its published parameters, and the height and the place of the sensor where they
are given (sensor.height, sensor.origin_x, ...).
"""
EXAMPLES = """\
  gp-ground-seg evaluate KITTI_ROOT
  gp-ground-seg evaluate KITTI_ROOT --sequences 00,08 --json scores.json
  gp-ground-seg evaluate KITTI_ROOT --config my.yaml --against default
  gp-ground-seg evaluate KITTI_ROOT --set faces.max_normal_z=0 --against default
  gp-ground-seg evaluate drive.mcap --config my.yaml --against default
  gp-ground-seg evaluate KITTI_ROOT --peer patchworkpp
  gp-ground-seg evaluate KITTI_ROOT --workers 8

KITTI_ROOT holds sequences/00/{velodyne/*.bin,labels/*.label}. With --workers
scores are the same; times are not: frames are computed at the same time.
"""

EXPERIMENT_EXAMPLES = """\
  gp-ground-seg experiment ablation KITTI_ROOT
  gp-ground-seg experiment scenes --sensors vlp-16 --scenes kerb
  gp-ground-seg experiment NAME --help   describes one of them
"""

ROOT = ('root', 'folder in SemanticKITTI layout', {'metavar': 'ROOT'})
OF_FRAMES = (
    ('--sequences', 'sequences, as in 00,08 (default: all)', {'metavar': 'LIST'}),
    ('--frame-step', 'every Nth frame of a sequence only', options.NUMBER),
    options.COLUMNS,
)
REPORT = options.MARKDOWN, options.TO_JSON, options.FORCE
CUT = (
    '--cut',
    f'height [m] at which objects are cut, to count low objects (default: {CUT_HEIGHT}); '
    '0 = no low objects: each method segments a frame once',
    {'metavar': 'HEIGHT',
     'type': options.value(float, lambda z: 0.0 <= z < math.inf, 'a number, at least 0')},
)  # fmt: skip


def add_parser(subparsers: options.Subparsers) -> None:
    """Declare the commands."""
    peer = 'compare with this method: patchworkpp (pip install pypatchworkpp)'
    options.command(
        subparsers, 'evaluate', DESCRIPTION, EXAMPLES, ROOT, *OF_FRAMES, CUT,
        [('--against', 'compare with this parameter file or preset', {'metavar': 'NAME'}),
         ('--peer', peer, {'choices': ['patchworkpp'], 'metavar': 'METHOD'})],
        *REPORT, options.CLUSTER, *options.CONFIG, run=run_evaluate,
    )  # fmt: skip
    _add_experiments(subparsers)


def _add_experiments(subparsers: options.Subparsers) -> None:
    """Declare `experiment`, and a command below it for each of `EXPERIMENTS`."""
    description = 'Repeat an experiment of docs/: configurations scored over scans.'
    parser = options.command(subparsers, 'experiment', description, EXPERIMENT_EXAMPLES)
    names = parser.add_subparsers(metavar='NAME', required=True, dest='experiment')
    for name, experiment in EXPERIMENTS.items():
        description = inspect.getdoc(experiment.run) or name
        source = ' KITTI_ROOT' if experiment.labelled else ' --sensors vlp-16'
        example = f'  gp-ground-seg experiment {name}{source} --json {name}.json'
        given: list[Any] = []
        if experiment.labelled:
            count = {'nargs': '?'} if experiment.sensors else {}
            given += (*ROOT[:2], {**ROOT[2], **count}), *OF_FRAMES
        if experiment.sensors:
            n_seeds = f'scenes of each kind (default: {experiment.n_seeds})'
            given += [('--seeds', n_seeds, options.NUMBER)]
            for option, known, default in (
                ('--sensors', SENSORS, experiment.sensors),
                ('--scenes', SCENES, experiment.scenes),
            ):
                text = f'some of {", ".join(known)} (default: {", ".join(default)})'
                given += [(option, text, {'metavar': 'LIST', 'type': options.some_of(known)})]
        given += *REPORT, *([] if experiment.is_timed else [options.CLUSTER]), *options.CONFIG
        options.command(
            names, name, f'{description}\n', example, *given, run=run_experiment,
            purpose=description.splitlines()[0].removesuffix('.'),
            root=None, workers=None, scheduler=None,
        )  # fmt: skip


def run_evaluate(arguments: Namespace) -> int:
    """Evaluate, write the files, print the tables."""
    config = options.read_config(arguments)
    cut = CUT_HEIGHT if arguments.cut is None else float(arguments.cut)
    changed: list[str] = []
    methods: list[evaluate.Method] = [evaluate.OurMethod(config)]
    if arguments.peer is not None:
        methods.append(PatchworkppMethod.of_sensor(config.sensor))
    if arguments.against is not None:
        other = config_of(arguments.against)
        methods.append(evaluate.OurMethod(other, shown(Path(arguments.against).name)))
        changed = [
            f'{spec.name}: {yaml_scalar(before)} -> {yaml_scalar(after)} {spec.unit}'.rstrip()
            for spec, before, after in other.differences(config)
        ]
        if not changed:
            raise ConfigError(f'--against {arguments.against}: the same parameters as given')
    items, load = _items(arguments, cut)
    with reporting_runner(arguments, 'evaluate') as runner:
        scores = evaluate.score_methods(items, methods, load, runner=runner)
    if changed:
        print(f'{shown(arguments.against)} -> given:', *changed, '', sep='\n')
    found = tables.evaluation(scores, config)
    print_report(arguments, found, runner, data=arguments.root, cut=cut)
    changes = [f'{name}={value}' for name, value in report.changed_parameters(config).items()]
    print('', f'parameters: {", ".join(changes) or "defaults"}', *_result_lines(scores), sep='\n')
    return 0


def run_experiment(arguments: Namespace) -> int:
    """Measure, write the file, print the tables."""
    name, experiment = arguments.experiment, EXPERIMENTS[arguments.experiment]
    config, is_simulated = options.read_config(arguments), arguments.root is None
    others = ('sequences', 'frame_step') if is_simulated else ('sensors', 'scenes', 'seeds')
    kind = 'labelled' if is_simulated else 'simulated'
    options.refuse(arguments, others, f'is for {kind} scans')

    scans: Sequence[Any] = (
        simulated_frames(
            arguments.sensors or experiment.sensors,
            arguments.scenes or experiment.scenes,
            arguments.seeds or experiment.n_seeds,
            experiment.places,
        )
        if is_simulated
        else frames_from_options(arguments)
    )
    with reporting_runner(arguments, name) as runner:
        found = experiment.run(scans, config, runner)
    print_report(arguments, found, runner, experiment=name)
    return 0


def reporting_runner(arguments: Namespace, title: str) -> AbstractContextManager[Runner]:
    """Return the runner of the options; refuse now what would spoil the report at its end."""
    if arguments.markdown:
        require('tabulate', 'tabulate')
    if arguments.json:
        files.check_writable(arguments.json, force=arguments.force)
    return options.runner(arguments, title)


def print_report(arguments: Namespace, found: report.Report, runner: Runner, **facts: Any) -> None:
    """Write ``--json`` with `facts`, and print the tables."""
    environment = {**report.describe_environment('pypatchworkpp'), 'n_workers': runner.n_workers}
    if arguments.json:
        data = found.encode(environment, **facts)
        files.write_file(Path(arguments.json), data, force=arguments.force)
    machine = report.machine_line(environment, found.backend)
    print(found.text(machine, markdown=arguments.markdown))


def _items(arguments: Namespace, cut: float) -> tuple[Any, Callable[[Any], Any]]:
    """Return labelled frames, or with ``--against`` any clouds, and the reader of a cloud."""
    root = Path(arguments.root)
    if semantic_kitti.is_root(root):
        return frames_from_options(arguments), partial(evaluate.load_kitti, cut=cut)
    if not root.exists():
        raise DataError(f'{root}: no such file or folder')
    if arguments.against is None:
        raise DataError(
            f'{root}: no sequences/*/velodyne folder below it (SemanticKITTI layout); scans '
            'without labels need --against'
        )
    names = ('sequences', 'frame_step', 'cut', 'workers', 'scheduler')
    options.refuse(arguments, names, f'{root} has no sequences/*/velodyne below it')
    found = inputs.list_inputs(root, options.columns_of(arguments))
    name = shown(found.path.stem)
    return found, lambda item: evaluate.KnownScan(name, shown(item.name), item.read().xyz)


def _result_lines(scores: evaluate.Scores) -> list[str]:
    """Return a line for each method on all its scans, ours the last."""
    pooled, lines = tables.measured(scores.scans), []
    medians = scores.scans.groupby('method')['seconds'].median()
    for name in reversed(scores.methods):
        own = pooled.loc[name]
        words = ['no labels of the ground']
        if scores.has_truth:
            titles = {'IoU': 'iou', 'precision': 'precision', 'recall': 'recall'}
            words = [f'{title} {100.0 * own[key]:.2f} %' for title, key in titles.items()]
        if own.get('n_objects'):
            words.append(f'{own["n_lost"]:.0f} of {own["n_objects"]:.0f} objects lost')
        lines.append(f'{name}: {", ".join(words)}, {1e3 * medians[name]:.1f} ms')
    counted = options.count(int(pooled['n_scans'].iloc[0]), 'frame')
    counted += f' of {options.count(len(scores.sequences), "sequence")}'
    return [f'{counted}; GroundGrid convention; median time of a frame', *lines]


def frames_from_options(arguments: Namespace) -> list[semantic_kitti.Frame]:
    """Labelled frames of the options, grouped by sequence."""
    names = arguments.sequences
    chosen = None if names is None else [name for name in names.split(',') if name]
    columns, step = options.columns_of(arguments), arguments.frame_step or 1
    return semantic_kitti.labelled_frames(arguments.root, chosen, columns, step)
