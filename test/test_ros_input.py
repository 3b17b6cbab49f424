"""Input of the node: messages of any layout, against the struct module; stamps that jump."""

import copy
import struct
from array import array

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

pytest.importorskip('rclpy', reason='ROS is not installed')

import ros_helpers  # noqa: F401  imports type support without its warnings
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import PointCloud2, PointField

from gp_ground_seg.data.point_cloud2 import read_xyz
from gp_ground_seg.errors import PointCloudError
from gp_ground_seg.ros.input import JUMP_TOLERANCE, StampWatch, select_points

STRUCT_CODE = {
    PointField.INT8: 'b',
    PointField.UINT8: 'B',
    PointField.INT16: 'h',
    PointField.UINT16: 'H',
    PointField.INT32: 'i',
    PointField.UINT32: 'I',
    PointField.FLOAT32: 'f',
    PointField.FLOAT64: 'd',
}
COORDINATE = st.one_of(
    st.floats(width=32), st.sampled_from([float('nan'), float('inf'), float('-inf'), -0.0])
)


@st.composite
def clouds(draw):
    """A message, and its points as lists of (x, y, z, bytes)."""
    further = draw(st.lists(st.sampled_from(['intensity', 'ring', 'time', 'label']), unique=True))
    is_bigendian = draw(st.booleans())
    order = '>' if is_bigendian else '<'
    fields, offset = [], draw(st.integers(0, 5))
    for name in draw(st.permutations(['x', 'y', 'z', *further])):
        kinds = [PointField.FLOAT32, PointField.FLOAT64] if name in 'xyz' else list(STRUCT_CODE)
        kind = draw(st.sampled_from(kinds))
        fields.append(PointField(name=name, offset=offset, datatype=kind, count=1))
        offset += struct.calcsize('=' + STRUCT_CODE[kind]) + draw(st.integers(0, 3))
    height, width = draw(st.integers(0, 3)), draw(st.integers(0, 5))
    row_step = width * offset + draw(st.integers(0, 9))
    raw = bytearray(draw(st.binary(min_size=height * row_step, max_size=height * row_step)))
    points = []
    for row in range(height):
        for column in range(width):
            start = row * row_step + column * offset
            values = []
            for field in fields:
                if field.name in 'xyz':
                    value = draw(COORDINATE)
                    code = order + STRUCT_CODE[field.datatype]
                    struct.pack_into(code, raw, start + field.offset, value)
                    values.append((field.name, value))
            xyz = [value for _, value in sorted(values)]
            points.append((xyz, bytes(raw[start : start + offset])))
    message = PointCloud2(
        height=height,
        width=width,
        fields=fields,
        is_bigendian=is_bigendian,
        point_step=offset,
        row_step=row_step,
        is_dense=draw(st.booleans()),
    )
    message.data = array('B', raw)
    message.header.frame_id = draw(st.sampled_from(['velo_link', '', 'os_sensor']))
    message.header.stamp.sec = draw(st.integers(-(2**31), 2**31 - 1))
    message.header.stamp.nanosec = draw(st.integers(0, 999_999_999))
    # As a subscriber gets it.
    return deserialize_message(serialize_message(message), PointCloud2), points


@settings(max_examples=300, deadline=None)
@given(clouds(), st.data())
def test_any_layout_is_read_and_split_without_loss(case, data):
    message, points = case
    before = copy.deepcopy(message)
    xyz = read_xyz(message)
    assert xyz.shape == (len(points), 3)
    np.testing.assert_array_equal(xyz, np.reshape([p for p, _ in points], (-1, 3)))

    mask = np.array([data.draw(st.booleans()) for _ in points], dtype=bool)
    for keep in (mask, ~mask):
        part = select_points(message, keep)
        kept = [point for point, is_kept in zip(points, keep, strict=True) if is_kept]
        assert bytes(part.data) == b''.join(raw for _, raw in kept)
        assert (part.height, part.width) == (1, len(kept))
        assert part.row_step == len(kept) * message.point_step
        for name in ('header', 'fields', 'is_bigendian', 'point_step'):
            assert getattr(part, name) == getattr(message, name)
        assert part.is_dense == all(np.isfinite(p).all() for p, _ in kept)
        # It is a message that can be sent and read again.
        again = deserialize_message(serialize_message(part), PointCloud2)
        np.testing.assert_array_equal(read_xyz(again), xyz[keep])
    assert message == before


def test_signalling_nan_is_just_not_finite():
    kinds = {'x': PointField.FLOAT32, 'y': PointField.FLOAT32, 'z': PointField.FLOAT64}
    message = PointCloud2(
        height=1,
        width=1,
        point_step=20,
        row_step=20,
        fields=[
            PointField(name=name, offset=4 * k, datatype=kind, count=1)
            for k, (name, kind) in enumerate(kinds.items())
        ],
    )
    message.data = array('B', struct.pack('<IfdI', 0x7F800001, 1.0, 2.0, 0))
    xyz = read_xyz(message)
    assert np.isnan(xyz[0, 0])
    assert not select_points(message, np.array([True])).is_dense


@pytest.mark.parametrize(
    ('attribute', 'value', 'reason'),
    [
        ('fields', [], r'no field named x.*fields: none'),
        ('width', 3, r'data of 24 bytes: must be at least 36'),
        ('point_step', 11, r'field z at offset 8 of 4 bytes: must end within point_step 11'),
        ('point_step', 0, r'point_step 0'),
        ('data', array('B', bytes(23)), r'data of 23 bytes: must be at least 24'),
    ],
)
def test_malformed_message_says_what_and_where(attribute, value, reason):
    fields = [
        PointField(name=name, offset=4 * k, datatype=PointField.FLOAT32, count=1)
        for k, name in enumerate('xyz')
    ]
    message = PointCloud2(height=1, width=2, fields=fields, point_step=12, row_step=24)
    message.data = array('B', bytes(24))
    assert read_xyz(message).shape == (2, 3)
    setattr(message, attribute, value)
    with pytest.raises(PointCloudError, match=reason):
        read_xyz(message)


@given(st.lists(st.floats(0.0, 5.0)))
def test_a_stamp_far_behind_the_newest_is_a_jump(stamps):
    watch, newest = StampWatch(), None
    for stamp in stamps:
        behind = 0.0 if newest is None else newest - stamp
        jump = watch.note(stamp)
        if behind > JUMP_TOLERANCE:
            assert jump == behind
            newest = stamp
        else:
            assert jump == 0.0
            newest = stamp if newest is None else max(newest, stamp)


def test_a_bag_played_in_a_loop_jumps_once_a_round():
    watch = StampWatch()
    rounds = [[1317383.0 + 0.1 * k for k in range(20)]] * 3
    assert [sum(watch.note(s) > 0.0 for s in stamps) for stamps in rounds] == [0, 1, 1]


def test_after_a_reset_any_stamp_is_the_first():
    watch = StampWatch()
    watch.note(100.0)
    watch.reset()
    assert watch.note(1.0) == 0.0
