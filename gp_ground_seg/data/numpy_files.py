"""Arrays of numpy: .npy of one table or structured array, .npz of one array for each field."""

from __future__ import annotations

import io

import numpy as np

from gp_ground_seg.core.errors import PointCloudError
from gp_ground_seg.data.clouds import Cloud, Columns, cloud_of, gather, name_columns, scatter
from gp_ground_seg.data.files import MAX_SCAN_BYTES

TABLE = 'points'  # array of an .npz that is a table (N, >= 3), beside fields (N,)


def read_numpy(data: bytes) -> Cloud:
    """Read a table x, y, z, intensity, ..., a structured array, or arrays by name."""
    found = np.load(io.BytesIO(data), allow_pickle=False)
    if isinstance(found, np.ndarray):
        return _cloud({TABLE: found})
    size = sum(entry.file_size for entry in found.zip.infolist())
    if size > MAX_SCAN_BYTES:
        raise PointCloudError(f'{size} bytes unpacked, accepted are at most {MAX_SCAN_BYTES}')
    return _cloud(dict(found))


def _cloud(arrays: Columns) -> Cloud:
    """Cloud of the fields and the table; arrays of other lengths are kept aside."""
    table = arrays.pop(TABLE, None)
    if table is not None and table.dtype.names is None:
        if table.ndim != 2 or table.shape[1] < 3:
            raise PointCloudError(f'array of shape {table.shape}: must be (N, 3) or wider')
        table = name_columns(table)
    columns = {**({} if table is None else scatter(table.ravel())), **arrays}
    shape = columns['x'].shape if 'x' in columns else ()
    own = {name: values for name, values in columns.items() if shape and values.shape[:1] == shape}
    return cloud_of(gather(own), {name: v for name, v in columns.items() if name not in own})


def encode_npy(cloud: Cloud) -> bytes:
    """File of a structured array."""
    file = io.BytesIO()
    np.save(file, cloud.fields)
    return file.getvalue()


def encode_npz(cloud: Cloud) -> bytes:
    """File of an array for each field, and those that were kept aside."""
    aside = cloud.header if isinstance(cloud.header, dict) else {}
    return encode_arrays({**aside, **scatter(cloud.fields)})


def encode_arrays(arrays: Columns) -> bytes:
    """File .npz of arrays by name."""
    file = io.BytesIO()
    np.savez_compressed(file, **arrays)  # type: ignore[arg-type]  # any names
    return file.getvalue()
