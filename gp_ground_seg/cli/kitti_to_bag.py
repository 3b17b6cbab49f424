"""``kitti-to-bag``: a KITTI sequence as a rosbag2."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from gp_ground_seg.cli.output import count, note_leftovers, progress_bar
from gp_ground_seg.data.bags import BagWriter, cloud_topic
from gp_ground_seg.data.point_cloud2 import CloudMessage, cloud_from_columns, encode_cloud
from gp_ground_seg.data.semantic_kitti import Frame, list_frames, read_labels, read_points
from gp_ground_seg.errors import DataError

TOPIC = '/kitti/velo/pointcloud'
FRAME_ID = 'velo_link'
EPOCH = 1_316_995_200
"""Seconds of 2011-09-26 00:00 UTC, the day of KITTI's first drives; times.txt starts at 0."""

_LAST_SECOND = 2**31 - 1

DESCRIPTION = """\
Write the scans of a SemanticKITTI sequence as a rosbag2.

Topic /kitti/velo/pointcloud (sensor_msgs/PointCloud2, offered reliably), frame
velo_link, fields x y z intensity (FLOAT32) and, for scans that have labels,
label (UINT32, the SemanticKITTI class, as PCL's PointXYZL has it).

Stamps are times.txt (10 Hz where there is none) counted from 2011-09-26 00:00 UTC;
the recorded time of a message is its stamp.

OUT is a folder, as `ros2 bag record -o` makes. If it ends in .mcap or .db3 it is
that single file, which `ros2 bag play` and Foxglove open as well.
"""

EXAMPLES = """\
examples:
  gp-ground-seg kitti-to-bag KITTI_ROOT --sequence 00 drive
  gp-ground-seg kitti-to-bag KITTI_ROOT --sequence 08 drive.mcap --start 100 --count 50
"""


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Declare the command."""
    parser = subparsers.add_parser(
        'kitti-to-bag',
        description=DESCRIPTION,
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument('root', metavar='ROOT', help='folder with sequences/ in it')
    parser.add_argument('output', metavar='OUT', help='folder, .mcap or .db3 file to write')
    parser.add_argument('--sequence', metavar='S', required=True, help='sequence, as in 00')
    parser.add_argument(
        '--format',
        choices=('mcap', 'sqlite3'),
        help='storage (default: by the name of OUT, else mcap)',
    )
    parser.add_argument(
        '--start', metavar='N', type=int, default=0, help='scans to skip (default: 0)'
    )
    parser.add_argument('--count', metavar='N', type=int, help='scans to write (default: all)')
    parser.add_argument('--force', action='store_true', help='replace a bag that exists')
    parser.add_argument('--quiet', action='store_true', help='no progress bar, no notes')
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Write the bag."""
    frames = _choose(list_frames(arguments.root, arguments.sequence), arguments)
    stamps = [_nanoseconds(frame) for frame in frames]
    target = Path(arguments.output)
    if not arguments.quiet:
        note_leftovers(target)
    n_points = 0
    with (
        BagWriter(target, storage=arguments.format, force=arguments.force) as bag,
        progress_bar(len(frames), quiet=arguments.quiet, title='kitti-to-bag') as bar,
    ):
        bag.add_topic(cloud_topic(TOPIC))
        for frame, stamp in zip(frames, stamps, strict=True):
            cloud = frame_as_cloud(frame, stamp)
            bag.write(TOPIC, stamp, encode_cloud(cloud))
            n_points += cloud.width
            bar.update()
    n_labelled = sum(frame.labels_path is not None for frame in frames)
    print(
        f'{count(len(frames), "frame")} ({n_labelled} with labels), {count(n_points, "point")}, '
        f'{1e-9 * (stamps[-1] - stamps[0]):.1f} s, written to {target}'
    )
    return 0


def frame_as_cloud(frame: Frame, stamp: int) -> CloudMessage:
    """Cloud of a scan, with its labels if it has any.

    Parameters
    ----------
    frame : Frame
        The scan.
    stamp : int
        Time of the header [ns].

    Raises
    ------
    DataError
        If a file cannot be read.
    """
    points = read_points(frame.points_path)
    columns: dict[str, npt.NDArray[Any]] = {
        name: points[:, k] for k, name in enumerate(('x', 'y', 'z', 'intensity'))
    }
    if frame.labels_path is not None:
        columns['label'] = read_labels(frame.labels_path, len(points)).astype(np.uint32)
    return cloud_from_columns(divmod(stamp, 10**9), FRAME_ID, columns)


def _choose(frames: Sequence[Frame], arguments: argparse.Namespace) -> Sequence[Frame]:
    start, wanted = arguments.start, arguments.count
    where = f'sequence {arguments.sequence}: {count(len(frames), "scan")} there'
    if not 0 <= start < len(frames):
        raise DataError(f'--start {start}: must be in [0, {len(frames) - 1}]; {where}')
    left = len(frames) - start
    if wanted is None:
        return frames[start:]
    if not 1 <= wanted <= left:
        raise DataError(f'--count {wanted}: must be in [1, {left}] from scan {start} on; {where}')
    return frames[start : start + wanted]


def _nanoseconds(frame: Frame) -> int:
    """Stamp of a frame [ns]."""
    if not 0 <= frame.time <= _LAST_SECOND - EPOCH:
        raise DataError(
            f'times.txt of sequence {frame.sequence}: time {frame.time:g} s of frame '
            f'{frame.index}: must be in [0, {_LAST_SECOND - EPOCH}] s'
        )
    return EPOCH * 10**9 + round(frame.time * 1e9)
