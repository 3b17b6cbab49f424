"""Byte layout of PointCloud2, against the struct module."""

import array
import struct
from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gp_ground_seg.data.cloud_layout import read_xyz, select_rows
from gp_ground_seg.errors import PointCloudError

FLOAT32, FLOAT64, UINT16 = 7, 8, 4
SIZE = {FLOAT32: 4, FLOAT64: 8}
STRUCT_CODE = {FLOAT32: 'f', FLOAT64: 'd'}
CONTAINERS = (
    bytes,
    bytearray,
    memoryview,
    lambda b: array.array('B', b),
    lambda b: np.array(list(b), np.uint8),
)


@dataclass
class Field:
    name: str
    offset: int
    datatype: int
    count: int = 1


@dataclass
class Layout:
    height: int
    width: int
    fields: list[Field]
    is_bigendian: bool
    point_step: int
    row_step: int
    data: object

    def xyz(self):
        return read_xyz(**vars(self))

    def select(self, mask):
        return select_rows(
            self.height, self.width, self.point_step, self.row_step, self.data, mask
        )


@st.composite
def layouts(draw):
    """Random field order, gaps, row padding, byte order, types and trailing bytes."""
    height = draw(st.integers(0, 4))
    width = draw(st.integers(0, 6))
    fields, offset = [], draw(st.integers(0, 9))
    for name in draw(st.permutations(['x', 'y', 'z', 'intensity'])):
        datatype = draw(st.sampled_from([FLOAT32, FLOAT64]))
        fields.append(Field(name, offset, datatype, draw(st.sampled_from([0, 1]))))
        offset += SIZE[datatype] + draw(st.integers(0, 5))
    row_step = width * offset + draw(st.integers(0, 7))
    trailing = draw(st.integers(0, 5))
    size = height * row_step + trailing
    raw = draw(st.binary(min_size=size, max_size=size))
    container = draw(st.sampled_from(CONTAINERS))
    big = draw(st.booleans())
    return Layout(height, width, fields, big, offset, row_step, container(raw)), raw


def packed_point(layout, raw, row, column):
    start = row * layout.row_step + column * layout.point_step
    return raw[start : start + layout.point_step]


def all_points(layout, raw):
    return [
        packed_point(layout, raw, row, column)
        for row in range(layout.height)
        for column in range(layout.width)
    ]


@settings(max_examples=400, deadline=None)
@given(layouts())
def test_read_xyz_agrees_with_struct(case):
    layout, raw = case
    order = '>' if layout.is_bigendian else '<'
    where = {field.name: field for field in layout.fields}
    expected = [
        [
            struct.unpack_from(order + STRUCT_CODE[where[a].datatype], point, where[a].offset)[0]
            for a in 'xyz'
        ]
        for point in all_points(layout, raw)
    ]
    xyz = layout.xyz()
    assert xyz.dtype.isnative
    assert xyz.shape == (layout.height * layout.width, 3)
    with np.errstate(invalid='ignore'):  # signalling NaN
        xyz = xyz.astype(np.float64)
    np.testing.assert_array_equal(xyz, np.reshape(expected, (-1, 3)))


@settings(max_examples=400, deadline=None)
@given(layouts(), st.randoms(use_true_random=False))
def test_select_rows_keeps_every_byte_of_the_kept_points(case, random):
    layout, raw = case
    points = all_points(layout, raw)
    mask = np.array([random.random() < 0.5 for _ in points], dtype=bool)
    expected = b''.join(point for point, keep in zip(points, mask, strict=True) if keep)
    selected = layout.select(mask)
    assert selected.tobytes() == expected
    # Whatever is not kept is in the complement: nothing is lost or doubled.
    assert len(selected) + len(layout.select(~mask)) == len(points) * layout.point_step


def kitti_layout(n=5, **changes):
    rng = np.random.default_rng(0)
    fields = [Field(name, 4 * k, FLOAT32) for k, name in enumerate(('x', 'y', 'z', 'intensity'))]
    data = rng.normal(size=(n, 4)).astype('<f4').tobytes()
    return Layout(**{**vars(Layout(1, n, fields, False, 16, 16 * n, data)), **changes})


def replaced(name, /, **changes):
    return [
        Field(**{**vars(field), **changes}) if field.name == name else field
        for field in kitti_layout().fields
    ]


def test_result_is_a_float32_copy():
    data = np.frombuffer(kitti_layout().data, np.uint8).copy()
    xyz = kitti_layout(data=data).xyz()
    assert xyz.dtype == np.float32
    before = xyz.copy()
    data[:] = 0
    np.testing.assert_array_equal(xyz, before)


def test_float64_keeps_its_precision():
    value = 1.0 + 1e-12
    fields = [Field(name, 8 * k, FLOAT64) for k, name in enumerate('xyz')]
    xyz = read_xyz(1, 1, fields, False, 24, 24, struct.pack('<3d', value, 2.0, 3.0))
    assert xyz.dtype == np.float64
    assert xyz[0, 0] == value


def test_empty_cloud_needs_no_layout():
    assert read_xyz(0, 0, [], False, 0, 0, b'').shape == (0, 3)
    assert len(select_rows(0, 0, 0, 0, b'', np.zeros(0, dtype=bool))) == 0


def test_row_step_of_a_single_row_is_not_used():
    np.testing.assert_array_equal(kitti_layout(row_step=0).xyz(), kitti_layout().xyz())
    everything = np.ones(5, dtype=bool)
    assert kitti_layout(row_step=0).select(everything).tobytes() == kitti_layout().data


@pytest.mark.parametrize(
    ('changes', 'message'),
    [
        ({'fields': []}, r'no field named x: must have exactly one; fields: none'),
        ({'fields': replaced('z', name='height')}, r'no field named z.*x, y, height, intensity'),
        ({'fields': replaced('intensity', name='y')}, r'2 fields named y: must have exactly one'),
        (
            {'fields': replaced('y', datatype=UINT16)},
            r'field y has datatype 4 \(UINT16\): must be FLOAT32',
        ),
        ({'fields': replaced('y', datatype=77)}, r'field y has datatype 77 \(unknown\)'),
        ({'fields': replaced('x', count=3)}, r'field x has count 3: must be 1'),
        ({'fields': replaced('z', offset=13)}, r'z at offset 13 of 4 bytes.*point_step 16'),
        ({'fields': replaced('z', offset=-4)}, r'z at offset -4'),
        ({'point_step': 0}, r'point_step 0: must be at least 1'),
        ({'width': 6}, r'data of 80 bytes: must be at least 96 \(height 1, width 6'),
        ({'data': b''}, r'data of 0 bytes: must be at least 80'),
        ({'height': 5, 'width': 1, 'row_step': 15}, r'row_step 15: must be at least 16 \(width 1'),
        ({'height': 2, 'row_step': 2**32 - 1}, r'data of 80 bytes: must be at least'),
    ],
)
def test_malformed_layout_says_what_and_where(changes, message):
    with pytest.raises(PointCloudError, match=message):
        kitti_layout(**changes).xyz()


def test_select_refuses_what_it_cannot_read():
    keep = np.ones(5, dtype=bool)
    with pytest.raises(PointCloudError, match=r'data of 70 bytes: must be at least 80'):
        kitti_layout(data=bytes(70)).select(keep)
    with pytest.raises(
        PointCloudError, match=r'mask of shape \(4,\).*must be bool of shape \(5,\)'
    ):
        kitti_layout().select(keep[:4])
    with pytest.raises(PointCloudError, match=r'type uint8'):
        kitti_layout().select(keep.astype(np.uint8))
