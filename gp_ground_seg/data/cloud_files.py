"""Point clouds in files, their format known by the suffix; those of numpy are read here.

``.npy`` is one table or structured array, ``.npz`` has an array for each field, or one table.
``.xyz``, ``.txt`` and ``.csv`` have a line for each point, and may have one with the names before.
"""

from __future__ import annotations

import io
import textwrap
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from gp_ground_seg.core.errors import DataError, GroundSegError, PointCloudError, in_one_line
from gp_ground_seg.data.clouds import (
    COLUMNS,
    Cloud,
    Columns,
    Fields,
    check_numbers,
    cloud_of,
    count_numbers,
    gather,
    name_columns,
    scatter,
)
from gp_ground_seg.data.files import MAX_SCAN_BYTES, read_bytes
from gp_ground_seg.data.pcd import encode_pcd, read_pcd
from gp_ground_seg.data.ply import encode_ply, read_ply
from gp_ground_seg.data.scan_layout import KITTI, ScanLayout, check_scan, four_columns, read_scan

NUSCENES_SUFFIX, NUSCENES_COLUMNS = '.pcd.bin', 5
TABLE = 'points'  # array of an .npz that is a table (N, >= 3), beside fields (N,)
COMMENTS = ('#', '//')  # begin lines of a text that are no points


def _read_numpy(data: bytes) -> tuple[Fields, Columns]:
    """Read a table x, y, z, intensity, ..., a structured array, or arrays by name."""
    found = np.load(io.BytesIO(data), allow_pickle=False)
    if isinstance(found, np.ndarray):
        return _fields_of({TABLE: found})
    return _fields_of(dict(found))


def _fields_of(arrays: Columns) -> tuple[Fields, Columns]:
    """Put the fields and the table together; arrays of another length are what is beside them."""
    table = arrays.pop(_table_name(arrays), None)
    if table is not None and table.dtype.names is None:
        if table.ndim != 2 or table.shape[1] < 3:
            raise PointCloudError(f'array of shape {table.shape}: must be (N, 3) or wider')
        table = name_columns(table)
    columns = {**({} if table is None else scatter(table.ravel())), **arrays}
    shape = columns['x'].shape if 'x' in columns else ()
    fields = {name: v for name, v in columns.items() if shape and v.shape[:1] == shape}
    return gather(fields), {name: v for name, v in columns.items() if name not in fields}


def _table_name(arrays: Columns) -> str:
    """Name of the table: `TABLE`, or, where no array is x, the only one that can be a table."""
    if {TABLE, 'x'} & arrays.keys():
        return TABLE
    tables = [name for name, v in arrays.items() if v.dtype.names or v.shape[1:] >= (3,)]
    if len(tables) != 1:
        found = ', '.join(f'{name} {v.shape}' for name, v in arrays.items()) or 'none'
        found = textwrap.shorten(found, 200, placeholder=' ...')
        raise PointCloudError(f'arrays {found}: must be x, y, z, or one array (N, 3) or wider')
    return tables[0]


def _read_text(data: bytes) -> tuple[Fields, None]:
    """Read lines of x, y, z, ..., split by spaces, commas or semicolons; names may be first."""
    text = data.decode('utf-8-sig')
    stripped = (line.strip() for line in io.StringIO(text))
    lines = (line for line in stripped if line and not line.startswith(COMMENTS))
    first = next(lines, '')
    delimiter = next((mark for mark in ',;' if mark in first), None)
    words = [word.strip(' "') for word in first.split(delimiter)]
    check_numbers(len(words))
    if not first:
        raise PointCloudError('no line of numbers in it')
    before = 0 if all(map(_is_number, words)) else text.partition(first)[0].count('\n') + 1
    if before and next(lines, None) is None:
        raise PointCloudError('no points in it, only a line of names')
    table = np.loadtxt(
        io.StringIO(text), delimiter=delimiter, comments=COMMENTS, skiprows=before, ndmin=2
    )
    if not before:
        return _fields_of({TABLE: table})[0], None
    names = [word.lower() if word.lower() in COLUMNS else word for word in words]
    return gather(dict(zip(names, table.T, strict=True))), None


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _encode_npy(cloud: Cloud) -> bytes:
    """File of a structured array."""
    file = io.BytesIO()
    np.save(file, cloud.fields)
    return file.getvalue()


def _encode_npz(cloud: Cloud) -> bytes:
    """File of an array for each field, and of arrays of another length."""
    others = cloud.header if isinstance(cloud.header, dict) else {}
    return encode_arrays({**others, **scatter(cloud.fields)})


def encode_arrays(arrays: Columns) -> bytes:
    """File .npz of arrays by name."""
    file = io.BytesIO()
    np.savez_compressed(file, **arrays)  # type: ignore[arg-type]  # any names
    return file.getvalue()


# Each returns the points, and what the file has beside them.
_READERS: dict[str, Callable[[bytes], tuple[Fields, Any]]] = {
    '.pcd': read_pcd,
    '.ply': read_ply,
    '.npy': _read_numpy,
    '.npz': _read_numpy,
    '.xyz': _read_text,
    '.txt': _read_text,
    '.csv': _read_text,
}
_ENCODERS = {'.pcd': encode_pcd, '.ply': encode_ply, '.npy': _encode_npy, '.npz': _encode_npz}
SUFFIXES = ('.bin', *_READERS)
WRITABLE = tuple(_ENCODERS)


def read_file(path: Path, layout: ScanLayout = KITTI) -> Cloud:
    """Read a file; `layout` is that of ``.bin`` files, says what to do in doubt, and the origin.

    Raises DataError if it cannot be read, is larger than `MAX_SCAN_BYTES`, or, where the layout
    asks for that, can be no scan. nuScenes' ``.pcd.bin`` is known by its name.
    """
    suffix = path.suffix.lower()
    if suffix == '.bin':
        if path.name.endswith(NUSCENES_SUFFIX) and layout.columns == KITTI.columns:
            layout = replace(layout, columns=NUSCENES_COLUMNS)
        table = read_scan(path, layout)
        # Coordinates of a map need their double precision until the origin is subtracted.
        xyz = four_columns(table) if layout.origin is None else table
        cloud = Cloud(name_columns(table), xyz)
    else:
        data = read_bytes(path, MAX_SCAN_BYTES)
        with _named(path, 'cannot be read'), np.errstate(all='ignore'):
            fields, header = _READERS[suffix](data)
            check_numbers(count_numbers(fields.dtype))
            cloud = cloud_of(fields, header)
    cloud = cloud.about(layout.origin)
    check_scan(path, cloud.xyz[:, :3], layout)
    return cloud


def encode_file(path: Path, cloud: Cloud, columns: Columns) -> bytes:
    """File of a cloud with further values for each point; DataError if none can be.

    Its format is that of `path`, one of `WRITABLE`.
    """
    with _named(path, 'cannot be written'), np.errstate(all='ignore'):
        return _ENCODERS[path.suffix](cloud.join(columns))


@contextmanager
def _named(path: Path, what: str) -> Iterator[None]:
    """Raise what goes wrong in the block as a DataError with the name of the file."""
    try:
        yield
    except PointCloudError as error:
        raise DataError(f'{path}: {error}') from error
    except GroundSegError:
        raise
    except Exception as error:  # Of many types: ValueError, struct.error, zlib.error, ...
        said = f'{type(error).__name__}: {in_one_line(error)}'
        raise DataError(f'{path}: {what} as {path.suffix} ({said})') from error
