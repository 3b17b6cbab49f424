"""Vehicles, persons, cyclists; the scenes around the sensor; mounts and merged clouds."""

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
from conftest import scene_of, simulated

from gp_ground_seg.lab.simulation import (
    HDL_64E,
    PLACES,
    SCENES,
    SENSORS,
    Kind,
    Scene,
    objects,
    semantic_kitti_labels,
    traffic,
)
from gp_ground_seg.lab.simulation.terrain import flat, slope

EXACT = replace(HDL_64E, n_columns=700, range_std=0.0, dropout=0.0)
TALL = replace(EXACT, elevations=SENSORS['os1-128'].elevations)
FLAT = flat()
BARE = Scene('bare', FLAT)


def in_world(made):
    return made.points[:, :3].astype(float) @ made.rotation.T + made.position


def profile(model, ahead):
    """Height of the highest body of a vehicle at places along it: by its edges, one by one."""
    top = np.zeros(len(ahead))
    for _, corners in model.bodies:
        for (u0, z0), (u1, z1) in itertools.pairwise((*corners, corners[0])):
            low, high = sorted(((u0, z0), (u1, z1)))
            over = (ahead >= low[0] - 1e-4) & (ahead <= high[0] + 1e-4)
            share = np.clip((ahead - low[0]) / max(high[0] - low[0], 1e-4), 0.0, 1.0)
            height = low[1] + share * (high[1] - low[1])
            height = np.where(high[0] - low[0] < 1e-4, max(z0, z1), height)
            top = np.where(over, np.maximum(top, height), top)
    return top


@pytest.mark.parametrize('name', traffic.MODELS)
@pytest.mark.parametrize(('yaw', 'gradient'), [(0.7, 0.0), (-2.0, 0.12), (math.pi / 2, 0.15)])
def test_returns_of_a_vehicle_lie_on_it(name, yaw, gradient):
    """In the axes of the vehicle no return is outside length, width and profile, on slopes too."""
    model, heading = traffic.MODELS[name], 0.4
    terrain = slope(gradient, heading)
    x, y = 8.0, 2.0
    made = simulated(Scene('one', terrain, traffic.vehicle(terrain, name, x, y, yaw)), TALL)
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
    top = profile(model, ahead)
    assert (above <= np.maximum(top, 2.0 * model.wheel) + 1e-3).all()
    assert above.max() > 0.95 * top.max()


@pytest.mark.parametrize(
    ('make', 'kind', 'label', 'height', 'wide'),
    [
        (traffic.person, Kind.PERSON, 30, 1.7, 0.23),
        (traffic.cyclist, Kind.CYCLIST, 31, 1.75, 0.86),
    ],
)
def test_persons_and_cyclists(make, kind, label, height, wide):
    made = simulated(Scene('one', FLAT, make(FLAT, 6.0, 1.0)), EXACT)
    x, y, z = in_world(made)[made.object_id == 1].T
    assert len(z) > 50
    assert (made.kind[made.object_id == 1] == kind).all()
    assert set(semantic_kitti_labels(made.kind)) == {40, label}
    assert height - 0.06 < z.max() <= height + 1e-4
    assert z.min() < 0.1
    assert np.hypot(x - 6.0, y - 1.0).max() < wide


def test_a_vehicle_of_several_solids_is_one_object():
    cars = [objects.car(FLAT, 8.0, y) for y in (-4.0, 4.0)]
    crate = objects.standing_box(FLAT, 8.0, 0.0, (1.0, 1.0, 0.6))
    scene = Scene('two', FLAT, (*cars[0], crate, *cars[1], *objects.truck(FLAT, 16.0, 0.0)))
    assert objects.number_objects(scene.solids).tolist() == [1, 1, 0, 2, 2, 3, 3]
    made = simulated(scene, EXACT)
    y, boxes = made.points[:, 1], made.kind == Kind.BOX
    assert set(made.object_id[boxes & (y > 2.0) & (made.points[:, 0] < 11.0)]) == {2}
    assert set(made.object_id[boxes]) == {0, 1, 2, 3}


SCATTERED, WALLED = {'BOX', 'POLE', 'VEGETATION', 'WALL'}, {'BOX', 'PERSON', 'POLE', 'WALL'}
JAM = (100, 120), (1.44, 3.61), 1.2, (0, 72), {'BOX', 'CYCLIST', 'PERSON', 'WALL'}
MEASURES = {
    # Number of objects, their heights [m], the nearest solid [m], slopes of most and of the
    # steepest ground [degrees], kinds of the solids.
    'flat': ((12, 12), (1.5, 1.5), 6.0, (0, 0), SCATTERED),
    'slope': ((12, 12), (1.5, 1.5), 6.0, (4.5, 4.6), SCATTERED),
    'ramp': ((12, 12), (1.5, 1.5), 6.0, (0, 6.9), SCATTERED),
    'rough': ((12, 12), (1.5, 1.5), 6.0, (2, 11), SCATTERED),
    'road_then_rubble': ((12, 12), (1.5, 1.5), 6.0, (0, 48), SCATTERED),
    'kerb': ((12, 12), (1.5, 1.5), 6.0, (0, 72), SCATTERED),
    'ditch': ((12, 12), (1.5, 1.5), 6.0, (0, 39), SCATTERED),
    'crest': ((12, 12), (1.5, 1.5), 6.0, (0, 4.6), SCATTERED),
    'urban': ((30, 35), (1.5, 3.6), 3.0, (0, 72), {*SCATTERED, 'OVERHANG'}),
    'traffic_jam': JAM,
    'wet_road': JAM,
    'car_park': ((240, 270), (1.44, 1.75), 2.9, (0.2, 0.8), {'BOX', 'PERSON'}),
    'hidden_climb': ((19, 22), (1.44, 2.1), 2.8, (0, 8.6), {'BOX', 'PERSON'}),
    'blind_slope': ((12, 12), (1.5, 1.5), 6.0, (5.7, 8.6), SCATTERED),
    'hedge': ((1, 1), (1.7, 1.7), 3.5, (1, 5), {'OVERHANG', 'PERSON', 'POLE', 'VEGETATION'}),
    'low_boxes': ((37, 42), (0.2, 0.6), 2.9, (0, 0), {'BOX'}),
    'low_boxes_rough': ((37, 42), (0.2, 0.6), 2.9, (2, 11), {'BOX'}),
    'low_walls': ((5, 5), (0.25, 0.4), -6.0, (0, 0), {'WALL'}),
    'lying_persons': ((34, 38), (0.22, 0.22), 2.9, (0, 0), {'PERSON'}),
    'hills': ((12, 12), (0.39, 2.3), 4.0, (9, 35), WALLED),
    'valley': ((16, 16), (0.39, 2.5), 4.0, (4, 30), WALLED),
    'bank': ((16, 16), (0.39, 2.0), 4.0, (1.4, 38), WALLED),
    'on_ramp': ((12, 12), (0.39, 2.0), 4.0, (0.6, 14), WALLED),
    'dike': ((16, 16), (0.39, 1.8), 4.0, (1.3, 37), WALLED),
}


@pytest.mark.parametrize('name', SCENES)
def test_every_scene_has_its_measures(name):
    (least, most), (lowest, highest), room, (usual, steepest), kinds = MEASURES[name]
    x, y = np.random.default_rng(0).uniform(-40.0, 40.0, (2, 4000))
    for seed in range(3):
        scene = scene_of(name, seed)
        assert {solid.kind.name for solid in scene.solids} == kinds
        assert least <= objects.number_objects(scene.solids).max() <= most
        none, *heights = objects.object_heights(scene.terrain, scene.solids)
        assert math.isnan(none)
        assert lowest - 1e-9 <= min(heights) <= max(heights) <= highest + 1e-9
        assert min(math.hypot(s.x, s.y) - s.radius for s in scene.solids) > room
        # No two objects stand in one another: of each pair the parts are apart.
        at = np.array(sorted({solid.part_of for solid in scene.solids if solid.part_of}))
        if len(at) and name in PLACES:
            apart = np.linalg.norm(at[:, None] - at, axis=-1) + 100.0 * np.eye(len(at))
            assert apart.min() > 0.5
        assert scene.leans == (name in ('hills', 'on_ramp'))
        slope = np.linalg.norm(scene.terrain.gradient(np.column_stack([x, y])), axis=1)
        degrees = np.degrees(np.arctan(slope))
        assert np.median(degrees) >= usual and 0.35 * steepest <= degrees.max() <= steepest
    if name in ('hidden_climb', 'blind_slope'):  # level at the sensor
        assert not scene.terrain.gradient(np.zeros((1, 2))).any()


def test_the_height_of_an_object_is_that_of_its_highest_part_above_the_ground():
    hill = slope(0.1)
    low = objects.parts_of(0.0, 20.0, [objects.standing_box(hill, 0.0, 20.0, (1.0, 1.0, 0.3))])
    crate = objects.standing_box(hill, 5.0, 0.0, (1.0, 1.0, 9.0))
    solids = (*objects.car(hill, 10.0, 0.0), crate, *low)
    none, car, box = objects.object_heights(hill, solids)
    assert (car, box) == pytest.approx((1.5, 0.3)) and math.isnan(none)
    assert len(objects.object_heights(hill, ())) == 1


# Mounts.


def test_a_cloud_in_the_vehicle_frame_is_that_of_the_sensor_moved():
    seen, moved = (
        simulated('hedge', replace(SENSORS[sensor], n_columns=240), 3)
        for sensor in ('hdl-64e', 'hdl-64e-vehicle')
    )
    shift = np.tile([0.0, 0.0, 1.73], (len(seen.points), 1))
    np.testing.assert_allclose(moved.points[:, :3] - seen.points[:, :3], shift, atol=2e-5)
    np.testing.assert_array_equal(moved.kind, seen.kind)
    np.testing.assert_allclose(moved.ground_z - seen.ground_z, 1.73)
    assert SENSORS['hdl-64e-vehicle'].height_of_cloud == 0.0
    assert SENSORS['hdl-64e'].height_of_cloud == 1.73


def test_a_tilted_sensor_in_a_vehicle_frame_sees_level_ground_level():
    tilted = replace(EXACT, roll=0.3, pitch=-0.1, origin=(1.2, -0.4, 1.5))
    made = simulated(BARE, tilted)
    assert tilted.height_of_cloud == pytest.approx(0.23)
    np.testing.assert_allclose(made.points[:, 2], -0.23, atol=2e-5)
    np.testing.assert_allclose(made.ground_z, -0.23, atol=1e-9)
    np.testing.assert_array_equal(made.rotation, np.eye(3))
    np.testing.assert_allclose(made.position, [-1.2, 0.4, 0.23])
    # The rays start at the sensor: its beams are cones about the axis it turns around.
    rays = (made.points[:, :3].astype(float) - tilted.origin) @ tilted.rotation()
    elevation = np.arcsin(rays[:, 2] / np.linalg.norm(rays, axis=1))
    assert np.abs(elevation[:, None] - tilted.elevations).min(axis=1).max() < 1e-5


def test_a_merged_cloud_is_of_both_sensors_in_one_frame():
    pair = SENSORS['vlp-32c-pair']
    made, upright = (
        simulated('hidden_climb', sensor, 1) for sensor in (pair, replace(pair, others=()))
    )
    n = len(upright.points)
    np.testing.assert_array_equal(made.points[:n], upright.points)
    np.testing.assert_array_equal(made.object_id[:n], upright.object_id)
    (other,) = pair.others
    assert pair.origin[2] - other.origin[2] == pytest.approx(0.3)
    assert abs(abs(other.roll) - math.pi) < 1e-9 and len(made.points) > 1.5 * n
    # One ground in both: that of the terrain.
    for part in (slice(None, n), slice(n, None)):
        error = (made.points[:, 2] - made.ground_z)[part][made.is_ground[part]]
        assert np.abs(error).max() < 0.1
    assert made.position[2] == 0.0
