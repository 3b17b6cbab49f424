"""``view``: segmented scans to turn and scrub through; ``tune``: parameters by sliders."""

from __future__ import annotations

import argparse
import importlib.util
import os
import sys
from collections.abc import Iterator
from itertools import islice
from pathlib import Path

from gp_ground_seg.cli import options
from gp_ground_seg.core.errors import DataError, PointCloudError, shown
from gp_ground_seg.core.parameters.config import Config
from gp_ground_seg.core.parameters.export import to_yaml
from gp_ground_seg.core.parameters.schema import NODE_NAME
from gp_ground_seg.core.result import Segmentation
from gp_ground_seg.core.segmenter import GroundSegmenter
from gp_ground_seg.data.atomic_output import staged_file
from gp_ground_seg.data.inputs import Inputs
from gp_ground_seg.lab.viewers.html_page import open_server, write_page
from gp_ground_seg.lab.viewers.rerun_view import Recording, open_viewer, web_viewer
from gp_ground_seg.lab.viewers.scene import View, make_scene, read_view
from gp_ground_seg.lab.viewers.tuner import Tuner, tunable

VIEW = """\
Look at segmented scans in Rerun: points by class, height or probability, the surface with
its 2-sigma band and length-scales, vertical faces, candidates and inliers; over the frames
IoU and objects lost (with labels, as SemanticKITTI has them) and latency; theta is recorded.

INPUT is what `segment` takes. --web serves to this machine only, until Ctrl-C.
"""
VIEW_EXAMPLES = """\
  gp-ground-seg view KITTI_ROOT/sequences/00           move through a sequence
  gp-ground-seg view drive.mcap --frame-step 5 --web   every fifth cloud, in the browser
  gp-ground-seg view drive.mcap --save drive.rrd       for later: rerun drive.rrd
  gp-ground-seg view 000000.bin --labels 000000.label --html scan.html

needs the packages rerun-sdk, and viser for --html (docs/install.md)
"""
TUNE = """\
Show a scan in the browser, with sliders and boxes for the parameters. Labels follow at once,
and points that change their class have a colour. With labels of SemanticKITTI, IoU and objects
lost are shown too. Buttons write the parameters as YAML and, with ROS, set them in a running
node. The page is served to this machine only. Ctrl-C stops it.
"""
TUNE_EXAMPLES = """\
  gp-ground-seg tune 000000.bin
  gp-ground-seg tune KITTI_ROOT/sequences/00 --frame 5 -o kitti.yaml
  gp-ground-seg tune drive.mcap --parameters label.ground_tolerance,faces.cell_size
  gp-ground-seg tune drive.mcap --node /front/ground_segmentation_node

needs the package viser (docs/install.md)
"""


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Declare the commands."""
    view = options.new_parser(subparsers, 'view', VIEW, VIEW_EXAMPLES)
    tune = options.new_parser(subparsers, 'tune', TUNE, TUNE_EXAMPLES)
    number, file = options.NUMBER, {'metavar': 'FILE'}
    for parser, run in ((view, run_view), (tune, run_tune)):
        options.add(
            parser,
            ('input', 'scan, folder of scans, sequence or bag', {'metavar': 'INPUT'}),
            ('--labels', 'SemanticKITTI labels of a scan (default: those beside it)', file),
            ('--frame', 'number of one frame, from 0', {'metavar': 'N', 'type': int}),
            (
                '--port',
                'of the page, or the next free one (default: %(default)s)',
                {**number, 'default': 9090},
            ),
            *options.CLOUDS,
            options.FORCE,
            options.QUIET,
        )
        options.add_config(parser)
        parser.set_defaults(run=run)
    options.add(
        view, ('--frame-step', 'only every N-th frame (default: 1)', {**number, 'default': 1})
    )
    options.add(
        view.add_mutually_exclusive_group(),
        ('--save', 'write a recording (.rrd)', file),
        ('--web', 'serve the web viewer, and print its address', options.FLAG),
        ('--html', 'write one frame as a page (.html) that opens from disk', file),
    )
    specs = tunable()
    basic = [spec.name for spec in specs if spec.basic]
    names = options.some_of(spec.name for spec in specs)
    options.add(
        tune,
        ('--parameters', 'those to show (default: the basic ones)',
         {'metavar': 'NAME,NAME', 'type': names, 'default': basic}),
        ('-o --output', 'file to write (default: %(default)s)', {**file, 'default': 'tuned.yaml'}),
        ('--node', 'node to set (default: %(default)s)',
         {'metavar': 'NAME', 'default': f'/{NODE_NAME}'}),
    )  # fmt: skip


def run_view(arguments: argparse.Namespace) -> int:
    """Segment the frames, and show them."""
    inputs, config = options.list_clouds(arguments), options.read_config(arguments)
    target = arguments.html or arguments.save
    suffix = '.html' if arguments.html else '.rrd'
    if target and Path(target).suffix.lower() != suffix:
        raise DataError(f'{target}: must end in {suffix}')
    with GroundSegmenter(config) as segmenter:
        if arguments.html:
            arguments.frame = arguments.frame or 0
            ((_, view, result),) = _frames(inputs, arguments, segmenter)
            scene = make_scene(view, result, config, segmenter.backend)
            write_page(target, scene, view.title, config, arguments.force)
        elif arguments.save:
            with staged_file(target, force=arguments.force) as part:
                recording = Recording(shown(inputs.path.name))
                recording.stream.save(part)
                _record(recording, inputs, arguments, segmenter)
        elif arguments.web:
            with web_viewer(arguments.port) as (server, address, sink):
                recording = Recording(shown(inputs.path.name))
                recording.stream.connect_grpc(sink)
                print(f'{address}\nCtrl-C ends it.', flush=True)
                _record(recording, inputs, arguments, segmenter)
                server.wait()
            raise DataError('the web viewer has ended')
        elif sys.platform == 'linux' and not {'DISPLAY', 'WAYLAND_DISPLAY'} & os.environ.keys():
            raise DataError('no display here: --web, --save FILE and --html FILE need none')
        else:
            recording = Recording(shown(inputs.path.name))
            recording.stream.connect_grpc(open_viewer())
            _record(recording, inputs, arguments, segmenter)
    if target:
        print(f'written to {shown(target)}')
    return 0


def _record(
    recording: Recording, inputs: Inputs, arguments: argparse.Namespace, segmenter: GroundSegmenter
) -> None:
    try:
        for k, view, result in _frames(inputs, arguments, segmenter):
            scene = make_scene(view, result, segmenter.config, segmenter.backend)
            recording.log(k, scene, result, view.scores(result.label))
    finally:
        # All is sent, before a file gets its name or a server ends.
        recording.stream.disconnect()


def _frames(
    inputs: Inputs, arguments: argparse.Namespace, segmenter: GroundSegmenter
) -> Iterator[tuple[int, View, Segmentation]]:
    """Segment the frames asked for, each with its number."""
    first, step = arguments.frame or 0, arguments.frame_step
    numbers = range(first, len(inputs) if arguments.frame is None else first + 1, step)
    bar = options.progress('view', quiet=arguments.quiet)(total=len(numbers))
    with bar:
        chosen = islice(inputs, numbers.start, numbers.stop, step)
        for k, item in zip(numbers, chosen, strict=True):
            view = read_view(item, arguments.labels)
            try:
                if k == first:
                    # Once without counting its time, in which code is loaded.
                    segmenter.segment(view.points)
                    segmenter.reset()
                yield k, view, segmenter.segment(view.points)
            except PointCloudError as error:
                raise DataError(f'{item.title}: {error}') from error
            bar.update()


def run_tune(arguments: argparse.Namespace) -> int:
    """Serve the page."""
    inputs, config = options.list_clouds(arguments), options.read_config(arguments)
    output, is_ours = Path(arguments.output), arguments.force
    if output.exists() and not is_ours:
        raise DataError(f'{output}: exists already; --force replaces it')

    def write(values: Config) -> str:
        nonlocal is_ours
        with staged_file(output, force=is_ours) as part:
            part.write_text(to_yaml(values, 'Found with gp-ground-seg tune.'), encoding='utf-8')
        is_ours = True
        return f'written to {output}'

    def apply(values: Config) -> str:
        from gp_ground_seg.ros.parameters import set_remotely

        set_remotely(arguments.node, {name: values[name] for name in arguments.parameters})
        return f'{arguments.node} uses them'

    with open_server(arguments.port) as (server, address):
        begin = arguments.parameters, arguments.labels, arguments.frame or 0
        tuner = Tuner(server, inputs, config, *begin)
        tuner.add_button(f'write {output.name}', write)
        if importlib.util.find_spec('rclpy'):
            tuner.add_button(f'apply to {arguments.node}', apply)
        print(f'{address}\nCtrl-C ends it.', flush=True)
        tuner.run()
    return 0
