"""``plot``: pictures of a segmented scan: in perspective, or segments of it from the side."""

from __future__ import annotations

import argparse
import math
from pathlib import Path

import numpy as np

from gp_ground_seg.cli import options
from gp_ground_seg.core.errors import DataError, shown
from gp_ground_seg.core.result import Segmentation
from gp_ground_seg.core.segmenter import GroundSegmenter
from gp_ground_seg.data.files import check_writable
from gp_ground_seg.data.semantic_kitti import read_labels
from gp_ground_seg.lab.plotting import (
    CAMERA,
    Place,
    camera_at,
    plot_scan_view,
    plot_segment,
    segment_at,
)
from gp_ground_seg.lab.scoring.metrics import true_labels

SCAN = """\
Draw a scan in perspective: ground grey, obstacles orange; with --labels missed ground blue and
false ground purple.
"""
SCAN_EXAMPLES = """\
  gp-ground-seg plot scan drive.mcap --frame 20 -o scan.png
  gp-ground-seg plot scan 000000.bin --camera 90,30,40 -o from_the_left.svg
  gp-ground-seg plot scan velodyne/000000.bin --labels labels/000000.label -o errors.png
"""
SEGMENT = """\
The paper's Figure 1 for any scan and segment, or two side by side: points, ground
candidates, the lines through them with their critical points, the inliers, and the
estimated ground with twice its standard deviation; below it the length-scale and its
pseudo-inputs. Segments are numbered counter-clockwise from straight behind.
"""
SEGMENT_EXAMPLES = """\
  gp-ground-seg plot segment 000000.bin --azimuth 0 -o ahead.pdf
  gp-ground-seg plot segment 000000.bin --segment 157,158 -o pair.png
"""
KINDS = ('.png', '.pdf', '.svg')
ENDINGS = ' or '.join(KINDS)


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Declare the command and its pictures."""
    description = 'Draw a segmented scan: in perspective, or one segment of it.'
    examples = SCAN_EXAMPLES + SEGMENT_EXAMPLES
    parser = options.new_parser(subparsers, 'plot', description, examples)
    pictures = parser.add_subparsers(metavar='PICTURE', required=True, dest='picture')
    scan = options.new_parser(pictures, 'scan', SCAN, SCAN_EXAMPLES, 'a scan in perspective')
    scan.add_argument(
        '--camera', metavar='AZIMUTH,ELEVATION,DISTANCE', type=_camera, default=CAMERA,
        help='where it stands, seen from the middle of the scene: counter-clockwise from ahead '
        '[deg], upwards [deg], away [m] (default: 196,24,32)',
    )  # fmt: skip
    segment = options.new_parser(
        pictures, 'segment', SEGMENT, SEGMENT_EXAMPLES, 'a segment from the side'
    )
    which = segment.add_mutually_exclusive_group(required=True)
    which.add_argument(
        '--segment', metavar='N[,N]', type=_integers,
        help='number of the segment, or of several side by side',
    )  # fmt: skip
    which.add_argument(
        '--azimuth', metavar='DEG', type=_degrees,
        help='the segment in this direction, 90 = left',
    )  # fmt: skip
    for picture in (scan, segment):
        options.add(
            picture,
            ('input', 'scan, folder of scans, or bag', {'metavar': 'INPUT'}),
            ('--labels', 'SemanticKITTI labels of the points', {'metavar': 'FILE'}),
            ('--frame', 'which of several, from 0 (default: %(default)s)',
             {'metavar': 'N', 'type': int, 'default': 0}),
            ('-o --output', f'{ENDINGS} file', {'metavar': 'OUT', 'required': True}),
            *options.CLOUDS,
            options.FORCE,
        )  # fmt: skip
        options.add_config(picture)
        picture.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Segment the scan and draw it."""
    config = options.read_config(arguments)
    path = Path(arguments.output)
    if path.suffix.lower() not in KINDS:
        raise DataError(f'{path}: must end in {ENDINGS}')
    check_writable(path, force=arguments.force)
    scan = options.list_clouds(arguments)[arguments.frame]
    points, title, truth = scan.read().xyz, shown(scan.title), None
    if arguments.labels is not None:
        truth = true_labels(read_labels(arguments.labels, len(points)))
    used = options.spare_compiling(config, 1)
    result = GroundSegmenter(used).segment(points)
    if arguments.picture == 'scan':
        camera = arguments.camera
        said = plot_scan_view(points, result.label, path, title, camera, truth=truth)
    else:
        segments: list[int] | None = arguments.segment
        if segments is None:
            segments = [segment_at(math.radians(arguments.azimuth), config.grid.n_segments)]
        plot_segment(result, config, points, segments, path, truth, title)
        said = '; '.join(_segment_counts(result, segment) for segment in segments)
    print(f'{said}, written to {shown(path)}')
    options.note_spared(config, used)
    return 0


def _integers(text: str) -> list[int]:
    """Read numbers of segments."""
    try:
        return [int(word) for word in text.split(',')]
    except ValueError:
        message = f'{text!r}: must be whole numbers, as in 157,158'
        raise argparse.ArgumentTypeError(message) from None


def _degrees(text: str) -> float:
    """Read an angle [deg]."""
    value = float(text)
    if not abs(value) <= 360.0:
        raise argparse.ArgumentTypeError(f'{text}: must be a number of degrees, -360 to 360')
    return value


def _camera(text: str) -> Place:
    """Read azimuth, elevation and distance; straight from above no side of a picture is up."""
    try:
        azimuth, elevation, distance = map(float, text.split(','))
    except ValueError:
        azimuth = elevation = distance = math.nan
    if not (abs(azimuth) <= 360.0 and abs(elevation) <= 89.0 and 1.0 <= distance <= 1000.0):
        wanted = 'azimuth within 360 and elevation within 89 degrees, distance 1 to 1000 m'
        raise argparse.ArgumentTypeError(f'{text!r}: must be {wanted}, as in 90,30,40')
    return camera_at(azimuth, elevation, distance)


def _segment_counts(result: Segmentation, segment: int) -> str:
    first, last = result.candidates.offsets[segment : segment + 2].tolist()
    n_inliers = int(result.surface.inlier[first:last].sum())
    n_pseudo = int(np.diff(result.pseudo.offsets)[segment])
    return (
        f'segment {segment}: {last - first} candidates, {n_inliers} inliers, '
        f'{n_pseudo} pseudo-inputs'
    )
