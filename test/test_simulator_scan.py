"""Scans: sensors, labels against geometry, noise, occlusion, reflections, tilt, drives."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from gp_ground_seg.errors import ConfigError
from gp_ground_seg.simulation import (
    HDL_32E,
    HDL_64E,
    MID_360,
    OS1_128,
    SCENES,
    SENSORS,
    VLP_16,
    Kind,
    Scene,
    WetPatch,
    objects,
    simulate_drive,
    simulate_scan,
)
from gp_ground_seg.simulation import terrain as landforms

COARSE = dataclasses.replace(HDL_64E, n_columns=240)
EXACT = dataclasses.replace(COARSE, range_std=0.0, dropout=0.0)
FLAT = Scene('bare', landforms.flat())
# Steepest face in any scene is a kerb's, 0.15 m up over 0.05 m.
STEEPEST = 3.0


def scan(scene, sensor=COARSE, seed=0, **pose):
    return simulate_scan(scene, sensor, np.random.default_rng(seed), **pose)


@pytest.fixture(params=SCENES, scope='module')
def scene(request):
    return SCENES[request.param](7)


@pytest.mark.parametrize(
    ('sensor', 'n_beams', 'top', 'bottom'),
    [
        (HDL_64E, 64, 2.0, -24.33),
        (HDL_32E, 32, 10.67, -30.67),
        (VLP_16, 16, 15.0, -15.0),
        (OS1_128, 128, 22.5, -22.5),
    ],
)
def test_fields_of_view(sensor, n_beams, top, bottom):
    rays = sensor.directions()
    assert rays.shape == (n_beams * sensor.n_columns, 3) == (sensor.n_rays, 3)
    np.testing.assert_allclose(np.linalg.norm(rays, axis=1), 1.0)
    elevation = np.degrees(np.arcsin(rays[:, 2]))
    assert elevation.max() == pytest.approx(top)
    assert elevation.min() == pytest.approx(bottom)
    assert SENSORS[sensor.name] is sensor


def test_mid_360_fills_its_field_of_view_and_never_repeats():
    assert SENSORS['mid-360'] is MID_360
    first, second = MID_360.directions(0.1), MID_360.directions(0.2)
    assert first.shape == (MID_360.n_rays, 3) == (20_000, 3)
    np.testing.assert_allclose(np.linalg.norm(first, axis=1), 1.0)
    elevation = np.degrees(np.arcsin(first[:, 2]))
    assert -7.0 <= elevation.min() < -6.9
    assert 51.9 < elevation.max() <= 52.0
    # Evenly over the sphere: every cell of 10 degrees by a tenth of the height has its share.
    azimuth = np.arctan2(first[:, 1], first[:, 0])
    cells, *_ = np.histogram2d(azimuth, first[:, 2], bins=(36, 10))
    assert cells.min() > 0.7 * cells.mean()
    nearest = np.min(np.linalg.norm(first[:500, None] - second[None], axis=-1), axis=1)
    assert np.median(nearest) > 1e-3
    result = scan(FLAT, MID_360)
    assert not result.ring.any()
    assert len(result.points) > 1000
    assert result.is_ground.all()


@pytest.mark.parametrize('change', [{'elevations': (0.1,)}, {'n_columns': 2}, {'n_points': 0}])
def test_scatter_model_checks_its_values(change):
    with pytest.raises(ConfigError, match=next(iter(change))):
        dataclasses.replace(MID_360, **change)


def test_hdl64e_has_two_blocks():
    degrees = np.degrees(HDL_64E.elevations)
    np.testing.assert_allclose(np.diff(degrees[:32]), -1.0 / 3.0, atol=1e-3)
    np.testing.assert_allclose(np.diff(degrees[32:]), -0.5, atol=1e-9)
    np.testing.assert_allclose(degrees[[31, 32]], [-8.33, -8.83])


def test_rays_are_ordered_ring_by_ring_counter_clockwise():
    result = scan(FLAT)
    assert (np.diff(result.ring.astype(int)) >= 0).all()
    azimuth = np.arctan2(result.points[:, 1], result.points[:, 0]) % (2.0 * np.pi)
    same_ring = np.diff(result.ring) == 0
    assert (np.diff(azimuth)[same_ring] > 0.0).all()
    elevation = np.arctan2(result.points[:, 2], np.hypot(result.points[:, 0], result.points[:, 1]))
    np.testing.assert_allclose(elevation, np.array(COARSE.elevations)[result.ring], atol=1e-5)


def test_types_and_shapes(scene):
    result = scan(scene)
    n = len(result.points)
    assert (result.points.dtype, result.points.shape) == (np.float32, (n, 4))
    assert (result.ring.dtype, result.ring.shape) == (np.uint16, (n,))
    assert (result.is_ground.dtype, result.is_ground.shape) == (np.bool_, (n,))
    assert (result.ground_z.dtype, result.ground_z.shape) == (np.float64, (n,))
    assert (result.kind.dtype, result.kind.shape) == (np.uint8, (n,))
    assert np.isfinite(result.points).all()
    assert np.isfinite(result.ground_z).all()
    assert ((result.points[:, 3] >= 0.0) & (result.points[:, 3] <= 1.0)).all()
    np.testing.assert_array_equal(result.is_ground, result.kind == Kind.TERRAIN)


def test_ground_points_without_noise_are_on_the_terrain(scene):
    result = scan(scene, EXACT)
    height = (result.points[:, 2] - result.ground_z)[result.is_ground]
    # float32 keeps 7 digits of 120 m, and a kerb's face triples what is lost across it.
    assert np.abs(height).max() < 3e-5
    assert result.is_ground.sum() > 2500


def test_ground_points_are_within_the_noise(scene):
    result = scan(scene)
    height = (result.points[:, 2] - result.ground_z)[result.is_ground]
    assert np.abs(height).max() < 6.0 * COARSE.range_std * math.hypot(1.0, STEEPEST)
    assert np.median(np.abs(height)) < COARSE.range_std


def test_solids_are_above_and_reflections_below_the_ground(scene):
    result = scan(scene, EXACT)
    height = result.points[:, 2] - result.ground_z
    solid = ~np.isin(result.kind, [Kind.TERRAIN, Kind.REFLECTION])
    assert solid.sum() > 20
    assert height[solid].min() > -3e-5
    assert (height[np.isin(result.kind, [Kind.OVERHANG, Kind.VEGETATION])] > 0.5).all()
    assert (height[result.kind == Kind.REFLECTION] < -0.0999).all()


def test_urban_scene_has_everything():
    result = scan(SCENES['urban'](0), HDL_64E)
    assert set(np.unique(result.kind)) == set(Kind)
    assert np.bincount(result.kind).min() > 100
    assert len(result.points) > 100_000


def test_ranges_are_within_limits():
    sensor = dataclasses.replace(COARSE, min_range=6.0, max_range=25.0, range_std=0.5)
    distance = np.linalg.norm(scan(FLAT, sensor).points[:, :3], axis=1)
    assert distance.min() >= 6.0 - 1e-5
    assert distance.max() <= 25.0 + 1e-5
    assert distance.max() > 24.0


def test_same_seed_same_scan(scene):
    first, second = scan(scene, seed=3), scan(scene, seed=3)
    for name in ('points', 'ring', 'is_ground', 'ground_z', 'kind'):
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name))


def test_other_seed_other_scan_and_other_scene(scene):
    first, second = scan(scene, seed=3), scan(scene, seed=4)
    assert first.points.shape != second.points.shape or (first.points != second.points).any()
    other = scan(SCENES[scene.name](8), EXACT, seed=3)
    same = scan(scene, EXACT, seed=3)
    assert other.points.shape != same.points.shape or (other.points != same.points).any()


def test_dropout_rate():
    n = len(scan(FLAT, dataclasses.replace(COARSE, dropout=0.0)).points)
    kept = len(scan(FLAT, dataclasses.replace(COARSE, dropout=0.3)).points)
    assert abs(kept - 0.7 * n) < 5.0 * math.sqrt(0.3 * 0.7 * n)
    assert len(scan(FLAT, dataclasses.replace(COARSE, dropout=1.0)).points) == 0


def test_noise_is_along_the_ray_with_the_given_std():
    exact = scan(FLAT, EXACT).points[:, :3].astype(float)
    noisy = scan(FLAT, dataclasses.replace(EXACT, range_std=0.05)).points[:, :3].astype(float)
    noise = np.linalg.norm(noisy, axis=1) - np.linalg.norm(exact, axis=1)
    assert noise.std() == pytest.approx(0.05, rel=0.05)
    assert abs(noise.mean()) < 0.002
    np.testing.assert_allclose(np.cross(exact, noisy) / 120.0**2, 0.0, atol=1e-6)


def test_noise_of_a_ray_does_not_depend_on_the_scene():
    """A wall in front changes the points on it and behind it, and no other."""
    wall = objects.wall(FLAT.terrain, (10.0, -3.0), (10.0, 3.0), 5.0)
    bare, walled = scan(FLAT), scan(Scene('wall', FLAT.terrain, wall))
    left_bare, left_walled = (s.points[s.points[:, 0] < -1.0] for s in (bare, walled))
    np.testing.assert_array_equal(left_bare, left_walled)


def test_nothing_is_seen_behind_a_wall():
    wall = objects.wall(FLAT.terrain, (10.0, -3.0), (10.0, 3.0), 30.0)
    behind = (
        *objects.car(FLAT.terrain, 20.0, 0.0),
        objects.pole(FLAT.terrain, 15.0, 1.0),
        objects.floating_box(FLAT.terrain, 30.0, 0.0, (5.0, 5.0, 1.0), 2.0),
    )
    result = scan(Scene('wall', FLAT.terrain, (*wall, *behind)), EXACT)
    x, y, _, _ = result.points.T
    shadow = (x > 0.0) & (np.abs(y) < 0.299 * x)
    assert x[shadow].max() < 9.86
    assert set(result.kind[shadow]) == {Kind.TERRAIN, Kind.WALL}


def test_ground_is_seen_under_an_overhang():
    deck = objects.floating_box(FLAT.terrain, 15.0, 0.0, (10.0, 30.0, 1.0), 1.9)
    result = scan(Scene('deck', FLAT.terrain, (deck,)), EXACT)
    x, y, _, _ = result.points.T
    under = (np.abs(x - 15.0) < 5.0) & (np.abs(y) < 15.0)
    assert set(result.kind[under]) == {Kind.TERRAIN, Kind.OVERHANG}
    assert result.points[result.kind == Kind.OVERHANG, 2].min() >= 1.9 - 1.73 - 1e-5


def test_reflections_are_mirror_images():
    """On a level wet road the image of a wall's face is that face, below the ground."""
    wall = objects.wall(FLAT.terrain, (12.0, -6.0), (12.0, 6.0), 2.0)
    wet = (WetPatch(9.0, 0.0, 2.0, reflectivity=0.7),)
    result = scan(Scene('wet', FLAT.terrain, wall, wet), EXACT)
    x, _, z, _ = result.points[result.kind == Kind.REFLECTION].T
    assert len(x) > 30
    np.testing.assert_allclose(x, 12.0 - 0.15, atol=1e-5)
    assert (z >= -1.73 - 2.0 - 1e-5).all()
    dry = scan(Scene('dry', FLAT.terrain, wall), EXACT)
    mirrored = scan(Scene('wet', FLAT.terrain, wall, (WetPatch(9.0, 0.0, 2.0, 1.0),)), EXACT)
    share = len(x) / np.sum(mirrored.kind == Kind.REFLECTION)
    assert share == pytest.approx(0.7, abs=0.1)
    assert not (dry.kind == Kind.REFLECTION).any()
    assert len(dry.points) == len(result.points)


@pytest.mark.parametrize(('roll', 'pitch'), [(0.05, 0.0), (0.0, -0.08), (-0.1, 0.12)])
def test_tilted_sensor_sees_the_same_world(roll, pitch, scene):
    sensor = dataclasses.replace(EXACT, n_columns=120, roll=roll, pitch=pitch)
    result = scan(scene, sensor)
    local = result.points[:, :3].astype(float)
    world = local @ result.rotation.T + result.position
    height = world[:, 2] - scene.terrain.height(world[:, 0], world[:, 1])
    assert np.abs(height[result.is_ground]).max() < 5e-5
    foot = local.copy()
    foot[:, 2] = result.ground_z
    foot = foot @ result.rotation.T + result.position
    # The foot is on the terrain (on a kerb's face to the digits that are left of it).
    on_terrain = foot[:, 2] - scene.terrain.height(foot[:, 0], foot[:, 1])
    np.testing.assert_allclose(on_terrain, 0.0, atol=1e-6)


def test_tilted_ground_height_on_a_plane():
    sensor = dataclasses.replace(EXACT, roll=-0.06, pitch=0.1)
    result = scan(FLAT, sensor)
    x, y, _, _ = result.points.T.astype(float)
    down = result.rotation[2]
    np.testing.assert_allclose(
        result.ground_z, (-1.73 - down[0] * x - down[1] * y) / down[2], atol=1e-9
    )


def test_signs_of_roll_and_pitch():
    """REP-103: positive pitch lowers the nose, positive roll the right side."""
    nose = scan(FLAT, dataclasses.replace(EXACT, pitch=0.1))
    ahead = nose.ground_z[(nose.points[:, 0] > 5.0)]
    assert (ahead > -1.73).all()
    side = scan(FLAT, dataclasses.replace(EXACT, roll=0.1))
    right = side.ground_z[side.points[:, 1] < -5.0]
    assert (right > -1.73).all()


def test_yaw_turns_the_scene():
    terrain = landforms.ramp(10.0, 0.2)
    ahead, left = scan(Scene('ramp', terrain), EXACT), scan(
        Scene('ramp', terrain), EXACT, yaw=-math.pi / 2
    )  # fmt: skip
    rises = ahead.points[:, 2] > -1.6
    assert (ahead.points[rises, 0] > 10.0).all()
    rises = left.points[:, 2] > -1.6
    assert (left.points[rises, 1] > 10.0).all()


def test_drive_moves_over_the_terrain(scene):
    scans = list(simulate_drive(scene, COARSE, n_frames=3, speed=15.0, seed=5))
    np.testing.assert_allclose([s.time for s in scans], [0.0, 0.1, 0.2])
    np.testing.assert_allclose([s.position[0] for s in scans], [0.0, 1.5, 3.0])
    for s in scans:
        ground = float(scene.terrain.height(s.position[0], s.position[1]))
        assert s.position[2] - ground == pytest.approx(COARSE.height)


def test_drive_depends_on_its_seed_only():
    scene = SCENES['urban'](0)
    first, again, other = (
        list(simulate_drive(scene, COARSE, n_frames=2, speed=15.0, seed=seed))
        for seed in (5, 5, 6)
    )
    np.testing.assert_array_equal(first[1].points, again[1].points)
    assert first[0].points.shape != other[0].points.shape
    assert first[0].points.shape != first[1].points.shape


@pytest.mark.parametrize(
    ('change', 'name'),
    [
        ({'elevations': ()}, 'elevations'),
        ({'elevations': (0.0, 0.1)}, 'elevations'),
        ({'elevations': (2.0,)}, 'elevations'),
        ({'elevations': (math.nan,)}, 'elevations'),
        ({'n_columns': 0}, 'n_columns'),
        ({'min_range': 200.0}, 'min_range'),
        ({'max_range': math.inf}, 'max_range'),
        ({'range_std': -0.1}, 'range_std'),
        ({'dropout': 1.5}, 'dropout'),
        ({'height': 0.0}, 'height'),
        ({'pitch': 2.0}, 'pitch'),
        ({'roll': math.nan}, 'roll'),
    ],
)
def test_sensor_refuses_bad_values(change, name):
    with pytest.raises(ConfigError, match=name):
        dataclasses.replace(HDL_64E, **change)


@pytest.mark.parametrize(('n_frames', 'speed'), [(0, 1.0), (2, math.inf)])
def test_drive_refuses_bad_values(n_frames, speed):
    with pytest.raises(ConfigError, match='n_frames'):
        simulate_drive(FLAT, COARSE, n_frames, speed, seed=0)
