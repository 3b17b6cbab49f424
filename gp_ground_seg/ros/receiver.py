"""The other end of the node: receives the clouds it publishes."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import PointCloud2

from gp_ground_seg.datasets.bags import CloudMessage, decode_cloud
from gp_ground_seg.errors import GroundSegError
from gp_ground_seg.ros.qos import cloud_profile
from gp_ground_seg.ros.session import Session

DEPTH = 50
"""Clouds that may wait while others are looked at."""
PROBE_FRAME = 'gp_ground_seg_probe'
"""Frame of the empty clouds that only test the connection."""
PROBE_PERIOD = 0.2
"""Time between two of them [s]."""


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
        profile = QoSProfile(
            history=HistoryPolicy.KEEP_LAST,
            depth=DEPTH,
            reliability=ReliabilityPolicy.RELIABLE,
        )
        self._session = session
        self._on_cloud = on_cloud
        self._unanswered = set(topics)
        for topic in topics:
            session.node.create_subscription(
                PointCloud2, topic, partial(self._receive, topic), profile, raw=True
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
        node = self._session.node
        publisher = node.create_publisher(PointCloud2, input_topic, cloud_profile())
        probe = PointCloud2()
        probe.header.frame_id = PROBE_FRAME
        end = time.monotonic() + timeout
        next_probe = 0.0
        try:
            while self._unanswered:
                check()
                now = time.monotonic()
                if now > end:
                    raise GroundSegError(
                        f'no answer on {", ".join(sorted(self._unanswered))} within '
                        f'{timeout:g} s of sending empty clouds to {input_topic}'
                    )
                if now > next_probe:
                    publisher.publish(probe)
                    next_probe = now + PROBE_PERIOD
                self._session.spin(0.02)
        finally:
            node.destroy_publisher(publisher)

    def _receive(self, topic: str, raw: bytes, info: dict[str, Any]) -> None:
        arrival = info.get('received_timestamp') or time.time_ns()
        cloud = decode_cloud(raw)
        if cloud.frame_id == PROBE_FRAME:
            self._unanswered.discard(topic)
        else:
            self._on_cloud(topic, cloud, arrival)
