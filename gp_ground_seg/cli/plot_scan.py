"""``plot-scan``: a segmented scan in perspective."""

from __future__ import annotations

import argparse
from contextlib import closing
from pathlib import Path

import numpy as np
import numpy.typing as npt

from gp_ground_seg.cli.options import add_config_options, config_from_options
from gp_ground_seg.data.semantic_kitti import read_points
from gp_ground_seg.errors import DataError
from gp_ground_seg.plotting.scan_view import plot_scan_view
from gp_ground_seg.segmenter import GroundSegmenter
from gp_ground_seg.simulation import SCENES, SENSORS, simulate_scan

DESCRIPTION = """\
Draw a scan as RViz would show the node's topics: ground, obstacles, and the ground
model as profiles with twice its standard deviation, coloured by length-scale.
"""

EXAMPLES = """\
examples:
  gp-ground-seg plot-scan 000000.bin -o scan.png
  gp-ground-seg plot-scan --simulate road_then_rubble -o scan.png
  gp-ground-seg plot-scan --simulate urban --sensor vlp-16 --preset vlp16 -o scan.png
"""


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Declare the command."""
    parser = subparsers.add_parser(
        'plot-scan',
        description=DESCRIPTION,
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    source = parser.add_mutually_exclusive_group(required=True)
    source.add_argument('input', metavar='INPUT', nargs='?', help='KITTI scan (.bin)')
    source.add_argument('--simulate', metavar='SCENE', choices=SCENES, help=', '.join(SCENES))
    parser.add_argument(
        '--sensor',
        choices=SENSORS,
        default='hdl-64e',
        help='sensor of the simulated scan (default: %(default)s)',
    )
    parser.add_argument(
        '--seed', metavar='N', type=int, default=0, help='of the simulated scene (default: 0)'
    )
    parser.add_argument('-o', '--output', metavar='OUT', required=True, help='.png file')
    parser.add_argument('--force', action='store_true', help='overwrite the file')
    add_config_options(parser)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Segment the scan and draw."""
    config = config_from_options(arguments)
    if Path(arguments.output).suffix != '.png':
        raise DataError(f'{arguments.output}: must end in .png')
    if Path(arguments.output).exists() and not arguments.force:
        raise DataError(f'{arguments.output}: exists already; --force replaces it')
    points, title = _scan(arguments)
    with closing(GroundSegmenter(config)) as segmenter:
        result = segmenter.segment(points)
    plot_scan_view(points, result, config, arguments.output, title)
    print(f'{len(points)} points, written to {arguments.output}')
    return 0


def _scan(arguments: argparse.Namespace) -> tuple[npt.NDArray[np.float32], str]:
    """Points, and what they are."""
    if arguments.input is not None:
        return read_points(arguments.input), Path(arguments.input).name
    if arguments.seed < 0:
        raise DataError(f'--seed {arguments.seed}: must not be negative')
    scan = simulate_scan(
        SCENES[arguments.simulate](arguments.seed),
        SENSORS[arguments.sensor],
        np.random.default_rng(arguments.seed),
    )
    return scan.points, f'simulated {arguments.sensor}: {arguments.simulate}'
