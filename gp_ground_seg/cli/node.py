"""``node``: the ROS 2 node; ``node-bench``: its latency and losses; ``warm-up``."""

from __future__ import annotations

import argparse
import itertools
import sys
import tempfile
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gp_ground_seg.cli import options
from gp_ground_seg.errors import DataError, GroundSegError, MissingDependencyError, install_hint
from gp_ground_seg.ros.lifecycle import needing_ros, stop_on_signals

if TYPE_CHECKING:
    from gp_ground_seg.data.point_cloud2 import CloudMessage

N_SIMULATED = 10
FEWEST = 10

NODE_EXAMPLES = """\
  gp-ground-seg node
  gp-ground-seg node --ros-args -r points:=/kitti/velo/pointcloud
  gp-ground-seg node --ros-args -p label.ground_tolerance:=0.15 --params-file my.yaml
"""
BENCH_DESCRIPTION = """\
Start the node in a second process and send it clouds through ROS at several rates, to see
what is lost and how late the results are back. Both processes have a ROS domain of their
own. Let nothing else run meanwhile: sender and receiver share the machine with the node.

DATA is a folder with sequences/*/velodyne below it, a scan, a folder of scans, or a bag;
without it, simulated scans of an HDL-64E. What follows --ros-args goes to the node.
"""
BENCH_EXAMPLES = """\
  gp-ground-seg node-bench
  gp-ground-seg node-bench KITTI_ROOT --json node.json
  gp-ground-seg node-bench drive.mcap --rates 10 --frames 100
  gp-ground-seg node-bench KITTI_ROOT --ros-args -p learning.mode:=fixed
"""
WARM_UP_DESCRIPTION = """\
Compile beforehand what a robot, or an image for one, would compile at its first start: the
node then has its compiled code after a second instead of a minute. The code is kept on disk,
for this version, this processor and this user.
"""
WARM_UP_EXAMPLES = """\
  gp-ground-seg warm-up
  NUMBA_CACHE_DIR=/opt/robot/numba gp-ground-seg warm-up
"""


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Declare the commands; what follows ``--ros-args`` is left to ROS or the node."""
    description = 'Run the ROS 2 node: points in, ground and obstacles out.'
    parser = options.new_parser(subparsers, 'node', description, NODE_EXAMPLES)
    parser.usage = 'gp-ground-seg node [--ros-args ...]'
    parser.set_defaults(run=lambda a: start(a.ros_args), accepts_ros_args=True)

    parser = options.new_parser(subparsers, 'warm-up', WARM_UP_DESCRIPTION, WARM_UP_EXAMPLES)
    parser.set_defaults(run=run_warm_up)

    parser = options.new_parser(subparsers, 'node-bench', BENCH_DESCRIPTION, BENCH_EXAMPLES)
    number: dict[str, Any] = {'metavar': 'N', 'type': partial(options.positive, least=FEWEST)}
    options.add(
        parser,
        ('data', 'scans or a bag', {'metavar': 'DATA', 'nargs': '?'}),
        ('--topic', 'PointCloud2 topic of a bag', {'metavar': 'T'}),
        ('--clouds', 'different clouds, sent over and over (default: %(default)s)',
         {**number, 'default': 30}),
        ('--rates', 'clouds per second, one after the other (default: %(default)s)',
         {'metavar': 'LIST', 'type': _rates, 'default': '10,20,50'}),
        ('--frames', 'clouds sent at each rate (default: %(default)s)',
         {**number, 'default': 600}),
        *options.SCAN_LAYOUT,
        options.TO_JSON,
        options.FORCE,
        options.QUIET,
    )  # fmt: skip
    parser.set_defaults(run=run_bench, accepts_ros_args=True)


def _rates(text: str) -> list[float]:
    return [options.above_zero(word) for word in text.split(',')]


def start(words: Sequence[str]) -> int:
    """Run the node until a signal; return its exit code, or raise where there is no ROS."""
    # Importing ROS takes most of a second; a signal within it is obeyed as well.
    with stop_on_signals() as stop:
        with needing_ros('the node'):
            from gp_ground_seg.ros.node import main as run_node
        return 0 if stop.made else run_node(words)


def main() -> int:
    """Entry point ``ground_segmentation_node``; says what is missing where there is no ROS."""
    try:
        return start(sys.argv[1:])
    except GroundSegError as error:
        print(f'ground_segmentation_node: error: {error}', file=sys.stderr)
        return 2


def run_warm_up(_arguments: argparse.Namespace) -> int:
    """Compile all code that a frame needs, in this process."""
    from gp_ground_seg.jit import HAVE_NUMBA, code_folder
    from gp_ground_seg.segmenter import warm_up

    if not HAVE_NUMBA:
        raise MissingDependencyError(
            f'numba is not installed, nothing to compile: {install_hint("numba")}'
        )
    begin = time.monotonic()
    warm_up().close()
    seconds, folder = time.monotonic() - begin, code_folder()
    if folder is None:
        raise GroundSegError('compiled code is not kept on disk, see the note above')
    print(f'compiled code is kept in {folder}; it was there after {seconds:.1f} s')
    return 0


def run_bench(arguments: argparse.Namespace) -> int:
    """Measure, print the table."""
    from gp_ground_seg.evaluation.report import describe_environment, write_json

    clouds = _load_clouds(arguments)
    with options.staged_options(arguments, 'json') as parts:
        document = {
            'source': {
                'data': arguments.data or 'simulated HDL-64E',
                'n_clouds': len(clouds),
                'mean_points': sum(cloud.width for cloud in clouds) / len(clouds),
                'mean_bytes': sum(len(cloud.data) for cloud in clouds) / len(clouds),
                'node_arguments': arguments.ros_args[1:],
            },
            'rates': _measure(arguments, clouds),
            'environment': describe_environment(),
        }
        if 'json' in parts:
            write_json(document, parts['json'])
    print(_text(document))
    return 0


def _load_clouds(arguments: argparse.Namespace) -> list[CloudMessage]:
    """Return the clouds to send, x, y, z and intensity as float32."""
    from gp_ground_seg.cli.bags import scan_cloud
    from gp_ground_seg.cli.bench import frames_from_options
    from gp_ground_seg.cli.demo import FRAME_ID, simulated_drive

    if arguments.data is not None:
        points = [frame.points for frame in frames_from_options(arguments, arguments.clouds)]
    elif arguments.topic is not None:
        raise DataError(f'--topic {arguments.topic}: goes with a bag')
    else:
        options.refuse_scan_layout(arguments, 'a simulated one')
        points = [scan for scan, _, _ in simulated_drive(min(arguments.clouds, N_SIMULATED)).scans]
    return [scan_cloud(scan, 0, FRAME_ID) for scan in points]


def _measure(
    arguments: argparse.Namespace, different: Sequence[CloudMessage]
) -> list[dict[str, Any]]:
    """Return the results at each rate."""
    from gp_ground_seg.ros import probe as probing

    quiet, words, n = arguments.quiet, arguments.ros_args[1:], arguments.frames
    stamped = probing.restamped(different, 1_700_000_000)
    with (
        needing_ros('node-bench'),
        probing.probe_session('node_bench') as (session, own),
        tempfile.TemporaryDirectory(prefix='gp_ground_seg-') as folder,
        probing.NodeProcess(Path(folder, 'log'), [*own, *words], Path(folder)) as node,
    ):
        probe = probing.Probe(session, lambda *_: None)
        if not quiet:
            options.note('waiting for the node; it compiles when it runs the first time')
        probe.connect(node)
        rates = []
        for rate in arguments.rates:
            _, dropped_before = probe.counters()
            with options.progress(f'{rate:g} Hz', quiet=quiet)(total=n) as bar:
                trips = probe.paced(itertools.islice(stamped, n), rate, bar.update)
            _, dropped = probe.counters()
            rates.append(probing.rate_result(rate, trips, dropped - dropped_before))
        node.check()
    return rates


def _text(document: dict[str, Any]) -> str:
    from gp_ground_seg.evaluation.report import Column, Table, milliseconds

    counts = {'sent': 'n_sent', 'back': 'n_back', 'lost': 'n_lost', 'reported': 'n_dropped'}
    percentiles = {'p50 [ms]': 'p50', 'p95': 'p95', 'p99': 'p99', 'worst': 'worst'}
    columns = [
        Column('Rate [Hz]', 'g', 'asked'),
        Column('sent [Hz]', '.2f', 'sent'),
        *(Column(title, 'd', key) for title, key in counts.items()),
        *(milliseconds(title, key) for title, key in percentiles.items()),
    ]
    rows = [[rate[column.key] for column in columns] for rate in document['rates']]
    source, environment = document['source'], document['environment']
    return (
        f'{source["data"]}: {options.count(source["n_clouds"], "cloud")} of '
        f'{source["mean_points"]:.0f} points, {source["mean_bytes"] / 1e6:.2f} MB, on average\n'
        f'{environment["cpu"]}, {environment["n_cores"]} cores\n\n'
        f'{Table(columns, rows).text()}'
    )
