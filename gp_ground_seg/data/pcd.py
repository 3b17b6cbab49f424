"""PCD files of the Point Cloud Library: text, binary and compressed, read and written.

Why not pypcd4: it reads fields of several numbers wrongly from compressed files, takes what a
header says of sizes for granted, and has no way to leave padding out. Compressed files need its
codec, the package python-neo-lzf.

Source: https://pointclouds.org/documentation/tutorials/pcd_file_format.html, pcl/io/pcd_io.cpp.
"""

from __future__ import annotations

import re
import struct
from typing import Any, NamedTuple

import numpy as np

from gp_ground_seg.data import clouds
from gp_ground_seg.data.clouds import Cloud, Fields, gather, scatter
from gp_ground_seg.data.scan_layout import MAX_SCAN_BYTES
from gp_ground_seg.errors import PointCloudError, require

_END = re.compile(rb'^DATA[ \t]+(\w+)[ \t]*\r?\n', re.MULTILINE)
_MAX_HEADER_BYTES = 1 << 16
_TYPES = {f'{kind}{n}' for kind in 'iu' for n in (1, 2, 4, 8)} | {'f4', 'f8'}
COMPRESSED = 'binary_compressed'
VIEWPOINT = '0 0 0 1 0 0 0'


class PcdHeader(NamedTuple):
    """What a file says besides its points."""

    width: int
    height: int
    viewpoint: str = VIEWPOINT
    is_compressed: bool = False


def read_pcd(data: bytes) -> Cloud:
    """Read a file; PointCloudError if it cannot be one."""
    end = _END.search(data[:_MAX_HEADER_BYTES])
    if end is None:
        raise PointCloudError('no DATA line of a PCD header in it')
    lines = data[: end.start()].decode('ascii', 'replace').splitlines()
    entries = {words[0]: words[1:] for words in map(str.split, lines) if words}
    for key in ('SIZE', 'TYPE', 'WIDTH'):
        if key not in entries:
            raise PointCloudError(f'no {key} line in its header')
    names = entries.get('FIELDS', entries.get('COLUMNS', []))
    counts = [int(word) for word in entries.get('COUNT', ['1'] * len(names))]
    width, height = int(entries['WIDTH'][0]), int(entries.get('HEIGHT', '1')[0])
    n_points = int(entries.get('POINTS', [str(width * height)])[0])
    if min(width, height) < 0 or min(counts, default=0) < 1 or n_points != width * height:
        raise PointCloudError(f'{n_points} points, which is not width {width} * height {height}')
    types: list[tuple[str, str, Any]] = []
    padding: set[str] = set()
    rows = zip(names, entries['TYPE'], entries['SIZE'], counts, strict=True)
    for name, kind, size, count in rows:
        if (code := f'{kind.lower()}{size}') not in _TYPES:
            raise PointCloudError(f'field {name}: no type {kind} of {size} bytes')
        if name == '_':
            name = f'padding {len(padding)}'
            padding.add(name)
        types.append((name, f'<{code}', () if count == 1 else (count,)))
    data_kind, rest = end[1].decode(), data[end.end() :]
    if data_kind == COMPRESSED:
        # Field after field, and no padding.
        dtype = np.dtype([one for one in types if one[0] not in padding])
        fields = _split(_decompress(rest, n_points * dtype.itemsize), dtype, n_points)
    elif data_kind in ('ascii', 'binary'):
        table = clouds.read_table(rest, np.dtype(types), n_points, data_kind == 'ascii')
        fields = gather({name: v for name, v in scatter(table).items() if name not in padding})
    else:
        raise PointCloudError(f'DATA {data_kind}: must be ascii, binary or {COMPRESSED}')
    viewpoint = ' '.join(entries.get('VIEWPOINT', VIEWPOINT.split()))
    return clouds.cloud_of(fields, PcdHeader(width, height, viewpoint, data_kind == COMPRESSED))


def _decompress(data: bytes, size: int) -> bytes:
    """Return the `size` bytes of a compressed body, which begins with its two sizes."""
    packed_size, said_size = struct.unpack_from('<II', data)
    if said_size != size or size > MAX_SCAN_BYTES or packed_size > len(data) - 8:
        raise PointCloudError(
            f'body of {len(data)} bytes, which says {packed_size} bytes hold {said_size}; '
            f'its header says {size} (at most {MAX_SCAN_BYTES})'
        )
    # LZF knows no empty input.
    return (
        bytes(require('lzf', 'formats').decompress(data[8 : 8 + packed_size], size))
        if size
        else b''
    )


def _split(columns: bytes, dtype: np.dtype[Any], n_points: int) -> Fields:
    """Points of columns that lie one after the other."""
    found, start = {}, 0
    for name in dtype.names or ():
        column = np.frombuffer(columns, np.dtype([(name, dtype[name])]), n_points, start)
        found[name] = column[name]
        start += column.nbytes
    return gather(found)


def encode_pcd(cloud: Cloud) -> bytes:
    """File of a cloud, binary or, where it was read from such a file, compressed."""
    fields = clouds.in_types(cloud.fields, _TYPES, 'PCD')
    header = cloud.header if isinstance(cloud.header, PcdHeader) else PcdHeader(0, 0)
    size = (header.width, header.height)
    width, height = size if header.width * header.height == len(fields) else (len(fields), 1)
    body, kind = fields.tobytes(), 'binary'
    if header.is_compressed and body:
        columns = b''.join(column.tobytes() for column in scatter(fields).values())
        # Nothing comes back where it would not become smaller.
        if packed := require('lzf', 'formats').compress(columns):
            body = struct.pack('<II', len(packed), len(columns)) + packed
            kind = COMPRESSED
    dtypes = [fields.dtype[name] for name in fields.dtype.names or ()]
    entries = {
        'VERSION': ['0.7'],
        'FIELDS': fields.dtype.names or (),
        'SIZE': [dtype.base.itemsize for dtype in dtypes],
        'TYPE': [dtype.base.kind.upper() for dtype in dtypes],
        'COUNT': [int(np.prod(dtype.shape)) for dtype in dtypes],
        'WIDTH': [width],
        'HEIGHT': [height],
        'VIEWPOINT': [header.viewpoint],
        'POINTS': [len(fields)],
        'DATA': [kind],
    }
    lines = ''.join(f'{key} {" ".join(map(str, words))}\n' for key, words in entries.items())
    return f'# .PCD v0.7 - Point Cloud Data file format\n{lines}'.encode() + body
