"""``demo``: see it work, with no data at hand."""

from __future__ import annotations

import argparse
import importlib.util
import math
import time
from pathlib import Path
from typing import TYPE_CHECKING

from gp_ground_seg.cli.demo_frames import (
    TOPIC,
    Drive,
    WrittenDrive,
    kitti_drive,
    simulated_drive,
    write_drive,
)
from gp_ground_seg.cli.demo_node import NodeProcess, private_network
from gp_ground_seg.cli.demo_tally import OUTPUTS, Tally
from gp_ground_seg.cli.demo_text import result_text, thousands
from gp_ground_seg.cli.output import count, progress_bar
from gp_ground_seg.cli.play import needing_ros, positive, summary
from gp_ground_seg.data.atomic_output import staged_files
from gp_ground_seg.data.bags import BagReader
from gp_ground_seg.data.point_cloud2 import decode_cloud
from gp_ground_seg.data.semantic_kitti import list_sequences
from gp_ground_seg.errors import DataError, GroundSegError, MissingDependencyError
from gp_ground_seg.plotting.birds_eye import plot_birds_eye
from gp_ground_seg.ros.transport import large_cloud_transport

if TYPE_CHECKING:
    from gp_ground_seg.ros.receiver import OutputReceiver
    from gp_ground_seg.ros.session import Session

BAG, PICTURE, LOG = 'drive.mcap', 'birds_eye.png', 'node.log'
DEFAULT_FRAMES = 30
SEED = 3
RATE = 10.0
"""Scans per second [Hz]."""
MAX_LOAD, COMFORTABLE_LOAD = 0.9, 0.7
"""Share of the time that the node may need: above the first it is given more."""
N_TRIALS = 5
TRIAL_TIMEOUT = 60.0
"""Longest time one scan may take [s]."""
EXIT_FAILED = 1
START_TIMEOUT = 300.0
"""Time the node has to start; where it compiles on a slow machine that is minutes [s]."""
SILENCE = 5.0
"""Time without a cloud after which what is still missing is lost [s]."""

DESCRIPTION = """\
See it work, with no data at hand: simulate a short drive along a street, write it
as a bag, start the node in a second process, play the bag to it through ROS, receive
both clouds, check that every point came back exactly once, score the labels against
the truth, and draw one scan from above. With --kitti the same on real, labelled scans.

Nothing leaves this machine: the demo has a ROS domain of its own.
"""

EXAMPLES = f"""\
examples:
  gp-ground-seg demo
  gp-ground-seg demo --frames 100 --rate 20 --output big_demo
  gp-ground-seg demo --kitti KITTI_ROOT --sequence 08

Writes into the output folder: {BAG} (what was played), {PICTURE}, {LOG}.
exit code: 0, 1 if a scan was lost or a point did not come back as it should, 2 for an
error, 130 when interrupted
"""


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Declare the command."""
    parser = subparsers.add_parser(
        'demo',
        description=DESCRIPTION,
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument('--kitti', metavar='ROOT', help='folder in SemanticKITTI layout')
    parser.add_argument(
        '--sequence', metavar='S', help='sequence of it, as in 00 (default: the first)'
    )
    parser.add_argument(
        '--frames',
        metavar='N',
        type=_positive_integer,
        default=DEFAULT_FRAMES,
        help=f'scans to play, at most (default: {DEFAULT_FRAMES})',
    )
    parser.add_argument(
        '--rate',
        metavar='HZ',
        type=positive,
        help=f'scans per second (default: {RATE:g}, as most LiDARs; less if this machine is '
        'too slow for that)',
    )
    parser.add_argument(
        '--output',
        metavar='DIR',
        default='demo_output',
        help='folder for what is written (default: demo_output)',
    )
    parser.add_argument('--force', action='store_true', help='replace the files of another demo')
    parser.set_defaults(run=run)


def _positive_integer(text: str) -> int:
    if not text.isdecimal() or int(text) == 0:
        raise argparse.ArgumentTypeError(f'{text!r}: must be a whole number, at least 1')
    return int(text)


def run(arguments: argparse.Namespace) -> int:
    """Run the demo."""
    if importlib.util.find_spec('matplotlib') is None:
        # Said now, not after everything else is done.
        raise MissingDependencyError(
            "the demo draws with matplotlib: pip install 'gp_ground_seg[plot]'"
        )
    with needing_ros('the demo'):
        from gp_ground_seg.ros.session import ros_session

    drive = _choose_drive(arguments)
    folder = Path(arguments.output)
    with (
        staged_files(folder, (BAG, PICTURE, LOG), force=arguments.force) as part,
        private_network(),
        large_cloud_transport(),
        ros_session('demo') as session,
        NodeProcess(part / LOG, ('-r', f'points:={TOPIC}'), session.holding_back) as node,
    ):
        written = _write(drive, part / BAG, session)
        tally = Tally(shown=drive.n_frames // 2)
        receiver = _connect(session, node, tally)
        with BagReader(part / BAG) as bag:
            rate = arguments.rate or _sustainable_rate(bag, receiver)
            _play(bag, rate, written.period, session, tally)
        node.check()
        tally.look()
        if tally.picture is None:
            raise GroundSegError(
                f'none of {count(tally.n_sent, "scan")} came back; the last words of the node:\n'
                f'{node.log_tail()}'
            )
        plot_birds_eye(
            tally.picture.points,
            tally.picture.label,
            part / PICTURE,
            truth=tally.picture.truth,
            title=f'{drive.name}, scan {tally.picture_number + 1} of {drive.n_frames}',
        )
    print(f'\n{result_text(tally, rate, drive.truth)}\n')
    print(f'picture  {folder / PICTURE}  one of the scans from above, and the errors in it')
    print(f'bag      {folder / BAG}  what was played; `gp-ground-seg play` plays it again')
    return 0 if tally.n_lost == 0 and tally.is_partition_exact else EXIT_FAILED


def _choose_drive(arguments: argparse.Namespace) -> Drive:
    sequence = arguments.sequence
    if arguments.kitti is None:
        if sequence is not None:
            raise DataError(f'--sequence {sequence}: goes with --kitti ROOT')
        return simulated_drive(arguments.frames, SEED)
    if sequence is None:
        sequence = list_sequences(arguments.kitti)[0]
    return kitti_drive(arguments.kitti, sequence, arguments.frames)


def _write(drive: Drive, path: Path, session: Session) -> WrittenDrive:
    scans = count(drive.n_frames, 'scan')
    _step(1, f'writing {scans} as a bag: {drive.description}; meanwhile the node starts')
    start = time.monotonic()
    with progress_bar(drive.n_frames, quiet=False, title='scans') as bar:

        def progress() -> None:
            session.check()
            bar.update()

        written = write_drive(drive, path, progress)
    seconds = time.monotonic() - start
    points, size = thousands(written.n_points), written.n_bytes / 1e6
    _detail(f'{points} points, {size:.0f} MB, took {seconds:.1f} s')
    return written


def _connect(session: Session, node: NodeProcess, tally: Tally) -> OutputReceiver:
    from gp_ground_seg.ros.receiver import OutputReceiver

    _step(2, 'connecting to the node, a second process (it compiles when it runs the first time)')
    start = time.monotonic()
    receiver = OutputReceiver(session, OUTPUTS, tally.arrived)
    receiver.connect(TOPIC, START_TIMEOUT, node.check)
    _detail(f'it answered after {time.monotonic() - start:.1f} s')
    return receiver


def _sustainable_rate(bag: BagReader, receiver: OutputReceiver) -> float:
    """Return the usual rate [Hz], or what this machine can do if that is less."""
    _, _, first = next(bag.messages([TOPIC]))
    seconds = receiver.time_answer(TOPIC, decode_cloud(first), N_TRIALS, TRIAL_TIMEOUT)
    if seconds < MAX_LOAD / RATE:
        return RATE
    # Of the next lower numbers of one digit.
    rate = COMFORTABLE_LOAD / seconds
    unit = 10.0 ** math.floor(math.log10(rate))
    rate = min(RATE, math.floor(round(rate / unit, 6)) * unit)
    _detail(
        f'a scan takes {1e3 * seconds:.0f} ms here and now: playing {rate:g} per second '
        f'instead of {RATE:g}'
    )
    return rate


def _play(bag: BagReader, rate: float, period: float, session: Session, tally: Tally) -> None:
    """Play scans that are `period` apart [s] at `rate` [Hz]; receive until all are back."""
    from gp_ground_seg.ros.player import Player, PlayOptions

    _step(3, f'playing the bag to the node, {rate:g} scans per second, and receiving both clouds')
    with progress_bar(bag.n_messages(TOPIC), quiet=False, title='scans') as bar:

        def spin(seconds: float) -> None:
            session.spin(seconds)
            bar.update(tally.n_back - bar.n)

        player = Player(session.node, bag, [TOPIC], spin, PlayOptions(rate=rate * period))
        player.wait_for_subscribers(SILENCE)
        player.play(tally.sent)
        n_back, last_news = tally.n_back, time.monotonic()
        while tally.n_lost and time.monotonic() < last_news + SILENCE:
            spin(SILENCE / 100.0)
            if tally.n_back > n_back:
                n_back, last_news = tally.n_back, time.monotonic()
    _detail(summary(player.report()))


def _step(number: int, text: str) -> None:
    print(f'[{number}/3] {text}', flush=True)


def _detail(text: str) -> None:
    print(f'      {text}', flush=True)
