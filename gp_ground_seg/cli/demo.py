"""``demo``: the node at work, with no data at hand."""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import numpy.typing as npt

from gp_ground_seg.cli import options
from gp_ground_seg.cli.bags import scan_cloud
from gp_ground_seg.core.errors import DataError, GroundSegError
from gp_ground_seg.core.frame import Label
from gp_ground_seg.data import point_cloud2
from gp_ground_seg.data.atomic_output import staged_files
from gp_ground_seg.data.bags import BagReader, BagWriter, cloud_topic
from gp_ground_seg.data.point_cloud2 import CloudMessage, decode_cloud, encode_cloud, read_xyz
from gp_ground_seg.data.semantic_kitti import (
    labelled_frames,
    list_sequences,
    read_labels,
    read_points,
)
from gp_ground_seg.lab.plotting.scan import plot_scan_view
from gp_ground_seg.lab.plotting.style import new_figure
from gp_ground_seg.lab.scoring.metrics import GROUNDGRID, Labels, count_labels, label_ratios
from gp_ground_seg.lab.scoring.report import Column
from gp_ground_seg.lab.simulation import HDL_64E, SCENES, semantic_kitti_labels, simulate_drive
from gp_ground_seg.ros.probe import (
    GROUND,
    OBSTACLES,
    NodeProcess,
    Probe,
    probe_session,
    rate_result,
)
from gp_ground_seg.ros.start_stop import needing_ros

if TYPE_CHECKING:
    from gp_ground_seg.ros.start_stop import Session

BAG, PICTURE, LOG = 'drive.mcap', 'scan.png', 'node.log'
TOPIC = '/points'  # of the bag
FRAME_ID = 'lidar'
EPOCH = 1_700_000_000
"""Second at which every drive starts: the same drive gives the same bag."""
SEED, SPEED = 3, 8.0
"""Of the simulated drive; the second [m/s]."""
RATE = 10.0
"""Scans per second, at most if --rate is not given [Hz]."""
PATIENCE = 60.0
"""Longest time that a scan may take where --rate is not given [s]."""

DESCRIPTION = """\
Show the node at work without data: simulate a short drive along a street, write it as a bag,
start the node in a second process, send the scans of the bag to it through ROS, receive both
clouds, check that every point came back exactly once, score the labels against the truth, and
draw one scan with its errors. With --kitti it does the same on real, labelled scans.

Its topics are in a namespace of a random name: other nodes are not disturbed.
"""
EXAMPLES = f"""\
  gp-ground-seg demo
  gp-ground-seg demo --frames 100 --rate 20 --output big_demo
  gp-ground-seg demo --kitti KITTI_ROOT --sequence 08

Writes into the output folder: {BAG} (what was played), {PICTURE} (ground,
obstacles and the errors of one scan), {LOG} (what the node said).

exit code: 0, 1 if scans were lost or came back wrong, 2 for an error, 130 when
interrupted
"""


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Declare the command."""
    parser = options.new_parser(subparsers, 'demo', DESCRIPTION, EXAMPLES)
    rate = f'scans per second (default: as fast as the node answers, {RATE:g} at most)'
    options.add(
        parser,
        ('--kitti', 'folder in SemanticKITTI layout', {'metavar': 'ROOT'}),
        ('--sequence', 'sequence of it, as in 00 (default: the first)', {'metavar': 'S'}),
        ('--frames', 'scans to play, at most (default: %(default)s)',
         {**options.NUMBER, 'default': 30}),
        options.COLUMNS,
        ('--rate', rate, {'metavar': 'HZ', 'type': options.above_zero}),
        ('--output', 'folder for what is written (default: %(default)s)',
         {'metavar': 'DIR', 'default': 'demo_output'}),
        options.FORCE,
    )  # fmt: skip
    parser.set_defaults(run=run)


Scan = tuple[npt.NDArray[np.float32], npt.NDArray[np.integer], float]
"""Points (N, 4), SemanticKITTI class of each (N,), time since the start of the drive [s]."""


class Drive(NamedTuple):
    """Labelled scans, made one by one: what they are, and whose labels they have."""

    name: str
    truth: str
    n_frames: int
    scans: Iterator[Scan]


def simulated_drive(n_frames: int) -> Drive:
    """Return a drive along a street that an HDL-64E sees."""
    scans = simulate_drive(SCENES['urban'](SEED), HDL_64E, n_frames, SPEED, SEED)
    labelled = ((scan.points, semantic_kitti_labels(scan.kind), scan.time) for scan in scans)
    return Drive('Simulated street', 'the truth, which the simulator knows', n_frames, labelled)


def kitti_drive(root: str | Path, sequence: str, n_frames: int, columns: int) -> Drive:
    """Return the first labelled scans of a KITTI sequence; raise a DataError if it has none."""
    frames = labelled_frames(root, [sequence], columns)[:n_frames]

    def scans() -> Iterator[Scan]:
        for frame in frames:
            points = read_points(frame.points_path, frame.columns)
            assert frame.labels_path is not None, 'labelled_frames gives only labelled ones'
            yield points, read_labels(frame.labels_path, len(points)), frame.time

    return Drive(f'KITTI sequence {sequence}', 'the labels of SemanticKITTI', len(frames), scans())


def numbered_cloud(
    points: npt.NDArray[np.float32], semantic: npt.NDArray[np.integer], stamp: int
) -> CloudMessage:
    """Return a cloud whose points carry their class (``label``) and their number (``index``)."""
    index = np.arange(len(points), dtype=np.uint32)
    label = semantic.astype(np.uint32)
    return scan_cloud(points, stamp, FRAME_ID, label=label, index=index)


def check_scan(sent: CloudMessage, results: dict[str, CloudMessage]) -> tuple[bool, Labels]:
    """Compare a `numbered_cloud` with the clouds that came back.

    Returns whether each finite point came back once, with every byte, and nothing else did; and
    the `Label` (N,) by the cloud a point came back in.
    """
    points, clouds = point_cloud2.read_fields(sent), (results[GROUND], results[OBSTACLES])
    label = np.full(len(points), Label.UNKNOWN, dtype=np.uint8)
    for cloud in clouds:
        names = ('header', 'fields', 'point_step', 'is_bigendian')
        is_whole = len(cloud.data) == cloud.height * cloud.width * cloud.point_step
        if not is_whole or any(getattr(sent, name) != getattr(cloud, name) for name in names):
            return False, label
    ground, obstacles = map(point_cloud2.read_fields, clouds)
    for value, part in ((Label.GROUND, ground), (Label.OBSTACLE, obstacles)):
        label[part['index'][part['index'] < len(points)]] = value
    back = np.concatenate([ground, obstacles])
    back = back[np.argsort(back['index'], kind='stable')]
    finite = np.isfinite(read_xyz(sent)).all(axis=1)
    return back.tobytes() == points[finite].tobytes(), label


class Tally:
    """Sums over the scans of the given `stamps` that came back."""

    def __init__(self, stamps: Sequence[tuple[int, int]]) -> None:
        self._numbers = {stamp: k for k, stamp in enumerate(stamps)}
        self.n_points = self.n_faulty = 0
        self.counts = Counter[str]()
        # Middle scan or nearest before it: number, places (N, 3), labels and true labels.
        self.picture: tuple[int, npt.NDArray[np.floating], Labels, Labels] | None = None

    def add(self, sent: CloudMessage, results: dict[str, CloudMessage]) -> None:
        """Check a scan that came back, and add it."""
        number = self._numbers[point_cloud2.stamp_of(sent)]
        is_exact, label = check_scan(sent, results)
        xyz = read_xyz(sent)
        truth = GROUNDGRID.truth(point_cloud2.read_fields(sent)['label'], xyz[:, 2])
        self.n_points += int(np.isfinite(xyz).all(axis=1).sum())
        self.n_faulty += not is_exact
        self.counts.update(count_labels(label, truth))
        if self.picture is None or number <= len(self._numbers) // 2:
            self.picture = number, xyz, label, truth


def result_text(
    tally: Tally, result: dict[str, Any], n_stray: int, truth: str
) -> tuple[str, bool]:
    """Return the result in plain words, and whether all scans came back as they should."""
    wanted, scores = result['asked'], label_ratios(tally.counts)
    is_exact = not (tally.n_faulty or n_stray)
    partition = 'each is in exactly one of the two clouds, not a byte changed'
    if not is_exact:
        partition = f'not so in {tally.n_faulty} scans; {n_stray} clouds too many'
    iou, precision, recall = (
        f'{100.0 * value:.2f} %'
        for value in (scores['iou'], scores['precision'], scores['recall'])
    )
    lines = [
        f'scans    {result["n_sent"]} sent, {result["n_back"]} back, {result["n_lost"]} lost',
        f'points   {Column("", "_d").show(tally.n_points)} of these scans: {partition}',
        f'labels   ground IoU {iou}, precision {precision}, recall {recall} (against {truth})',
        f'latency  median {1e3 * result["p50"]:.1f} ms, 99 % within {1e3 * result["p99"]:.1f} ms, '
        'from sending a scan to having both clouds',
        f'rate     {result["sent"]:.1f} scans per second sent, {wanted:g} were wanted',
    ]
    if result['n_lost']:
        line = f'FAILED: {result["n_lost"]} of {result["n_sent"]} scans were lost'
        if result['p50'] > 1.0 / wanted:
            line += '; this machine is too slow for that rate, try a lower --rate'
        lines.append(line)
    if not is_exact:
        lines.append('FAILED: the two clouds are not the scan that was sent; this is a bug')
    return '\n'.join(lines), is_exact and not result['n_lost']


def run(arguments: argparse.Namespace) -> int:
    """Run the demo."""
    new_figure(1.0, 1.0)  # where it cannot draw, it says so before the drive
    sequence = arguments.sequence
    if arguments.kitti is not None:
        sequence = sequence or list_sequences(arguments.kitti)[0]
        columns = options.columns_of(arguments)
        drive = kitti_drive(arguments.kitti, sequence, arguments.frames, columns)
    elif sequence is not None:
        raise DataError(f'--sequence {sequence}: goes with --kitti ROOT')
    else:
        options.refuse_columns(arguments, 'a simulated one')
        drive = simulated_drive(arguments.frames)
    folder = Path(arguments.output)
    options.note_leftovers(folder)
    with (
        needing_ros('the demo'),
        probe_session('demo') as (session, words),
        staged_files(folder, (BAG, PICTURE, LOG), force=arguments.force) as part,
        NodeProcess(part / LOG, words) as node,
    ):
        tally = Tally(_write(drive, part / BAG, session))
        print('[2/3] connecting to the node, whose code is compiled at a first start', flush=True)
        probe = Probe(session, tally.add)
        probe.connect(node)
        result = _play(part / BAG, drive.n_frames, arguments.rate, probe)
        node.check()
        if tally.picture is None:
            raise GroundSegError(f'no scan came back; the node said:\n{node.log_tail()}')
        number, xyz, label, truth = tally.picture
        title = f'{drive.name}, scan {number + 1} of {drive.n_frames}'
        counts = plot_scan_view(xyz, label, part / PICTURE, title, truth=truth)
    text, is_good = result_text(tally, result, probe.n_stray, drive.truth)
    print(f'\n{text}\n')
    print(f'picture  {folder / PICTURE}  scan {number + 1}: {counts}')
    print(f'bag      {folder / BAG}  what was played; `gp-ground-seg play` plays it again')
    return 0 if is_good else 1


def _write(drive: Drive, path: Path, session: Session) -> list[tuple[int, int]]:
    """Write the drive as a bag; return the stamps of its scans."""
    scans = options.count(drive.n_frames, 'scan')
    print(f'[1/3] writing {scans} as a bag: {drive.name}; meanwhile the node starts', flush=True)
    stamps = []
    with options.progress('scans')(total=drive.n_frames) as bar, BagWriter(path) as bag:
        bag.add_topic(cloud_topic(TOPIC))
        for points, semantic, seconds in drive.scans:
            stamp = EPOCH * 10**9 + round(seconds * 1e9)
            bag.write(TOPIC, stamp, encode_cloud(numbered_cloud(points, semantic, stamp)))
            stamps.append(divmod(stamp, 10**9))
            session.check()
            bar.update()
    return stamps


def _play(path: Path, n_frames: int, wanted: float | None, probe: Probe) -> dict[str, Any]:
    """Send the scans of a bag to the node; return the statistics of `rate_result`."""
    rate, patience = wanted or RATE, None if wanted else PATIENCE
    pace = f'{rate:g} scans per second{"" if wanted else " at most"}'
    print(f'[3/3] playing the bag to the node, {pace}, and receiving both clouds', flush=True)
    with BagReader(path) as bag, options.progress('scans')(total=n_frames) as bar:
        clouds = (decode_cloud(raw) for _, _, raw in bag.messages([TOPIC]))
        return rate_result(rate, probe.send(clouds, rate, bar.update, patience))
