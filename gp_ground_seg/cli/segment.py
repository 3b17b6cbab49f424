"""``segment``: label scans on disk, or the clouds of a bag."""

from __future__ import annotations

import argparse
from pathlib import Path

from gp_ground_seg.cli.options import add_config_options, config_from_options
from gp_ground_seg.cli.segment_bag import (
    DEFAULT_GROUND_TOPIC,
    DEFAULT_OBSTACLES_TOPIC,
    segment_bag,
)
from gp_ground_seg.cli.segment_scans import find_scans, segment_scans
from gp_ground_seg.data.bag_files import BAG_SUFFIXES, is_bag
from gp_ground_seg.errors import DataError

DESCRIPTION = """\
Split scans into ground and obstacles.

INPUT is guessed from what it is:
  scan.bin             a KITTI scan (float32 x, y, z, intensity)
  folder               of .bin files, or a sequence with velodyne/ in it
  drive.bag            a ROS 1 bag
  drive.mcap, .db3     a single-file rosbag2
  folder               of a rosbag2 (with metadata.yaml)

Scans give .label files in SemanticKITTI's form, one uint32 per point in input
order: 40 (road) = ground, 99 (other-object) = obstacle, 0 (unlabelled) = unknown,
which are the points that are not finite. With --raw: 1, 2 and 0.

A bag gives a rosbag2 with all messages of the input as they are, and after each
point cloud its ground and its obstacles: every field of every point bit for bit,
the same header, the same recorded time. Unknown points are in neither.
Messages of ROS 1 are converted to ROS 2.

Nothing is overwritten without --force. Output is written under a hidden name
(.NAME.partial-...) and takes its name when it is complete.
"""

EXAMPLES = """\
examples:
  gp-ground-seg segment 000000.bin -o 000000.label
  gp-ground-seg segment KITTI_ROOT/sequences/00 -o labels
  gp-ground-seg segment drive.mcap                          writes drive_ground.mcap
  gp-ground-seg segment drive.bag -o out --topic /velodyne_points --format sqlite3
"""


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Declare the command."""
    parser = subparsers.add_parser(
        'segment',
        description=DESCRIPTION,
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument('input', metavar='INPUT', help='scan, folder of scans, or bag')
    parser.add_argument(
        '-o',
        '--output',
        metavar='OUT',
        help='for scans a folder, or a .label file for a single scan; for bags a folder, or a '
        '.mcap or .db3 file (default: INPUT with _ground added, beside it)',
    )
    parser.add_argument('--force', action='store_true', help='replace output that exists')
    parser.add_argument('--quiet', action='store_true', help='no progress bar, no notes')
    add_config_options(parser)
    scans = parser.add_argument_group('for scans')
    scans.add_argument(
        '--raw', action='store_true', help='write 0 unknown, 1 ground, 2 obstacle as labels'
    )
    bags = parser.add_argument_group('for bags')
    bags.add_argument(
        '--topic', metavar='T', help='PointCloud2 topic (default: the only one there is)'
    )
    bags.add_argument(
        '--ground-topic',
        metavar='T',
        help=f'topic of the ground (default: {DEFAULT_GROUND_TOPIC})',
    )
    bags.add_argument(
        '--obstacles-topic',
        metavar='T',
        help=f'topic of the obstacles (default: {DEFAULT_OBSTACLES_TOPIC})',
    )
    bags.add_argument(
        '--drop',
        metavar='T',
        action='append',
        default=[],
        help='leave this topic out of the output (may be repeated)',
    )
    bags.add_argument(
        '--format',
        choices=('mcap', 'sqlite3'),
        help='storage of the output (default: by its name, else as the input; mcap for ROS 1)',
    )
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Find out what the input is, and segment it."""
    config = config_from_options(arguments)
    source = Path(arguments.input)
    if not source.exists():
        raise DataError(f'{source}: no such file or folder')
    if is_bag(source) or _holds_bag_files(source):
        _refuse(arguments, 'scans', raw='--raw')
        return segment_bag(source, arguments, config)
    scans = find_scans(source)
    _refuse(
        arguments,
        'bags',
        topic='--topic',
        ground_topic='--ground-topic',
        obstacles_topic='--obstacles-topic',
        drop='--drop',
        format='--format',
    )
    return segment_scans(source, scans, arguments, config)


def _holds_bag_files(source: Path) -> bool:
    """Whether a folder has bag files in it and no scans; opening it says what to do."""
    if not source.is_dir() or any(source.glob('*.bin')):
        return False
    return any(child.suffix in BAG_SUFFIXES for child in source.iterdir())


def _refuse(arguments: argparse.Namespace, kind: str, **options: str) -> None:
    for name, option in options.items():
        if getattr(arguments, name):
            raise DataError(f'{option}: is for {kind}, which {arguments.input} is not')
