"""Clouds of one topic, each once: QoS that follows the publishers, losses."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable
from copy import copy
from typing import Any

from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.subscription import Subscription
from sensor_msgs.msg import PointCloud2

from gp_ground_seg.ros.input import STEADY_CLOCK, cloud_profile, in_words

INPUT_DEPTH = 5  # clouds that may wait to be processed: half a second of a LiDAR at 10 Hz
LARGE_CLOUD = 500_000  # size up to which stock Fast DDS loses no best-effort cloud [bytes]
OVERTAKING_TIME = 1.0  # longest wait of a best-effort cloud for reliable ones [s]
NEAR = 1000  # gap in the numbers of several publishers up to which it counts as a loss
MAX_IN_FLIGHT = 1000  # clouds that are remembered, to recognise a second copy


class SequenceGaps:
    """Counts messages that did not arrive, of publishers that number theirs 1, 2, 3 ... each.

    They were lost on the way, or overwritten in a full queue while the node was busy. rclpy does
    not say who has sent a message: a number counts as the next of the publisher whose last one is
    the nearest below. What this misses for one publisher, it counts for another later. The first
    message of a publisher may look like a gap, and is not counted.
    """

    def __init__(self) -> None:
        self._last: list[int] = []
        self._n_lost = 0

    @property
    def n_heard(self) -> int:
        """Publishers with a known last number."""
        return len(self._last)

    def reset(self) -> None:
        """Forget the last numbers: other publishers have their own."""
        self._last.clear()
        self._n_lost = 0

    def note(self, number: int | None, n_publishers: int = 1) -> int:
        """Return how many messages are missing before the one with this `number`.

        -1 if it comes late, and was counted as missing.
        """
        if number is None:
            self.reset()
            return 0
        below = max((last for last in self._last if last < number), default=None)
        if self.n_heard < max(1, n_publishers) and below != number - 1:
            self._last.append(number)
            return 0
        is_next = below is not None and (self.n_heard == 1 or number - below < NEAR)
        if not is_next and self._n_lost and any(0 <= last - number < NEAR for last in self._last):
            self._n_lost -= 1
            return -1
        # Where none is near, one of them counts anew.
        last = below if below is not None else min(self._last)
        self._last[self._last.index(last)] = number
        n_lost = number - last - 1 if is_next else 0
        self._n_lost += n_lost
        return n_lost


class CloudSubscription:
    """Reliable subscription, and a best-effort one while a publisher offers no more.

    A best-effort reader loses most of a replayed KITTI bag with stock Fast DDS; a reliable one
    gets nothing from a best-effort LiDAR driver. The best-effort one hears reliable publishers
    too, and has their clouds at times before a lost one is sent again: beside a reliable publisher
    its clouds wait for a newer one of the reliable subscription, `OVERTAKING_TIME` at most.
    Reliability given in ``qos_overrides``, by `is_given`, is kept for any publisher. `callback`
    takes each cloud once, its wait in this process [s] and the clouds lost before it, -1 for one
    that was counted as lost.
    """

    def __init__(
        self,
        node: Node,
        topic: str,
        is_given: Callable[[str], bool],
        callback: Callable[[PointCloud2, float, int], None],
    ) -> None:
        self._node = node
        self._unresolved_topic = topic
        self._callback = callback
        self._gaps = SequenceGaps()
        self._offered: dict[bytes, ReliabilityPolicy] = {}
        self._had: deque[tuple[object, ...]] = deque(maxlen=MAX_IN_FLIGHT)
        self._waiting: deque[tuple[float, PointCloud2, dict[str, Any]]] = deque()
        self._heard_reliable, self._newest_reliable = -math.inf, 0  # when [s]; when sent [ns]
        self._large_size = 0
        self._is_best_effort_heard = False
        self.topic: str = node.resolve_topic_name(topic)
        self._is_pinned = is_given(f'qos_overrides.{self.topic}.subscription.reliability')
        # The executor still uses a subscription within its own event; a guard condition runs
        # after all that became ready with it.
        self._review_soon = node.create_guard_condition(self._review)
        self._take_soon = node.create_guard_condition(self._take_waiting)
        overrides = QoSOverridingOptions.with_default_policies()
        self._subscription = self._create(self._receive, cloud_profile(INPUT_DEPTH), overrides)
        self._best_effort: Subscription | None = None
        # The event can come before the publisher is listed, and there is no event for the end
        # of the last best-effort publisher: they are looked at every second too.
        node.create_timer(1.0, self._review_soon.trigger, clock=STEADY_CLOCK)

    @property
    def qos(self) -> QoSProfile:
        """Quality of service in use: of two, that of the reliable subscription."""
        only_best_effort = self._n_best_effort == self.n_publishers
        used = self._best_effort if self._best_effort and only_best_effort else self._subscription
        return used.qos_profile

    @property
    def qos_words(self) -> str:
        """`qos` as in ``reliable, keep_last 5, volatile``."""
        words = in_words(self.qos)
        if self._best_effort and self._n_best_effort < self.n_publishers:
            words += f'; best_effort from {self._n_best_effort} of {self.n_publishers} publishers'
        return words

    @property
    def n_publishers(self) -> int:
        """Publishers, as of the last look."""
        return len(self._offered)

    @property
    def fault(self) -> str:
        """What is wrong with the way clouds are received; empty if nothing."""
        if not self._large_size:
            return ''
        return (
            f'clouds of {self._large_size / 1e6:.1f} MB come best-effort, of which Fast DDS may '
            'lose most: let their publisher offer reliable, or start it with '
            'FASTRTPS_DEFAULT_PROFILES_FILE=config/fastdds_large_clouds.xml'
        )

    @property
    def _n_best_effort(self) -> int:
        return list(self._offered.values()).count(ReliabilityPolicy.BEST_EFFORT)

    def _create(
        self,
        callback: Callable[[PointCloud2, dict[str, Any]], None],
        profile: QoSProfile,
        overrides: QoSOverridingOptions | None = None,
    ) -> Subscription:
        return self._node.create_subscription(
            PointCloud2,
            self._unresolved_topic,
            callback,
            profile,
            event_callbacks=SubscriptionEventCallbacks(incompatible_qos=self._on_incompatible),
            qos_overriding_options=overrides,
        )

    def _receive(self, message: PointCloud2, info: dict[str, Any]) -> None:
        self._take(message, info, self._subscription)
        if self._best_effort:
            self._heard_reliable = time.monotonic()
            self._newest_reliable = info.get('source_timestamp') or 0
            self._take_waiting()

    def _receive_best_effort(self, message: PointCloud2, info: dict[str, Any]) -> None:
        self._waiting.append((time.monotonic(), message, info))
        # After all that is ready by then: a copy of the reliable subscription comes first.
        self._take_soon.trigger()

    def _take_waiting(self) -> None:
        """Take the best-effort clouds that overtake no reliable one."""
        now = time.monotonic()
        while self._waiting and self._best_effort:
            arrival, message, info = self._waiting[0]
            is_newer = (info.get('source_timestamp') or 0) > self._newest_reliable
            if is_newer and now - min(arrival, self._heard_reliable) < OVERTAKING_TIME:
                return
            self._waiting.popleft()
            self._take(message, info, self._best_effort)

    def _take(self, message: PointCloud2, info: dict[str, Any], source: Subscription) -> None:
        # rclpy does not say who has sent a cloud; when, and its number, are that of one only.
        sent, number = info.get('source_timestamp'), info.get('publication_sequence_number')
        header = message.header
        key = (sent, number, header.stamp.sec, header.stamp.nanosec, header.frame_id)
        if self._best_effort and key in self._had:
            if source is self._subscription:
                self._large_size = 0  # it only was faster
            return
        self._had.append(key)
        if not self._offered:
            self._look_at_publishers()
        self._is_best_effort_heard |= source is self._best_effort
        is_complete = self._is_best_effort_heard or self._best_effort is None
        n_silent = 0 if is_complete else self._n_best_effort
        n_lost = self._gaps.note(number, self.n_publishers - n_silent)
        if n_lost:
            self._look_at_publishers()
            n_lost = n_lost if self._gaps.n_heard else 0
        if source.qos_profile.reliability == ReliabilityPolicy.BEST_EFFORT:
            self._check_size(len(message.data))
        # Both are stamps of the system clock; 0 where the middleware gives none.
        now = time.time_ns()
        wait = max(0.0, 1e-9 * (now - (info.get('received_timestamp') or now)))
        self._callback(message, wait, n_lost)

    def _check_size(self, size: int) -> None:
        if size > LARGE_CLOUD:
            self._large_size = size
            self._node.get_logger().warning(f'on {self.topic}, {self.fault}', once=True)

    def _on_incompatible(self, _event: object) -> None:
        if self._is_pinned:
            self._node.get_logger().error(
                f'a publisher of {self.topic} does not offer what qos_overrides asks for '
                f'({self.qos_words}): nothing will arrive from it'
            )
        self._review_soon.trigger()

    def _look_at_publishers(self) -> None:
        before, self._offered = (
            self._offered,
            {
                bytes(entry.endpoint_gid): entry.qos_profile.reliability
                for entry in self._node.get_publishers_info_by_topic(self.topic)
            },
        )
        if self._offered.keys() != before.keys():
            self._gaps.reset()
            self._is_best_effort_heard = False

    def _review(self) -> None:
        self._look_at_publishers()
        self._take_waiting()
        is_needed = self._n_best_effort > 0
        if not self._offered or self._is_pinned or is_needed == (self._best_effort is not None):
            return
        if self._best_effort is None:
            profile = copy(self._subscription.qos_profile)
            profile.reliability = ReliabilityPolicy.BEST_EFFORT
            self._best_effort = self._create(self._receive_best_effort, profile)
        else:
            self._heard_reliable = -math.inf
            self._take_waiting()
            self._node.destroy_subscription(self._best_effort)
            self._best_effort, self._large_size = None, 0
        self._node.get_logger().info(
            f'subscribing {self.qos_words} to {self.topic}, as its publishers offer'
        )
