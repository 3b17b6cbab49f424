"""Small bags of every kind, for the tests."""

from functools import partial

import numpy as np
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from gp_ground_seg.data.bags import POINT_CLOUD2, BagReader, encode_cloud, jazzy_types, new_bag

START = 1_317_000_000_123_456_789
PERIOD = 100_000_000
CUSTOM = 'my_msgs/msg/Odd'
CUSTOM_DEFINITION = 'Header header\ntime when\nuint8[] bytes\nfloat64 value\n'


def scan(seed=0, n_ground=1500, n_wall=300):
    """Flat ground 1.73 m below the sensor, a wall, a NaN: (N, 4) float32."""
    rng = np.random.default_rng(seed)
    ground = rng.uniform(-25, 25, (n_ground, 3))
    ground[:, 2] = -1.73 + rng.normal(0, 0.01, n_ground)
    wall = rng.uniform(-5, 5, (n_wall, 3))
    wall[:, 0], wall[:, 2] = 10.0, rng.uniform(-1, 1, n_wall)
    points = np.vstack([ground, wall, [[np.nan, 0, 0]]]).astype('<f4')
    return np.hstack([points, rng.random((len(points), 1), dtype=np.float32)])


def cloud(index=0, **changes):
    """Cloud with a ring and padding, organised in one row unless told otherwise."""
    points = scan(index, **changes)
    new = jazzy_types().types
    layout = (('x', 0, 7), ('y', 4, 7), ('z', 8, 7), ('i', 12, 7), ('ring', 17, 4))
    fields = [new['sensor_msgs/msg/PointField'](*field, 1) for field in layout]
    rng = np.random.default_rng(index)
    data = rng.integers(0, 256, (len(points), 22), dtype=np.uint8)
    data[:, :16] = points.view(np.uint8)
    seconds, nanoseconds = divmod(START - 5_000 + index * PERIOD, 10**9)
    stamp = new['builtin_interfaces/msg/Time'](seconds, nanoseconds)
    header = new['std_msgs/msg/Header'](stamp, 'velo_link')
    return new[POINT_CLOUD2](
        header, 1, len(points), fields, False, 22, 22 * len(points), data.reshape(-1), False
    )


def write_ros2_bag(path, n_clouds=3, topics=('/points',), silent=(), **changes):
    """Clouds on each topic, a string before every one of them; returns what was written."""
    written = []
    kinds = {**dict.fromkeys((*topics, *silent), POINT_CLOUD2), '/note': 'std_msgs/msg/String'}
    with new_bag(path, kinds) as write:
        for k in range(n_clouds):
            time = START + k * PERIOD
            note = jazzy_types().types['std_msgs/msg/String'](f'cloud {k}')
            raw = bytes(jazzy_types().serialize_cdr(note, 'std_msgs/msg/String'))
            entries = [('/note', time - 7, raw)]
            entries += [(topic, time, encode_cloud(cloud(k, **changes))) for topic in topics]
            for entry in entries:
                write(*entry)
                written.append(entry)
    return written


def write_clouds(path, raws, start=0):
    """Messages of one topic, a nanosecond apart."""
    with new_bag(path, {'/points': POINT_CLOUD2}) as write:
        for time, raw in enumerate(raws, start):
            write('/points', time, raw)


def read_messages(path, *topics):
    """Messages of a bag, or of some topics: topic, time and bytes of each."""
    with BagReader(path) as bag:
        return list(bag.messages(topics))


def write_ros1_bag(path, n_clouds=3, topic='/kitti/velo/pointcloud'):
    """A bag as kitti2bag makes, with a message of a custom type, and a topic of two publishers."""
    types = get_typestore(Stores.ROS1_NOETIC)
    types.register(get_types_from_msg(CUSTOM_DEFINITION, CUSTOM))
    with Ros1Writer(path) as bag:
        add = partial(bag.add_connection, typestore=types)
        clouds, odd = add(topic, POINT_CLOUD2), add('/odd', CUSTOM)
        texts = [add('/text', 'std_msgs/msg/String', callerid=name) for name in ('/a', '/b')]
        for k in range(n_clouds):
            time = START + k * PERIOD
            raw = jazzy_types().cdr_to_ros1(encode_cloud(cloud(k)), POINT_CLOUD2)
            bag.write(clouds, time, raw)
            for other in (odd, *texts):
                bag.write(other, time + 1, b'not read')
