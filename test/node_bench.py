"""Latency and losses of the node: ``python test/node_bench.py [KITTI]``, on an idle machine.

The node runs in a second process and is sent clouds through ROS at several rates, in a namespace
of a random name. KITTI is a folder with sequences/*/velodyne below it; without it, simulated
scans of an HDL-64E. What follows ``--ros-args`` goes to the node.
"""

import argparse
import itertools
import sys
import tempfile
import time
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd

from gp_ground_seg.cli.bags import scan_cloud
from gp_ground_seg.cli.demo import FRAME_ID, simulated_drive
from gp_ground_seg.cli.options import progress
from gp_ground_seg.data.bags import decode_cloud, encode_cloud, stamp_of, with_stamp
from gp_ground_seg.data.semantic_kitti import labelled_frames, read_points
from gp_ground_seg.lab.scoring.report import describe_environment, machine_line
from gp_ground_seg.ros.node_process import INPUT, OUTPUTS, Link, NodeProcess, private_session

SILENCE = 2.0
"""Time without a cloud after which what is still missing is lost [s]."""
N_SCANS = 10
PERCENTILES = {50: 'p50 [ms]', 95: 'p95', 99: 'p99', 100: 'worst'}


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
        back = self._back.setdefault(stamp_of(decode_cloud(raw)), {})
        back[topic] = info.get('received_timestamp') or time.time_ns()

    def _latencies(self):
        """Of the clouds that are back [ms]."""
        return [
            1e-6 * (max(back.values()) - sent)
            for stamp, sent in self._sent.items()
            if len(back := self._back.get(stamp, {})) == len(OUTPUTS)
        ]

    def send(self, clouds, rate, on_sent):
        """Send clouds at a rate [Hz]; return counts, and percentiles of the latency."""
        self._sent.clear()
        due = time.monotonic()
        for cloud in clouds:
            raw = encode_cloud(cloud)
            while (left := due - time.monotonic()) > 0.0:
                self._session.spin(left)
            self._sent[stamp_of(cloud)] = time.time_ns()
            self._publisher.publish(raw)
            on_sent()
            due += 1.0 / rate
        n_back = -1
        while n_back < (n := len(self._latencies())) < len(self._sent):
            n_back = n
            self._session.wait_for(lambda n=n: len(self._latencies()) > n, SILENCE)
        first, *_, last = self._sent.values()
        latencies, n_sent = self._latencies(), len(self._sent)
        row = {'rate [Hz]': rate, 'sent [Hz]': 1e9 * (n_sent - 1) / (last - first)}
        row |= {'sent': n_sent, 'back': len(latencies), 'lost': n_sent - len(latencies)}
        percents = np.percentile(latencies or [np.nan], [*PERCENTILES])
        return row | dict(zip(PERCENTILES.values(), percents, strict=True))


def restamped(clouds, start):
    """Yield clouds over and over, stamped every 0.1 s from the second `start` on."""
    for k, cloud in enumerate(itertools.cycle(clouds)):
        yield with_stamp(cloud, (start + k // 10, k % 10 * 10**8))


def measure(clouds, rates, n_frames, ros_args=()):
    """Results at each rate."""
    stamped = restamped(clouds, 1_700_000_000)
    with (
        private_session('node_bench') as (session, own),
        tempfile.TemporaryDirectory(prefix='gp_ground_seg-') as folder,
        NodeProcess(Path(folder, 'log'), [*own, *ros_args]) as node,
    ):
        results = []
        Link(session, node).connect(clouds[0])
        while not node.is_compiled() and 'runtime.backend:=numpy' not in ros_args:
            session.sleep(0.2)
            node.check()
        probe = Probe(session)
        for rate in rates:
            with progress(f'{rate:g} Hz')(total=n_frames) as bar:
                some = itertools.islice(stamped, n_frames)
                results.append(probe.send(some, rate, bar.update))
        node.check()
    return results


def main():
    """Measure, and print a table."""
    words, mark, ros_args = sys.argv[1:], '--ros-args', []
    if mark in words:
        words, ros_args = words[: words.index(mark)], words[words.index(mark) + 1 :]
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('kitti', nargs='?')
    parser.add_argument('--rates', type=float, nargs='+', default=[10.0, 20.0, 50.0])
    parser.add_argument('--frames', type=int, default=600, help='clouds sent at each rate')
    given = parser.parse_args(words)
    if given.kitti:
        frames = labelled_frames(Path(given.kitti))[:N_SCANS]
        scans = [read_points(frame.points_path, frame.columns) for frame in frames]
    else:
        scans = [points for points, _, _ in simulated_drive(N_SCANS)]
    clouds = [scan_cloud(points, 0, FRAME_ID) for points in scans]
    n_points = sum(map(len, scans)) / len(scans)
    print(f'{given.kitti or "simulated HDL-64E"}: {len(scans)} clouds of {n_points:.0f} points')
    rows = measure(clouds, given.rates, given.frames, ros_args)
    print(pd.DataFrame(rows).to_string(index=False, float_format='{:.1f}'.format))
    print(machine_line(describe_environment()))


if __name__ == '__main__':
    main()
