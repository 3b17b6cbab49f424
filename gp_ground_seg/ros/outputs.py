"""What the node publishes of a segmented cloud: one row per topic."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from rclpy.node import Node
from rclpy.qos_overriding_options import QoSOverridingOptions
from sensor_msgs.msg import PointCloud2

from gp_ground_seg.labels import Label
from gp_ground_seg.ros.point_cloud2 import select_points
from gp_ground_seg.ros.qos import cloud_profile
from gp_ground_seg.segmentation import Segmentation


@dataclass(frozen=True)
class Output:
    """One output topic.

    Attributes
    ----------
    topic : str
        Relative name.
    message_type : type
        Type of the message.
    build : callable
        Makes the message from the cloud that came in and its segmentation.
    is_optional : bool
        Whether it is built only while somebody subscribes.
    """

    topic: str
    message_type: type
    build: Callable[[PointCloud2, Segmentation], Any]
    is_optional: bool


def _points_with(label: Label) -> Callable[[PointCloud2, Segmentation], PointCloud2]:
    def build(cloud: PointCloud2, segmentation: Segmentation) -> PointCloud2:
        return select_points(cloud, segmentation.label == label)

    return build


OUTPUTS = (
    Output('ground', PointCloud2, _points_with(Label.GROUND), is_optional=False),
    Output('obstacles', PointCloud2, _points_with(Label.OBSTACLE), is_optional=False),
)


class OutputPublishers:
    """Publishers of all outputs.

    Parameters
    ----------
    node : Node
        Node that publishes.
    """

    def __init__(self, node: Node) -> None:
        self._publishers = [
            (
                output,
                node.create_publisher(
                    output.message_type,
                    output.topic,
                    cloud_profile(),
                    qos_overriding_options=QoSOverridingOptions.with_default_policies(),
                ),
            )
            for output in OUTPUTS
        ]

    def publish(self, cloud: PointCloud2, segmentation: Segmentation) -> None:
        """Publish all outputs of one cloud; nothing, if one of them cannot be built."""
        messages = [
            (publisher, output.build(cloud, segmentation))
            for output, publisher in self._publishers
            if not output.is_optional or publisher.get_subscription_count() > 0
        ]
        for publisher, message in messages:
            publisher.publish(message)
