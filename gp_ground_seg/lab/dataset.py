"""Scans and bags that are segmented into files, and what of it has been done before."""

from __future__ import annotations

import itertools
import os
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from gp_ground_seg.core.errors import DataError
from gp_ground_seg.core.frame import Label
from gp_ground_seg.core.parameters.config import Config
from gp_ground_seg.core.pipeline.sensor_pose import MeasuredPose
from gp_ground_seg.core.result import Segmentation
from gp_ground_seg.core.segmenter import GroundSegmenter
from gp_ground_seg.data.bags import POINT_CLOUD2, decode_cloud, encode_cloud, new_bag, storage_of
from gp_ground_seg.data.cloud_files import encode_output
from gp_ground_seg.data.files import changed_at, naming, read_bytes, remove_leftovers, write_file
from gp_ground_seg.data.inputs import Inputs
from gp_ground_seg.data.point_cloud2 import read_xyz, select_points
from gp_ground_seg.lab.cluster import Progress

PARAMETERS = 'parameters.yaml'
"""File of an output folder that says how its files were made."""
TOPICS = {'/ground': Label.GROUND, '/obstacles': Label.OBSTACLE}
"""Of a bag that is written."""


class Item(NamedTuple):
    """Scans, or the clouds of a bag, to segment into a file each, or into one bag."""

    inputs: Inputs
    names: Sequence[str]  # of the files or the bag to write, below the output folder
    to_bag: bool = False

    def __str__(self) -> str:
        return str(self.inputs.path)

    def write(self, segmenter: GroundSegmenter, folder: Path) -> Iterator[Segmentation]:
        """Write into a folder, replacing others, and yield the result for each cloud."""
        if self.to_bag:
            yield from write_bag(self.inputs, folder / self.names[0], segmenter)
            return
        for scan, name in zip(self.inputs, self.names, strict=True):
            cloud, path = scan.read(), folder / name
            with naming(scan.path):
                result = segmenter.segment(cloud.xyz)
            write_file(path, encode_output(path, cloud, result))
            yield result


def write_bag(source: Inputs, target: Path, segmenter: GroundSegmenter) -> Iterator[Segmentation]:
    """Write a bag of the clouds of a bag, and yield the result for each.

    It is stored as its suffix says, else as the input, and appears when the iteration ends.
    Raises DataError if a cloud cannot be read, or the bag cannot be written.
    """
    storage = storage_of(source.path).replace('ros1', 'mcap')  # no ROS 1 bag is written
    topics = dict.fromkeys(TOPICS, POINT_CLOUD2)
    with new_bag(target, topics, force=True, storage=storage) as write:
        for place, time, raw in source.messages():
            with naming(place):
                cloud = decode_cloud(raw)
                result = segmenter.segment(read_xyz(cloud))
            for part, label in TOPICS.items():
                write(part, time, encode_cloud(select_points(cloud, result.label == label)))
            yield result


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
        label, pose = result.label, result.pose
        n_ground, seconds = int((label == Label.GROUND).sum()), result.timings['total']
        return cls(len(label), n_ground, seconds, pose.measured, pose.contradictions)


def segment_block(
    folder: Path, config: Config, items: Sequence[Item], progress: Progress
) -> list[Outcome]:
    """Segment items into the files of a folder."""
    segmenter = GroundSegmenter(config)
    results = (result for item in items for result in item.write(segmenter, folder))
    return [Outcome.of(result) for result in progress(results)]


def count_clouds(items: Iterable[Item]) -> int:
    """Count the clouds of items."""
    return sum(len(item.inputs) for item in items)


def find_left(
    folder: Path, items: Sequence[Item], parameters: str | None, *, force: bool
) -> Sequence[Item]:
    """Return the items to segment: all with `force`, else those that are not finished.

    Output is finished that is newer than its input, and no older than `PARAMETERS`. Raises
    DataError if an output is an input, and without `force` if it was made with other parameters,
    or by no run with parameters.

    Parameters
    ----------
    parameters : str or None
        What a run into a folder writes into `PARAMETERS`; None if the output is a single one.
    """
    paths = [item.inputs.path.resolve() for item in items]
    inputs = {place for path in paths for place in (path, *path.parents)}
    outputs = [folder / name for item in items for name in item.names]
    for path in outputs:
        if path.resolve() in inputs:
            raise DataError(f'{path}: is the input, or has it in it; name another output')
    if parameters is not None:
        for parent in {path.parent for path in outputs}:
            remove_leftovers(parent)
    there = [path for path in outputs if os.path.lexists(path)]
    if force or not there:
        return items
    begun = changed_at(folder / PARAMETERS)
    if parameters is None or not begun:
        raise DataError(f'{there[0]}: exists already; --force replaces it')
    if said := find_difference(folder, parameters):
        raise DataError(f'{said}; give another output folder, or --force to start anew')
    return [item for item in items if not _is_finished(folder, item, begun)]


def find_difference(folder: Path, parameters: str) -> str:
    """Say where the `PARAMETERS` of a folder differ from these; empty if they do not."""
    path = folder / PARAMETERS
    before = read_bytes(path, 1 << 20).decode(errors='replace') if path.exists() else ''
    for said, now in itertools.zip_longest(
        before.splitlines(), parameters.splitlines(), fillvalue=''
    ):
        if said != now:
            return f'{path}: says "{said}", now it is "{now}"'
    return ''


def _is_finished(folder: Path, item: Item, begun: int) -> bool:
    changed = changed_at(item.inputs.path)
    written = [changed_at(folder / name) for name in item.names]
    return all(time > changed and time >= begun for time in written)
