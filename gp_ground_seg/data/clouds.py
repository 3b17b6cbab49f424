"""A point cloud of any format: every field of its file, and the coordinates to segment."""

from __future__ import annotations

import logging
import math
import re
from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import count
from typing import Any

import numpy as np
import numpy.typing as npt

from gp_ground_seg.core.errors import PointCloudError, in_one_line, log_once

Fields = npt.NDArray[np.void]
Columns = dict[str, npt.NDArray[Any]]
COLUMNS = ('x', 'y', 'z', 'intensity')
"""Names of the first columns of a table without names; the others are column_5, ..."""
MAX_NUMBERS = 1000
"""Most numbers of a point: the header of a file without points can name any number."""
_MAX_HEADER_BYTES = 1 << 16
_LONG = {'i8', 'u8'}
_NAN_OF_WINDOWS = re.compile(rb'[-+]?(nan\(\w+\)|1\.#(QNAN|SNAN|IND)\w*)', re.IGNORECASE)


@dataclass(frozen=True)
class Cloud:
    """Points of one scan."""

    #: (N,) every field of the file under its name and in its type; x, y, z [m] among them
    fields: Fields
    #: (N, 3) or wider, points for `GroundSegmenter.segment`: x, y, z [m], the sensor at the
    #: origin; of a ``.bin`` scan (N, 4), with the intensity
    xyz: npt.NDArray[np.floating]
    #: what the file has besides its points, and gets again when it is written; or None
    header: Any = None

    def join(self, columns: Columns) -> Cloud:
        """Return the cloud with further fields; one whose name is taken is called ``gp_NAME``."""
        joined = scatter(self.fields)
        for name, values in columns.items():
            while name in joined:
                name = f'gp_{name}'
            joined[name] = values
        return replace(self, fields=gather(joined))


def coordinate_names(names: Collection[str]) -> list[str]:
    """Names of x, y and z, which some programs write as capitals."""
    return [name if name in names else name.upper() for name in 'xyz']


def cloud_of(fields: Fields, header: Any = None) -> Cloud:
    """Cloud of the points of a structured array; PointCloudError without numbers x, y, z."""
    known = fields.dtype.names or ()
    names = coordinate_names(known)
    for name in names:
        if name not in known or fields.dtype[name].kind not in 'fiu':
            found = ', '.join(f'{k} {fields.dtype[k]}' for k in known) or 'none'
            raise PointCloudError(
                f'no field {name.lower()} of one number per point; fields: {found}'
            )
    columns = [fields[name] for name in names]
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
    fields = np.empty(len(next(iter(columns.values()), ())), dtype=types)
    for name, values in columns.items():
        fields[name] = values
    return fields


def scatter(fields: Fields) -> Columns:
    """Columns of a structured array by name."""
    return {name: fields[name] for name in fields.dtype.names or ()}


def count_numbers(dtype: np.dtype[Any]) -> int:
    """Count the numbers of a point, where a field may have several."""
    return sum(math.prod(dtype[name].shape) for name in dtype.names or ())


def distinct(names: Sequence[str]) -> list[str]:
    """Return `names`, where one that is there already gets ``_2``, ``_3``, ... behind it.

    PointCloudError for more than `MAX_NUMBERS`.
    """
    check_numbers(len(names))
    found: dict[str, None] = {}
    for name in names:
        options = (name if k == 1 else f'{name}_{k}' for k in count(1))
        found[next(option for option in options if option not in found)] = None
    return list(found)


def in_types(
    fields: Fields, accepted: Collection[str], format_name: str, flat: bool = False
) -> Fields:
    """Fields as a format can hold them, little-endian, without spaces in their names.

    Bools become uint8, half floats float32, and where there are no integers of 8 bytes float64 if
    it holds them exactly; where `flat`, a field ``a`` of several numbers becomes fields ``a_0``,
    ``a_1``, ... Names stay `distinct`. Raises PointCloudError for a type that is not `accepted`.
    """
    columns: list[tuple[str, npt.NDArray[Any]]] = []
    for name, values in scatter(fields).items():
        code = values.dtype.str[1:]
        code = {'b1': 'u1', 'f2': 'f4'}.get(code, code)
        if code in _LONG - {*accepted} and np.abs(values.astype('f8')).max(initial=0.0) < 2**53:
            code = 'f8'
        if code not in accepted:
            raise PointCloudError(f'field {name}: {format_name} has no type {values.dtype}')
        values = values.astype(f'<{code}')
        word = '_'.join(name.split())
        word = 'field' if word in ('', '_') else word  # _ is the padding of a PCD
        parts = [(word, values)]
        if flat and values.ndim > 1:
            table = values.reshape(len(values), math.prod(values.shape[1:])).T
            parts = [(f'{word}_{k}', part) for k, part in enumerate(table)]
        columns += parts
    names, arrays = zip(*columns, strict=True)
    return gather(dict(zip(distinct(names), arrays, strict=True)))


def split_header(data: bytes, last: str) -> tuple[list[str], bytes]:
    """Lines of a header, with the `last`, known by its first word, and the bytes behind it."""
    head = data[:_MAX_HEADER_BYTES]
    found = re.search(rf'^{last}\b.*\n'.encode(), head, re.IGNORECASE | re.MULTILINE)
    if found is None:
        raise PointCloudError(f'no {last} line of a header in it; it begins with {data[:20]!r}')
    text = head[: found.end()].decode('utf-8-sig', errors='backslashreplace')
    lines = [line.strip() for line in text.split('\n')]
    return [line for line in lines if line], data[found.end() :]


def read_table(data: bytes, dtype: np.dtype[Any], n_points: int) -> Fields:
    """Read the points behind a header; PointCloudError if there are fewer than it says."""
    if (needed := n_points * dtype.itemsize) > len(data):
        raise PointCloudError(
            f'{len(data)} bytes behind the header, which says {n_points} points '
            f'(at least {needed} bytes); truncated?'
        )
    return np.frombuffer(data, dtype, n_points)


def read_lines(text: bytes, dtype: np.dtype[Any], n_points: int) -> Fields:
    """Read points of a text, one a line; PointCloudError if there are fewer than it should have.

    Further words of a line are left out, as is a field beside x, y and z that has words. Integers
    with other numbers among them become float64.
    """
    lines = [line for line in text.splitlines() if line.strip()][:n_points]
    if len(lines) < n_points:
        raise PointCloudError(f'{len(lines)} points, its header says {n_points}; truncated?')
    wanted = count_numbers(dtype)
    if n_points == 0:
        return np.empty(0, dtype)
    with suppress(ValueError, TypeError):
        return np.loadtxt(lines, dtype, comments=None, ndmin=1, usecols=range(wanted))
    if (n_words := min(len(line.split()) for line in lines)) < wanted:
        raise PointCloudError(
            f'a line of {n_words} words, its header says {wanted}, separated by spaces'
        )
    lines = [_NAN_OF_WINDOWS.sub(b'nan', line) for line in lines]
    columns: Columns = {}
    stop = 0
    for name in dtype.names or ():
        own, shape = dtype[name].base, dtype[name].shape
        start, stop = stop, stop + math.prod(shape)
        for kind in (own, np.dtype('f8')):
            try:
                values = np.loadtxt(lines, kind, None, usecols=range(start, stop), ndmin=2)
            except (ValueError, TypeError) as error:
                problem = in_one_line(error)
                continue
            columns[name] = values.reshape(-1, *shape)
            break
        if name not in columns:
            if name in 'xyzXYZ':
                raise PointCloudError(f'field {name}: {problem} Row 0 is the first point')
            log_once(logging.INFO, f'field {name}: has what is no number; left out')
        elif kind != own:
            log_once(logging.INFO, f'field {name}: has numbers that are no {own}; read as float64')
    return gather(columns)
