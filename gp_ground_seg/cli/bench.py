"""``bench``: time per frame by stage, beside Patchwork++ in the same run."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np

from gp_ground_seg.cli import options
from gp_ground_seg.core.errors import DataError, MissingDependencyError, shown
from gp_ground_seg.data.inputs import holds_bag, list_inputs
from gp_ground_seg.data.scan_layout import KITTI_COLUMNS
from gp_ground_seg.data.semantic_kitti import list_sequences
from gp_ground_seg.lab.scoring import report
from gp_ground_seg.lab.scoring.benchmark import bench_cases, bench_document, run_cases
from gp_ground_seg.lab.scoring.evaluate import TITLES, KnownScan
from gp_ground_seg.lab.scoring.patchworkpp import PatchworkppMethod
from gp_ground_seg.lab.scoring.report import Column, Table

DESCRIPTION = """\
Measure the time of the segmentation on your data, by stage: with theta fixed and learned in
every frame. If pypatchworkpp is installed, Patchwork++ runs on each frame just before or
after ours, so the ratio of the two times holds although the speed of the machine drifts.
Both take one thread. Reading is left out. Run nothing else meanwhile.

DATA is a folder with sequences/*/velodyne below it, a scan, a folder of scans, or a bag.
"""
EXAMPLES = """\
  gp-ground-seg bench KITTI_ROOT
  gp-ground-seg bench drive.mcap --frames 20
  gp-ground-seg bench KITTI_ROOT --set grid.n_segments=120 --json mine.json
  gp-ground-seg bench --from mine.json
"""

RUN_LENGTH = 10
"""Successive frames that are taken together where there are more than wanted."""


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Declare the command."""
    parser = options.new_parser(subparsers, 'bench', DESCRIPTION, EXAMPLES)
    file = {'metavar': 'FILE'}
    options.add(
        parser,
        ('data', 'scans or a bag', {'metavar': 'DATA', 'nargs': '?'}),
        ('--frames', 'frames, in runs of ten spread over the data (default: %(default)s)',
         {**options.NUMBER, 'default': 60}),
        ('--passes', 'measure all frames N times', {**options.NUMBER, 'default': 1}),
        ('--from', 'show what --json wrote, measure nothing', {**file, 'dest': 'record'}),
        ('--topic', 'PointCloud2 topic of a bag', {'metavar': 'T'}),
        ('--numpy', 'time both without compiled code as well', options.FLAG),
        options.COLUMNS,
        options.TO_JSON,
        options.FORCE,
    )  # fmt: skip
    options.add_config(parser)
    parser.set_defaults(run=run, workers=None, scheduler=None)


def run(arguments: argparse.Namespace) -> int:
    """Measure or read a record; write the files, print the tables."""
    if (arguments.data is None) == (arguments.record is None):
        raise DataError('bench: name either DATA to measure on or --from FILE')
    given = arguments.record
    if given is not None:
        options.refuse_columns(arguments, given)
    with options.staged_options(arguments, 'json') as parts:
        document = _measure(arguments) if given is None else read_record(given)
        if 'json' in parts:
            report.write_json(document, parts['json'])
    print(bench_text(document))
    return 0


def read_record(path: str | Path) -> dict[str, Any]:
    """Read what ``--json`` wrote; DataError if it cannot be read or is something else."""
    try:
        document = json.loads(Path(path).read_text(encoding='utf-8'))
    except ValueError as error:
        raise DataError(f'{path}: cannot be read: {error}') from error
    if not isinstance(document, dict) or not {'cases', 'baseline'} <= set(document):
        raise DataError(f'{path}: not a record of `gp-ground-seg bench --json`')
    return document


def _measure(arguments: argparse.Namespace) -> dict[str, Any]:
    config = options.read_config(arguments)
    environment = report.describe_environment('pypatchworkpp')
    try:
        baseline = PatchworkppMethod().name
    except MissingDependencyError as error:
        options.note(f'no ratios without the baseline: {error}')
        baseline = None
    source = Path(arguments.data)
    if holds_bag(source):
        options.refuse_columns(arguments, source)
    columns = options.columns_of(arguments)
    frames = load_frames(source, arguments.frames, arguments.topic, columns)
    cases = bench_cases(config, with_numpy=arguments.numpy)
    make_baseline = PatchworkppMethod if baseline else None
    with options.runner(arguments, 'bench') as runner:
        measured = run_cases(frames, cases, make_baseline, arguments.passes, runner=runner)
    data = source.resolve().name
    return bench_document(measured, config, environment, baseline, data)


def load_frames(
    source: Path, n_frames: int, topic: str | None = None, columns: int = KITTI_COLUMNS
) -> list[KnownScan]:
    """Read about `n_frames` frames of DATA; DataError if there is no point in any."""
    if topic is None and any(source.glob('sequences/*/velodyne')):
        folders = {name: source / 'sequences' / name for name in list_sequences(source)}
    else:
        folders = {source.stem: source}
    frames = []
    for j, (name, folder) in enumerate(folders.items()):
        inputs = list_inputs(folder, columns, topic)
        # Shares of whole frames that add up to those wanted.
        share = n_frames * (j + 1) // len(folders) - n_frames * j // len(folders)
        wanted = {k: run_name for run_name, k in runs(inputs.topic or name, len(inputs), share)}
        for k, item in enumerate(inputs):
            if k in wanted:
                xyz = item.read().xyz
                # With full intensity Patchwork++ drops no point as noise.
                points = np.ones((len(xyz), 4), dtype=np.float32)
                points[:, : xyz.shape[1]] = xyz
                names = shown(wanted[k]), shown(item.name)
                frames.append(KnownScan(*names, points, {}))
    if not any(len(frame.points) for frame in frames):
        raise DataError(f'{source}: no point in any of {len(frames)} frames')
    return frames


def runs(name: str, n_available: int, n_wanted: int) -> list[tuple[str, int]]:
    """Name and index of frames in runs of `RUN_LENGTH`, spread evenly; all if no more are there.

    Each run has another name: Patchwork++ must not learn over the gap before it.
    """
    if n_available <= n_wanted or not n_wanted:
        return [(name, k) for k in range(min(n_available, n_wanted))]
    length = min(RUN_LENGTH, n_wanted)
    n_places, n_runs = n_available // length, n_wanted // length
    starts = [length * ((2 * k + 1) * n_places // (2 * n_runs)) for k in range(n_runs)]
    return [
        (name if n_runs == 1 else f'{name}:{start}', k)
        for start in starts
        for k in range(start, start + length)
    ]


def bench_text(document: dict[str, Any]) -> str:
    """Lay out a `gp_ground_seg.lab.scoring.benchmark.bench_document` for the terminal."""
    cases = document['cases']
    parameters = report.parameters_line(document['config_changes'])
    machine = report.machine_line(document['environment'])
    by_stage = Table(
        {
            Column('stage, median [ms]'): [case['name'] for case in cases],
            **{
                Column(stage, '.2f'): [case['stages_ms'][stage] for case in cases]
                for stage in cases[0]['stages_ms']
            },
        }
    )
    footer = f'{report.fold(parameters)}\n{report.fold(machine)}'
    return '\n\n'.join([_case_table(document).text(), by_stage.text(), footer])


def _case_table(document: dict[str, Any]) -> Table:
    cases, peer = document['cases'], document['baseline_ms']
    n_points = document['n_points']
    median, largest = (Column('', '_d').show(round(n_points[key])) for key in ('median', 'max'))
    name = TITLES[document['baseline']] if peer else ''

    times = [case['ms'] for case in cases] + ([peer] if peer else [])
    names = [case['name'] for case in cases] + ([name] if peer else [])
    columns = {
        Column('time per frame, reading left out'): names,
        Column('median [ms]', '.2f'): [ms['median'] for ms in times],
        Column('p99 [ms]', '.2f'): [ms['p99'] for ms in times],
    }
    if peer:
        own = {'median': 1.0, 'p99': peer['p99'] / peer['median']}
        ratios = [case['ratio'] for case in cases] + [own]
        columns[Column(f'/ {name}', '.2f')] = [ratio['median'] for ratio in ratios]
        columns[Column(f'p99 / {name} median', '.2f')] = [ratio['p99'] for ratio in ratios]
    title = (
        f'{document["n_frames"]} frames of {document["data"]}, {median} points (median), '
        f'at most {largest}'
    )
    return Table(columns, title, n_sums=1 if peer else 0)
