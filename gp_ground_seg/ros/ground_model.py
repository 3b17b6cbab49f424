"""``~/ground_model``: the estimated surface as a cloud, and back.

In another node::

    from gp_ground_seg.ros.ground_model import read_ground_model

    def on_ground_model(cloud):
        height, std = read_ground_model(cloud).at(x, y)
"""

from __future__ import annotations

import numpy as np
from sensor_msgs.msg import PointCloud2, PointField

from gp_ground_seg.core.ground_model import GroundModel
from gp_ground_seg.core.result import Segmentation
from gp_ground_seg.data.point_cloud2 import message_data, read_columns

FIELDS = ('x', 'y', 'z', 'std', 'length_scale', 'range', 'roll', 'pitch')
"""Fields of the cloud, all float32 [m, rad]. The last three locate a place in the grid: the
horizontal range of the knot in the level frame, and the angles, equal in all points, that turn
the cloud's frame into the level one."""


def ground_model_cloud(cloud: PointCloud2, segmentation: Segmentation) -> PointCloud2:
    """Return the surface of a segmented `cloud` as an organised cloud with its header.

    Row m is segment m, counter-clockwise from -x of the level frame; column k is the k-th
    range. The coordinates and std are NaN where there is no model, length_scale in
    segments without a ground candidate.
    """
    model = GroundModel.of(segmentation)
    n_segments, n_knots = model.height.shape
    points = np.empty((n_segments, n_knots, len(FIELDS)), dtype='<f4')
    with np.errstate(over='ignore'):
        points[..., :3] = model.knot_points()
        points[..., 3] = model.std
        points[..., 4] = model.length_scale
        points[..., 5] = model.knots
        points[..., 6:] = model.roll, model.pitch
    message = PointCloud2(
        header=cloud.header,
        height=n_segments,
        width=n_knots,
        fields=[
            PointField(name=name, offset=4 * k, datatype=PointField.FLOAT32, count=1)
            for k, name in enumerate(FIELDS)
        ],
        is_bigendian=False,
        point_step=4 * len(FIELDS),
        row_step=4 * len(FIELDS) * n_knots,
        is_dense=bool(np.isfinite(points).all()),
    )
    message.data = message_data(points)
    return message


def read_ground_model(cloud: PointCloud2) -> GroundModel:
    """Return the model in a cloud of ``~/ground_model``; `GroundModel.at` gives heights.

    `cloud` is a message of rclpy, or one with the same attributes, such as that of rosbags. Raises
    a PointCloudError if a field is missing, or if the points are not such a grid.
    """
    return GroundModel.from_columns(read_columns(cloud, FIELDS))
