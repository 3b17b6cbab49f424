"""``play``: the clouds of a bag, published as they were recorded."""

from __future__ import annotations

import argparse
import contextlib
import math
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

from gp_ground_seg.cli.notes import note
from gp_ground_seg.cli.output import count, progress_bar
from gp_ground_seg.data.bags import BagReader
from gp_ground_seg.errors import GroundSegError, MissingDependencyError
from gp_ground_seg.ros.transport import large_cloud_transport

if TYPE_CHECKING:
    from gp_ground_seg.ros.player import Player, PlayReport

NODE_NAME = 'bag_player'
OWN_PACKAGE = 'gp_ground_seg'
EXIT_UNDELIVERED = 1
SILENT_WAIT = 1.0
"""Time without a subscriber after which that is said [s]."""

DESCRIPTION = """\
Publish the point clouds of a bag (ROS 1 .bag, rosbag2 folder, .mcap, .db3) on
their topic, byte for byte, at the times they were recorded.

Offered reliably: a reliable subscriber gets every cloud. Waits for a subscriber
before it starts. Only PointCloud2 topics are played; for TF and the rest use
`ros2 bag play`.

In the end one line tells
  late         clouds sent more than 20 ms after their time
  undelivered  clouds that nobody was there for, or that some reliable subscriber
               has not acknowledged. A subscriber too slow to process what its
               middleware acknowledged loses it all the same: that is in its own
               /diagnostics.
"""

EXAMPLES = """\
examples:
  gp-ground-seg play drive.mcap
  gp-ground-seg play drive.mcap --clock --rate 0.5 --start 10 --duration 5
  gp-ground-seg play drive.mcap --loop --ros-args -r /kitti/velo/pointcloud:=/points

exit code: 0, 1 if clouds were not delivered (always 0 with --no-wait), 2 for an error,
130 when interrupted
"""


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Declare the command; what follows ``--ros-args`` is left to ROS."""
    parser = subparsers.add_parser(
        'play',
        description=DESCRIPTION,
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument('bag', metavar='BAG', help='bag to play')
    which = parser.add_mutually_exclusive_group()
    which.add_argument(
        '--topic',
        metavar='T',
        action='append',
        help='PointCloud2 topic to play (may be repeated; default: the only one)',
    )
    which.add_argument('--all', action='store_true', help='play all PointCloud2 topics')
    parser.add_argument(
        '--rate',
        metavar='R',
        type=positive,
        default=1.0,
        help='speed, 2 = twice as fast as recorded (default: 1)',
    )
    parser.add_argument('--loop', action='store_true', help='begin again at the end, until Ctrl-C')
    parser.add_argument(
        '--clock',
        action='store_true',
        help="publish the bag's time on /clock, 50 times a second (for use_sim_time)",
    )
    parser.add_argument(
        '--start', metavar='S', type=not_negative, default=0.0, help='skip the first S seconds'
    )
    parser.add_argument('--duration', metavar='S', type=positive, help='play S seconds only')
    waiting = parser.add_mutually_exclusive_group()
    waiting.add_argument(
        '--wait',
        metavar='S',
        type=not_negative,
        help='give up when there is no subscriber within S seconds (default: wait for ever)',
    )
    waiting.add_argument(
        '--no-wait', action='store_true', help='start at once, whether anybody listens or not'
    )
    parser.add_argument('--quiet', action='store_true', help='no progress bar, no notes')
    parser.set_defaults(run=run, accepts_ros_args=True)


def positive(text: str) -> float:
    """Read an option's number that must be above 0."""
    number = not_negative(text)
    if number == 0.0:
        raise argparse.ArgumentTypeError(f'{text}: must be above 0')
    return number


def not_negative(text: str) -> float:
    """Read an option's number that must be at least 0."""
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not (math.isfinite(number) and number >= 0.0):
        raise argparse.ArgumentTypeError(f'{text!r}: must be a number, at least 0')
    return number


@contextlib.contextmanager
def needing_ros(command: str) -> Iterator[None]:
    """Turn a failed import of ROS within the block into a MissingDependencyError."""
    try:
        yield
    except ImportError as error:
        if isinstance(error, GroundSegError) or (error.name or '').startswith(OWN_PACKAGE):
            raise
        raise MissingDependencyError(
            f'{command} needs ROS 2, which cannot be imported ({error}): source the setup '
            "file of a ROS 2 installation, or pip install 'gp_ground_seg[ros]'"
        ) from error


def run(arguments: argparse.Namespace) -> int:
    """Play the bag."""
    with needing_ros('play'):
        from gp_ground_seg.ros.player import Player, PlayOptions
        from gp_ground_seg.ros.session import ros_session

    options = PlayOptions(
        rate=arguments.rate,
        start=arguments.start,
        duration=arguments.duration,
        loop=arguments.loop,
        clock=arguments.clock,
    )
    with BagReader(arguments.bag) as bag:
        topics = _choose_topics(bag, arguments)
        if not arguments.quiet:
            _note_what_is_not_played(bag, topics)
        with large_cloud_transport(), ros_session(NODE_NAME, arguments.ros_args) as session:
            player = Player(session.node, bag, topics, session.sleep, options)
            if not arguments.no_wait:
                _wait_for_subscribers(player, arguments)
            report = _play(player, bag, topics, arguments)
    return EXIT_UNDELIVERED if report.n_undelivered and not arguments.no_wait else 0


def summary(report: PlayReport) -> str:
    """Return one line on how the playing went."""
    from gp_ground_seg.ros.player import LATE

    rate = '' if report.rate is None else f' ({report.rate:.2f} Hz)'
    return (
        f'{count(report.n_sent, "cloud")} sent in {report.seconds:.1f} s{rate}, '
        f'{report.n_late} more than {1e3 * LATE:.0f} ms late (worst '
        f'{1e3 * report.worst_delay:.1f} ms), '
        f'{report.n_undelivered} undelivered'
    )


def _choose_topics(bag: BagReader, arguments: argparse.Namespace) -> list[str]:
    if arguments.all:
        topics = [name for name in bag.point_cloud_topics if bag.n_messages(name)]
        return topics or [bag.pick_point_cloud_topic()]
    if arguments.topic:
        return [bag.pick_point_cloud_topic(name) for name in dict.fromkeys(arguments.topic)]
    return [bag.pick_point_cloud_topic()]


def _note_what_is_not_played(bag: BagReader, topics: Sequence[str]) -> None:
    others = [f'{name} ({kind})' for name, kind in bag.topics.items() if name not in topics]
    if others:
        note(f'not played: {", ".join(others)}')


def _wait_for_subscribers(player: Player, arguments: argparse.Namespace) -> None:
    limit: float | None = arguments.wait
    if player.wait_for_subscribers(SILENT_WAIT if limit is None else min(limit, SILENT_WAIT)):
        return
    lonely = ', '.join(player.topics_without_subscriber())
    if limit is None or limit > SILENT_WAIT:
        if not arguments.quiet:
            note(f'waiting for a subscriber of {lonely}')
        if player.wait_for_subscribers(None if limit is None else limit - SILENT_WAIT):
            return
        lonely = ', '.join(player.topics_without_subscriber())
    raise GroundSegError(
        f'no subscriber of {lonely} within {limit:g} s; --no-wait plays without one'
    )


def _play(
    player: Player, bag: BagReader, topics: Sequence[str], arguments: argparse.Namespace
) -> PlayReport:
    n_clouds = sum(bag.n_messages(topic) for topic in topics)
    try:
        # Where the end is not known there is no bar towards it, only a count.
        with progress_bar(
            0 if arguments.loop else n_clouds, quiet=arguments.quiet, title='play'
        ) as bar:
            player.play(lambda *_cloud: bar.update())
    finally:
        # After an interrupt, too: with --loop it is the only end.
        report = player.report()
        if report.n_sent:
            print(summary(report), flush=True)
            for topic in report.best_effort_topics if not arguments.quiet else ():
                note(
                    f'{topic} has a best-effort subscriber; it may have lost clouds, '
                    'nobody can tell'
                )
    return report
