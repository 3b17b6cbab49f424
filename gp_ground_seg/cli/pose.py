"""``pose``: height and tilt of the sensor, estimated from scans."""

from __future__ import annotations

import argparse
import math
import statistics
from contextlib import closing

from gp_ground_seg.cli import options
from gp_ground_seg.core.errors import PointCloudError
from gp_ground_seg.core.pipeline.sensor_pose import SensorPose
from gp_ground_seg.core.segmenter import GroundSegmenter
from gp_ground_seg.lab.scoring.report import Cell, Column, Table, percent, write_json

DESCRIPTION = """\
Estimate height and tilt of the sensor from scans.

INPUT is a scan of any format that `segment` reads, a folder of them, a sequence with
velodyne/ in it, or a bag. Each scan has an estimate of its own. Support is the share of
the low points on the plane of the ground, residual their distance to it. With enough scans
of level ground you can set the medians as parameters: docs/pose.md.
"""
EXAMPLES = """\
  gp-ground-seg pose 000000.bin
  gp-ground-seg pose KITTI_ROOT/sequences/00
  gp-ground-seg pose drive.mcap
  gp-ground-seg pose scans --set sensor.height=1.2      compare with this height
"""


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Declare the command."""
    parser = options.new_parser(subparsers, 'pose', DESCRIPTION, EXAMPLES)
    options.add(
        parser,
        ('input', 'scan, folder of scans, or bag', {'metavar': 'INPUT'}),
        *options.CLOUDS,
        options.TO_JSON,
        options.FORCE,
    )
    options.add_config(parser)
    parser.set_defaults(run=run)


DEGREES = math.degrees(1.0)
COLUMNS = (
    Column('scan'),
    Column('height [m]', '.2f', 'height'),
    Column('roll [deg]', '+.2f', 'roll', DEGREES),
    Column('pitch [deg]', '+.2f', 'pitch', DEGREES),
    percent('support [%]', 'support', '.0f'),
    Column('residual [m]', '.3f', 'residual'),
    Column('used as', key='used_as'),
)


def run(arguments: argparse.Namespace) -> int:
    """Print a line for each scan, and the medians."""
    poses, rows, notes = [], [], []
    scans = options.list_clouds(arguments)
    config, bar = options.read_config(arguments), options.progress('pose')
    with options.staged_options(arguments, 'json') as parts:
        with closing(GroundSegmenter(config)) as segmenter:
            for scan in bar(scans, total=len(scans)):
                try:
                    pose = segmenter.estimate_pose(scan.read().xyz)
                except PointCloudError as error:
                    notes.append(f'{scan.title}: refused: {error}')
                    continue
                poses.append(pose)
                rows.append(_pose_row(scan.title, pose))
                notes += [f'{scan.title}: {line}' for line in pose.contradictions]
        table = Table(COLUMNS, rows)
        if poses:
            print(table.text())
            notes.insert(0, _pose_summary(poses))
        if 'json' in parts:
            write_json({'scans': table.json(), 'notes': notes}, parts['json'])
    print('\n'.join(notes))
    return 0


def _pose_row(name: str, pose: SensorPose) -> list[Cell]:
    """Return what the scan shows of the pose, and the values used."""
    used = f'height {pose.height:.2f}'
    if not pose.height_estimated:
        used = f'height {pose.height:g} (not measured)'
    if not pose.is_level:
        used += f', roll {math.degrees(pose.roll):.1f} pitch {math.degrees(pose.pitch):.1f}'
    found = pose.measured
    if found is None or not found.tells_height:
        return [name, *5 * [None], used]
    tilt = (found.roll, found.pitch) if found.tells_tilt else (None, None)
    return [name, found.height, *tilt, found.plane.support, found.plane.residual, used]


def _pose_summary(poses: list[SensorPose]) -> str:
    """Return the medians over the scans that show the pose, as parameters."""
    found = [pose.measured for pose in poses if pose.measured is not None]
    heights = [one.height for one in found if one.tells_height]
    tilts = [(one.roll, one.pitch) for one in found if one.tells_tilt]
    if not heights:
        return 'no scan shows enough ground to estimate the height: set sensor.height'
    words = f'median of {len(heights)}: sensor.height={statistics.median(heights):.2f}'
    if tilts:
        roll, pitch = map(statistics.median, zip(*tilts, strict=True))
        words += f' sensor.roll={roll:.3f} sensor.pitch={pitch:.3f} [m, rad]'
    return words
