"""A node in a second process, clouds sent to it, and what comes back: losses and latency.

ROS is imported by what needs it: commands import this module where there is no ROS.
"""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import secrets
import subprocess
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from gp_ground_seg.core.errors import GroundSegError
from gp_ground_seg.data import point_cloud2
from gp_ground_seg.data.point_cloud2 import CloudMessage, encode_cloud, stamp_of
from gp_ground_seg.ros.start_stop import (
    Session,
    child_command,
    large_cloud_transport,
    ros_session,
)

INPUT, GROUND, OBSTACLES = 'points', 'ground', 'obstacles'  # topics of the node
START_TIMEOUT = 300.0  # time the node has to start, and to compile on a slow machine [s]
SILENCE = 2.0  # time without a cloud after which what is still missing is lost [s]

_RUN = 'from gp_ground_seg.ros.start_stop import run_node; sys.exit(run_node(sys.argv[1:]))'
_PROBE_FRAME = 'gp_ground_seg_probe'
_PROBE_PERIOD = 0.2


class NodeProcess:
    """A node in a second process, for a ``with`` statement; its output goes to the file `log`.

    It ends when this process does, however that ends.
    """

    def __init__(self, log: Path, ros_args: Sequence[str] = ()) -> None:
        self._log = log
        self._command = [*child_command(_RUN), '--ros-args', *ros_args]

    def __enter__(self) -> NodeProcess:
        """Start it."""
        with self._log.open('wb') as log:
            self._process = subprocess.Popen(
                self._command, stdin=subprocess.PIPE, stdout=log, stderr=subprocess.STDOUT
            )
        self.pid = self._process.pid
        return self

    def __exit__(self, *_error: object) -> None:
        """Stop it."""
        self._process.terminate()
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(5.0)
        self._process.kill()  # does nothing to a process that has ended
        self._process.communicate()

    def _said(self) -> str:
        return self._log.read_text(encoding='utf-8', errors='replace')

    def log_tail(self) -> str:
        """Return the last lines of its output."""
        return '\n'.join(self._said().splitlines()[-20:])

    def is_settled(self) -> bool:
        """Return whether it has the backend that it keeps."""
        from gp_ground_seg.ros.warm_up import CHANGED, FOLLOWS, STAYS

        said = self._said()
        return FOLLOWS not in said or CHANGED in said or STAYS in said

    def check(self) -> None:
        """Raise a GroundSegError if it has ended."""
        code = self._process.poll()
        if code is not None:
            ended = f'was killed by signal {-code}' if code < 0 else f'ended with code {code}'
            raise GroundSegError(f'the node {ended}; its last words:\n{self.log_tail()}')


@contextlib.contextmanager
def probe_session(name: str) -> Iterator[tuple[Session, list[str]]]:
    """Yield a session named `name` to talk to a `NodeProcess`, and the ROS arguments of that.

    Both are in a namespace of a random name, so that other nodes and other runs do not matter.
    """
    namespace = f'/gp_ground_seg_{secrets.token_hex(4)}'
    words = ['-r', f'__ns:={namespace}', '-r', '/diagnostics:=diagnostics']
    with large_cloud_transport(), ros_session(name, ['--ros-args', *words]) as session:
        yield session, words


@dataclasses.dataclass
class Trip:
    """A cloud: when it was sent, when the last of its results was back; system time [ns]."""

    sent: int
    back: int | None = None

    @property
    def latency(self) -> float:
        """Time in between [s]; NaN if it did not come back."""
        return np.nan if self.back is None else 1e-9 * (self.back - self.sent)


Results = dict[str, CloudMessage]  # what came back of a cloud, by topic


def restamped(clouds: Iterable[CloudMessage], start: int) -> Iterator[CloudMessage]:
    """Yield `clouds` over and over, stamped every 0.1 s from the second `start` on."""
    for k, cloud in enumerate(itertools.cycle(clouds)):
        yield point_cloud2.with_header(cloud, (start + k // 10, k % 10 * 10**8))


class Probe:
    """Sends clouds to a node, receives its results reliably, and matches them by stamp.

    `on_back` is called with a cloud and its results, when both are back; `n_stray` counts the
    results that belong to no cloud sent, or came a second time.
    """

    def __init__(
        self, session: Session, on_back: Callable[[CloudMessage, Results], object]
    ) -> None:
        from sensor_msgs.msg import PointCloud2

        from gp_ground_seg.ros.input import cloud_profile

        self.n_stray = 0
        self._session = session
        self._on_back = on_back
        self._waiting: dict[tuple[int, int], tuple[Trip, CloudMessage, Results]] = {}
        self._publisher = session.node.create_publisher(PointCloud2, INPUT, cloud_profile(10))
        for topic in (GROUND, OBSTACLES):
            session.node.create_subscription(
                PointCloud2, topic, partial(self._receive, topic), cloud_profile(50), raw=True
            )

    def connect(self, node: NodeProcess) -> None:
        """Send empty clouds until both topics have answered and the node is settled."""
        empty = point_cloud2.cloud_from_columns((0, 0), _PROBE_FRAME, {})
        end, next_time, trip = time.monotonic() + START_TIMEOUT, 0.0, Trip(0)
        for cloud in restamped([empty], 1):
            while time.monotonic() < next_time:
                self._session.spin(0.02)
            node.check()
            if trip.back is not None and node.is_settled():
                break
            if time.monotonic() > end:
                raise GroundSegError(
                    f'no answer on {GROUND} and {OBSTACLES} within {START_TIMEOUT:g} s; '
                    f'the last words of the node:\n{node.log_tail()}'
                )
            self._waiting.clear()
            trip = self._send(cloud, encode_cloud(cloud))
            next_time = time.monotonic() + _PROBE_PERIOD
        self._waiting.clear()

    def send(
        self,
        clouds: Iterable[CloudMessage],
        rate: float,
        on_sent: Callable[[], object],
        patience: float | None = None,
    ) -> list[Trip]:
        """Send `clouds` at `rate` [Hz], whether or not results come back; return their trips.

        With `patience` [s], a cloud is not sent before the last one is back; raises a
        GroundSegError if that takes longer.
        """
        trips = []
        due = time.monotonic()
        for cloud in clouds:
            raw = encode_cloud(cloud)
            if patience is not None and self._wait(patience):
                raise GroundSegError(f'no answer to a cloud within {patience:g} s')
            while (left := due - time.monotonic()) > 0.0:
                self._session.spin(left)
            trips.append(self._send(cloud, raw))
            on_sent()
            due += 1.0 / rate
            if patience is not None:
                due = max(due, time.monotonic())
        self._wait(patience or SILENCE)
        return trips

    def _send(self, cloud: CloudMessage, raw: bytes) -> Trip:
        trip = Trip(time.time_ns())
        self._waiting[stamp_of(cloud)] = trip, cloud, {}
        self._publisher.publish(raw)
        return trip

    def _wait(self, silence: float) -> int:
        """Receive until all is back, or nothing for `silence` [s]; return how many are lost."""
        n_waiting, last_news = len(self._waiting), time.monotonic()
        while self._waiting and time.monotonic() < last_news + silence:
            self._session.spin(0.02)
            if len(self._waiting) < n_waiting:
                n_waiting, last_news = len(self._waiting), time.monotonic()
        self._waiting.clear()
        return n_waiting

    def _receive(self, topic: str, raw: bytes, info: dict[str, Any]) -> None:
        cloud, now = point_cloud2.decode_cloud(raw), info.get('received_timestamp')
        stamp, is_data = stamp_of(cloud), cloud.header.frame_id != _PROBE_FRAME
        if stamp not in self._waiting or topic in self._waiting[stamp][2]:
            self.n_stray += is_data
            return
        trip, sent, results = self._waiting[stamp]
        results[topic] = cloud
        if len(results) == 2:
            del self._waiting[stamp]
            trip.back = now or time.time_ns()
            if is_data:
                self._on_back(sent, results)


def rate_result(asked: float, trips: Sequence[Trip]) -> dict[str, Any]:
    """Return the statistics of clouds sent at a rate of `asked` [Hz]; times in seconds."""
    latency = np.array([trip.latency for trip in trips])
    known = latency[np.isfinite(latency)]
    seconds = 1e-9 * (trips[-1].sent - trips[0].sent)
    percents = np.percentile(known, [50, 95, 99, 100]) if len(known) else np.full(4, np.nan)
    return {
        'asked': asked,
        'sent': (len(trips) - 1) / seconds if seconds > 0.0 else np.nan,
        'n_sent': len(trips),
        'n_back': len(known),
        'n_lost': len(trips) - len(known),
        **dict(zip(('p50', 'p95', 'p99', 'worst'), percents.tolist(), strict=True)),
    }
