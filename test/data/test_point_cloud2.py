"""Byte layout of PointCloud2 against the struct module; messages against ROS itself."""

import array
import dataclasses
import itertools
import struct

import bag_samples as samples
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gp_ground_seg.core.errors import PointCloudError
from gp_ground_seg.data import point_cloud2
from gp_ground_seg.data.bags import cloud_from_points, encode_cloud, jazzy_types, with_stamp
from gp_ground_seg.data.point_cloud2 import read_columns, read_fields, read_xyz, stamp_of

FLOAT32, FLOAT64 = 7, 8
STRUCT_CODES = dict(enumerate('bBhHiIfd', 1))
TYPES = dict(enumerate(['i1', 'u1', 'i2', 'u2', 'i4', 'u4', 'f4', 'f8'], 1))
CONTAINERS = [bytes, bytearray, memoryview, lambda b: array.array('B', b)]
CONTAINERS += [lambda b: np.array(list(b), np.uint8)]


Field = jazzy_types().types['sensor_msgs/msg/PointField']


def cloud_of(height, width, fields, is_bigendian, point_step, row_step, data):
    empty = cloud_from_points(np.empty((0, 4)), 0, 'lidar')
    return dataclasses.replace(
        empty, height=height, width=width, fields=fields, is_bigendian=is_bigendian,
        point_step=point_step, row_step=row_step, data=data,
    )  # fmt: skip


@st.composite
def layouts(draw):
    """Random field order, gaps, row padding, byte order, types and trailing bytes."""
    height = draw(st.integers(0, 4))
    width = draw(st.integers(0, 6))
    fields, offset = [], draw(st.integers(0, 9))
    for name in draw(st.permutations(['x', 'y', 'z', 'intensity'])):
        datatype = draw(st.sampled_from([FLOAT32, FLOAT64]))
        fields.append(Field(name, offset, datatype, draw(st.sampled_from([0, 1]))))
        offset += struct.calcsize(STRUCT_CODES[datatype]) + draw(st.integers(0, 5))
    row_step = width * offset + draw(st.integers(0, 7))
    trailing = draw(st.integers(0, 5))
    size = height * row_step + trailing
    raw = draw(st.binary(min_size=size, max_size=size))
    container = draw(st.sampled_from(CONTAINERS))
    big = draw(st.booleans())
    return cloud_of(height, width, fields, big, offset, row_step, container(raw)), raw


def all_points(layout, raw):
    step = layout.point_step
    return [
        raw[row * layout.row_step + column * step :][:step]
        for row in range(layout.height)
        for column in range(layout.width)
    ]


@settings(max_examples=100)
@given(layouts(), st.randoms(use_true_random=False))
def test_coordinates_and_selections_agree_with_struct(case, random):
    layout, raw = case
    points = all_points(layout, raw)
    order = '>' if layout.is_bigendian else '<'
    axes = [field for name in 'xyz' for field in layout.fields if field.name == name]
    expected = [
        struct.unpack_from(order + STRUCT_CODES[axis.datatype], point, axis.offset)[0]
        for point in points
        for axis in axes
    ]
    xyz = read_xyz(layout)
    assert xyz.dtype.isnative
    assert xyz.shape == (layout.height * layout.width, 3)
    with np.errstate(invalid='ignore'):  # signalling NaN
        xyz = xyz.astype(np.float64)
    np.testing.assert_array_equal(xyz, np.reshape(expected, (-1, 3)))
    mask = np.array([random.random() < 0.5 for _ in points], dtype=bool)
    for chosen in (mask, ~mask):
        selected = point_cloud2.select_points(layout, chosen, bytearray, are_finite=True)
        assert selected.data == b''.join(itertools.compress(points, chosen))
        assert (selected.height, selected.width) == (1, chosen.sum())


@given(layouts(), st.data())
def test_points_stay_and_columns_follow(case, data):
    layout, raw = case
    points = all_points(layout, raw)
    kinds = data.draw(st.lists(st.sampled_from([*TYPES.values()]), max_size=4))
    values = data.draw(st.binary(min_size=8 * len(points), max_size=8 * len(points)))
    columns = {f'c{k}': np.frombuffer(values, kind, len(points)) for k, kind in enumerate(kinds)}
    placed, step, wide = point_cloud2.append_columns(layout, columns)
    end = layout.point_step
    for _, offset, datatype in placed:
        size = struct.calcsize(STRUCT_CODES[datatype])
        assert offset >= end and offset % size == 0
        end = offset + size
    assert step % 4 == 0 and end <= step < end + 12 and len(wide) == len(points) * step
    new = wide.reshape(-1, step)[:, : layout.point_step]
    assert [row.tobytes() for row in new] == points
    wider = dataclasses.replace(
        layout, fields=[Field(*column, 1) for column in placed], data=bytes(wide),
        point_step=step, row_step=layout.width * step,
    )  # fmt: skip
    found = read_columns(wider, list(columns))
    assert list(found) == list(columns)
    for name, values in columns.items():
        assert found[name].dtype == values.dtype
        np.testing.assert_array_equal(found[name], values.reshape(layout.height, layout.width))


def kitti_layout(n=5, **changes):
    rng = np.random.default_rng(0)
    fields = [
        Field(name, 4 * k, FLOAT32, 1) for k, name in enumerate(('x', 'y', 'z', 'intensity'))
    ]
    data = rng.normal(size=(n, 4)).astype('<f4').tobytes()
    return dataclasses.replace(cloud_of(1, n, fields, False, 16, 16 * n, data), **changes)


def replaced(name, /, **changes):
    fields = kitti_layout().fields
    return [dataclasses.replace(one, **(changes if one.name == name else {})) for one in fields]


def test_coordinates_side_by_side_are_not_copied():
    data = np.frombuffer(kitti_layout().data, np.uint8).copy()
    xyz = read_xyz(kitti_layout(data=data))
    assert np.shares_memory(xyz, data) and not xyz.flags.writeable and xyz.dtype == np.float32
    np.testing.assert_array_equal(xyz, data.view('<f4').reshape(-1, 4)[:, :3])
    apart = read_xyz(kitti_layout(data=data, fields=replaced('z', offset=12)))
    assert not np.shares_memory(apart, data)
    np.testing.assert_array_equal(apart, data.view('<f4').reshape(-1, 4)[:, [0, 1, 3]])


def test_what_is_not_needed_is_not_checked():
    cloud = cloud_from_points(np.empty((0, 4)), 0, 'lidar')
    assert read_xyz(dataclasses.replace(cloud, fields=[])).shape == (0, 3)
    assert point_cloud2.select_points(cloud, np.zeros(0, dtype=bool)).width == 0
    layout = kitti_layout(row_step=0)
    np.testing.assert_array_equal(read_xyz(layout), read_xyz(kitti_layout()))
    assert select_all(layout).data.tobytes() == kitti_layout().data


def field(name, /, **changes):
    return {'fields': replaced(name, **changes)}


def append(layout):
    return point_cloud2.append_columns(layout, {'a': np.ones(5, np.uint8)})


def select_all(layout):
    return point_cloud2.select_points(layout, np.ones(5, bool))


WRONG = [
    (read_xyz, {'fields': []}, r'no field named x: must have exactly one; fields: none'),
    (read_xyz, field('z', name='up'), r'no field named z.*x, y, up, intensity'),
    (read_xyz, field('intensity', name='y'), r'2 fields named y: must have exactly one'),
    (read_xyz, field('z', datatype=4),
     r'z has datatype 4 \(UINT16\): must be FLOAT32 \(7\) or FLOAT64 \(8\)'),
    (read_xyz, field('z', count=3), r'field z has count 3: must be 1'),
    (read_xyz, field('z', offset=13), r'z at offset 13 of 4 bytes.*point_step 16'),
    (read_xyz, field('z', offset=-4), r'z at offset -4'),
    (read_xyz, {'point_step': 0}, r'point_step 0: must be at least 1'),
    (read_xyz, {'width': 6}, r'data of 80 bytes: must be at least 96 \(height 1, width 6'),
    (read_xyz, {'height': 5, 'width': 1, 'row_step': 15}, r'row_step 15: must be at least 16'),
    (read_xyz, {'height': 2, 'row_step': 2**32 - 1}, r'data of 80 bytes: must be at least'),
    (read_xyz, {'row_step': 81}, r'row_step 81: must be at most the 80 bytes of data'),
    # numpy adds in 32 bits: an offset of 2^31 - 1 ended the process.
    *((read_fields, field('intensity', offset=offset, count=count),
       f'intensity at offset {offset} .*point_step 16')
      for offset, count in [(13, 1), (12, 2), (2**31 - 1, 1), (4, 2**30)]),
    (read_fields, field('x', datatype=9), r'field x has datatype 9 \(unknown\)'),
    (lambda cloud: read_columns(cloud, ['z']), {'width': 0, **field('z', count=2)}, 'count 2'),
    *((call, {'data': bytes(70)}, r'data of 70 bytes: must be at least 80')
      for call in (select_all, append)),
]  # fmt: skip


@pytest.mark.parametrize(('call', 'changes', 'message'), WRONG)
def test_what_cannot_be_is_refused_and_says_where(call, changes, message):
    with pytest.raises(PointCloudError, match=message):
        call(kitti_layout(**changes))


def test_selection_and_another_stamp_keep_all_else():
    cloud = samples.cloud(2)
    mask = np.isfinite(read_xyz(cloud)).all(axis=1)
    data = cloud.data.reshape(-1, cloud.point_step)[mask].ravel()
    shape = {'width': mask.sum(), 'row_step': len(data), 'data': data, 'is_dense': True}
    selected, moved = point_cloud2.select_points(cloud, mask), with_stamp(cloud, 7_000_000_008)
    assert not point_cloud2.select_points(cloud, ~mask).is_dense
    assert (stamp_of(moved.header), moved.header.frame_id) == (7_000_000_008, 'velo_link')
    for found, expected in (
        (selected, dataclasses.replace(cloud, **shape)),
        (dataclasses.replace(moved, header=cloud.header), cloud),
    ):
        assert encode_cloud(found) == encode_cloud(expected)
