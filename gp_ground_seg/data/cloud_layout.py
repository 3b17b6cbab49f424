"""Byte layout of a ``sensor_msgs/PointCloud2``: plain numbers and bytes in, numpy out.

Takes the attributes of any PointCloud2 (rclpy's or rosbags') and imports neither.
"""

from __future__ import annotations

from array import array
from collections.abc import Iterable
from typing import Protocol, TypeAlias

import numpy as np
import numpy.typing as npt

from gp_ground_seg.errors import PointCloudError

CloudBytes: TypeAlias = 'bytes | bytearray | memoryview | array[int] | npt.NDArray[np.uint8]'

_FLOAT_CODES = {7: 'f4', 8: 'f8'}
_DATATYPE_NAMES = {
    1: 'INT8', 2: 'UINT8', 3: 'INT16', 4: 'UINT16',
    5: 'INT32', 6: 'UINT32', 7: 'FLOAT32', 8: 'FLOAT64',
}  # fmt: skip


class PointFieldLike(Protocol):
    """What is read of a ``sensor_msgs/PointField``."""

    @property
    def name(self) -> str:
        """Name of the field."""

    @property
    def offset(self) -> int:
        """First byte within a point."""

    @property
    def datatype(self) -> int:
        """Code of the number type, 1 (INT8) to 8 (FLOAT64)."""

    @property
    def count(self) -> int:
        """Numbers in the field."""


def read_xyz(
    height: int,
    width: int,
    fields: Iterable[PointFieldLike],
    is_bigendian: bool,
    point_step: int,
    row_step: int,
    data: CloudBytes,
) -> npt.NDArray[np.float32] | npt.NDArray[np.float64]:
    """Coordinates of every point, row by row.

    Only what x, y and z need is checked; other fields may be anything. A cloud
    of one row never uses `row_step`, and bytes after the last point are left alone,
    as in PCL. A cloud without points needs no fields.

    Parameters
    ----------
    height, width : int
        Rows, and points in each.
    fields : iterable of PointField
        Where x, y and z are; FLOAT32 or FLOAT64 at any offset.
    is_bigendian : bool
        Byte order of the numbers.
    point_step, row_step : int
        Bytes from one point, or row, to the next.
    data : bytes-like
        The points.

    Returns
    -------
    (height * width, 3) float32 or float64
        A copy in native byte order; float64 if any of the three is FLOAT64.

    Raises
    ------
    PointCloudError
        If the layout cannot hold what it claims; the message names the
        attribute, its value and what is accepted.

    Source: sensor_msgs/msg/PointCloud2.msg, sensor_msgs/msg/PointField.msg.
    """
    if height * width == 0:
        return np.empty((0, 3), dtype=np.float32)
    raw = check_extent(height, width, point_step, row_step, data)
    columns = _find_xyz(fields, point_step)
    order = '>' if is_bigendian else '<'
    wide = any(code == 'f8' for _, code in columns)
    # One coordinate after the other, as the segmentation takes it.
    xyz = np.empty((3, height, width), dtype=np.float64 if wide else np.float32)
    # Arbitrary bytes may be a signalling NaN, one more value that is not finite.
    with np.errstate(invalid='ignore'):
        for axis, (offset, code) in enumerate(columns):
            xyz[axis] = np.ndarray(
                (height, width), order + code, raw, offset, (row_step, point_step)
            )
    result: npt.NDArray[np.float32] | npt.NDArray[np.float64] = xyz.reshape(3, -1).T
    return result


def select_rows(
    height: int,
    width: int,
    point_step: int,
    row_step: int,
    data: CloudBytes,
    mask: npt.NDArray[np.bool_],
) -> npt.NDArray[np.uint8]:
    """Bytes of the points where `mask` is true, packed into one row.

    Parameters
    ----------
    height, width, point_step, row_step, data
        Attributes of the cloud, see `read_xyz`.
    mask : (height * width,) bool
        Which points to keep, row by row.

    Returns
    -------
    (n * point_step,) uint8
        Every byte of the `n` kept points, in order: the ``data`` of a cloud of height 1,
        width `n`, the same fields and ``point_step``.

    Raises
    ------
    PointCloudError
        If the layout cannot hold what it claims, or the mask has another length.
    """
    if mask.shape != (height * width,) or mask.dtype != np.bool_:
        raise PointCloudError(
            f'mask of shape {mask.shape} and type {mask.dtype}: '
            f'must be bool of shape ({height * width},), one per point'
        )
    if height * width == 0:
        return np.empty(0, dtype=np.uint8)
    raw = check_extent(height, width, point_step, row_step, data)
    # One opaque element per point: numpy then moves whole points, 10 times as fast as bytes.
    points = np.ndarray((height, width), f'V{point_step}', raw, 0, (row_step, point_step))
    kept: npt.NDArray[np.void] = points.reshape(-1).take(np.flatnonzero(mask))
    return kept.view(np.uint8)


def check_extent(
    height: int, width: int, point_step: int, row_step: int, data: CloudBytes
) -> npt.NDArray[np.uint8]:
    """Return `data` as numbers, if all points lie within it without overlap."""
    if point_step < 1:
        raise PointCloudError(f'point cloud: point_step {point_step}: must be at least 1 byte')
    row_bytes = width * point_step
    if height > 1 and row_step < row_bytes:
        raise PointCloudError(
            f'point cloud: row_step {row_step}: must be at least {row_bytes} '
            f'(width {width} * point_step {point_step})'
        )
    needed = (height - 1) * row_step + row_bytes
    raw = np.frombuffer(data, dtype=np.uint8)
    if len(raw) < needed:
        raise PointCloudError(
            f'point cloud: data of {len(raw)} bytes: must be at least {needed} '
            f'(height {height}, width {width}, point_step {point_step}, row_step {row_step})'
        )
    return raw


def _find_xyz(fields: Iterable[PointFieldLike], point_step: int) -> list[tuple[int, str]]:
    """Offset and type code of x, y and z."""
    known = list(fields)
    columns = []
    for axis in 'xyz':
        matches = [field for field in known if field.name == axis]
        if len(matches) != 1:
            names = ', '.join(field.name for field in known) or 'none'
            many = 'no field' if not matches else f'{len(matches)} fields'
            raise PointCloudError(
                f'point cloud: {many} named {axis}: must have exactly one; fields: {names}'
            )
        columns.append(_locate(matches[0], point_step))
    return columns


def _locate(field: PointFieldLike, point_step: int) -> tuple[int, str]:
    code = _FLOAT_CODES.get(field.datatype)
    if code is None:
        kind = _DATATYPE_NAMES.get(field.datatype, 'unknown')
        raise PointCloudError(
            f'point cloud: field {field.name} has datatype {field.datatype} ({kind}): '
            'must be FLOAT32 (7) or FLOAT64 (8)'
        )
    # Some old writers leave count at 0 and mean 1; PCL reads these too.
    if field.count not in (0, 1):
        raise PointCloudError(
            f'point cloud: field {field.name} has count {field.count}: must be 1'
        )
    size = int(code[1])
    if field.offset < 0 or field.offset + size > point_step:
        raise PointCloudError(
            f'point cloud: field {field.name} at offset {field.offset} of {size} bytes: '
            f'must end within point_step {point_step}'
        )
    return field.offset, code
