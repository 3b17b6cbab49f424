"""Columns behind the points of any layout, against the struct module."""

import struct
from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gp_ground_seg.data.cloud_columns import append_columns, read_columns
from gp_ground_seg.errors import PointCloudError

CODES = {1: 'b', 2: 'B', 3: 'h', 4: 'H', 5: 'i', 6: 'I', 7: 'f', 8: 'd'}
TYPES = {1: 'i1', 2: 'u1', 3: 'i2', 4: 'u2', 5: 'i4', 6: 'u4', 7: 'f4', 8: 'f8'}


@dataclass(frozen=True)
class Field:
    name: str
    offset: int
    datatype: int
    count: int = 1


@st.composite
def cases(draw):
    height, width = draw(st.integers(0, 3)), draw(st.integers(0, 4))
    step = draw(st.integers(1, 21))
    row_step = width * step + draw(st.integers(0, 7))
    size = height * row_step
    data = draw(st.binary(min_size=size, max_size=size + 3))
    columns, datatypes = {}, draw(st.lists(st.sampled_from(sorted(CODES)), max_size=4))
    for k, datatype in enumerate(datatypes):
        raw = draw(st.binary(min_size=8 * height * width, max_size=8 * height * width))
        columns[f'c{k}'] = np.frombuffer(raw, TYPES[datatype], count=height * width)
    return height, width, draw(st.booleans()), step, row_step, data, columns


@given(cases())
def test_points_stay_and_columns_follow(case):
    height, width, is_bigendian, step, row_step, data, columns = case
    wide = append_columns(*case)
    assert [column.name for column in wide.columns] == list(columns)
    assert wide.point_step % 4 == 0
    assert len(wide.data) == height * width * wide.point_step
    raw = bytes(wide.data)
    ends = [step]
    for column in wide.columns:
        size = struct.calcsize(CODES[column.datatype])
        assert column.offset >= ends[-1]
        assert column.offset % size == 0
        ends.append(column.offset + size)
    assert ends[-1] <= wide.point_step < ends[-1] + 12
    for k in range(height * width):
        row, place = divmod(k, width)
        old = data[row * row_step + place * step :][:step]
        new = raw[k * wide.point_step :][: wide.point_step]
        assert new[:step] == old
        for column in wide.columns:
            code = CODES[column.datatype]
            (value,) = struct.unpack_from(
                ('>' if is_bigendian else '<') + code, new, column.offset
            )
            np.testing.assert_equal(
                np.array(value, TYPES[column.datatype]), columns[column.name][k]
            )

    names = list(columns)
    found = read_columns(
        height,
        width,
        [Field(*column) for column in wide.columns],
        is_bigendian,
        wide.point_step,
        width * wide.point_step,
        raw,
        names,
    )
    for name in names:
        assert found[name].dtype == columns[name].dtype
        np.testing.assert_array_equal(found[name], columns[name].reshape(height, width))


def test_short_data_is_refused():
    with pytest.raises(PointCloudError, match='data of 11 bytes: must be at least 12'):
        append_columns(1, 3, False, 4, 12, bytes(11), {'a': np.zeros(3, np.uint8)})


@pytest.mark.parametrize(
    'fields',
    [
        [],
        [Field('a', 0, 7), Field('a', 4, 7)],
        [Field('a', 0, 7, 2)],
        [Field('a', 6, 7)],
        [Field('a', 0, 9)],
    ],
)
def test_a_field_that_is_no_single_number_is_refused(fields):
    with pytest.raises(PointCloudError, match='exactly one field a'):
        read_columns(1, 1, fields, False, 8, 8, bytes(8), ['a'])
