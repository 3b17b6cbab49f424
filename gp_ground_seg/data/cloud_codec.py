"""PointCloud2 messages as CDR bytes, without ROS."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from gp_ground_seg.data.bag_files import in_one_line
from gp_ground_seg.data.cloud_layout import read_xyz, select_rows
from gp_ground_seg.data.rosbags_support import POINT_CLOUD2, jazzy_types
from gp_ground_seg.errors import PointCloudError

UINT32 = 6
FLOAT32 = 7


@dataclass(frozen=True)
class PointField:
    """A field of the points; `datatype` as in ``sensor_msgs/PointField``."""

    name: str
    offset: int
    datatype: int
    count: int = 1


@dataclass(frozen=True)
class CloudMessage:
    """A ``sensor_msgs/PointCloud2``, attribute by attribute.

    Attributes
    ----------
    stamp : tuple of int
        Seconds and nanoseconds of the header.
    frame_id : str
        Frame of the header.
    height, width : int
        Rows, and points in each.
    fields : tuple of PointField
        What a point consists of.
    point_step, row_step : int
        Bytes from one point, or row, to the next.
    data : (at least height * row_step,) uint8
        The points.
    is_bigendian, is_dense : bool
        Byte order; whether all points are said to be finite.
    """

    stamp: tuple[int, int]
    frame_id: str
    height: int
    width: int
    fields: tuple[PointField, ...]
    point_step: int
    row_step: int
    data: npt.NDArray[np.uint8]
    is_bigendian: bool = False
    is_dense: bool = False

    def xyz(self) -> npt.NDArray[np.float32] | npt.NDArray[np.float64]:
        """Coordinates of every point, (height * width, 3); raises as `read_xyz` does."""
        return read_xyz(
            self.height, self.width, self.fields, self.is_bigendian,
            self.point_step, self.row_step, self.data,
        )  # fmt: skip

    def select(self, mask: npt.NDArray[np.bool_]) -> CloudMessage:
        """Cloud of the points where `mask` is true: same header, same fields, one row.

        ``is_dense`` says whether the kept points are all finite, as in the node's clouds.
        Raises as `select_rows` and `read_xyz` do.
        """
        data = select_rows(
            self.height, self.width, self.point_step, self.row_step, self.data, mask
        )
        width = int(np.count_nonzero(mask))
        kept = dataclasses.replace(
            self, height=1, width=width, row_step=width * self.point_step, data=data
        )
        return dataclasses.replace(kept, is_dense=bool(np.isfinite(kept.xyz()).all()))


def cloud_from_columns(
    stamp: tuple[int, int], frame_id: str, columns: dict[str, npt.NDArray[Any]]
) -> CloudMessage:
    """Cloud with one float32 or uint32 field per column, packed, in the given order."""
    kinds = {'f': ('<f4', FLOAT32), 'u': ('<u4', UINT32)}
    points = np.empty(
        len(next(iter(columns.values()))),
        dtype=[(name, kinds[values.dtype.kind][0]) for name, values in columns.items()],
    )
    for name, values in columns.items():
        points[name] = values
    fields = tuple(
        PointField(name, 4 * k, kinds[values.dtype.kind][1])
        for k, (name, values) in enumerate(columns.items())
    )
    step = points.dtype.itemsize
    data = points.view(np.uint8)
    return CloudMessage(stamp, frame_id, 1, len(points), fields, step, len(data), data)


def decode_cloud(raw: bytes | memoryview) -> CloudMessage:
    """Message from its CDR bytes.

    Raises
    ------
    PointCloudError
        If the bytes are no PointCloud2.
    MissingDependencyError
        If rosbags is not installed.
    """
    types = jazzy_types()
    try:
        message = types.deserialize_cdr(raw, POINT_CLOUD2)
    except Exception as error:
        # As with whole bags: the kind of error depends on where parsing went astray.
        raise PointCloudError(
            f'{len(raw)} bytes that are no {POINT_CLOUD2}: {in_one_line(error)}'
        ) from error
    stamp = message.header.stamp
    return CloudMessage(
        stamp=(stamp.sec, stamp.nanosec),
        frame_id=message.header.frame_id,
        height=message.height,
        width=message.width,
        fields=tuple(PointField(f.name, f.offset, f.datatype, f.count) for f in message.fields),
        point_step=message.point_step,
        row_step=message.row_step,
        data=message.data,
        is_bigendian=bool(message.is_bigendian),
        is_dense=bool(message.is_dense),
    )


def encode_cloud(cloud: CloudMessage) -> bytes:
    """CDR bytes of a message.

    Raises
    ------
    MissingDependencyError
        If rosbags is not installed.
    """
    types = jazzy_types()
    new = types.types
    header = new['std_msgs/msg/Header'](
        stamp=new['builtin_interfaces/msg/Time'](*cloud.stamp), frame_id=cloud.frame_id
    )
    message = new[POINT_CLOUD2](
        header=header,
        height=cloud.height,
        width=cloud.width,
        fields=[
            new['sensor_msgs/msg/PointField'](*dataclasses.astuple(field))
            for field in cloud.fields
        ],
        is_bigendian=cloud.is_bigendian,
        point_step=cloud.point_step,
        row_step=cloud.row_step,
        data=cloud.data,
        is_dense=cloud.is_dense,
    )
    return bytes(types.serialize_cdr(message, POINT_CLOUD2))
