"""ROS 1 messages in ROS 2 form."""

from __future__ import annotations

from typing import Any

from gp_ground_seg.data.rosbags_support import BagTopic, jazzy_types, latched_qos, parse_definition

_HEADER = 'std_msgs/msg/Header'
_RENAMED = {'tf/msg/tfMessage': 'tf2_msgs/msg/TFMessage'}


class Ros1Converter:
    """Turns the messages of a ROS 1 connection into CDR.

    Where ROS 2 Jazzy has the type in the same layout, or does not have it at
    all, the bytes are carried over one to one (only a header's ``seq``, which
    ROS 2 does not have, goes). A type that changed between the two is migrated:
    fields of the same name keep their value, new ones are zero.

    Parameters
    ----------
    connection : rosbags.interfaces.Connection
        Connection of a ROS 1 bag; its message definition must be parseable.

    Attributes
    ----------
    topic : BagTopic
        The topic in ROS 2 terms.
    migrated : bool
        Whether the type changed between ROS 1 and ROS 2.
    """

    def __init__(self, connection: Any) -> None:
        from rosbags.convert.converter import is_same_wireformat

        self._source = parse_definition(connection.msgdef.data, connection.msgtype)
        self._source_type = connection.msgtype
        self._type = _RENAMED.get(connection.msgtype, connection.msgtype)
        self._target = jazzy_types()
        if self._type not in self._target.fielddefs:
            self._target = _with_ros2_header(self._source)
        self.migrated = not is_same_wireformat(
            self._source, self._target, self._source_type, self._type
        )
        self._defaults: dict[str, object] = {}
        definition, _ = self._target.generate_msgdef(self._type, ros_version=2)
        self.topic = BagTopic(
            name=connection.topic,
            msgtype=self._type,
            definition=definition,
            type_hash=self._target.hash_rihs01(self._type),
            qos=latched_qos() if connection.ext.latching else (),
            n_messages=connection.msgcount,
        )

    def convert(self, raw: bytes) -> bytes:
        """One message as CDR."""
        if not self.migrated:
            return bytes(self._target.ros1_to_cdr(raw, self._type))
        from rosbags.convert.converter import migrate_bytes

        return bytes(
            migrate_bytes(
                self._source, self._target, self._source_type, self._type, self._defaults, raw,
                src_is2=False, dst_is2=True,
            )
        )  # fmt: skip


def _with_ros2_header(types: Any) -> Any:
    """Copy of a store whose Header is that of ROS 2."""
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.EMPTY)
    store.register({**types.fielddefs, _HEADER: jazzy_types().fielddefs[_HEADER]})
    return store
