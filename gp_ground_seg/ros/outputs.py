"""What the node publishes of a segmented cloud: one row per topic."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from rclpy.node import Node
from rclpy.qos_overriding_options import QoSOverridingOptions
from sensor_msgs.msg import PointCloud2

from gp_ground_seg.frame import Label
from gp_ground_seg.parameters.config import Config
from gp_ground_seg.result import Segmentation
from gp_ground_seg.ros.ground_model import ground_model_cloud
from gp_ground_seg.ros.labelled import FIELDS, free_names, labelled_cloud
from gp_ground_seg.ros.point_cloud2 import select_points
from gp_ground_seg.ros.qos import cloud_profile


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
        Makes the message from the cloud that came in, its segmentation and the
        parameters it was made with.
    is_optional : bool
        Whether it is built only while somebody subscribes.
    """

    topic: str
    message_type: type
    build: Callable[[PointCloud2, Segmentation, Config], Any]
    is_optional: bool


def _points_with(label: Label) -> Callable[[PointCloud2, Segmentation, Config], PointCloud2]:
    def build(cloud: PointCloud2, segmentation: Segmentation, _config: Config) -> PointCloud2:
        return select_points(cloud, segmentation.label == label)

    return build


def _labelled(cloud: PointCloud2, segmentation: Segmentation, _config: Config) -> PointCloud2:
    return labelled_cloud(cloud, segmentation)


def _ground_model(cloud: PointCloud2, segmentation: Segmentation, _config: Config) -> PointCloud2:
    return ground_model_cloud(cloud, segmentation)


LABELLED = Output('~/labeled', PointCloud2, _labelled, is_optional=True)
CLOUD_OUTPUTS = (
    Output('ground', PointCloud2, _points_with(Label.GROUND), is_optional=False),
    Output('obstacles', PointCloud2, _points_with(Label.OBSTACLE), is_optional=False),
    LABELLED,
    Output('~/ground_model', PointCloud2, _ground_model, is_optional=True),
)


def marker_outputs() -> tuple[Output, ...]:
    """Return the output of ``~/markers``.

    Raises
    ------
    ImportError
        If visualization_msgs or geometry_msgs is not installed.
    """
    from visualization_msgs.msg import MarkerArray

    from gp_ground_seg.ros.markers import markers

    return (Output('~/markers', MarkerArray, markers, is_optional=True),)


class OutputPublishers:
    """Publishers of all outputs.

    Parameters
    ----------
    node : Node
        Node that publishes.
    """

    def __init__(self, node: Node) -> None:
        self._logger = node.get_logger()
        outputs: tuple[Output, ...] = CLOUD_OUTPUTS
        try:
            outputs += marker_outputs()
        except ImportError as error:
            self._logger.warning(
                f'no topic ~/markers: {error.name} is not installed '
                '(sudo apt install ros-jazzy-visualization-msgs)'
            )
        self._renamed: dict[str, str] = {}
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
            for output in outputs
        ]

    def n_subscribers(self) -> dict[str, int]:
        """Return how many subscribe to each topic."""
        return {
            publisher.topic_name: publisher.get_subscription_count()
            for _, publisher in self._publishers
        }

    def publish(self, cloud: PointCloud2, segmentation: Segmentation, config: Config) -> list[str]:
        """Publish all outputs of one cloud; nothing, if one of them cannot be built.

        Returns
        -------
        list of str
            Topics published to.
        """
        wanted = [
            (output, publisher)
            for output, publisher in self._publishers
            if not output.is_optional or publisher.get_subscription_count() > 0
        ]
        messages = [
            (publisher, output.build(cloud, segmentation, config)) for output, publisher in wanted
        ]
        if any(output is LABELLED for output, _ in wanted):
            self._say_what_is_renamed(cloud)
        for publisher, message in messages:
            publisher.publish(message)
        return [publisher.topic_name for publisher, _ in messages]

    def _say_what_is_renamed(self, cloud: PointCloud2) -> None:
        names = free_names(field.name for field in cloud.fields)
        renamed = {field: names[field] for field in FIELDS if names[field] != field}
        if renamed != self._renamed:
            self._renamed = renamed
            for field, name in renamed.items():
                self._logger.warning(
                    f'the input has a field {field} of its own, which is kept; '
                    f'in ~/labeled ours is {name}'
                )
