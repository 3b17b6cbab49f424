"""``bench``: time per frame by stage, beside Patchwork++ in the same run."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, TypeVar

from tqdm import tqdm

from gp_ground_seg.cli.bench_input import load_frames
from gp_ground_seg.cli.bench_text import bench_text, replace_section
from gp_ground_seg.cli.notes import note
from gp_ground_seg.cli.options import add_config_options, config_from_options
from gp_ground_seg.compiled.cores import usable_cores
from gp_ground_seg.data.atomic_output import staged_file
from gp_ground_seg.errors import DataError, MissingDependencyError
from gp_ground_seg.evaluation.bench import bench_cases, run_cases
from gp_ground_seg.evaluation.bench_report import bench_report
from gp_ground_seg.evaluation.bench_scaling import time_merged, time_scaling
from gp_ground_seg.evaluation.environment import describe_environment
from gp_ground_seg.evaluation.methods import PATCHWORKPP, PatchworkppMethod
from gp_ground_seg.evaluation.report import write_json
from gp_ground_seg.jit import HAVE_NUMBA
from gp_ground_seg.parameters.config import Config
from gp_ground_seg.plotting.charts import plot_stage_bars

DESCRIPTION = """\
Time the segmentation on your data: theta fixed and learned in every frame, on one
thread and on all, by stage; with pypatchworkpp installed beside Patchwork++ on the same
frames. Each time is taken right before or after the yardstick's on that frame, so that
the ratio of the two holds where the speed of the machine drifts. Reading is left out.
Let nothing else run meanwhile.

DATA is a folder with sequences/*/velodyne below it, a scan, a folder of scans, or a bag.
"""

EXAMPLES = """\
examples:
  gp-ground-seg bench KITTI_ROOT
  gp-ground-seg bench drive.mcap --frames 20 --quick
  gp-ground-seg bench KITTI_ROOT --set grid.n_segments=120 --json mine.json
  gp-ground-seg bench --from mine.json --plot stages.png
"""

_Item = TypeVar('_Item')


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Declare the command."""
    parser = subparsers.add_parser(
        'bench',
        description=DESCRIPTION,
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument('data', metavar='DATA', nargs='?', help='scans or a bag')
    parser.add_argument(
        '--from', metavar='FILE', dest='record', help='show what --json wrote, measure nothing'
    )
    parser.add_argument(
        '--frames', metavar='N', type=int, default=60,
        help='frames, in runs of ten spread over the data (default: %(default)s)',
    )  # fmt: skip
    parser.add_argument(
        '--passes', metavar='N', type=int, default=1, help='go over the frames so often'
    )
    parser.add_argument(
        '--threads', metavar='LIST', help='numbers of threads, as in 1,4 (default: 1 and all)'
    )
    parser.add_argument('--topic', metavar='T', help='PointCloud2 topic of a bag')
    parser.add_argument(
        '--numpy', action='store_true', help='time learning without compiled code as well'
    )
    parser.add_argument(
        '--quick', action='store_true', help='no merged clouds, no growth with size'
    )
    parser.add_argument('--json', metavar='FILE', help='write every number to this file as well')
    parser.add_argument('--plot', metavar='FILE', help='draw the stages as a PNG')
    parser.add_argument(
        '--docs', metavar='FILE', help='for developers: put the tables between the marks of FILE'
    )
    parser.add_argument('--force', action='store_true', help='overwrite JSON and PNG')
    add_config_options(parser)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Measure or read a record; write what was asked for, print the tables."""
    if (arguments.data is None) == (arguments.record is None):
        raise DataError('bench: name either DATA to measure on or --from FILE')
    if arguments.record is not None:
        document = read_record(arguments.record)
    else:
        with ExitStack() as stack:
            # Around the measurement: a target that is refused is so before the work.
            part = None
            if arguments.json is not None:
                part = stack.enter_context(staged_file(arguments.json, force=arguments.force))
            document = _measure(arguments)
            if part is not None:
                write_json(document, part)
    print(bench_text(document))
    if arguments.plot is not None:
        _plot(document, arguments)
    if arguments.docs is not None:
        _update_docs(Path(arguments.docs), document)
    return 0


def _plot(document: dict[str, Any], arguments: argparse.Namespace) -> None:
    # Without compiled code a frame takes so long that the others would be but slivers.
    cases = [case for case in document['cases'] if case['backend'] == 'numba']
    peer = document['yardstick_ms']
    plot_stage_bars(
        {case['name']: case['stages_ms'] for case in cases or document['cases']},
        arguments.plot,
        f'{document["n_frames"]} frames of {document["data"]}, '
        f'{round(document["n_points"]["median"] / 1000)} 000 points each, '
        f'{document["environment"]["cpu"]}',
        (document['yardstick'], peer['median']) if peer else None,
        force=arguments.force,
    )


def read_record(path: str | Path) -> dict[str, Any]:
    """Read what ``--json`` wrote.

    Raises
    ------
    DataError
        If the file cannot be read or is something else.
    """
    try:
        document = json.loads(Path(path).read_text(encoding='utf-8'))
    except (OSError, ValueError) as error:
        raise DataError(f'{path}: cannot be read: {error}') from error
    if not isinstance(document, dict) or not {'cases', 'scaling', 'merged'} <= set(document):
        raise DataError(f'{path}: not a record of `gp-ground-seg bench --json`')
    return document


def _measure(arguments: argparse.Namespace) -> dict[str, Any]:
    config = config_from_options(arguments)
    if arguments.frames < 1 or arguments.passes < 1:
        raise DataError('--frames and --passes must be at least 1')
    cases = bench_cases(config, _threads(arguments.threads, config), with_numpy=arguments.numpy)
    yardstick = _yardstick()
    frames = load_frames(Path(arguments.data), arguments.frames, arguments.topic)
    measured = run_cases(frames, cases, yardstick, arguments.passes, progress=_progress('frames'))
    merged, scaling = None, {}
    if not arguments.quick:
        merged = time_merged(frames, config)
        scaling = time_scaling(frames, config, progress=_progress('sizes'))
    packages = ['pypatchworkpp'] if yardstick else []
    return bench_report(
        measured,
        merged,
        scaling,
        config,
        describe_environment(*packages),
        PATCHWORKPP if yardstick else None,
        Path(arguments.data).resolve().name,
    )


def _yardstick() -> Callable[[], PatchworkppMethod] | None:
    try:
        PatchworkppMethod()
    except MissingDependencyError:
        note('no ratios without a yardstick: pip install pypatchworkpp')
        return None
    return PatchworkppMethod


def _threads(text: str | None, config: Config) -> list[int]:
    if not HAVE_NUMBA or config.runtime.backend == 'numpy':
        return [1]
    if text is None:
        return sorted({1, len(usable_cores())})
    try:
        threads = [int(word) for word in text.split(',')]
    except ValueError:
        threads = []
    if not threads or min(threads) < 1 or len(set(threads)) < len(threads):
        raise DataError(f'--threads {text}: must be different whole numbers from 1, as in 1,4')
    return threads


def _progress(title: str) -> Callable[[Sequence[_Item]], Iterable[_Item]]:
    def wrap(items: Sequence[_Item]) -> Iterable[_Item]:
        bar: Iterable[_Item] = tqdm(items, desc=title, file=sys.stderr, disable=None, leave=False)
        return bar

    return wrap


def _update_docs(path: Path, document: dict[str, Any]) -> None:
    try:
        text = path.read_text(encoding='utf-8')
    except (OSError, ValueError) as error:
        raise DataError(f'{path}: cannot be read: {error}') from error
    try:
        text = replace_section(text, document)
    except DataError as error:
        raise DataError(f'{path}: {error}') from error
    with staged_file(path, force=True) as part:
        part.write_text(text, encoding='utf-8')
