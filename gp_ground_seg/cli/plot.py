"""``plot scan`` and ``plot segment``: pictures of a segmented scan."""

from __future__ import annotations

import argparse
import math
from contextlib import closing
from pathlib import Path

import numpy as np

from gp_ground_seg.cli.options import add_config_options, config_from_options, new_parser
from gp_ground_seg.data.semantic_kitti import read_labels, read_points
from gp_ground_seg.errors import DataError
from gp_ground_seg.evaluation.metrics import GROUNDGRID
from gp_ground_seg.plotting.perspective import plot_scan_view
from gp_ground_seg.plotting.segment import plot_segment, segment_at
from gp_ground_seg.segmenter import GroundSegmenter
from gp_ground_seg.simulation import SCENES, SENSORS, simulate_scan

SCAN = """\
Draw a scan as RViz would show the node's topics: ground, obstacles, and the ground
model as profiles with twice its standard deviation, coloured by length-scale.
"""

SCAN_EXAMPLES = """\
  gp-ground-seg plot scan 000000.bin -o scan.png
  gp-ground-seg plot scan --simulate road_then_rubble -o scan.png
  gp-ground-seg plot scan --simulate urban --sensor vlp-16 --preset vlp16 -o scan.png
"""

SEGMENT = """\
The paper's Figure 1 for any scan and segment: points, ground candidates, the lines
through them with their critical points, the inliers, and the estimated ground with
twice its standard deviation; below it the length-scale and its pseudo-inputs.
"""

SEGMENT_EXAMPLES = """\
  gp-ground-seg plot segment 000000.bin --segment 157 -o segment.png
  gp-ground-seg plot segment 000000.bin --azimuth 0 -o ahead.pdf
  gp-ground-seg plot segment velodyne/000000.bin --labels labels/000000.label \\
      --segment 157 -o segment.png

Segments are numbered counter-clockwise from straight behind.
"""


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Declare the command and its two pictures."""
    description = 'Draw a segmented scan: in perspective, or one segment from the side.'
    parser = new_parser(subparsers, 'plot', description, SCAN_EXAMPLES + SEGMENT_EXAMPLES)
    pictures = parser.add_subparsers(metavar='PICTURE', required=True)

    scan = new_parser(pictures, 'scan', SCAN, SCAN_EXAMPLES, 'a scan in perspective')
    source = scan.add_mutually_exclusive_group(required=True)
    source.add_argument('input', metavar='INPUT', nargs='?', help='KITTI scan (.bin)')
    source.add_argument('--simulate', metavar='SCENE', choices=SCENES, help=', '.join(SCENES))
    sensor = 'sensor of the simulated scan (default: %(default)s)'
    scan.add_argument('--sensor', choices=SENSORS, default='hdl-64e', help=sensor)
    seed = 'of the simulated scene (default: %(default)s)'
    scan.add_argument('--seed', metavar='N', type=int, default=0, help=seed)
    scan.set_defaults(run=run_scan)

    segment = new_parser(
        pictures, 'segment', SEGMENT, SEGMENT_EXAMPLES, 'one segment of a scan from the side'
    )
    segment.add_argument('input', metavar='INPUT', help='KITTI scan (.bin)')
    which = segment.add_mutually_exclusive_group(required=True)
    for group, option, metavar, kind, text in (
        (which, '--segment', 'M', int, 'number of the segment'),
        (which, '--azimuth', 'DEG', float, 'the one that looks there, 90 = left'),
        (segment, '--labels', 'FILE', str, 'colour the points by these labels'),
        (segment, '--max-range', 'R', float, 'range shown [m] (default: all candidates)'),
    ):
        group.add_argument(option, metavar=metavar, type=kind, help=text)
    segment.set_defaults(run=run_segment)

    for picture, kinds in ((scan, '.png'), (segment, '.png or .pdf')):
        picture.add_argument('-o', '--output', metavar='OUT', required=True, help=f'{kinds} file')
        picture.add_argument('--force', action='store_true', help='overwrite the file')
        add_config_options(picture)


def run_scan(arguments: argparse.Namespace) -> int:
    """Segment the scan and draw all of it."""
    config = config_from_options(arguments)
    if Path(arguments.output).suffix != '.png':
        raise DataError(f'{arguments.output}: must end in .png')
    _refuse_existing(arguments)
    if arguments.input is not None:
        points, title = read_points(arguments.input), Path(arguments.input).name
    elif arguments.seed < 0:
        raise DataError(f'--seed {arguments.seed}: must not be negative')
    else:
        scene, rng = (
            SCENES[arguments.simulate](arguments.seed),
            np.random.default_rng(arguments.seed),
        )
        points = simulate_scan(scene, SENSORS[arguments.sensor], rng).points
        title = f'simulated {arguments.sensor}: {arguments.simulate}'
    with closing(GroundSegmenter(config)) as segmenter:
        result = segmenter.segment(points)
    plot_scan_view(points, result, config, arguments.output, title)
    print(f'{len(points)} points, written to {arguments.output}')
    return 0


def run_segment(arguments: argparse.Namespace) -> int:
    """Segment the scan and draw one segment of it."""
    config = config_from_options(arguments)
    segment: int = arguments.segment
    if arguments.azimuth is not None:
        if not math.isfinite(arguments.azimuth):
            raise DataError(f'--azimuth {arguments.azimuth}: must be a number of degrees')
        segment = segment_at(math.radians(arguments.azimuth), config.grid.n_segments)
    _refuse_existing(arguments)
    points = read_points(arguments.input)
    truth = None
    if arguments.labels is not None:
        semantic = read_labels(arguments.labels, len(points))
        truth = GROUNDGRID.truth(semantic, points[:, 2])
    with closing(GroundSegmenter(config)) as segmenter:
        result = segmenter.segment(points)
    scan = Path(arguments.input)
    folder = scan.resolve().parent
    title = f'{folder.parent.name}/{scan.stem}' if folder.name == 'velodyne' else scan.name
    plot_segment(
        result, config, points, segment, arguments.output, truth, title, arguments.max_range
    )
    own = slice(*result.candidates.offsets[segment : segment + 2])
    pseudo = slice(*result.pseudo.offsets[segment : segment + 2])
    print(
        f'segment {segment}: {own.stop - own.start} candidates, '
        f'{int(result.surface.inlier[own].sum())} inliers, {pseudo.stop - pseudo.start} '
        f'pseudo-inputs, written to {arguments.output}'
    )
    return 0


def _refuse_existing(arguments: argparse.Namespace) -> None:
    """Refuse early, before the scan is segmented."""
    if Path(arguments.output).exists() and not arguments.force:
        raise DataError(f'{arguments.output}: exists already; --force replaces it')
