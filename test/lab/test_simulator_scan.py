"""Scans: sensors, labels against geometry, noise, occlusion, reflections, tilt, drives."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from conftest import scene_of, simulated
from scipy.spatial import cKDTree

from gp_ground_seg.lab.simulation import (
    HDL_64E,
    PLACES,
    SCENES,
    SENSORS,
    Kind,
    Scene,
    objects,
    semantic_kitti_labels,
    simulate_drive,
)
from gp_ground_seg.lab.simulation.scenes import WetPatch
from gp_ground_seg.lab.simulation.terrain import flat, slope

COARSE = replace(HDL_64E, n_columns=240)
EXACT = replace(COARSE, range_std=0.0, dropout=0.0)
FEW = replace(HDL_64E, n_columns=40)
FLAT = Scene('bare', flat())
ARRAYS = ('points', 'is_ground', 'ground_z', 'kind', 'object_id')
# Steepest face in any scene is a kerb's, 0.15 m up over 0.05 m.
STEEPEST = 3.0


@pytest.fixture(params=SCENES, scope='module')
def scene(request):
    return scene_of(request.param, 7)


@pytest.mark.parametrize(
    ('name', 'n_beams', 'top', 'bottom'),
    [
        ('hdl-64e', 64, 2.0, -24.33),
        ('hdl-32e', 32, 10.67, -30.67),
        ('vlp-16', 16, 15.0, -15.0),
        ('os1-128', 128, 22.5, -22.5),
        ('at128', 128, 12.5, -12.9),
    ],
)
def test_fields_of_view(name, n_beams, top, bottom):
    sensor = SENSORS[name]
    rays = sensor.directions(0.0)
    assert rays.shape == (n_beams * sensor.n_columns, 3)
    np.testing.assert_allclose(np.linalg.norm(rays, axis=1), 1.0)
    elevation = np.degrees(np.arcsin(rays[:, 2]))
    assert (elevation.max(), elevation.min()) == pytest.approx((top, bottom))
    azimuth = np.abs(np.degrees(np.arctan2(rays[:, 1], rays[:, 0])))
    assert azimuth.max() == pytest.approx(60.0 if name == 'at128' else 180.0, abs=0.3)
    assert azimuth.min() < 0.3
    steps = {-1.0 / 3.0, -0.5} if name == 'hdl-64e' else {(bottom - top) / (n_beams - 1)}
    found = set(np.diff(np.degrees(sensor.elevations)).round(2))
    assert found == {round(step, 2) for step in steps}


def test_mid_360_fills_its_field_of_view_and_never_repeats():
    sensor = SENSORS['mid-360']
    first, second = sensor.directions(0.1), sensor.directions(0.2)
    assert first.shape == (20_000, 3)
    np.testing.assert_allclose(np.linalg.norm(first, axis=1), 1.0)
    elevation = np.degrees(np.arcsin(first[:, 2]))
    assert -7.0 <= elevation.min() < -6.9
    assert 51.9 < elevation.max() <= 52.0
    # Evenly over the sphere: every cell of 10 degrees by a tenth of the height has its share.
    azimuth = np.arctan2(first[:, 1], first[:, 0])
    cells, *_ = np.histogram2d(azimuth, first[:, 2], bins=(36, 10))
    assert cells.min() > 0.7 * cells.mean()
    assert np.median(cKDTree(second).query(first)[0]) > 1e-3
    result = simulated(FLAT, sensor)
    assert len(result.points) > 1000
    assert result.is_ground.all()


def test_rays_are_ordered_ring_by_ring_counter_clockwise():
    x, y, z = simulated(FLAT, COARSE).points[:, :3].T.astype(float)
    elevation = np.arctan2(z, np.hypot(x, y))
    beams = np.array(COARSE.elevations)
    ring = np.abs(elevation[:, None] - beams).argmin(axis=1)
    np.testing.assert_allclose(elevation, beams[ring], atol=1e-5)
    assert (np.diff(ring) >= 0).all()
    azimuth = np.arctan2(y, x) % (2.0 * np.pi)
    assert (np.diff(azimuth)[np.diff(ring) == 0] > 0.0).all()


def test_points_are_typed_and_ground_is_terrain(scene):
    result, noisy = simulated(scene, EXACT), simulated(scene, COARSE)
    n = len(noisy.points)
    types = (np.float32, np.bool_, np.float64, np.uint8, np.int32)
    for name, dtype in zip(ARRAYS, types, strict=True):
        values = getattr(noisy, name)
        assert (values.dtype, values.shape) == (dtype, (n, 4) if name == 'points' else (n,))
        assert np.isfinite(values).all(), name
    assert ((noisy.points[:, 3] >= 0.0) & (noisy.points[:, 3] <= 1.0)).all()
    np.testing.assert_array_equal(noisy.is_ground, noisy.kind == Kind.TERRAIN)
    ground = np.isin(semantic_kitti_labels(noisy.kind), [40, 44, 48, 49, 60, 72])
    np.testing.assert_array_equal(ground, noisy.is_ground)

    height = (noisy.points[:, 2] - noisy.ground_z)[noisy.is_ground]
    assert np.abs(height).max() < 6.0 * COARSE.range_std * math.hypot(1.0, STEEPEST)
    assert np.median(np.abs(height)) < COARSE.range_std
    height = result.points[:, 2] - result.ground_z
    # float32 keeps 7 digits of 120 m, and a kerb's face triples what is lost across it.
    assert np.abs(height[result.is_ground]).max() < 3e-5
    assert result.is_ground.sum() > (1000 if scene.name in PLACES else 2500)
    # Solids are above the ground, reflections below.
    solid = ~np.isin(result.kind, [Kind.TERRAIN, Kind.REFLECTION])
    assert solid.sum() > 20
    assert height[solid].min() > -3e-5
    floating = [Kind.OVERHANG] if scene.name == 'hedge' else [Kind.OVERHANG, Kind.VEGETATION]
    assert (height[np.isin(result.kind, floating)] > 0.5).all()
    assert (height[result.kind == Kind.REFLECTION] < -0.0999).all()


def test_numbers_of_objects_go_with_their_kinds_and_the_own_car_has_room(scene):
    made = simulated(scene, EXACT)
    walls = [Kind.WALL] if scene.name == 'low_walls' else []
    numbered = made.object_id > 0
    assert np.isin(made.kind[numbered], [Kind.BOX, Kind.PERSON, Kind.CYCLIST, *walls]).all()
    assert numbered[np.isin(made.kind, [Kind.PERSON, Kind.CYCLIST, *walls])].all()
    world = made.points[:, :3].astype(float) @ made.rotation.T + made.position
    for number in np.unique(made.object_id[numbered]):
        returns = made.object_id == number
        assert len(set(made.kind[returns])) == 1
        assert np.hypot(*np.ptp(world[returns, :2], axis=0)) < 12.1  # a truck, a wall
    near = (np.abs(world[:, 0]) < 2.3) & (np.abs(world[:, 1]) < 0.95)
    assert scene.name not in PLACES or not (near & ~made.is_ground).any()


def is_same(one, other):
    return all(np.array_equal(getattr(one, name), getattr(other, name)) for name in ARRAYS)


def test_a_scan_depends_on_seed_and_scene_only(scene):
    again = SCENES[scene.name](7)  # another object, and so scanned anew
    assert is_same(simulated(scene, FEW, 3), simulated(again, FEW, 3))
    assert not is_same(simulated(scene, FEW, 3), simulated(scene, FEW, 4))
    # The noise of a ray depends on the seed alone.
    assert not is_same(simulated(scene, FEW, 3), simulated(scene_of(scene.name, 8), FEW, 3))


def flat_scan(**changes):
    return simulated(FLAT, replace(EXACT, **changes)).points[:, :3].astype(float)


def test_limits_dropout_and_noise_are_those_of_the_sensor():
    distance = np.linalg.norm(flat_scan(min_range=6.0, max_range=25.0, range_std=0.5), axis=1)
    assert distance.min() >= 6.0 - 1e-5
    assert 24.0 < distance.max() <= 25.0 + 1e-5
    exact = flat_scan()
    n, kept = len(exact), len(flat_scan(dropout=0.3))
    assert abs(kept - 0.7 * n) < 5.0 * math.sqrt(0.3 * 0.7 * n)
    assert len(flat_scan(dropout=1.0)) == 0
    # Noise is along the ray.
    noisy = flat_scan(range_std=0.05)
    noise = np.linalg.norm(noisy, axis=1) - np.linalg.norm(exact, axis=1)
    assert noise.std() == pytest.approx(0.05, rel=0.05)
    assert abs(noise.mean()) < 0.002
    np.testing.assert_allclose(np.cross(exact, noisy) / 120.0**2, 0.0, atol=1e-6)


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


def test_tilted_sensor_sees_the_same_world(scene):
    sensor = replace(EXACT, n_columns=60, roll=-0.1, pitch=0.12)
    result = simulated(scene, sensor)
    returns = result.points[:, :3].astype(float)
    feet = np.column_stack([returns[:, :2], result.ground_z])
    # A foot is on the terrain; on a kerb's face to the digits that are left of it.
    for local, tolerance in ((returns[result.is_ground], 5e-5), (feet, 1e-6)):
        x, y, z = (local @ result.rotation.T + result.position).T
        np.testing.assert_allclose(z, scene.terrain.height(x, y), atol=tolerance)


@pytest.mark.parametrize('heading', [0.0, 0.7, -2.0])
def test_a_vehicle_that_leans_sees_a_slope_as_level_ground(heading):
    hill = slope(0.3, heading, 2.0)
    made = simulated(Scene('hill', hill, leans=True), EXACT)
    normal = np.array([-0.3 * math.cos(heading), -0.3 * math.sin(heading), 1.0])
    normal /= np.linalg.norm(normal)
    np.testing.assert_allclose(made.position, [0.0, 0.0, 2.0] + 1.73 * normal, atol=1e-12)
    np.testing.assert_allclose(made.rotation[:, 2], normal, atol=1e-12)
    np.testing.assert_allclose(made.rotation @ made.rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(made.rotation) == pytest.approx(1.0)
    assert made.rotation[0, 0] > 0.9 and made.rotation[1, 0] == 0.0  # it drives along x
    np.testing.assert_allclose(made.points[:, 2], -1.73, atol=3e-5)
    np.testing.assert_allclose(made.ground_z, -1.73, atol=1e-7)
    level = simulated(Scene('hill', hill), EXACT)
    np.testing.assert_array_equal(level.rotation, np.eye(3))
    # What a level sensor sees on level ground, a leaning one sees on the slope.
    on_flat = simulated(FLAT, EXACT).points
    np.testing.assert_allclose(made.points[:, :3], on_flat[:, :3], atol=1e-4)


def test_drive_moves_over_the_terrain(scene):
    scans = list(simulate_drive(scene, FEW, n_frames=2, speed=15.0, seed=5))
    np.testing.assert_allclose([s.time for s in scans], [0.0, 0.1])
    for s, x in zip(scans, (0.0, 1.5), strict=True):
        foot = s.position - FEW.height * s.rotation[:, 2]
        expected = [x, 0.0, float(scene.terrain.height(x, 0.0))]
        np.testing.assert_allclose(foot, expected, atol=1e-12)
    again, other = (next(simulate_drive(scene, FEW, 1, 15.0, seed)) for seed in (5, 6))
    assert is_same(scans[0], again)
    assert not is_same(scans[0], other)
    assert not is_same(scans[0], scans[1])
