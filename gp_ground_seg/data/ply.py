"""PLY files, text and binary of either byte order: their vertices, read and written.

Why not plyfile 1.1: its licence is the GPL, this package has Apache's; it needs numpy 2, and reads
text number by number, which is slow.

Source: http://paulbourke.net/dataformats/ply/.
"""

import re
from typing import Any

import numpy as np

from gp_ground_seg.core.errors import PointCloudError
from gp_ground_seg.data import clouds
from gp_ground_seg.data.clouds import Cloud, Fields

_CODES = {
    'char': 'i1', 'uchar': 'u1', 'short': 'i2', 'ushort': 'u2', 'int': 'i4', 'uint': 'u4',
    'float': 'f4', 'double': 'f8',
}  # fmt: skip
_NAMES = {code: name for name, code in _CODES.items()}
# int8, ..., of newer writers.
_READABLE = {**_CODES, **{np.dtype(code).name: code for code in (*_NAMES, 'i8', 'u8')}}
_ORDERS = {'ascii': '<', 'binary_little_endian': '<', 'binary_big_endian': '>'}


def read_ply(data: bytes) -> tuple[Fields, list[str]]:
    """Read the vertices of a file, and its comments.

    PointCloudError if it cannot be a PLY, if the vertices are not its first element, or if they
    have lists.
    """
    lines, body = clouds.split_header(data, 'end_header')
    remarks = [line for line in lines if line.split()[0] in ('comment', 'obj_info')]
    entries = [line.split() for line in lines if line not in remarks]
    form = ' '.join(next((words[1:2] for words in entries if words[0] == 'format'), [])).lower()
    starts = [k for k, words in enumerate(entries) if words[0] == 'element']
    elements = ', '.join(' '.join(entries[k][1:]) for k in starts)
    vertices = re.match(r'vertex (\d+)(, |$)', elements, re.ASCII)
    if lines[0].lower() != 'ply' or form not in _ORDERS or vertices is None:
        raise PointCloudError(
            'no PLY with a number of vertices as its first element: '
            f'format {form}, elements {elements or "none"}'
        )
    begin, end = [*starts, len(entries)][:2]
    properties = [words for words in entries[begin:end] if words[0] == 'property']
    read = clouds.read_lines if form == 'ascii' else clouds.read_table
    fields = read(body, _type_of(properties, _ORDERS[form]), int(vertices[1]))
    return fields.astype(fields.dtype.newbyteorder('=')), remarks


def _type_of(properties: list[list[str]], order: str) -> np.dtype[Any]:
    """Type of a vertex in a byte order, of the lines of its properties."""
    names, codes = [], []
    for line in properties:
        code = _READABLE.get(line[1].lower()) if len(line) == 3 else None
        if code is None:
            problem = 'cannot be read: a vertex has numbers only, no lists'
            raise PointCloudError(f'line {" ".join(line)!r} of its header {problem}')
        names.append(line[2])
        codes.append(f'{order}{code}')
    return np.dtype(list(zip(clouds.distinct(names), codes, strict=True)))


def encode_ply(cloud: Cloud) -> bytes:
    """File of a cloud as vertices, binary, with the comments it was read with."""
    fields = clouds.in_types(cloud.fields, _NAMES, 'PLY', flat=True)
    lines = [
        'ply',
        'format binary_little_endian 1.0',
        *(cloud.header if isinstance(cloud.header, list) else ()),
        f'element vertex {len(fields)}',
    ]
    for name in fields.dtype.names or ():
        lines.append(f'property {_NAMES[fields.dtype[name].str[1:]]} {name}')
    return '\n'.join([*lines, 'end_header', '']).encode() + fields.tobytes()
