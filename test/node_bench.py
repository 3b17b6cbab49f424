"""Latency and losses of the node: ``python test/node_bench.py [ROOT]``, on an idle machine.

The node runs in a second process and is sent clouds through ROS at several rates, in a namespace
of a random name: frames of a KITTI_ROOT, or simulated scans of a sensor. What follows
``--ros-args`` goes to the node. With --first-minute, rows are of 60 s at 10 Hz from where a node
without compiled code begins to listen, on all cores and on one, or beside a busy loop on each.
"""

import argparse
import contextlib
import itertools
import os
import subprocess
import sys
import tempfile
import time
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd

from gp_ground_seg.cli.bags import scan_cloud
from gp_ground_seg.cli.demo import FRAME_ID
from gp_ground_seg.cli.options import progress
from gp_ground_seg.data.bags import decode_cloud, encode_cloud, stamp_of, with_stamp
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
        back = self._back.setdefault(stamp_of(decode_cloud(raw)), {})
        back[topic] = info.get('received_timestamp') or time.time_ns()

    def _n_back(self):
        return sum(len(self._back.get(stamp, ())) == len(OUTPUTS) for stamp in self._sent)

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
        n_back, last_news = self._n_back(), time.monotonic()
        while n_back < len(self._sent) and time.monotonic() < last_news + SILENCE:
            self._session.spin(0.02)
            if (n := self._n_back()) > n_back:
                n_back, last_news = n, time.monotonic()
        return self._result(rate)

    def _result(self, asked):
        latency = [
            1e-6 * (max(back.values()) - sent)
            for stamp, sent in self._sent.items()
            if len(back := self._back.get(stamp, {})) == len(OUTPUTS)
        ]
        first, *_, last = self._sent.values()
        n_sent = len(self._sent)
        sent_at = 1e9 * (n_sent - 1) / (last - first)
        row = {'rate [Hz]': asked, 'sent [Hz]': sent_at, 'sent': n_sent, 'back': len(latency)}
        percents = np.percentile(latency or [np.nan], [*PERCENTILES])
        return {
            **row,
            'lost': n_sent - len(latency),
            **dict(zip(PERCENTILES.values(), percents, strict=True)),
        }


def restamped(clouds, start):
    """Yield clouds over and over, stamped every 0.1 s from the second `start` on."""
    for k, cloud in enumerate(itertools.cycle(clouds)):
        yield with_stamp(cloud, (start + k // 10, k % 10 * 10**8))


def cpu_of(pid):
    """CPU time of a process and of those of its children that have ended [s]."""
    fields = Path(f'/proc/{pid}/stat').read_text().rpartition(')')[2].split()
    return sum(map(int, fields[11:15])) / os.sysconf('SC_CLK_TCK')


@contextlib.contextmanager
def started(ros_args):
    """A session, and the node of a second process that it talks to."""
    with (
        private_session('node_bench') as (session, own),
        tempfile.TemporaryDirectory(prefix='gp_ground_seg-') as folder,
        NodeProcess(Path(folder, 'log'), [*own, *ros_args]) as node,
    ):
        yield session, node
        node.check()


def measure(clouds, ros_args):
    """Results at each rate, with what the node says it dropped, and its CPU time of a cloud."""
    from diagnostic_msgs.msg import DiagnosticArray

    stamped = restamped(clouds, 1_700_000_000)
    with started(ros_args) as (session, node):
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
    return results


def first_minute(clouds, cores, is_busy, ros_args):
    """Results of the first minute of a node on some `cores`, with nothing compiled before."""
    before, beside, compiled = os.sched_getaffinity(0), [], []
    with tempfile.TemporaryDirectory() as cache, contextlib.ExitStack() as stack:
        os.environ['NUMBA_CACHE_DIR'] = cache
        os.sched_setaffinity(0, cores)  # also of what is started here
        session, node = stack.enter_context(started(ros_args))
        for core in cores if is_busy else ():
            os.sched_setaffinity(0, {core})
            beside.append(subprocess.Popen([sys.executable, '-c', 'while True: pass']))
        os.sched_setaffinity(0, before)
        try:
            probe = Probe(session)
            session.wait_for(lambda: any('listening' in x for x in node.log_lines()), 60.0)
            start = time.monotonic()

            def note():
                if not compiled and node.is_compiled():
                    compiled.append(time.monotonic() - start)

            found = probe.send(itertools.islice(restamped(clouds, 1), N_SENT), 10.0, note)
            cpu = cpu_of(node.pid)
            while not compiled and time.monotonic() < start + 240.0:
                session.sleep(0.2)
                note()
        finally:
            for process in beside:
                process.kill()
                process.wait()
    words = f'{len(cores)}{", busy" if is_busy else ""}'
    return {'cores': words, **found, 'CPU [s]': cpu, 'numba after [s]': (*compiled, np.nan)[0]}


def main():
    """Measure, and print a table."""
    words, mark, ros_args = sys.argv[1:], '--ros-args', []
    if mark in words:
        words, ros_args = words[: words.index(mark)], words[words.index(mark) + 1 :]
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('root', nargs='?')
    parser.add_argument('--sensor', choices=SENSORS, default='hdl-64e', help='that is simulated')
    parser.add_argument('--first-minute', action='store_true')
    given = parser.parse_args(words)
    if given.root:
        scans = [frame.points for frame in frames(given.root)[:N_READ]]
    else:
        scans = [
            simulate_scan(SCENES['urban'](1), SENSORS[given.sensor], np.random.default_rng(k), k)
            .points for k in range(N_SIMULATED)
        ]  # fmt: skip
    clouds = [scan_cloud(points, 0, FRAME_ID) for points in scans]
    if given.first_minute:
        every = os.sched_getaffinity(0)
        rows = [
            first_minute(clouds, cores, is_busy, ros_args)
            for cores, is_busy in ((every, False), ({min(every)}, False), (every, True))
        ]
    else:
        rows = measure(clouds, ros_args)
    n_points = sum(map(len, scans)) / len(scans)
    source = given.root or f'simulated {given.sensor}'
    print(f'{source}: {len(scans)} clouds of {n_points:.0f} points')
    print(pd.DataFrame(rows).round(1).to_string(index=False))
    print(machine_line(describe_environment(), 'numba'))


if __name__ == '__main__':
    main()
