"""PLY files, text and binary of either byte order: their vertices, read and written.

Why not plyfile 1.1: its licence is the GPL, this package has Apache's; it needs numpy 2, and reads
text and lists number by number: 0.5 s for 120,000 points of a text, which take 0.03 s here.

Source: http://paulbourke.net/dataformats/ply/.
"""

from __future__ import annotations

from typing import Any, Literal, NamedTuple

import numpy as np

from gp_ground_seg.core.errors import PointCloudError
from gp_ground_seg.data.clouds import (
    Cloud,
    Fields,
    check_size,
    distinct,
    gather,
    in_types,
    lines_of,
    note,
    read_lines,
    scatter,
    split_header,
)

_CODES = {
    'char': 'i1', 'uchar': 'u1', 'short': 'i2', 'ushort': 'u2', 'int': 'i4', 'uint': 'u4',
    'float': 'f4', 'double': 'f8',
}  # fmt: skip
_NAMES = {code: name for name, code in _CODES.items()}
_LONG_NAMES = {'i8': 'int64', 'u8': 'uint64'}
# int8, ..., of newer writers.
_READABLE = {
    **_CODES,
    'bool': 'u1',
    **{np.dtype(code).name: code for code in (*_NAMES, *_LONG_NAMES, 'f2')},
}
_ORDERS = {'ascii': '<', 'binary_little_endian': '<', 'binary_big_endian': '>'}


class PlyHeader(NamedTuple):
    """Comments of a header, and whether it has integers of 8 bytes, which few programs read."""

    remarks: tuple[str, ...] = ()
    has_long: bool = False


class _Element(NamedTuple):
    """Rows of one kind; `properties` are the words of their lines."""

    name: str
    n_rows: int
    properties: list[list[str]]

    def runs(self, order: str) -> list[tuple[np.dtype[Any], int, int]]:
        """Fields up to each list and behind the last, bytes of its count and of an item."""
        runs: list[tuple[np.dtype[Any], int, int]] = []
        fields: list[tuple[str, str]] = []
        names = iter(distinct([words[-1] for words in self.properties]))
        for kind, *words in self.properties:
            name, codes = next(names), [_READABLE.get(w.lower()) for w in (kind, *words[:-1])]
            if codes[0]:
                fields.append((name, f'{order}{codes[0]}'))
            elif kind != 'list' or None in codes[1:]:
                raise PointCloudError(f'property {name} of {self.name}: is a {kind}')
            else:
                count, item = (int(code[1:]) for code in codes[1:] if code)
                runs.append((np.dtype(fields), count, item))
                fields = []
        return [*runs, (np.dtype(fields), 0, 0)]


def read_ply(data: bytes) -> tuple[Fields, PlyHeader]:
    """Read the vertices of a file, without lists; PointCloudError if it cannot be one."""
    lines, body = split_header(data, 'end_header')
    form, remarks = '', []
    elements: list[_Element] = []
    for line in lines:
        key, *words = line.split()
        if key in ('comment', 'obj_info'):
            remarks.append(line)
        elif key == 'format' and words:
            form = words[0].lower()
        elif key == 'element' and len(words) > 1 and words[1].isdecimal():
            elements.append(_Element(words[0].lower(), int(words[1]), []))
        elif key == 'property' and len(words) > 1 and elements:
            elements[-1].properties.append(words)
        elif key in ('format', 'element', 'property'):
            raise PointCloudError(f'line {line!r} of its header cannot be read')
    names = [element.name for element in elements]
    if lines[0].strip().lower() != 'ply' or form not in _ORDERS or 'vertex' not in names:
        found = ', '.join(names) or 'none'
        raise PointCloudError(f'no vertices of a PLY in it: format {form}, elements {found}')
    before, vertex = elements[: names.index('vertex')], elements[names.index('vertex')]
    left_out = [words[-1] for words in vertex.properties if words[0] == 'list']
    if wrong := {'x', 'y', 'z'} & {*left_out}:
        raise PointCloudError(f'property {min(wrong)} of the vertices: is a list')
    if left_out:
        note(f'PLY: lists of the vertices are left out: {", ".join(left_out)}')
    for words in vertex.properties if form == 'ascii' else []:
        if words[0] != 'list' and words[0].lower() not in _READABLE:
            words[0] = 'double'  # a text needs no size
    read = _read_text if form == 'ascii' else _read_binary
    fields = read(body, before, vertex, _ORDERS[form])
    has_long = any(words[0] in _LONG_NAMES.values() for words in vertex.properties)
    return fields.astype(fields.dtype.newbyteorder('=')), PlyHeader(tuple(remarks), has_long)


def _read_text(data: bytes, before: list[_Element], vertex: _Element, order: str) -> Fields:
    lines = lines_of(data)
    start = sum(element.n_rows for element in before)
    lines = lines[start : start + vertex.n_rows]
    runs = vertex.runs(order)
    if len(runs) > 1:
        is_list = [words[0] == 'list' for words in vertex.properties]
        lines = [_without_lists(line.split(), is_list) for line in lines]
    types = [(name, run[name]) for run, *_ in runs for name in run.names or ()]
    return read_lines(lines, np.dtype(types), vertex.n_rows)


def _without_lists(words: list[bytes], is_list: list[bool]) -> bytes:
    """Words of a row that are no part of a list."""
    kept, place = [], 0
    try:
        for skipped in is_list:
            if skipped:
                place += int(words[place])
            else:
                kept.append(words[place])
            place += 1
    except IndexError:
        raise PointCloudError(f'a row of {len(words)} numbers, has lists; truncated?') from None
    return b' '.join(kept)


def _read_binary(data: bytes, before: list[_Element], vertex: _Element, order: str) -> Fields:
    place = 0
    parts: list[Fields] = []
    for element in (*before, vertex):
        parts, place = _read_rows(data, place, element, order)
    columns = {name: values for part in parts for name, values in scatter(part).items()}
    return parts[0] if len(parts) == 1 else gather(columns)


def _read_rows(data: bytes, place: int, element: _Element, order: str) -> tuple[list[Fields], int]:
    """Read the runs of the rows that begin at `place`, and where they end."""
    runs = element.runs(order)
    least = element.n_rows * sum(run.itemsize + count for run, count, _ in runs)
    check_size(len(data) - place, element.n_rows, least)
    if len(runs) == 1:
        return [np.ndarray(element.n_rows, runs[0][0], data, place)], place + least
    parts = [bytearray() for _ in runs]
    sizes = [(run.itemsize, count, item) for run, count, item in runs]
    byte_order: Literal['little', 'big'] = 'little' if order == '<' else 'big'
    for _ in range(element.n_rows):
        for part, (size, count, item) in zip(parts, sizes, strict=True):
            part += data[place : place + size]
            place += size + count
            place += item * int.from_bytes(data[place - count : place], byte_order)
    check_size(len(data), element.n_rows, place)
    rows = [np.ndarray(element.n_rows, runs[k][0], part) for k, part in enumerate(parts)]
    return rows, place


def encode_ply(cloud: Cloud) -> bytes:
    """File of a cloud as vertices, binary, with the comments it was read with."""
    header = cloud.header if isinstance(cloud.header, PlyHeader) else PlyHeader()
    names = {**_NAMES, **_LONG_NAMES} if header.has_long else _NAMES
    fields = in_types(cloud.fields, names, 'PLY', flat=True)
    lines = [
        'ply',
        'format binary_little_endian 1.0',
        *header.remarks,
        f'element vertex {len(fields)}',
    ]
    for name in fields.dtype.names or ():
        lines.append(f'property {names[fields.dtype[name].str[1:]]} {name}')
    return '\n'.join([*lines, 'end_header', '']).encode() + fields.tobytes()
