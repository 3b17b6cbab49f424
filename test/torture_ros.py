"""Hostile messages over DDS: clouds that contradict themselves or have flipped bytes, parameters
of every type that a byte can name, and wrong times.

The node refuses what contradicts itself, answers every call and every valid cloud sent in between,
and prints no traceback. `python test/torture_ros.py FIRST STOP` sends the cases of a range.
"""

import sys
import tempfile
from array import array
from pathlib import Path

import numpy as np
from rcl_interfaces.msg import Parameter, ParameterValue
from rclpy.serialization import serialize_message
from ros_helpers import SETTERS, linked_process, street, to_message
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import PointField

VALID = to_message(street(2000))
MAX_RSS = 1.5e9
"""Memory that the node may hold at the end [bytes]."""


def hostile_cloud(rng):
    """Cloud whose layout, sizes and fields are drawn at random, near to what is valid."""
    message = to_message(street(int(rng.choice([0, 1, 50, 500])), seed=int(rng.integers(1000))))
    sizes = [0, 1, 2, 3, 12, 16, 63, 65, 1000, 2**16, 2**31 - 1, 2**31, 2**32 - 1]
    for name in ('height', 'width', 'point_step', 'row_step'):
        if rng.random() < 0.4:
            setattr(message, name, int(rng.choice(sizes)))
    for field in message.fields:
        if rng.random() < 0.3:
            field.offset = int(rng.choice(sizes))
        if rng.random() < 0.2:
            field.datatype = int(rng.integers(0, 256))
        if rng.random() < 0.2:
            field.count = int(rng.choice(sizes))
        if rng.random() < 0.1:
            field.name = str(rng.choice(['', 'x', 'y', 'z', 'label', 'ground_z', '\0', 'é' * 50]))
    if rng.random() < 0.2:
        message.fields = message.fields[: rng.integers(5)]
    if rng.random() < 0.2:
        message.fields = [*message.fields, PointField(name='x', datatype=7, count=1)]
    if rng.random() < 0.3:
        message.data = array('B', rng.bytes(int(rng.choice([0, 1, 100, 64000]))))
    message.is_bigendian = bool(rng.random() < 0.2)
    if rng.random() < 0.2:
        message.header.frame_id = str(rng.choice(['', '/', 'a b', 'é', 'x' * 3000]))
    if rng.random() < 0.2:
        message.header.stamp.sec = int(rng.choice([-(2**31), -1, 0, 2**31 - 1]))
        message.header.stamp.nanosec = int(rng.choice([0, 10**9, 2**32 - 1]))
    return message


def damaged_message(rng):
    """Serialized valid cloud with bytes flipped, mostly in what comes before the points."""
    data = bytearray(serialize_message(to_message(street(100, seed=int(rng.integers(1000))))))
    for _ in range(rng.integers(1, 6)):
        data[rng.integers(min(len(data), rng.choice([60, 250, len(data)])))] = rng.integers(256)
    return bytes(data[: rng.integers(1, len(data) + 1)] if rng.random() < 0.1 else data)


def hostile_parameter(rng, kind):
    """Parameter of the type `kind` in [0, 256), whose values fit it or not."""
    names = 'grid.r_max', 'label.ground_tolerance', 'runtime.backend', 'use_sim_time'
    return Parameter(
        name=str(rng.choice([*names, '', 'é' * 3000, '\x1b[2J'])),
        value=ParameterValue(
            type=kind,
            bool_value=bool(rng.random() < 0.5),
            integer_value=int(rng.choice([-(2**63), 0, 50, 2**63 - 1])),
            double_value=float(rng.choice([np.nan, np.inf, -1e300, 50.0])),
            string_value=str(rng.choice(['', 'gpu', '\n', 'é' * 3000])),
            double_array_value=[50.0] * int(rng.integers(3)),
        ),
    )


def wrong_time(rng):
    """Time of a clock, mostly negative or too large."""
    time = Clock()
    time.clock.sec = int(rng.choice([-(2**31), -5, -1, 0, 2**31 - 1]))
    time.clock.nanosec = int(rng.choice([0, 10**9, 2**32 - 1]))
    return time


def main():
    """Send the cases of the command line to one node."""
    first, stop = map(int, sys.argv[1:3])
    wrong = []
    simulated = '-p', 'use_sim_time:=true'
    with (
        tempfile.TemporaryDirectory() as folder,
        linked_process(Path(folder), *simulated) as (node, link),
    ):
        node.wait_until_settled()
        clock = link.probe.create_publisher(Clock, '/clock', 1)
        for number in range(first, stop):
            print(f'\r{number}', end='', flush=True)
            rng = np.random.default_rng([17, number])
            cloud = hostile_cloud(rng) if rng.random() < 0.5 else damaged_message(rng)
            link.publisher.publish(cloud)
            clock.publish(wrong_time(rng))
            for setter in SETTERS:
                link.request(setter, [hostile_parameter(rng, number % 256)])
            if number % 10 == 9 or number == stop - 1:
                seen = len(link.ground.messages)
                link.publish_until(
                    VALID,
                    lambda seen=seen: any(m.width for m in link.ground.messages[seen:]),
                    'answer to a valid cloud',
                )
        memory = int(Path(f'/proc/{node.popen.pid}/statm').read_text().split()[1]) * 4096
        if memory > MAX_RSS:
            wrong.append(f'{memory / 1e6:.0f} MB held')
        if node.popen.poll() is not None:
            wrong.append(f'the node ended with {node.popen.poll()}')
        if 'Traceback' in node.log:
            wrong.append(node.log[node.log.index('Traceback') :][:500].replace('\n', ' | '))
    for line in wrong:
        print(f'\rcases {first} to {stop}: {line}')
    print()
    sys.exit(1 if wrong else 0)


if __name__ == '__main__':
    main()
