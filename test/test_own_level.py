"""Which level is the ground: that the robot stands on, not its body, nor what lies below it."""

import math

import numpy as np
import pytest
from test_sensor_pose import (
    SENSORS,
    SMALL_HDL,
    SMALL_OS1,
    SMALL_VLP,
    pose_of,
    scan_of,
    tilted,
)

from gp_ground_seg.core.pipeline.sensor_pose import CLEAR_TILT
from gp_ground_seg.lab.simulation import Scene
from gp_ground_seg.lab.simulation import terrain as landforms


@pytest.mark.parametrize(
    'scene', [pytest.param('flat', marks=pytest.mark.slow), 'urban', 'car_park']
)
@pytest.mark.parametrize(
    ('length', 'width', 'ahead', 'below'),
    [(3.0, 3.0, 0.0, 0.3), (3.0, 2.2, -1.0, 0.5), (2.4, 1.0, 2.0, 1.0), (8.0, 2.4, -6.0, 1.5)],
    ids=['roof', 'cab', 'bonnet', 'trailer'],
)
def test_the_own_vehicle_is_not_the_ground(scene, length, width, ahead, below):
    # Beside the street is a sidewalk, 0.15 m higher.
    height = pytest.approx(2.4, abs=0.1 if scene == 'urban' else 0.05)
    points = scan_of(scene, SMALL_OS1, 2.4).points[:, :3]
    body = np.random.default_rng(0).uniform(-0.5, 0.5, (20000, 3)) * (length, width, 0.02)
    over = np.concatenate([points, np.add(body, (ahead, 0.0, -below))])
    assert pose_of(over).height == height
    # As the sensor sees it, with what it hides.
    share = np.where(points[:, 2] < -below, -below / np.minimum(points[:, 2], -1e-9), 1.0)
    x, y = points[:, 0] * share - ahead, points[:, 1] * share
    share[(abs(x) > length / 2.0) | (abs(y) > width / 2.0)] = 1.0
    assert pose_of(points * share[:, None]).height == height


LEVELS = {
    'dike': [(-6.0, -1.5), (-3.0, 0.0), (3.0, 0.0), (6.0, -1.5)],
    'dock': [(2.5, 0.0), (2.5, -1.5)],
    'stairs': [(3.0 + 0.3 * ((k + 1) // 2), -0.17 * (k // 2)) for k in range(1, 22)],
}


def level_above(name, sensor, height):
    scene = Scene(name, landforms.polyline(1.3, LEVELS[name]))
    return scan_of(scene, sensor, height).points


@SENSORS
@pytest.mark.parametrize('name', LEVELS)
def test_the_robot_stands_on_the_level_near_it(sensor, name):
    """Lower land beside it, of which more is seen, is not the ground near the sensor."""
    height = 0.8 if sensor is SMALL_VLP else 1.75
    points = level_above(name, sensor, height)
    pose = pose_of(points)
    assert pose.is_level and pose.height == pytest.approx(height, abs=0.05)
    assert pose_of(points, height=height).contradictions == ()
    (line,) = pose_of(points, height=height - 0.5).contradictions
    assert f'sensor.height = {height - 0.5:g}' in line
    # The level of a tilted sensor as well.
    lean = pose_of(tilted(points, 0.1, -0.06))
    np.testing.assert_allclose((lean.roll, lean.pitch), (0.1, -0.06), atol=0.01)
    assert lean.height == pytest.approx(height, abs=0.05)


def test_a_given_level_that_is_seen_as_well_is_not_contradicted():
    """The land on both sides of the dike: which level is meant, the scan does not tell."""
    points = level_above('dike', SMALL_HDL, 1.75)
    assert pose_of(points, height=1.75 + 1.5).contradictions == ()
    assert len(pose_of(points, height=1.75 + 0.75).contradictions) == 1


@SENSORS
@pytest.mark.parametrize('scene', ['valley', 'on_ramp'])
def test_a_slope_nearby_is_not_the_ground_of_the_robot(sensor, scene):
    height = 0.8 if sensor is SMALL_VLP else 1.75
    pose = pose_of(scan_of(scene, sensor, height, seed=2).points)
    assert pose.is_level and pose.height == pytest.approx(height, abs=0.15)


def test_what_is_not_levelled_has_the_height_of_a_level_plane():
    """Hills of which no plane has enough to tell the tilt."""
    found = [pose_of(scan_of('hills', SMALL_OS1, 1.75, seed=seed).points) for seed in range(6)]
    untold = [pose.measured.plane for pose in found if not pose.measured.tells_tilt]
    assert untold
    for plane in untold:
        assert math.hypot(plane.slope_x, plane.slope_y) <= 1.1 * math.tan(CLEAR_TILT)


@SENSORS
def test_noise_below_the_ground_is_left_out(sensor):
    """One point of a hundred, most of them nearer than the ground is seen."""
    height, rng = 0.8 if sensor is SMALL_VLP else 1.75, np.random.default_rng(0)
    points = scan_of('urban', sensor, height).points[:, :3]
    n = len(points) // 100
    azimuth, r = rng.uniform(-np.pi, np.pi, n), 2.0 + rng.exponential(1.5, n)
    z = -height - rng.uniform(0.3, 3.0, n)
    noise = np.column_stack([r * np.cos(azimuth), r * np.sin(azimuth), z])
    pose = pose_of(np.concatenate([points, noise]))
    assert pose.is_level and pose.height == pytest.approx(height, abs=0.1)
