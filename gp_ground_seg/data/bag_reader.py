"""Reading bags: ROS 1, rosbag2 folders, bare MCAP and sqlite3 files."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Collection, Iterator
from pathlib import Path
from types import TracebackType
from typing import Any

from gp_ground_seg.data.bag_files import (
    METADATA_FILE,
    check_is_bag,
    in_one_line,
    is_ros1_bag,
    open_reader,
    reading,
)
from gp_ground_seg.data.ros1_conversion import Ros1Converter
from gp_ground_seg.data.rosbags_support import (
    POINT_CLOUD2,
    UNKNOWN_TYPE_HASH,
    BagTopic,
    jazzy_topic,
    jazzy_types,
    parse_definition,
    require_rosbags,
)
from gp_ground_seg.errors import DataError


def open_bag(path: str | Path) -> BagReader:
    """Open a bag of any kind for reading; use it in a ``with`` statement.

    Raises
    ------
    DataError
        If there is no bag, or it cannot be read.
    MissingDependencyError
        If rosbags is not installed.
    """
    return BagReader(path)


class BagReader:
    """A bag seen as ROS 2 topics with CDR messages; ROS 1 messages are converted.

    Parameters
    ----------
    path : str or Path
        ROS 1 ``.bag``, rosbag2 folder, ``.mcap`` or ``.db3``.

    Raises
    ------
    DataError
        If there is no bag, or it cannot be read.
    MissingDependencyError
        If rosbags is not installed.
    """

    def __init__(self, path: str | Path) -> None:
        require_rosbags()
        self.path = Path(path)
        with reading(self.path):
            check_is_bag(self.path)
        self._converters: dict[int, Ros1Converter] = {}
        self._unconvertible: dict[str, str] = {}
        with reading(self.path):
            self._reader = open_reader(self.path)
        try:
            self._topics = self._describe_topics()
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> BagReader:
        """Return the open bag."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Close the bag."""
        self.close()

    def close(self) -> None:
        """Close the files; nothing can be read afterwards."""
        self._reader.close()

    @property
    def storage(self) -> str:
        """``ros1``, ``mcap`` or ``sqlite3``."""
        if is_ros1_bag(self.path):
            return 'ros1'
        files = self.path.glob('*.db3*') if self.path.is_dir() else [self.path]
        return 'sqlite3' if any('.db3' in file.suffixes for file in files) else 'mcap'

    @property
    def topics(self) -> dict[str, str]:
        """Message type of each topic, as in ``sensor_msgs/msg/PointCloud2``."""
        return {name: topic.msgtype for name, topic in self._topics.items()}

    @property
    def point_cloud_topics(self) -> list[str]:
        """Names of the PointCloud2 topics."""
        return [
            name
            for name, topic in self._topics.items()
            if topic.msgtype == POINT_CLOUD2 and topic.encoding == 'cdr'
        ]

    @property
    def migrated_topics(self) -> list[str]:
        """ROS 1 topics whose type has other fields in ROS 2 (see `Ros1Converter`)."""
        return sorted({c.topic.name for c in self._converters.values() if c.migrated})

    def topic(self, name: str) -> BagTopic:
        """All that is known of a topic.

        Raises
        ------
        DataError
            If there is none of that name; the message lists those there are.
        """
        if name not in self._topics:
            raise DataError(f'{self.path}: no topic {name}; topics here: {self._listing()}')
        return self._topics[name]

    def n_messages(self, topic: str) -> int:
        """Messages of one topic; raises as `topic` does."""
        return self.topic(topic).n_messages

    def pick_point_cloud_topic(self, topic: str | None = None) -> str:
        """Return `topic` if it is one of point clouds with messages, or the only such topic.

        Raises
        ------
        DataError
            If there is none, or the choice is not clear; the message lists the topics.
        """
        if topic is not None:
            if self.topic(topic).msgtype != POINT_CLOUD2:
                raise DataError(
                    f'{self.path}: topic {topic} is of type {self.topics[topic]}, must be '
                    f'{POINT_CLOUD2}; such topics here: '
                    f'{", ".join(self.point_cloud_topics) or "none"}'
                )
            candidates = [topic]
        else:
            candidates = self.point_cloud_topics
        if not candidates:
            raise DataError(
                f'{self.path}: no {POINT_CLOUD2} topic; topics here: {self._listing()}'
            )
        recorded = [name for name in candidates if self.n_messages(name)]
        if not recorded:
            raise DataError(f'{self.path}: no message on {", ".join(candidates)}')
        if len(recorded) > 1:
            raise DataError(
                f'{self.path}: {len(recorded)} {POINT_CLOUD2} topics, choose one with --topic: '
                f'{", ".join(recorded)}'
            )
        return recorded[0]

    def messages(self, topics: Collection[str] | None = None) -> Iterator[tuple[str, int, bytes]]:
        """Messages in order of their recorded time; file after file in a split bag.

        Parameters
        ----------
        topics : collection of str, optional
            Topics wanted; all by default.

        Yields
        ------
        topic : str
            Name of the topic.
        time : int
            Recorded time [ns].
        raw : bytes
            The message as CDR.

        Raises
        ------
        DataError
            If the bag is damaged, a topic is unknown, or fewer messages can be read
            than the bag lists.
        """
        wanted = list(self._topics) if topics is None else list(dict.fromkeys(topics))
        for name in wanted:
            if name in self._unconvertible:
                raise DataError(
                    f'{self.path}: topic {name} ({self.topics[name]}) has a message definition '
                    f'that cannot be converted from ROS 1: {self._unconvertible[name]}'
                )
        expected = Counter({name: self.n_messages(name) for name in wanted})
        connections = [c for c in self._reader.connections if c.topic in expected]
        found: Counter[str] = Counter()
        with reading(self.path):
            source = iter(self._reader.messages(connections=connections) if connections else ())
        while True:
            # The caller's own errors, raised at the yield, must not pass through here.
            with reading(self.path):
                entry = next(source, None)
                if entry is None:
                    break
                connection, time, raw = entry
                converter = self._converters.get(connection.id)
                message = bytes(raw) if converter is None else converter.convert(raw)
            found[connection.topic] += 1
            yield connection.topic, time, message
        for name in wanted:
            if found[name] != expected[name]:
                raise DataError(
                    f'{self.path}: topic {name} lists {expected[name]} messages, '
                    f'{found[name]} could be read; the bag is damaged, '
                    f'or its {METADATA_FILE} belongs to another one'
                )

    def _listing(self) -> str:
        return ', '.join(f'{name} ({kind})' for name, kind in self.topics.items()) or 'none'

    def _describe_topics(self) -> dict[str, BagTopic]:
        topics: dict[str, BagTopic] = {}
        for connection in self._reader.connections:
            topic = self._describe(connection)
            known = topics.get(topic.name)
            if known is None:
                topics[topic.name] = topic
            elif known.msgtype == topic.msgtype:
                # Several publishers of one topic.
                topics[topic.name] = dataclasses.replace(
                    known,
                    n_messages=known.n_messages + topic.n_messages,
                    qos=tuple(dict.fromkeys(known.qos + topic.qos)),
                )
            else:
                raise DataError(
                    f'{self.path}: topic {topic.name} has messages of two types, '
                    f'{known.msgtype} and {topic.msgtype}; one topic must have one type'
                )
        return topics

    def _describe(self, connection: Any) -> BagTopic:
        if is_ros1_bag(self.path):
            try:
                converter = self._converters[connection.id] = Ros1Converter(connection)
            except Exception as error:  # Said when, and only if, the topic is read.
                self._unconvertible[connection.topic] = in_one_line(error)
                return BagTopic(
                    connection.topic, connection.msgtype, '', UNKNOWN_TYPE_HASH,
                    n_messages=connection.msgcount,
                )  # fmt: skip
            return converter.topic
        definition, type_hash = _definition(connection)
        return BagTopic(
            name=connection.topic,
            msgtype=connection.msgtype,
            definition=definition,
            type_hash=type_hash,
            encoding=connection.ext.serialization_format,
            qos=tuple(connection.ext.offered_qos_profiles),
            n_messages=connection.msgcount,
        )


def _definition(connection: Any) -> tuple[str, str]:
    """Definition and hash of a rosbag2 connection; older bags have neither."""
    msgtype, text = connection.msgtype, connection.msgdef.data
    if not text:
        if msgtype not in jazzy_types().fielddefs:
            return '', UNKNOWN_TYPE_HASH
        known = jazzy_topic(connection.topic, msgtype)
        return known.definition, known.type_hash
    if connection.digest:
        return text, connection.digest
    try:
        return text, parse_definition(text, msgtype).hash_rihs01(msgtype)
    except Exception:  # A definition rosbags cannot parse is copied all the same.
        return text, UNKNOWN_TYPE_HASH
