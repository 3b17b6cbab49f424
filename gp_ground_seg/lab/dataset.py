"""Scans and bags that are segmented into files, and the folders of these files."""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from gp_ground_seg.core.errors import DataError, PointCloudError
from gp_ground_seg.core.frame import Label
from gp_ground_seg.core.parameters.config import Config
from gp_ground_seg.core.pipeline.sensor_pose import MeasuredPose
from gp_ground_seg.core.result import Segmentation
from gp_ground_seg.core.segmenter import GroundSegmenter
from gp_ground_seg.data.bags import BAG_SUFFIXES, BagReader, BagWriter, decode_cloud, encode_cloud
from gp_ground_seg.data.cloud_files import encode_output
from gp_ground_seg.data.files import changed_at, read_bytes, remove_leftovers, write_file
from gp_ground_seg.data.inputs import Input
from gp_ground_seg.data.point_cloud2 import read_xyz, select_points
from gp_ground_seg.lab.cluster import Progress

PARAMETERS = 'parameters.yaml'
"""File of an output folder that says how its files were made."""
TOPICS = {'/ground': Label.GROUND, '/obstacles': Label.OBSTACLE}
"""Of a bag that is written."""


class Item(NamedTuple):
    """A scan or bag to segment."""

    path: Path  # of the input
    names: Sequence[str]  # of the files to write, below the output folder
    # Writes them into a folder, and yields the result for each cloud.
    write: Callable[[GroundSegmenter, Path], Iterator[Segmentation]]
    n_clouds: int = 1

    def __str__(self) -> str:
        return str(self.path)


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


def write_scans(
    scans: Iterable[Input], names: Sequence[str], segmenter: GroundSegmenter, folder: Path
) -> Iterator[Segmentation]:
    """Write a file for each scan, and yield the results: the `write` of an `Item`."""
    for scan, name in zip(scans, names, strict=True):
        cloud, path = scan.read(), folder / name
        try:
            result = segmenter.segment(cloud.xyz)
        except PointCloudError as error:
            raise PointCloudError(f'{scan.path}: {error}') from error
        write_file(path, encode_output(path, cloud, result))
        yield result


def write_bag(
    source: Path,
    name: str,
    topic: str | None,
    storage: str | None,
    force: bool,
    segmenter: GroundSegmenter,
    folder: Path,
) -> Iterator[Segmentation]:
    """Write the bag `name` of the clouds of `source`, and yield the result for each.

    The bag appears when the iteration ends. Raises DataError if a cloud cannot be read, or the
    target cannot be, or exists and `force` is false.

    Parameters
    ----------
    topic : str or None
        PointCloud2 topic to segment, by default the only one.
    storage : str or None
        ``mcap`` or ``sqlite3``; by default that of the suffix, else that of the input.
    """
    here, target = source.resolve(), folder / name
    if target.resolve() in (here, *here.parents):
        raise DataError(f'{target}: is the input, or has it in it; name another output')
    with BagReader(source) as bag:
        topic = bag.pick_point_cloud_topic(topic)
        if not (storage or target.suffix in BAG_SUFFIXES or bag.storage == 'ros1'):
            storage = bag.storage
        with BagWriter(target, storage=storage, force=force) as output:
            for part in TOPICS:
                output.add_topic(part)
            for k, (_, time, raw) in enumerate(bag.messages([topic])):
                try:
                    cloud = decode_cloud(raw)
                    result = segmenter.segment(read_xyz(cloud))
                except PointCloudError as error:
                    place = f'message {k} of topic {topic}, recorded at {time} ns'
                    raise DataError(f'{source}: {place}: {error}') from error
                for part, label in TOPICS.items():
                    kept = select_points(cloud, result.label == label)
                    output.write(part, time, encode_cloud(kept))
                yield result


def segment_block(
    folder: Path, config: Config, items: Sequence[Item], progress: Progress
) -> list[Outcome]:
    """Segment items into the files of a folder."""
    segmenter = GroundSegmenter(config)
    results = (result for item in items for result in item.write(segmenter, folder))
    return [Outcome.of(result) for result in progress(results)]


def count_clouds(items: Iterable[Item]) -> int:
    """Count the clouds of items."""
    return sum(item.n_clouds for item in items)


class OutputFolder:
    """A folder of output, which a run begins, or goes on with.

    Output counts as finished that is newer than its input, and no older than `PARAMETERS`.
    Raises DataError if the path is that of a file.

    Parameters
    ----------
    path : Path
        Need not exist.
    parameters : str
        All that the output depends on, beside the content of the inputs, for `PARAMETERS`.
    """

    def __init__(self, path: Path, parameters: str) -> None:
        if path.exists() and not path.is_dir():
            raise DataError(f'{path}: is a file, must be a folder')
        self._path, self._parameters = path, parameters
        self._is_new, self._is_begun = not path.exists(), (path / PARAMETERS).exists()
        self._outputs: list[Path] = []

    def find_left(self, items: Sequence[Item], *, force: bool) -> list[Item]:
        """Return the items that are not finished; all with `force`.

        Raises DataError without `force` if the folder has output of other parameters, or files to
        write that no run has written.
        """
        inputs = {item.path.resolve() for item in items}
        self._outputs = [self._path / name for item in items for name in item.names]
        if same := [path for path in self._outputs if path.resolve() in inputs]:
            raise DataError(f'{same[0]}: is the input; name another output')
        if force:
            return [*items]
        if self._is_begun:
            self._check_parameters()
            begun = changed_at(self._path / PARAMETERS)
            return [item for item in items if not self._is_finished(item, begun)]
        if there := [path for path in self._outputs if os.path.lexists(path)]:
            n_there = f'{len(there)} of {len(self._outputs)} files to write do'
            raise DataError(f'{there[0]}: exists already ({n_there}); --force replaces them')
        return [*items]

    def _check_parameters(self) -> None:
        """Raise DataError if the output that is there was made otherwise."""
        path = self._path / PARAMETERS
        before = read_bytes(path, 1 << 20).decode(errors='replace').splitlines()
        now = self._parameters.splitlines()
        for said, wanted in itertools.zip_longest(before, now, fillvalue=''):
            if said != wanted:
                raise DataError(
                    f'{path}: says "{said.strip(" #")}", now it is "{wanted.strip(" #")}"; give '
                    'another output folder, or --force to start anew'
                )

    def _is_finished(self, item: Item, begun: int) -> bool:
        changed = changed_at(item.path)
        written = [changed_at(self._path / name) for name in item.names]
        return all(time > changed and time >= begun for time in written)

    def begin(self, *, force: bool) -> None:
        """Write the parameters, with `force` anew: what is older than they are is not finished."""
        if force or not self._is_begun:
            write_file(self._path / PARAMETERS, self._parameters.encode())

    def close(self) -> None:
        """Remove what killed workers and runs have left; where nothing is written, all of it."""
        for folder in {path.parent for path in self._outputs}:
            remove_leftovers(folder)
        if self._is_begun or any(path.exists() for path in self._outputs):
            return
        (self._path / PARAMETERS).unlink(missing_ok=True)
        if self._is_new:
            with suppress(OSError):  # something else is in it
                for folder in [*sorted(self._path.rglob('*'), reverse=True), self._path]:
                    folder.rmdir()
