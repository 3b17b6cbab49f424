"""Clouds of every layout through the real node, over DDS."""

import math
from array import array

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

pytest.importorskip('rclpy', reason='ROS is not installed')

import ros_helpers as ros
from sensor_msgs.msg import PointCloud2, PointField

from gp_ground_seg import Config, GroundSegmenter, Label
from gp_ground_seg.core.pipeline.points import single_precision
from gp_ground_seg.ros.outputs import LABELLED_FIELDS as FIELDS
from gp_ground_seg.ros.outputs import labelled_names

CODES = ('i1', 'u1', 'i2', 'u2', 'i4', 'u4', 'f4', 'f8')
NAMES = 'intensity', 'ring', 'label', 'height', 'normal x', '', 'réflexion'
NOT_FINITE = (math.nan, math.inf, -math.inf)
# Small, so that hundreds of clouds take seconds; nothing of a layout depends on it.
CHANGES = {
    'learning.mode': 'fixed',
    'grid.n_segments': 16,
    'grid.n_bins': 16,
    'runtime.n_threads': 1,
}


@st.composite
def clouds(draw):
    """A message, the coordinates of its points (N, 3) float64, and the bytes of each."""
    order = draw(st.sampled_from('<>'))
    further = draw(st.lists(st.sampled_from(NAMES), max_size=4))
    fields, offset, formats = [], draw(st.integers(0, 3)), {}
    for name in draw(st.permutations(['x', 'y', 'z', *further])):
        is_axis = name in ('x', 'y', 'z')
        code = draw(st.sampled_from(CODES[6:] if is_axis else CODES))
        count = draw(st.sampled_from((0, 1))) if is_axis else draw(st.integers(0, 5))
        datatype = 1 + CODES.index(code)
        fields.append(PointField(name=name, offset=offset, datatype=datatype, count=count))
        if is_axis:
            formats[name] = (order + code, offset)
        offset += int(code[1]) * max(count, int(is_axis)) + draw(st.integers(0, 5))
    step = offset
    shape = height, width = draw(st.integers(0, 5)), draw(st.integers(0, 40))
    # A single row needs no row_step; drivers leave it at 0.
    least = 0 if height == 1 else width * step
    row_step = draw(st.sampled_from((least, width * step, width * step + 13)))
    size = height * max(row_step, width * step)
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    raw = rng.integers(0, 256, size + draw(st.sampled_from((0, 7))), dtype=np.uint8)

    n_points = height * width
    source = ros.street(n_points, seed=int(rng.integers(2**32)))
    is_wide = any(code.endswith('f8') for code, _ in formats.values())
    xyz = np.empty((n_points, 3), dtype=np.float64 if is_wide else np.float32)
    for k, axis in enumerate('xyz'):
        values = source[axis].astype(np.float64)
        bad = rng.random(n_points) < draw(st.sampled_from((0.0, 0.1, 1.0)), label=f'bad {axis}')
        values[bad] = rng.choice(NOT_FINITE, int(bad.sum()))
        code, at = formats[axis]
        if n_points:
            np.ndarray(shape, code, raw, at, (row_step, step))[...] = values.reshape(shape)
        xyz[:, k] = values.astype(code[1:])
    message = PointCloud2(height=height, width=width, fields=fields, point_step=step)
    message.row_step, message.is_bigendian = row_step, order == '>'
    message.is_dense = draw(st.booleans())
    message.header.frame_id = draw(st.sampled_from(('velo_link', '', 'os_sensor')))
    message.header.stamp.sec = draw(st.integers(-(2**31), 2**31 - 1))
    message.header.stamp.nanosec = draw(st.integers(0, 999_999_999))
    message.data = array('B', raw.tobytes())
    starts = [r * row_step + c * step for r in range(height) for c in range(width)]
    return message, xyz, [raw[start : start + step].tobytes() for start in starts]


@pytest.fixture(scope='module')
def tested():
    with ros.bench(*ros.given(CHANGES)) as b:
        labelled = ros.Collector(b.probe, PointCloud2, 'ground_segmentation_node/labeled')
        publisher = next(p for o, p in b.node._outputs._publishers if o.topic == '~/labeled')
        ros.wait_for(lambda: publisher.get_subscription_count() == 1, 'ear of the labelled cloud')
        segmenter = GroundSegmenter(Config().replace(**CHANGES))
        yield b, labelled, segmenter
        segmenter.close()


@settings(max_examples=40)
@given(clouds())
def test_every_layout_comes_through(tested, case):
    check_layout(tested, case)


@pytest.mark.slow
@settings(max_examples=400)
@given(clouds())
def test_every_layout_comes_through_of_many(tested, case):
    check_layout(tested, case)


def check_layout(tested, case):
    """Every byte of a cloud is in the outputs, with labels as of the library."""
    b, labelled, segmenter = tested
    message, xyz, rows = case
    expected = segmenter.segment(single_precision(xyz))
    count = len(labelled.messages)
    parts = b.segment(message)

    for part, wanted in zip(parts, (Label.GROUND, Label.OBSTACLE), strict=True):
        kept = [row for row, label in zip(rows, expected.label, strict=True) if label == wanted]
        for name in ('header', 'fields', 'is_bigendian', 'point_step'):
            assert getattr(part, name) == getattr(message, name)
        assert (part.height, part.width) == (1, len(kept))
        assert part.row_step == len(kept) * message.point_step
        assert bytes(part.data) == b''.join(kept)
        assert part.is_dense
    assert parts[0].width + parts[1].width == np.isfinite(xyz).all(axis=1).sum()

    whole = labelled.wait(count + 1)[-1]
    for name in ('header', 'height', 'width', 'is_bigendian'):
        assert getattr(whole, name) == getattr(message, name)
    assert whole.row_step == message.width * whole.point_step
    assert whole.fields[: len(message.fields)] == message.fields
    names = list(labelled_names(field.name for field in message.fields).values())
    added = whole.fields[len(message.fields) :]
    assert [field.name for field in added] == names
    assert [CODES[field.datatype - 1] for field in added] == ['u1', *['f4'] * 5]
    raw = np.frombuffer(whole.data, np.uint8).reshape(len(rows), whole.point_step)
    assert [row[: message.point_step].tobytes() for row in raw] == rows
    is_dense = np.isfinite(xyz).all()
    for field, name in zip(added, FIELDS, strict=True):
        code = CODES[field.datatype - 1]
        column = raw[:, field.offset : field.offset + int(code[1])]
        order = '>' if message.is_bigendian else '<'
        values = np.ascontiguousarray(column).view(order + code).ravel()
        np.testing.assert_array_equal(values, getattr(expected, name).astype(code))
        is_dense &= np.isfinite(values).all()
    assert whole.is_dense == is_dense


@settings(max_examples=30)
@given(clouds(), st.sampled_from(('short', 'no z', 'two x', 'step', 'integer', 'outside')))
def test_a_cloud_that_cannot_hold_what_it_claims_is_refused_and_the_next_one_processed(
    tested, case, fault
):
    (b, _, _), (message, _, _) = tested, case
    assume(message.height * message.width > 0)
    by_name = {field.name: field for field in message.fields}
    if fault == 'short':
        row = message.width * message.point_step
        message.data = message.data[: (message.height - 1) * message.row_step + row - 1]
    elif fault == 'no z':
        message.fields.remove(by_name['z'])
    elif fault == 'two x':
        message.fields.append(by_name['x'])
    elif fault == 'step':
        message.point_step = 0
    elif fault == 'integer':
        by_name['y'].datatype = PointField.INT32
    else:
        by_name['x'].offset = message.point_step - 3
    before = len(b.ground.messages)
    b.publisher.publish(message)
    # The cloud after it is processed, and is the only one.
    good = PointCloud2(height=1)
    good.header.frame_id = 'good'
    for part in b.segment(good):
        assert (part.width, part.header.frame_id) == (0, 'good')
    assert len(b.ground.messages) == len(b.obstacles.messages) == before + 1
