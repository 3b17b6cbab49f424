"""PLY files, text and binary of either byte order: their vertices, read and written.

Why not plyfile 1.1: its licence is the GPL, this package has Apache's; it needs numpy 2, and reads
text number by number, which is slow.

Source: http://paulbourke.net/dataformats/ply/.
"""

from __future__ import annotations

import logging
import re
from typing import Any

import numpy as np

from gp_ground_seg.core.errors import PointCloudError, log_once
from gp_ground_seg.data import clouds
from gp_ground_seg.data.clouds import Cloud, Fields

_CODES = {
    'char': 'i1', 'uchar': 'u1', 'short': 'i2', 'ushort': 'u2', 'int': 'i4', 'uint': 'u4',
    'float': 'f4', 'double': 'f8',
}  # fmt: skip
_NAMES = {code: name for name, code in _CODES.items()}
# int8, ..., of newer writers.
_READABLE = {**_CODES, **{np.dtype(code).name: code for code in (*_NAMES, 'i8', 'u8')}}
_BIG = 'binary_big_endian'
_FORMS = 'ascii', 'binary_little_endian', _BIG
_ListSizes = list[tuple[int, int]]
"""Bytes of the count, and of an item, of each list of a vertex."""


def read_ply(data: bytes) -> tuple[Fields, list[str]]:
    """Read the vertices of a file, without their lists, and its comments.

    PointCloudError if it cannot be a PLY, if the vertices are not its first element, or if a list
    is before one of their numbers.
    """
    lines, body = clouds.split_header(data, 'end_header')
    remarks = [line for line in lines if line.split()[0] in ('comment', 'obj_info')]
    entries = [line.split() for line in lines if line not in remarks]
    form = ' '.join(next((words[1:2] for words in entries if words[0] == 'format'), [])).lower()
    starts = [k for k, words in enumerate(entries) if words[0] == 'element']
    elements = ', '.join(' '.join(entries[k][1:]) for k in starts)
    vertices = re.match(r'vertex (\d+)(, |$)', elements, re.ASCII)
    if lines[0].lower() != 'ply' or form not in _FORMS or vertices is None:
        raise PointCloudError(
            'no PLY with a number of vertices as its first element: '
            f'format {form}, elements {elements or "none"}'
        )
    n_points, is_big = int(vertices[1]), form == _BIG
    begin, end = [*starts, len(entries)][:2]
    properties = [words for words in entries[begin:end] if words[0] == 'property']
    dtype, lists = _types_of(properties, is_big)
    if form == 'ascii':
        fields = clouds.read_lines(body, dtype, n_points)
    else:
        if lists:
            body = _without_lists(body, dtype.itemsize, lists, is_big, n_points)
        fields = clouds.read_table(body, dtype, n_points)
    return fields.astype(fields.dtype.newbyteorder('=')), remarks


def _types_of(properties: list[list[str]], is_big: bool) -> tuple[np.dtype[Any], _ListSizes]:
    """Type of the numbers of a vertex, and its lists, of the lines of its properties."""
    names, codes = [], []
    lists: dict[str, tuple[int, int]] = {}
    for line in properties:
        found = [_READABLE.get(word.lower(), '') for word in line[1:-1] if word != 'list']
        is_list = line[1:2] == ['list']
        if len(found) != 1 + is_list or not all(found):
            raise PointCloudError(f'line {" ".join(line)!r} of its header cannot be read')
        if is_list:
            count, item = (int(code[1:]) for code in found)
            lists[line[-1]] = count, item
        elif lists:
            raise PointCloudError(f'property {line[-1]} is behind a list: must be before it')
        else:
            names.append(line[-1])
            codes.append(f'{">" if is_big else "<"}{found[0]}')
    if lists:
        log_once(logging.INFO, f'PLY: lists of the vertices are left out: {", ".join(lists)}')
    dtype = np.dtype(list(zip(clouds.distinct(names), codes, strict=True)))
    return dtype, list(lists.values())


def _without_lists(
    data: bytes, n_bytes: int, lists: _ListSizes, is_big: bool, n_points: int
) -> bytes:
    """Rows of a body, each cut to its first `n_bytes`."""
    clouds.check_size(len(data), n_points, n_points * (n_bytes + sum(count for count, _ in lists)))
    rows, place = [], 0
    for _ in range(n_points):
        rows.append(data[place : place + n_bytes])
        place += n_bytes
        for count, item in lists:
            n_items = int.from_bytes(data[place : place + count], 'big' if is_big else 'little')
            place += count + item * n_items
    clouds.check_size(len(data), n_points, place)
    return b''.join(rows)


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
