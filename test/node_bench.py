"""Latency and losses of the node: ``python test/node_bench.py [ROOT]``, on an idle machine.

The node runs in a second process and is sent clouds through ROS at several rates, in a namespace
of a random name: frames of a KITTI_ROOT, or simulated scans of a sensor. What follows
``--ros-args`` goes to the node.
"""

import argparse
import itertools
import os
import sys
import tempfile
import time
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd

from gp_ground_seg.cli.demo import FRAME_ID
from gp_ground_seg.cli.options import progress
from gp_ground_seg.data.bags import cloud_from_points, decode_cloud, encode_cloud, with_stamp
from gp_ground_seg.data.point_cloud2 import stamp_of
from gp_ground_seg.data.semantic_kitti import frames
from gp_ground_seg.lab.scoring.report import describe_environment, machine_line
from gp_ground_seg.lab.simulation import SCENES, SENSORS, simulate_scan
from gp_ground_seg.ros.node_process import INPUT, OUTPUTS, Link, NodeProcess, private_session

SILENCE = 2.0
"""Time without a cloud after which what is still missing is lost [s]."""
N_READ, N_SIMULATED = 30, 10  # different clouds
RATES, N_SENT = (10.0, 20.0, 50.0), 600  # [Hz], clouds at each
PERCENTILES = {50: 'p50 [ms]', 95: 'p95', 99: 'p99', 100: 'worst'}


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


class Probe:
    """Sends clouds at a rate, whether or not results come back, and notes when both did."""

    def __init__(self, session):
        from sensor_msgs.msg import PointCloud2

        self._session, self._sent, self._back = session, {}, {}
        self._publisher = session.publisher_of_clouds(INPUT, 10)
        for topic in OUTPUTS:
            take = partial(self._take, topic)
            session.node.create_subscription(PointCloud2, topic, take, 50, raw=True)

    def _take(self, topic, raw, info):
        back = self._back.setdefault(stamp_of(decode_cloud(raw).header), {})
        back[topic] = info.get('received_timestamp') or time.time_ns()
        self._last_news = time.monotonic()

    def send(self, clouds, rate, on_sent):
        """Send clouds at a rate [Hz]; return counts, and percentiles of the latency."""
        self._sent.clear()
        due = time.monotonic()
        for cloud in clouds:
            raw = encode_cloud(cloud)
            while (left := due - time.monotonic()) > 0.0:
                self._session.spin(left)
            self._sent[stamp_of(cloud.header)] = time.time_ns()
            self._publisher.publish(raw)
            on_sent()
            due += 1.0 / rate
        self._last_news = time.monotonic()
        while time.monotonic() < self._last_news + SILENCE:
            self._session.spin(0.02)
        latency = [
            1e-6 * (max(back.values()) - sent)
            for stamp, sent in self._sent.items()
            if len(back := self._back.get(stamp, {})) == len(OUTPUTS)
        ]
        first, *_, last = self._sent.values()
        n_sent = len(self._sent)
        percents = np.percentile(latency or [np.nan], [*PERCENTILES])
        return {
            'rate [Hz]': rate,
            'sent [Hz]': 1e9 * (n_sent - 1) / (last - first),
            'sent': n_sent,
            'lost': n_sent - len(latency),
            **dict(zip(PERCENTILES.values(), percents, strict=True)),
        }


def restamped(clouds, start):
    """Yield clouds over and over, stamped every 0.1 s from the second `start` on."""
    for k, cloud in enumerate(itertools.cycle(clouds)):
        yield with_stamp(cloud, 10**9 * start + 10**8 * k)


def cpu_of(pid):
    """CPU time of a process and of those of its children that have ended [s]."""
    fields = Path(f'/proc/{pid}/stat').read_text().rpartition(')')[2].split()
    return sum(map(int, fields[11:15])) / os.sysconf('SC_CLK_TCK')


def measure(clouds, ros_args):
    """Results at each rate, with what the node says it dropped, and its CPU time of a cloud."""
    from diagnostic_msgs.msg import DiagnosticArray

    stamped = restamped(clouds, 1_700_000_000)
    with (
        private_session('node_bench') as (session, own),
        tempfile.TemporaryDirectory(prefix='gp_ground_seg-') as folder,
        NodeProcess(Path(folder, 'log'), [*own, *ros_args]) as node,
    ):
        arrays, results = [], []
        session.node.create_subscription(DiagnosticArray, '/diagnostics', arrays.append, 10)
        Link(session, node).connect(clouds[0])
        while not node.is_compiled() and 'runtime.backend:=numpy' not in ros_args:
            session.sleep(0.2)
            node.check()
        probe = Probe(session)
        for rate in RATES:
            before, cpu = dropped_by_node(session, arrays), cpu_of(node.pid)
            with progress(f'{rate:g} Hz')(total=N_SENT) as bar:
                found = probe.send(itertools.islice(stamped, N_SENT), rate, bar.update)
            found['CPU [ms]'] = 1e3 * (cpu_of(node.pid) - cpu) / N_SENT
            n_dropped = dropped_by_node(session, arrays) - before
            results.append({**found, 'reported': n_dropped})
        node.check()
    return results


def main():
    """Measure, and print a table."""
    words, mark, ros_args = sys.argv[1:], '--ros-args', []
    if mark in words:
        words, ros_args = words[: words.index(mark)], words[words.index(mark) + 1 :]
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('root', nargs='?')
    parser.add_argument('--sensor', choices=SENSORS, default='hdl-64e', help='that is simulated')
    given = parser.parse_args(words)
    if given.root:
        scans = [frame.points for frame in frames(given.root)[:N_READ]]
    else:
        scans = [
            simulate_scan(SCENES['urban'](1), SENSORS[given.sensor], np.random.default_rng(k), k)
            .points for k in range(N_SIMULATED)
        ]  # fmt: skip
    clouds = [cloud_from_points(points, 0, FRAME_ID) for points in scans]
    n_points = sum(map(len, scans)) / len(scans)
    source = given.root or f'simulated {given.sensor}'
    print(f'{source}: {len(scans)} clouds of {n_points:.0f} points')
    print(pd.DataFrame(measure(clouds, ros_args)).round(1).to_string(index=False))
    print(machine_line(describe_environment(), 'numba'))


if __name__ == '__main__':
    main()
