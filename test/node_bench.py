"""Latency and losses of the node: ``python test/node_bench.py [ROOT]``, on an idle machine.

The node runs in a second process and is sent clouds through ROS at several rates, in a namespace
of a random name: frames of a KITTI_ROOT, or simulated scans of a sensor. Its CPU time is beside
that of Patchwork++ at the same rate. For its first minute, set NUMBA_CACHE_DIR to an empty folder.
"""

import argparse
import itertools
import tempfile
import time
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd
from cli_runner import cpu_seconds

from gp_ground_seg.cli.demo import FRAME_ID
from gp_ground_seg.data.bags import cloud_from_points, decode_cloud, encode_cloud, with_stamp
from gp_ground_seg.data.point_cloud2 import stamp_of
from gp_ground_seg.data.semantic_kitti import frames
from gp_ground_seg.lab.scoring.peers import PatchworkppMethod
from gp_ground_seg.lab.scoring.report import describe_environment, machine_line
from gp_ground_seg.lab.simulation import SCENES, SENSORS, simulate_scan
from gp_ground_seg.ros.loader import CHANGED
from gp_ground_seg.ros.node_process import INPUT, OUTPUTS, NodeProcess, private_session

SILENCE = 2.0  # time without a cloud after which what is still missing is lost [s]
N_READ, N_SIMULATED = 30, 10  # different clouds
N_SENT, N_PEER = 600, 100  # clouds at each rate, to the node and to Patchwork++
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
        back = self._back.setdefault(stamp_of(decode_cloud(raw).header), {})
        back[topic] = info.get('received_timestamp') or time.time_ns()
        self._last_news = time.monotonic()

    def send(self, clouds, rate):
        """Send clouds at a rate [Hz]; return counts, and percentiles of the latency."""
        self._sent.clear()
        due = time.monotonic()
        for cloud in clouds:
            raw = encode_cloud(cloud)
            while (left := due - time.monotonic()) > 0.0:
                self._session.spin(left)
            self._sent[stamp_of(cloud.header)] = time.time_ns()
            self._publisher.publish(raw)
            due += 1.0 / rate
        self._last_news = time.monotonic()
        while time.monotonic() < self._last_news + SILENCE:
            self._session.spin(0.02)
        latency = [
            1e-6 * (max(back.values()) - sent)
            for stamp, sent in self._sent.items()
            if len(back := self._back.get(stamp, {})) == len(OUTPUTS)
        ]
        percents = np.percentile(latency or [np.nan], [*PERCENTILES])
        return {
            'rate [Hz]': rate,
            'sent': len(self._sent),
            'lost': len(self._sent) - len(latency),
            **dict(zip(PERCENTILES.values(), percents, strict=True)),
        }


def cpu_of_peer(scans, rate):
    """CPU time of Patchwork++ for a scan, called at a rate [Hz]; NaN where it is not installed."""
    try:
        peer = PatchworkppMethod()
    except ImportError:
        return np.nan
    start, cpu = time.monotonic(), 0.0
    for k in range(N_PEER):
        time.sleep(max(0.0, start + k / rate - time.monotonic()))
        before = time.process_time()
        peer.run(scans[k % len(scans)])
        cpu += time.process_time() - before
    return cpu / N_PEER


def send_orientations(session):
    """Send what a level IMU does, at 200 Hz."""
    from sensor_msgs.msg import Imu

    publisher, level = session.node.create_publisher(Imu, 'imu', 10), Imu()
    level.header.frame_id, level.orientation.w = FRAME_ID, 1.0

    def send():
        level.header.stamp = session.node.get_clock().now().to_msg()
        publisher.publish(level)

    session.node.create_timer(0.005, send)


def measure(scans, given):
    """Results at each rate, with the CPU time of a cloud; print what the node says of its own."""
    clouds = itertools.cycle([cloud_from_points(points, 0, FRAME_ID) for points in scans])
    endless = (with_stamp(cloud, time.time_ns()) for cloud in clouds)
    words = ['-p', 'frame.level:=imu', *given.ros_args] if given.imu else given.ros_args
    expected, results = 'listening' if given.at_once else CHANGED, []
    with private_session('node_bench') as (session, own), tempfile.TemporaryDirectory() as folder:
        node = NodeProcess(Path(folder, 'log'), [*own, *words])
        with node:
            probe = Probe(session)
            if given.imu:
                send_orientations(session)
            while not any(expected in line for line in node.log_lines()):
                session.spin(0.1)
                node.check()
            probe.send(itertools.islice(endless, 0 if given.at_once else 20), 10.0)  # DDS connects
            for rate in given.rates:
                cpu = cpu_seconds(node.pid)
                found = probe.send(itertools.islice(endless, N_SENT), rate)
                found['CPU [ms]'] = 1e3 * (cpu_seconds(node.pid) - cpu) / N_SENT
                results.append({**found, 'Patchwork++ [ms]': 1e3 * cpu_of_peer(scans, rate)})
            node.check()
        print(*(line for line in node.log_lines() if CHANGED in line or 'ends' in line), sep='\n')
    return results


def main():
    """Measure, and print a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('root', nargs='?')
    parser.add_argument('--sensor', choices=SENSORS, default='hdl-64e', help='that is simulated')
    parser.add_argument('--rates', type=float, nargs='+', default=[10.0, 20.0, 50.0], help='[Hz]')
    parser.add_argument('--at-once', action='store_true', help='before its code is compiled')
    parser.add_argument('--imu', action='store_true', help='levelled by one that sends at 200 Hz')
    parser.add_argument('--ros-args', nargs=argparse.REMAINDER, default=[], help='for the node')
    given = parser.parse_args()
    if given.root:
        scans = [frame.points for frame in frames(given.root)[:N_READ]]
    else:
        scans = [
            simulate_scan(SCENES['urban'](1), SENSORS[given.sensor], np.random.default_rng(k), k)
            .points for k in range(N_SIMULATED)
        ]  # fmt: skip
    print(f'{len(scans)} clouds of {sum(map(len, scans)) / len(scans):.0f} points')
    print(pd.DataFrame(measure(scans, given)).round(1).to_string(index=False))
    print(machine_line(describe_environment(), 'numba'))


if __name__ == '__main__':
    main()
