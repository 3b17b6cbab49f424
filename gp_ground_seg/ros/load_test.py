"""Clouds sent to the node at a given rate, and when their results came back."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Sequence

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import PointCloud2

from gp_ground_seg.data.point_cloud2 import CloudMessage, encode_cloud, stamp_of, with_header
from gp_ground_seg.evaluation.trips import Trip
from gp_ground_seg.ros.receiver import OutputReceiver
from gp_ground_seg.ros.session import Session

DEPTH = 10
"""Clouds kept for repair; what the node is too slow for is lost in its own queue, not here."""
SILENCE = 2.0
"""Time without a cloud after which what is still missing is lost [s]."""
START = 1_700_000_000
"""Second of the first stamp; later ones are 0.1 s apart, whatever the rate."""
PERIOD_NS = 100_000_000
COUNTERS = ('Clouds since startup', 'Dropped since startup')


class LoadTest:
    """Sends clouds to a node and follows what comes back; in the thread of the session.

    Parameters
    ----------
    session : Session
        Session that sends and receives.
    topic : str
        Topic the node listens to.
    outputs : sequence of str
        Topics that answer each cloud.
    clouds : sequence of CloudMessage
        What to send, over and over; the stamps are replaced.
    """

    def __init__(
        self,
        session: Session,
        topic: str,
        outputs: Sequence[str],
        clouds: Sequence[CloudMessage],
    ) -> None:
        self._session = session
        self._topic = topic
        self._n_outputs = len(outputs)
        self._clouds = itertools.cycle(clouds)
        self._numbers = itertools.count()
        self._waiting: dict[tuple[int, int], tuple[Trip, set[str]]] = {}
        self._receiver = OutputReceiver(session, outputs, self._arrived)
        self._counts: dict[str, int] = {}
        profile = QoSProfile(
            history=HistoryPolicy.KEEP_LAST,
            depth=DEPTH,
            reliability=ReliabilityPolicy.RELIABLE,
        )
        self._publisher = session.node.create_publisher(PointCloud2, topic, profile)
        session.node.create_subscription(DiagnosticArray, '/diagnostics', self._diagnosed, 10)

    def connect(self, timeout: float, check: Callable[[], None]) -> None:
        """Wait until the node answers, see `OutputReceiver.connect`; then for its counters."""
        self._receiver.connect(self._topic, timeout, check)
        end = time.monotonic() + timeout
        while not self._counts and time.monotonic() < end:
            check()
            self._session.spin(0.05)

    def paced(self, rate: float, n_clouds: int, watch: Callable[[Trip], object]) -> list[Trip]:
        """Send `n_clouds` at `rate` [Hz], whatever comes back; return their trips."""
        trips = []
        due = time.monotonic()
        for _ in range(n_clouds):
            raw, stamp = self._next()
            while (left := due - time.monotonic()) > 0.0:
                self._session.spin(left)
            trips.append(self._send(raw, stamp))
            watch(trips[-1])
            due += 1.0 / rate
        self._wait(SILENCE)
        return trips

    def one_by_one(self, n_clouds: int, watch: Callable[[Trip], object]) -> list[Trip]:
        """Send each cloud when the one before is back; return their trips."""
        trips = []
        for _ in range(n_clouds):
            trips.append(self._send(*self._next()))
            self._wait(SILENCE)
            watch(trips[-1])
        return trips

    def counters(self, timeout: float = 5.0) -> tuple[int, int]:
        """Clouds that the node says it has processed and dropped, from a report of now on."""
        self._counts.clear()
        end = time.monotonic() + timeout
        while not self._counts and time.monotonic() < end:
            self._session.spin(0.05)
        processed, dropped = (self._counts.get(name, -1) for name in COUNTERS)
        return processed, dropped

    def _next(self) -> tuple[bytes, tuple[int, int]]:
        seconds, nanoseconds = divmod(next(self._numbers) * PERIOD_NS, 10**9)
        stamp = START + seconds, nanoseconds
        return encode_cloud(with_header(next(self._clouds), stamp)), stamp

    def _send(self, raw: bytes, stamp: tuple[int, int]) -> Trip:
        trip = Trip(time.time_ns())
        self._waiting[stamp] = trip, set()
        self._publisher.publish(raw)
        return trip

    def _wait(self, silence: float) -> None:
        """Receive until all is back, or nothing more comes; what is missing then is lost."""
        n_waiting, last_news = len(self._waiting), time.monotonic()
        while self._waiting and time.monotonic() < last_news + silence:
            self._session.spin(0.02)
            if len(self._waiting) < n_waiting:
                n_waiting, last_news = len(self._waiting), time.monotonic()
        self._waiting.clear()

    def _arrived(self, topic: str, cloud: CloudMessage, now: int) -> None:
        trip, topics = self._waiting.get(stamp_of(cloud), (None, set()))
        if trip is None:
            return
        topics.add(topic)
        if len(topics) == self._n_outputs:
            del self._waiting[stamp_of(cloud)]
            trip.back = now

    def _diagnosed(self, array: DiagnosticArray) -> None:
        for status in array.status:
            if status.name.endswith(': processing'):
                values = {entry.key: entry.value for entry in status.values}
                self._counts.update({name: int(values[name]) for name in COUNTERS})
