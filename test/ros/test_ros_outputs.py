"""The topics: every byte of a cloud, and the optional ones, which cost nothing unasked."""

import time
from array import array

import numpy as np
import pytest
import ros_helpers as ros
from nav_msgs.msg import OccupancyGrid
from rclpy.qos import DurabilityPolicy, QoSProfile
from ros_helpers import street, to_message, xyz_of
from sensor_msgs.msg import LaserScan, PointCloud2, PointField

from gp_ground_seg import Config, GroundSegmenter, Label
from gp_ground_seg.core.parameters.schema import NODE_NAME
from gp_ground_seg.core.pipeline.points import rotation, single_precision
from gp_ground_seg.data import costmap
from gp_ground_seg.data.costmap import SegmentedCloud
from gp_ground_seg.data.point_cloud2 import read_columns, read_xyz
from gp_ground_seg.ros import outputs
from gp_ground_seg.ros.outputs import LABELLED_FIELDS as FIELDS
from gp_ground_seg.ros.outputs import MODEL_FIELDS, read_ground_model

pytestmark = pytest.mark.usefixtures('compiled_code')

OPTIONAL = {
    '~/labeled': PointCloud2, '~/ground_model': PointCloud2, '~/scan': LaserScan,
    '~/occupancy': OccupancyGrid,
}  # fmt: skip
CONFIG = Config().replace(**{'learning.mode': 'fixed'})


@pytest.fixture(scope='module')
def b():
    with ros.bench({'learning.mode': 'fixed'}) as shared:
        yield shared


def received(b, topic, message):
    """What the optional topic says of one cloud."""
    collector = b.listen(topic, OPTIONAL[topic])
    b.segment(message)
    answer = collector.wait(1)[0]
    b.forget(collector)
    return answer


def test_ground_model_gives_the_height_anywhere(b):
    """Also that of a tilted sensor, which is not where the frame of the cloud begins."""
    tilt = {'sensor.roll': 0.35, 'sensor.pitch': -0.2}
    origin = {'sensor.origin_x': 1.5, 'sensor.origin_y': -0.5, 'sensor.origin_z': 1.0}
    points = street(6000)
    turned = xyz_of(points).astype(np.float64) @ rotation(*tilt.values())
    points = ros.moved(points, turned + np.array([*origin.values()]))
    message = to_message(points, stamp=(17, 23), frame='velo_link')
    with b.changed(tilt | origin):
        found = received(b, '~/ground_model', message)
    assert found.header == message.header
    assert (found.height, found.width) == (CONFIG.grid.n_segments, CONFIG.grid.n_bins + 1)
    layout = [(field.name, field.datatype, field.count) for field in found.fields]
    assert layout == [(name, PointField.FLOAT32, 1) for name in MODEL_FIELDS]
    model = read_ground_model(found)
    np.testing.assert_allclose((model.roll, model.pitch), (0.35, -0.2), atol=1e-6)
    expected = GroundSegmenter(CONFIG.replace(**tilt, **origin)).segment(xyz_of(points))
    height, std = model.at(points['x'], points['y'])
    ground = expected.label == Label.GROUND
    assert np.isfinite(height[ground]).mean() > 0.99
    for found, wanted in ((height, expected.ground_z), (std, expected.ground_std)):
        off = np.abs(found - wanted)[ground]
        assert np.nanmedian(off) < 1e-4 and np.nanquantile(off, 0.95) < 1e-3


def test_a_reader_that_is_transient_local_gets_a_grid_of_the_last_second_only(b):
    message = to_message(street(3000))
    profile = QoSProfile(depth=5, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    received(b, '~/occupancy', message)
    time.sleep(1.0)
    words = b.probe, OccupancyGrid, f'{b.node_name}/occupancy', profile
    reader = ros.Collector(*words)
    ros.wait_for(lambda: b.node._outputs.n_subscribers()[reader.subscription.topic_name], 'it')
    time.sleep(0.3)
    assert not reader.messages

    def comes_to_the_next():
        """Unless it is too old, where this process was kept from its work just then."""
        b.segment(message)
        late = ros.Collector(*words)
        time.sleep(outputs.MAP_LIFESPAN)
        b.forget(late)
        return late.messages

    ros.wait_for(comes_to_the_next, 'grid at once')
    reader.wait(1)
    b.forget(reader)


REDUCED = {
    'output.min_height': 0.3, 'output.max_height': 1.2, 'output.max_step_down': 0.2,
    'output.cell_size': 0.25, 'output.grid_size': 30.0, 'grid.r_max': 80.0,
}  # fmt: skip


def street_with_drop():
    """A street, and in front of the sensor ground in rings that is 0.6 m lower from x = 6 m on."""
    rings, azimuth = np.meshgrid(np.geomspace(3.5, 30.0, 60), np.linspace(-0.7, 0.7, 320))
    x, y = rings * np.cos(azimuth), rings * np.sin(azimuth)
    scale = np.where(x > 6.0, (1.73 + 0.6) / 1.73, 1.0)
    front = np.stack([scale * x, scale * y, -1.73 * scale], axis=-1).reshape(-1, 3)
    others = street(8000)
    others = others[abs(np.arctan2(others['y'], others['x'])) > 0.7]
    return ros.moved(street(len(front) + len(others)), np.vstack([front, xyz_of(others)]))


def test_what_a_costmap_takes_is_that_of_the_library(b):
    message = to_message(street_with_drop(), stamp=(17, 23), frame='velo_link')
    config, rows = CONFIG.replace(**REDUCED), ros.rows_of(message)
    expected = SegmentedCloud(message, GroundSegmenter(config).segment(read_xyz(message)), config)
    with b.changed(REDUCED):
        parts = b.segment(message)
        scan, grid = (received(b, topic, message) for topic in ('~/scan', '~/occupancy'))
    assert all(one.header == message.header for one in (*parts, scan, grid))
    assert expected.is_obstacle.sum() > 300 and len(expected._found.points()) > 100
    for part, chosen in zip(parts, (expected.is_ground, expected.is_obstacle), strict=True):
        assert ros.rows_of(part) == [rows[k] for k in np.flatnonzero(chosen)]

    returns = expected.places(expected.segmentation.label != Label.UNKNOWN)
    ranges = costmap.scan_ranges(expected.blocked, returns)
    np.testing.assert_array_equal(np.array(scan.ranges, np.float32), ranges)
    assert (scan.range_min, scan.range_max, len(ranges)) == (0.0, 80.0, costmap.DIRECTIONS)
    # Of the middle of each direction, counter-clockwise from -x.
    middle = -np.pi + 2.0 * np.pi * (np.arange(len(ranges)) + 0.5) / len(ranges)
    angles = scan.angle_min + scan.angle_increment * np.arange(len(ranges))
    np.testing.assert_allclose(angles, middle, atol=1e-4)
    assert scan.angle_max == pytest.approx(middle[-1])

    info, origin = grid.info, grid.info.origin
    assert info.map_load_time == message.header.stamp
    assert (info.width, info.height, info.resolution) == (120, 120, 0.25)
    assert (origin.position.x, origin.position.y, origin.orientation.w) == (-15.0, -15.0, 1.0)
    cells = np.array(grid.data, np.int8).reshape(120, 120)
    found, tolerance = expected.segmentation, config.label.ground_tolerance
    reach = costmap.reach_of_model(found.surface, expected.heading, tolerance)
    places = expected.places(expected.is_ground), expected.blocked
    np.testing.assert_array_equal(cells, costmap.occupancy(*places, reach, 0.25, 30.0))


def test_the_time_of_a_scan_is_that_between_clouds(b):
    collector = b.listen('~/scan', LaserScan)
    for n, stamp in enumerate([(100, 0), (100, 10**8), (105, 0)], 1):
        b.segment(to_message(street(500), stamp))
        collector.wait(n)
    b.forget(collector)
    # After a pause it says nothing.
    assert [scan.scan_time for scan in collector.messages[1:]] == pytest.approx([0.1, 0.0])


def test_nothing_is_built_that_nobody_subscribes_to(b, monkeypatch):
    built = []

    def counted(output):
        return output._replace(build=lambda s: built.append(output.topic) or output.build(s))

    rows = [(counted(output), publisher) for output, publisher in b.node._outputs._publishers]
    monkeypatch.setattr(b.node._outputs, '_publishers', rows)
    for topic in OPTIONAL:  # each begins with the end of the one before
        received(b, topic, PointCloud2())  # without points and fields: this is answered too
        assert built == ['ground', 'obstacles', topic]
        built.clear()


OTHER_QOS = {'depth': 3, 'reliability': 'best_effort'}


def test_quality_of_service_of_every_output_can_be_overridden():
    topics = [o.topic for o in outputs.OUTPUTS]
    assert {o.topic: (o.message_type, o.is_optional) for o in outputs.OUTPUTS} == {
        **dict.fromkeys(('ground', 'obstacles'), (PointCloud2, False)),
        **{topic: (message, True) for topic, message in OPTIONAL.items()},
    }
    names = (f'qos_overrides./{topic.replace("~", NODE_NAME)}.publisher' for topic in topics)
    values = {f'{name}.{k}': v for name in names for k, v in OTHER_QOS.items()}
    with ros.started_node(*ros.given(values)) as node:
        for _, publisher in node._outputs._publishers:
            qos = publisher.qos_profile
            assert {'depth': qos.depth, 'reliability': qos.reliability.short_key} == OTHER_QOS
    # Of this node only.
    assert {output.profile.depth for output in outputs.OUTPUTS} == {outputs.OUTPUT_DEPTH}


# Clouds of four layouts through the real node, over DDS; test_point_cloud2.py has any.

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
    names = ['ring', 'z', 'label', 'x', 'réflexion', 'y', 'height', 'gp_label']
    others = {'ring': 'u2', 'label': 'u1', 'réflexion': 'f8', 'height': 'i4', 'gp_label': 'u1'}
    formats = [code[0] + others.get(name, code[1:]) for name in names]
    layout = {'names': names, 'formats': formats, 'offsets': [*range(3, 91, 11)]}
    dtype = np.dtype({**layout, 'itemsize': 93})
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
    message = to_message(points, (-height, 999_999_999), 'velo_link')
    message.height, message.width, message.is_bigendian = height, width, code[0] == '>'
    message.row_step, message.data = rows.shape[1] * (height != 1), array('B', rows.tobytes())
    return message, xyz_of(points).astype(code[1:]), [row.tobytes() for row in raw]


@pytest.mark.parametrize('case', CASES)
def test_every_byte_comes_through_with_labels_as_of_the_library(b, case):
    message, xyz, rows = cloud_of(*CASES[case])
    expected = GroundSegmenter(CONFIG).segment(single_precision(xyz))
    labelled = b.listen('~/labeled')
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

    (whole,) = labelled.wait(1)
    b.forget(labelled)
    for name in ('header', 'height', 'width', 'is_bigendian'):
        assert getattr(whole, name) == getattr(message, name)
    assert whole.row_step == message.width * whole.point_step
    assert whole.fields[: len(message.fields)] == message.fields
    names = ['gp_gp_label', 'gp_height', *FIELDS[2:]]  # the input has the others
    assert [field.name for field in whole.fields[len(message.fields) :]] == names
    raw = np.frombuffer(whole.data, np.uint8).reshape(len(rows), whole.point_step)
    assert [row[: message.point_step].tobytes() for row in raw] == rows
    columns = [column.ravel() for column in read_columns(whole, names).values()]
    assert [column.dtype for column in columns] == ['u1', *['f4'] * 5]
    for field, column in zip(FIELDS, columns, strict=True):
        np.testing.assert_array_equal(column, getattr(expected, field).astype(column.dtype))
    assert whole.is_dense == all(np.isfinite(values).all() for values in (xyz, *columns))
