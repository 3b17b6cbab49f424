"""``pose``: height and tilt of the sensor, from scans on disk."""

from __future__ import annotations

import argparse
import math
import statistics
from contextlib import closing
from pathlib import Path

from gp_ground_seg.cli.options import add_config_options, config_from_options
from gp_ground_seg.cli.segment import find_scans
from gp_ground_seg.cli.tables import format_table
from gp_ground_seg.data.semantic_kitti import read_points
from gp_ground_seg.errors import DataError, PointCloudError
from gp_ground_seg.pipeline.sensor_pose import SensorPose
from gp_ground_seg.segmenter import GroundSegmenter

DESCRIPTION = """\
Find out from scans how high the sensor is and how it is tilted.

INPUT is a .bin scan (float32 x, y, z, intensity), a folder of them, or a sequence
with velodyne/ in it. Each scan is judged by itself. Support is the share of the
low points on the plane that was found, residual their distance to it. With enough
scans of level ground the medians are values to set: docs/pose.md.
"""

EXAMPLES = """\
examples:
  gp-ground-seg pose 000000.bin
  gp-ground-seg pose KITTI_ROOT/sequences/00
  gp-ground-seg pose scans --set sensor.height=1.2      does it agree?
"""


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Declare the command."""
    parser = subparsers.add_parser(
        'pose',
        description=DESCRIPTION,
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument('input', metavar='INPUT', help='scan, or folder of scans')
    add_config_options(parser)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Print a line for each scan, and the medians."""
    config = config_from_options(arguments)
    source = Path(arguments.input)
    if not source.exists():
        raise DataError(f'{source}: no such file or folder')
    scans = find_scans(source)
    rows, notes = [], []
    poses: list[SensorPose] = []
    with closing(GroundSegmenter(config)) as segmenter:
        for scan in scans:
            try:
                pose = segmenter.estimate_pose(read_points(scan))
            except PointCloudError as error:
                notes.append(f'{scan.name}: refused: {error}')
                continue
            poses.append(pose)
            rows.append([scan.name, *_cells(pose)])
            notes += [f'{scan.name}: {line}' for line in pose.contradictions]
    if rows:
        header = ['scan', 'height [m]', 'roll [deg]', 'pitch [deg]', 'support', 'residual [m]',
                  'used as']  # fmt: skip
        print(format_table(header, rows))
        print(_summary(poses))
    for line in notes:
        print(line)
    return 0


def _cells(pose: SensorPose) -> list[str]:
    how = [f'height {pose.height:.2f}' if pose.height_estimated else f'height {pose.height:g}']
    if not pose.height_estimated:
        how[0] += ' (not measured)'
    if not pose.is_level:
        how.append(f'roll {math.degrees(pose.roll):.1f} pitch {math.degrees(pose.pitch):.1f}')
    measured = pose.measured
    if measured is None or not measured.tells_height:
        return ['-', '-', '-', '-', '-', ', '.join(how)]
    tilt = ['-', '-']
    if measured.tells_tilt:
        tilt = [f'{math.degrees(angle):+.2f}' for angle in (measured.roll, measured.pitch)]
    plane = measured.plane
    return [
        f'{measured.height:.2f}',
        *tilt,
        f'{100.0 * plane.support:.0f} %',
        f'{plane.residual:.3f}',
        ', '.join(how),
    ]


def _summary(poses: list[SensorPose]) -> str:
    """Medians over the scans that tell, as parameters."""
    found = [pose.measured for pose in poses if pose.measured is not None]
    heights = [one.height for one in found if one.tells_height]
    tilts = [one for one in found if one.tells_tilt]
    if not heights:
        return 'no scan shows enough ground to tell the height: set sensor.height'
    words = f'median of {len(heights)}: sensor.height={statistics.median(heights):.2f}'
    if tilts:
        roll, pitch = (statistics.median(getattr(t, n) for t in tilts) for n in ('roll', 'pitch'))
        words += f' sensor.roll={roll:.3f} sensor.pitch={pitch:.3f} [m, rad]'
    return words
