"""A point cloud of any format: every field of its file, and the coordinates to segment."""

from __future__ import annotations

import io
import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from gp_ground_seg.core.errors import PointCloudError

Fields = npt.NDArray[np.void]
Columns = dict[str, npt.NDArray[Any]]
COLUMNS = ('x', 'y', 'z', 'intensity')
"""Names of the first columns of a table without names; the others are column_5, ..."""
MAX_NUMBERS = 1000
"""Numbers of a point that are accepted: a header can name more where there is no point."""


@dataclass(frozen=True)
class Cloud:
    """Points of one scan.

    Attributes
    ----------
    fields : (N,) structured array
        Every field of the file under its name and in its type; x, y, z [m] among them.
    xyz : (N, 3) or wider float32 or float64 array
        Points for `GroundSegmenter.segment`: x, y, z [m], the sensor at the origin; of a ``.bin``
        scan (N, 4), with the intensity.
    header : opaque
        Contents of the file beside the points, with which it is written again; None without.
    """

    fields: Fields
    xyz: npt.NDArray[np.floating]
    header: Any = None

    def take(self, mask: npt.NDArray[np.bool_]) -> Cloud:
        """Return the points where `mask` is true."""
        return replace(self, fields=self.fields[mask], xyz=self.xyz[mask])

    def join(self, columns: Columns) -> Cloud:
        """Return the cloud with further fields; one whose name is taken is called ``gp_NAME``."""
        taken = self.fields.dtype.names or ()
        new = {f'gp_{name}' if name in taken else name: v for name, v in columns.items()}
        return replace(self, fields=gather({**scatter(self.fields), **new}))


def cloud_of(fields: Fields, header: Any = None) -> Cloud:
    """Cloud of the points of a structured array; PointCloudError without numbers x, y, z."""
    for name in 'xyz':
        dtype = dict(fields.dtype.fields or {}).get(name, [np.dtype('V')])[0]
        if dtype.kind not in 'fiu':
            known = ', '.join(fields.dtype.names or ()) or 'none'
            raise PointCloudError(f'no field {name} of one number per point; fields: {known}')
    columns = [fields[name] for name in 'xyz']
    is_single = all(column.dtype.kind == 'f' and column.itemsize <= 4 for column in columns)
    # A sensor's bytes may be a signalling NaN.
    with np.errstate(invalid='ignore'):
        xyz = np.stack(columns, axis=1, dtype=np.float32 if is_single else np.float64)
    return Cloud(fields, xyz, header)


def check_numbers(n: int) -> None:
    """Raise PointCloudError if a point has more than `MAX_NUMBERS` numbers."""
    if n > MAX_NUMBERS:
        raise PointCloudError(f'{n} numbers per point, accepted are at most {MAX_NUMBERS}')


def name_columns(table: npt.NDArray[Any]) -> Fields:
    """Structured array (N,) of a table (N, columns); PointCloudError for too many columns."""
    check_numbers(table.shape[1])
    names = [*COLUMNS, *(f'column_{k}' for k in range(5, table.shape[1] + 1))]
    dtype = np.dtype([(name, table.dtype) for name in names[: table.shape[1]]])
    return np.ascontiguousarray(table).view(dtype).reshape(len(table))


def gather(columns: Mapping[str, npt.NDArray[Any]]) -> Fields:
    """Structured array (N,), packed, of arrays (N, ...) by name."""
    types = [(name, values.dtype, values.shape[1:]) for name, values in columns.items()]
    size = len(next(iter(columns.values()), ()))
    fields = np.empty(size, dtype=types)
    for name, values in columns.items():
        fields[name] = values
    return fields


def scatter(fields: Fields) -> Columns:
    """Columns of a structured array by name."""
    return {name: fields[name] for name in fields.dtype.names or ()}


def count_numbers(dtype: np.dtype[Any]) -> int:
    """Count the numbers of a point, where a field may have several."""
    return sum(math.prod(dtype[name].shape) for name in dtype.names or ())


def in_types(
    fields: Fields, accepted: Collection[str], format_name: str, flat: bool = False
) -> Fields:
    """Fields as a format can hold them, little-endian, without spaces in their names.

    Bools become uint8 and half floats float32; where `flat`, a field ``a`` of several numbers
    becomes fields ``a_0``, ``a_1``, ... Raises PointCloudError for a type that is not `accepted`.
    """
    columns = {}
    for name, values in scatter(fields).items():
        name = '_'.join(name.split())
        code = values.dtype.str[1:]
        code = {'b1': 'u1', 'f2': 'f4'}.get(code, code)
        if code not in accepted:
            raise PointCloudError(f'field {name}: {format_name} has no type {values.dtype}')
        values = values.astype(f'<{code}')
        if flat and values.ndim > 1:
            table = values.reshape(len(values), int(np.prod(values.shape[1:])))
            columns.update({f'{name}_{k}': table[:, k] for k in range(table.shape[1])})
        else:
            columns[name] = values
    return gather(columns)


def read_table(data: bytes, dtype: np.dtype[Any], n_points: int, is_text: bool) -> Fields:
    """Read the points behind a header; PointCloudError if there are fewer than it says."""
    # In a text each number takes two bytes, except the last.
    needed = n_points * (2 * count_numbers(dtype) if is_text else dtype.itemsize) - is_text
    if needed > len(data):
        raise PointCloudError(
            f'{len(data)} bytes behind the header, which says {n_points} points '
            f'(at least {needed} bytes); truncated?'
        )
    if not (is_text and n_points):
        return np.frombuffer(data, dtype, n_points)
    text = io.BytesIO(data)
    points: Fields = np.loadtxt(text, dtype, comments=None, max_rows=n_points, ndmin=1)
    if len(points) != n_points:
        raise PointCloudError(f'{len(points)} points, its header says {n_points}; truncated?')
    return points
