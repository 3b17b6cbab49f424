"""``plot``: pictures of a segmented scan: in perspective, or segments of it from the side."""

import argparse
from pathlib import Path

from gp_ground_seg.cli import options
from gp_ground_seg.core.errors import LOGGER, DataError, shown
from gp_ground_seg.core.segmenter import GroundSegmenter
from gp_ground_seg.data.files import check_writable
from gp_ground_seg.data.semantic_kitti import read_entries
from gp_ground_seg.lab import plotting
from gp_ground_seg.lab.scoring.metrics import true_labels

SCAN = """\
Draw a scan in perspective: ground grey, obstacles orange; with --labels missed ground blue and
false ground purple.
"""
SCAN_EXAMPLES = """\
  gp-ground-seg plot scan drive.mcap --frame 20 -o scan.png
  gp-ground-seg plot scan 000000.bin --camera 90,30,40 -o from_the_left.svg
  gp-ground-seg plot scan 000000.bin --labels 000000.label -o errors.png
"""
SEGMENT = """\
The paper's Figure 1 for any scan and segment, or two side by side: points, ground candidates, the
lines through them with their critical points, the inliers, and the estimated ground with twice its
standard deviation; below it the length-scale and its pseudo-inputs. Of n segments number m begins
at azimuth -180 + m * 360/n degrees, counter-clockwise from ahead: 90 of 180 is ahead, to the left.
"""
SEGMENT_EXAMPLES = """\
  gp-ground-seg plot segment 000000.bin --segment 90 -o ahead.pdf
  gp-ground-seg plot segment 000000.bin --segment 157,158 -o pair.png
"""
KINDS = ('.png', '.pdf', '.svg')
ENDINGS = ' or '.join(KINDS)


def add_parser(subparsers: options.Subparsers) -> None:
    """Declare the command and its pictures."""
    description = 'Draw a segmented scan: in perspective, or one segment of it.'
    examples = SCAN_EXAMPLES + SEGMENT_EXAMPLES
    parser = options.command(subparsers, 'plot', description, examples)
    wanted = 'three numbers, up to 360 and 89 degrees, and 1 to 1000 m'
    camera = options.value(lambda text: [*map(float, text.split(','))], _can_look, wanted)
    wanted = 'whole numbers, as 90,91'
    numbers = options.value(lambda text: [*map(int, text.split(','))], bool, wanted)
    pictures = parser.add_subparsers(metavar='PICTURE', required=True, dest='picture')
    of_both: tuple[options.Option, ...] = (
        ('input', 'scan, folder of scans, or bag', {'metavar': 'INPUT'}),
        ('--labels', 'SemanticKITTI labels of the points', {'metavar': 'FILE'}),
        ('--frame', 'which of several, from 0 (default: 0)', options.whole(0)),
        ('-o --output', f'{ENDINGS} file', {'metavar': 'OUT', 'required': True}),
        *options.CLOUDS, options.FORCE, *options.CONFIG,
    )  # fmt: skip
    options.command(
        pictures, 'scan', SCAN, SCAN_EXAMPLES,
        ('--camera', 'where it stands, seen from the middle of the scene: counter-clockwise from '
         'ahead within 360 deg, upwards within 89 deg, 1 to 1000 m away (default: 196,24 and as '
         'near as the cloud is small)', {'metavar': 'AZIMUTH,ELEVATION,DISTANCE', 'type': camera}),
        *of_both, purpose='a scan in perspective', run=run,
    )  # fmt: skip
    options.command(
        pictures, 'segment', SEGMENT, SEGMENT_EXAMPLES,
        ('--segment', 'number of the segment, or of several side by side',
         {'metavar': 'N[,N]', 'type': numbers, 'required': True}),
        *of_both, purpose='a segment from the side', run=run,
    )  # fmt: skip


def run(arguments: argparse.Namespace) -> int:
    """Segment the scan and draw it."""
    config = options.read_config(arguments)
    path = Path(arguments.output)
    if path.suffix.lower() not in KINDS:
        raise DataError(f'{path}: must end in {ENDINGS}')
    check_writable(path, force=arguments.force)
    scans = options.list_clouds(arguments)
    scan = scans[arguments.frame or 0]
    if arguments.frame is None and len(scans) > 1:
        first = ', '.join([scan.title, *(one.title for one in scans.files[1:4])])
        LOGGER.info('the first of %d clouds, %s ...: see --frame', len(scans), first)
    points, title, truth = scan.read().xyz, shown(scan.title), None
    if arguments.labels is not None:
        truth = true_labels(read_entries(arguments.labels, len(points)) & 0xFFFF)
    used = options.spare_compiling(config, 1)
    result = GroundSegmenter(used).segment(points)
    if arguments.picture == 'scan':
        camera = arguments.camera and plotting.camera_at(*arguments.camera)
        said = plotting.plot_scan_view(points, result.label, path, title, camera, truth=truth)
    else:
        said = plotting.plot_segment(result, points, arguments.segment, path, truth, title)
    for line in result.pose.contradictions:
        LOGGER.info('%s', line)
    print(f'sensor: {plotting.words_of_pose(result.pose)}')
    print(f'{said}, written to {shown(path)}')
    options.note_spared(config, used)
    return 0


def _can_look(view: list[float]) -> bool:
    """Whether a camera can look from there; straight from above no side of a picture is up."""
    azimuth, elevation, distance = view
    return abs(azimuth) <= 360.0 and abs(elevation) <= 89.0 and 1.0 <= distance <= 1000.0
