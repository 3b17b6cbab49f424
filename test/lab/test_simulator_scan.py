"""Scans: sensors and mounts, labels against geometry, noise, occlusion, reflections, scenes."""

import math
from dataclasses import replace

import numpy as np
import pytest
from conftest import scene_of, simulated
from matplotlib.path import Path
from scipy.spatial import cKDTree
from scipy.spatial.distance import pdist

from gp_ground_seg.lab.simulation import (
    HDL_64E,
    PLACES,
    SCENES,
    SEMANTIC_KITTI,
    SENSORS,
    Kind,
    Scene,
    objects,
    simulate_scan,
    traffic,
)
from gp_ground_seg.lab.simulation.scenes import WetPatch
from gp_ground_seg.lab.simulation.terrain import flat, slope

COARSE = replace(HDL_64E, n_columns=240)
EXACT = replace(COARSE, range_std=0.0, dropout=0.0)
DENSE = replace(EXACT, n_columns=700)
FLAT = Scene('bare', flat())
# Steepest face in any scene is a kerb's, 0.15 m up over 0.05 m.
STEEPEST = 3.0


@pytest.fixture(params=SCENES, scope='module')
def scene(request):
    return scene_of(request.param, 7)


def in_world(made):
    return made.points[:, :3].astype(float) @ made.rotation.T + made.position


# Sensors.


@pytest.mark.parametrize(
    ('name', 'n_beams', 'top', 'bottom'),
    [
        ('hdl-64e', 64, 2.0, -24.33),
        ('hdl-32e', 32, 10.67, -30.67),
        ('vlp-16', 16, 15.0, -15.0),
        ('os1-128', 128, 22.5, -22.5),
    ],
)
def test_rays_go_ring_by_ring_counter_clockwise(name, n_beams, top, bottom):
    sensor = SENSORS[name]
    x, y, z = np.moveaxis(sensor.directions(0.001).reshape(n_beams, sensor.n_columns, 3), 2, 0)
    np.testing.assert_allclose(np.hypot(np.hypot(x, y), z), 1.0)
    elevation = np.degrees(np.arcsin(z))
    assert (elevation.max(), elevation.min()) == pytest.approx((top, bottom))
    assert np.ptp(elevation, axis=1).max() < 1e-9 and (np.diff(elevation[:, 0]) < 0.0).all()
    assert (np.diff(np.arctan2(y, x) % math.tau, axis=1) > 0.0).all()


def test_mid_360_fills_its_field_of_view_and_never_repeats():
    first, second = (SENSORS['mid-360'].directions(phase) for phase in (0.1, 0.2))
    assert first.shape == (20_000, 3)
    np.testing.assert_allclose(np.linalg.norm(first, axis=1), 1.0)
    elevation = np.degrees(np.arcsin(first[:, 2]))
    assert (elevation.min(), elevation.max()) == pytest.approx((-7.0, 52.0), abs=0.1)
    # Evenly over the sphere: every cell of 10 degrees by a tenth of the height has its share.
    azimuth = np.arctan2(first[:, 1], first[:, 0])
    cells, *_ = np.histogram2d(azimuth, first[:, 2], bins=(36, 10))
    assert cells.min() > 0.7 * cells.mean()
    assert np.median(cKDTree(second).query(first)[0]) > 1e-3


def flat_scan(**changes):
    return simulated(FLAT, replace(EXACT, **changes)).points[:, :3].astype(float)


def test_limits_dropout_and_noise_are_those_of_the_sensor():
    distance = np.linalg.norm(flat_scan(min_range=6.0, max_range=25.0, range_std=0.5), axis=1)
    assert distance.min() >= 6.0 - 1e-5
    assert 24.0 < distance.max() <= 25.0 + 1e-5
    exact = flat_scan()
    n, kept = len(exact), len(flat_scan(dropout=0.3))
    assert abs(kept - 0.7 * n) < 5.0 * math.sqrt(0.3 * 0.7 * n)
    # Noise is along the ray.
    noisy = flat_scan(range_std=0.05)
    noise = np.linalg.norm(noisy, axis=1) - np.linalg.norm(exact, axis=1)
    assert noise.std() == pytest.approx(0.05, rel=0.05)
    assert abs(noise.mean()) < 0.002
    np.testing.assert_allclose(np.cross(exact, noisy) / 120.0**2, 0.0, atol=1e-6)


def test_a_cloud_in_the_vehicle_frame_is_that_of_the_sensor_moved():
    tilted = replace(DENSE, roll=0.3, pitch=-0.1, origin=(1.2, -0.4, 1.5))
    made = simulated(FLAT, tilted)
    assert tilted.height_of_cloud == pytest.approx(0.23)
    np.testing.assert_allclose(made.points[:, 2], -0.23, atol=2e-5)
    np.testing.assert_allclose(made.ground_z, -0.23, atol=1e-9)
    np.testing.assert_array_equal(made.rotation, np.eye(3))
    np.testing.assert_allclose(made.position, [-1.2, 0.4, 0.23])
    # The rays start at the sensor: its beams are cones about the axis it turns around.
    rays = (made.points[:, :3].astype(float) - tilted.origin) @ tilted.rotation()
    elevation = np.arcsin(rays[:, 2] / np.linalg.norm(rays, axis=1))
    assert np.abs(elevation[:, None] - tilted.elevations).min(axis=1).max() < 1e-5
    assert SENSORS['hdl-64e-vehicle'].height_of_cloud == 0.0


def test_a_merged_cloud_is_of_both_sensors_in_one_frame():
    pair = SENSORS['vlp-32c-pair']
    made, upright = (
        simulated('hidden_climb', sensor, 1) for sensor in (pair, replace(pair, others=()))
    )
    n = len(upright.points)
    np.testing.assert_array_equal(made.points[:n], upright.points)
    np.testing.assert_array_equal(made.object_id[:n], upright.object_id)
    assert len(made.points) > 1.5 * n
    # One ground in both: that of the terrain.
    for part in (slice(None, n), slice(n, None)):
        error = (made.points[:, 2] - made.ground_z)[part][made.is_ground[part]]
        assert np.abs(error).max() < 0.1


# Scans of all scenes.


def test_labels_and_heights_are_those_of_the_terrain(scene):
    noisy, exact = simulated(scene, COARSE), simulated(scene, EXACT)
    assert np.isfinite(noisy.points).all() and np.isfinite(noisy.ground_z).all()
    assert ((noisy.points[:, 3] >= 0.0) & (noisy.points[:, 3] <= 1.0)).all()
    classes = [40, 44, 48, 49, 60, 72]
    np.testing.assert_array_equal(np.isin(SEMANTIC_KITTI[noisy.kind], classes), noisy.is_ground)
    height = (noisy.points[:, 2] - noisy.ground_z)[noisy.is_ground]
    assert np.abs(height).max() < 6.0 * COARSE.range_std * math.hypot(1.0, STEEPEST)
    assert np.median(np.abs(height)) < COARSE.range_std
    assert SEMANTIC_KITTI.tolist() == [40, 10, 50, 80, 52, 1, 70, 30, 31]
    height, kind = exact.points[:, 2] - exact.ground_z, exact.kind
    # float32 keeps 7 digits of 120 m, and a kerb's face triples what is lost across it.
    assert np.abs(height[exact.is_ground]).max() < 3e-5
    assert exact.is_ground.sum() > (1000 if scene.name in PLACES else 2500)
    # Solids are above the ground, reflections below.
    solid = ~np.isin(kind, [Kind.TERRAIN, Kind.REFLECTION])
    assert solid.sum() > 20
    assert height[solid].min() > -3e-5
    floating = [Kind.OVERHANG] if scene.name == 'hedge' else [Kind.OVERHANG, Kind.VEGETATION]
    assert (height[np.isin(kind, floating)] > 0.5).all()
    assert (height[kind == Kind.REFLECTION] < -0.0999).all()


def test_objects_have_one_kind_one_place_and_room(scene):
    made = simulated(scene, EXACT)
    numbered, world = made.object_id > 0, in_world(made)
    assert np.isin(made.kind[numbered], [Kind.BOX, Kind.PERSON, Kind.CYCLIST]).all()
    assert numbered[np.isin(made.kind, [Kind.PERSON, Kind.CYCLIST])].all()
    for number in np.unique(made.object_id[numbered]):
        returns = made.object_id == number
        assert len(set(made.kind[returns])) == 1
        assert np.hypot(*np.ptp(world[returns, :2], axis=0)) < 12.1  # a truck
    if scene.name in PLACES:
        # None stands in another, or where the own car is.
        at = np.array(sorted({solid.part_of for solid in scene.solids if solid.part_of}))
        assert len(at) < 2 or pdist(at).min() > 0.5
        near = (np.abs(world[:, 0]) < 2.3) & (np.abs(world[:, 1]) < 0.95)
        assert not (near & ~made.is_ground).any()


def test_a_tilted_sensor_on_a_drive_sees_the_same_world(scene):
    """Points and feet are on the terrain; a scan depends on place, scene and seed only."""
    tilted = replace(EXACT, n_columns=24, roll=-0.1, pitch=0.12)

    def scan_at(seed, scene=scene):
        return simulate_scan(scene, tilted, np.random.default_rng(seed), x=1.5)

    made = scan_at(5)
    foot = made.position - tilted.height * (made.rotation @ tilted.rotation().T)[:, 2]
    expected = [1.5, 0.0, float(scene.terrain.height(1.5, 0.0))]
    np.testing.assert_allclose(foot, expected, atol=1e-12)
    returns = made.points[:, :3].astype(float)
    feet = np.column_stack([returns[:, :2], made.ground_z])
    # On a kerb's face to the digits that are left of it.
    for local, tolerance in ((returns[made.is_ground], 5e-5), (feet, 1e-6)):
        x, y, z = (local @ made.rotation.T + made.position).T
        np.testing.assert_allclose(z, scene.terrain.height(x, y), atol=tolerance)
    assert np.array_equal(made.points, scan_at(5, SCENES[scene.name](7)).points)
    assert not np.array_equal(made.points, scan_at(6).points)
    assert not np.array_equal(made.points, scan_at(5, scene_of(scene.name)).points)


# Hidden, mirrored, and seen from a slope.


def test_nothing_is_seen_behind_a_wall():
    wall = objects.wall(FLAT.terrain, (10.0, -3.0), (10.0, 3.0), 30.0)
    behind = (
        *objects.car(FLAT.terrain, 20.0, 0.0),
        objects.pole(FLAT.terrain, 15.0, 1.0),
        objects.floating_box(FLAT.terrain, 30.0, 0.0, (5.0, 5.0, 1.0), 2.0),
    )
    walled = Scene('wall', FLAT.terrain, (*wall, *behind))
    # The noise of a ray does not depend on the scene: nothing changes away from the wall.
    noisy = [simulated(scene, COARSE).points for scene in (walled, FLAT)]
    np.testing.assert_array_equal(*(points[points[:, 0] < -1.0] for points in noisy))
    result = simulated(walled, EXACT)
    x, y, _, _ = result.points.T
    shadow = (x > 0.0) & (np.abs(y) < 0.299 * x)
    assert x[shadow].max() < 9.86
    assert set(result.kind[shadow]) == {Kind.TERRAIN, Kind.WALL}


def test_reflections_are_mirror_images():
    """On a level wet road the image of a wall's face is that face, below the ground."""
    wall = objects.wall(FLAT.terrain, (12.0, -6.0), (12.0, 6.0), 2.0)
    dry, result, mirrored = (
        simulated(Scene('wet', FLAT.terrain, wall, (WetPatch(9.0, 0.0, 2.0, share),)), EXACT)
        for share in (0.0, 0.7, 1.0)
    )
    x, _, z, _ = result.points[result.kind == Kind.REFLECTION].T
    assert len(x) > 30
    np.testing.assert_allclose(x, 12.0 - 0.15, atol=1e-5)
    assert (z >= -1.73 - 2.0 - 1e-5).all()
    share = len(x) / np.sum(mirrored.kind == Kind.REFLECTION)
    assert share == pytest.approx(0.7, abs=0.1)
    assert not (dry.kind == Kind.REFLECTION).any()
    assert len(dry.points) == len(result.points)


@pytest.mark.parametrize('heading', [0.0, -2.0])
def test_a_vehicle_that_leans_sees_a_slope_as_level_ground(heading):
    made = simulated(Scene('hill', slope(0.3, heading, 2.0), leans=True), EXACT)
    normal = np.array([-0.3 * math.cos(heading), -0.3 * math.sin(heading), 1.0])
    normal /= np.linalg.norm(normal)
    np.testing.assert_allclose(made.position, [0.0, 0.0, 2.0] + 1.73 * normal, atol=1e-12)
    np.testing.assert_allclose(made.rotation[:, 2], normal, atol=1e-12)
    np.testing.assert_allclose(made.rotation @ made.rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(made.rotation) == pytest.approx(1.0)
    assert made.rotation[0, 0] > 0.9 and made.rotation[1, 0] == 0.0  # it drives along x
    np.testing.assert_allclose(made.ground_z, -1.73, atol=1e-7)
    # What a level sensor sees on level ground, a leaning one sees on the slope.
    on_flat = simulated(FLAT, EXACT).points
    np.testing.assert_allclose(made.points[:, :3], on_flat[:, :3], atol=1e-4)


# Objects.


@pytest.mark.parametrize('name', traffic.MODELS)
def test_returns_of_a_vehicle_on_a_slope_lie_on_it(name):
    """In the axes of the vehicle no return is outside length, width and profile."""
    model, terrain, yaw = traffic.MODELS[name], slope(0.12, 0.4), -2.0
    x, y, tall = 8.0, 2.0, replace(DENSE, elevations=SENSORS['os1-128'].elevations)
    made = simulated(Scene('one', terrain, traffic.vehicle(terrain, name, x, y, yaw)), tall)
    dx, dy, z = (in_world(made) - [x, y, 0.0]).T
    returns = made.object_id == 1
    ahead = dx * math.cos(yaw) + dy * math.sin(yaw)
    left = dy * math.cos(yaw) - dx * math.sin(yaw)
    # Ground is seen below it.
    is_below = (np.abs(ahead) < 0.45 * model.length) & (np.abs(left) < 0.3 * model.width)
    assert (made.is_ground & is_below).any()
    above = (z - terrain.height(x + dx, y + dy))[returns]
    ahead, left = ahead[returns], left[returns]
    assert len(above) > 300
    assert np.abs(ahead).max() <= model.length / 2 + 1e-4
    assert np.abs(left).max() <= model.width / 2 + 1e-4
    assert above.min() >= -1e-4
    # Each return lies in one of the outlines, seen from the side, or on a wheel.
    seen, hair = np.column_stack([ahead, above]), 2e-3
    inside = np.zeros(len(seen), dtype=bool)
    for _, corners in model.bodies:
        for sign in (-hair, hair):
            inside |= Path(corners).contains_points(seen, radius=sign)
    for axle in model.axles:
        inside |= np.hypot(ahead - axle, above - model.wheel) < model.wheel + hair
    assert inside.all()
    assert above.max() > 0.95 * max(z for _, corners in model.bodies for _, z in corners)


# Solids, objects, heights of the lowest and of the highest object [m], slopes of half of the
# ground and of the steepest [degrees].
MEASURES = {
    'flat': (65, 12, 1.5, 1.5, 0, 0), 'slope': (64, 12, 1.5, 1.5, 4.57, 4.57),
    'ramp': (61, 12, 1.5, 1.5, 0, 6.84), 'rough': (64, 12, 1.5, 1.5, 2.56, 7.08),
    'road_then_rubble': (64, 12, 1.5, 1.5, 0, 36.44), 'kerb': (64, 12, 1.5, 1.5, 0, 71.57),
    'ditch': (61, 12, 1.5, 1.5, 0, 38.66), 'crest': (64, 12, 1.5, 1.5, 0, 4.57),
    'urban': (255, 33, 1.5, 3.6, 0, 71.57), 'traffic_jam': (661, 112, 1.45, 3.6, 0, 71.57),
    'car_park': (1554, 263, 1.474, 1.731, 0.73, 0.73),
    'hidden_climb': (105, 20, 1.45, 1.946, 0, 5.76),
    'wet_road': (661, 112, 1.45, 3.6, 0, 71.57), 'blind_slope': (64, 12, 1.5, 1.5, 7.51, 7.51),
    'low_boxes': (40, 40, 0.2, 0.6, 0, 0), 'low_boxes_rough': (40, 40, 0.2, 0.6, 2.56, 7.08),
    'lying_persons': (35, 35, 0.22, 0.22, 0, 0), 'hills': (52, 12, 0.404, 2.142, 10.16, 29.84),
    'valley': (60, 16, 0.402, 2.437, 5.28, 23.28), 'bank': (60, 16, 0.434, 1.928, 1.46, 17.46),
    'on_ramp': (52, 12, 0.426, 1.948, 0.7, 13.43), 'dike': (60, 16, 0.404, 1.7, 1.36, 27.5),
    'hedge': (843, 1, 1.7, 1.7, 1.17, 3.33),
}  # fmt: skip


@pytest.mark.parametrize('name', SCENES)
def test_every_scene_has_its_measures(name):
    scene = scene_of(name, 0)
    at = np.random.default_rng(0).uniform(-40.0, 40.0, (2, 4000)).T
    degrees = np.degrees(np.arctan(np.linalg.norm(scene.terrain.gradient(at), axis=1)))
    _, *heights = objects.object_heights(scene.terrain, scene.solids)
    found = len(scene.solids), len(heights), min(heights), max(heights)
    assert (*found, np.median(degrees), degrees.max()) == pytest.approx(MEASURES[name], abs=0.01)
