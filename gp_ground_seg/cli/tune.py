"""``tune``: parameters by sliders, and the labels of a scan next to them."""

import argparse
import shlex
from pathlib import Path

from gp_ground_seg.cli import options
from gp_ground_seg.core.parameters.config import Config
from gp_ground_seg.core.parameters.schema import NODE_NAME
from gp_ground_seg.data.files import check_writable, write_file
from gp_ground_seg.lab.tuner import Tuner, open_server, tunable

DESCRIPTION = """\
Show a scan in the browser, with sliders for the parameters. Labels follow at once,
and points that change their class have a colour. With labels of SemanticKITTI, IoU and objects
lost are shown too. A button writes the parameters as YAML, and shows the command that loads the
file into a running node. The page is served to this machine only. Ctrl-C stops it.
"""
EXAMPLES = """\
  gp-ground-seg tune 000000.bin
  gp-ground-seg tune KITTI_ROOT/sequences/00 --frame 5 -o kitti.yaml
  gp-ground-seg tune drive.mcap --parameters sensor.height,faces.cell_size

needs the package viser (docs/install.md)
"""


def add_parser(subparsers: options.Subparsers) -> None:
    """Declare the command."""
    file, specs = {'metavar': 'FILE'}, tunable()
    basic = [spec.name for spec in specs if spec.basic]
    names = options.some_of(spec.name for spec in specs)
    options.command(
        subparsers, 'tune', DESCRIPTION, EXAMPLES,
        ('input', 'scan, folder of scans, sequence or bag', {'metavar': 'INPUT'}),
        ('--labels', 'SemanticKITTI labels of a scan (default: those next to it)', file),
        ('--frame', 'number of the first frame to show, from 0',
         {**options.whole(0), 'default': 0}),
        ('--port', 'of the page, or the next free one (default: %(default)s)',
         {**options.NUMBER, 'default': 9090}),
        ('--parameters', 'those to show (default: the basic ones)',
         {'metavar': 'NAME,NAME', 'type': names, 'default': basic}),
        ('-o --output', 'file to write (default: %(default)s)', {**file, 'default': 'tuned.yaml'}),
        *options.CLOUDS, options.FORCE, options.QUIET, *options.CONFIG, run=run,
    )  # fmt: skip


def run(arguments: argparse.Namespace) -> int:
    """Serve the page."""
    inputs, config = options.list_clouds(arguments), options.read_config(arguments)
    output, is_ours = Path(arguments.output), arguments.force
    check_writable(output, force=is_ours)
    load = f'ros2 param load /{NODE_NAME} {shlex.quote(str(output))}'

    def write(values: Config) -> str:
        nonlocal is_ours
        text = values.to_yaml('Found with gp-ground-seg tune.')
        write_file(output, text.encode(), force=is_ours)
        is_ours = True
        return f'written to {output}; a running node takes it by {load}'

    with open_server(arguments.port) as (server, address):
        begin = arguments.parameters, arguments.labels, arguments.frame
        tuner = Tuner(server, inputs, config, *begin)
        tuner.add_button(f'write {output.name}', write)
        print(f'{address}\nCtrl-C ends it.', flush=True)
        tuner.run()
    return 0
