"""A first frame that costs nobody anything."""

from __future__ import annotations

import gc
import math

import numpy as np

from gp_ground_seg.config import Config
from gp_ground_seg.segmenter import GroundSegmenter
from gp_ground_seg.sensor_pose import given_pose

_RINGS = 24
_DIRECTIONS = 64


def warm_up(segmenter: GroundSegmenter) -> float:
    """Segment a small made-up frame, so that all code is compiled before a cloud waits for it.

    What was learned from it is forgotten.

    Returns
    -------
    float
        Time it took [s].
    """
    points = _flat_ground(segmenter.config).astype(np.float32)
    # Compiling makes millions of objects that stay; looking through them for what can go takes
    # a tenth of the time.
    collects = gc.isenabled()
    gc.disable()
    try:
        duration = segmenter.segment(points).timings['total']
    finally:
        if collects:
            gc.enable()
    segmenter.reset()
    return duration


def _flat_ground(config: Config) -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
    """Rings on level ground as the sensor would see them, (N, 3) [m]."""
    nearest = config.grid.r_min
    radius, azimuth = np.meshgrid(
        np.linspace(nearest, min(nearest + 30.0, config.grid.r_max), _RINGS),
        np.linspace(-math.pi, math.pi, _DIRECTIONS, endpoint=False),
    )
    pose = given_pose(config.sensor)
    height = np.full(radius.shape, -pose.height)
    level = np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), height], axis=-1)
    return level.reshape(-1, 3) @ pose.rotation
