"""Plays the clouds of a bag as recorded; ``ros2 bag play`` does not come with ROS by pip."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Sequence
from typing import NamedTuple

from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.time import Time
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import PointCloud2

from gp_ground_seg.data.bags import BagReader
from gp_ground_seg.ros.input import cloud_profile

DEPTH = 100  # clouds kept until acknowledged: with stock Fast DDS that can take 3 s
SLICE = 0.02  # longest wait in one piece [s]: /clock is published in between
DELIVERY_TIMEOUT = 5.0  # of the last clouds [s]; Fast DDS asks for lost ones every 3 s


class PlayOptions(NamedTuple):
    """What is played, and how."""

    rate: float  # 1 = as recorded
    loop: bool
    clock: bool


class Player:
    """Publishes PointCloud2 `topics` of a bag as recorded; `pause` waits at most that long [s]."""

    is_acknowledged = True
    """Whether every reliable subscriber has acknowledged all clouds at the end."""
    _first_sent: float | None = None
    _last_sent = 0.0
    _n_sent = 0

    def __init__(
        self,
        node: Node,
        bag: BagReader,
        topics: Sequence[str],
        pause: Callable[[float], None],
        options: PlayOptions,
    ) -> None:
        self._bag = bag
        self._options = options
        self._pause = pause
        profile = cloud_profile(DEPTH)
        self._publishers = {t: node.create_publisher(PointCloud2, t, profile) for t in topics}
        # Reliable, which serves both kinds of subscribers.
        self._clock = node.create_publisher(Clock, '/clock', 1) if options.clock else None

    def topics_without_subscriber(self) -> list[str]:
        """Return the topics, as remapped, that have no subscriber."""
        publishers = self._publishers.values()
        return [p.topic_name for p in publishers if p.get_subscription_count() == 0]

    def wait_for_subscribers(self, limit: float | None = None) -> bool:
        """Return whether all topics have a subscriber within `limit` [s]; None = no limit."""
        end = None if limit is None else time.monotonic() + limit
        while self.topics_without_subscriber():
            if end is not None and time.monotonic() > end:
                return False
            self._pause(SLICE)
        return True

    def play(self, on_cloud: Callable[[], object] = lambda: None) -> None:
        """Play, and call `on_cloud` before each cloud is sent."""
        start = self._play_once(time.monotonic(), on_cloud)
        while self._options.loop:
            start = self._play_once(start, on_cloud)
        self._wait_for_delivery()

    def summary(self) -> str:
        """Return one line on what was played up to now; nothing if no cloud was sent."""
        if self._first_sent is None:
            return ''
        plural = 's' if self._n_sent != 1 else ''
        return f'{self._n_sent} cloud{plural} sent in {self._last_sent - self._first_sent:.1f} s'

    def _play_once(self, start: float, on_cloud: Callable[[], object]) -> float:
        """Play from the monotonic time `start` on; return when the next round has to start."""
        rate, first, last = self._options.rate, 0, 0
        n_clouds: Counter[str] = Counter()
        # The next cloud is read right after one was sent: there is time for it then.
        for topic, recorded, raw in self._bag.messages(self._publishers):
            if not n_clouds:
                first = last = recorded
                start = max(start, time.monotonic())
            # The parts of a split bag may overlap.
            last = max(last, recorded)
            due = start + 1e-9 * (last - first) / rate
            self._wait_until(due, last)
            on_cloud()
            self._send(topic, raw)
            n_clouds[topic] += 1
        n_periods, span = max(n_clouds.values()) - 1, 1e-9 * (last - first)
        # A bag of a single cloud begins again after 0.1 s.
        return start + (span + (span / n_periods if n_periods else 0.1)) / rate

    def _wait_until(self, due: float, recorded: int) -> None:
        """Wait until a monotonic time [s]; at it, the time of the bag is `recorded` [ns]."""
        while True:
            left = due - time.monotonic()
            self._publish_time(recorded - round(1e9 * max(left, 0.0) * self._options.rate))
            if left <= 0.0:
                return
            self._pause(min(SLICE, left))

    def _publish_time(self, nanoseconds: int) -> None:
        if self._clock is not None:
            self._clock.publish(Clock(clock=Time(nanoseconds=nanoseconds).to_msg()))

    def _send(self, topic: str, raw: bytes) -> None:
        self._last_sent = time.monotonic()
        self._publishers[topic].publish(raw)
        self._n_sent += 1
        if self._first_sent is None:
            self._first_sent = self._last_sent

    def _wait_for_delivery(self) -> None:
        """Wait until the last clouds are acknowledged: they go with their publisher."""
        end = time.monotonic() + DELIVERY_TIMEOUT
        for publisher in self._publishers.values():
            while not publisher.wait_for_all_acked(Duration(seconds=0)):
                if time.monotonic() > end:
                    self.is_acknowledged = False
                    return
                self._pause(SLICE)
