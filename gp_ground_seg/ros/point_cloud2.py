"""``sensor_msgs/PointCloud2`` messages to arrays and back."""

from __future__ import annotations

from array import array

import numpy as np
import numpy.typing as npt
from sensor_msgs.msg import PointCloud2

from gp_ground_seg.data import point_cloud2


def read_xyz(message: PointCloud2) -> npt.NDArray[np.float32] | npt.NDArray[np.float64]:
    """Coordinates of every point, row by row.

    Parameters
    ----------
    message : PointCloud2
        Any layout: fields in any order, FLOAT32 or FLOAT64, any ``point_step``,
        padded rows, either byte order, organised or not.

    Returns
    -------
    (height * width, 3) float32 or float64
        A copy, in the unit of the message [m].

    Raises
    ------
    PointCloudError
        If the message cannot hold what it claims.
    """
    return point_cloud2.read_xyz(message)


def select_points(message: PointCloud2, mask: npt.NDArray[np.bool_]) -> PointCloud2:
    """Cloud of the points where `mask` is true, unorganised (height 1), in input order.

    Parameters
    ----------
    message : PointCloud2
        The cloud to take from; it is not changed.
    mask : (height * width,) bool
        Which points to keep, row by row.

    Returns
    -------
    PointCloud2
        Header, fields, byte order and ``point_step`` of the input, every byte of
        the kept points; ``is_dense`` says whether they are all finite.

    Raises
    ------
    PointCloudError
        If the message cannot hold what it claims, or the mask has another length.
    """
    kept = point_cloud2.select_rows(message, mask)
    # The one type that rclpy takes over without looking at every byte.
    data = array('B')
    data.frombytes(kept.data)
    n_points = int(np.count_nonzero(mask))
    selection = PointCloud2(
        header=message.header,
        height=1,
        width=n_points,
        fields=message.fields,
        is_bigendian=message.is_bigendian,
        point_step=message.point_step,
        row_step=n_points * message.point_step,
    )
    selection.data = data
    selection.is_dense = bool(np.isfinite(read_xyz(selection)).all())
    return selection
