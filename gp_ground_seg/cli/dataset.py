"""``segment`` of whole data sets: scans or bags in blocks, with a record from which to go on."""

from __future__ import annotations

import argparse
import statistics
from collections.abc import Callable, Sequence
from contextlib import closing
from functools import partial
from operator import attrgetter
from pathlib import Path
from typing import Any

from gp_ground_seg.cli import options
from gp_ground_seg.core.errors import DataError, shown
from gp_ground_seg.core.parameters.config import Config
from gp_ground_seg.data.cloud_output import FORMATS
from gp_ground_seg.data.inputs import Input, holds_bag, list_inputs
from gp_ground_seg.data.semantic_kitti import list_frames, list_sequences, read_points
from gp_ground_seg.lab.scale.cluster import Progress
from gp_ground_seg.lab.scale.dataset import Manifest, Outcome, Scan, digest, run_blocks, sweep

# Options that the output depends on, beside the parameters and the layout of scans.
_OPTIONS = ('topic', 'ground_topic', 'obstacles_topic', 'drop', 'format')


def is_dataset(arguments: argparse.Namespace) -> bool:
    """Whether output is to appear block by block, rather than all of it at the end."""
    asked = (arguments.workers, arguments.scheduler, arguments.resume, arguments.more)
    return any(asked) or _is_root(arguments.input)


def _is_root(source: str) -> bool:
    return any(True for _ in Path(source).glob('sequences/*/velodyne'))


def list_scans(arguments: argparse.Namespace) -> list[Scan]:
    """List the scans of the input; of a SemanticKITTI root, output goes into the same folders."""
    columns = options.columns_of(arguments)
    if not _is_root(arguments.input):
        found = list_inputs(arguments.input, columns)
        return [Scan(item.path, f'{item.name}.label', partial(_read, item)) for item in found]
    names = list_sequences(arguments.input)
    frames = [frame for name in names for frame in list_frames(arguments.input, name, columns)]
    return [
        Scan(
            frame.points_path,
            f'sequences/{frame.sequence}/predictions/{frame.index}.label',
            partial(read_points, frame.points_path, columns),
        )
        for frame in frames
    ]


def _read(item: Input) -> Any:
    return item.read().xyz


def list_bags(arguments: argparse.Namespace, name_of: Callable[[Path], str]) -> list[Scan]:
    """List the bags of the input."""
    paths = [Path(source) for source in (arguments.input, *arguments.more)]
    for path in paths:
        if not holds_bag(path):
            raise DataError(f'{path}: is no bag, of several inputs each must be one')
    names = [name_of(path) for path in paths]
    for name in names:
        if names.count(name) > 1:
            raise DataError(f'two of the bags would become {name}')
    return [Scan(path, name, list) for path, name in zip(paths, names, strict=True)]


def run(
    arguments: argparse.Namespace,
    config: Config,
    target: Path,
    items: Sequence[Scan],
    function: Callable[[Config, Sequence[Scan], Progress], Outcome],
    unit: str = 'frame',
) -> None:
    """Compute the blocks that are not finished, and print a summary.

    `function` computes a block of items, called `unit` in the bar, and writes below `target`.
    """
    if target.suffix[1:] in FORMATS:
        raise DataError(f'{target}: must be a folder')
    if not target.resolve().parent.is_dir():
        raise DataError(f'{target}: the folder {target.resolve().parent} does not exist')
    columns = options.columns_of(arguments)
    given = [getattr(arguments, name) for name in _OPTIONS]
    # A bag takes long: each is a block by itself, and kept once it is finished.
    group = attrgetter('name') if unit == 'bag' else None
    manifest = Manifest(target, digest(config, columns, given), items)
    with closing(manifest):
        done, again = manifest.open(resume=arguments.resume, force=arguments.force)
        if done or again:
            begun = f'{len(done)} of {len(items)} were finished before'
            print(f'{begun}; done again: {again}' if again else begun)
        if len(done) < len(items):
            with options.runner(arguments, 'segment', unit) as runner:
                manifest.begin()
                found = run_blocks(runner, function, config, items, manifest, done, group)
                n_workers = runner.n_workers
            print_summary(found, target, n_workers)
    sweep(target, [item.name for item in items])


def print_summary(found: Outcome, target: Path, n_workers: int = 0) -> None:
    """Print points, ground, time, and height and tilt of the sensor."""
    seconds = found.seconds
    share = f'{found.n_ground / found.n_points:.1%} ground' if found.n_points else 'no ground'
    pace = f'{1e3 * statistics.median(seconds[1:] or seconds):.1f} ms'
    pace += ' per frame (median' if len(seconds) > 1 else ' for the first frame (with loading code'
    beside = f' in each of {options.count(n_workers, "worker")}' if n_workers else ''
    print(
        f'{options.count(len(seconds), "frame")}, {options.count(found.n_points, "point")}, '
        f'{share}, {pace}, segmentation only){beside}, written to {shown(target)}'
    )
    if seconds:
        print(_pose_summary(found))
    if found.contradictions:
        n_frames = options.count(len(found.contradictions), 'frame')
        print(f'{shown(found.contradictions[0])} ({n_frames}: docs/pose.md)')


def _pose_summary(found: Outcome) -> str:
    """Median and standard deviation over the scans that show the pose, as parameters."""
    if not found.heights:
        return 'no frame shows enough ground to estimate the height of the sensor'
    rolls, pitches = zip(*found.tilts, strict=True) if found.tilts else ((), ())
    words = []
    for name, values, digits, unit in (
        ('height', found.heights, 2, 'm'),
        ('roll', rolls, 3, 'rad'),
        ('pitch', pitches, 3, 'rad'),
    ):
        if not values:
            continue
        spread = f' (std {statistics.stdev(values):.{digits}f})' if len(values) > 1 else ''
        words.append(f'sensor.{name}={statistics.median(values):.{digits}f}{spread} {unit}')
    return f'measured in {options.count(len(found.heights), "frame")}: {", ".join(words)}'
