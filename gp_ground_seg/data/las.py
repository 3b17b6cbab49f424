"""LAS and LAZ files, read and written with laspy; the classification is that of the ASPRS.

The one module that imports laspy, an optional package.
"""

from __future__ import annotations

import copy
import io
import logging
import struct
from typing import Any

import numpy as np
import numpy.typing as npt

from gp_ground_seg.core.errors import PointCloudError, require
from gp_ground_seg.core.frame import Label
from gp_ground_seg.data.clouds import Cloud, Columns, cloud_of, gather, in_types, scatter
from gp_ground_seg.data.scan_layout import MAX_SCAN_BYTES

_LOGGER = logging.getLogger('gp_ground_seg')
SCALE = 1e-4
"""Resolution of the coordinates of clouds that come from another format [m]."""
CLASS = {Label.UNKNOWN: 0, Label.GROUND: 2, Label.OBSTACLE: 1}
"""ASPRS: 0 created, never classified; 1 unassigned; 2 ground (LAS 1.4 R15, table 17)."""
_TYPES = {f'{kind}{n}' for kind in 'iu' for n in (1, 2, 4, 8)} | {'f4', 'f8'}
_MOST_STEPS = 2e9  # of a coordinate, an int32
_ORIGINAL = 'original_'  # of fields whose name is that of a dimension of another type


def _laspy() -> Any:
    require('lazrs', 'laspy lazrs')
    return require('laspy', 'laspy lazrs')


def read_las(data: bytes) -> Cloud:
    """Read a file; PointCloudError if its header cannot be right."""
    laspy = _laspy()
    n_chunks = _check_sizes(data)
    # The reader on one thread takes no size in a damaged file for granted.
    with laspy.open(io.BytesIO(data), laz_backend=laspy.LazBackend.Lazrs) as reader:
        header = reader.header
        size = header.point_count * header.point_format.size
        room = len(data)
        if header.are_points_compressed:
            (chunk_size,) = struct.unpack_from(
                '<I', header.vlrs.get('LasZipVlr')[0].record_data, 12
            )
            room = min(MAX_SCAN_BYTES, n_chunks * chunk_size * header.point_format.size)
        if size > room:
            raise PointCloudError(f'{header.point_count} points ({size} bytes), of {room} bytes')
        las = reader.read()
    if len(las) != header.point_count:
        raise PointCloudError(f'{len(las)} points, its header says {header.point_count}')
    names = [name for name in las.point_format.dimension_names if name not in 'XYZ']
    return cloud_of(gather({name: np.array(las[name]) for name in (*'xyz', *names)}), header)


def _check_sizes(data: bytes) -> int:
    """Return the number of chunks; PointCloudError if there is no room for these or the records.

    laspy would read records on and on, lazrs end the process where it gets no memory for chunks.
    """
    (start, n_records, point_format) = struct.unpack_from('<IIB', data, 96)
    n_chunks = 0
    if data[25] >= 4:  # version 1.4
        n_records += struct.unpack_from('<I', data, 243)[0]
    if point_format & 0x80:  # compressed
        (table,) = struct.unpack_from('<q', data, start)
        if table == -1:  # of a writer that could not go back
            (table,) = struct.unpack_from('<q', data, len(data) - 8)
        (n_chunks,) = struct.unpack_from('<I', data, table + 4)
    if n_records > len(data) // 54 or n_chunks > len(data):
        raise PointCloudError(f'{n_records} records and {n_chunks} chunks in {len(data)} bytes')
    return int(n_chunks)


def encode_las(cloud: Cloud, label: npt.NDArray[np.uint8], compressed: bool) -> bytes:
    """File of a cloud with its `Label` (N,) as classification.

    A cloud that was read from LAS keeps its header, scale and point format. Fields without a
    dimension there, or of another type than it, become extra dimensions. LAS has no coordinates
    that are not finite: such points are left out.
    """
    laspy = _laspy()
    known = np.isfinite(cloud.xyz[:, :3]).all(axis=1)
    if n_lost := np.count_nonzero(~known):
        _LOGGER.warning('LAS has no place for points that are not finite: %d left out', n_lost)
    columns = scatter(in_types(cloud.fields[known], _TYPES, 'LAS', flat=True))
    places = {name: columns.pop(name).astype(np.float64) for name in 'xyz'}
    if isinstance(cloud.header, laspy.LasHeader):
        header = copy.deepcopy(cloud.header)
    else:
        header = _new_header(laspy, places)
        for dimension in header.point_format.dimensions:
            name, kind = dimension.name, dimension.dtype or 'V'
            if name in columns and not np.can_cast(columns[name].dtype, kind):
                columns[f'{_ORIGINAL}{name}'] = columns.pop(name)
        columns['return_number'] = columns['number_of_returns'] = np.ones_like(label[known])
    if np.any(columns.get('classification', 0)):
        columns.setdefault(f'{_ORIGINAL}classification', columns['classification'])
    columns['classification'] = np.array([CLASS[one] for one in sorted(CLASS)])[label[known]]
    extra = columns.keys() - set(header.point_format.dimension_names)
    header.add_extra_dims(
        [laspy.ExtraBytesParams(name, columns[name].dtype) for name in columns if name in extra]
    )
    las = laspy.LasData(
        header, laspy.ScaleAwarePointRecord.zeros(len(label[known]), header=header)
    )
    for name, values in {**places, **columns}.items():
        las[name] = values
    result = io.BytesIO()
    las.write(result, do_compress=compressed)
    return result.getvalue()


def _new_header(laspy: Any, places: Columns) -> Any:
    """Header for points at `places`; resolution `SCALE`, or what their extent needs."""
    header = laspy.LasHeader(version='1.4', point_format=6)
    header.global_encoding.wkt = True  # as the format asks for
    for k, values in enumerate(places.values()):
        if len(values):
            header.offsets[k] = np.floor(values.min())
            header.scales[k] = max(SCALE, np.ptp(values) / _MOST_STEPS)
    return header
