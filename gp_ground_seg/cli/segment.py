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
from gp_ground_seg.data.cloud_output import FORMATS, CloudOutput, encode_labels
from gp_ground_seg.data.files import AnyPath, as_path, stamp, write_file
from gp_ground_seg.data.inputs import holds_bag
from gp_ground_seg.lab.scale.cluster import Progress
from gp_ground_seg.lab.scale.dataset import Outcome, Scan, pool, segment_block

DESCRIPTION = """\
Split scans into ground and obstacles.

INPUT is one of:
  scan.bin             float32 x, y, z, intensity, as in KITTI; --columns and --dtype for others
  .pcd .ply .npy .npz, and .pcd.bin of nuScenes
  folder               of such files, or a sequence with velodyne/ in it
  drive.bag            a ROS 1 bag
  drive.mcap, .db3     a single-file rosbag2
  folder               of a rosbag2 (with metadata.yaml)
  KITTI_ROOT           with sequences/00/velodyne/ and so on in it; several bags; s3://...

The output of a .bin scan is a .label file as in SemanticKITTI, one uint32 per point in
the order of the input: 40 (road) = ground, 99 (other-object) = obstacle, 0 (unlabelled) =
unknown (the point is not finite). With --raw: 1, 2 and 0.

The output of other formats has the same format; the name of OUT or --format chooses another
one. It has every field of the input, and label (0 unknown, 1 ground, 2 obstacle), height,
ground_z, ground_std [m], p_ground (docs/datasets.md).

The output of a bag is a rosbag2 with all messages of the input, and after each point cloud
its ground and its obstacles: every field of every point bit for bit, the same header, the
same recorded time. Unknown points are in neither. Messages of ROS 1 are converted to ROS 2.

At the end it prints height and tilt of the sensor over the frames that show enough ground,
median and standard deviation. With level ground they can be set as parameters (docs/pose.md).

A file whose coordinates can be no scan (another layout, millimetres, a map) is refused.
--force reads it anyway.

Nothing is overwritten without --force. Output has a hidden name (.NAME.partial-...) until
it is complete.

With a KITTI_ROOT, several bags, a URL, --workers or --resume, each file appears when it is
complete, and OUT/manifest.jsonl has a line for each block of files. --resume skips those
whose input and output are as they were. The labels are the same (docs/datasets.md).
"""
EXAMPLES = """\
  gp-ground-seg segment 000000.bin -o 000000.label
  gp-ground-seg segment KITTI_ROOT/sequences/00 -o labels
  gp-ground-seg segment scan.pcd -o scan.npz --surface
  gp-ground-seg segment drive.mcap --format ply --split     files for each cloud
  gp-ground-seg segment drive.mcap                          writes drive_ground.mcap
  gp-ground-seg segment drive.bag -o out --topic /velodyne_points --format sqlite3
  gp-ground-seg segment KITTI_ROOT -o OUT --workers 8 --resume
  gp-ground-seg segment s3://bucket/kitti -o s3://bucket/labels --scheduler tcp://host:8786
"""

FOR_BAGS = ('ground_topic', 'obstacles_topic', 'drop')
FOR_SCANS = ('raw', 'split', 'surface', 'origin')


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Declare the commands."""
    parser = options.new_parser(subparsers, 'segment', DESCRIPTION, EXAMPLES)
    options.add(
        parser,
        ('input', 'scan, folder of scans, bag, or a root or URL', {'metavar': 'INPUT'}),
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
        ('--raw', 'write 0 unknown, 1 ground, 2 obstacle as labels', options.FLAG),
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
    is_bag = '://' not in arguments.input and holds_bag(source)
    gives_bag = is_bag and arguments.format not in FORMATS
    kind, foreign = ('scans', FOR_SCANS) if gives_bag else ('bags', FOR_BAGS)
    if not (is_bag or arguments.format in FORMATS):
        foreign = (*foreign, 'topic', 'format')
    for name in foreign:
        if getattr(arguments, name):
            option = name.replace('_', '-')
            raise DataError(f'--{option}: is for {kind}, which {source} is not')
    if is_bag:
        options.refuse_scan_layout(arguments, source)
    if dataset.is_dataset(arguments):
        _segment_dataset(arguments, config, is_bag)
        return 0
    target = Path(arguments.output or _default_output(source, arguments.format))
    with GroundSegmenter(config) as segmenter:
        segment = _segment_bag if gives_bag else _segment_scans
        dataset.print_summary(Outcome.of(segment(target, arguments, segmenter)), target)
    return 0


def _segment_dataset(arguments: argparse.Namespace, config: Config, is_bag: bool) -> None:
    """Segment a whole data set, or several bags, into a folder."""
    if arguments.output is None and '://' in arguments.input:
        raise DataError(f'{arguments.input}: give the folder for the output, -o OUT')
    target = as_path(arguments.output or _default_output(Path(arguments.input)))
    for name in ('format', 'split', 'surface'):
        if getattr(arguments, name) not in (None, False, *SUFFIX_OF_STORAGE):
            raise DataError(f'--{name}: whole data sets give .label files and bags')
    if is_bag or arguments.more:
        if not isinstance(target, Path):
            raise DataError(f'{target}: bags are written to folders of this machine')
        bags = dataset.list_bags(arguments, lambda path: _default_output(path).name)
        write_bags = partial(_segment_bags, _bag_output(arguments), target)
        dataset.run(arguments, config, target, bags, write_bags, 'bag')
        return
    scans, write = dataset.list_scans(arguments), partial(_write_labels, arguments.raw)
    dataset.run(arguments, config, target, scans, partial(segment_block, write, target))


def _segment_bags(
    output: BagOutput,
    target: Path,
    config: Config,
    bags: Sequence[Scan],
    progress: Progress,
) -> Outcome:
    """Segment bags, each into one in the folder `target`."""
    outcomes = []
    for bag in progress(bags):
        with GroundSegmenter(config) as segmenter:
            source, path = Path(str(bag.path)), target / bag.name
            outcome = Outcome.of(output.write(source, path, segmenter, force=True))
            outcomes.append(outcome._replace(sizes=[stamp(path)[0]]))
    return pool(outcomes)


def _write_labels(raw: bool, path: AnyPath, result: Segmentation) -> int:
    data = encode_labels(result, raw)
    write_file(path, data)
    return len(data)


def _default_output(source: Path, form: str | None = None) -> Path:
    """Beside the input: a file for a single-file rosbag2, else a folder."""
    named = source if source.name not in ('', '..') else source.resolve()
    if named.is_dir():
        return named.with_name(f'{named.name}_ground')
    suffix = '' if named.suffix in ('.bag', '.bin') else named.suffix
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
    output = CloudOutput(form, arguments.raw, arguments.split, arguments.surface)
    if not arguments.quiet:
        options.note_leftovers(target)
    bar = options.progress('segment', quiet=arguments.quiet)
    with output.staged(scans, target, is_file=is_file, force=arguments.force) as paths:
        for scan in bar(scans, total=len(scans)):
            yield output.write(scan, segmenter, paths(scan))


def _segment_bag(
    target: Path, arguments: argparse.Namespace, segmenter: GroundSegmenter
) -> Iterator[Segmentation]:
    """Write the bag of a bag; yield the results."""
    clouds = options.list_clouds(arguments)
    if not arguments.quiet:
        options.note_leftovers(target)
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
