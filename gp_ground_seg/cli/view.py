"""``view``: segmented scans to turn and scrub through, in Rerun or as a page."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

from gp_ground_seg.cli import options
from gp_ground_seg.data.atomic_output import staged_file
from gp_ground_seg.data.inputs import Input, Inputs, list_inputs
from gp_ground_seg.errors import DataError, PointCloudError
from gp_ground_seg.result import Segmentation
from gp_ground_seg.segmenter import GroundSegmenter
from gp_ground_seg.viewers.html_page import write_page
from gp_ground_seg.viewers.rerun_view import Recording, web_viewer
from gp_ground_seg.viewers.scene import Scene, View, make_scene, read_view

DESCRIPTION = """\
Look at segmented scans: points by class, height over the ground or probability, the
surface with its 2-sigma band and its length-scales, vertical faces, candidates and
inliers; over the frames IoU and objects lost (where labels are at hand), theta and latency.

INPUT is whatever `segment` takes: a scan, a folder of scans, a sequence, a bag. Labels of
SemanticKITTI are found beside its scans.

Without --save, --web or --html it opens Rerun's own viewer. --web listens on this
machine only, until Ctrl-C; from another: ssh -L.
"""
EXAMPLES = """\
  gp-ground-seg view KITTI_ROOT/sequences/00          scrub through a sequence
  gp-ground-seg view drive.mcap --frame-step 5        every fifth cloud of a bag
  gp-ground-seg view 000000.bin --labels 000000.label
  gp-ground-seg view drive.mcap --web                 in the browser
  gp-ground-seg view drive.mcap --save drive.rrd      later: rerun drive.rrd
  gp-ground-seg view drive.mcap --frame 40 --html scan.html

needs: pip install 'gp_ground_seg[view]'
"""


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Declare the command."""
    parser = options.new_parser(subparsers, 'view', DESCRIPTION, EXAMPLES)
    add_input(parser)
    number = {'metavar': 'N', 'type': options.positive}
    options.add(
        parser,
        ('--frame-step', 'only every N-th frame (default: 1)', {**number, 'default': 1}),
        ('--port', 'of --web (default: a free one)', {**number, 'default': 0}),
        options.QUIET,
    )
    options.add(
        parser.add_mutually_exclusive_group(),
        ('--save', 'write a recording for Rerun (.rrd)', {'metavar': 'FILE'}),
        ('--web', 'serve the web viewer, and print its address', options.FLAG),
        ('--html', 'write one frame as a page that opens from disk', {'metavar': 'FILE'}),
    )
    parser.set_defaults(run=run)


def add_input(parser: argparse.ArgumentParser) -> None:
    """Add what the scans are, and the parameters."""
    frame = {'metavar': 'N', 'type': int}
    options.add(
        parser,
        ('input', 'scan, folder of scans, sequence or bag', {'metavar': 'INPUT'}),
        ('--labels', 'SemanticKITTI labels of the points, or their folder', {'metavar': 'PATH'}),
        ('--frame', 'number of one frame, from 0', frame),
        ('--topic', 'PointCloud2 topic of a bag (default: the only one)', {'metavar': 'T'}),
        *options.SCAN_LAYOUT,
        options.FORCE,
    )
    options.add_config(parser)


def open_input(arguments: argparse.Namespace) -> Inputs:
    """Return the frames; DataError if there are none, or not the one asked for."""
    layout = options.scan_layout(arguments)
    inputs = list_inputs(arguments.input, layout, arguments.topic)
    if inputs.topic is not None:
        options.refuse_scan_layout(arguments, arguments.input)
    if arguments.frame is not None and not 0 <= arguments.frame < len(inputs):
        last = len(inputs) - 1
        raise DataError(f'--frame {arguments.frame}: {arguments.input} has frames 0 to {last}')
    return inputs


def run(arguments: argparse.Namespace) -> int:
    """Segment the frames, and show them."""
    inputs, config = open_input(arguments), options.read_config(arguments)
    with closing(GroundSegmenter(config)) as segmenter:
        frames = _frames(inputs, arguments, segmenter)
        if arguments.html:
            _check_suffix(arguments.html, '.html')
            arguments.frame = arguments.frame or 0
            _, view, scene, _ = next(frames)
            write_page(arguments.html, scene, view.name, config, arguments.force)
            print(f'{view.name}, written to {arguments.html}')
        elif arguments.save:
            _check_suffix(arguments.save, '.rrd')
            with staged_file(arguments.save, force=arguments.force) as part:
                recording = Recording(Path(arguments.input).name)
                recording.stream.save(part)
                n_frames = _send(recording, frames)
                recording.stream.disconnect()
            print(f'{options.count(n_frames, "frame")}, written to {arguments.save}')
        elif arguments.web:
            with web_viewer(arguments.port) as (server, address, sink):
                recording = Recording(Path(arguments.input).name)
                recording.stream.connect_grpc(sink)
                print(f'{address}\nCtrl-C ends it.', flush=True)
                try:
                    _send(recording, frames)
                    server.wait()
                finally:
                    # First, or rerun says that the server has gone.
                    recording.stream.disconnect()
                raise DataError('the web viewer ended')
        else:
            if sys.platform == 'linux' and not {'DISPLAY', 'WAYLAND_DISPLAY'} & os.environ.keys():
                raise DataError('no display here: --web, --save or --html need none')
            recording = Recording(Path(arguments.input).name)
            recording.stream.spawn()
            _send(recording, frames)
            recording.stream.disconnect()
    return 0


def _check_suffix(path: str, suffix: str) -> None:
    if Path(path).suffix.lower() != suffix:
        raise DataError(f'{path}: must end in {suffix}')


_Frame = tuple[int, View, Scene, Segmentation]


def _frames(
    inputs: Inputs, arguments: argparse.Namespace, segmenter: GroundSegmenter
) -> Iterator[_Frame]:
    """Segment the frames asked for, each with its number."""
    step, one = arguments.frame_step, arguments.frame
    n_frames = len(range(0, len(inputs), step)) if one is None else 1
    with options.progress('view', quiet=arguments.quiet)(total=n_frames) as bar:
        pairs = enumerate(inputs) if one is None else [(one, inputs[one])]
        for k, item in pairs:
            if one is None and k % step:
                continue
            view = read_view(item, arguments.labels)
            try:
                if k == (one or 0):
                    # Once without counting: code is loaded, or even compiled.
                    segmenter.segment(view.points)
                    segmenter.reset()
                result = segmenter.segment(view.points)
            except PointCloudError as error:
                raise DataError(f'{item.title}: {error}') from error
            yield k, view, make_scene(view, result, segmenter.config, segmenter.backend), result
            bar.update()


def _send(recording: Recording, frames: Iterator[_Frame]) -> int:
    """Log the frames, and return their number."""
    n_frames = 0
    for n_frames, (k, view, scene, result) in enumerate(frames, 1):
        recording.log(k, scene, result, view.scores(result))
    return n_frames
