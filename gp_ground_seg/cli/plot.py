"""``plot``: pictures of a segmented scan: in perspective, from above, one segment of it."""

from __future__ import annotations

import argparse
import math
from contextlib import closing
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from gp_ground_seg.cli import options
from gp_ground_seg.data.semantic_kitti import read_labels, read_points
from gp_ground_seg.errors import DataError
from gp_ground_seg.evaluation.metrics import GROUNDGRID, Labels
from gp_ground_seg.parameters.config import Config
from gp_ground_seg.plotting.scan import plot_birds_eye, plot_scan_view
from gp_ground_seg.plotting.segment import plot_segment, segment_at
from gp_ground_seg.result import Segmentation
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

ABOVE = """\
Draw a scan from above: ground and obstacles; with --labels the errors beside it.
"""

ABOVE_EXAMPLES = """\
  gp-ground-seg plot above velodyne/000000.bin --labels labels/000000.label -o errors.png
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
    """Declare the command and its pictures."""
    description = 'Draw a segmented scan: in perspective, from above, or one segment of it.'
    examples = SCAN_EXAMPLES + ABOVE_EXAMPLES + SEGMENT_EXAMPLES
    parser = options.new_parser(subparsers, 'plot', description, examples)
    pictures = parser.add_subparsers(metavar='PICTURE', required=True)
    number: dict[str, Any] = {'metavar': 'N', 'type': int}
    scan = ('input', 'KITTI scan (.bin)', {'metavar': 'INPUT'})
    labels = ('--labels', 'SemanticKITTI labels of the points', {'metavar': 'FILE'})

    view = options.new_parser(pictures, 'scan', SCAN, SCAN_EXAMPLES, 'a scan in perspective')
    options.add(
        view.add_mutually_exclusive_group(required=True),
        (*scan[:2], {'metavar': 'INPUT', 'nargs': '?'}),
        ('--simulate', ', '.join(SCENES), {'metavar': 'SCENE', 'choices': SCENES}),
    )
    sensor = 'sensor of the simulated scan (default: %(default)s)'
    options.add(
        view,
        ('--sensor', sensor, {'choices': SENSORS, 'default': 'hdl-64e'}),
        ('--seed', 'of the simulated scene (default: %(default)s)', {**number, 'default': 0}),
    )
    above = options.new_parser(
        pictures, 'above', ABOVE, ABOVE_EXAMPLES, 'a scan and its errors from above'
    )
    options.add(above, scan, labels)

    segment = options.new_parser(
        pictures, 'segment', SEGMENT, SEGMENT_EXAMPLES, 'a segment from the side'
    )
    metres, degrees = {'metavar': 'R', 'type': float}, {'metavar': 'DEG', 'type': float}
    shown = ('--max-range', 'range shown [m] (default: all candidates)', metres)
    options.add(segment, scan, labels, shown)
    options.add(
        segment.add_mutually_exclusive_group(required=True),
        ('--segment', 'number of the segment', number),
        ('--azimuth', 'the one that looks there, 90 = left', degrees),
    )
    for picture, draw, endings in (
        (view, _draw_view, ('.png',)),
        (above, _draw_above, ('.png',)),
        (segment, _draw_segment, ('.png', '.pdf')),
    ):
        output = {'metavar': 'OUT', 'required': True}
        options.add(
            picture, ('-o --output', f'{" or ".join(endings)} file', output), options.FORCE
        )
        options.add_config(picture)
        picture.set_defaults(run=run, draw=draw, endings=endings)


class Segmented(NamedTuple):
    """A scan, its name, its true labels if known, parameters and result."""

    points: npt.NDArray[np.float32]
    title: str
    truth: Labels | None
    config: Config
    result: Segmentation


def run(arguments: argparse.Namespace) -> int:
    """Segment the scan and draw it."""
    config = options.read_config(arguments)
    path = Path(arguments.output)
    if path.suffix.lower() not in arguments.endings:
        raise DataError(f'{path}: must end in {" or ".join(arguments.endings)}')
    if path.exists() and not arguments.force:
        raise DataError(f'{path}: exists already; --force replaces it')
    points, title = _simulate(arguments) if arguments.input is None else _read(arguments.input)
    truth = None
    if getattr(arguments, 'labels', None) is not None:
        truth = GROUNDGRID.truth(read_labels(arguments.labels, len(points)), points[:, 2])
    with closing(GroundSegmenter(config)) as segmenter:
        result = segmenter.segment(points)
    said = arguments.draw(arguments, Segmented(points, title, truth, config, result))
    print(f'{said}, written to {path}')
    return 0


def _read(path: str) -> tuple[npt.NDArray[np.float32], str]:
    """Points of a file, and its name as in ``00/000005``."""
    scan = Path(path)
    folder = scan.resolve().parent
    title = f'{folder.parent.name}/{scan.stem}' if folder.name == 'velodyne' else scan.name
    return read_points(scan), title


def _simulate(arguments: argparse.Namespace) -> tuple[npt.NDArray[np.float32], str]:
    if arguments.seed < 0:
        raise DataError(f'--seed {arguments.seed}: must not be negative')
    scene, rng = SCENES[arguments.simulate], np.random.default_rng(arguments.seed)
    points = simulate_scan(scene(arguments.seed), SENSORS[arguments.sensor], rng).points
    return points, f'simulated {arguments.sensor}: {arguments.simulate}'


def _draw_view(arguments: argparse.Namespace, scan: Segmented) -> str:
    plot_scan_view(scan.points, scan.result, scan.config, arguments.output, scan.title)
    return f'{len(scan.points)} points'


def _draw_above(arguments: argparse.Namespace, scan: Segmented) -> str:
    plot_birds_eye(scan.points, scan.result.label, arguments.output, scan.truth, scan.title)
    return f'{len(scan.points)} points'


def _draw_segment(arguments: argparse.Namespace, scan: Segmented) -> str:
    segment, result = arguments.segment, scan.result
    if arguments.azimuth is not None:
        if not math.isfinite(arguments.azimuth):
            raise DataError(f'--azimuth {arguments.azimuth}: must be a number of degrees')
        segment = segment_at(math.radians(arguments.azimuth), scan.config.grid.n_segments)
    plot_segment(
        result, scan.config, scan.points, segment, arguments.output, scan.truth, scan.title,
        arguments.max_range,
    )  # fmt: skip
    own, pseudo = (
        slice(*offsets[segment : segment + 2])
        for offsets in (result.candidates.offsets, result.pseudo.offsets)
    )
    return (
        f'segment {segment}: {own.stop - own.start} candidates, '
        f'{int(result.surface.inlier[own].sum())} inliers, {pseudo.stop - pseudo.start} '
        'pseudo-inputs'
    )
