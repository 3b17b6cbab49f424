"""Clouds of four layouts through the real node, over DDS; test_point_cloud2.py has any."""

from array import array

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='ROS is not installed')

import ros_helpers as ros
from sensor_msgs.msg import PointCloud2, PointField

from gp_ground_seg import Config, GroundSegmenter, Label
from gp_ground_seg.core.pipeline.points import single_precision
from gp_ground_seg.ros.outputs import LABELLED_FIELDS as FIELDS
from gp_ground_seg.ros.outputs import labelled_names

CODES = ('i1', 'u1', 'i2', 'u2', 'i4', 'u4', 'f4', 'f8')
# Small, as nothing of a layout depends on it.
CHANGES = {
    'learning.mode': 'fixed',
    'grid.n_segments': 16,
    'grid.n_bins': 16,
}
CASES = {
    'one row without row_step': ('<f4', (1, 200), 0, 0.1),
    'double precision, big-endian, padded rows': ('>f8', (5, 40), 13, 0.0),
    'nothing finite': ('<f8', (3, 7), 1, 1.0),
    'no point': ('>f4', (0, 3), 0, 0.0),
}
"""Type of the coordinates, rows by columns, bytes behind each row, share that is not finite."""


def cloud_of(code, shape, padding, share):
    """Message with gaps and further fields, coordinates (N, 3), and the bytes of each point."""
    rng, (height, width) = np.random.default_rng(0), shape
    types = {'ring': 'u2', 'z': code[1:], 'label': 'u1', 'x': code[1:], 'réflexion': 'f8'}
    types |= {'y': code[1:], 'height': 'i4'}
    sizes = [np.dtype(name).itemsize for name in types.values()]
    starts = 3 * np.arange(1, len(sizes) + 1) + np.cumsum([0, *sizes[:-1]])
    dtype = np.dtype({
        'names': [*types], 'formats': [code[0] + name for name in types.values()],
        'offsets': starts, 'itemsize': starts[-1] + sizes[-1] + 5,
    })  # fmt: skip
    raw = rng.integers(0, 256, (height * width, dtype.itemsize), dtype=np.uint8)
    points = raw.view(dtype)[:, 0]
    source = ros.street(len(points))
    for axis in 'xyz':
        bad = rng.random(len(points)) < share
        points[axis] = source[axis]
        points[axis][bad] = rng.choice([np.nan, np.inf, -np.inf], bad.sum())
    points['x'][:1] = 500.0  # beyond the grid: no height there
    rows = raw.reshape(height, width * dtype.itemsize)
    rows = np.pad(rows, ((0, 0), (0, padding)), constant_values=7)
    message = PointCloud2(height=height, width=width, point_step=dtype.itemsize)
    message.row_step, message.is_bigendian = rows.shape[1] * (height != 1), code[0] == '>'
    message.fields = [
        PointField(name=name, offset=dtype.fields[name][1], datatype=1 + CODES.index(of), count=1)
        for name, of in types.items()
    ]
    message.header.frame_id = 'velo_link'
    message.header.stamp.sec, message.header.stamp.nanosec = -height, 999_999_999
    message.data = array('B', rows.tobytes())
    xyz = np.stack([points[axis].astype(code[1:]) for axis in 'xyz'], axis=-1)
    return message, xyz, [row.tobytes() for row in raw]


@pytest.fixture(scope='module')
def tested():
    with ros.bench(*ros.given(CHANGES)) as b:
        yield b, b.listen('~/labeled'), GroundSegmenter(Config().replace(**CHANGES))


@pytest.mark.parametrize('case', CASES)
def test_every_byte_comes_through_with_labels_as_of_the_library(tested, case):
    b, labelled, segmenter = tested
    message, xyz, rows = cloud_of(*CASES[case])
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
