"""``sensor_msgs/PointCloud2`` in numpy: coordinates, columns, selections.

The layout functions take any object with the attributes of the message, rclpy's or rosbags'.
Why not `sensor_msgs_py`: it needs ROS, and refuses legal clouds.

Source: sensor_msgs/msg/PointCloud2.msg, sensor_msgs/msg/PointField.msg.
"""

from __future__ import annotations

from array import array
from collections.abc import Callable, Collection, Mapping, Sequence
from copy import copy
from typing import Any, Protocol, TypeVar

import numpy as np
import numpy.typing as npt
from numpy.lib.recfunctions import repack_fields
from numpy.lib.stride_tricks import as_strided

from gp_ground_seg.core.errors import PointCloudError
from gp_ground_seg.core.frame import PointArray
from gp_ground_seg.core.pipeline.points import finite_points, single_precision
from gp_ground_seg.data.clouds import Columns, distinct

_CODES = {1: 'i1', 2: 'u1', 3: 'i2', 4: 'u2', 5: 'i4', 6: 'u4', 7: 'f4', 8: 'f8'}
_DATATYPE_NAMES = {datatype: np.dtype(code).name.upper() for datatype, code in _CODES.items()}
DATATYPES = {code: datatype for datatype, code in _CODES.items()}
_FLOATS = (7, 8)
_ALIGNMENT = 4  # added columns start at a multiple of this in a point, or of their size [bytes]


class CloudMessage(Protocol):
    """Attributes of a ``sensor_msgs/PointCloud2`` message."""

    header: Any
    height: int
    width: int
    fields: Sequence[Any]
    is_bigendian: bool
    point_step: int
    row_step: int
    data: Any
    is_dense: bool


_Message = TypeVar('_Message', bound=CloudMessage)


def stamp_of(header: Any) -> int:
    """Return the stamp of a header [ns]."""
    return int(10**9 * header.stamp.sec + header.stamp.nanosec)


def read_xyz(cloud: CloudMessage, *, is_single: bool = False) -> PointArray:
    """Coordinates of every point, row by row, in native byte order, (height * width, 3).

    They may lie in the data of the cloud, read-only. float64 if one of the three is FLOAT64 and
    not `is_single`; what is finite stays finite. Only x, y and z are checked. A cloud of one row
    never uses ``row_step``, which must not exceed its data; bytes after the last point are
    ignored. A cloud without points needs no fields. Raises PointCloudError if the layout cannot
    hold what it claims.
    """
    if cloud.height * cloud.width == 0:
        return np.empty((0, 3), dtype=np.float32)
    columns = list(_views(cloud, 'xyz', _FLOATS).values())
    first, size = columns[0], columns[0].dtype.itemsize
    x, y, z = (column.ctypes.data for column in columns)
    is_one_type = first.dtype.isnative and all(column.dtype == first.dtype for column in columns)
    if is_one_type and y - x == z - y == size:
        # Side by side, as most sensors write them.
        shape, strides = (*first.shape, 3), (*first.strides, size)
        xyz = as_strided(first, shape, strides, writeable=False).reshape(-1, 3)
    else:
        wide = any(column.dtype.itemsize == 8 for column in columns)
        # Arbitrary bytes may be a signalling NaN, one more value that is not finite.
        with np.errstate(invalid='ignore'):
            # Each coordinate is contiguous, as the segmentation reads it.
            stacked = np.stack(columns, dtype=np.float64 if wide else np.float32)
        xyz = stacked.reshape(3, -1).T
    return single_precision(xyz) if is_single else xyz


def read_columns(cloud: CloudMessage, names: Sequence[str]) -> Columns:
    """Values of the fields `names`, each (height, width), a copy in native byte order."""
    views = _views(cloud, names, _CODES).items()
    return {name: view.astype(view.dtype.newbyteorder('=')) for name, view in views}


def read_fields(cloud: CloudMessage) -> npt.NDArray[np.void]:
    """Every field of every point under its name, row by row, native byte order, (N,) structured.

    A field of several numbers is a sub-array. Raises PointCloudError as `read_xyz`, and if any
    field cannot be as it is described.
    """
    for field in cloud.fields:
        _check_field(field, _CODES, cloud.point_step)
    dtype = np.dtype(
        {
            'names': distinct([field.name for field in cloud.fields]),
            'formats': [
                (_code(cloud, field.datatype), field.count if field.count > 1 else ())
                for field in cloud.fields
            ],
            'offsets': [field.offset for field in cloud.fields],
            'itemsize': cloud.point_step,
        }
    )
    return _view(cloud, dtype).reshape(-1).astype(repack_fields(dtype.newbyteorder('=')))


def append_columns(
    cloud: CloudMessage, columns: Mapping[str, npt.NDArray[Any]]
) -> tuple[list[tuple[str, int, int]], int, npt.NDArray[np.uint8]]:
    """Put columns, (height * width,) of types that PointField knows, behind every point.

    They are written in the byte order of the cloud; bytes between them are zero, padding of the
    rows is gone. Returns name, offset and datatype of each, the new ``point_step`` and the data.
    Raises PointCloudError if the layout cannot hold what it claims.
    """
    placed = []
    end = _round_up(cloud.point_step, _ALIGNMENT)
    for name, values in columns.items():
        itemsize = values.dtype.itemsize
        start = _round_up(end, itemsize)
        placed.append((name, start, DATATYPES[f'{values.dtype.kind}{itemsize}']))
        end = start + itemsize
    step = _round_up(end, _ALIGNMENT)
    points = _view(cloud, f'V{cloud.point_step}')
    wide = np.zeros((points.size, step), dtype=np.uint8)
    wide[:, : cloud.point_step].view(points.dtype)[:] = points.reshape(-1, 1)
    with np.errstate(over='ignore', invalid='ignore'):
        for name, start, datatype in placed:
            column = wide[:, start : start + columns[name].itemsize].view(_code(cloud, datatype))
            column[:, 0] = columns[name]
    return placed, step, wide.reshape(-1)


def _round_up(value: int, multiple: int) -> int:
    return -(-value // multiple) * multiple


def _code(cloud: CloudMessage, datatype: int) -> str:
    return f'{">" if cloud.is_bigendian else "<"}{_CODES[datatype]}'


def _views(cloud: CloudMessage, names: Sequence[str], accepted: Collection[int]) -> Columns:
    """Fields `names` where they lie in the data, each (height, width), checked."""
    views = {}
    _view(cloud, 'u1')  # the layout before the fields
    for name in names:
        matches = [field for field in cloud.fields if field.name == name]
        if len(matches) != 1:
            known = ', '.join(field.name for field in cloud.fields) or 'none'
            many = 'no field' if not matches else f'{len(matches)} fields'
            raise PointCloudError(
                f'point cloud: {many} named {name}: must have exactly one; fields: {known}'
            )
        (field,) = matches
        # Some old writers leave count at 0 and mean 1; PCL reads these too.
        if field.count not in (0, 1):
            raise PointCloudError(f'point cloud: field {name} has count {field.count}: must be 1')
        _check_field(field, accepted, cloud.point_step)
        views[name] = _view(cloud, _code(cloud, field.datatype), field.offset)
    return views


def _check_field(field: Any, accepted: Collection[int], point_step: int) -> None:
    """Raise PointCloudError unless a field is of an accepted type and within the point."""
    what = f'point cloud: field {field.name}'
    if field.datatype not in accepted:
        kind = _DATATYPE_NAMES.get(field.datatype, 'unknown')
        wanted = ' or '.join(f'{_DATATYPE_NAMES[datatype]} ({datatype})' for datatype in accepted)
        raise PointCloudError(f'{what} has datatype {field.datatype} ({kind}): must be {wanted}')
    n_bytes = max(field.count, 1) * int(_CODES[field.datatype][1])
    # numpy adds in 32 bits, and would read outside of the data.
    if not 0 <= field.offset <= point_step - n_bytes:
        place = f'at offset {field.offset} of {n_bytes} bytes'
        raise PointCloudError(f'{what} {place}: must end within point_step {point_step}')


def _view(cloud: CloudMessage, code: npt.DTypeLike, offset: int = 0) -> npt.NDArray[Any]:
    """Type `code` at an offset within each point, (height, width); checks that all points fit."""
    height, width = cloud.height, cloud.width
    point_step, row_step, row_bytes = cloud.point_step, cloud.row_step, width * cloud.point_step
    if height * width == 0:
        return np.empty((height, width), code)
    needed = (height - 1) * row_step + row_bytes
    raw = np.frombuffer(cloud.data, dtype=np.uint8)
    rules = (
        (f'point_step {point_step}', point_step >= 1, 'at least 1 byte'),
        (f'row_step {row_step}', height == 1 or row_step >= row_bytes, f'at least {row_bytes}'),
        (f'data of {len(raw)} bytes', len(raw) >= needed, f'at least {needed}'),
        (f'row_step {row_step}', row_step <= len(raw), f'at most the {len(raw)} bytes of data'),
    )
    layout = f'height {height}, width {width}, point_step {point_step}, row_step {row_step}'
    for what, holds, bound in rules:
        if not holds:
            raise PointCloudError(f'point cloud: {what}: must be {bound} ({layout})')
    view: npt.NDArray[Any] = np.ndarray((height, width), code, raw, offset, (row_step, point_step))
    return view


def select_points(
    cloud: _Message,
    mask: npt.NDArray[np.bool_],
    make_data: Callable[[int], Any] = lambda size: np.empty(size, np.uint8),
    *,
    are_finite: bool = False,
) -> _Message:
    """Message of the points where `mask`, (height * width,) bool, is true, with all their bytes.

    It has the same header and fields, and one row. ``is_dense`` says whether the kept points are
    all finite; they are looked at unless the caller knows that they `are_finite`. `make_data`
    makes what the message holds so many bytes in. Raises PointCloudError as `read_xyz` does.
    """
    index = np.flatnonzero(mask)
    kept = copy(cloud)
    kept.height, kept.width = 1, len(index)
    kept.row_step = kept.width * cloud.point_step
    kept.data = make_data(kept.row_step)
    if len(index):
        # Whole points are 10 times as fast to move as bytes. In any other mode numpy fills an
        # array of its own first.
        points = _view(cloud, f'V{cloud.point_step}').reshape(-1)
        points.take(index, out=np.frombuffer(kept.data, points.dtype), mode='clip')
    kept.is_dense = are_finite or bool(finite_points(read_xyz(kept)).all())
    return kept


def message_bytes(size: int) -> array[int]:
    """Return `size` bytes as the one type that rclpy takes without a look at each."""
    return array('B', [0]) * size


def message_data(values: npt.NDArray[Any], typecode: str = 'B') -> array[Any]:
    """Return the bytes of an array as `message_bytes` does."""
    data = array(typecode)
    data.frombytes(np.ascontiguousarray(values).data.cast('B') if values.size else b'')
    return data
