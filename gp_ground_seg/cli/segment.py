"""``segment``: label scans, or split the clouds of a bag; what was done before is skipped."""

from __future__ import annotations

import argparse
import itertools
import os
import statistics
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

from gp_ground_seg import __version__
from gp_ground_seg.cli import options
from gp_ground_seg.core.errors import DataError, shown
from gp_ground_seg.core.frame import Label
from gp_ground_seg.core.parameters.config import Config
from gp_ground_seg.core.pipeline.sensor_pose import MeasuredPose
from gp_ground_seg.core.result import Segmentation
from gp_ground_seg.core.segmenter import GroundSegmenter
from gp_ground_seg.data import bags, files, inputs, semantic_kitti
from gp_ground_seg.data.cloud_files import FORMATS, LABELS, encode_output
from gp_ground_seg.data.inputs import Input, Inputs
from gp_ground_seg.data.point_cloud2 import read_xyz, select_points
from gp_ground_seg.lab.cluster import Progress

DESCRIPTION = """\
Split scans into ground and obstacles.

INPUT is a scan (.bin .pcd .ply .npy .npz), a folder or sequence of scans, a bag (.bag .mcap .db3,
or a rosbag2 folder), or a KITTI_ROOT. docs/datasets.md has more on formats, and on whole data
sets.

A .bin gives a .label file: 40 = ground, 99 = obstacle, 0 = no return (SemanticKITTI). Other scans
keep their format and get label (1 ground, 2 obstacle, 0 no return), height, ground_z, ground_std
and p_ground. A bag gives a rosbag2 of the ground and the obstacles of each cloud.

If it is run again with the same arguments, inputs whose output is newer are skipped.

At the end it prints height and tilt of the sensor, to check or to set (docs/pose.md).
"""
EXAMPLES = """\
  gp-ground-seg segment 000000.bin -o 000000.label
  gp-ground-seg segment KITTI_ROOT/sequences/00 -o labels
  gp-ground-seg segment scan.pcd -o scan.npz
  gp-ground-seg segment drive.mcap             writes drive_ground.mcap
  gp-ground-seg segment KITTI_ROOT -o OUT --workers 8
  gp-ground-seg segment KITTI_ROOT -o OUT --scheduler tcp://host:8786
"""
PARAMETERS = 'parameters.yaml'
"""File of an output folder that says how its files were made."""
TOPICS = {'/ground': Label.GROUND, '/obstacles': Label.OBSTACLE}
"""Of a bag that is written."""


def add_parser(subparsers: options.Subparsers) -> None:
    """Declare the commands."""
    parser = options.command(
        subparsers, 'segment', DESCRIPTION, EXAMPLES,
        ('input', 'scan, folder of scans, bag, or a root', {'metavar': 'INPUT'}),
        ('more', argparse.SUPPRESS, {'nargs': '*', 'default': []}),
        ('-o --output', 'for scans a folder, or a file for a single scan; for a bag a folder, '
         'or a .mcap or .db3 file (default: INPUT with _ground added, beside it)',
         {'metavar': 'OUT'}),
        ('--format', 'of a file for each scan or cloud (default: by the name of OUT, else labels '
         f'of .bin scans, and as the input): {", ".join(FORMATS)}',
         {'choices': FORMATS, 'metavar': 'FORMAT'}),
        *options.CLOUDS, options.FORCE, options.QUIET, options.CLUSTER, *options.CONFIG, run=run,
    )  # fmt: skip
    parser.usage = '%(prog)s INPUT [-o OUT] [options]'


def run(arguments: argparse.Namespace) -> int:
    """Write the files of each input that are not written yet, and print a summary."""
    config, source = options.read_config(arguments), Path(arguments.input)
    target = Path(arguments.output or _default_output(source, arguments.format))
    scans, form, is_one = _list_scans(arguments, source, target)
    if not is_one and (target.is_file() or target.suffix[1:] in FORMATS):
        raise DataError(f'{target}: must be a folder')
    folder, place = (target.parent, target) if is_one else (target, target.resolve())
    if not place.parent.is_dir():
        raise DataError(f'{target}: the folder {place.parent} does not exist')
    outputs = [target] if is_one else [output_of(folder, form, scan) for scan in scans]
    parameters = None if is_one else _parameters(arguments, config)
    left = find_left(scans, outputs, folder, parameters, force=arguments.force)
    if len(left) < len(scans):
        print(f'{len(scans) - len(left)} of {len(scans)} were finished before')
    if not left:
        return 0
    used, is_new = options.spare_compiling(config, len(left)), not folder.exists()
    write = partial(segment_scans, folder, form, used)
    if is_one and scans.topic:
        write = partial(segment_bag, target, used)
    with options.runner(arguments, 'segment') as runner:
        if parameters and (arguments.force or find_difference(folder, parameters)):
            files.write_file(folder / PARAMETERS, parameters.encode())
        try:
            found = runner.run(write, left)
        finally:
            if is_new and not any(map(os.path.lexists, outputs)):  # it failed at once
                with suppress(OSError):  # another run may have written there
                    (folder / PARAMETERS).unlink()
                    folder.rmdir()
    _print_summary([*itertools.chain(*found)], target, runner.n_workers)
    options.note_spared(config, used)
    return 0


def _list_scans(
    arguments: argparse.Namespace, source: Path, target: Path
) -> tuple[Inputs, str | None, bool]:
    """Return what to segment, and the format of its files; whether they are one, or one bag."""
    if arguments.more:
        raise DataError(
            f'{arguments.more[0]}: a second input, where one is taken; for several: '
            'for f in FILES; do gp-ground-seg segment "$f"; done'
        )
    form, suffix = arguments.format, target.suffix[1:]
    if semantic_kitti.is_root(source):
        if form not in (None, LABELS):
            raise DataError(f'--format {form}: a KITTI_ROOT gives .label files')
        # Where SemanticKITTI's tools look for predictions.
        labels = [
            replace(scan, name=f'sequences/{name}/predictions/{scan.name}')
            for name in semantic_kitti.list_sequences(source)
            for scan in options.list_clouds(arguments, source / 'sequences' / name)
        ]
        return Inputs(source, labels), LABELS, False
    scans = options.list_clouds(arguments)
    if scans.topic:
        options.refuse(arguments, ('workers', 'scheduler'), 'is for scans, not for a bag')
        return scans, form, form is None
    if source.is_dir() or not suffix or (suffix not in FORMATS and target.is_dir()):
        return scans, form, False
    if suffix not in FORMATS:
        raise DataError(f'{target}: must be a folder, or end in .{", .".join(FORMATS)}')
    if form not in (None, suffix):
        raise DataError(f'{target}: ends in .{suffix}, which is not {form}')
    return Inputs(source, [replace(scan, name=target.stem) for scan in scans]), suffix, True


def _parameters(arguments: argparse.Namespace, config: Config) -> str:
    """Return what the files of an output folder depend on, beside the content of the inputs."""
    source = Path(arguments.input).resolve()
    if not (source.is_dir() or inputs.holds_bag(source)):
        source = source.parent  # the same names from elsewhere are other inputs
    title = f'written by gp-ground-seg segment {__version__}, from {source}'
    for name in 'topic', 'columns':
        title += f', {name} {value}' if (value := vars(arguments)[name]) else ''
    return f'# {shown(title)}\n{config.to_yaml()}'


def _default_output(source: Path, form: str | None = None) -> Path:
    """Beside the input: a file of the same format where it can be written, else a folder."""
    named = source if source.name not in ('', '..') else source.resolve()
    if named.is_dir():
        return named.with_name(f'{named.name}_ground')
    suffix = '' if named.suffix in ('.bag', '.bin') else named.suffix
    if form is not None:
        suffix = '' if named.suffix in bags.BAG_SUFFIXES else f'.{form}'
    return named.with_name(f'{named.stem}_ground{suffix}')


def _print_summary(found: Sequence[Outcome], target: Path, n_workers: int = 0) -> None:
    """Print points, ground, time, and height and tilt of the sensor."""
    seconds = [one.seconds for one in found]
    n_points, n_ground = sum(one.n_points for one in found), sum(one.n_ground for one in found)
    share = f'{n_ground / n_points:.1%} ground' if n_points else 'no ground'
    # The first may load code.
    pace = f'{1e3 * statistics.median(seconds[1:] or seconds):.1f} ms per frame (median'
    beside = f' in each of {options.count(n_workers, "worker")}' if n_workers else ''
    print(
        f'{options.count(len(found), "frame")}, {options.count(n_points, "point")}, '
        f'{share}, {pace}, segmentation only){beside}, written to {shown(target)}'
    )
    print(_pose_summary([one.measured for one in found if one.measured is not None]))
    if contradictions := [text for one in found for text in one.contradictions]:
        n_frames = options.count(len(contradictions), 'frame')
        print(f'{shown(contradictions[0])} ({n_frames}: docs/pose.md)')


def _pose_summary(poses: Sequence[MeasuredPose]) -> str:
    """Median and standard deviation over the scans that show the pose, as parameters."""
    heights = [pose.height for pose in poses if pose.tells_height]
    if not heights:
        return 'no frame shows enough ground to estimate the height of the sensor'
    tilted = [pose for pose in poses if pose.tells_tilt]
    words = []
    for name, values, digits, unit in (
        ('height', heights, 2, 'm'),
        ('roll', [pose.roll for pose in tilted], 3, 'rad'),
        ('pitch', [pose.pitch for pose in tilted], 3, 'rad'),
    ):
        if not values:
            continue
        spread = f' (std {statistics.stdev(values):.{digits}f})' if len(values) > 1 else ''
        words.append(f'sensor.{name}={statistics.median(values):.{digits}f}{spread} {unit}')
    return f'measured in {options.count(len(heights), "frame")}: {", ".join(words)}'


class Outcome(NamedTuple):
    """What is kept of a segmented cloud, for a summary."""

    n_points: int
    n_ground: int
    seconds: float  # segmentation only
    measured: MeasuredPose | None  # what it shows of the sensor's pose
    contradictions: Sequence[str]  # of it and a parameter

    @classmethod
    def of(cls, result: Segmentation) -> Outcome:
        """Count a result."""
        pose, n_ground = result.pose, int(result.is_ground.sum())
        seconds, n_points = result.timings['total'], len(result.label)
        return cls(n_points, n_ground, seconds, pose.measured, pose.contradictions)


def output_of(folder: Path, form: str | None, scan: Input) -> Path:
    """File of a folder that a scan becomes, of a format or its own; of a `.bin` `LABELS`."""
    suffix = scan.path.suffix.lower()[1:]
    return folder / f'{scan.name}.{form or (suffix if suffix in FORMATS else LABELS)}'


def segment_scans(
    folder: Path, form: str | None, config: Config, scans: Iterable[Input], progress: Progress
) -> list[Outcome]:
    """Write the file of each scan into a folder, replacing others."""
    segmenter, found = GroundSegmenter(config), []
    for scan in progress(scans):
        cloud, path = scan.read(), output_of(folder, form, scan)
        with files.naming(scan.path):
            result = segmenter.segment(cloud.xyz)
        files.write_file(path, encode_output(path, cloud, result))
        found.append(Outcome.of(result))
    return found


def segment_bag(target: Path, config: Config, bag: Inputs, progress: Progress) -> list[Outcome]:
    """Write a bag of the ground and the obstacles of each cloud of a bag, replacing another.

    It is stored as its suffix says, else as the input. Raises DataError if a cloud cannot be read,
    or the bag cannot be written.
    """
    storage = bags.storage_of(bag.path).replace('ros1', 'mcap')  # no ROS 1 bag is written
    topics = dict.fromkeys(TOPICS, bags.POINT_CLOUD2)
    segmenter, found = GroundSegmenter(config), []
    with bags.new_bag(target, topics, force=True, storage=storage) as write:
        for place, time, raw in progress(bag.messages()):
            with files.naming(place):
                cloud = bags.decode_cloud(raw)
                result = segmenter.segment(read_xyz(cloud))
            for part, label in TOPICS.items():
                write(part, time, bags.encode_cloud(select_points(cloud, result.label == label)))
            found.append(Outcome.of(result))
    return found


def find_left(
    scans: Inputs, outputs: Sequence[Path], folder: Path, parameters: str | None, *, force: bool
) -> Sequence[Input]:
    """Return the scans to segment: all with `force`, else those that are not finished.

    Output is finished that is newer than its input, and no older than the `PARAMETERS` of its
    folder; of a bag all clouds are done again if one is not. `parameters` is None if all scans
    become one of the `outputs`. Raises DataError if an output is an input, and without `force` if
    it was made with other parameters, or by no run with parameters.
    """
    sources = [scan.path for scan in scans.files] or [scans.path] * len(outputs)
    taken = {place for path in map(Path.resolve, {*sources}) for place in (path, *path.parents)}
    for path in outputs:
        if path.resolve() in taken:
            raise DataError(f'{path}: is the input, or has it in it; name another output')
    if parameters is not None:
        for parent in {path.parent for path in outputs}:
            files.remove_leftovers(parent)
    there = [path for path in outputs if os.path.lexists(path)]
    if force or not there:
        return scans if scans.topic else scans.files
    begun = files.changed_at(folder / PARAMETERS)
    if parameters is None or not begun:
        raise DataError(f'{there[0]}: exists already; --force replaces it')
    if said := find_difference(folder, parameters):
        raise DataError(f'{said}; give another output folder, or --force to start anew')
    is_left = [
        files.changed_at(path) <= files.changed_at(source) or files.changed_at(path) < begun
        for source, path in zip(sources, outputs, strict=True)
    ]
    return scans if scans.topic and any(is_left) else [*itertools.compress(scans.files, is_left)]


def find_difference(folder: Path, parameters: str) -> str:
    """Say where the `PARAMETERS` of a folder differ from these; empty if they do not."""
    path = folder / PARAMETERS
    before = files.read_bytes(path, 1 << 20).decode(errors='replace') if path.exists() else ''
    lines = itertools.zip_longest(before.splitlines(), parameters.splitlines(), fillvalue='')
    found = (f'{path}: says "{said}", now it is "{now}"' for said, now in lines if said != now)
    return next(found, '')
