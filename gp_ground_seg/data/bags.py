"""Bags: ROS 1, rosbag2 folders, MCAP and sqlite3 files read; rosbag2 written whole or not at all.

The one module that imports rosbags, mcap and zstandard, optional packages; only where a bag is
used. Why not rosbags for MCAP and rosbag2 folders: one channel of protobuf or JSON, one line of
metadata.yaml that is not needed, or no profile stops it (test/foreign_files.py).
"""

from __future__ import annotations

import functools
import os
import sqlite3
import tempfile
from collections import Counter
from collections.abc import Callable, Collection, Iterator
from contextlib import AbstractContextManager, ExitStack, closing
from pathlib import Path
from typing import Any, NamedTuple, Protocol

from gp_ground_seg.core.errors import DataError, require
from gp_ground_seg.data.atomic_output import staged_bag_folder, staged_file
from gp_ground_seg.data.bag_files import (
    METADATA_FILE,
    PACKED_SUFFIXES,
    POINT_CLOUD2,
    STORAGE_OF_SUFFIX,
    SUFFIX_OF_STORAGE,
    BagTopic,
    check_is_bag,
    check_mcap_file,
    check_sqlite_file,
    list_files,
    reading,
    resolve_storage,
    storage_of,
    writing,
)


@functools.cache
def jazzy_types() -> Any:
    """Message types of ROS 2 Jazzy (``rosbags.typesys.store.Typestore``)."""
    require('rosbags.highlevel', 'rosbags')
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS2_JAZZY)


def jazzy_topic(name: str, msgtype: str, qos: tuple[Any, ...] = ()) -> BagTopic:
    """Topic of a type that is part of ROS 2 Jazzy."""
    definition, _ = jazzy_types().generate_msgdef(msgtype, ros_version=2)
    return BagTopic(name, msgtype, definition, jazzy_types().hash_rihs01(msgtype), qos)


def cloud_topic(name: str) -> BagTopic:
    """PointCloud2 topic offered reliably; with best effort, large clouds get lost when played."""
    require('rosbags.highlevel', 'rosbags')
    from rosbags import interfaces as ros

    forever = ros.QosTime(9223372036, 854775807)  # RMW_DURATION_INFINITE
    history, liveliness = ros.QosHistory.KEEP_LAST, ros.QosLiveliness.AUTOMATIC
    kind = ros.QosReliability.RELIABLE, ros.QosDurability.VOLATILE
    qos = ros.Qos(history, 10, *kind, forever, forever, liveliness, forever, False)
    return jazzy_topic(name, POINT_CLOUD2, (qos,))


class _Channel(NamedTuple):
    """Messages of one topic, type and encoding in one file; `key` is its number there."""

    key: int
    topic: str
    msgtype: str
    encoding: str
    n_messages: int


class _Storage(Protocol):
    """One file of a bag."""

    channels: list[_Channel]

    def messages(self, keys: Collection[int]) -> Iterator[tuple[int, int, bytes]]:
        """Key, recorded time [ns] and bytes of each message of these channels."""


class _Ros1Storage:
    """A ``.bag``. Its clouds become CDR, which other messages are not."""

    def __init__(self, path: Path, stack: ExitStack) -> None:
        require('rosbags.highlevel', 'rosbags')
        from rosbags import rosbag1

        self._reader = rosbag1.Reader(path)
        self._reader.open()
        stack.callback(self._reader.close)
        self.channels = [
            _Channel(c.id, c.topic, c.msgtype, self._encoding(c.msgtype), c.msgcount)
            for c in self._reader.connections
        ]

    @staticmethod
    def _encoding(msgtype: str) -> str:
        return 'cdr' if msgtype == POINT_CLOUD2 else 'ros1'

    def messages(self, keys: Collection[int]) -> Iterator[tuple[int, int, bytes]]:
        connections = [c for c in self._reader.connections if c.id in keys]
        for connection, time, raw in self._reader.messages(connections):
            yield connection.id, time, jazzy_types().ros1_to_cdr(raw, POINT_CLOUD2)


class _SqliteStorage:
    """A ``.db3`` of any version of rosbag2."""

    def __init__(self, path: Path, stack: ExitStack) -> None:
        check_sqlite_file(path)
        address = f'{path.absolute().as_uri()}?mode=ro&immutable=1'
        database = sqlite3.connect(address, uri=True, check_same_thread=False)
        self._database = stack.enter_context(closing(database))
        counts = dict(database.execute('SELECT topic_id, count(*) FROM messages GROUP BY 1'))
        topics = database.execute('SELECT id, name, type, serialization_format FROM topics')
        self.channels = [
            _Channel(key, name, msgtype, encoding, counts.get(key, 0))
            for key, name, msgtype, encoding in topics
        ]

    def messages(self, keys: Collection[int]) -> Iterator[tuple[int, int, bytes]]:
        wanted = ', '.join(map(str, map(int, keys)))
        yield from self._database.execute(
            'SELECT topic_id, timestamp, data FROM messages '
            f'WHERE topic_id IN ({wanted}) ORDER BY timestamp, id'
        )


class _McapStorage:
    """An ``.mcap``. Without an index of its chunks it is read in the order of the file."""

    def __init__(self, path: Path, stack: ExitStack) -> None:
        reader = require('mcap.reader', 'mcap')
        check_mcap_file(path)
        self._file = stack.enter_context(path.open('rb'))
        self._reader = reader.SeekingReader(self._file, validate_crcs=True)
        summary = self._reader.get_summary()
        self._is_indexed = bool(summary and summary.chunk_indexes)
        channels: dict[int, Any] = {}
        schemas: dict[int, Any] = {}
        counts: dict[int, int] = {}
        indexed: set[int] = set()
        if summary is not None:
            channels, schemas = summary.channels, summary.schemas
            counts = summary.statistics.channel_message_counts if summary.statistics else {}
            indexed = {key for c in summary.chunk_indexes for key in c.message_index_offsets}
        if not counts or not {*counts, *indexed} <= channels.keys():
            counts = self._scan(channels, schemas)
        self.channels = [
            _Channel(
                c.id,
                c.topic,
                schemas[c.schema_id].name if c.schema_id else '',
                c.message_encoding,
                counts.get(c.id, 0),
            )
            for c in channels.values()
        ]

    def _scan(self, channels: dict[int, Any], schemas: dict[int, Any]) -> Counter[int]:
        """Count the messages of a file whose summary does not; completes its channels."""
        from mcap.records import Channel, Message, Schema
        from mcap.stream_reader import StreamReader

        counts: Counter[int] = Counter()
        self._file.seek(0)
        for record in StreamReader(self._file, validate_crcs=True).records:
            if isinstance(record, Message):
                counts[record.channel_id] += 1
            elif isinstance(record, Channel):
                channels[record.id] = record
            elif isinstance(record, Schema):
                schemas[record.id] = record
        return counts

    def messages(self, keys: Collection[int]) -> Iterator[tuple[int, int, bytes]]:
        topics = {c.topic for c in self.channels if c.key in keys}
        found = self._reader.iter_messages(topics, log_time_order=self._is_indexed)
        for _, channel, message in found:
            if channel.id in keys:
                yield channel.id, message.log_time, message.data


_STORAGES: dict[str, Callable[[Path, ExitStack], _Storage]] = {
    '.bag': _Ros1Storage,
    '.db3': _SqliteStorage,
    '.mcap': _McapStorage,
}


def _open_storage(file: Path, stack: ExitStack) -> _Storage:
    """Open one file of a bag; a packed one is unpacked first."""
    if file.suffix not in PACKED_SUFFIXES:
        return _STORAGES[file.suffix](file, stack)
    plain = Path(stack.enter_context(tempfile.TemporaryDirectory()), file.stem)
    with file.open('rb') as source, plain.open('wb') as target:
        require('zstandard', 'zstandard').ZstdDecompressor().copy_stream(source, target)
    return _STORAGES[plain.suffix](plain, stack)


class BagReader(AbstractContextManager['BagReader']):
    """A bag as ROS 2 topics with CDR messages, to be used in a ``with`` statement.

    `path` is a ROS 1 ``.bag``, whose clouds are converted, a rosbag2 folder, ``.mcap`` or
    ``.db3``. Topics of other encodings are listed, and not read. Raises DataError if it cannot be
    read, MissingDependencyError without rosbags and mcap.
    """

    def __init__(self, path: str | Path) -> None:
        require('rosbags.highlevel', 'rosbags mcap')
        self.path = Path(path)
        self.storage = storage_of(self.path)  # ``ros1``, ``mcap`` or ``sqlite3``
        with ExitStack() as stack:
            with reading(self.path):
                check_is_bag(self.path)
                files, self._counts, self._is_packed = list_files(self.path)
                self._storages = [_open_storage(file, stack) for file in files]
            self._open = stack.pop_all()
        self._topics: dict[str, list[_Channel]] = {}
        channels = [channel for storage in self._storages for channel in storage.channels]
        # What is recorded on a topic beside CDR is left.
        for channel in sorted(channels, key=lambda c: c.encoding != 'cdr'):
            known = self._topics.setdefault(channel.topic, [])
            if channel.encoding == (known or [channel])[0].encoding:
                known.append(channel)

    def __exit__(self, *error: object) -> None:
        """Close the files; nothing can be read afterwards."""
        self._open.close()

    @property
    def topics(self) -> dict[str, str]:
        """Type of the messages of each topic; those not in CDR with their encoding."""
        return {name: self._kind(name) for name in self._topics}

    def _kind(self, topic: str) -> str:
        channels = self._topics[topic]
        types = ' and '.join(sorted({channel.msgtype for channel in channels}))
        encoding = channels[0].encoding
        return types if encoding == 'cdr' else ', '.join(filter(None, (types, encoding)))

    @property
    def point_cloud_topics(self) -> list[str]:
        """Names of the PointCloud2 topics."""
        return [name for name, kind in self.topics.items() if kind == POINT_CLOUD2]

    def _list_topics(self) -> str:
        return ', '.join(f'{name} ({kind})' for name, kind in self.topics.items()) or 'none'

    def n_messages(self, topic: str) -> int:
        """Messages of one topic; raises DataError if there is none of that name."""
        if topic not in self._topics:
            raise DataError(f'{self.path}: no topic {topic}; topics here: {self._list_topics()}')
        return self._counts.get(topic, sum(c.n_messages for c in self._topics[topic]))

    def pick_point_cloud_topic(self, topic: str | None = None) -> str:
        """Return `topic` if it has point clouds, or the only one that has; else a DataError."""
        clouds = self.point_cloud_topics
        if topic is not None:
            self.n_messages(topic)
            if topic not in clouds:
                raise DataError(
                    f'{self.path}: topic {topic} is of type {self._kind(topic)}, must be '
                    f'{POINT_CLOUD2}; such topics here: {", ".join(clouds) or "none"}'
                )
            clouds = [topic]
        recorded = [name for name in clouds if self.n_messages(name)]
        if len(recorded) == 1:
            return recorded[0]
        if recorded:
            listed = ', '.join(recorded)
            problem = f'{len(recorded)} {POINT_CLOUD2} topics, choose one with --topic: {listed}'
        elif clouds:
            problem = f'no message on {", ".join(clouds)}'
        else:
            problem = f'no {POINT_CLOUD2} topic; topics here: {self._list_topics()}'
        raise DataError(f'{self.path}: {problem}')

    def messages(self, topics: Collection[str] | None = None) -> Iterator[tuple[str, int, bytes]]:
        """Topic, recorded time [ns] and CDR bytes of each message, by default of all in CDR.

        In order of their time; file after file in a split bag. Raises DataError if a topic is
        unknown, of several types or not in CDR, the bag damaged, or its list of messages wrong.
        """
        expected = {name: self.n_messages(name) for name in topics or ()}
        if topics is None:
            readable = [name for name, channels in self._topics.items() if _is_readable(channels)]
            expected = {name: self.n_messages(name) for name in readable}
        for name in expected:
            if not _is_readable(self._topics[name]):
                raise DataError(
                    f'{self.path}: topic {name} has messages of {self._kind(name)}; '
                    'one topic must have one type, and be in CDR'
                )
        found: Counter[str] = Counter()
        for storage in self._storages:
            names = {
                c.key: c.topic
                for c in storage.channels
                if c.topic in expected and c.encoding == 'cdr'
            }
            for key, time, raw in self._read(storage, names):
                found[names[key]] += 1
                yield names[key], time, raw
        for name, n_messages in expected.items():
            if found[name] != n_messages:
                raise DataError(
                    f'{self.path}: topic {name} lists {n_messages} messages, '
                    f'{found[name]} could be read; the bag is damaged, '
                    f'or its {METADATA_FILE} belongs to another one'
                )

    def _read(self, storage: _Storage, keys: Collection[int]) -> Iterator[tuple[int, int, bytes]]:
        """Messages of one file, unpacked; errors of reading as DataError."""
        source = storage.messages(keys) if keys else iter(())
        while True:
            # Errors of the caller, raised at the yield, must not pass through here.
            with reading(self.path):
                if (entry := next(source, None)) is None:
                    return
                key, time, raw = entry
                if self._is_packed:
                    unpacker = require('zstandard', 'zstandard').ZstdDecompressor()
                    raw = unpacker.decompressobj().decompress(raw)
            yield key, time, bytes(raw)


def _is_readable(channels: Collection[_Channel]) -> bool:
    """Whether the messages of a topic are of one type in CDR."""
    return {c.encoding for c in channels} == {'cdr'} and len({c.msgtype for c in channels}) == 1


class BagWriter:
    """A new rosbag2 bag, in a ``with`` statement; written whole or not at all (`staged_file`).

    `path` is a folder as ``ros2 bag record -o`` makes, or a single file, by its suffix; `storage`
    see `resolve_storage`. With `force` a bag of that name is replaced. Raises DataError if the
    path is taken or cannot be written, MissingDependencyError without rosbags.
    """

    def __init__(
        self, path: str | Path, *, storage: str | None = None, force: bool = False
    ) -> None:
        require('rosbags.highlevel', 'rosbags')
        self.path = Path(path)
        self.storage = resolve_storage(path, storage)
        self._force = force
        self._connections: dict[str, Any] = {}

    def __enter__(self) -> BagWriter:
        """Create the hidden bag."""
        from rosbags.rosbag2 import StoragePlugin, Writer

        with ExitStack() as stack:
            if self.path.suffix in STORAGE_OF_SUFFIX:
                product = stack.enter_context(staged_file(self.path, force=self._force))
                # rosbags writes folders; the one file in it is named after the folder.
                folder = product.parent / 'bag' / product.stem
                file = folder / f'{folder.name}{SUFFIX_OF_STORAGE[self.storage]}'
                stack.push(lambda kind, *_: os.rename(file, product) if kind is None else None)
            else:
                folder = stack.enter_context(staged_bag_folder(self.path, force=self._force))
            stack.enter_context(writing(self.path))
            plugin = StoragePlugin[self.storage.upper()]
            # Version 9 is what Jazzy writes.
            self._writer = stack.enter_context(Writer(folder, version=9, storage_plugin=plugin))
            self._open = stack.pop_all()
        return self

    def __exit__(self, *error: Any) -> None:
        """Give the bag its name, or remove it after an error."""
        self._open.__exit__(*error)

    def add_topic(self, topic: BagTopic) -> None:
        """Declare a topic, before its first message; raises `DataError` if it is there."""
        if topic.name in self._connections:
            raise DataError(f'{self.path}: topic {topic.name} twice')
        with writing(self.path):
            self._connections[topic.name] = self._writer.add_connection(
                topic.name,
                topic.msgtype,
                msgdef=topic.definition,
                rihs01=topic.type_hash,
                offered_qos_profiles=topic.qos,
            )

    def write(self, topic: str, time: int, raw: bytes | memoryview) -> None:
        """Append one message, CDR bytes, to a declared topic with its recorded `time` [ns]."""
        with writing(self.path):
            self._writer.write(self._connections[topic], time, raw)
