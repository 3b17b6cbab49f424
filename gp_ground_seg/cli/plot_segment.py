"""``plot-segment``: one segment of a scan from the side."""

from __future__ import annotations

import argparse
import math
from contextlib import closing
from pathlib import Path

from gp_ground_seg.cli.options import add_config_options, config_from_options
from gp_ground_seg.data.semantic_kitti import read_labels, read_points
from gp_ground_seg.errors import DataError
from gp_ground_seg.evaluation.metrics import GROUNDGRID
from gp_ground_seg.plotting.segment_profile import plot_segment, segment_at
from gp_ground_seg.segmenter import GroundSegmenter

DESCRIPTION = """\
The paper's Figure 1 for any scan and segment: points, ground candidates, the lines
through them with their critical points, the inliers, and the estimated ground with
twice its standard deviation; below it the length-scale and its pseudo-inputs.
"""

EXAMPLES = """\
examples:
  gp-ground-seg plot-segment 000000.bin --segment 157 -o segment.png
  gp-ground-seg plot-segment 000000.bin --azimuth 0 -o ahead.pdf
  gp-ground-seg plot-segment velodyne/000000.bin --labels labels/000000.label \\
      --segment 157 -o segment.png

Segments are numbered counter-clockwise from straight behind.
"""


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Declare the command."""
    parser = subparsers.add_parser(
        'plot-segment',
        description=DESCRIPTION,
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument('input', metavar='INPUT', help='KITTI scan (.bin)')
    which = parser.add_mutually_exclusive_group(required=True)
    which.add_argument('--segment', metavar='M', type=int, help='number of the segment')
    which.add_argument(
        '--azimuth', metavar='DEG', type=float, help='the one that looks there, 90 = left'
    )
    parser.add_argument('-o', '--output', metavar='OUT', required=True, help='.png or .pdf file')
    parser.add_argument('--labels', metavar='FILE', help='colour the points by these labels')
    parser.add_argument(
        '--max-range', metavar='R', type=float, help='range shown [m] (default: all candidates)'
    )
    parser.add_argument('--force', action='store_true', help='overwrite the file')
    add_config_options(parser)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Segment the scan and draw."""
    config = config_from_options(arguments)
    segment: int = arguments.segment
    if arguments.azimuth is not None:
        if not math.isfinite(arguments.azimuth):
            raise DataError(f'--azimuth {arguments.azimuth}: must be a number of degrees')
        segment = segment_at(math.radians(arguments.azimuth), config.grid.n_segments)
    if Path(arguments.output).exists() and not arguments.force:
        raise DataError(f'{arguments.output}: exists already; --force replaces it')
    points = read_points(arguments.input)
    truth = None
    if arguments.labels is not None:
        semantic = read_labels(arguments.labels, len(points))
        truth = GROUNDGRID.truth(semantic, points[:, 2])
    with closing(GroundSegmenter(config)) as segmenter:
        result = segmenter.segment(points)
    plot_segment(
        result,
        config,
        points,
        segment,
        arguments.output,
        truth,
        title=_title(Path(arguments.input)),
        max_range=arguments.max_range,
    )
    own = slice(*result.candidates.offsets[segment : segment + 2])
    pseudo = slice(*result.pseudo.offsets[segment : segment + 2])
    print(
        f'segment {segment}: {own.stop - own.start} candidates, '
        f'{int(result.surface.inlier[own].sum())} inliers, {pseudo.stop - pseudo.start} '
        f'pseudo-inputs, written to {arguments.output}'
    )
    return 0


def _title(scan: Path) -> str:
    """Sequence and frame where the folders say so, else the file's name."""
    folder = scan.resolve().parent
    return f'{folder.parent.name}/{scan.stem}' if folder.name == 'velodyne' else scan.name
