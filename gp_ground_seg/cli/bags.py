"""``kitti-to-bag``: a KITTI sequence as a rosbag2; ``play``: the clouds of a bag, published."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from gp_ground_seg.cli import options
from gp_ground_seg.core.errors import DataError, shown
from gp_ground_seg.data.bags import BagReader, BagWriter, cloud_from_columns, encode_cloud
from gp_ground_seg.data.point_cloud2 import CloudMessage
from gp_ground_seg.data.semantic_kitti import Frame, list_frames, read_labels, read_points
from gp_ground_seg.ros.start_stop import large_cloud_transport, needing_ros, ros_session

if TYPE_CHECKING:
    from gp_ground_seg.ros.playback import Player

TOPIC = '/kitti/velo/pointcloud'
FRAME_ID = 'velo_link'
EPOCH = 1_316_995_200
"""Seconds of 2011-09-26 00:00 UTC, the day of KITTI's first drives; times.txt starts at 0."""
SILENT_WAIT = 1.0
"""Time without a subscriber after which a note says so [s]."""

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
their topic, byte for byte, at the times they were recorded.

Offered reliably: a reliable subscriber gets every cloud. Waits for a subscriber
before it starts. Only PointCloud2 topics are played; for TF and the rest use
`ros2 bag play`.

A slow subscriber may lose clouds that its middleware acknowledged: its own
/diagnostics have their number.
"""
PLAY_EXAMPLES = """\
  gp-ground-seg play drive.mcap
  gp-ground-seg play drive.mcap --clock --rate 0.5
  gp-ground-seg play drive.mcap --loop --ros-args -r /kitti/velo/pointcloud:=/points

exit code: 0, 1 if clouds were not acknowledged (always 0 with --no-wait), 2 for an error, 130
when interrupted
"""


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Declare the commands."""
    parser = options.new_parser(subparsers, 'kitti-to-bag', CONVERT_DESCRIPTION, CONVERT_EXAMPLES)
    options.add(
        parser,
        ('root', 'folder with sequences/ in it', {'metavar': 'ROOT'}),
        ('output', 'folder, .mcap or .db3 file to write', {'metavar': 'OUT'}),
        ('--sequence', 'sequence, as in 00', {'metavar': 'S', 'required': True}),
        options.COLUMNS,
        options.FORCE,
        options.QUIET,
    )
    parser.set_defaults(run=run_convert)

    parser = options.new_parser(subparsers, 'play', PLAY_DESCRIPTION, PLAY_EXAMPLES)
    options.add(
        parser,
        ('bag', 'bag to play', {'metavar': 'BAG'}),
        ('--rate', 'speed, 2 = twice as fast as recorded (default: 1)',
         {'metavar': 'R', 'type': options.above_zero, 'default': 1.0}),
        ('--loop', 'begin again at the end, until Ctrl-C', options.FLAG),
        ('--clock', "publish the bag's time on /clock, 50 Hz (for use_sim_time)", options.FLAG),
        ('--topic', 'PointCloud2 topic to play (may be repeated; default: the only one)',
         {'metavar': 'T', 'action': 'append'}),
        ('--no-wait', 'start at once, with or without a subscriber', options.FLAG),
        options.QUIET,
    )  # fmt: skip
    parser.set_defaults(run=run_play, accepts_ros_args=True)


def scan_cloud(
    points: npt.NDArray[np.float32], stamp_ns: int, frame_id: str, **further: npt.NDArray[Any]
) -> CloudMessage:
    """Return points (N, 4), x y z [m] intensity, and `further` fields (N,) as a cloud."""
    columns = {name: points[:, k] for k, name in enumerate(('x', 'y', 'z', 'intensity'))}
    return cloud_from_columns(divmod(stamp_ns, 10**9), frame_id, {**columns, **further})


def run_convert(arguments: argparse.Namespace) -> int:
    """Write the bag."""
    columns = options.columns_of(arguments)
    frames = list_frames(arguments.root, arguments.sequence, columns)
    stamps = [_nanoseconds(frame) for frame in frames]
    target = Path(arguments.output)
    n_points = 0
    with (
        BagWriter(target, force=arguments.force) as bag,
        options.progress('kitti-to-bag', quiet=arguments.quiet)(total=len(frames)) as bar,
    ):
        bag.add_topic(TOPIC)
        for frame, stamp in zip(frames, stamps, strict=True):
            points = read_points(frame.points_path, frame.columns)
            labels = {}
            if frame.labels_path is not None:
                labels['label'] = read_labels(frame.labels_path, len(points)).astype(np.uint32)
            bag.write(TOPIC, stamp, encode_cloud(scan_cloud(points, stamp, FRAME_ID, **labels)))
            n_points += len(points)
            bar.update()
    n_labelled = sum(frame.labels_path is not None for frame in frames)
    n_frames, n_all = options.count(len(frames), 'frame'), options.count(n_points, 'point')
    seconds = 1e-9 * (stamps[-1] - stamps[0])
    facts = f'{n_frames} ({n_labelled} with labels), {n_all}, {seconds:.1f} s'
    print(f'{facts}, written to {shown(target)}')
    return 0


def _nanoseconds(frame: Frame) -> int:
    """Return the stamp of a frame [ns]."""
    last = 2**31 - 1 - EPOCH
    if not 0 <= frame.time <= last:
        raise DataError(
            f'times.txt of sequence {frame.sequence}: time {frame.time:g} s of frame '
            f'{frame.index}: must be in [0, {last}] s'
        )
    return EPOCH * 10**9 + round(frame.time * 1e9)


def run_play(arguments: argparse.Namespace) -> int:
    """Play the bag."""
    with needing_ros('play'):
        from gp_ground_seg.ros.playback import Player, PlayOptions

    how = PlayOptions(arguments.rate, arguments.loop, arguments.clock)
    with BagReader(arguments.bag) as bag:
        chosen = dict.fromkeys(arguments.topic or [None])
        topics = [bag.pick_point_cloud_topic(name) for name in chosen]
        others = [f'{name} ({kind})' for name, kind in bag.topics.items() if name not in topics]
        if others and not arguments.quiet:
            options.note(f'not played: {", ".join(others)}')
        n_clouds = sum(bag.n_messages(topic) for topic in topics)
        with large_cloud_transport(), ros_session('bag_player', arguments.ros_args) as session:
            player = Player(session.node, bag, topics, session.sleep, how)
            if not arguments.no_wait:
                _wait_for_subscribers(player, quiet=arguments.quiet)
            try:
                # With --loop there is no end to show progress towards, only a count.
                total = 0 if arguments.loop else n_clouds
                with options.progress('play', quiet=arguments.quiet)(total=total) as bar:
                    player.play(bar.update)
            finally:
                # After an interrupt, too: with --loop it is the only end.
                if summary := player.summary():
                    print(summary, flush=True)
    if not player.is_acknowledged:
        options.note('not every reliable subscriber has acknowledged all clouds')
    return 0 if player.is_acknowledged or arguments.no_wait else 1


def _wait_for_subscribers(player: Player, *, quiet: bool) -> None:
    if not (player.wait_for_subscribers(SILENT_WAIT) or quiet):
        options.note(
            f'waiting for a subscriber of {", ".join(player.topics_without_subscriber())}'
        )
    player.wait_for_subscribers()
