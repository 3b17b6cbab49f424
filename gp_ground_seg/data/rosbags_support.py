"""What every module about bags needs of the optional package rosbags."""

from __future__ import annotations

import functools
import importlib
from dataclasses import dataclass
from typing import Any

from gp_ground_seg.errors import MissingDependencyError

POINT_CLOUD2 = 'sensor_msgs/msg/PointCloud2'

# What rosbag2 itself stores for a type whose definition it never saw is not a valid hash.
UNKNOWN_TYPE_HASH = 'RIHS01_' + 64 * '0'


@dataclass(frozen=True)
class BagTopic:
    """A topic in ROS 2 terms.

    Attributes
    ----------
    name, msgtype : str
        As in ``/points``, ``sensor_msgs/msg/PointCloud2``.
    definition : str
        Text of the message definition, empty if unknown.
    type_hash : str
        RIHS01 hash of the type.
    encoding : str
        Serialisation of the messages, ``cdr`` for all ROS 2 writes itself.
    qos : tuple
        Profiles offered by the publishers (``rosbags.interfaces.Qos``).
    n_messages : int
        Messages in the bag.
    """

    name: str
    msgtype: str
    definition: str
    type_hash: str
    encoding: str = 'cdr'
    qos: tuple[Any, ...] = ()
    n_messages: int = 0


def require_rosbags() -> None:
    """Raise unless rosbags can be imported.

    Raises
    ------
    MissingDependencyError
        If it cannot; the message says how to install it.
    """
    try:
        importlib.import_module('rosbags.highlevel')
    except ImportError as error:
        raise MissingDependencyError(
            f"bags need the package rosbags ({error}): pip install 'gp_ground_seg[bags]'"
        ) from error


@functools.cache
def jazzy_types() -> Any:
    """Message types of ROS 2 Jazzy (``rosbags.typesys.store.Typestore``)."""
    require_rosbags()
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS2_JAZZY)


@functools.cache
def parse_definition(text: str, msgtype: str) -> Any:
    """Types of one definition (.msg or .idl text) in a store of their own, to read only."""
    from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore

    types: dict[str, Any] = {}
    separator = 80 * '=' + '\n'
    if text.startswith(f'{separator}IDL: '):
        for part in text.split(separator)[1:]:
            types.update(get_types_from_idl(part.partition('\n')[2]))
    else:
        types.update(get_types_from_msg(text, msgtype))
    store = get_typestore(Stores.EMPTY)
    store.register(types)
    return store


def jazzy_topic(name: str, msgtype: str, qos: tuple[Any, ...] = ()) -> BagTopic:
    """Topic of a type that ROS 2 Jazzy brings along."""
    types = jazzy_types()
    definition, _ = types.generate_msgdef(msgtype, ros_version=2)
    return BagTopic(name, msgtype, definition, types.hash_rihs01(msgtype), qos=qos)


def cloud_topic(name: str) -> BagTopic:
    """PointCloud2 topic offered reliably, as the outputs of the node are.

    A player takes the profile from the bag, and best effort loses large clouds.
    """
    return jazzy_topic(name, POINT_CLOUD2, (_qos('RELIABLE', 'VOLATILE'),))


def latched_qos() -> tuple[Any, ...]:
    """Profile of a latched ROS 1 publisher."""
    return (_qos('RELIABLE', 'TRANSIENT_LOCAL'),)


def _qos(reliability: str, durability: str) -> Any:
    require_rosbags()
    from rosbags.interfaces import (
        Qos,
        QosDurability,
        QosHistory,
        QosLiveliness,
        QosReliability,
        QosTime,
    )

    forever = QosTime(9223372036, 854775807)  # RMW_DURATION_INFINITE
    return Qos(
        QosHistory.KEEP_LAST,
        10,
        QosReliability[reliability],
        QosDurability[durability],
        forever,
        forever,
        QosLiveliness.AUTOMATIC,
        forever,
        avoid_ros_namespace_conventions=False,
    )
