"""Columns of a ``sensor_msgs/PointCloud2``: read by name, or put behind what is there."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from gp_ground_seg.data.cloud_layout import CloudBytes, PointFieldLike, check_extent
from gp_ground_seg.errors import PointCloudError

_CODES = {1: 'i1', 2: 'u1', 3: 'i2', 4: 'u2', 5: 'i4', 6: 'u4', 7: 'f4', 8: 'f8'}
_DATATYPES = {code: datatype for datatype, code in _CODES.items()}
_ALIGNMENT = 4
"""The added columns start at a multiple of this within a point [bytes]."""


class Column(NamedTuple):
    """Where an added column is: attributes of a ``sensor_msgs/PointField`` with count 1."""

    name: str
    offset: int
    datatype: int


class WiderCloud(NamedTuple):
    """A cloud with columns added; rows and points in each are as before.

    Attributes
    ----------
    columns : tuple of Column
        The added columns, in the order given.
    point_step : int
        Bytes from one point to the next; a row is ``width`` times that.
    data : (height * width * point_step,) uint8
        The points.
    """

    columns: tuple[Column, ...]
    point_step: int
    data: npt.NDArray[np.uint8]


def append_columns(
    height: int,
    width: int,
    is_bigendian: bool,
    point_step: int,
    row_step: int,
    data: CloudBytes,
    columns: Mapping[str, npt.NDArray[Any]],
) -> WiderCloud:
    """Put columns behind the bytes of every point.

    Parameters
    ----------
    height, width, is_bigendian, point_step, row_step, data
        Attributes of the cloud, see `cloud_layout.read_xyz`.
    columns : mapping of str to (height * width,) array
        Values, row by row, of an integer or float type of one to eight bytes that
        PointField knows; written in the byte order of the cloud.

    Returns
    -------
    WiderCloud
        Every byte of every point, then the columns at multiples of four bytes or of
        their own size, zeros between them. Padding of the rows is gone.

    Raises
    ------
    PointCloudError
        If the layout cannot hold what it claims.
    """
    placed, step = _place(point_step, columns)
    size = height * width
    wide = np.zeros(size * step, dtype=np.uint8)
    if size:
        raw = check_extent(height, width, point_step, row_step, data)
        # One opaque element per point moves whole points at once.
        points = np.ndarray((height, width), f'V{point_step}', raw, 0, (row_step, point_step))
        np.ndarray((height, width), points.dtype, wide.data, 0, (width * step, step))[...] = points
        order = '>' if is_bigendian else '<'
        with np.errstate(over='ignore', invalid='ignore'):
            for column in placed:
                code = order + _CODES[column.datatype]
                target: npt.NDArray[Any] = np.ndarray(
                    (size,), code, wide.data, column.offset, (step,)
                )
                target[...] = columns[column.name]
    return WiderCloud(placed, step, wide)


def _place(
    point_step: int, columns: Mapping[str, npt.NDArray[Any]]
) -> tuple[tuple[Column, ...], int]:
    """Offset of each column, and the bytes of a point with all of them."""
    placed = []
    end = _round_up(point_step, _ALIGNMENT)
    for name, values in columns.items():
        size = values.dtype.itemsize
        start = _round_up(end, size)
        placed.append(Column(name, start, _DATATYPES[f'{values.dtype.kind}{size}']))
        end = start + size
    return tuple(placed), _round_up(end, _ALIGNMENT)


def _round_up(value: int, multiple: int) -> int:
    return -(-value // multiple) * multiple


def read_columns(
    height: int,
    width: int,
    fields: Iterable[PointFieldLike],
    is_bigendian: bool,
    point_step: int,
    row_step: int,
    data: CloudBytes,
    names: Sequence[str],
) -> dict[str, npt.NDArray[Any]]:
    """Values of the fields `names`, each (height, width), a copy in native byte order.

    Raises
    ------
    PointCloudError
        If a field is missing, there twice, no single number or beyond the point, or the
        layout cannot hold what it claims.
    """
    known = list(fields)
    raw = check_extent(height, width, point_step, row_step, data) if height * width else None
    values: dict[str, npt.NDArray[Any]] = {}
    for name in names:
        matches = [field for field in known if field.name == name]
        code = _CODES.get(matches[0].datatype) if len(matches) == 1 else None
        if code is None or matches[0].count > 1 or matches[0].offset + int(code[1]) > point_step:
            present = ', '.join(field.name for field in known) or 'none'
            raise PointCloudError(
                f'point cloud: needs exactly one field {name}, a single number within the '
                f'point; fields: {present}'
            )
        if raw is None:
            values[name] = np.empty((height, width), dtype=code)
            continue
        order = '>' if is_bigendian else '<'
        view: npt.NDArray[Any] = np.ndarray(
            (height, width), order + code, raw, matches[0].offset, (row_step, point_step)
        )
        values[name] = view.astype(code)
    return values
