"""``demo``: the node at work, with no data at hand."""

import argparse
import sys
import time
from collections import Counter
from pathlib import Path

import numpy as np

from gp_ground_seg.cli import options
from gp_ground_seg.core.errors import GroundSegError, in_thousands
from gp_ground_seg.core.frame import Label
from gp_ground_seg.data import bags
from gp_ground_seg.data.files import check_writable
from gp_ground_seg.data.point_cloud2 import CloudMessage, read_fields, read_xyz
from gp_ground_seg.lab.plotting import new_figure, plot_scan_view
from gp_ground_seg.lab.scoring.metrics import Labels, count_labels, label_ratios, true_labels
from gp_ground_seg.lab.simulation import HDL_64E, SCENES, SEMANTIC_KITTI, simulate_scan
from gp_ground_seg.ros.node_process import GROUND, OBSTACLES, Link, NodeProcess, private_session
from gp_ground_seg.ros.session import Session, needing_ros

BAG, PICTURE, LOG = 'drive.mcap', 'scan.png', 'node.log'
TOPIC = '/points'  # of the bag
FRAME_ID = 'lidar'
EPOCH = 1_700_000_000  # second at which every drive starts: the same drive gives the same bag
SEED, SPEED = 3, 8.0  # seed and speed [m/s] of the simulated drive
LABELS = {GROUND: Label.GROUND, OBSTACLES: Label.OBSTACLE}  # label of the points on each topic
PERIOD = 0.1  # time of a turn of the sensor; scans are sent no faster [s]
LAST_LINES = 20  # of the node's log, printed when the demo fails

DESCRIPTION = f"""\
Show the node at work without data: simulate a short drive along a street, write it as a bag,
start the node in a second process, send the scans of the bag to it through ROS, receive both
clouds, score the labels against the truth, and draw the last with its errors. A scan is sent
when the last one is back, at most {1.0 / PERIOD:g} in a second.

Its topics are in a namespace of a random name: other nodes are not disturbed.
"""
EXAMPLES = f"""\
  gp-ground-seg demo
  gp-ground-seg demo --frames 100 --output big_demo

Writes into the output folder: {BAG} (what was played), {PICTURE} (ground,
obstacles and the errors of the last scan), {LOG} (what the node said).

exit code: 0, 1 if points were lost, 2 for an error, 130 when interrupted
"""


def add_parser(subparsers: options.Subparsers) -> None:
    """Declare the command."""
    options.command(
        subparsers, 'demo', DESCRIPTION, EXAMPLES,
        ('--frames', 'scans to play (default: %(default)s)', {**options.NUMBER, 'default': 30}),
        ('--output', 'folder for what is written (default: %(default)s)',
         {'metavar': 'DIR', 'default': 'demo_output'}),
        options.FORCE, run=run,
    )  # fmt: skip


class Tally:
    """Sums over scans, and the labels of the last of them."""

    def __init__(self) -> None:
        self.n_sent = self.n_back = 0
        self.counts = Counter[str]()
        self.latencies: list[float] = []
        self.n_compiled = 0

    def add(
        self, sent: CloudMessage, back: dict[str, CloudMessage], latency: float, is_compiled: bool
    ) -> None:
        """Add a scan and what came back of it, `latency` [s] later, by compiled code or not."""
        self.latencies.append(latency)
        self.n_compiled += is_compiled
        self.xyz = np.concatenate([read_xyz(cloud) for cloud in back.values()])
        parts = [np.full(cloud.width, LABELS[topic]) for topic, cloud in back.items()]
        self.label: Labels = np.concatenate(parts).astype(np.uint8)
        semantic = np.concatenate([read_fields(cloud)['label'] for cloud in back.values()])
        self.truth = true_labels(semantic)
        self.n_sent += int(np.isfinite(read_xyz(sent)).all(axis=1).sum())
        self.n_back += len(self.xyz)
        self.counts.update(count_labels(self.label, self.truth))

    def summary(self) -> str:
        """Return the result in plain words."""
        ratios, scores = label_ratios(self.counts), ('iou', 'precision', 'recall')
        iou, precision, recall = (f'{100.0 * ratios[name]:.2f} %' for name in scores)
        p50, p99 = 1e3 * np.percentile(self.latencies, [50, 99])
        lines = [
            f'points   {in_thousands(self.n_sent)} in {len(self.latencies)} scans sent, '
            f'{in_thousands(self.n_back)} back',
            f'labels   ground IoU {iou}, precision {precision}, recall {recall} against the truth',
            f'latency  median {p50:.1f} ms, 99 % within {p99:.1f} ms, from sending a scan to '
            'having both clouds',
            f'backend  numpy for {len(self.latencies) - self.n_compiled} scans, compiled code for '
            f'{self.n_compiled}',
        ]
        if self.n_sent != self.n_back:
            lines.append('FAILED: each point must come back once; this is a bug')
        return '\n'.join(lines)


def run(arguments: argparse.Namespace) -> int:
    """Run the demo."""
    new_figure(1.0, 1.0)  # where it cannot draw, it says so before the drive
    n_frames, folder = arguments.frames, Path(arguments.output)
    with needing_ros('the demo'), private_session('demo') as (session, words):
        folder.mkdir(exist_ok=True)
        for name in (BAG, PICTURE, LOG):
            check_writable(folder / name, force=arguments.force)
        with NodeProcess(folder / LOG, words) as node:
            _write(n_frames, folder / BAG, session)
            try:
                with bags.BagReader(folder / BAG) as bag:
                    tally = _play(bag, n_frames, session, node)
            except GroundSegError as error:
                print('the last lines of the log of the node:', *node.log_lines()[-LAST_LINES:],
                      sep='\n  ', file=sys.stderr)  # fmt: skip
                raise GroundSegError(
                    f'{error}; {folder} has the bag and the log; try again with --force: what was '
                    'compiled is kept'
                ) from error
        title = f'Simulated street, scan {n_frames}'
        path = folder / PICTURE
        counts = plot_scan_view(tally.xyz, tally.label, path, title, truth=tally.truth)
    print(f'\n{tally.summary()}\n')
    print(f'picture  {path}  scan {n_frames}: {counts}')
    print(f'bag      {folder / BAG}  what was played; `gp-ground-seg play` plays it again')
    return 0 if tally.n_sent == tally.n_back else 1


def _write(n_frames: int, path: Path, session: Session) -> None:
    """Write the drive as a bag."""
    scans = f'{options.count(n_frames, "scan")} of a simulated street'
    print(f'[1/3] writing {scans} as a bag; meanwhile the node starts', flush=True)
    scene, rng = SCENES['urban'](SEED), np.random.default_rng(SEED)
    with bags.new_bag(path, {TOPIC: bags.POINT_CLOUD2}, force=True) as write:
        for k in options.progress('scans')(range(n_frames)):
            scan = simulate_scan(scene, HDL_64E, rng, x=SPEED * k * PERIOD)
            stamp = EPOCH * 10**9 + round(k * PERIOD * 1e9)
            label = SEMANTIC_KITTI[scan.kind]
            cloud = bags.cloud_from_points(scan.points, stamp, FRAME_ID, label=label)
            write(TOPIC, stamp, bags.encode_cloud(cloud))
            session.check()


def _play(bag: bags.BagReader, n_frames: int, session: Session, node: NodeProcess) -> Tally:
    """Send the scans of a bag to the node."""
    print('[2/3] connecting to the node', flush=True)
    link = Link(session, node)
    link.connect(bags.decode_cloud(next(bag.messages([TOPIC]))[2]))
    print('[3/3] sending the scans to the node, and receiving both clouds', flush=True)
    tally = Tally()
    for _, _, raw in options.progress('scans')(bag.messages([TOPIC]), total=n_frames):
        cloud, started = bags.decode_cloud(raw), time.monotonic()
        back = link.ask(cloud)
        tally.add(cloud, back, time.monotonic() - started, node.is_compiled())
        session.sleep(max(0.0, started + PERIOD - time.monotonic()))
    return tally
