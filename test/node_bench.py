"""Latency and losses of the node: ``python test/node_bench.py [DATA]``, on an idle machine.

The node runs in a second process and is sent clouds through ROS at several rates, in a namespace
of a random name. DATA is a folder with sequences/*/velodyne below it, a scan, a
folder of scans, or a bag; without it, simulated scans of an HDL-64E. What follows ``--ros-args``
goes to the node.
"""

import argparse
import itertools
import sys
import tempfile
import time
from pathlib import Path

from gp_ground_seg.cli.bags import scan_cloud
from gp_ground_seg.cli.bench import load_frames
from gp_ground_seg.cli.demo import FRAME_ID, simulated_drive
from gp_ground_seg.cli.options import progress
from gp_ground_seg.lab.scoring.report import (
    Column,
    Table,
    describe_environment,
    machine_line,
    milliseconds,
)
from gp_ground_seg.ros.probe import NodeProcess, Probe, probe_session, rate_result, restamped

N_SIMULATED = 10
COUNTS = {'sent': 'n_sent', 'back': 'n_back', 'lost': 'n_lost', 'reported': 'n_dropped'}
PERCENTILES = {'p50 [ms]': 'p50', 'p95': 'p95', 'p99': 'p99', 'worst': 'worst'}
COLUMNS = [
    Column('Rate [Hz]', 'g', 'asked'),
    Column('sent [Hz]', '.2f', 'sent'),
    *(Column(title, 'd', key) for title, key in COUNTS.items()),
    *(milliseconds(title, key) for title, key in PERCENTILES.items()),
]


def dropped_by_node(session, arrays):
    """Clouds that the node has dropped, by its next report."""
    arrays.clear()
    end = time.monotonic() + 5.0
    while not arrays and time.monotonic() < end:
        session.spin(0.05)
    for status in (status for array in arrays for status in array.status):
        if status.name.endswith(': processing'):
            return int({e.key: e.value for e in status.values}['Dropped since startup'])
    raise TimeoutError('no diagnostics of the node within 5 s')


def measure(clouds, rates, n_frames, ros_args=()):
    """Results at each rate, as `rate_result` has them, with what the node says it dropped."""
    from diagnostic_msgs.msg import DiagnosticArray

    stamped = restamped(clouds, 1_700_000_000)
    with (
        probe_session('node_bench') as (session, own),
        tempfile.TemporaryDirectory(prefix='gp_ground_seg-') as folder,
        NodeProcess(Path(folder, 'log'), [*own, *ros_args]) as node,
    ):
        arrays, results = [], []
        session.node.create_subscription(DiagnosticArray, '/diagnostics', arrays.append, 10)
        probe = Probe(session, lambda *_: None)
        probe.connect(node)
        for rate in rates:
            before = dropped_by_node(session, arrays)
            with progress(f'{rate:g} Hz')(total=n_frames) as bar:
                trips = probe.send(itertools.islice(stamped, n_frames), rate, bar.update)
            n_dropped = dropped_by_node(session, arrays) - before
            results.append({**rate_result(rate, trips), 'n_dropped': n_dropped})
        node.check()
    return results


def main():
    """Measure, and print a table."""
    words, mark, ros_args = sys.argv[1:], '--ros-args', []
    if mark in words:
        words, ros_args = words[: words.index(mark)], words[words.index(mark) + 1 :]
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('data', nargs='?')
    parser.add_argument('--topic', help='PointCloud2 topic of a bag')
    parser.add_argument('--clouds', type=int, default=30, help='different clouds')
    parser.add_argument('--rates', type=float, nargs='+', default=[10.0, 20.0, 50.0])
    parser.add_argument('--frames', type=int, default=600, help='clouds sent at each rate')
    given = parser.parse_args(words)
    if given.data:
        frames = load_frames(Path(given.data), given.clouds, given.topic)
        scans = [frame.points for frame in frames]
    else:
        scans = [points for points, _, _ in simulated_drive(N_SIMULATED).scans]
    clouds = [scan_cloud(points, 0, FRAME_ID) for points in scans]
    rates = measure(clouds, given.rates, given.frames, ros_args)
    n_points = sum(map(len, scans)) / len(scans)
    title = f'{given.data or "simulated HDL-64E"}: {len(scans)} clouds of {n_points:.0f} points'
    columns = {column: [rate[column.key] for rate in rates] for column in COLUMNS}
    print(Table(columns, title).text())
    print(machine_line(describe_environment()))


if __name__ == '__main__':
    main()
