"""Scans and bags that are segmented into files, and a record of the files that are written."""

from __future__ import annotations

import fcntl
import json
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import IO, NamedTuple

from gp_ground_seg.core.errors import LOGGER, DataError, PointCloudError
from gp_ground_seg.core.frame import Label
from gp_ground_seg.core.parameters.config import Config
from gp_ground_seg.core.result import Segmentation
from gp_ground_seg.core.segmenter import GroundSegmenter
from gp_ground_seg.data.bag_files import BAG_SUFFIXES
from gp_ground_seg.data.bags import BagReader, BagWriter, decode_cloud, encode_cloud
from gp_ground_seg.data.cloud_files import encode_output
from gp_ground_seg.data.files import (
    PARTIAL_MARK,
    checksum,
    flush,
    read_bytes,
    stamp,
    write_file,
    writing,
)
from gp_ground_seg.data.inputs import Input
from gp_ground_seg.data.point_cloud2 import read_xyz, select_points
from gp_ground_seg.lab.cluster import Progress

RECORD, PARAMETERS = 'outputs.jsonl', 'parameters.yaml'
TOPICS = {'/ground': Label.GROUND, '/obstacles': Label.OBSTACLE}
"""Of a bag that is written."""
_MAX_RECORD_BYTES = 1 << 32


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
    """Numbers of the segmented clouds: points, times, and what they show of the sensor's pose."""

    n_points: int
    n_ground: int
    seconds: list[float]  # of each cloud, segmentation only
    heights: list[float]  # of the sensor, by the clouds that show it [m]
    tilts: list[tuple[float, float]]  # roll and pitch, by the clouds that show them [rad]
    contradictions: list[str]  # of the clouds that contradict a parameter
    # By the name of each file that is on disk: its size, time and checksum.
    written: dict[str, list[object]]

    @classmethod
    def of(cls, results: Iterable[Segmentation]) -> Outcome:
        """Sum up clouds, one by one."""
        found = cls(0, 0, [], [], [], [], {})
        for result in results:
            n_ground = int((result.label == Label.GROUND).sum())
            found = found._replace(
                n_points=found.n_points + len(result.label), n_ground=found.n_ground + n_ground
            )
            found.seconds.append(result.timings['total'])
            found.contradictions.extend(result.pose.contradictions)
            measured = result.pose.measured
            if measured is not None and measured.tells_height:
                found.heights.append(measured.height)
            if measured is not None and measured.tells_tilt:
                found.tilts.append((measured.roll, measured.pitch))
        return found

    def joined(self, other: Outcome) -> Outcome:
        """Put further clouds behind these."""
        return Outcome(
            self.n_points + other.n_points,
            self.n_ground + other.n_ground,
            self.seconds + other.seconds,
            self.heights + other.heights,
            self.tilts + other.tilts,
            self.contradictions + other.contradictions,
            {**self.written, **other.written},
        )


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
) -> Outcome:
    """Segment items into the files of a folder, and have them on disk."""
    segmenter = GroundSegmenter(config)
    results = (result for item in items for result in item.write(segmenter, folder))
    outcome = Outcome.of(progress(results))
    names = [name for item in items for name in item.names]
    for parent in {parent for name in names for parent in Path(name).parents}:
        with writing(folder / parent):
            flush(folder / parent)
    outcome.written.update({n: [*stamp(folder / n), checksum(folder / n)] for n in names})
    return outcome


def count_clouds(items: Iterable[Item]) -> int:
    """Count the clouds of items."""
    return sum(item.n_clouds for item in items)


class Record:
    """What a folder has of earlier runs: their parameters, and a line for each step of a run.

    The first line of a run has the names of the files that it is to write; they were not there, or
    were to be replaced. Further lines have, by name, size and time of the input, and size, time
    and checksum of the output, of the files that are written. While it is in use the record is
    locked, and nothing is written before `begin`.

    Parameters
    ----------
    folder : Path
        Output folder.
    parameters : str
        All that the output depends on, beside the inputs.
    """

    def __init__(self, folder: Path, parameters: str) -> None:
        self._folder, self._parameters = folder, parameters
        self._file: IO[bytes] | None = None
        self._inputs: dict[Path, tuple[int, str]] = {}
        self._to_write: list[str] = []
        self._changed: list[str] = []
        self._is_new = False

    def find_left(self, items: Sequence[Item], *, force: bool) -> list[Item]:
        """Lock the folder, and return the items that are not finished; all with `force`.

        Raises DataError if another run writes to the folder, and without `force` if it has files
        of other parameters, or files to write that no run has written.
        """
        if self._folder.exists() and not self._folder.is_dir():
            raise DataError(f'{self._folder}: is a file, must be a folder')
        self._inputs = {item.path: stamp(item.path) for item in items}
        inputs = {path.resolve() for path in self._inputs}
        for name in (name for item in items for name in item.names):
            if (self._folder / name).resolve() in inputs:
                raise DataError(f'{self._folder / name}: is the input; name another output')
        if (self._folder / RECORD).exists():
            self._lock()
        if force:
            return [*items]
        planned, written = self._read()
        self._check_parameters(planned)
        left = [item for item in items if not self._is_finished(item, written)]
        wanted = [name for item in left for name in item.names]
        foreign = [n for n in wanted if n not in planned and os.path.lexists(self._folder / n)]
        if foreign:
            raise DataError(
                f'{self._folder / foreign[0]}: exists already ({len(foreign)} of {len(wanted)} '
                'files to write do); --force replaces them'
            )
        self._changed = [
            name
            for name in wanted
            if name in written
            and os.path.lexists(self._folder / name)
            and not self._is_as_written(name, written[name])
        ]
        return left

    def _is_finished(self, item: Item, written: dict[str, list[object]]) -> bool:
        """Whether the files of an item are there, of its input as it is now."""
        given = [*self._inputs[item.path]]
        known = [(name, written.get(name, [])) for name in item.names]
        return all(k[:2] == given and self._is_as_written(name, k) for name, k in known)

    def _is_as_written(self, name: str, known: list[object]) -> bool:
        """Whether a file has the content that was written; it is read if its time is another."""
        size, time = stamp(self._folder / name)
        if size < 0 or known[2:3] != [size]:
            return False
        return known[3:4] == [time] or known[4:] == [checksum(self._folder / name)]

    def _lock(self) -> None:
        """Open the file; the kernel frees its lock with the process, however that ends."""
        number = os.open(self._folder / RECORD, os.O_RDWR | os.O_CREAT | os.O_APPEND, 0o666)
        self._file = os.fdopen(number, 'rb+', buffering=0)
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise DataError(f'{self._folder}: another run writes to it') from error
        except OSError:
            LOGGER.warning('%s: has no locks, start no other run', self._folder)

    def _check_parameters(self, planned: set[str]) -> None:
        """Raise DataError if others are there, of the user or of files that have been written."""
        path = self._folder / PARAMETERS
        is_in_use = self._file is None or any((self._folder / name).exists() for name in planned)
        if is_in_use and path.exists() and read_bytes(path, 1 << 20) != self._parameters.encode():
            raise DataError(
                f'{path}: says other parameters, or another version; give another output folder, '
                'or --force to start anew'
            )

    def _read(self) -> tuple[set[str], dict[str, list[object]]]:
        """Return the names of files to write, and of those that are written what is known."""
        planned, written = set[str](), dict[str, list[object]]()
        if self._file is None:
            return planned, written
        lines = read_bytes(self._folder / RECORD, _MAX_RECORD_BYTES).split(b'\n')
        for number, line in enumerate(lines[:-1], 1):
            try:
                entry = json.loads(line)
                for name in map(str, entry.get('to_write', [])):
                    planned.add(name)
                    written.pop(name, None)
                written.update(
                    {name: [*about] for name, about in entry.get('written', {}).items()}
                )
            except (ValueError, TypeError, AttributeError, RecursionError) as error:
                place = f'{self._folder / RECORD}: line {number}'
                raise DataError(f'{place} is none of a record; --force starts anew') from error
        return planned, written

    def begin(self, items: Sequence[Item], *, force: bool) -> None:
        """Note the files of the items: what follows may write them. With `force` begin anew.

        Files that were changed since they were written are kept under another name.
        """
        self._is_new = not self._folder.exists()
        with writing(self._folder):
            self._folder.mkdir(parents=True, exist_ok=True)
            flush(self._folder.parent)
            if self._file is None:
                self._lock()
        assert self._file is not None
        # The last line of a run that was killed may be cut off.
        known = b'' if force else read_bytes(self._folder / RECORD, _MAX_RECORD_BYTES)
        with writing(self._folder / RECORD):
            self._file.truncate(known.rfind(b'\n') + 1)
        write_file(self._folder / PARAMETERS, self._parameters.encode())
        for name in self._changed:
            self._put_aside(self._folder / name)
        self._to_write = [name for item in items for name in item.names]
        self._append({'to_write': self._to_write})
        with writing(self._folder):
            flush(self._folder)

    def _put_aside(self, path: Path) -> None:
        """Rename a file, which may have been edited by hand."""
        aside = path.with_name(f'{path.name}.changed')
        if os.path.lexists(aside):
            raise DataError(f'{path}: was changed since it was written, and {aside} is there')
        with writing(aside):
            os.rename(path, aside)
        LOGGER.warning('%s: was changed since it was written, is %s now', path, aside.name)

    def add(self, items: Iterable[Item], outputs: dict[str, list[object]]) -> None:
        """Note that the files of the items are on disk, as `outputs` say."""
        written = {n: [*self._inputs[i.path], *outputs[n]] for i in items for n in i.names}
        self._append({'written': written})

    def _append(self, entry: dict[str, object]) -> None:
        """Write a line, and have it on disk."""
        assert self._file is not None
        data = json.dumps(entry).encode() + b'\n'
        with writing(self._folder / RECORD):
            while data:  # a disk that gets full takes a part
                data = data[self._file.write(data) :]
            os.fsync(self._file.fileno())

    def close(self) -> None:
        """Free the lock; a folder that was made for files, of which none is written, goes."""
        if self._file is not None:
            self._file.close()
        if self._is_new and not any((self._folder / name).exists() for name in self._to_write):
            for name in RECORD, PARAMETERS:
                (self._folder / name).unlink(missing_ok=True)
            for folder in [*sorted(self._folder.rglob('*'), reverse=True), self._folder]:
                with suppress(OSError):  # something else is in it
                    folder.rmdir()


def sweep(folder: Path, items: Iterable[Item]) -> None:
    """Delete what killed workers left of the files of the items, all of which are finished."""
    for parent in {(folder / name).parent for item in items for name in item.names}:
        for left in parent.glob(f'.*{PARTIAL_MARK}*'):
            if left.is_file():
                left.unlink(missing_ok=True)
