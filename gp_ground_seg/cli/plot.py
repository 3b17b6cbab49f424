"""``plot``: pictures of a segmented scan: in perspective, from above, one segment of it."""

from __future__ import annotations

import argparse
import math
from contextlib import closing
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from gp_ground_seg.cli import options
from gp_ground_seg.core.errors import DataError
from gp_ground_seg.core.parameters.config import Config
from gp_ground_seg.core.result import Segmentation
from gp_ground_seg.core.segmenter import GroundSegmenter
from gp_ground_seg.data.semantic_kitti import read_labels
from gp_ground_seg.lab.plotting.scan import (
    VALUES,
    Scene,
    View,
    plot_birds_eye,
    plot_scan_view,
    plot_sheet,
    write_movie,
)
from gp_ground_seg.lab.plotting.segment import plot_segment, segment_at
from gp_ground_seg.lab.scoring.metrics import GROUNDGRID
from gp_ground_seg.lab.simulation import SCENES, SENSORS, simulate_scan

SCAN = """\
Draw a scan as RViz would show the node's topics: ground, obstacles, and the ground
model, with profiles of twice its standard deviation, coloured by length-scale.
"""
SCAN_EXAMPLES = """\
  gp-ground-seg plot scan 000000.bin -o scan.png
  gp-ground-seg plot scan drive.mcap --frame 20 -o scan.png
  gp-ground-seg plot scan --simulate road_then_rubble -o scan.png
  gp-ground-seg plot scan --simulate urban --sensor vlp-16 --colour height -o scan.svg
  gp-ground-seg plot scan 000000.bin --camera 90,30,40 -o from_the_left.pdf
  gp-ground-seg plot scan --sheet -o scenes.png             one panel per simulated scene
"""

DRIVE = """\
Draw clouds of a bag, sequence or folder as `plot scan` does, one after the other, as a movie.
"""
DRIVE_EXAMPLES = """\
  gp-ground-seg plot drive drive.mcap -o drive.gif
  gp-ground-seg plot drive KITTI_ROOT/sequences/00 --frames 30 --colour p_ground -o drive.gif
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
    examples = SCAN_EXAMPLES + DRIVE_EXAMPLES + ABOVE_EXAMPLES + SEGMENT_EXAMPLES
    parser = options.new_parser(subparsers, 'plot', description, examples)
    pictures = parser.add_subparsers(metavar='PICTURE', required=True, dest='picture')
    number: dict[str, Any] = {'metavar': 'N', 'type': int}
    scan = ('input', 'scan, folder of scans, or bag', {'metavar': 'INPUT'})
    labels = ('--labels', 'SemanticKITTI labels of the points', {'metavar': 'FILE'})

    view = options.new_parser(pictures, 'scan', SCAN, SCAN_EXAMPLES, 'a scan in perspective')
    options.add(
        view.add_mutually_exclusive_group(required=True),
        (*scan[:2], {'metavar': 'INPUT', 'nargs': '?'}),
        ('--simulate', ', '.join(SCENES), {'metavar': 'SCENE', 'choices': SCENES}),
        ('--sheet', 'all these scenes, each in a panel', options.FLAG),
    )
    sensor = 'sensor of the simulated scan (default: %(default)s)'
    options.add(
        view,
        ('--sensor', sensor, {'choices': SENSORS, 'default': 'hdl-64e'}),
        ('--seed', 'of the simulated scene (default: %(default)s)', {**number, 'default': 0}),
    )
    drive = options.new_parser(pictures, 'drive', DRIVE, DRIVE_EXAMPLES, 'clouds as a movie')
    options.add(
        drive,
        ('input', 'bag, sequence, or folder of scans', {'metavar': 'INPUT'}),
        ('--frames', 'the first N clouds only', options.NUMBER),
        ('--fps', 'clouds per second (default: %(default)s)', {**options.NUMBER, 'default': 10}),
        options.QUIET,
    )
    camera = {'metavar': 'AZIMUTH,ELEVATION,DISTANCE', 'type': _camera, 'default': View()}
    for picture in (view, drive):
        options.add(
            picture,
            ('--camera', 'where it stands, seen from the middle of the scene: counter-clockwise '
             'from ahead [deg], upwards [deg], away [m] (default: 196,24,32)', camera),
            ('--colour', 'colour points by class, or by the height over the ground or the '
             'probability of ground', {'choices': ('class', *VALUES), 'default': 'class'}),
        )  # fmt: skip
    purpose = 'a scan and its errors from above'
    above = options.new_parser(pictures, 'above', ABOVE, ABOVE_EXAMPLES, purpose)
    options.add(above, scan, labels)

    purpose = 'a segment from the side'
    segment = options.new_parser(pictures, 'segment', SEGMENT, SEGMENT_EXAMPLES, purpose)
    metres, degrees = {'metavar': 'R', 'type': float}, {'metavar': 'DEG', 'type': float}
    shown = ('--max-range', 'range shown [m] (default: all candidates)', metres)
    options.add(segment, scan, labels, shown)
    options.add(
        segment.add_mutually_exclusive_group(required=True),
        ('--segment', 'number of the segment', number),
        ('--azimuth', 'the one that looks there, 90 = left', degrees),
    )
    for picture in (view, drive, above, segment):
        endings = ('.gif',) if picture is drive else ('.png', '.pdf', '.svg')
        output = (f'{" or ".join(endings)} file', {'metavar': 'OUT', 'required': True})
        if picture is not drive:
            which = {**number, 'default': 0}
            options.add(picture, ('--frame', 'which of several, from 0 (default: 0)', which))
        options.add(picture, ('-o --output', *output), *options.CLOUDS, options.FORCE)
        options.add_config(picture)
        picture.set_defaults(run=run, endings=endings)


def run(arguments: argparse.Namespace) -> int:
    """Segment the scan and draw it."""
    config = options.read_config(arguments)
    path = Path(arguments.output)
    if path.suffix.lower() not in arguments.endings:
        raise DataError(f'{path}: must end in {" or ".join(arguments.endings)}')
    if path.exists() and not arguments.force:
        raise DataError(f'{path}: exists already; --force replaces it')
    with closing(GroundSegmenter(config)) as segmenter:
        if arguments.picture == 'drive' or getattr(arguments, 'sheet', False):
            said = _draw_scenes(arguments, config, segmenter)
        else:
            said = _draw_scan(arguments, config, segmenter)
    print(f'{said}, written to {path}')
    return 0


def _draw_scan(arguments: argparse.Namespace, config: Config, segmenter: GroundSegmenter) -> str:
    path = arguments.output
    simulated = arguments.input is None
    points, title = _simulate(arguments, arguments.simulate) if simulated else _read(arguments)
    truth = None
    if getattr(arguments, 'labels', None) is not None:
        truth = GROUNDGRID.truth(read_labels(arguments.labels, len(points)), points[:, 2])
    result = segmenter.segment(points)
    if arguments.picture == 'scan':
        view = arguments.camera._replace(colour=arguments.colour)
        return plot_scan_view(points, result, config, path, title, view)
    if arguments.picture == 'above':
        return plot_birds_eye(points, result.label, path, truth, title)
    segment, reach = _segment_number(arguments, config), arguments.max_range
    plot_segment(result, config, points, segment, path, truth, title, reach)
    return _segment_counts(result, segment)


def _draw_scenes(arguments: argparse.Namespace, config: Config, segmenter: GroundSegmenter) -> str:
    """Draw all simulated scenes on a sheet, or the clouds of the input as a movie."""
    path, view = arguments.output, arguments.camera._replace(colour=arguments.colour)
    bar = options.progress('plot', quiet=getattr(arguments, 'quiet', False))
    if arguments.picture == 'scan':
        clouds = ((name, _simulate(arguments, name)[0]) for name in bar(list(SCENES)))
        scenes = (Scene(name, points, segmenter.segment(points)) for name, points in clouds)
        plot_sheet(scenes, len(SCENES), config, path, view)
        return f'{len(SCENES)} scenes'
    inputs = options.list_clouds(arguments)
    n_clouds = min(len(inputs), arguments.frames or len(inputs))
    chosen = bar(islice(inputs, n_clouds), total=n_clouds)
    clouds = ((one.title, one.read().xyz) for one in chosen)
    scenes = (Scene(title, points, segmenter.segment(points)) for title, points in clouds)
    write_movie(scenes, config, path, view, arguments.fps)
    return options.count(n_clouds, 'cloud')


def _camera(text: str) -> View:
    """Read azimuth, elevation and distance; straight from above no side of a picture is up."""
    try:
        azimuth, elevation, distance = map(float, text.split(','))
    except ValueError:
        azimuth = elevation = distance = math.nan
    if not (abs(azimuth) <= 360.0 and abs(elevation) <= 89.0 and 1.0 <= distance <= 1000.0):
        wanted = 'azimuth within 360 and elevation within 89 degrees, distance 1 to 1000 m'
        raise argparse.ArgumentTypeError(f'{text!r}: must be {wanted}, as in 90,30,40')
    return View.around(azimuth, elevation, distance)


def _read(arguments: argparse.Namespace) -> tuple[npt.NDArray[np.floating], str]:
    """Points of a scan, and its name as in ``00/000005``."""
    scan = options.list_clouds(arguments)[arguments.frame]
    folder = Path(str(scan.path)).resolve().parent
    title = f'{folder.parent.name}/{scan.name}' if folder.name == 'velodyne' else scan.title
    return scan.read().xyz, title


def _simulate(arguments: argparse.Namespace, name: str) -> tuple[npt.NDArray[np.floating], str]:
    options.refuse_scan_layout(arguments, 'a simulated one')
    if arguments.seed < 0:
        raise DataError(f'--seed {arguments.seed}: must not be negative')
    scene, rng = SCENES[name], np.random.default_rng(arguments.seed)
    points = simulate_scan(scene(arguments.seed), SENSORS[arguments.sensor], rng).points
    return points, f'simulated {arguments.sensor}: {name}'


def _segment_number(arguments: argparse.Namespace, config: Config) -> int:
    if arguments.azimuth is None:
        return int(arguments.segment)
    if not math.isfinite(arguments.azimuth):
        raise DataError(f'--azimuth {arguments.azimuth}: must be a number of degrees')
    return segment_at(math.radians(arguments.azimuth), config.grid.n_segments)


def _segment_counts(result: Segmentation, segment: int) -> str:
    own, pseudo = (
        slice(*offsets[segment : segment + 2])
        for offsets in (result.candidates.offsets, result.pseudo.offsets)
    )
    return (
        f'segment {segment}: {own.stop - own.start} candidates, '
        f'{int(result.surface.inlier[own].sum())} inliers, {pseudo.stop - pseudo.start} '
        'pseudo-inputs'
    )
