"""PCD files of the Point Cloud Library: text, binary and compressed are read, binary written.

Why not pypcd4 1.5: it mixes up the numbers of a field of several in compressed files, returns
fewer points than the header says from a file that is cut off, misreads padding, refuses headers
without COUNT, and allocates whatever size a header names. Compressed files need the codec lzf.

Source: https://pointclouds.org/documentation/tutorials/pcd_file_format.html, pcl/io/pcd_io.cpp.
"""

from __future__ import annotations

import re
import struct
from typing import Any, NamedTuple

import numpy as np

from gp_ground_seg.core.errors import PointCloudError, require
from gp_ground_seg.data.clouds import Cloud, Fields, gather, in_types, read_table

_END = re.compile(rb'^DATA[ \t]+(\w+)[ \t]*\r?\n', re.MULTILINE)
_MAX_HEADER_BYTES = 1 << 16
_MAX_EXPANSION = 88  # of LZF: three bytes repeat 264 at most
_TYPES = {f'{kind}{n}' for kind in 'iu' for n in (1, 2, 4, 8)} | {'f4', 'f8'}


class PcdHeader(NamedTuple):
    """Entries of a header that are kept beside the points."""

    width: int = 0
    height: int = 1
    viewpoint: str = '0 0 0 1 0 0 0'


def read_pcd(data: bytes) -> tuple[Fields, PcdHeader]:
    """Read a file; PointCloudError if it cannot be one."""
    end = _END.search(data[:_MAX_HEADER_BYTES])
    if end is None:
        raise PointCloudError('no DATA line of a PCD header in it')
    lines = data[: end.start()].decode('ascii', 'replace').splitlines()
    entries = {words[0]: words[1:] for words in map(str.split, lines) if words}
    for key in ('FIELDS', 'SIZE', 'TYPE', 'WIDTH'):
        if key not in entries:
            raise PointCloudError(f'no {key} line in its header')
    width, height = int(entries['WIDTH'][0]), int(entries.get('HEIGHT', '1')[0])
    n_points = int(entries.get('POINTS', [str(width * height)])[0])
    if min(width, height) < 0 or n_points != width * height:
        raise PointCloudError(f'{n_points} points, which is not width {width} * height {height}')
    types: list[tuple[str, str, Any]] = []
    names = entries['FIELDS']
    counts = map(int, entries.get('COUNT', ['1'] * len(names)))
    for name, kind, size, count in zip(
        names, entries['TYPE'], entries['SIZE'], counts, strict=True
    ):
        if (code := f'{kind.lower()}{size}') not in _TYPES:
            raise PointCloudError(f'field {name}: no type {kind} of {size} bytes')
        unique = f'_ {len(types)}' if name == '_' else name
        types.append((unique, f'<{code}', () if count == 1 else (count,)))
    kept = [entry for entry in types if not entry[0].startswith('_ ')]
    form, rest = end[1], data[end.end() :]
    if form == b'binary_compressed':
        fields = _read_compressed(rest, np.dtype(kept), n_points)
    elif form in (b'ascii', b'binary'):
        table = read_table(rest, np.dtype(types), n_points, form == b'ascii')
        fields = gather({name: table[name] for name, *_ in kept})
    else:
        raise PointCloudError(f'DATA {form.decode()}: must be ascii, binary or binary_compressed')
    viewpoint = ' '.join(entries.get('VIEWPOINT', PcdHeader().viewpoint.split()))
    return fields, PcdHeader(width, height, viewpoint)


def _read_compressed(data: bytes, dtype: np.dtype[Any], n_points: int) -> Fields:
    """Read a body: its size, that unpacked, and field after field without padding."""
    packed, size = struct.unpack_from('<II', data)
    needed = n_points * dtype.itemsize
    if size != needed:
        raise PointCloudError(f'body of {size} bytes, its header says {needed}')
    body = data[8 : 8 + packed]
    if size > _MAX_EXPANSION * len(body):
        raise PointCloudError(f'{len(body)} packed bytes cannot hold the {size} of its header')
    # LZF knows no empty text.
    body = require('lzf', 'python-neo-lzf').decompress(body, size) if size else b''
    columns, start = {}, 0
    for name in dtype.names or ():
        column = np.frombuffer(body, np.dtype([(name, dtype[name])]), n_points, start)
        columns[name] = column[name]
        start += column.nbytes
    return gather(columns)


def encode_pcd(cloud: Cloud) -> bytes:
    """Binary file of a cloud, organised and with the viewpoint as it was read."""
    fields = in_types(cloud.fields, _TYPES, 'PCD')
    header = cloud.header if isinstance(cloud.header, PcdHeader) else PcdHeader()
    if header.width * header.height != len(fields):
        header = header._replace(width=len(fields), height=1)
    dtypes = [fields.dtype[name] for name in fields.dtype.names or ()]
    entries = {
        'VERSION': ['0.7'],
        'FIELDS': fields.dtype.names or (),
        'SIZE': [dtype.base.itemsize for dtype in dtypes],
        'TYPE': [dtype.base.kind.upper() for dtype in dtypes],
        'COUNT': [int(np.prod(dtype.shape)) for dtype in dtypes],
        'WIDTH': [header.width],
        'HEIGHT': [header.height],
        'VIEWPOINT': [header.viewpoint],
        'POINTS': [len(fields)],
        'DATA': ['binary'],
    }
    lines = ''.join(f'{key} {" ".join(map(str, words))}\n' for key, words in entries.items())
    return lines.encode() + fields.tobytes()
