"""``kitti-to-bag``: a KITTI sequence as a rosbag2; ``play``: the clouds of a bag, published."""

import argparse
import math
import time
from collections.abc import Iterator

import numpy as np

from gp_ground_seg.cli import options
from gp_ground_seg.core.errors import DataError, shown
from gp_ground_seg.data import bags
from gp_ground_seg.data.bags import POINT_CLOUD2, BagReader
from gp_ground_seg.data.semantic_kitti import list_frames
from gp_ground_seg.ros.session import large_cloud_transport, needing_ros, ros_session

TOPIC = '/kitti/velo/pointcloud'
FRAME_ID = 'velo_link'
EPOCH = 1_316_995_200
"""Seconds of 2011-09-26 00:00 UTC, the day of KITTI's first drives; times.txt starts at 0."""
DEPTH = 100  # clouds kept until acknowledged: with stock Fast DDS that can take 3 s
SLICE = 0.02  # longest wait in one piece [s]: /clock is published in between
DISCOVERY_TIMEOUT = 2.0  # longest wait for the first subscribers [s]
DELIVERY_TIMEOUT = 5.0  # longest wait for the last clouds [s]
PAUSE = 0.1  # time in the bag from the last cloud of a round to the first of the next [s]

CONVERT_DESCRIPTION = """\
Write the scans of a SemanticKITTI sequence as a rosbag2.

Topic /kitti/velo/pointcloud (sensor_msgs/PointCloud2, offered reliably), frame
velo_link, fields x y z intensity (FLOAT32) and, for scans that have labels,
label (UINT32, the SemanticKITTI class, as PCL's PointXYZL has it).

Stamps are times.txt (10 Hz where there is none) counted from 2011-09-26 00:00 UTC;
the recorded time of a message is its stamp.

OUT is a folder, as `ros2 bag record -o` makes. If it ends in .mcap or .db3 it is
that single file, which `ros2 bag play` and Foxglove open as well.
"""
CONVERT_EXAMPLES = """\
  gp-ground-seg kitti-to-bag KITTI_ROOT --sequence 00 drive
  gp-ground-seg kitti-to-bag KITTI_ROOT --sequence 08 drive.mcap
"""
PLAY_DESCRIPTION = """\
Publish the point clouds of a bag (ROS 1 .bag, rosbag2 folder, .mcap, .db3) on
their topics, byte for byte, at the times they were recorded. It begins when each
topic has a subscriber, after 2 s at the latest.

For TF and other topics, a choice of topics, remapped QoS or a start in the middle
use `ros2 bag play`.
"""
PLAY_EXAMPLES = """\
  gp-ground-seg play drive.mcap
  gp-ground-seg play drive.mcap --clock --rate 0.5
  gp-ground-seg play drive.mcap --loop --ros-args -r /points:=/front/points
"""


def add_parser(subparsers: options.Subparsers) -> None:
    """Declare the commands."""
    options.command(
        subparsers, 'kitti-to-bag', CONVERT_DESCRIPTION, CONVERT_EXAMPLES,
        ('root', 'folder with sequences/ in it', {'metavar': 'ROOT'}),
        ('output', 'folder, .mcap or .db3 file to write', {'metavar': 'OUT'}),
        ('--sequence', 'sequence, as in 00', {'metavar': 'S', 'required': True}),
        options.COLUMNS,
        options.FORCE,
        options.QUIET, run=run_convert,
    )  # fmt: skip
    options.command(
        subparsers, 'play', PLAY_DESCRIPTION, PLAY_EXAMPLES,
        ('bag', 'bag to play', {'metavar': 'BAG'}),
        ('--rate', 'speed, 2 = twice as fast as recorded (default: 1)',
         {'metavar': 'R', 'default': 1.0,
          'type': options.value(float, lambda rate: 0 < rate < math.inf, 'a number, above 0')}),
        ('--loop', 'begin again at the end, until Ctrl-C', options.FLAG),
        ('--clock', "publish the bag's time on /clock, 50 Hz (for use_sim_time)", options.FLAG),
        options.QUIET, run=run_play, accepts_ros_args=True,
    )  # fmt: skip


def run_convert(arguments: argparse.Namespace) -> int:
    """Write the bag."""
    frames = list_frames(arguments.root, arguments.sequence, options.columns_of(arguments))
    stamps = [EPOCH * 10**9 + round(frame.time * 1e9) for frame in frames]
    if not 0 <= stamps[0] <= stamps[-1] < 2**31 * 10**9:
        times = f'{frames[0].time:g} to {frames[-1].time:g} s'
        raise DataError(f'times.txt of sequence {arguments.sequence}: {times}: no stamps of ROS')
    n_points = n_labelled = 0
    progress = options.progress('kitti-to-bag', quiet=arguments.quiet)
    with bags.new_bag(arguments.output, {TOPIC: POINT_CLOUD2}, force=arguments.force) as write:
        for frame, stamp in progress([*zip(frames, stamps, strict=True)]):
            points, labels = frame.points, {}
            if frame.labels_path is not None:
                labels['label'] = frame.semantic.astype(np.uint32)
            cloud = bags.cloud_from_points(points, stamp, FRAME_ID, **labels)
            write(TOPIC, stamp, bags.encode_cloud(cloud))
            n_points += len(points)
            n_labelled += len(labels)
    n_frames, n_all = options.count(len(frames), 'frame'), options.count(n_points, 'point')
    seconds = 1e-9 * (stamps[-1] - stamps[0])
    facts = f'{n_frames} ({n_labelled} with labels), {n_all}, {seconds:.1f} s'
    print(f'{facts}, written to {shown(arguments.output)}')
    return 0


def run_play(arguments: argparse.Namespace) -> int:
    """Play the bag."""
    with needing_ros('play'), BagReader(arguments.bag) as bag:
        counts = {t: bag.n_messages(t) for t, kind in bag.topics.items() if kind == POINT_CLOUD2}
        topics = [topic for topic, n in counts.items() if n] or [bag.pick_point_cloud_topic()]
        # With --loop there is no end to show progress towards, only a count.
        total = 0 if arguments.loop else sum(counts.values())
        with (
            large_cloud_transport(),
            ros_session('bag_player', arguments.ros_args) as session,
            options.progress('play', quiet=arguments.quiet)(total=total) as bar,
        ):
            publishers = {t: session.publisher_of_clouds(t, DEPTH) for t in topics}
            tell_time = session.publisher_of_time() if arguments.clock else lambda _time: None
            session.wait_for(
                lambda: all(p.get_subscription_count() for p in publishers.values()),
                DISCOVERY_TIMEOUT,
            )
            for topic, due, recorded, raw in _scheduled(
                bag, topics, arguments.rate, arguments.loop
            ):
                left = math.inf
                while left:
                    left = max(0.0, due - time.monotonic())
                    tell_time(recorded - round(1e9 * left * arguments.rate))
                    session.sleep(min(SLICE, left))
                publishers[topic].publish(raw)
                bar.update()
            # With the publisher the last clouds would be lost.
            for publisher in publishers.values():
                session.wait_until_delivered(publisher, DELIVERY_TIMEOUT)
    return 0


def _scheduled(
    bag: BagReader, topics: list[str], rate: float, is_loop: bool
) -> Iterator[tuple[str, float, int, bytes]]:
    """Yield topic, monotonic time when it is due [s], time in the bag [ns], bytes of clouds."""
    start = 0.0
    while True:
        first: int | None = None
        elapsed = 0  # in the bag [ns]
        for topic, recorded, raw in bag.messages(topics):
            if first is None:
                first, start = recorded, max(start, time.monotonic())
            # The parts of a split bag may overlap.
            elapsed = max(elapsed, recorded - first)
            yield topic, start + 1e-9 * elapsed / rate, first + elapsed, raw
        if not is_loop:
            return
        start += (1e-9 * elapsed + PAUSE) / rate
