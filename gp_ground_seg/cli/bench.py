"""``bench``: time per frame by stage, beside Patchwork++ in the same run."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np

from gp_ground_seg.cli.evaluate import add_json_options, progress, staged_options
from gp_ground_seg.cli.options import (
    add_config_options,
    config_from_options,
    new_parser,
    note,
    positive,
)
from gp_ground_seg.cli.segment import find_scans
from gp_ground_seg.data.bag_files import is_bag
from gp_ground_seg.data.bags import BagReader
from gp_ground_seg.data.point_cloud2 import decode_cloud, read_xyz
from gp_ground_seg.data.semantic_kitti import list_frames, list_sequences, read_points
from gp_ground_seg.errors import DataError, MissingDependencyError, PointCloudError
from gp_ground_seg.evaluation.benchmark import (
    MODES,
    BenchFrame,
    bench_cases,
    bench_document,
    run_cases,
    spread,
    time_growth,
)
from gp_ground_seg.evaluation.environment import describe_environment, parameters_line
from gp_ground_seg.evaluation.methods import PATCHWORKPP, TITLES, PatchworkppMethod
from gp_ground_seg.evaluation.table import Cell, Column, Table, fold, write_json
from gp_ground_seg.jit import HAVE_NUMBA
from gp_ground_seg.parameters.config import Config
from gp_ground_seg.plotting.charts import plot_stage_bars

DESCRIPTION = """\
Time the segmentation on your data: theta fixed and learned in every frame, on one
thread and on all, by stage; with pypatchworkpp installed beside Patchwork++ on the same
frames. Each time is taken right before or after that of Patchwork++ on that frame, so that
the ratio of the two holds where the speed of the machine drifts. Reading is left out.
Let nothing else run meanwhile.

DATA is a folder with sequences/*/velodyne below it, a scan, a folder of scans, or a bag.
"""

EXAMPLES = """\
  gp-ground-seg bench KITTI_ROOT
  gp-ground-seg bench drive.mcap --frames 20 --quick
  gp-ground-seg bench KITTI_ROOT --set grid.n_segments=120 --json mine.json
  gp-ground-seg bench --from mine.json --plot stages.png
"""

RUN_LENGTH = 10
"""Successive frames that are taken together where there are more than wanted."""


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Declare the command."""
    parser = new_parser(subparsers, 'bench', DESCRIPTION, EXAMPLES)
    parser.add_argument('data', metavar='DATA', nargs='?', help='scans or a bag')
    parser.add_argument(
        '--frames', metavar='N', type=positive, default=60,
        help='frames, in runs of ten spread over the data (default: %(default)s)',
    )  # fmt: skip
    parser.add_argument(
        '--passes', metavar='N', type=positive, default=1, help='go over the frames so often'
    )
    for name, metavar, what in (
        ('--from', 'FILE', 'show what --json wrote, measure nothing'),
        ('--threads', 'LIST', 'numbers of threads, as in 1,4 (default: 1 and all)'),
        ('--topic', 'T', 'PointCloud2 topic of a bag'),
        ('--plot', 'FILE', 'draw the stages as a PNG'),
    ):
        dest = 'record' if name == '--from' else None
        parser.add_argument(name, metavar=metavar, help=what, dest=dest)
    for name, what in (
        ('--numpy', 'time learning without compiled code as well'),
        ('--quick', 'no growth with size, no merged clouds'),
    ):
        parser.add_argument(name, action='store_true', help=what)
    add_json_options(parser)
    add_config_options(parser)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Measure or read a record; write the files, print the tables."""
    if (arguments.data is None) == (arguments.record is None):
        raise DataError('bench: name either DATA to measure on or --from FILE')
    if arguments.record is not None:
        document = read_record(arguments.record)
    else:
        with staged_options(arguments, 'json') as parts:
            document = _measure(arguments)
            if 'json' in parts:
                write_json(document, parts['json'])
    print(bench_text(document))
    if arguments.plot is not None:
        _plot(document, arguments)
    return 0


def _plot(document: dict[str, Any], arguments: argparse.Namespace) -> None:
    # Without compiled code a frame takes so long that the others would be but slivers.
    cases = [case for case in document['cases'] if case['backend'] == 'numba']
    peer = document['baseline_ms']
    title = (
        f'{document["n_frames"]} frames of {document["data"]}, '
        f'{round(document["n_points"]["median"] / 1000)} 000 points each, '
        f'{document["environment"]["cpu"]}'
    )
    bars = {case['name']: case['stages_ms'] for case in cases or document['cases']}
    line = (TITLES[document['baseline']], peer['median']) if peer else None
    plot_stage_bars(bars, arguments.plot, title, line, force=arguments.force)


def read_record(path: str | Path) -> dict[str, Any]:
    """Read what ``--json`` wrote; DataError if it cannot be read or is something else."""
    try:
        document = json.loads(Path(path).read_text(encoding='utf-8'))
    except (OSError, ValueError) as error:
        raise DataError(f'{path}: cannot be read: {error}') from error
    if not isinstance(document, dict) or not {'cases', 'growth', 'baseline'} <= set(document):
        raise DataError(f'{path}: not a record of `gp-ground-seg bench --json`')
    return document


def _measure(arguments: argparse.Namespace) -> dict[str, Any]:
    config = config_from_options(arguments)
    environment = describe_environment('pypatchworkpp')
    threads = _threads(arguments.threads, config, environment.n_cores)
    cases = bench_cases(config, threads, with_numpy=arguments.numpy)
    try:
        PatchworkppMethod()
        baseline = PATCHWORKPP
    except MissingDependencyError:
        note('no ratios without the baseline: pip install pypatchworkpp')
        baseline = None
    frames = load_frames(Path(arguments.data), arguments.frames, arguments.topic)
    measured = run_cases(
        frames, cases, (lambda _: PatchworkppMethod()) if baseline else None, arguments.passes,
        progress=progress('frames'),
    )  # fmt: skip
    growth = []
    if not arguments.quick:
        growth = time_growth(frames, config, progress=progress('sizes', 'size'))
    data = Path(arguments.data).resolve().name
    return bench_document(measured, growth, config, environment, baseline, data)


def _threads(text: str | None, config: Config, n_cores: int) -> list[int]:
    if not HAVE_NUMBA or config.runtime.backend == 'numpy':
        return [1]
    if text is None:
        return sorted({1, n_cores})
    try:
        threads = [int(word) for word in text.split(',')]
    except ValueError:
        threads = []
    if not threads or min(threads) < 1 or len(set(threads)) < len(threads):
        raise DataError(f'--threads {text}: must be different whole numbers from 1, as in 1,4')
    return threads


def load_frames(source: Path, n_frames: int, topic: str | None = None) -> list[BenchFrame]:
    """Read at most about `n_frames` frames into memory, in runs spread over all there are.

    `source` is a folder with sequences/*/velodyne below it, a scan, a folder of scans, or a bag.
    Raises DataError if there is nothing to read there, or no point in it.
    """
    if not source.exists():
        raise DataError(f'{source}: no such file or folder')
    if is_bag(source):
        frames = _bag_frames(source, n_frames, topic)
    elif topic is not None:
        raise DataError(f'--topic: is for bags, which {source} is not')
    else:
        if any(source.glob('sequences/*/velodyne')):
            names = list_sequences(source)
            paths = {
                name: [one.points_path for one in list_frames(source, name)] for name in names
            }
        else:
            paths = {source.stem: find_scans(source)}
        frames = [
            BenchFrame(run_name, own[k].stem, read_points(own[k]))
            for name, own in paths.items()
            for run_name, k in runs(name, len(own), max(n_frames // len(paths), 1))
        ]
    if not any(len(frame.points) for frame in frames):
        raise DataError(f'{source}: no point in any of {len(frames)} frames')
    return frames


def _bag_frames(source: Path, n_frames: int, topic: str | None) -> list[BenchFrame]:
    frames = []
    with BagReader(source) as bag:
        name = bag.pick_point_cloud_topic(topic)
        wanted = {k: run_name for run_name, k in runs(name, bag.n_messages(name), n_frames)}
        for k, (_, time, raw) in enumerate(bag.messages([name])):
            if k in wanted:
                try:
                    xyz = read_xyz(decode_cloud(raw))
                except PointCloudError as error:
                    raise DataError(f'{source}: message {k} of topic {name}: {error}') from error
                # With full intensity Patchwork++ drops no point as noise.
                points = np.ones((len(xyz), 4), dtype=np.float32)
                points[:, :3] = xyz
                frames.append(BenchFrame(wanted[k], str(time), points))
    return frames


def runs(name: str, n_available: int, n_wanted: int) -> list[tuple[str, int]]:
    """Name and index of frames in runs of `RUN_LENGTH`, spread evenly; all if no more are there.

    Each run has a name of its own: what is temporal must not reach over the hole before it.
    """
    if n_available <= n_wanted:
        return [(name, k) for k in range(n_available)]
    length = min(RUN_LENGTH, n_wanted)
    starts = [length * k for k in spread(n_available // length, n_wanted // length)]
    return [
        (name if len(starts) == 1 else f'{name}:{start}', k)
        for start in starts
        for k in range(start, start + length)
    ]


def bench_text(document: dict[str, Any]) -> str:
    """Lay out a `gp_ground_seg.evaluation.benchmark.bench_document` for the terminal."""
    run = document['environment']
    versions = ', '.join(f'{name} {v or "absent"}' for name, v in run['versions'].items())
    footer = (
        parameters_line(document['config_changes']),
        f'machine: {run["cpu"]}, {run["n_cores"]} cores for this process',
        f'versions: Python {run["python"]}, {versions}',
        f'commit: {run["commit"] or "unknown"}',
    )
    tables = [_case_table(document), _stage_table(document['cases'])]
    if document['growth']:
        tables.append(_growth_table(document['growth']))
    return '\n\n'.join([*(table.text() for table in tables), '\n'.join(map(fold, footer))])


def _case_table(document: dict[str, Any]) -> Table:
    cases, peer = document['cases'], document['baseline_ms']
    n_points = document['n_points']
    median, largest = (f'{round(n_points[key]):_d}'.replace('_', ' ') for key in ('median', 'max'))
    rows: list[list[Cell]] = [[c['name'], c['ms']['median'], c['ms']['p99']] for c in cases]
    columns = [Column('time per frame, reading left out')]
    columns += [Column('median [ms]', '.2f'), Column('p99 [ms]', '.2f')]
    if peer:
        name = TITLES[document['baseline']]
        columns += [Column(f'/ {name}', '.2f'), Column('p99 / its median', '.2f')]
        for row, case in zip(rows, cases, strict=True):
            row += case['ratio'].values()
        rows.append([name, peer['median'], peer['p99'], 1.0, peer['p99'] / peer['median']])
    title = (
        f'{document["n_frames"]} frames of {document["data"]}, {median} points (median), '
        f'at most {largest}'
    )
    return Table(columns, rows, title, n_sums=1 if peer else 0)


def _stage_table(cases: list[dict[str, Any]]) -> Table:
    stages = [Column(name, '.2f') for name in cases[0]['stages_ms']]
    rows = [[case['name'], *case['stages_ms'].values()] for case in cases]
    return Table([Column('stage, median [ms]'), *stages], rows)


def _growth_table(growth: list[dict[str, Any]]) -> Table:
    columns = {'series': Column('growth with'), 'size': Column('size', '_.0f')}
    for mode, title in MODES.items():
        columns[f'{mode}_ms'] = Column(f'{title} [ms]', '.2f')
        columns[f'{mode}_ratio'] = Column('/ default', '.2f')
    title = (
        'One thread; times over those of the same frames with the parameters given. More points '
        'than a frame has are two and four successive frames laid over one another'
    )
    return Table([*columns.values()], [[row[key] for key in columns] for row in growth], title)
