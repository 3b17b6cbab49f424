"""The input topic: adapts to its publishers, and knows what it lost."""

from __future__ import annotations

import time
from collections.abc import Callable
from copy import copy
from dataclasses import dataclass
from typing import Any

from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.subscription import Subscription
from sensor_msgs.msg import PointCloud2

from gp_ground_seg.ros.health.rate import SequenceGaps
from gp_ground_seg.ros.qos import INPUT_DEPTH, cloud_profile, in_words, matching_reliability

REVIEW_PERIOD = 1.0
"""Time between two looks at the publishers [s]."""


@dataclass(frozen=True)
class Arrival:
    """How a cloud came.

    Attributes
    ----------
    wait : float
        Time between its arrival in this process and the callback [s].
    n_lost : int
        Clouds of the same publisher just before it that did not arrive. Always 0
        with several publishers, whose counts cannot be told apart.
    """

    wait: float
    n_lost: int


class CloudSubscription:
    """Subscription that is best-effort if a publisher is, and reliable otherwise.

    Reliability given in ``qos_overrides`` is kept whatever the publishers offer.

    Parameters
    ----------
    node : Node
        Node that subscribes.
    topic : str
        Name of the topic, before remapping.
    is_pinned : callable
        Whether the reliability parameter of this name was given by the user.
    callback : callable
        Takes each cloud and its `Arrival`, in the executor of the node.
    """

    def __init__(
        self,
        node: Node,
        topic: str,
        is_pinned: Callable[[str], bool],
        callback: Callable[[PointCloud2, Arrival], None],
    ) -> None:
        self._node = node
        self._unresolved_topic = topic
        self._callback = callback
        self._gaps = SequenceGaps()
        self._offered: dict[bytes, ReliabilityPolicy] = {}
        self.topic: str = node.resolve_topic_name(topic)
        self._is_pinned = is_pinned(f'qos_overrides.{self.topic}.subscription.reliability')
        # To destroy a subscription within its own event would pull it from under the
        # executor; a guard condition runs after all that became ready with the event.
        self._review_soon = node.create_guard_condition(self._review)
        self._subscription = self._create(
            cloud_profile(INPUT_DEPTH), QoSOverridingOptions.with_default_policies()
        )
        # The event can come before the publisher is listed, and nothing tells
        # when the last best-effort publisher has gone.
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        node.create_timer(REVIEW_PERIOD, self._review_soon.trigger, clock=steady)

    @property
    def qos(self) -> QoSProfile:
        """Quality of service in use."""
        return self._subscription.qos_profile

    @property
    def n_publishers(self) -> int:
        """Publishers of the topic, as of the last look."""
        return len(self._offered)

    def _create(self, profile: QoSProfile, overrides: QoSOverridingOptions | None) -> Subscription:
        return self._node.create_subscription(
            PointCloud2,
            self._unresolved_topic,
            self._receive,
            profile,
            event_callbacks=SubscriptionEventCallbacks(incompatible_qos=self._on_incompatible),
            qos_overriding_options=overrides,
        )

    def _receive(self, message: PointCloud2, info: dict[str, Any]) -> None:
        # Both are stamps of the system clock; 0 where the middleware gives none.
        received = info.get('received_timestamp') or 0
        wait = max(0.0, 1e-9 * (time.time_ns() - received)) if received > 0 else 0.0
        if not self._offered:
            self._look_at_publishers()
        n_lost = self._gaps.note(info.get('publication_sequence_number'))
        if n_lost and (self._look_at_publishers() or self.n_publishers != 1):
            n_lost = 0
        self._callback(message, Arrival(wait, n_lost))

    def _on_incompatible(self, _event: object) -> None:
        if self._is_pinned:
            self._node.get_logger().error(
                f'a publisher of {self.topic} does not offer what qos_overrides asks for '
                f'({in_words(self.qos)}): nothing will arrive from it'
            )
        self._review_soon.trigger()

    def _look_at_publishers(self) -> bool:
        """Return whether other publishers are there than at the last look."""
        offered = {
            bytes(entry.endpoint_gid): entry.qos_profile.reliability
            for entry in self._node.get_publishers_info_by_topic(self.topic)
        }
        has_changed = offered.keys() != self._offered.keys()
        self._offered = offered
        if has_changed:
            self._gaps.reset()
        return has_changed

    def _review(self) -> None:
        self._look_at_publishers()
        if not self._offered or self._is_pinned:
            return
        wanted = matching_reliability(self._offered.values())
        if wanted == self.qos.reliability:
            return
        profile = copy(self.qos)
        profile.reliability = wanted
        self._node.get_logger().info(
            f'subscribing {in_words(profile)} to {self.topic}, as its publishers offer'
        )
        self._node.destroy_subscription(self._subscription)
        self._gaps.reset()
        self._subscription = self._create(profile, None)
