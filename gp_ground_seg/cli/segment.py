"""``segment``: label scans, or split the clouds of a bag; ``pose``: height and tilt."""

from __future__ import annotations

import argparse
import math
import re
import statistics
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from functools import partial
from pathlib import Path

import numpy as np

from gp_ground_seg.cli import dataset, options
from gp_ground_seg.data.atomic_output import staged_file, staged_files
from gp_ground_seg.data.bag_files import BAG_SUFFIXES, SUFFIX_OF_STORAGE
from gp_ground_seg.data.bags import BagReader, BagWriter, cloud_topic
from gp_ground_seg.data.files import AnyPath, as_path, write_file
from gp_ground_seg.data.inputs import Inputs, holds_bag, list_inputs
from gp_ground_seg.data.point_cloud2 import decode_cloud, encode_cloud, read_xyz, select_points
from gp_ground_seg.errors import DataError, PointCloudError
from gp_ground_seg.evaluation.report import Cell, Column, Table, percent, write_json
from gp_ground_seg.frame import Label
from gp_ground_seg.parameters.config import Config
from gp_ground_seg.pipeline.sensor_pose import SensorPose
from gp_ground_seg.result import Segmentation
from gp_ground_seg.scale.cluster import Progress
from gp_ground_seg.scale.dataset import Outcome, Scan, pool, segment_block
from gp_ground_seg.segmenter import GroundSegmenter

DESCRIPTION = """\
Split scans into ground and obstacles.

INPUT is one of:
  scan.bin             a scan as KITTI's: float32 x, y, z, intensity; --columns, --dtype: another
  folder               of .bin files, or a sequence with velodyne/ in it
  drive.bag            a ROS 1 bag
  drive.mcap, .db3     a single-file rosbag2
  folder               of a rosbag2 (with metadata.yaml)

Scans give .label files in SemanticKITTI's form, one uint32 per point in input
order: 40 (road) = ground, 99 (other-object) = obstacle, 0 (unlabelled) = unknown,
which are the points that are not finite. With --raw: 1, 2 and 0.

A bag gives a rosbag2 with all messages of the input as they are, and after each
point cloud its ground and its obstacles: every field of every point bit for bit,
the same header, the same recorded time. Unknown points are in neither.
Messages of ROS 1 are converted to ROS 2.

Scans whose numbers can be none, as of another layout or in millimetres, are refused
with what they look like; with --force they are taken.

Nothing is overwritten without --force. Output is written under a hidden name
(.NAME.partial-...) and takes its name when it is complete.
"""
EXAMPLES = """\
  gp-ground-seg segment 000000.bin -o 000000.label
  gp-ground-seg segment KITTI_ROOT/sequences/00 -o labels
  gp-ground-seg segment nuscenes/samples/LIDAR_TOP -o labels --columns 5
  gp-ground-seg segment drive.mcap                          writes drive_ground.mcap
  gp-ground-seg segment drive.bag -o out --topic /velodyne_points --format sqlite3
"""

POSE_DESCRIPTION = """\
Estimate from scans how high the sensor is and how it is tilted.

INPUT is a .bin scan (float32 x, y, z, intensity; else --columns, --dtype), a folder of
them, or a sequence with velodyne/ in it. Each scan is judged by itself. Support is the
share of the low points on the plane that was found, residual their distance to it.
With enough scans of level ground the medians are values to set: docs/pose.md.
"""
POSE_EXAMPLES = """\
  gp-ground-seg pose 000000.bin
  gp-ground-seg pose KITTI_ROOT/sequences/00
  gp-ground-seg pose scans --set sensor.height=1.2      does it agree?
"""

GROUND_TOPIC, OBSTACLES_TOPIC = '/ground', '/obstacles'
FOR_BAGS = ('topic', 'ground_topic', 'obstacles_topic', 'drop', 'format')
# Unlabelled, road and other-object.
SEMANTIC_KITTI_CODE = {Label.UNKNOWN: 0, Label.GROUND: 40, Label.OBSTACLE: 99}
_TOPIC_NAME = re.compile(r'(/[A-Za-z_][A-Za-z0-9_]*)+')


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Declare the commands."""
    parser = options.new_parser(subparsers, 'segment', DESCRIPTION, EXAMPLES)
    options.add(
        parser,
        ('input', 'scan, folder of scans, bag, or a root or URL', {'metavar': 'INPUT'}),
        ('more', 'further bags', {'metavar': 'BAG', 'nargs': '*'}),
        ('-o --output', 'for scans a folder, or a .label file for a single scan; for bags a '
         'folder, or a .mcap or .db3 file (default: INPUT with _ground added, beside it)',
         {'metavar': 'OUT'}),
        ('--resume', 'go on with OUT, whose finished blocks are in its manifest', options.FLAG),
        options.FORCE,
        options.QUIET,
    )  # fmt: skip
    options.add_cluster(parser)
    options.add_config(parser)
    raw = ('--raw', 'write 0 unknown, 1 ground, 2 obstacle as labels', options.FLAG)
    options.add(parser.add_argument_group('for scans'), *options.SCAN_LAYOUT, raw)
    topic, several = {'metavar': 'T'}, {'metavar': 'T', 'action': 'append', 'default': []}
    options.add(
        parser.add_argument_group('for bags'),
        ('--topic', 'PointCloud2 topic (default: the only one there is)', topic),
        ('--ground-topic', f'topic of the ground (default: {GROUND_TOPIC})', topic),
        ('--obstacles-topic', f'topic of the obstacles (default: {OBSTACLES_TOPIC})', topic),
        ('--drop', 'leave this topic out of the output (may be repeated)', several),
        ('--format', 'storage of the output (default: by its name, else as the input; mcap for '
         'ROS 1)', {'choices': SUFFIX_OF_STORAGE}),
    )  # fmt: skip
    parser.set_defaults(run=run)

    parser = options.new_parser(subparsers, 'pose', POSE_DESCRIPTION, POSE_EXAMPLES)
    options.add(
        parser,
        ('input', 'scan, folder of scans, or bag', {'metavar': 'INPUT'}),
        ('--topic', 'PointCloud2 topic of a bag (default: the only one)', {'metavar': 'T'}),
        *options.SCAN_LAYOUT,
        options.TO_JSON,
        options.FORCE,
    )
    options.add_config(parser)
    parser.set_defaults(run=run_pose)


def run(arguments: argparse.Namespace) -> int:
    """Segment the input, by its kind."""
    config = options.read_config(arguments)
    source = Path(arguments.input)
    is_bag = '://' not in arguments.input and holds_bag(source)
    kind, foreign = ('scans', ['raw']) if is_bag else ('bags', FOR_BAGS)
    for name in foreign:
        if getattr(arguments, name):
            option = name.replace('_', '-')
            raise DataError(f'--{option}: is for {kind}, which {source} is not')
    if is_bag:
        options.refuse_scan_layout(arguments, source)
    if dataset.is_dataset(arguments):
        _segment_dataset(arguments, config, is_bag)
        return 0
    target = Path(arguments.output) if arguments.output else _default_output(source)
    with closing(GroundSegmenter(config)) as segmenter:
        segment = _segment_bag if is_bag else _segment_scans
        dataset.print_summary(Outcome.of(segment(target, arguments, segmenter)), target)
    return 0


def _segment_dataset(arguments: argparse.Namespace, config: Config, is_bag: bool) -> None:
    """Segment a whole data set, or several bags, into a folder."""
    if arguments.output is None and '://' in arguments.input:
        raise DataError(f'{arguments.input}: give the folder for the output, -o OUT')
    target = as_path(arguments.output or _default_output(Path(arguments.input)))
    if is_bag or arguments.more:
        if not isinstance(target, Path):
            raise DataError(f'{target}: bags are written to folders of this machine')
        bags = dataset.list_bags(arguments, lambda path: _default_output(path).name)
        dataset.run(arguments, config, target, bags, partial(_segment_bags, arguments, target))
        return
    scans, write = dataset.list_scans(arguments), partial(_write_labels, arguments.raw)
    dataset.run(arguments, config, target, scans, partial(segment_block, write, target))


def _segment_bags(
    arguments: argparse.Namespace,
    target: Path,
    config: Config,
    bags: Sequence[Scan],
    progress: Progress,
) -> Outcome:
    """Segment bags, each into one in the folder `target`."""
    outcomes = []
    for bag in progress(bags):
        given = {'input': str(bag.path), 'quiet': True, 'force': True}
        own = argparse.Namespace(**{**vars(arguments), **given})
        with closing(GroundSegmenter(config)) as segmenter:
            outcomes.append(Outcome.of(_segment_bag(target / bag.name, own, segmenter)))
    return pool(outcomes)


def _write_labels(raw: bool, path: AnyPath, result: Segmentation) -> None:
    codes = sorted(Label) if raw else [SEMANTIC_KITTI_CODE[k] for k in sorted(Label)]
    write_file(path, np.array(codes, dtype='<u4')[result.label].tobytes())


def _default_output(source: Path) -> Path:
    """Beside the input: a file for a single-file rosbag2, else a folder."""
    named = source if source.name not in ('', '..') else source.resolve()
    if named.is_dir():
        return named.with_name(f'{named.name}_ground')
    suffix = '' if named.suffix in ('.bag', '.bin') else named.suffix
    return named.with_name(f'{named.stem}_ground{suffix}')


def _segment_scans(
    target: Path, arguments: argparse.Namespace, segmenter: GroundSegmenter
) -> Iterator[Segmentation]:
    """Write one label file per scan; yield what each holds."""
    codes = sorted(Label) if arguments.raw else [SEMANTIC_KITTI_CODE[k] for k in sorted(Label)]
    code = np.array(codes, dtype='<u4')
    scans = list_inputs(arguments.input, options.scan_layout(arguments))
    if not arguments.quiet:
        options.note_leftovers(target)
    with (
        _label_files(scans, target, arguments) as label_paths,
        options.progress('segment', quiet=arguments.quiet)(total=len(scans)) as bar,
    ):
        for scan, label_path in zip(scans, label_paths, strict=True):
            try:
                result = segmenter.segment(scan.read().xyz)
            except PointCloudError as error:
                raise PointCloudError(f'{scan.path}: {error}') from error
            label_path.write_bytes(code[result.label].tobytes())
            yield result
            bar.update()


@contextmanager
def _label_files(
    scans: Inputs, target: Path, arguments: argparse.Namespace
) -> Iterator[list[Path]]:
    """Yield where to write the labels of each scan; all take their names at the end."""
    if target.suffix == '.label':
        if Path(arguments.input).is_dir():
            raise DataError(f'{target}: must be a folder, {arguments.input} is one')
        with staged_file(target, force=arguments.force) as path:
            yield [path]
        return
    names = [f'{scan.name}.label' for scan in scans]
    with staged_files(target, names, force=arguments.force) as folder:
        yield [folder / name for name in names]


def _segment_bag(
    target: Path, arguments: argparse.Namespace, segmenter: GroundSegmenter
) -> Iterator[Segmentation]:
    """Copy a bag, the ground and the obstacles of each cloud after it; yield the results."""
    n_done = 0
    source = Path(arguments.input)
    here = source.resolve()
    if target.resolve() in (here, *here.parents):
        raise DataError(f'{target}: is the input, or has it in it; name another output')
    topics = (arguments.ground_topic or GROUND_TOPIC, arguments.obstacles_topic or OBSTACLES_TOPIC)
    outputs = dict(zip(topics, (Label.GROUND, Label.OBSTACLE), strict=True))
    with BagReader(source) as bag:
        topic = bag.pick_point_cloud_topic(arguments.topic)
        for name in arguments.drop:
            bag.topic(name)  # Raises where there is none.
        copied = [name for name in bag.topics if name not in arguments.drop]
        _check_output_topics(source, topics, copied)
        storage = arguments.format
        if storage is None and target.suffix not in BAG_SUFFIXES and bag.storage != 'ros1':
            storage = bag.storage
        if not arguments.quiet:
            options.note_leftovers(target)
            for name in set(bag.migrated_topics) & set(copied):
                kind = bag.topics[name]
                options.note(f'topic {name}: {kind} has other fields in ROS 2; new ones are zero')
        with (
            BagWriter(target, storage=storage, force=arguments.force) as output,
            options.progress('segment', quiet=arguments.quiet)(total=bag.n_messages(topic)) as bar,
        ):
            for name in copied:
                output.add_topic(bag.topic(name))
            for name in outputs:
                output.add_topic(cloud_topic(name))
            for name, time, raw in bag.messages([*copied, topic]):
                if name in copied:
                    output.write(name, time, raw)
                if name != topic:
                    continue
                try:
                    cloud = decode_cloud(raw)
                    result = segmenter.segment(read_xyz(cloud))
                except PointCloudError as error:
                    raise DataError(
                        f'{source}: message {n_done} of topic {topic}, '
                        f'recorded at {time} ns: {error}'
                    ) from error
                for part, label in outputs.items():
                    chosen = select_points(cloud, result.label == label)
                    output.write(part, time, encode_cloud(chosen))
                yield result
                n_done += 1
                bar.update()


def _check_output_topics(source: Path, topics: tuple[str, str], copied: list[str]) -> None:
    for option, name in zip(('--ground-topic', '--obstacles-topic'), topics, strict=True):
        if not _TOPIC_NAME.fullmatch(name):
            raise DataError(f'{option} {name}: must be a full topic name, as in {GROUND_TOPIC}')
        if name in copied:
            choices = f'choose another with {option}, or leave that one out with --drop {name}'
            raise DataError(f'{source}: has a topic {name} already; {choices}')
    if topics[0] == topics[1]:
        raise DataError(f'--obstacles-topic {topics[1]}: is the topic of the ground as well')


DEGREES = math.degrees(1.0)
POSE_COLUMNS = (
    Column('scan'),
    Column('height [m]', '.2f', 'height'),
    Column('roll [deg]', '+.2f', 'roll', DEGREES),
    Column('pitch [deg]', '+.2f', 'pitch', DEGREES),
    percent('support [%]', 'support', '.0f'),
    Column('residual [m]', '.3f', 'residual'),
    Column('used as', key='used_as'),
)


def run_pose(arguments: argparse.Namespace) -> int:
    """Print a line for each scan, and the medians."""
    poses, rows, notes = [], [], []
    scans = list_inputs(arguments.input, options.scan_layout(arguments), arguments.topic)
    config, bar = options.read_config(arguments), options.progress('pose')
    with options.staged_options(arguments, 'json') as parts:
        with closing(GroundSegmenter(config)) as segmenter:
            for scan in bar(scans, total=len(scans)):
                try:
                    pose = segmenter.estimate_pose(scan.read().xyz)
                except PointCloudError as error:
                    notes.append(f'{scan.title}: refused: {error}')
                    continue
                poses.append(pose)
                rows.append(_pose_row(scan.title, pose))
                notes += [f'{scan.title}: {line}' for line in pose.contradictions]
        table = Table(POSE_COLUMNS, rows)
        if poses:
            print(table.text())
            notes.insert(0, _pose_summary(poses))
        if 'json' in parts:
            write_json({'scans': table.json(), 'notes': notes}, parts['json'])
    print('\n'.join(notes))
    return 0


def _pose_row(name: str, pose: SensorPose) -> list[Cell]:
    """Return what was measured, where the scan tells it, and the values used."""
    used = f'height {pose.height:.2f}'
    if not pose.height_estimated:
        used = f'height {pose.height:g} (not measured)'
    if not pose.is_level:
        used += f', roll {math.degrees(pose.roll):.1f} pitch {math.degrees(pose.pitch):.1f}'
    found = pose.measured
    if found is None or not found.tells_height:
        return [name, *5 * [None], used]
    tilt = (found.roll, found.pitch) if found.tells_tilt else (None, None)
    return [name, found.height, *tilt, found.plane.support, found.plane.residual, used]


def _pose_summary(poses: list[SensorPose]) -> str:
    """Return the medians over the scans that tell, as parameters."""
    found = [pose.measured for pose in poses if pose.measured is not None]
    heights = [one.height for one in found if one.tells_height]
    tilts = [(one.roll, one.pitch) for one in found if one.tells_tilt]
    if not heights:
        return 'no scan shows enough ground to tell the height: set sensor.height'
    words = f'median of {len(heights)}: sensor.height={statistics.median(heights):.2f}'
    if tilts:
        roll, pitch = map(statistics.median, zip(*tilts, strict=True))
        words += f' sensor.roll={roll:.3f} sensor.pitch={pitch:.3f} [m, rad]'
    return words
