"""Bags: ROS 1, rosbag2 folders, MCAP and sqlite3 files read; rosbag2 written whole or not at all.

The one module that imports rosbags, an optional package; only where a bag is used.
"""

from __future__ import annotations

import dataclasses
import functools
import os
from collections import Counter
from collections.abc import Callable, Collection, Iterator
from contextlib import AbstractContextManager, ExitStack, suppress
from pathlib import Path
from typing import Any

from gp_ground_seg.core.errors import DataError, in_one_line, require
from gp_ground_seg.data.atomic_output import staged_bag_folder, staged_file
from gp_ground_seg.data.bag_files import (
    METADATA_FILE,
    POINT_CLOUD2,
    STORAGE_OF_SUFFIX,
    SUFFIX_OF_STORAGE,
    UNKNOWN_TYPE_HASH,
    BagTopic,
    check_is_bag,
    reading,
    resolve_storage,
    storage_of,
    writing,
)

_HEADER = 'std_msgs/msg/Header'
_RENAMED = {'tf/msg/tfMessage': 'tf2_msgs/msg/TFMessage'}


@functools.cache
def jazzy_types() -> Any:
    """Message types of ROS 2 Jazzy (``rosbags.typesys.store.Typestore``)."""
    require('rosbags.highlevel', 'rosbags')
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS2_JAZZY)


def jazzy_topic(name: str, msgtype: str) -> BagTopic:
    """Topic of a type that is part of ROS 2 Jazzy."""
    return _topic_of(jazzy_types(), name, msgtype, ())


def cloud_topic(name: str) -> BagTopic:
    """PointCloud2 topic offered reliably; with best effort, large clouds get lost when played."""
    return _topic_of(jazzy_types(), name, POINT_CLOUD2, (_reliable_qos('VOLATILE'),))


def _topic_of(types: Any, name: str, msgtype: str, qos: tuple[Any, ...]) -> BagTopic:
    definition, _ = types.generate_msgdef(msgtype, ros_version=2)
    return BagTopic(name, msgtype, definition, types.hash_rihs01(msgtype), qos=qos)


def _reliable_qos(durability: str) -> Any:
    from rosbags import interfaces as ros

    forever = ros.QosTime(9223372036, 854775807)  # RMW_DURATION_INFINITE
    history, liveliness = ros.QosHistory.KEEP_LAST, ros.QosLiveliness.AUTOMATIC
    kind = ros.QosReliability.RELIABLE, ros.QosDurability[durability]
    return ros.Qos(history, 10, *kind, forever, forever, liveliness, forever, False)


@functools.cache
def _parse_definition(text: str, msgtype: str) -> Any:
    """Types of one definition (.msg or .idl text) in a separate store, only to be read."""
    from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore

    store = get_typestore(Stores.EMPTY)
    separator = 80 * '=' + '\n'
    if text.startswith(f'{separator}IDL: '):
        parts = (part.partition('\n')[2] for part in text.split(separator)[1:])
        types = {name: kind for part in parts for name, kind in get_types_from_idl(part).items()}
    else:
        types = get_types_from_msg(text, msgtype)
    store.register(types)
    return store


def _ros2_topic(connection: Any) -> BagTopic:
    """Topic of a rosbag2 connection; older bags have neither definition nor hash."""
    msgtype, text = connection.msgtype, connection.msgdef.data
    type_hash = connection.digest if text else ''
    if not text and msgtype in jazzy_types().fielddefs:
        known = jazzy_topic(connection.topic, msgtype)
        text, type_hash = known.definition, known.type_hash
    elif text and not type_hash:
        with suppress(Exception):  # A definition rosbags cannot parse is copied all the same.
            type_hash = _parse_definition(text, msgtype).hash_rihs01(msgtype)
    encoding, qos = connection.ext
    known_hash = type_hash or UNKNOWN_TYPE_HASH
    return BagTopic(connection.topic, msgtype, text, known_hash, encoding, tuple(qos))


def _ros1_topic(connection: Any) -> tuple[BagTopic, Callable[[bytes], Any]]:
    """Topic of a ROS 1 connection, and a function that converts its messages to CDR."""
    from rosbags.convert.converter import is_same_wireformat, migrate_bytes
    from rosbags.typesys import Stores, get_typestore

    old = connection.msgtype
    new = _RENAMED.get(old, old)
    source, target = _parse_definition(connection.msgdef.data, old), jazzy_types()
    if new not in target.fielddefs:
        header = target.fielddefs[_HEADER]
        target = get_typestore(Stores.EMPTY)
        target.register({**source.fielddefs, _HEADER: header})
    convert: Callable[[bytes], Any] = functools.partial(target.ros1_to_cdr, typename=new)
    # In the same layout only a header's ``seq`` goes; else fields of one name keep their value.
    if not is_same_wireformat(source, target, old, new):
        convert = functools.partial(
            migrate_bytes, source, target, old, new, {}, src_is2=False, dst_is2=True
        )
    qos = (_reliable_qos('TRANSIENT_LOCAL'),) if connection.ext.latching else ()
    return _topic_of(target, connection.topic, new, qos), convert


class BagReader(AbstractContextManager['BagReader']):
    """A bag as ROS 2 topics with CDR messages, to be used in a ``with`` statement.

    `path` is a ROS 1 ``.bag``, whose messages are converted, a rosbag2 folder, ``.mcap`` or
    ``.db3``. Raises DataError if it cannot be read, MissingDependencyError without rosbags.
    """

    def __init__(self, path: str | Path) -> None:
        require('rosbags.highlevel', 'rosbags')
        from rosbags import rosbag1, rosbag2

        self.path = Path(path)
        self.storage = storage_of(self.path)  # ``ros1``, ``mcap`` or ``sqlite3``
        self._converters: dict[int, Callable[[bytes], Any]] = {}
        with ExitStack() as stack:
            with reading(self.path):
                check_is_bag(self.path)
                rosbag: Any = rosbag1 if self.storage == 'ros1' else rosbag2
                reader = rosbag.Reader(self.path)
                reader.open()
                stack.callback(reader.close)
            self._reader = reader
            self._topics: dict[str, BagTopic] = {}
            for connection in reader.connections:
                self._add(self._describe(connection), connection.msgcount)
            self._open = stack.pop_all()

    def __exit__(self, *error: object) -> None:
        """Close the files; nothing can be read afterwards."""
        self._open.close()

    @property
    def topics(self) -> dict[str, str]:
        """Message type of each topic, as in ``sensor_msgs/msg/PointCloud2``."""
        return {name: topic.msgtype for name, topic in self._topics.items()}

    @property
    def point_cloud_topics(self) -> list[str]:
        """Names of the PointCloud2 topics."""
        kind = POINT_CLOUD2, 'cdr'
        return [name for name, t in self._topics.items() if (t.msgtype, t.encoding) == kind]

    def topic(self, name: str) -> BagTopic:
        """Return the description of a topic; raises DataError if there is none of that name."""
        if name not in self._topics:
            raise DataError(f'{self.path}: no topic {name}; topics here: {self._list_topics()}')
        return self._topics[name]

    def _list_topics(self) -> str:
        return ', '.join(f'{name} ({kind})' for name, kind in self.topics.items()) or 'none'

    def n_messages(self, topic: str) -> int:
        """Messages of one topic; raises as `topic` does."""
        return self.topic(topic).n_messages

    def pick_point_cloud_topic(self, topic: str | None = None) -> str:
        """Return `topic` if it has point clouds, or the only one that has; else a DataError."""
        clouds = self.point_cloud_topics
        if topic is not None:
            if (msgtype := self.topic(topic).msgtype) != POINT_CLOUD2:
                raise DataError(
                    f'{self.path}: topic {topic} is of type {msgtype}, must be {POINT_CLOUD2}; '
                    f'such topics here: {", ".join(clouds) or "none"}'
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
        """Topic, recorded time [ns] and CDR bytes of each message, of all topics by default.

        In order of their time; file after file in a split bag. Raises DataError if a topic is
        unknown, the bag damaged, or its list of messages wrong.
        """
        wanted = {name: self.topic(name) for name in (self._topics if topics is None else topics)}
        for name, topic in wanted.items():
            if topic.problem:
                raise DataError(
                    f'{self.path}: topic {name} ({topic.msgtype}) has a message definition '
                    f'that cannot be converted from ROS 1: {topic.problem}'
                )
        connections = [c for c in self._reader.connections if c.topic in wanted]
        found: Counter[str] = Counter()
        source = iter(self._reader.messages(connections=connections) if connections else ())
        while True:
            # Errors of the caller, raised at the yield, must not pass through here.
            with reading(self.path):
                if (entry := next(source, None)) is None:
                    break
                connection, time, raw = entry
                message = bytes(self._converters.get(connection.id, bytes)(raw))
            found[connection.topic] += 1
            yield connection.topic, time, message
        for name, topic in wanted.items():
            if found[name] != topic.n_messages:
                raise DataError(
                    f'{self.path}: topic {name} lists {topic.n_messages} messages, '
                    f'{found[name]} could be read; the bag is damaged, '
                    f'or its {METADATA_FILE} belongs to another one'
                )

    def _add(self, topic: BagTopic, n_messages: int) -> None:
        """Add a topic, or another of its publishers."""
        known = self._topics.setdefault(topic.name, topic)
        if known.msgtype != topic.msgtype:
            raise DataError(
                f'{self.path}: topic {topic.name} has messages of two types, {known.msgtype} and '
                f'{topic.msgtype}; one topic must have one type'
            )
        self._topics[topic.name] = dataclasses.replace(
            known,
            n_messages=known.n_messages + n_messages,
            qos=tuple(dict.fromkeys((*known.qos, *topic.qos))),
            problem=known.problem or topic.problem,
        )

    def _describe(self, connection: Any) -> BagTopic:
        if self.storage != 'ros1':
            return _ros2_topic(connection)
        try:
            topic, self._converters[connection.id] = _ros1_topic(connection)
        except Exception as error:  # Reported when, and only if, the topic is read.
            name, msgtype, problem = connection.topic, connection.msgtype, in_one_line(error)
            return BagTopic(name, msgtype, '', UNKNOWN_TYPE_HASH, problem=problem)
        return topic


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
                serialization_format=topic.encoding,
                offered_qos_profiles=topic.qos,
            )

    def write(self, topic: str, time: int, raw: bytes | memoryview) -> None:
        """Append one message, CDR bytes, to a declared topic with its recorded `time` [ns]."""
        with writing(self.path):
            self._writer.write(self._connections[topic], time, raw)
