"""What became of the clouds a publisher sent."""

from __future__ import annotations

from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import PointCloud2

DEPTH = 100
"""Clouds kept until they are acknowledged. Small ones are so a few at a time, and lost pieces
of large ones can take 3 s with stock Fast DDS; acknowledged ones need no memory."""
_NOW = Duration(seconds=0)


class TrackedPublisher:
    """Publisher of serialised clouds that knows how many did not get through.

    A cloud is delivered when every reliable subscriber has acknowledged it: its
    middleware has it. What a slow subscriber then pushes out of its own queue is
    for that one to tell; what a best-effort subscriber gets, nobody knows.

    The middleware tells only whether *all* clouds sent so far are acknowledged.
    Those of which this was never seen are counted as undelivered once newer ones
    take their place, their subscribers are gone, or the counting ends.

    Parameters
    ----------
    node : Node
        Node that publishes.
    topic : str
        Name of the topic, before remapping.
    """

    def __init__(self, node: Node, topic: str) -> None:
        profile = QoSProfile(
            history=HistoryPolicy.KEEP_LAST,
            depth=DEPTH,
            reliability=ReliabilityPolicy.RELIABLE,
        )
        self._node = node
        self._publisher = node.create_publisher(PointCloud2, topic, profile)
        self.topic: str = self._publisher.topic_name
        self.n_sent = 0
        self.n_without_subscriber = 0
        self.n_given_up = 0
        self.n_pending = 0
        self.has_best_effort_subscriber = False

    @property
    def n_subscribers(self) -> int:
        """Subscribers that can receive."""
        n: int = self._publisher.get_subscription_count()
        return n

    @property
    def n_undelivered(self) -> int:
        """Clouds that nobody was there for, or not everybody has acknowledged."""
        return self.n_without_subscriber + self.n_given_up + self.n_pending

    def publish(self, raw: bytes) -> None:
        """Send one cloud of CDR bytes."""
        self.update()
        if self.n_subscribers == 0:
            self.n_without_subscriber += 1
        else:
            if self.n_pending == DEPTH:
                # The queue is full: this one takes the place of the oldest.
                self._give_up(1)
            self.n_pending += 1
        self._publisher.publish(raw)
        self.n_sent += 1

    def update(self) -> None:
        """Ask what has been acknowledged since the last time."""
        if self.n_pending == 0:
            return
        # First: without subscribers everything is "acknowledged".
        if self.n_subscribers == 0:
            self._give_up(self.n_pending)
        elif self._publisher.wait_for_all_acked(_NOW):
            self.n_pending = 0

    def look_at_subscribers(self) -> None:
        """Note whether there is one whose losses stay unknown."""
        for entry in self._node.get_subscriptions_info_by_topic(self.topic):
            if entry.qos_profile.reliability == ReliabilityPolicy.BEST_EFFORT:
                self.has_best_effort_subscriber = True

    def _give_up(self, n_clouds: int) -> None:
        self.n_given_up += n_clouds
        self.n_pending -= n_clouds
