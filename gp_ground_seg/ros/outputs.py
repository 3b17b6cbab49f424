"""The output topics: an `Output` for each makes a message from a segmented cloud."""

import math
from collections.abc import Callable
from copy import copy
from typing import Any, NamedTuple

import numpy as np
from nav_msgs.msg import OccupancyGrid
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.qos_overriding_options import QoSOverridingOptions
from sensor_msgs.msg import LaserScan, PointCloud2, PointField

from gp_ground_seg.core.frame import NOT_FINITE, BoolArray
from gp_ground_seg.core.ground_model import GroundModel
from gp_ground_seg.data import costmap, point_cloud2
from gp_ground_seg.data.point_cloud2 import message_bytes, message_data, read_xyz, select_points

LABELLED_FIELDS = ('label', 'height', 'ground_z', 'ground_std', 'return_std', 'p_ground')
"""Fields of ``~/labeled``: uint8 `Label`, then float32, [m] but for the probability."""
MODEL_FIELDS = (
    'x', 'y', 'z', 'std', 'length_scale', 'range', 'roll', 'pitch', 'origin_x', 'origin_y',
    'origin_z',
)  # fmt: skip
"""Fields of ``~/ground_model``, all float32 [m, rad]. The last six locate a place in the grid: the
horizontal range of the knot in the level frame, and, equal in all points, the angles that turn the
cloud's frame into the level one, and the place of the sensor in it."""
OUTPUT_DEPTH = 20  # messages kept: Fast DDS may send a lost fragment again after 0.7 s only
MAP_LIFESPAN = 0.9  # a grid for a reader that comes later has been sent so long ago at most [s]
LONGEST_PERIOD = 1.0  # between two clouds [s]: from then on some are missing, ``scan_time`` is 0


class Output(NamedTuple):
    """A topic, and the function that makes its message."""

    topic: str
    message_type: type
    build: Callable[[costmap.SegmentedCloud], Any]
    is_optional: bool  # built only while it has a subscriber
    profile: QoSProfile = QoSProfile(depth=OUTPUT_DEPTH)


def labelled_cloud(segmented: costmap.SegmentedCloud) -> PointCloud2:
    """Return the cloud with `LABELLED_FIELDS` added to every point, with ``gp_`` if in use.

    Header, order, shape and every byte of every point are the input's; padding of the rows is
    left out. ``is_dense`` tells whether the coordinates and all added values are finite.
    """
    cloud, columns = segmented.cloud, {}
    for field in LABELLED_FIELDS:
        name = field
        while name in columns or any(name == other.name for other in cloud.fields):
            name = f'gp_{name}'
        values = getattr(segmented.segmentation, field)
        with np.errstate(over='ignore'):
            columns[name] = values if field == 'label' else values.astype(np.float32, copy=False)
    placed, step, data = point_cloud2.append_columns(cloud, columns)
    message = copy(cloud)
    message.fields = [
        *cloud.fields,
        *(PointField(name=n, offset=start, datatype=kind, count=1) for n, start, kind in placed),
    ]
    message.point_step, message.row_step = step, cloud.width * step
    message.data = message_data(data)
    known = read_xyz(cloud), *columns.values()
    message.is_dense = all(bool(np.isfinite(values).all()) for values in known)
    return message


def ground_model_cloud(segmented: costmap.SegmentedCloud) -> PointCloud2:
    """Return the surface of a segmented cloud as an organised cloud with its header.

    Row m is segment m, counter-clockwise from -x of the level frame; column k is the k-th
    range. The coordinates and std are NaN where there is no model, length_scale in
    segments without a ground candidate.
    """
    model = GroundModel.of(segmented.segmentation)
    n_segments, n_knots = model.height.shape
    places, pose = np.moveaxis(model.knot_points(), -1, 0), (model.roll, model.pitch)
    columns = *places, model.std, model.length_scale, model.knots, *pose, *model.origin
    with np.errstate(over='ignore'):
        points = np.stack(np.broadcast_arrays(*columns), axis=-1).astype('<f4')
    return PointCloud2(
        header=segmented.cloud.header,
        height=n_segments,
        width=n_knots,
        fields=[
            PointField(name=name, offset=4 * k, datatype=PointField.FLOAT32, count=1)
            for k, name in enumerate(MODEL_FIELDS)
        ],
        is_bigendian=False,
        point_step=4 * len(MODEL_FIELDS),
        row_step=4 * len(MODEL_FIELDS) * n_knots,
        is_dense=bool(np.isfinite(points).all()),
        data=message_data(points),
    )


def read_ground_model(cloud: PointCloud2) -> GroundModel:
    """Return the model in a cloud of ``~/ground_model``; `GroundModel.at` gives heights.

    `cloud` is a message of rclpy, or one with the same attributes, such as that of rosbags. Raises
    a PointCloudError if a field is missing, or if the points are not such a grid.
    """
    return GroundModel.from_columns(point_cloud2.read_columns(cloud, MODEL_FIELDS))


def scan(segmented: costmap.SegmentedCloud) -> LaserScan:
    """Return the nearest obstacle in each direction about the origin of the cloud.

    Infinite where the direction has returns and no obstacle, NaN where it has no return. Edges of
    drops are obstacles if ``output.max_step_down`` is not 0, and NaN is what they may hide.
    """
    step = 2.0 * math.pi / costmap.DIRECTIONS
    message = LaserScan(header=segmented.cloud.header, angle_increment=step)
    message.angle_min, message.angle_max = 0.5 * step - math.pi, math.pi - 0.5 * step
    message.range_max = segmented.config.grid.r_max
    returns = segmented.places(segmented.segmentation.grid.cell != NOT_FINITE)
    message.ranges = message_data(costmap.scan_ranges(segmented.blocked, returns), 'f')
    return message


def occupancy_grid(segmented: costmap.SegmentedCloud) -> OccupancyGrid:
    """Return the cells about the origin of the cloud: free, occupied or unknown."""
    output, ground_std = segmented.config.output, segmented.config.label.ground_tolerance
    ground, obstacles = segmented.places(segmented.is_ground), segmented.blocked
    reach = costmap.reach_of_model(segmented.segmentation.surface, segmented.heading, ground_std)
    cells = costmap.occupancy(ground, obstacles, reach, output.cell_size, output.grid_size)
    message = OccupancyGrid(header=segmented.cloud.header)
    info = message.info
    info.map_load_time, info.resolution = message.header.stamp, output.cell_size
    info.height, info.width = cells.shape
    info.origin.position.x = info.origin.position.y = -0.5 * info.width * output.cell_size
    info.origin.orientation.w = 1.0
    message.data = message_data(cells, 'b')
    return message


def _selected(segmented: costmap.SegmentedCloud, chosen: BoolArray) -> PointCloud2:
    """Return the `chosen` points, (N,) bool, which are finite, with every byte of each."""
    return select_points(segmented.cloud, chosen, message_bytes, are_finite=True)


# Readers of maps are transient local, or not; DDS keeps no old one for those.
_OF_MAPS = QoSProfile(
    depth=OUTPUT_DEPTH,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
    lifespan=Duration(seconds=MAP_LIFESPAN),
)
OUTPUTS = (
    Output('ground', PointCloud2, lambda s: _selected(s, s.is_ground), False),
    Output('obstacles', PointCloud2, lambda s: _selected(s, s.is_obstacle), False),
    Output('~/labeled', PointCloud2, labelled_cloud, True),
    Output('~/ground_model', PointCloud2, ground_model_cloud, True),
    Output('~/scan', LaserScan, scan, True),
    Output('~/occupancy', OccupancyGrid, occupancy_grid, True, _OF_MAPS),
)


class OutputPublishers:
    """Publishers of all outputs of `node`."""

    _stamp = math.inf  # of the last cloud [s]

    def __init__(self, node: Node) -> None:
        options = {'qos_overriding_options': QoSOverridingOptions.with_default_policies()}
        self._publishers = [
            # A copy: rclpy writes qos_overrides of this node into it.
            (o, node.create_publisher(o.message_type, o.topic, copy(o.profile), **options))
            for o in OUTPUTS
        ]

    def n_subscribers(self) -> dict[str, int]:
        """Return the number of subscribers of each topic."""
        return {p.topic_name: p.get_subscription_count() for _, p in self._publishers}

    def publish(self, segmented: costmap.SegmentedCloud) -> None:
        """Publish all outputs of a cloud, or none if one cannot be built."""
        seconds = 1e-9 * point_cloud2.stamp_of(segmented.cloud.header)
        period, self._stamp = seconds - self._stamp, seconds
        messages = [
            (publisher, output.build(segmented))
            for output, publisher in self._publishers
            if not output.is_optional or publisher.get_subscription_count() > 0
        ]
        for publisher, message in messages:
            if isinstance(message, LaserScan):
                message.scan_time = period if 0.0 < period < LONGEST_PERIOD else 0.0
            publisher.publish(message)
