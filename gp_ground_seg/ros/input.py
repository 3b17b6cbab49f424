"""The input: clouds of one topic as their publishers offer them, losses, time jumps."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Mapping
from statistics import median
from typing import Any

from builtin_interfaces.msg import Time as TimeMessage
from rclpy.clock import Clock, JumpThreshold, TimeJump
from rclpy.clock_type import ClockType
from rclpy.duration import Duration
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from sensor_msgs.msg import PointCloud2

from gp_ground_seg.core.errors import ConfigError

CLOUD_TYPE = 'sensor_msgs/msg/PointCloud2'
INPUT_DEPTH = 1  # clouds that may wait to be processed: the newest only
MAX_DEPTH = 10_000
QOS_OVERRIDES = 'qos_overrides.'
LARGE_CLOUD = 500_000  # size up to which stock Fast DDS loses no best-effort cloud [bytes]
NEAR = 1000  # with several publishers, a larger gap in the numbers is no loss
JUMP_TOLERANCE = 0.5  # stamps of several sensors on a topic may be so far out of order [s]
NOTHING_ARRIVES = (
    'qos_overrides asks for reliable, and a publisher offers best effort: nothing arrives from it'
)
AGE_WINDOW = 10  # clouds over which the median of their age is taken
MAX_AGE = 1.0  # age of a cloud when it is sent from which on its stamp is of another clock [s]
NO_TIME = (
    'use_sim_time is true, and no time has come on /clock: start what publishes it, or set '
    'use_sim_time to false'
)
STEADY_CLOCK = Clock(clock_type=ClockType.STEADY_TIME)  # the clock of a node may stand or jump
THROTTLED = {'throttle_duration_sec': 5.0, 'throttle_time_source_type': STEADY_CLOCK}
"""Options of log messages that may come with every cloud."""


def check_overrides(given: Mapping[str, object]) -> None:
    """Raise a ConfigError for a depth in ``qos_overrides`` at which rcl fails without a reason."""
    for name, value in given.items():
        is_depth = name.startswith(QOS_OVERRIDES) and name.endswith('.depth')
        if is_depth and isinstance(value, int) and not 1 <= value <= MAX_DEPTH:
            raise ConfigError(f'{name} = {value}: must be an integer in [1, {MAX_DEPTH}]')


class SequenceGaps:
    """Counts messages that did not arrive, of publishers that number theirs 1, 2, 3 ... each.

    They were lost on the way, or overwritten in a full queue while the node was busy. rclpy does
    not name the publisher of a message: a number is assigned to the publisher whose last number is
    the nearest below it. So a loss may be counted late, with a message of another publisher. The
    first message of a publisher does not count as a gap.
    """

    def __init__(self) -> None:
        self._last: list[int] = []  # of each publisher heard

    def note(self, number: int | None, n_publishers: int = 1) -> int:
        """Return how many messages are missing before the one with this `number`."""
        if number is None:
            self._last.clear()
            return 0
        below = max((last for last in self._last if last < number), default=None)
        n_heard = len(self._last)
        if n_heard < max(1, n_publishers) and below != number - 1:
            self._last.append(number)
            return 0
        # With no last number near below, that of some publisher starts anew.
        is_next = below is not None and (n_heard == 1 or number - below < NEAR)
        last = below if below is not None else min(self._last)
        self._last[self._last.index(last)] = number
        return number - last - 1 if is_next else 0


OnCloud = Callable[[PointCloud2, float, int], None]
"""Takes a cloud, the time of ``time.monotonic`` at which it came [s], the number lost before."""


def wanted_profile(node: Node, topic: str) -> QoSProfile:
    """Declare ``qos_overrides`` of a subscription of clouds, and return the QoS that they give."""
    default = QoSProfile(depth=INPUT_DEPTH, reliability=ReliabilityPolicy.BEST_AVAILABLE)
    # rclpy declares them only where something subscribes.
    subscription = node.create_subscription(
        PointCloud2, topic, lambda _cloud: None, default,
        qos_overriding_options=QoSOverridingOptions.with_default_policies(),
    )  # fmt: skip
    profile: QoSProfile = subscription.qos_profile
    node.destroy_subscription(subscription)
    return profile


class CloudSubscription:
    """Subscription that is best-effort while any publisher is, and reliable otherwise.

    A best-effort reader loses most of a replayed KITTI bag with stock Fast DDS; a reliable one
    gets nothing from a best-effort LiDAR driver. ROS decides between them when a subscription with
    `ReliabilityPolicy.BEST_AVAILABLE` is made: `review` makes it, at the start and anew when the
    publishers change. A reliability given in ``qos_overrides`` is kept for any publisher.
    `why_idle` returns why no clouds are wanted: while it returns a text, there is no subscription.
    `on_jump` is called as by `TimeJumps`.
    """

    idle = ''
    """Why no clouds were wanted at the last review; empty if they were."""
    _subscription: Any = None
    _reliability = ReliabilityPolicy.UNKNOWN
    _fault_of_types = _fault_of_size = _fault_of_clock = ''

    def __init__(
        self,
        node: Node,
        topic: str,
        callback: OnCloud,
        why_idle: Callable[[], str],
        on_jump: Callable[[float], None],
    ) -> None:
        self._node = node
        self.callback = callback
        self._why_idle = why_idle
        self._jumps = TimeJumps(node, on_jump)
        self._gaps = SequenceGaps()
        # How old the stamps of the newest clouds were when these were sent [s].
        self._ages: deque[float] = deque(maxlen=AGE_WINDOW)
        self._offered: dict[bytes, ReliabilityPolicy] = {}
        self._foreign: set[str] = set()  # types of other messages that are sent on the topic
        self._unresolved_topic = topic
        self.topic: str = node.resolve_topic_name(topic)
        self._profile = wanted_profile(node, topic)
        self._is_pinned = self._profile.reliability != ReliabilityPolicy.BEST_AVAILABLE
        # The executor still uses a subscription within its own event; a guard condition runs
        # after all that became ready with it.
        self._review_soon = node.create_guard_condition(self.review)
        # The event can come before the publisher is listed, and there is no event for the end
        # of the last best-effort publisher: they are looked at every second too.
        node.create_timer(1.0, self._every_second, clock=STEADY_CLOCK)

    @property
    def qos_words(self) -> str:
        """Quality of service in use, as in ``reliable, keep_last 5, volatile``."""
        history, durability = self._profile.history, self._profile.durability
        words = f'{self._reliability.name}, {history.name} {self._profile.depth}'
        return f'{words}, {durability.name}'.lower()

    @property
    def n_publishers(self) -> int:
        """Number of publishers of clouds, when last counted."""
        return len(self._offered)

    @property
    def fault(self) -> str:
        """What is wrong with the way clouds are received; empty if nothing."""
        is_refused = ReliabilityPolicy.BEST_EFFORT in self._offered.values()
        is_pinned = self._is_pinned and self._reliability == ReliabilityPolicy.RELIABLE
        other = NOTHING_ARRIVES if is_pinned and is_refused else self._fault_of_size
        found = (self._fault_of_types, other, self._fault_of_clock, self._fault_of_stamps)
        return '; '.join(filter(None, found))

    @property
    def _fault_of_stamps(self) -> str:
        age = median(self._ages) if self._ages else 0.0
        if abs(age) <= MAX_AGE:
            return ''
        cure = 'set the timestamp mode of the driver, or use_sim_time for a recording'
        if self._node.get_clock().ros_time_is_active:
            cure = 'use_sim_time is true, and the time on /clock is not that of the clouds'
        side = 'before' if age > 0.0 else 'after'
        return f'stamps are of another clock, {abs(age):.1f} s {side} the clouds are sent: {cure}'

    def _receive(self, cloud: PointCloud2, info: dict[str, Any]) -> None:
        if not self._offered:
            self._look_at_publishers()
        n_lost = self._gaps.note(info.get('publication_sequence_number'), self.n_publishers)
        if n_lost and self._look_at_publishers():
            n_lost = 0  # the numbers are those of another publisher
        if self._reliability == ReliabilityPolicy.BEST_EFFORT and len(cloud.data) > LARGE_CLOUD:
            self._fault_of_size = (
                f'clouds of {len(cloud.data) / 1e6:.1f} MB come best-effort, and Fast DDS may '
                'lose most of them: let their publisher offer reliable, or start it with '
                'FASTRTPS_DEFAULT_PROFILES_FILE=config/fastdds_large_clouds.xml'
            )
            self._node.get_logger().warning(f'on {self.topic}, {self._fault_of_size}', once=True)
        self._jumps.note(seconds_of(cloud.header.stamp))
        # All are stamps of the system clock; 0 where the middleware gives none.
        now = time.time_ns()
        if ros_now := self._node.get_clock().now().nanoseconds:
            sent = ros_now - now + (info.get('source_timestamp') or now)
            self._ages.append(1e-9 * sent - seconds_of(cloud.header.stamp))
        wait = max(0.0, 1e-9 * (now - (info.get('received_timestamp') or now)))
        self.callback(cloud, time.monotonic() - wait, n_lost)

    def _on_incompatible(self, _event: object) -> None:
        if self._is_pinned:
            self._node.get_logger().error(f'on {self.topic}, {NOTHING_ARRIVES}')
        self._review_soon.trigger()

    def _look_at_publishers(self) -> bool:
        """Note the publishers; return whether they have changed since the last call."""
        before, foreign = self._offered.keys(), self._foreign
        entries = self._node.get_publishers_info_by_topic(self.topic)
        self._foreign = {entry.topic_type for entry in entries} - {CLOUD_TYPE}
        self._offered = {
            bytes(entry.endpoint_gid): entry.qos_profile.reliability
            for entry in entries
            if entry.topic_type == CLOUD_TYPE
        }
        self._fault_of_types = ''
        if self._foreign:
            self._fault_of_types = (
                f'{" and ".join(sorted(self._foreign))} is sent there, and {CLOUD_TYPE} is '
                'wanted: remap points to a topic of that type, or have the driver send it'
            )
        if self._foreign - foreign:
            self._node.get_logger().warning(f'on {self.topic}, {self._fault_of_types}')
        is_changed = self._offered.keys() != before
        if is_changed:
            self._gaps = SequenceGaps()
        return is_changed

    def _every_second(self) -> None:
        clock = self._node.get_clock()
        has_time = not clock.ros_time_is_active or clock.now().nanoseconds
        self._fault_of_clock = '' if has_time else NO_TIME
        if not has_time:
            self._node.get_logger().warning(NO_TIME, once=True)
        if fault := self._fault_of_stamps:
            self._node.get_logger().warning(f'on {self.topic}, {fault}', once=True)
        self._review_soon.trigger()

    def review(self) -> None:
        """Subscribe as the publishers offer, or not at all, as clouds are wanted now; log it."""
        self._look_at_publishers()
        wanted, offered = self._profile.reliability, self._offered.values()
        if not self._is_pinned:  # what BEST_AVAILABLE is for these publishers
            is_any = ReliabilityPolicy.BEST_EFFORT in offered
            wanted = ReliabilityPolicy.BEST_EFFORT if is_any else ReliabilityPolicy.RELIABLE
        self.idle = self._why_idle()
        is_listening = self._subscription is not None
        if is_listening != bool(self.idle) and wanted == self._reliability:
            return
        if is_listening:
            self._node.destroy_subscription(self._subscription)
            self._subscription = None
            self._gaps = SequenceGaps()
        self._reliability, self._fault_of_size = wanted, ''
        words = f'not listening to {self.topic}: {self.idle}'
        if not self.idle:
            self._subscription = self._node.create_subscription(
                PointCloud2,
                self._unresolved_topic,
                self._receive,
                self._profile,
                event_callbacks=SubscriptionEventCallbacks(incompatible_qos=self._on_incompatible),
            )
            words = f'listening to {self.topic} ({self.qos_words})'
        self._node.get_logger().info(words)


def seconds_of(stamp: TimeMessage) -> float:
    """Return the time of a header [s]."""
    return float(stamp.sec + 1e-9 * stamp.nanosec)


class TimeJumps:
    """Calls `on_jump` with how far [s] stamps of clouds, or the clock of `node`, jump back."""

    _newest: float | None = None  # stamp of a cloud [s]

    def __init__(self, node: Node, on_jump: Callable[[float], None]) -> None:
        self._node = node
        self._on_jump = on_jump
        threshold = JumpThreshold(
            min_forward=None, min_backward=Duration(seconds=-JUMP_TOLERANCE), on_clock_change=False
        )
        # The callback is called as long as this handle lives.
        self._handle = node.get_clock().create_jump_callback(
            threshold, post_callback=self._clock_jumped
        )

    def note(self, stamp: float) -> None:
        """Take the `stamp` of a cloud [s]."""
        newest = stamp if self._newest is None else self._newest
        is_jump = newest - stamp > JUMP_TOLERANCE
        self._newest = stamp if is_jump else max(newest, stamp)
        if is_jump:
            self._jumped(newest - stamp)

    def _clock_jumped(self, jump: TimeJump) -> None:
        # The stamps that follow are part of the same jump.
        self._newest = None
        self._jumped(-1e-9 * jump.delta.nanoseconds)

    def _jumped(self, seconds: float) -> None:
        self._on_jump(seconds)
        self._node.get_logger().info(
            f'time jumped back by {seconds:.1f} s, as when a bag starts again', **THROTTLED
        )
