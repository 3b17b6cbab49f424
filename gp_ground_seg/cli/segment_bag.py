"""Bag in, bag with ground and obstacles out."""

from __future__ import annotations

import argparse
import re
from contextlib import closing
from pathlib import Path

from gp_ground_seg.cli.notes import note
from gp_ground_seg.cli.output import SegmentationTally, note_leftovers, progress_bar
from gp_ground_seg.data.bag_files import BAG_SUFFIXES
from gp_ground_seg.data.bags import BagReader, BagWriter, cloud_topic, open_bag
from gp_ground_seg.data.point_cloud2 import decode_cloud, encode_cloud, read_xyz, select_points
from gp_ground_seg.errors import DataError, PointCloudError
from gp_ground_seg.frame import Label
from gp_ground_seg.parameters.config import Config
from gp_ground_seg.result import Segmentation
from gp_ground_seg.segmenter import GroundSegmenter

DEFAULT_GROUND_TOPIC = '/ground'
DEFAULT_OBSTACLES_TOPIC = '/obstacles'

_TOPIC_NAME = re.compile(r'(/[A-Za-z_][A-Za-z0-9_]*)+')


def segment_bag(source: Path, arguments: argparse.Namespace, config: Config) -> int:
    """Copy a bag, adding the ground and the obstacles of each cloud."""
    target = Path(arguments.output) if arguments.output else _default_output(source)
    _refuse_own_input(source, target)
    ground_topic = arguments.ground_topic or DEFAULT_GROUND_TOPIC
    obstacles_topic = arguments.obstacles_topic or DEFAULT_OBSTACLES_TOPIC
    tally = SegmentationTally()
    with open_bag(source) as bag, closing(GroundSegmenter(config)) as segmenter:
        topic = bag.pick_point_cloud_topic(arguments.topic)
        copied = _copied_topics(bag, arguments.drop)
        _check_output_topics(source, ground_topic, obstacles_topic, copied)
        storage = arguments.format
        if storage is None and target.suffix not in BAG_SUFFIXES and bag.storage != 'ros1':
            storage = bag.storage
        if not arguments.quiet:
            note_leftovers(target)
            _note_migrated(bag, copied)
        with (
            BagWriter(target, storage=storage, force=arguments.force) as output,
            progress_bar(bag.n_messages(topic), quiet=arguments.quiet, title='segment') as bar,
        ):
            for name in copied:
                output.add_topic(bag.topic(name))
            output.add_topic(cloud_topic(ground_topic))
            output.add_topic(cloud_topic(obstacles_topic))
            for name, time, raw in bag.messages([*copied, topic]):
                if name in copied:
                    output.write(name, time, raw)
                if name != topic:
                    continue
                try:
                    ground, obstacles, result = split_cloud(raw, segmenter)
                except PointCloudError as error:
                    raise DataError(
                        f'{source}: message {tally.n_frames} of topic {topic}, '
                        f'recorded at {time} ns: {error}'
                    ) from error
                output.write(ground_topic, time, ground)
                output.write(obstacles_topic, time, obstacles)
                tally.add(result)
                bar.update()
    print(tally.summary(target))
    return 0


def split_cloud(raw: bytes, segmenter: GroundSegmenter) -> tuple[bytes, bytes, Segmentation]:
    """Ground and obstacles of one PointCloud2, all as CDR bytes.

    Raises
    ------
    PointCloudError
        If the message or its layout cannot be read.
    """
    cloud = decode_cloud(raw)
    result = segmenter.segment(read_xyz(cloud))
    ground = select_points(cloud, result.label == Label.GROUND)
    obstacles = select_points(cloud, result.label == Label.OBSTACLE)
    return encode_cloud(ground), encode_cloud(obstacles), result


def _default_output(source: Path) -> Path:
    """Beside the input: a file for a single-file rosbag2, else a folder."""
    named = source if source.name not in ('', '..') else source.resolve()
    if named.is_dir():
        return named.with_name(f'{named.name}_ground')
    suffix = '' if named.suffix == '.bag' else named.suffix
    return named.with_name(f'{named.stem}_ground{suffix}')


def _refuse_own_input(source: Path, target: Path) -> None:
    """Refuse to replace the input, or the folder it is in, while reading it."""
    here = source.resolve()
    if target.resolve() in (here, *here.parents):
        raise DataError(f'{target}: is the input, or has it in it; name another output')


def _copied_topics(bag: BagReader, dropped: list[str]) -> list[str]:
    for name in dropped:
        bag.topic(name)  # Raises where there is none.
    return [name for name in bag.topics if name not in dropped]


def _check_output_topics(source: Path, ground: str, obstacles: str, copied: list[str]) -> None:
    for option, name in (('--ground-topic', ground), ('--obstacles-topic', obstacles)):
        if not _TOPIC_NAME.fullmatch(name):
            raise DataError(
                f'{option} {name}: must be a full topic name, as in {DEFAULT_GROUND_TOPIC}'
            )
        if name in copied:
            raise DataError(
                f'{source}: has a topic {name} already; choose another with {option}, '
                f'or leave that one out with --drop {name}'
            )
    if ground == obstacles:
        raise DataError(f'--obstacles-topic {obstacles}: is the topic of the ground as well')


def _note_migrated(bag: BagReader, copied: list[str]) -> None:
    for name in bag.migrated_topics:
        if name in copied:
            note(
                f'topic {name}: {bag.topics[name]} has other fields in ROS 2; those of the same '
                'name are kept, new ones are zero'
            )
