"""Point clouds in files, their format known by the suffix; those of numpy are read here.

``.npy`` is one table or structured array, ``.npz`` has an array for each field, or one table.
"""

from __future__ import annotations

import io
import textwrap
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

import numpy as np
import numpy.typing as npt

from gp_ground_seg.core.errors import DataError, GroundSegError, PointCloudError, in_one_line
from gp_ground_seg.data.clouds import (
    Cloud,
    Columns,
    Fields,
    check_numbers,
    cloud_of,
    coordinate_names,
    count_numbers,
    gather,
    name_columns,
    scatter,
)
from gp_ground_seg.data.files import MAX_SCAN_BYTES, read_bytes
from gp_ground_seg.data.pcd import encode_pcd, read_pcd
from gp_ground_seg.data.ply import encode_ply, read_ply
from gp_ground_seg.data.scan_layout import KITTI_COLUMNS, check_scan, four_columns, read_scan

NUSCENES_SUFFIX, NUSCENES_COLUMNS = '.pcd.bin', 5
TABLE = 'points'  # array of an .npz that is a table (N, >= 3), beside fields (N,)


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
    x = coordinate_names(columns)[0]
    shape = columns[x].shape if x in columns else ()
    fields = {name: v for name, v in columns.items() if shape and v.shape[:1] == shape}
    return gather(fields), {name: v for name, v in columns.items() if name not in fields}


def _table_name(arrays: Columns) -> str:
    """Name of the table: none beside an array x, `TABLE`, or the only one that can be a table."""
    if coordinate_names(arrays)[0] in arrays:
        return ''
    if TABLE in arrays:
        return TABLE
    tables = [name for name, v in arrays.items() if v.dtype.names or v.shape[1:] >= (3,)]
    if len(tables) != 1:
        found = ', '.join(f'{name} {v.shape}' for name, v in arrays.items()) or 'none'
        found = textwrap.shorten(found, 200, placeholder=' ...')
        raise PointCloudError(f'arrays {found}: must be x, y, z, or one array (N, 3) or wider')
    return tables[0]


def _encode_npy(cloud: Cloud) -> bytes:
    """File of a structured array."""
    file = io.BytesIO()
    _write_array(file, cloud.fields)
    return file.getvalue()


def _write_array(file: IO[bytes], values: npt.NDArray[Any]) -> None:
    """Write an ``.npy``, without numpy's warning that names beyond ASCII need numpy 1.17."""
    is_ascii = ''.join(values.dtype.names or ()).isascii()
    np.lib.format.write_array(file, values, None if is_ascii else (3, 0), allow_pickle=False)


def _encode_npz(cloud: Cloud) -> bytes:
    """File of an array for each field, and of arrays of another length."""
    others = cloud.header if isinstance(cloud.header, dict) else {}
    return encode_arrays({**others, **scatter(cloud.fields)})


def encode_arrays(arrays: Columns) -> bytes:
    """File .npz of arrays by name; `numpy.savez` takes some names for its own arguments."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, 'w', zipfile.ZIP_DEFLATED) as archive:
        for name, values in arrays.items():
            with archive.open(f'{name}.npy', 'w', force_zip64=True) as member:
                _write_array(member, np.asarray(values))
    return file.getvalue()


# Each returns the points, and what the file has beside them.
_READERS: dict[str, Callable[[bytes], tuple[Fields, Any]]] = {
    '.pcd': read_pcd,
    '.ply': read_ply,
    '.npy': _read_numpy,
    '.npz': _read_numpy,
}
_ENCODERS = {'.pcd': encode_pcd, '.ply': encode_ply, '.npy': _encode_npy, '.npz': _encode_npz}
SUFFIXES = ('.bin', *_READERS)
WRITABLE = tuple(_ENCODERS)
TEXT_SUFFIXES = ('.xyz', '.txt', '.csv')
"""Files of text, whose columns nobody knows but their author."""
FROM_TEXT = 'a text of points: load it by numpy.loadtxt or pandas.read_csv, save x y z as .npy'


def read_file(path: Path, columns: int = KITTI_COLUMNS) -> Cloud:
    """Read a file; `columns` are the numbers of a point in a ``.bin``.

    Raises DataError if it cannot be read, is larger than `MAX_SCAN_BYTES`, or can be no scan.
    nuScenes' ``.pcd.bin`` is known by its name.
    """
    suffix = path.suffix.lower()
    if suffix == '.bin':
        if path.name.endswith(NUSCENES_SUFFIX) and columns == KITTI_COLUMNS:
            columns = NUSCENES_COLUMNS
        table = read_scan(path, columns)
        return Cloud(name_columns(table), four_columns(table))
    cloud = decode_file(path, read_bytes(path, MAX_SCAN_BYTES))
    check_scan(path, cloud.xyz)
    return cloud


def decode_file(path: Path, data: bytes) -> Cloud:
    """Cloud of the data of a file, of the format of `path`; DataError if it cannot be read."""
    with _named(path, 'cannot be read'), np.errstate(all='ignore'):
        fields, header = _READERS[path.suffix.lower()](data)
        check_numbers(count_numbers(fields.dtype))
        return cloud_of(fields, header)


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
