"""``segment``: label scans, or split the clouds of a bag."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path

from gp_ground_seg.cli import dataset, options
from gp_ground_seg.core.errors import DataError
from gp_ground_seg.core.parameters.config import Config
from gp_ground_seg.core.result import Segmentation
from gp_ground_seg.core.segmenter import GroundSegmenter
from gp_ground_seg.data.bag_files import BAG_SUFFIXES, SUFFIX_OF_STORAGE
from gp_ground_seg.data.bag_output import GROUND_TOPIC, OBSTACLES_TOPIC, BagOutput
from gp_ground_seg.data.cloud_files import SUFFIXES, WRITABLE
from gp_ground_seg.data.cloud_output import FORMATS, CloudOutput, encode_labels
from gp_ground_seg.data.files import stamp, write_file
from gp_ground_seg.data.inputs import holds_bag
from gp_ground_seg.lab.scale.cluster import Progress
from gp_ground_seg.lab.scale.dataset import Outcome, Scan, pool, segment_block

DESCRIPTION = """\
Split scans into ground and obstacles.

INPUT is a scan (.bin .pcd .ply .npy .npz), a folder or sequence of scans, a bag
(.bag .mcap .db3, or a rosbag2 folder), several bags, or a KITTI_ROOT. docs/datasets.md has more
on formats, and on whole data sets.

A .bin or text gives a .label file: 40 = ground, 99 = obstacle, 0 = not finite (SemanticKITTI).
Other scans keep their format and get label (1 ground, 2 obstacle, 0 not finite), height,
ground_z, ground_std and p_ground. A bag gives a rosbag2 with all its messages, and ground and
obstacles after each cloud.

At the end it prints height and tilt of the sensor, to check or to set (docs/pose.md).
"""
EXAMPLES = """\
  gp-ground-seg segment 000000.bin -o 000000.label
  gp-ground-seg segment KITTI_ROOT/sequences/00 -o labels
  gp-ground-seg segment scan.pcd -o scan.npz --surface
  gp-ground-seg segment drive.mcap                          writes drive_ground.mcap
  gp-ground-seg segment KITTI_ROOT -o OUT --workers 8 --resume
  gp-ground-seg segment KITTI_ROOT -o OUT --scheduler tcp://host:8786
"""

FOR_BAGS: tuple[str, ...] = ('ground_topic', 'obstacles_topic', 'drop')
FOR_SCANS: tuple[str, ...] = ('split', 'surface')


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Declare the commands."""
    parser = options.new_parser(subparsers, 'segment', DESCRIPTION, EXAMPLES)
    parser.usage = '%(prog)s INPUT [BAG ...] [-o OUT] [options]'
    options.add(
        parser,
        ('input', 'scan, folder of scans, bag, or a root', {'metavar': 'INPUT'}),
        ('more', 'further bags', {'metavar': 'BAG', 'nargs': '*'}),
        ('-o --output', 'for scans a folder, or a file for a single scan; for bags a folder, or '
         'a .mcap or .db3 file (default: INPUT with _ground added, beside it)',
         {'metavar': 'OUT'}),
        ('--resume', 'go on with OUT, whose finished blocks are in its manifest', options.FLAG),
        options.FORCE,
        options.QUIET,
    )  # fmt: skip
    options.add_cluster(parser)
    options.add_config(parser)
    options.add(
        parser.add_argument_group('for scans'),
        ('--split', 'write ground and obstacles apart, as OUT_ground and OUT_obstacles',
         options.FLAG),
        ('--surface', 'write the ground as a grid as well, as OUT_surface.npz', options.FLAG),
    )  # fmt: skip
    topic, several = {'metavar': 'T'}, {'metavar': 'T', 'action': 'append', 'default': []}
    formats = (*FORMATS, *SUFFIX_OF_STORAGE)
    options.add(
        parser,
        ('--format', 'of the output (default: by the name of OUT, else labels of .bin scans, and '
         f'as the input; mcap for ROS 1): {", ".join(formats)}',
         {'choices': formats, 'metavar': 'FORMAT'}),
        *options.CLOUDS,
    )  # fmt: skip
    options.add(
        parser.add_argument_group('for bags'),
        ('--ground-topic', f'topic of the ground (default: {GROUND_TOPIC})', topic),
        ('--obstacles-topic', f'topic of the obstacles (default: {OBSTACLES_TOPIC})', topic),
        ('--drop', 'leave this topic out of the output (may be repeated)', several),
    )
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Segment the input, by its kind."""
    config = options.read_config(arguments)
    source = Path(arguments.input)
    is_bag = holds_bag(source)
    gives_bag = is_bag and arguments.format not in FORMATS
    kind, foreign = ('scans', FOR_SCANS) if gives_bag else ('bags', FOR_BAGS)
    if not (is_bag or arguments.format in FORMATS):
        foreign = (*foreign, 'topic', 'format')
    for name in foreign:
        if getattr(arguments, name):
            option = name.replace('_', '-')
            raise DataError(f'--{option}: is for {kind}, which {source} is not')
    if is_bag:
        options.refuse_columns(arguments, source)
    if dataset.is_dataset(arguments):
        _segment_dataset(arguments, config, is_bag)
        return 0
    target = Path(arguments.output or _default_output(source, arguments.format))
    segment = _segment_bag if gives_bag else _segment_scans
    results = segment(target, arguments, GroundSegmenter(config))
    dataset.print_summary(Outcome.of(results), target)
    return 0


def _segment_dataset(arguments: argparse.Namespace, config: Config, is_bag: bool) -> None:
    """Segment a whole data set, or several bags, into a folder."""
    target = Path(arguments.output or _default_output(Path(arguments.input)))
    for name in ('format', 'split', 'surface'):
        if getattr(arguments, name) not in (None, False, *SUFFIX_OF_STORAGE):
            raise DataError(f'--{name}: whole data sets give .label files and bags')
    if is_bag or arguments.more:
        bags = dataset.list_bags(arguments, lambda path: _default_output(path).name)
        write_bags = partial(_segment_bags, _bag_output(arguments), target)
        dataset.run(arguments, config, target, bags, write_bags, 'bag')
        return
    scans = dataset.list_scans(arguments)
    dataset.run(arguments, config, target, scans, partial(segment_block, _write_labels, target))


def _segment_bags(
    output: BagOutput,
    target: Path,
    config: Config,
    bags: Sequence[Scan],
    progress: Progress,
) -> Outcome:
    """Segment bags, each into one in the folder `target`."""
    outcomes, segmenter = [], GroundSegmenter(config)
    for bag in progress(bags):
        path = target / bag.name
        outcome = Outcome.of(output.write(bag.path, path, segmenter, force=True))
        outcomes.append(outcome._replace(sizes=[stamp(path)[0]]))
    return pool(outcomes)


def _write_labels(path: Path, result: Segmentation) -> int:
    data = encode_labels(result)
    write_file(path, data)
    return len(data)


def _default_output(source: Path, form: str | None = None) -> Path:
    """Beside the input: a file of the same format where it can be written, else a folder."""
    named = source if source.name not in ('', '..') else source.resolve()
    if named.is_dir():
        return named.with_name(f'{named.name}_ground')
    suffix = '' if named.suffix in ('.bag', '.bin') else named.suffix
    if suffix in SUFFIXES and suffix not in WRITABLE:
        suffix = '.npz'
    if form in FORMATS:
        suffix = '' if named.suffix in BAG_SUFFIXES else f'.{form}'
    return named.with_name(f'{named.stem}_ground{suffix}')


def _segment_scans(
    target: Path, arguments: argparse.Namespace, segmenter: GroundSegmenter
) -> Iterator[Segmentation]:
    """Write the files of each scan; yield the results."""
    scans = options.list_clouds(arguments)
    is_file = target.suffix[1:] in FORMATS
    has_several = scans.topic or Path(arguments.input).is_dir()
    if is_file and has_several:
        raise DataError(f'{target}: must be a folder, {arguments.input} has several scans')
    if target.suffix and not (is_file or has_several or target.is_dir()):
        raise DataError(f'{target}: must be a folder, or end in .{", .".join(FORMATS)}')
    form = target.suffix[1:] if is_file else arguments.format
    if arguments.format not in (None, form):
        raise DataError(f'{target}: ends in {target.suffix}, which is not {arguments.format}')
    output = CloudOutput(form, arguments.split, arguments.surface)
    options.note_leftovers(target, quiet=arguments.quiet)
    bar = options.progress('segment', quiet=arguments.quiet)
    with output.staged(scans, target, is_file=is_file, force=arguments.force) as paths:
        for scan in bar(scans, total=len(scans)):
            yield output.write(scan, segmenter, paths(scan))


def _segment_bag(
    target: Path, arguments: argparse.Namespace, segmenter: GroundSegmenter
) -> Iterator[Segmentation]:
    """Write the bag of a bag; yield the results."""
    clouds = options.list_clouds(arguments)
    options.note_leftovers(target, quiet=arguments.quiet)
    output = _bag_output(arguments)
    results = output.write(Path(arguments.input), target, segmenter, force=arguments.force)
    bar = options.progress('segment', quiet=arguments.quiet)
    yield from bar(results, total=len(clouds))


def _bag_output(arguments: argparse.Namespace) -> BagOutput:
    return BagOutput(
        arguments.topic,
        arguments.ground_topic or GROUND_TOPIC,
        arguments.obstacles_topic or OBSTACLES_TOPIC,
        arguments.drop,
        arguments.format,
    )
