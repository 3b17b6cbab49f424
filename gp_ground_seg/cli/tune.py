"""``tune``: parameters by sliders in the browser, labels that follow at once."""

from __future__ import annotations

import argparse
import importlib.util
from pathlib import Path

from gp_ground_seg.cli import options
from gp_ground_seg.cli.view import add_input, open_input
from gp_ground_seg.data.atomic_output import staged_file
from gp_ground_seg.errors import DataError
from gp_ground_seg.parameters.config import Config
from gp_ground_seg.parameters.export import to_yaml
from gp_ground_seg.parameters.schema import NODE_NAME
from gp_ground_seg.viewers.html_page import open_server
from gp_ground_seg.viewers.tuner import Tuner, tunable

DESCRIPTION = """\
A scan in the browser, with a slider for each basic parameter: its labels follow at once,
and what has changed is coloured. With labels (--labels, or those beside the scans of
SemanticKITTI) IoU and objects lost follow too.

INPUT is whatever `segment` takes: a scan, a folder of scans, a sequence, a bag; a slider
goes through the frames. The page is served to this machine only, until Ctrl-C; from
another: ssh -L. A button writes the parameters as YAML, for every command and the node;
where ROS runs, another sets them in a node that runs.
"""
EXAMPLES = """\
  gp-ground-seg tune 000000.bin
  gp-ground-seg tune KITTI_ROOT/sequences/00 --frame 5 --output kitti.yaml
  gp-ground-seg tune drive.mcap --config my.yaml --parameters label.ground_tolerance,grid.r_max
  gp-ground-seg tune drive.mcap --node /front/ground_segmentation_node

needs: pip install 'gp_ground_seg[tune]'
"""


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Declare the command."""
    parser = options.new_parser(subparsers, 'tune', DESCRIPTION, EXAMPLES)
    add_input(parser)
    specs = tunable()
    options.add(
        parser,
        ('--parameters', 'those to show (default: the basic ones)',
         {'metavar': 'NAME,NAME', 'type': options.some_of(spec.name for spec in specs),
          'default': [spec.name for spec in specs if spec.basic]}),
        ('-o --output', 'file that the button writes (default: %(default)s)',
         {'metavar': 'FILE', 'default': 'tuned.yaml'}),
        ('--node', 'node that the other button sets (default: %(default)s)',
         {'metavar': 'NAME', 'default': f'/{NODE_NAME}'}),
        ('--port', 'of the page (default: a free one)',
         {'metavar': 'N', 'type': options.positive, 'default': 0}),
    )  # fmt: skip
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Serve the page."""
    inputs, config = open_input(arguments), options.read_config(arguments)
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

    with open_server(arguments.port, 'tune') as server:
        tuner = Tuner(
            server, inputs, config, arguments.parameters, arguments.labels, arguments.frame or 0
        )
        tuner.add_action(f'write {output.name}', write)
        if importlib.util.find_spec('rclpy'):
            tuner.add_action(f'apply to {arguments.node}', apply)
        print(f'http://{server.get_host()}:{server.get_port()}\nCtrl-C ends it.', flush=True)
        tuner.run()
    return 0
