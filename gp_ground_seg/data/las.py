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

from gp_ground_seg.data.clouds import Cloud, Columns, cloud_of, gather, in_types, scatter
from gp_ground_seg.data.scan_layout import MAX_SCAN_BYTES
from gp_ground_seg.errors import PointCloudError, require
from gp_ground_seg.frame import Label

_LOGGER = logging.getLogger('gp_ground_seg')
SCALE = 1e-4
"""Resolution of the coordinates of clouds that come from another format [m]."""
CLASS = {Label.UNKNOWN: 0, Label.GROUND: 2, Label.OBSTACLE: 1}
"""ASPRS: 0 created, never classified; 1 unassigned; 2 ground (LAS 1.4 R15, table 17)."""
_TYPES = {f'{kind}{n}' for kind in 'iu' for n in (1, 2, 4, 8)} | {'f4', 'f8'}
_MOST_STEPS = 2e9  # of a coordinate, an int32
_ORIGINAL = 'original_'  # of fields whose name is that of a dimension of another type


def _laspy() -> Any:
    require('lazrs', 'formats')
    return require('laspy', 'formats')


def read_las(data: bytes) -> Cloud:
    """Read a file; PointCloudError if its header cannot be right."""
    laspy = _laspy()
    _check_header(data)
    with laspy.open(io.BytesIO(data), laz_backend=laspy.LazBackend.Lazrs) as reader:
        header = reader.header
        size = header.point_count * header.point_format.size
        room = MAX_SCAN_BYTES if header.are_points_compressed else len(data)
        if size > room:
            raise PointCloudError(f'{header.point_count} points ({size} bytes), of {room} bytes')
        if header.are_points_compressed:
            _check_chunks(data, header)
        las = reader.read()
    if len(las) != header.point_count:
        raise PointCloudError(f'{len(las)} points, its header says {header.point_count}')
    names = [name for name in las.point_format.dimension_names if name not in 'XYZ']
    columns = {name: np.array(las[name]) for name in ('x', 'y', 'z', *names)}
    return cloud_of(gather(columns), header)


def _check_header(data: bytes) -> None:
    """Raise PointCloudError for more records than there is room for; laspy reads on and on."""
    (n_records,) = struct.unpack_from('<I', data, 100)
    if data[24:26] >= b'\x01\x04':
        n_records += struct.unpack_from('<I', data, 243)[0]
    if n_records * 54 > len(data):
        raise PointCloudError(f'{n_records} variable length records in {len(data)} bytes')


def _check_chunks(data: bytes, header: Any) -> None:
    """Raise PointCloudError for a table of chunks that cannot be; lazrs would end the process."""
    (start,) = struct.unpack_from('<q', data, header.offset_to_point_data)
    if start == -1:  # of a writer that could not go back
        (start,) = struct.unpack_from('<q', data, len(data) - 8)
    if not header.offset_to_point_data < start <= len(data) - 8:
        raise PointCloudError(f'table of chunks at byte {start} of {len(data)}; truncated?')
    version, n_chunks = struct.unpack_from('<II', data, start)
    (chunk_size,) = struct.unpack_from('<I', header.vlrs.get('LasZipVlr')[0].record_data, 12)
    least, most = n_chunks, n_chunks * chunk_size
    if version or n_chunks > len(data) or not least <= header.point_count <= most:
        raise PointCloudError(f'{header.point_count} points in {n_chunks} chunks of {chunk_size}')


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
