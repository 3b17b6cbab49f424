"""Stage 2: lengths in proportion to the height of a low sensor.

A small robot must stop for objects that a car drives over. Its level beams hit objects at the
height of the sensor, for example 0.4 m: far from the last ring on the ground, a gate wider than
that would accept trunks, persons and cars as ground.
"""

from __future__ import annotations

from gp_ground_seg.core.parameters.config import Config, find_spec
from gp_ground_seg.core.pipeline.sensor_pose import SensorPose

REFERENCE_HEIGHT = 1.0
"""Height of a sensor over the ground from which parameters are used as they are given [m]."""
LOWEST = 0.1
"""Height below which the origin of a cloud is no sensor [m]."""
LEAST_TOLERANCE = 0.04
"""Least tolerance of ground that a low sensor leads to [m]: twice the noise of its ranges."""


def for_sensor(config: Config, pose: SensorPose) -> Config:
    """Return `config` with what depends on the height of the sensor in proportion to it.

    These are the gates of the growth, the tolerance of ground and the least height of obstacles;
    nothing for a sensor that is as high as `REFERENCE_HEIGHT`, or that is not seen to be lower.
    """
    share = sensor_height_of(pose) / REFERENCE_HEIGHT
    if share >= 1.0 or config.label.rule != 'roughness':
        return config
    names = (
        'grid.r_min',
        'growth.seed_height_tolerance',
        'growth.max_std',
        'label.ground_tolerance',
        'label.obstacle_min_height',
    )
    least = {name: float(find_spec(name).minimum or 0.0) for name in names}
    least['label.ground_tolerance'] = min(LEAST_TOLERANCE, config.label.ground_tolerance)
    return config.replace(**{name: max(share * config[name], least[name]) for name in names})


def sensor_height_of(pose: SensorPose) -> float:
    """Height of a low sensor over the ground, `REFERENCE_HEIGHT` of others [m]."""
    is_there = pose.starts_rays and pose.sensor_height >= LOWEST
    return min(pose.sensor_height, REFERENCE_HEIGHT) if is_there else REFERENCE_HEIGHT
