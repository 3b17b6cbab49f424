"""Clouds as messages of rclpy, and the quality of service of their topics."""

from __future__ import annotations

import functools
from array import array
from typing import Any

import numpy as np
import numpy.typing as npt
from rclpy.qos import QoSProfile

from gp_ground_seg.data import point_cloud2

OUTPUT_DEPTH = 20  # clouds kept: Fast DDS may send a lost fragment again after 0.7 s only


def message_data(values: npt.NDArray[Any]) -> array[int]:
    """Return the bytes of an array as the one type that rclpy takes without a look at each."""
    data = array('B')
    data.frombytes(np.ascontiguousarray(values).data.cast('B') if values.size else b'')
    return data


select_points = functools.partial(point_cloud2.select_points, as_data=message_data)


def cloud_profile(depth: int = OUTPUT_DEPTH) -> QoSProfile:
    """Return the default of a cloud topic: reliable, volatile, the newest `depth` clouds."""
    return QoSProfile(depth=depth)
