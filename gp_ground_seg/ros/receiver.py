"""The other end of the node: receives the clouds it publishes."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Any

from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import PointCloud2

from gp_ground_seg.data.point_cloud2 import (
    CloudMessage,
    cloud_from_columns,
    decode_cloud,
    encode_cloud,
    stamp_of,
    with_header,
)
from gp_ground_seg.errors import GroundSegError
from gp_ground_seg.ros.session import Session

DEPTH = 50
"""Clouds that may wait while others are looked at."""
PROBE_FRAME = 'gp_ground_seg_probe'
"""Frame of the clouds that only test the connection."""
PROBE_PERIOD = 0.2
"""Time between two of them [s]."""
POLL_PERIOD = 0.02
"""Longest wait for a message in one piece [s]."""


class OutputReceiver:
    """Receives clouds on several topics, reliably.

    Parameters
    ----------
    session : Session
        Session that receives, while it spins.
    topics : sequence of str
        Names of the topics.
    on_cloud : callable
        Called with topic, cloud, and system time [ns] of its arrival in this process.
    """

    def __init__(
        self,
        session: Session,
        topics: Sequence[str],
        on_cloud: Callable[[str, CloudMessage, int], None],
    ) -> None:
        self._profile = QoSProfile(
            history=HistoryPolicy.KEEP_LAST,
            depth=DEPTH,
            reliability=ReliabilityPolicy.RELIABLE,
        )
        self._session = session
        self._on_cloud = on_cloud
        self._topics = tuple(topics)
        self._unanswered: set[str] = set()
        self._n_probes = 0
        self._probe_stamp = (0, 0)
        for topic in topics:
            session.node.create_subscription(
                PointCloud2, topic, partial(self._receive, topic), self._profile, raw=True
            )

    def connect(
        self, input_topic: str, timeout: float, check: Callable[[], None] = lambda: None
    ) -> None:
        """Send empty clouds to the node until each of the topics has answered.

        Discovery takes its time, each way on its own: only an answer proves that
        nothing will be lost for want of a connection.

        Parameters
        ----------
        input_topic : str
            Topic the node listens to.
        timeout : float
            How long to try [s].
        check : callable
            Called again and again meanwhile; may raise.

        Raises
        ------
        GroundSegError
            If a topic has not answered in time.
        """
        nothing = cloud_from_columns((0, 0), '', {})
        with self._publisher(input_topic) as publisher:
            self._ask(publisher, nothing, PROBE_PERIOD, timeout, check)

    def time_answer(
        self, input_topic: str, cloud: CloudMessage, n_times: int, timeout: float
    ) -> float:
        """Return the median time until each of the topics has answered to `cloud` [s].

        Parameters
        ----------
        input_topic : str
            Topic the node listens to, after `connect`.
        cloud : CloudMessage
            What to send; in a frame of its own, so that the answer is not taken for data.
        n_times : int
            How often, one after the other.
        timeout : float
            How long to wait for an answer [s].

        Raises
        ------
        GroundSegError
            If a topic has not answered in time.
        """
        with self._publisher(input_topic) as publisher:
            end = time.monotonic() + timeout
            while publisher.get_subscription_count() == 0 and time.monotonic() < end:
                self._session.spin(POLL_PERIOD)
            times = [self._ask(publisher, cloud, timeout, timeout) for _ in range(n_times)]
        return statistics.median(times)

    @contextmanager
    def _publisher(self, topic: str) -> Iterator[Any]:
        publisher = self._session.node.create_publisher(PointCloud2, topic, self._profile)
        try:
            yield publisher
        finally:
            self._session.node.destroy_publisher(publisher)

    def _ask(
        self,
        publisher: Any,
        cloud: CloudMessage,
        period: float,
        timeout: float,
        check: Callable[[], None] = lambda: None,
    ) -> float:
        """Send a cloud every `period` [s] until answered; return how long that took [s]."""
        self._n_probes += 1
        self._probe_stamp = (self._n_probes, 0)
        self._unanswered = set(self._topics)
        raw = encode_cloud(with_header(cloud, self._probe_stamp, PROBE_FRAME))
        start = next_time = time.monotonic()
        while self._unanswered:
            check()
            now = time.monotonic()
            if now > start + timeout:
                raise GroundSegError(
                    f'no answer on {", ".join(sorted(self._unanswered))} within {timeout:g} s '
                    f'to what was sent to {publisher.topic_name}'
                )
            if now >= next_time:
                publisher.publish(raw)
                next_time = now + period
            self._session.spin(POLL_PERIOD)
        return time.monotonic() - start

    def _receive(self, topic: str, raw: bytes, info: dict[str, Any]) -> None:
        arrival = info.get('received_timestamp') or time.time_ns()
        cloud = decode_cloud(raw)
        if cloud.header.frame_id != PROBE_FRAME:
            self._on_cloud(topic, cloud, arrival)
        elif stamp_of(cloud) == self._probe_stamp:
            self._unanswered.discard(topic)
