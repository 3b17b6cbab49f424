"""Plays the clouds of a bag at the times they were recorded."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock

from gp_ground_seg.data.bags import BagReader
from gp_ground_seg.errors import DataError
from gp_ground_seg.ros.delivery import TrackedPublisher

LATE = 0.02
"""A cloud that is sent more than this after its time is late [s]."""
SLICE = 0.02
"""Longest wait in one piece [s]: /clock and acknowledgements are served in between."""
DELIVERY_TIMEOUT = 5.0
"""How long the last clouds may take to be acknowledged [s]; Fast DDS asks every 3 s."""
LONE_PERIOD = 0.1
"""Pause before a bag of a single cloud is played again [s]."""

Pause = Callable[[float], None]
"""Waits for at most that long [s]."""
Watch = Callable[[str, bytes, int], object]
"""Told of each cloud right before it is sent: topic of the bag, bytes, system time [ns]."""


@dataclass(frozen=True)
class PlayOptions:
    """What of a bag is played, and how.

    Attributes
    ----------
    rate : float
        Speed, 1 = as recorded.
    start : float
        What is left out at the beginning [s].
    duration : float or None
        How much is played [s], None = all.
    loop : bool
        Whether to begin again at the end, for ever.
    clock : bool
        Whether to publish the bag's time on /clock.
    """

    rate: float = 1.0
    start: float = 0.0
    duration: float | None = None
    loop: bool = False
    clock: bool = False


@dataclass(frozen=True)
class PlayReport:
    """How the playing went.

    Attributes
    ----------
    n_sent : int
        Clouds sent.
    seconds : float
        From the first to the last [s].
    rate : float or None
        Clouds per second of each topic, None with less than two.
    n_late : int
        Clouds sent more than `LATE` after their time.
    worst_delay : float
        The longest time after its time that a cloud was sent [s].
    n_undelivered : int
        Clouds not delivered, see `TrackedPublisher`.
    best_effort_topics : tuple of str
        Topics with subscribers that may have lost clouds without anybody knowing.
    """

    n_sent: int
    seconds: float
    rate: float | None
    n_late: int
    worst_delay: float
    n_undelivered: int
    best_effort_topics: tuple[str, ...]


class Player:
    """Publishes clouds of a bag, reliably, as the bytes that were recorded.

    Parameters
    ----------
    node : Node
        Node that publishes.
    bag : BagReader
        Open bag.
    topics : sequence of str
        Topics of the bag to play, all PointCloud2.
    pause : callable
        Waits for at most the given time [s]; called whenever there is nothing to send.
    options : PlayOptions
        What to play, and how.
    """

    def __init__(
        self,
        node: Node,
        bag: BagReader,
        topics: Sequence[str],
        pause: Pause,
        options: PlayOptions | None = None,
    ) -> None:
        self._bag = bag
        self._options = options if options is not None else PlayOptions()
        self._pause = pause
        self._publishers = {topic: TrackedPublisher(node, topic) for topic in topics}
        self._clock = _BagClock(node) if self._options.clock else None
        self._first_sent: float | None = None
        self._last_sent = 0.0
        self._n_late = 0
        self._worst_delay = 0.0

    def topics_without_subscriber(self) -> list[str]:
        """Topics, as remapped, that nobody listens to."""
        return [p.topic for p in self._publishers.values() if p.n_subscribers == 0]

    def wait_for_subscribers(self, limit: float | None = None) -> bool:
        """Return whether all topics have a subscriber within `limit` [s]; None = no limit."""
        end = None if limit is None else time.monotonic() + limit
        while self.topics_without_subscriber():
            left = SLICE if end is None else end - time.monotonic()
            if left <= 0.0:
                return False
            self._pause(min(SLICE, left))
        return True

    def play(self, watch: Watch = lambda topic, raw, now: None) -> None:
        """Play; `report` tells how it went, also after an interrupt.

        Parameters
        ----------
        watch : callable
            See `Watch`.

        Raises
        ------
        DataError
            If the bag is damaged, or has no cloud in the time asked for.
        """
        start = time.monotonic()
        while True:
            start = self._play_once(start, watch)
            if not self._options.loop:
                break
        self._wait_for_delivery()

    def report(self) -> PlayReport:
        """How it went up to now."""
        publishers = self._publishers.values()
        for publisher in publishers:
            publisher.update()
        n_sent = sum(p.n_sent for p in publishers)
        n_topics = sum(p.n_sent > 0 for p in publishers)
        seconds = 0.0 if self._first_sent is None else self._last_sent - self._first_sent
        n_periods = n_sent - n_topics
        return PlayReport(
            n_sent=n_sent,
            seconds=seconds,
            rate=n_periods / (n_topics * seconds) if n_periods and seconds > 0.0 else None,
            n_late=self._n_late,
            worst_delay=self._worst_delay,
            n_undelivered=sum(p.n_undelivered for p in publishers),
            best_effort_topics=tuple(
                p.topic for p in publishers if p.has_best_effort_subscriber
            ),
        )  # fmt: skip

    def _play_once(self, start: float, watch: Watch) -> float:
        """Play from the monotonic time `start` on; return when the next round has to start."""
        rate = self._options.rate
        first = last = None
        n_clouds = dict.fromkeys(self._publishers, 0)
        # The bag's next cloud is read right after the last one was sent: its time is not
        # needed then.
        for topic, recorded, raw in self._clouds():
            if first is None or last is None:
                first = last = recorded
                start = max(start, time.monotonic())
            # The parts of a split bag may overlap.
            last = max(last, recorded)
            due = start + 1e-9 * (last - first) / rate
            self._wait_until(due, last)
            watch(topic, raw, time.time_ns())
            self._send(topic, raw, due)
            n_clouds[topic] += 1
        if first is None or last is None:
            raise DataError(f'{self._bag.path}: {self._nothing_to_play()}')
        n_periods = max(n_clouds.values()) - 1
        span = 1e-9 * (last - first)
        period = span / n_periods if n_periods else LONE_PERIOD
        return start + (span + period) / rate

    def _clouds(self) -> Iterator[tuple[str, int, bytes]]:
        options = self._options
        origin = None
        for topic, recorded, raw in self._bag.messages(list(self._publishers)):
            if origin is None:
                origin = recorded
            offset = 1e-9 * (recorded - origin)
            if offset < options.start:
                continue
            if options.duration is not None and offset >= options.start + options.duration:
                return
            yield topic, recorded, raw

    def _nothing_to_play(self) -> str:
        times = [recorded for _, recorded, _ in self._bag.messages(list(self._publishers))]
        span = 1e-9 * (max(times) - min(times)) if times else 0.0
        return (
            f'no cloud in the time asked for (from {self._options.start:g} s on); '
            f'the last of its {len(times)} clouds is at {span:.3f} s'
        )

    def _wait_until(self, due: float, recorded: int) -> None:
        """Wait until a monotonic time [s]; at it, the time of the bag is `recorded` [ns]."""
        while True:
            left = due - time.monotonic()
            if self._clock is not None:
                self._clock.publish(recorded - round(1e9 * max(left, 0.0) * self._options.rate))
            if left <= 0.0:
                return
            self._pause(min(SLICE, left))
            for publisher in self._publishers.values():
                publisher.update()

    def _send(self, topic: str, raw: bytes, due: float) -> None:
        publisher = self._publishers[topic]
        if publisher.n_sent == 0:
            publisher.look_at_subscribers()
        now = time.monotonic()
        publisher.publish(raw)
        if self._first_sent is None:
            self._first_sent = now
        self._last_sent = now
        self._n_late += now - due > LATE
        self._worst_delay = max(self._worst_delay, now - due)

    def _wait_for_delivery(self) -> None:
        """Stay until the last clouds are acknowledged: they go with their publisher."""
        end = time.monotonic() + DELIVERY_TIMEOUT
        for publisher in self._publishers.values():
            publisher.look_at_subscribers()
            publisher.update()
            while publisher.n_pending and time.monotonic() < end:
                self._pause(SLICE)
                publisher.update()


class _BagClock:
    """The time of the bag on /clock."""

    def __init__(self, node: Node) -> None:
        # Reliable serves both kinds of subscribers.
        profile = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE)
        self._publisher = node.create_publisher(Clock, '/clock', profile)

    def publish(self, nanoseconds: int) -> None:
        message = Clock()
        message.clock.sec, message.clock.nanosec = divmod(nanoseconds, 10**9)
        self._publisher.publish(message)
