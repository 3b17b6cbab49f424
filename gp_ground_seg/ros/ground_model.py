"""``~/ground_model``: the estimated surface as a cloud, and back.

In a node of yours::

    from gp_ground_seg.ros.ground_model import read_ground_model

    def on_ground_model(cloud):
        height, std = read_ground_model(cloud).at(x, y)
"""

from __future__ import annotations

from array import array

import numpy as np
from sensor_msgs.msg import PointCloud2, PointField

from gp_ground_seg.datasets.cloud_columns import read_columns
from gp_ground_seg.ground_model import GroundModel
from gp_ground_seg.segmentation import Segmentation

FIELDS = ('x', 'y', 'z', 'std', 'length_scale')
"""Fields of the cloud, all float32 [m]."""


def ground_model_cloud(cloud: PointCloud2, segmentation: Segmentation) -> PointCloud2:
    """Surface of a segmented `cloud` as an organised cloud with the header of `cloud`.

    Row m is segment m, counter-clockwise from -x; column k is the k-th range. x and y
    are always finite; z and std are NaN where there is no model, length_scale in
    segments without a ground candidate of their own.
    """
    model = GroundModel.of(segmentation)
    n_segments, n_knots = model.height.shape
    points = np.empty((n_segments, n_knots, len(FIELDS)), dtype='<f4')
    with np.errstate(over='ignore'):
        points[..., :3] = model.knot_points()
        points[..., 3] = model.std
        points[..., 4] = model.length_scale
    data = array('B')
    data.frombytes(points.tobytes())
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
    message.data = data
    return message


def read_ground_model(cloud: PointCloud2) -> GroundModel:
    """Return the model in a cloud of ``~/ground_model``; `GroundModel.at` gives heights.

    Parameters
    ----------
    cloud : PointCloud2
        As published: rclpy's message, or one of the same attributes, as of rosbags.

    Raises
    ------
    PointCloudError
        If a field is missing, or the points are not such a grid (any more).
    """
    columns = read_columns(
        cloud.height,
        cloud.width,
        cloud.fields,
        cloud.is_bigendian,
        cloud.point_step,
        cloud.row_step,
        cloud.data,
        FIELDS,
    )
    points = np.stack([columns[axis] for axis in 'xyz'], axis=-1)
    return GroundModel.from_knot_points(points, columns['std'], columns['length_scale'])
