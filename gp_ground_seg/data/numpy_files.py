"""Arrays of numpy: .npy of one table or structured array, .npz of one array for each field."""

from __future__ import annotations

import io
import math
import zipfile
from typing import Any

import numpy as np
import numpy.typing as npt
from numpy.lib import format as npy

from gp_ground_seg.data.clouds import Cloud, Columns, cloud_of, gather, name_columns, scatter
from gp_ground_seg.data.scan_layout import MAX_SCAN_BYTES
from gp_ground_seg.errors import PointCloudError

_READ_HEADER = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}
TABLE = 'points'  # array of an .npz that is a table (N, >= 3), beside fields (N,)


def _read_array(data: bytes) -> npt.NDArray[Any]:
    """Array of the bytes of an .npy file, which must have the size that it says."""
    file = io.BytesIO(data)
    shape, by_columns, dtype = _READ_HEADER[npy.read_magic(file)](file)
    rest = data[file.tell() :]
    if dtype.hasobject:
        raise PointCloudError('holds Python objects, which are not read')
    if math.prod(shape) * dtype.itemsize != len(rest):
        raise PointCloudError(f'{len(rest)} bytes for an array {shape} of {dtype}; truncated?')
    return np.frombuffer(rest, dtype).reshape(shape, order='F' if by_columns else 'C')


def read_npy(data: bytes) -> Cloud:
    """Read a structured array, or a table x, y, z, intensity, ..."""
    return _cloud({TABLE: _read_array(data)})


def read_npz(data: bytes) -> Cloud:
    """Read arrays x, y, z and further fields, or such an array `TABLE`; others are kept aside."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        total = sum(entry.file_size for entry in archive.infolist())
        if total > MAX_SCAN_BYTES:
            raise PointCloudError(f'{total} bytes unpacked, accepted are at most {MAX_SCAN_BYTES}')
        names = [name for name in archive.namelist() if name.endswith('.npy')]
        return _cloud({name[:-4]: _read_array(archive.read(name)) for name in names})


def _cloud(arrays: Columns) -> Cloud:
    columns, table = arrays, arrays.get(TABLE)
    if table is not None and table.dtype.names is None:
        if table.ndim != 2 or table.shape[1] < 3:
            raise PointCloudError(f'array of shape {table.shape}: must be (N, 3) or wider')
        table = name_columns(table)
    if table is not None:
        columns = {**scatter(table.ravel()), **{k: v for k, v in arrays.items() if k != TABLE}}
    size = len(columns['x']) if 'x' in columns and columns['x'].ndim == 1 else -1
    own = {name: v for name, v in columns.items() if v.ndim and len(v) == size}
    aside = {name: v for name, v in columns.items() if name not in own}
    return cloud_of(gather(own), aside)


def encode_npy(cloud: Cloud) -> bytes:
    """File of a structured array."""
    file = io.BytesIO()
    npy.write_array(file, cloud.fields, allow_pickle=False)
    return file.getvalue()


def encode_npz(cloud: Cloud) -> bytes:
    """File of an array for each field, and those that were kept aside."""
    aside = cloud.header if isinstance(cloud.header, dict) else {}
    return encode_arrays({**aside, **scatter(cloud.fields)})


def encode_arrays(arrays: Columns) -> bytes:
    """File .npz of arrays, unlike `numpy.savez` with any names."""
    result = io.BytesIO()
    with zipfile.ZipFile(result, 'w', zipfile.ZIP_DEFLATED) as archive:
        for name, values in arrays.items():
            with archive.open(f'{name}.npy', 'w', force_zip64=True) as file:
                npy.write_array(file, np.ascontiguousarray(values), allow_pickle=False)
    return result.getvalue()
