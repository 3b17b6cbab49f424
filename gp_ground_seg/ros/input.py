"""The input: clouds of one topic as their publishers offer them, losses, time jumps."""

import math
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from statistics import median
from typing import Any

from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from sensor_msgs.msg import PointCloud2

from gp_ground_seg.core.errors import ConfigError
from gp_ground_seg.data.point_cloud2 import stamp_of

CLOUD_TYPE = 'sensor_msgs/msg/PointCloud2'
INPUT_DEPTH = 1  # clouds that may wait to be processed: the newest only
MAX_DEPTH = 10_000
QOS_OVERRIDES = 'qos_overrides.'
LARGE_CLOUD = 500_000  # size up to which stock Fast DDS loses no best-effort cloud [bytes]
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


class CloudSubscription:
    """Subscription that is best-effort while any publisher is, and reliable otherwise.

    A best-effort reader loses most of a replayed KITTI bag with stock Fast DDS; a reliable one
    gets nothing from a best-effort LiDAR driver. ROS decides between them when a subscription with
    `ReliabilityPolicy.BEST_AVAILABLE` is made: `review` makes it, at the start and anew when the
    publishers change. A reliability given in ``qos_overrides`` is kept for any publisher.
    `callback` takes a cloud, when it came by ``time.monotonic`` [s], and how many it lost before.
    `why_idle` returns why no clouds are wanted: while it returns a text, there is no subscription.
    `on_jump` is called with how far [s] stamps of clouds jump back, as when a bag starts again.
    """

    idle = ''
    """Why no clouds were wanted at the last review; empty if they were."""
    _subscription: Any = None
    _reliability = ReliabilityPolicy.UNKNOWN
    _size = 0  # of the newest cloud [bytes]
    _newest_stamp = -math.inf  # since the last jump [s]

    def __init__(
        self,
        node: Node,
        topic: str,
        callback: Callable[[PointCloud2, float, int], None],
        why_idle: Callable[[], str],
        on_jump: Callable[[float], None],
    ) -> None:
        self._node = node
        self.callback = callback
        self._why_idle = why_idle
        self._on_jump = on_jump
        # How old the stamps of the newest clouds were when these were sent [s].
        self._ages: deque[float] = deque(maxlen=AGE_WINDOW)
        self._offered: dict[bytes, ReliabilityPolicy] = {}
        self._numbers: list[int] = []  # that publishers have given their newest clouds
        self._foreign: set[str] = set()  # types of other messages that are sent on the topic
        self._logged: set[str] = set()  # first words of the faults that were logged
        self._unresolved_topic = topic
        self.topic: str = node.resolve_topic_name(topic)
        # rclpy declares ``qos_overrides`` only where something subscribes.
        default = QoSProfile(depth=INPUT_DEPTH, reliability=ReliabilityPolicy.BEST_AVAILABLE)
        options = QoSOverridingOptions.with_default_policies()
        declared = node.create_subscription(
            PointCloud2, topic, lambda _cloud: None, default, qos_overriding_options=options
        )
        self._profile: QoSProfile = declared.qos_profile
        node.destroy_subscription(declared)
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
        return '; '.join(self._faults())

    def _faults(self) -> Iterator[str]:
        """Yield each; no two begin with the same word."""
        clock, best_effort = self._node.get_clock(), ReliabilityPolicy.BEST_EFFORT
        if self._foreign:
            yield (
                f'{" and ".join(sorted(self._foreign))} is sent there, and {CLOUD_TYPE} is '
                'wanted: remap points to a topic of that type, or have the driver send it'
            )
        if self._reliability == best_effort and self._size > LARGE_CLOUD:
            yield (
                f'clouds of {self._size / 1e6:.1f} MB come best-effort, and Fast DDS may '
                'lose most of them: let their publisher offer reliable, or start it with '
                'FASTRTPS_DEFAULT_PROFILES_FILE=config/fastdds_large_clouds.xml'
            )
        is_refused = best_effort in self._offered.values()
        if is_refused and self._profile.reliability == ReliabilityPolicy.RELIABLE:
            yield NOTHING_ARRIVES
        if clock.ros_time_is_active and not clock.now().nanoseconds:
            yield NO_TIME
        age = median(self._ages) if self._ages else 0.0
        if abs(age) > MAX_AGE:
            cure = 'set the timestamp mode of the driver, or use_sim_time for a recording'
            if clock.ros_time_is_active:
                cure = 'use_sim_time is true, and the time on /clock is not that of the clouds'
            off = f'{abs(age):.1f} s {"before" if age > 0.0 else "after"}'
            yield f'stamps are of another clock, {off} the clouds are sent: {cure}'

    def _receive(self, cloud: PointCloud2, info: dict[str, Any]) -> None:
        n_lost = self._lost_before(info.get('publication_sequence_number'))
        self._size = len(cloud.data)
        stamp = stamp_of(cloud.header)
        self._note_stamp(1e-9 * stamp)
        # All are stamps of the system clock; 0 where the middleware gives none.
        now = time.time_ns()
        if ros_now := self._node.get_clock().now().nanoseconds:
            sent = ros_now - now + (info.get('source_timestamp') or now)
            self._ages.append(1e-9 * (sent - stamp))
        wait = max(0.0, 1e-9 * (now - (info.get('received_timestamp') or now)))
        self.callback(cloud, time.monotonic() - wait, n_lost)

    def _lost_before(self, number: int | None) -> int:
        """Return how many clouds are missing before the one with this `number`.

        They were lost on the way, or overwritten in a full queue while the node was busy. Each
        publisher numbers its own, and rclpy does not name it: it is the one that is next below.
        """
        if not self._offered:
            self._look_at_publishers()
        if number is None:
            self._numbers.clear()
            return 0
        known = self._numbers
        last = max((own for own in known if own < number), default=None)
        if last is None or (len(known) < self.n_publishers and last < number - 1):
            self._numbers = [*known, number][-max(1, self.n_publishers) :]
            return 0
        known[known.index(last)] = number
        n_lost = number - last - 1
        # Of another publisher, if they have changed.
        return 0 if n_lost and self._look_at_publishers() else n_lost

    def _note_stamp(self, stamp: float) -> None:
        back = self._newest_stamp - stamp
        self._newest_stamp = max(self._newest_stamp, stamp)
        if back > JUMP_TOLERANCE:
            self._newest_stamp = stamp
            self._on_jump(back)
            self._node.get_logger().info(
                f'time jumped back by {back:.1f} s, as when a bag starts again', **THROTTLED
            )

    def _look_at_publishers(self) -> bool:
        """Note the publishers; return whether they have changed since the last call."""
        before = self._offered.keys()
        entries = self._node.get_publishers_info_by_topic(self.topic)
        self._foreign = {entry.topic_type for entry in entries} - {CLOUD_TYPE}
        self._offered = {
            bytes(entry.endpoint_gid): entry.qos_profile.reliability
            for entry in entries
            if entry.topic_type == CLOUD_TYPE
        }
        if is_changed := self._offered.keys() != before:
            self._numbers.clear()
        return is_changed

    def _every_second(self) -> None:
        for fault in self._faults():
            if (kind := fault.split()[0]) not in self._logged:
                self._logged.add(kind)
                self._node.get_logger().warning(f'on {self.topic}, {fault}')
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
        self._reliability, self._size = wanted, 0
        self._numbers.clear()
        words = f'not listening to {self.topic}: {self.idle}'
        if not self.idle:
            self._subscription = self._node.create_subscription(
                PointCloud2,
                self._unresolved_topic,
                self._receive,
                self._profile,
                event_callbacks=SubscriptionEventCallbacks(
                    incompatible_qos=lambda _event: self._review_soon.trigger()
                ),
            )
            words = f'listening to {self.topic} ({self.qos_words})'
        self._node.get_logger().info(words)
