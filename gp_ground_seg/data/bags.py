"""Bags: ROS 1, rosbag2 folders, MCAP and sqlite3 files read; rosbag2 written whole or not at all.

And the clouds in them: messages of rosbags, and their CDR bytes.

The one module that imports rosbags and mcap, optional packages; only where a bag is used. Why not
rosbags for single MCAP files: a channel of protobuf or JSON, or no profile, stops it
(test/foreign_files.py).
"""

import dataclasses
import functools
import os
import struct
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import AbstractContextManager, ExitStack, contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from gp_ground_seg.core.errors import DataError, PointCloudError, in_one_line, require
from gp_ground_seg.data.clouds import check_numbers, gather, name_columns, scatter
from gp_ground_seg.data.files import naming, staged_file, writing
from gp_ground_seg.data.point_cloud2 import DATATYPES, CloudMessage

POINT_CLOUD2 = 'sensor_msgs/msg/PointCloud2'
METADATA_FILE = 'metadata.yaml'
STORAGE_OF_SUFFIX = {'.mcap': 'mcap', '.db3': 'sqlite3'}
BAG_SUFFIXES = ('.bag', *STORAGE_OF_SUFFIX)

_FOLDER_SUFFIXES = ('.mcap', '.db3', '.db3-shm', '.db3-wal', '.zstd', '.zst')
REPAIR = {
    '.bag': '`rosbag reindex` saves the readable part',
    '.mcap': '`mcap recover` saves the readable part',
    '.db3': '`sqlite3 .recover` saves the readable part',
    '': '`ros2 bag reindex` writes metadata.yaml anew',
}
"""What can repair a damaged bag, by its suffix; '' for a folder."""


def is_bag_folder(path: Path) -> bool:
    """Whether a folder holds a rosbag2 bag and nothing else."""
    return (path / METADATA_FILE).is_file() and all(
        child.is_file() and (child.name == METADATA_FILE or child.suffix in _FOLDER_SUFFIXES)
        for child in path.iterdir()
    )


def storage_of(path: Path) -> str:
    """Storage of a bag, or ``ros1``; DataError with the next step if `path` cannot be one."""
    if not path.exists():
        raise DataError(f'{path}: no such file or folder')
    if not path.is_dir():
        if path.suffix not in BAG_SUFFIXES:
            raise DataError(
                f'{path}: not a bag; accepted are ROS 1 .bag, .mcap, .db3 and rosbag2 folders'
            )
        return STORAGE_OF_SUFFIX.get(path.suffix, 'ros1')
    if not (path / METADATA_FILE).is_file():
        files = sorted(child.name for child in path.iterdir() if child.suffix in BAG_SUFFIXES)
        hint = f'; bag files in it, to be given one by one: {", ".join(files)}' if files else ''
        raise DataError(f'{path}: not a rosbag2 folder (no {METADATA_FILE} in it){hint}')
    return 'sqlite3' if any(path.glob('*.db3*')) else 'mcap'


def check_sqlite_path(path: Path) -> None:
    """Raise DataError for a path that rosbags, which gives it to sqlite as a URI, misreads."""
    if awkward := sorted(set('?#%') & set(str(path.absolute()))):
        raise DataError(f'{path}: a sqlite3 bag cannot have {" ".join(awkward)} in its path')


def check_sqlite_file(path: Path) -> None:
    """Raise DataError where a sqlite file is cut off, or in part still in a journal.

    sqlite itself would read zeros, or older messages.
    """
    check_sqlite_path(path)
    with path.open('rb') as file:
        header = file.read(100)
    # The format is that of https://www.sqlite.org/fileformat.html.
    if len(header) == 100 and header[24:28] == header[92:96]:
        page_size, n_pages = struct.unpack_from('>16xH10xI', header)
        # 65536 does not fit into the two bytes.
        size, wanted = path.stat().st_size, n_pages * (65536 if page_size == 1 else page_size)
        if size < wanted:
            raise DataError(f'{path}: truncated, {size} bytes where its header says {wanted}')
    for journal in (path.with_name(path.name + ending) for ending in ('-wal', '-journal')):
        if journal.exists() and journal.stat().st_size > 0:
            hint = f'`sqlite3 {path.name} vacuum` completes it'
            raise DataError(f'{path}: was not closed, some of it is in {journal.name}; {hint}')


@functools.cache
def jazzy_types() -> Any:
    """Message types of ROS 2 Jazzy (``rosbags.typesys.store.Typestore``)."""
    require('rosbags.highlevel', 'rosbags')
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS2_JAZZY)


class _Channel(NamedTuple):
    """Messages of one topic and type in one bag."""

    topic: str
    msgtype: str
    encoding: str
    n_messages: int


_Messages = Iterator[tuple[str, int, bytes]]
"""Topic, recorded time [ns] and bytes of each."""
_Contents = tuple[list[_Channel], Callable[[Collection[str]], _Messages]]
"""Channels of a bag, and what reads the CDR messages of some topics in it."""


def _open_ros(path: Path, storage: str, stack: ExitStack) -> _Contents:
    """Open a ROS 1 ``.bag``, whose clouds become CDR, a rosbag2 folder, or a ``.db3``."""
    from rosbags import rosbag1, rosbag2

    is_ros1 = storage == 'ros1'
    if storage == 'sqlite3':
        for file in path.glob('*.db3') if path.is_dir() else [path]:
            check_sqlite_file(file)
    bag = stack.enter_context(rosbag1.Reader(path) if is_ros1 else rosbag2.Reader(path))
    readable = [c for c in bag.connections if not is_ros1 or c.msgtype == POINT_CLOUD2]
    channels = [
        _Channel(c.topic, c.msgtype, 'cdr' if c in readable else 'ros1', c.msgcount or 0)
        for c in bag.connections
    ]

    def read(topics: Collection[str]) -> _Messages:
        for c, time, raw in bag.messages([c for c in readable if c.topic in topics]):
            cdr = jazzy_types().ros1_to_cdr(raw, POINT_CLOUD2) if is_ros1 else raw
            if time < 0:
                raise ValueError(f'a message of {c.topic} is recorded at {time} ns')
            yield c.topic, int(time), bytes(memoryview(cdr))  # of a number, bytes are zeros

    return channels, read


def _open_mcap(path: Path, stack: ExitStack) -> _Contents:
    """Open an ``.mcap``. Without an index of its chunks it is read in the order of the file."""
    library = require('mcap.reader', 'mcap')
    file = stack.enter_context(path.open('rb'))
    bag = library.SeekingReader(file, validate_crcs=True)
    summary = bag.get_summary()
    is_indexed = bool(summary and summary.chunk_indexes)
    counts = summary.statistics.channel_message_counts if summary and summary.statistics else {}
    channels, schemas = (summary.channels, summary.schemas) if summary else ({}, {})
    if not counts or not counts.keys() <= channels.keys():
        counts = Counter()
        file.seek(0)
        every = library.NonSeekingReader(file).iter_messages(log_time_order=False)
        for schema, channel, _ in every:
            counts[channel.id] += 1
            channels[channel.id], schemas[channel.schema_id] = channel, schema

    def read(topics: Collection[str]) -> _Messages:
        for _, channel, message in bag.iter_messages(topics, log_time_order=is_indexed):
            if channel.message_encoding == 'cdr':
                yield channel.topic, message.log_time, message.data

    kinds = {0: 'no type', **{number: schema.name for number, schema in schemas.items() if number}}
    return [
        _Channel(c.topic, kinds[c.schema_id], c.message_encoding, counts.get(c.id, 0))
        for c in channels.values()
    ], read


class BagReader(AbstractContextManager['BagReader']):
    """A bag as ROS 2 topics with CDR messages, to be used in a ``with`` statement.

    `path` is a ROS 1 ``.bag``, whose clouds are converted, a rosbag2 folder, ``.mcap`` or
    ``.db3``. Topics of other encodings are listed, and not read. Raises DataError if it cannot be
    read, MissingDependencyError without rosbags and mcap.

    Attributes
    ----------
    topics : dict of str to str
        Type of the messages of each topic; those not in CDR with their encoding.
    """

    def __init__(self, path: str | Path) -> None:
        require('rosbags.highlevel', 'rosbags mcap')
        self.path = Path(path)
        storage = storage_of(self.path)
        with ExitStack() as stack:
            with self._naming():
                if self.path.suffix == '.mcap' and self.path.is_file():
                    channels, self._read = _open_mcap(self.path, stack)
                else:
                    channels, self._read = _open_ros(self.path, storage, stack)
            self._open = stack.pop_all()
        self.topics: dict[str, str] = {}
        self._counts: dict[str, int] = {}
        self._in_cdr: list[str] = []
        for name in dict.fromkeys(channel.topic for channel in channels):
            every = [c for c in channels if c.topic == name]
            # Messages that are not CDR are skipped on a topic that has others.
            cdr = [c for c in every if c.encoding == 'cdr']
            kinds = {c.msgtype for c in cdr} or {f'{c.msgtype}, {c.encoding}' for c in every}
            self.topics[name] = ' and '.join(sorted(kinds))
            self._counts[name] = sum(c.n_messages for c in cdr or every)
            self._in_cdr += [name] if cdr else []

    def __exit__(self, *error: object) -> None:
        """Close the files; nothing can be read afterwards."""
        self._open.close()

    def _naming(self) -> AbstractContextManager[None]:
        repair = REPAIR['' if self.path.is_dir() else self.path.suffix]
        return naming(self.path, f'cannot be read as a bag; if it is damaged, {repair}')

    def _list_topics(self) -> str:
        return ', '.join(f'{name} ({kind})' for name, kind in self.topics.items()) or 'none'

    def n_messages(self, topic: str) -> int:
        """Messages of one topic; raises DataError if there is none of that name."""
        if topic not in self.topics:
            raise DataError(f'{self.path}: no topic {topic}; topics here: {self._list_topics()}')
        return self._counts[topic]

    def pick_point_cloud_topic(self, topic: str | None = None) -> str:
        """Return `topic` if it has point clouds, or the only one that has; else a DataError."""
        wanted = [topic] if topic else self.topics
        clouds = [name for name in wanted if self.topics.get(name) == POINT_CLOUD2]
        recorded = [name for name in clouds if self.n_messages(name)]
        if len(recorded) == 1:
            return recorded[0]
        if recorded:
            listed = ', '.join(recorded)
            problem = f'{len(recorded)} {POINT_CLOUD2} topics, choose one with --topic: {listed}'
        elif clouds:
            problem = f'no message on {", ".join(clouds)}'
        else:
            named = f' {topic}' if topic else ''
            problem = f'no {POINT_CLOUD2} topic{named}; topics here: {self._list_topics()}'
        raise DataError(f'{self.path}: {problem}')

    def messages(self, topics: Collection[str] | None = None) -> _Messages:
        """Topic, recorded time [ns] and CDR bytes of each message, by default of all in CDR.

        In the order of their time; file after file in a split bag. Raises DataError if a topic is
        unknown, the bag damaged, or fewer messages can be read than it lists.
        """
        expected = {name: self.n_messages(name) for name in topics or self._in_cdr}
        found: Counter[str] = Counter()
        # Without topics rosbags would read all.
        source = self._read(expected) if expected else iter(())
        while True:
            # Errors of the caller, raised at the yield, must not pass through here.
            with self._naming():
                message = next(source, None)
            if message is None:
                break
            found[message[0]] += 1
            yield message
        for name, n_messages in expected.items():
            if found[name] != n_messages:
                raise DataError(
                    f'{self.path}: topic {name} lists {n_messages} messages, '
                    f'{found[name]} could be read; the bag is damaged, '
                    f'or its {METADATA_FILE} belongs to another one'
                )


@contextmanager
def new_bag(
    path: str | Path, topics: Mapping[str, str], *, force: bool = False, storage: str = 'mcap'
) -> Iterator[Callable[[str, int, bytes | memoryview], None]]:
    """Write a rosbag2 bag, whole or not at all (`staged_file`).

    `path` is a folder as ``ros2 bag record -o`` makes, in a `storage`, or a single file, by its
    suffix; `topics` have types of ROS 2 Jazzy. With `force` a bag of that name is replaced. Yields
    what appends a message: its topic, the time when it was recorded [ns], and CDR bytes. Raises
    DataError if the path is taken or cannot be written, MissingDependencyError without rosbags.
    """
    path, types = Path(path), jazzy_types()
    from rosbags.rosbag2 import StoragePlugin, Writer

    if path.suffix == '.bag':
        raise DataError(f'{path}: only ROS 2 bags are written; use .mcap, .db3 or a folder')
    storage = STORAGE_OF_SUFFIX.get(path.suffix, storage)
    if storage == 'sqlite3':
        check_sqlite_path(path)
    is_file = path.suffix in STORAGE_OF_SUFFIX
    is_kind = Path.is_file if is_file else is_bag_folder
    with staged_file(path, force=force, is_kind=is_kind) as product, writing(path):
        # rosbags writes folders; the one file in it is named after the folder.
        folder = product.parent / 'bag' / product.stem if is_file else product
        # Version 9 is what Jazzy writes.
        with Writer(folder, version=9, storage_plugin=StoragePlugin[storage.upper()]) as bag:
            # Without a profile of its own a topic is played reliably: best effort loses clouds.
            connections = {
                name: bag.add_connection(name, kind, typestore=types)
                for name, kind in topics.items()
            }
            yield lambda topic, time, raw: bag.write(connections[topic], time, raw)
        if is_file:
            os.rename(folder / f'{folder.name}{path.suffix}', product)


def with_stamp(cloud: CloudMessage, stamp: int) -> CloudMessage:
    """Copy of a message with another stamp [ns]; the points are shared."""
    header = _new_header(stamp, cloud.header.frame_id)
    return dataclasses.replace(cloud, header=header)  # type: ignore[type-var]


def cloud_from_points(
    table: npt.NDArray[np.floating], stamp: int, frame_id: str, **further: npt.NDArray[Any]
) -> CloudMessage:
    """Message of points (N, >=3), x y z [m] intensity, with `further` fields (N,), packed.

    Its fields are float32 or uint32; the `stamp` is in ns.
    """
    types, columns = jazzy_types().types, {**scatter(name_columns(table)), **further}
    codes = {name: f'{values.dtype.kind}4' for name, values in columns.items()}
    points = gather({name: values.astype(f'<{codes[name]}') for name, values in columns.items()})
    step, n_points = points.dtype.itemsize, len(points)
    cloud: CloudMessage = types[POINT_CLOUD2](
        header=_new_header(stamp, frame_id),
        height=1,
        width=n_points,
        fields=[
            types['sensor_msgs/msg/PointField'](name, 4 * k, DATATYPES[code], 1)
            for k, (name, code) in enumerate(codes.items())
        ],
        is_bigendian=False,
        point_step=step,
        row_step=step * n_points,
        data=np.frombuffer(points.tobytes(), np.uint8),
        is_dense=False,
    )
    return cloud


def _new_header(stamp: int, frame_id: str) -> Any:
    types = jazzy_types().types
    time = types['builtin_interfaces/msg/Time'](*divmod(stamp, 10**9))
    return types['std_msgs/msg/Header'](time, frame_id)


def decode_cloud(raw: bytes | memoryview) -> CloudMessage:
    """Message of rosbags from its CDR bytes.

    Raises PointCloudError if they are none, or have more numbers per point than accepted.
    """
    types = jazzy_types()
    try:
        cloud: CloudMessage = types.deserialize_cdr(raw, POINT_CLOUD2)
    except Exception as error:  # Its kind depends on where parsing went astray.
        said = f'{len(raw)} bytes that are no {POINT_CLOUD2}: {in_one_line(error)}'
        raise PointCloudError(said) from error
    check_numbers(sum(max(field.count, 1) for field in cloud.fields))
    return cloud


def encode_cloud(cloud: CloudMessage) -> bytes:
    """CDR bytes of a message of rosbags; raises MissingDependencyError as `decode_cloud`."""
    return bytes(jazzy_types().serialize_cdr(cloud, POINT_CLOUD2))
