"""``node-bench``: latency, losses and memory of the node, over DDS between two processes."""

from __future__ import annotations

import argparse
import itertools
import tempfile
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gp_ground_seg.cli.bench import load_frames
from gp_ground_seg.cli.demo import START_TIMEOUT
from gp_ground_seg.cli.demo_frames import FRAME_ID, TOPIC, simulated_drive
from gp_ground_seg.cli.demo_node import NodeProcess, private_network
from gp_ground_seg.cli.demo_tally import OUTPUTS
from gp_ground_seg.cli.node_bench_text import document_of, goals_missed, node_bench_text
from gp_ground_seg.cli.notes import note
from gp_ground_seg.cli.output import count, progress_bar
from gp_ground_seg.cli.play import needing_ros
from gp_ground_seg.cli.process_memory import peak_memory, resident_memory
from gp_ground_seg.data.atomic_output import staged_file
from gp_ground_seg.data.point_cloud2 import CloudMessage, cloud_from_columns
from gp_ground_seg.errors import DataError, GroundSegError
from gp_ground_seg.evaluation.environment import describe_environment
from gp_ground_seg.evaluation.table import write_json
from gp_ground_seg.evaluation.trips import (
    MemoryResult,
    RateResult,
    Trip,
    memory_result,
    rate_result,
)
from gp_ground_seg.ros.transport import large_cloud_transport

if TYPE_CHECKING:
    from gp_ground_seg.ros.load_test import LoadTest

SEED = 3
N_SIMULATED = 10
RATES = '10,20,50'
FEWEST = 10
EXIT_MISSED = 1

DESCRIPTION = """\
Start the node in a second process and send it clouds through ROS: at several rates, to
see what is lost and how late the results are back, then one by one, to see what memory it
takes and whether that grows. Both processes have a ROS domain of their own. Let nothing
else run meanwhile: sender and receiver share the machine with the node.

DATA is a folder with sequences/*/velodyne below it, a scan, a folder of scans, or a bag;
without it, simulated scans of an HDL-64E. What follows --ros-args goes to the node.
"""

EXAMPLES = f"""\
examples:
  gp-ground-seg node-bench
  gp-ground-seg node-bench KITTI_ROOT --json node.json
  gp-ground-seg node-bench drive.mcap --rates 10 --frames 100 --memory-frames 0
  gp-ground-seg node-bench KITTI_ROOT --ros-args -p learning.mode:=fixed

exit code: 0, {EXIT_MISSED} if a goal of the table is missed, 2 for an error, 130 when interrupted
"""


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Declare the command; what follows ``--ros-args`` is left to the node."""
    parser = subparsers.add_parser(
        'node-bench',
        help='measure latency, losses and memory of the node',
        description=DESCRIPTION,
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument('data', metavar='DATA', nargs='?', help='scans or a bag')
    parser.add_argument('--topic', metavar='T', help='PointCloud2 topic of a bag')
    parser.add_argument(
        '--clouds', metavar='N', type=_number, default=30,
        help='different clouds, sent over and over (default: %(default)s)',
    )  # fmt: skip
    parser.add_argument(
        '--rates', metavar='LIST', type=_rates, default=RATES,
        help='clouds per second, one after the other (default: %(default)s)',
    )  # fmt: skip
    parser.add_argument(
        '--frames', metavar='N', type=_number, default=600,
        help='clouds sent at each rate (default: %(default)s)',
    )  # fmt: skip
    parser.add_argument(
        '--memory-frames', metavar='N', type=int, default=2000,
        help='clouds sent one by one; 0 = leave memory out (default: %(default)s)',
    )  # fmt: skip
    parser.add_argument('--json', metavar='FILE', help='write every number to this file as well')
    parser.add_argument('--force', action='store_true', help='overwrite the JSON file')
    parser.add_argument('--quiet', action='store_true', help='no progress')
    parser.set_defaults(run=run, accepts_ros_args=True)


def _number(text: str) -> int:
    if not text.isdecimal() or int(text) < FEWEST:
        raise argparse.ArgumentTypeError(f'{text!r}: must be a whole number, at least {FEWEST}')
    return int(text)


def _rates(text: str) -> list[float]:
    try:
        rates = [float(word) for word in text.split(',')]
    except ValueError:
        rates = []
    if not rates or not all(0.1 <= rate <= 1000.0 for rate in rates):
        raise argparse.ArgumentTypeError(f'{text!r}: must be numbers from 0.1 to 1000, as {RATES}')
    return rates


def run(arguments: argparse.Namespace) -> int:
    """Measure, print the table."""
    if arguments.memory_frames and arguments.memory_frames < FEWEST:
        raise DataError(
            f'--memory-frames {arguments.memory_frames}: must be 0 or at least {FEWEST}'
        )
    clouds = load_clouds(arguments)
    with ExitStack() as stack:
        part = None
        if arguments.json is not None:
            # Around the measurement: a target that is refused is so before the work.
            part = stack.enter_context(staged_file(arguments.json, force=arguments.force))
        rates, memory = _measure(arguments, clouds)
        document = document_of(rates, memory, _source(arguments, clouds), describe_environment())
        if part is not None:
            write_json(document, part)
    print(node_bench_text(document))
    return EXIT_MISSED if goals_missed(document) else 0


def load_clouds(arguments: argparse.Namespace) -> list[CloudMessage]:
    """Return the clouds to send, x, y, z and intensity as float32."""
    if arguments.data is not None:
        frames = load_frames(Path(arguments.data), arguments.clouds, arguments.topic)
        points = [frame.points for frame in frames]
    elif arguments.topic is not None:
        raise DataError(f'--topic {arguments.topic}: goes with a bag')
    else:
        n_scans = min(arguments.clouds, N_SIMULATED)
        points = [scan for scan, _, _ in simulated_drive(n_scans, SEED).scans]
    names = ('x', 'y', 'z', 'intensity')
    return [
        cloud_from_columns((0, 0), FRAME_ID, {name: scan[:, k] for k, name in enumerate(names)})
        for scan in points
    ]


def _measure(
    arguments: argparse.Namespace, clouds: Sequence[CloudMessage]
) -> tuple[list[RateResult], MemoryResult | None]:
    with needing_ros('node-bench'):
        from gp_ground_seg.ros.load_test import LoadTest
        from gp_ground_seg.ros.session import ros_session

    with tempfile.TemporaryDirectory(prefix='gp_ground_seg-') as folder, ExitStack() as stack:
        for block in (private_network(), large_cloud_transport()):
            stack.enter_context(block)
        session = stack.enter_context(ros_session('node_bench'))
        words = ('-r', f'points:={TOPIC}', *arguments.ros_args[1:])
        node = stack.enter_context(
            NodeProcess(Path(folder, 'node.log'), words, session.holding_back)
        )
        load = LoadTest(session, TOPIC, OUTPUTS, clouds)
        if not arguments.quiet:
            note('waiting for the node; it compiles when it runs the first time')
        load.connect(START_TIMEOUT, node.check)
        rates = [_at_rate(load, rate, arguments) for rate in arguments.rates]
        node.check()
        memory = None
        if arguments.memory_frames:
            memory = _memory(load, node, arguments)
    return rates, memory


def _at_rate(load: LoadTest, rate: float, arguments: argparse.Namespace) -> RateResult:
    n = arguments.frames
    with progress_bar(n, quiet=arguments.quiet, title=f'{rate:g} Hz') as bar:
        _, dropped_before = load.counters()
        trips = load.paced(rate, n, lambda _trip: bar.update())
        _, dropped = load.counters()
    return rate_result(rate, trips, dropped - dropped_before)


def _memory(load: LoadTest, node: NodeProcess, arguments: argparse.Namespace) -> MemoryResult:
    n = arguments.memory_frames
    resident: list[int] = []
    with progress_bar(n, quiet=arguments.quiet, title='memory') as bar:

        def watch(trip: Trip) -> None:
            if trip.back is None:
                node.check()
                raise GroundSegError(
                    f'no answer to a cloud; the last words of the node:\n{node.log_tail()}'
                )
            resident.append(resident_memory(node.pid))
            bar.update()

        load.one_by_one(n, watch)
    return memory_result(resident, peak_memory(node.pid))


def _source(arguments: argparse.Namespace, clouds: Sequence[CloudMessage]) -> dict[str, Any]:
    n_points = [cloud.width for cloud in clouds]
    return {
        'data': arguments.data or 'simulated HDL-64E',
        'n_clouds': len(clouds),
        'mean_points': sum(n_points) / len(n_points),
        'mean_bytes': sum(len(cloud.data) for cloud in clouds) / len(clouds),
        'node_arguments': list(itertools.islice(arguments.ros_args, 1, None)),
        'title': count(len(clouds), 'cloud'),
    }
