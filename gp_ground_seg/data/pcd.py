"""PCD files of the Point Cloud Library: text, binary and compressed are read, binary written.

Why not pypcd4 1.5: it reads a third of what is read here of test/foreign_files.py, mixes up the
numbers of a field of several in compressed files, and needs pydantic. Compressed files need the
codec lzf.

Source: https://pointclouds.org/documentation/tutorials/pcd_file_format.html, pcl/io/pcd_io.cpp.
"""

import math
import struct
from typing import Any, NamedTuple

import numpy as np

from gp_ground_seg.core.errors import PointCloudError, require
from gp_ground_seg.data import clouds

_MAX_EXPANSION = 88  # of LZF: three bytes repeat 264 at most
_MAX_NUMBER = 1 << 32  # in a header
_PADDING = ' '  # no name of a header has a space
_SHAPE = ('WIDTH', 'HEIGHT', 'POINTS')
_TYPES = {f'{kind}{n}' for kind in 'iu' for n in (1, 2, 4, 8)} | {'f4', 'f8'}


class PcdHeader(NamedTuple):
    """Entries of a header that are written again."""

    width: int = 0
    height: int = 1
    viewpoint: str = '0 0 0 1 0 0 0'


def read_pcd(data: bytes) -> tuple[clouds.Fields, PcdHeader]:
    """Read a file; PointCloudError if it cannot be one.

    Keys are read in capitals or not, COLUMNS as FIELDS, and what is not given is as PCL takes it:
    float32 of one number, and one row.
    """
    lines, rest = clouds.split_header(data, 'DATA')
    entries = {words[0].upper(): words[1:] for words in map(str.split, lines)}
    names = entries.get('FIELDS') or entries.get('COLUMNS')
    if not names:
        raise PointCloudError('no FIELDS line in its header')
    width, height = _shape_of(entries)
    types = _types_of(names, entries)
    form = ' '.join(entries.get('DATA', ())).lower()
    if form == 'binary_compressed':
        packed = np.dtype([entry for entry in types if _PADDING not in entry[0]])
        fields = _read_compressed(rest, packed, width * height)
    elif form == 'ascii':
        fields = clouds.read_lines(rest, np.dtype(types), width * height)
    elif form == 'binary':
        fields = clouds.read_table(rest, np.dtype(types), width * height)
    else:
        raise PointCloudError(f'DATA {form}: must be ascii, binary or binary_compressed')
    kept = [name for name in fields.dtype.names or () if _PADDING not in name]
    viewpoint = ' '.join(entries.get('VIEWPOINT', PcdHeader().viewpoint.split()))
    header = PcdHeader(width, height, viewpoint)
    return clouds.gather({name: fields[name] for name in kept}), header


def _shape_of(entries: dict[str, list[str]]) -> tuple[int, int]:
    """Width and height of a header; PointCloudError if they contradict its number of points."""
    given = {key: _number(key, ' '.join(entries[key])) for key in _SHAPE if key in entries}
    if not {'WIDTH', 'POINTS'} & given.keys():
        raise PointCloudError('no WIDTH or POINTS line in its header')
    width, height = given.get('WIDTH', 0), given.get('HEIGHT', 1)
    n_points = given.get('POINTS', width * height)
    if width * height == 0:  # some writers leave it to POINTS
        return n_points, 1
    if n_points != width * height:
        raise PointCloudError(f'{n_points} points, which is not width {width} * height {height}')
    return width, height


def _number(key: str, word: str) -> int:
    """Whole number of a header; PointCloudError if it is none, or larger than `_MAX_NUMBER`."""
    if not (word.isdecimal() and len(word) < 12 and int(word) <= _MAX_NUMBER):
        raise PointCloudError(f'{key} {word}: must be a whole number, at most {_MAX_NUMBER}')
    return int(word)


def _types_of(names: list[str], entries: dict[str, list[str]]) -> list[tuple[str, str, Any]]:
    """Name, type and shape of each field; `_PADDING` is in the name of what is left out."""
    types: list[tuple[str, str, Any]] = []
    defaults = {'TYPE': 'F', 'SIZE': '4', 'COUNT': '1'}
    columns = [entries.get(key, [word] * len(names)) for key, word in defaults.items()]
    if {*map(len, columns)} != {len(names)}:
        pairs = zip(defaults, columns, strict=True)
        counts = ', '.join(f'{len(column)} {key}' for key, column in pairs)
        raise PointCloudError(f'{len(names)} FIELDS, but {counts}; spaces in a name?')
    rows = zip(names, clouds.distinct(names), *columns, strict=True)
    for given, name, kind, size, count in rows:
        code, shape = f'{kind.lower()}{size}', () if count == '1' else (_number('COUNT', count),)
        if code not in _TYPES:
            raise PointCloudError(f'field {name}: no type {kind} of {size} bytes')
        types.append((f'{_PADDING}{name}' if given == '_' else name, f'<{code}', shape))
    # numpy adds their bytes in 32 bits, and would read outside of the file.
    clouds.check_numbers(sum(math.prod(shape) for _, _, shape in types))
    return types


def _read_compressed(data: bytes, dtype: np.dtype[Any], n_points: int) -> clouds.Fields:
    """Read a body: its size, that unpacked, and field after field without padding."""
    packed, size = struct.unpack('<II', data[:8].ljust(8, b'\0'))
    needed = n_points * dtype.itemsize
    if size != needed:
        raise PointCloudError(f'body of {size} bytes, its header says {needed}')
    body, unpacked = data[8 : 8 + packed], b''
    if 0 < size <= _MAX_EXPANSION * len(body):
        unpacked = require('lzf', 'python-neo-lzf').decompress(body, size) or b''
    if len(unpacked) < size:
        problem = f'{len(body)} packed bytes cannot hold the {size} of its header; truncated?'
        raise PointCloudError(problem)
    fields, start = np.empty(n_points, dtype), 0
    for name in dtype.names or ():
        column = np.frombuffer(unpacked, np.dtype([(name, dtype[name])]), n_points, start)
        fields[name] = column[name]
        start += column.nbytes
    return fields


def encode_pcd(cloud: clouds.Cloud) -> bytes:
    """Binary file of a cloud, organised and with the viewpoint as it was read."""
    fields = clouds.in_types(cloud.fields, _TYPES, 'PCD')
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
