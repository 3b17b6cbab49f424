"""PLY files, text and binary of either byte order: their vertices, read and written.

Why not plyfile 1.1: its licence is the GPL, this package has Apache's; it needs numpy 2, and reads
text number by number, which is slow.

Source: http://paulbourke.net/dataformats/ply/.
"""

import logging
import re
from typing import Any, Literal

import numpy as np

from gp_ground_seg.core.errors import PointCloudError, log_once
from gp_ground_seg.data import clouds

_CODES = {
    'char': 'i1', 'uchar': 'u1', 'short': 'i2', 'ushort': 'u2', 'int': 'i4', 'uint': 'u4',
    'float': 'f4', 'double': 'f8',
}  # fmt: skip
_NAMES = {code: name for name, code in _CODES.items()}
# int8, ..., of newer writers.
_READABLE = {**_CODES, **{np.dtype(code).name: code for code in (*_NAMES, 'i8', 'u8')}}
_Order = Literal['little', 'big']
_ORDERS: dict[str, _Order] = {
    'ascii': 'little', 'binary_little_endian': 'little', 'binary_big_endian': 'big',
}  # fmt: skip
_Lists = list[tuple[int, int]]  # bytes of the count, and of an item, of each list of a vertex


def read_ply(data: bytes) -> tuple[clouds.Fields, list[str]]:
    """Read the vertices of a file, without lists behind their numbers, and its comments.

    PointCloudError if it cannot be a PLY, or if the vertices are not its first element.
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
    (dtype, lists), order, n_points = _types_of(properties), _ORDERS[form], int(vertices[1])
    if form == 'ascii':
        return clouds.read_lines(body, dtype, n_points), remarks
    if lists:
        body = _without_lists(body, dtype.itemsize, lists, order, n_points)
    return clouds.read_table(body, dtype.newbyteorder(order), n_points).astype(dtype), remarks


def _types_of(properties: list[list[str]]) -> tuple[np.dtype[Any], _Lists]:
    """Type of the numbers of a vertex, and its lists, of the lines of its properties."""
    names, codes, lists = [], [], _Lists()
    for line in properties:
        is_list = line[1:2] == ['list']
        found = [_READABLE.get(word.lower(), '') for word in line[1 + is_list : -1]]
        if len(found) != 1 + is_list or not all(found) or (lists and not is_list):
            problem = 'cannot be read: a vertex has numbers, and behind them lists'
            raise PointCloudError(f'line {" ".join(line)!r} of its header {problem}')
        if is_list:
            lists.append((int(found[0][1:]), int(found[1][1:])))
            log_once(logging.INFO, f'PLY: lists of the vertices are left out: {line[-1]}')
        else:
            names.append(line[2])
            codes.append(found[0])
    return np.dtype(list(zip(clouds.distinct(names), codes, strict=True))), lists


def _without_lists(
    data: bytes, n_bytes: int, lists: _Lists, order: _Order, n_points: int
) -> bytes:
    """Rows of a body, each cut to its first `n_bytes`; only those that are there as a whole."""
    rows, place = list[bytes](), 0
    while len(rows) < n_points:
        begin, place = place, place + n_bytes
        for count, item in lists:
            place += count + item * int.from_bytes(data[place : place + count], order)
        if place > len(data):
            break
        rows.append(data[begin : begin + n_bytes])
    return b''.join(rows)


def encode_ply(cloud: clouds.Cloud) -> bytes:
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
