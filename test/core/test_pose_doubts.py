"""Poses that a scan hardly shows, and an earlier one replaces; low sensors; several levels."""

import dataclasses

import numpy as np
import pytest
from conftest import simulated
from rooms import CORRIDOR, HALL, ROOM, SMALL_ROOM
from test_sensor_pose import (
    SEGMENTER,
    SENSORS,
    SMALL_HDL,
    SMALL_OS1,
    SMALL_VLP,
    moved,
    pose_of,
    scan_of,
    segmenter,
    tilted,
)

from gp_ground_seg import Config
from gp_ground_seg.core.ground_model import GroundModel
from gp_ground_seg.core.pipeline import sensor_pose
from gp_ground_seg.core.pipeline.ground_plane import GroundPlane
from gp_ground_seg.core.pipeline.ground_view import LOWER_ENDS, OTHER_AXES, UPRIGHT, View, clearest
from gp_ground_seg.core.pipeline.sensor_pose import LITTLE_GROUND, LOW_GROUND, NO_HEIGHT
from gp_ground_seg.lab import simulation
from gp_ground_seg.lab.simulation import HDL_64E, OS1_128, VLP_16, Scene, objects
from gp_ground_seg.lab.simulation import terrain as landforms

GATES = {'growth.max_std': 1.0, 'growth.seed_height_tolerance': 1.0, 'observation.sigma_n': 0.5,
         'label.obstacle_min_height': 1.0, 'observation.slope_drift': 1.0}  # fmt: skip


def test_a_low_sensor_has_narrower_gates_and_is_told_from_the_origin_of_a_vehicle():
    config, reference = Config(), sensor_pose.REFERENCE_HEIGHT
    mounts = (
        *(('kerb', height, 0.0, height) for height in (0.6, 0.15)),
        *(('kerb', 1.73, z, reference) for z in (0.0, 1.53, 1.73)),
        ('hills', 0.8, 0.4, reference),
    )
    for scene, height, lift, expected in mounts:
        pose = pose_of(moved(scan_of(scene, SMALL_VLP, height).points, lift))
        assert sensor_pose.sensor_height_of(pose) == pytest.approx(expected, abs=0.04)
        own, share = sensor_pose.for_sensor(config, pose), expected / reference
        if share == 1.0:
            assert own is config
            continue
        for name, power in GATES.items():
            assert own[name] == pytest.approx(share**power * config[name], rel=0.3)
        least = max(0.1 * share, sensor_pose.LEAST_TOLERANCE)
        assert own.label.ground_tolerance == pytest.approx(least, abs=0.005)
        # A smaller one that is given stays, and the paper's rule knows no height of the sensor.
        fine = config.replace(**{'label.ground_tolerance': 0.02})
        assert sensor_pose.for_sensor(fine, pose).label.ground_tolerance == 0.02
        paper = config.replace(**{'label.rule': 'tolerance'})
        assert sensor_pose.for_sensor(paper, pose) is paper
        # What is at its least already is not refused.
        names = (*GATES, 'label.ground_tolerance', 'grid.r_min')
        tiny = config.replace(**{name: Config.find_spec(name).minimum for name in names})
        assert sensor_pose.for_sensor(tiny, pose) == tiny
    # The sensor is where the origin is given to be.
    points = moved(scan_of('kerb', SMALL_VLP, 0.15).points, 0.15)
    pose = pose_of(points, origin_z=0.15)
    assert sensor_pose.sensor_height_of(pose) == pytest.approx(0.15, abs=0.04)
    assert sensor_pose.sensor_height_of(pose_of(points)) == reference


def desks(gap):
    """A room full of desks, 0.74 m high, but for a `gap` [m] that a robot stands in."""
    tops = [
        objects.floating_box(ROOM.terrain, sign * x, sign * y, (*size, 0.04), 0.7)
        for sign in (-1.0, 1.0)
        for x, y, size in ((0.5 * gap + 1.5, 0.0, (3.0, 8.0)), (0.0, 0.5 * gap + 1.5, (gap, 3.0)))
    ]
    return Scene('desks', ROOM.terrain, (*ROOM.solids, *tops))


@pytest.mark.parametrize('over', [0.1, 0.15])
def test_a_sensor_just_over_table_tops_warns(over, caplog):
    points = scan_of(desks(0.6), SMALL_VLP, 0.74 + over).points
    own = segmenter()
    pose, _ = (own.segment(points).pose for _ in range(2))
    assert pose.height == pytest.approx(over, abs=0.04)
    assert pose.warnings == (LOW_GROUND,) and not pose.is_well_seen
    assert [record.getMessage() for record in caplog.records].count(LOW_GROUND) == 1
    # What is given is not doubted.
    assert segmenter(height=pose.height).segment(points).pose.warnings == ()


@pytest.mark.parametrize('scene', ['slope', 'blind_slope'])
def test_the_origin_of_a_vehicle_on_a_slope_is_not_over_table_tops(scene):
    """Its ground lies at as many angles of depression as that of a low sensor."""
    for name in ('hdl-64e-vehicle', 'vlp-32c-pair'):
        mounted = dataclasses.replace(simulation.SENSORS[name], n_columns=600)
        pose = pose_of(simulated(scene, mounted).points)
        assert abs(pose.height) < 0.2 and pose.warnings == ()


def part_of(points, start, width):
    """Points in a sector of an azimuth [degrees]."""
    azimuth = np.degrees(np.arctan2(points[:, 1], points[:, 0]))
    return points[(azimuth - start) % 360.0 < width]


@pytest.mark.parametrize(
    ('scene', 'sensor'), [('urban', SMALL_HDL), ('rough', SMALL_VLP), ('urban', SMALL_OS1)]
)
def test_a_part_of_a_scan_shows_little_ground_and_the_whole_enough(scene, sensor):
    points = scan_of(scene, sensor, 1.2).points
    whole = pose_of(points)
    assert whole.is_well_seen and whole.warnings == ()
    for width in (10.0, 30.0, 60.0):
        for start in (-180.0, -60.0, 60.0):
            pose = pose_of(part_of(points, start, width))
            assert pose.warnings in ((NO_HEIGHT,), (LITTLE_GROUND,)) and not pose.is_well_seen


@pytest.mark.parametrize(
    ('scene', 'roll', 'pitch'),
    [('urban', 0.0, 0.0), (ROOM, 0.1, -0.07)],
    ids=['urban, level', 'room, tilted'],
)
def test_parts_of_a_scan_have_its_labels_with_its_pose(scene, roll, pitch):
    """Packets of a driver that sends parts of a turn, 10 degrees each."""
    points = scan_of(scene, SMALL_HDL, 1.2, roll=roll, pitch=pitch).points
    whole, n_same = SEGMENTER.segment(points), 0
    assert whole.pose.is_well_seen and whole.pose.is_level == (roll == 0.0)
    # The pose of an earlier scan does not matter where a scan has its own.
    other = dataclasses.replace(whole.pose, height=3.0)
    with_other = SEGMENTER.segment(points, fallback=other)
    assert with_other.pose == whole.pose
    np.testing.assert_array_equal(with_other.label, whole.label)
    sector = np.degrees(np.arctan2(points[:, 1], points[:, 0])) // 10.0
    for own in (sector == k for k in np.unique(sector)):
        found = SEGMENTER.segment(points[own], fallback=whole.pose)
        pose = found.pose
        assert pose.is_fallback and not pose.height_estimated and pose.warnings == ()
        for name in ('height', 'roll', 'pitch'):
            assert getattr(pose, name) == getattr(whole.pose, name)
        n_same += (found.label == whole.label[own]).sum()
    assert n_same / len(points) >= 0.97


def test_the_pose_of_an_earlier_scan_replaces_nothing_that_is_given():
    points = scan_of('urban', SMALL_HDL, 1.2, roll=0.1).points
    earlier, part = pose_of(points), part_of(points, 0.0, 10.0)
    assert not earlier.is_level
    told = segmenter(height=1.0).segment(part, fallback=earlier).pose
    assert (told.height, told.roll, told.is_fallback) == (1.0, 0.0, False)
    tilted_so = SEGMENTER.segment(part, tilt=(0.2, 0.05), fallback=earlier).pose
    assert (tilted_so.roll, tilted_so.pitch) == (0.2, 0.05)
    assert (tilted_so.height, tilted_so.is_fallback) == (earlier.height, True)


# Which level is the ground: that the robot stands on, not its body, nor what lies below it.


@pytest.mark.parametrize('scene', ['urban', pytest.param('car_park', marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    ('length', 'width', 'ahead', 'below'),
    [(3.0, 3.0, 0.0, 0.3), (3.0, 2.2, -1.0, 0.5), (2.4, 1.0, 2.0, 1.0), (8.0, 2.4, -6.0, 1.5)],
    ids=['roof', 'cab', 'bonnet', 'trailer'],
)
def test_the_own_vehicle_is_not_the_ground(scene, length, width, ahead, below):
    # Beside the street is a sidewalk, 0.15 m higher.
    height = pytest.approx(2.4, abs=0.1 if scene == 'urban' else 0.05)
    points = scan_of(scene, SMALL_OS1, 2.4).points[:, :3]
    # As the sensor sees it, with what it hides.
    share = np.where(points[:, 2] < -below, -below / np.minimum(points[:, 2], -1e-9), 1.0)
    x, y = points[:, 0] * share - ahead, points[:, 1] * share
    share[(abs(x) > length / 2.0) | (abs(y) > width / 2.0)] = 1.0
    assert pose_of(points * share[:, None]).height == height


LEVELS = {
    'dike': [(-6.0, -1.5), (-3.0, 0.0), (3.0, 0.0), (6.0, -1.5)],
    'dock': [(2.5, 0.0), (2.5, -1.5)],
    'stairs': [(3.0 + 0.3 * ((k + 1) // 2), -0.17 * (k // 2)) for k in range(1, 22)],
    'path': [(-3.5, 0.8), (-3.5, 0.0), (1.5, 0.0), (1.5, 0.8)],
    'platform': [(1.5, 0.0), (1.5, 1.0)],
}


def level_above(name, sensor, height):
    return scan_of(Scene(name, landforms.polyline(1.3, LEVELS[name])), sensor, height).points


@SENSORS
@pytest.mark.parametrize('name', LEVELS)
def test_the_robot_stands_on_the_level_near_it(sensor, name):
    """Terrain beside it, lower or higher, of which more is seen, is not the ground near it."""
    height = (0.8 if sensor is SMALL_VLP else 1.75) + 0.7 * (LEVELS[name][-1][1] > 0.0)
    points = level_above(name, sensor, height)
    pose = pose_of(points)
    assert pose.is_level and pose.height == pytest.approx(height, abs=0.05)
    assert pose_of(points, height=height).contradictions == ()
    (line,) = pose_of(points, height=height - 0.4).contradictions
    assert f'sensor.height = {height - 0.4:g}' in line
    if name != 'path' or sensor is not SMALL_VLP:  # whose 16 beams see too little of it
        # The level of a tilted sensor as well.
        for turn in ((0.1, -0.06), (0.05, 0.03)):
            lean = pose_of(tilted(points, *turn))
            np.testing.assert_allclose((lean.roll, lean.pitch), turn, atol=0.01)
            assert lean.height == pytest.approx(height, abs=0.05)


def test_a_given_level_that_is_seen_as_well_is_not_contradicted():
    """The terrain on both sides of the dike: which level is meant, the scan does not tell."""
    points = level_above('dike', SMALL_HDL, 1.75)
    assert pose_of(points, height=1.75 + 1.5).contradictions == ()
    assert len(pose_of(points, height=1.75 + 0.75).contradictions) == 1


@pytest.mark.parametrize(('edge', 'drop'), [(2.6, -1.2), (4.0, 1.2)])
def test_a_sensor_that_looks_ahead_stands_on_the_level_that_ends_there(edge, drop):
    """On a dock, of which little is seen, and at the foot of one."""
    ahead = landforms.polyline(0.0, [(edge, 0.0), (edge, drop)])
    points = scan_of(Scene('edge', ahead), SMALL_HDL, 1.7).points
    pose = pose_of(points[np.abs(np.arctan2(points[:, 1], points[:, 0])) < 1.0])
    assert pose.is_level and pose.height == pytest.approx(1.7, abs=0.1)
    if drop < 0.0:
        assert pose.measured.plane.other_height == pytest.approx(1.7 - drop, abs=0.1)


JETTY = landforms.polyline(np.pi / 2, [(-2.0, -1.5), (-1.7, 0.0), (1.7, 0.0), (2.0, -1.5)])
RAILS = tuple(objects.floating_box(JETTY, 0.0, y, (40.0, 0.1, 0.08), 0.92) for y in (-1.6, 1.6))
UPWARDS = tuple(np.radians(np.linspace(52, -52, 64)))
NEAR = [
    # Floors under a ceiling, also the little that is seen of a small room, and among desks.
    *((HALL, *one, 0, 0.05) for one in ((VLP_16, 0.4), (OS1_128, 0.5), (HDL_64E, 1.73))),
    (SMALL_ROOM, simulation.SENSORS['mid-360'], 0.45, 0, 0.05),
    (CORRIDOR, simulation.SENSORS['mid-360'], 0.4, 1, 0.05),
    (desks(2.4), dataclasses.replace(SMALL_OS1, elevations=UPWARDS), 0.95, 0, 0.05),
    # A narrow jetty is the ground; rails beside the sensor, cars around or below, slopes are not.
    (Scene('rails', JETTY, RAILS), simulation.SENSORS['mid-360'], 1.0, 0, 0.05),
    *(
        (scene, sensor, height + more, 3, 0.05)
        for sensor, height in ((SMALL_VLP, 0.5), (SMALL_VLP, 1.0), (SMALL_OS1, 0.8))
        for scene, more in ((Scene('jetty', JETTY), 0.0), ('traffic_jam', 0.8))
    ),
    ('traffic_jam', SMALL_VLP, 3.1, 2, 0.15),
    *(
        (scene, sensor, height, 2, 0.15)
        for sensor, height in ((SMALL_HDL, 1.75), (SMALL_VLP, 0.8), (SMALL_OS1, 1.75))
        for scene in ('valley', 'on_ramp')
    ),
]


@pytest.mark.parametrize(('scene', 'sensor', 'height', 'seed', 'tolerance'), NEAR)
def test_the_ground_is_that_near_the_sensor(scene, sensor, height, seed, tolerance):
    pose = pose_of(scan_of(scene, sensor, height, seed=seed).points)
    assert pose.height_estimated and pose.is_level
    assert pose.height == pytest.approx(height, abs=tolerance)


def test_many_cells_tell_the_tilt_among_more_of_other_things():
    view, on_it = (
        View(GroundPlane(z, support=0.3, coverage=0.7, spread=0.1 * z, n_support=80), UPRIGHT)
        for z in (1.8, 0.0)  # the second from the axles of a vehicle
    )
    assert view.can_level and on_it.can_level
    assert not view._replace(plane=view.plane._replace(n_support=40)).can_level
    assert not view._replace(plane=view.plane._replace(undercut=0.6)).can_level  # a hillside
    # Level crests about the axles of a vehicle do not turn z over, nor roofs.
    plane = GroundPlane(0.1, support=0.4, coverage=1.0, reach=30.0, spread=0.1, n_support=140)
    own = plane._replace(is_below_sensor=True)
    seen = [View(p, OTHER_AXES[0]) for p in (plane, own._replace(undercut=0.4, overhung=0.6), own)]
    assert clearest(None, seen[:2]) is None and clearest(None, seen) is seen[2]


@pytest.mark.parametrize('sensor', [SMALL_VLP, SMALL_OS1], ids=lambda s: s.name)
@pytest.mark.parametrize('scene', ['car_park', 'traffic_jam', 'hedge'])
def test_lower_ends_of_objects_are_no_ground(scene, sensor):
    """The ground was cut away before; a height that is given is taken."""
    made = scan_of(scene, sensor, 1.8, seed=3)
    over = made.points[:, 2] + 1.8
    found = SEGMENTER.segment(made.points[over > 0.5])
    assert not found.is_ground.any() and found.pose.warnings == (NO_HEIGHT, LOWER_ENDS)
    assert segmenter(height=1.8).segment(made.points[over > 0.5]).pose.warnings == ()
    assert SEGMENTER.segment(made.points).warnings == ()


@pytest.mark.parametrize('is_gutter', [False, True])
def test_a_rough_path_between_hedges_is_no_cut_cloud(is_gutter):
    """Neither is an even one that falls to a gutter."""
    x, y = np.meshgrid(np.arange(-6.0, 6.0, 0.05), np.arange(-1.0, 1.01, 0.05))
    rise = 0.024 * np.abs(x) if is_gutter else 0.05 * np.sin(5.0 * x) * np.cos(4.0 * y)
    path = np.stack([x, y, rise - 0.4], axis=-1)
    x, z = np.meshgrid(np.arange(-6.0, 6.0, 0.05), np.arange(-0.4, 0.6, 0.1))
    hedges = [np.stack([x, 0.0 * x + side, z], -1) for side in (-1.15, 1.15) if not is_gutter]
    pose = pose_of(np.concatenate([part.reshape(-1, 3) for part in (path, *hedges)]))
    assert pose.height == pytest.approx(0.4, abs=0.05) and pose.warnings == ()


@pytest.mark.parametrize(('sensor', 'seed'), [(simulation.SENSORS['mid-360'], n) for n in (7, 36)])
def test_hollows_in_a_few_directions_are_no_cut_cloud(sensor, seed):
    path = landforms.rough(np.random.default_rng(seed), 0.035, (0.6, 8.0))
    left, right = (objects.wall(path, (-15.0, y), (15.0, y), 2.0) for y in (-1.1, 1.1))
    pose = pose_of(scan_of(Scene('path', path, left + right), sensor, 0.4, seed=seed).points)
    assert pose.warnings == () and pose.height == pytest.approx(0.4, abs=0.05)


def test_a_hollow_around_few_beams_is_no_cut_cloud():
    azimuth, angle = np.meshgrid(np.arange(0.0, 6.28, 0.01), np.radians(np.arange(-1, 16, 2)))
    r = 0.3 / (0.06 + np.tan(angle))  # beams on a cone, 0.3 m above its tip
    points = np.stack([r * np.cos(azimuth), r * np.sin(azimuth), -r * np.tan(angle)], axis=-1)
    assert LOWER_ENDS not in pose_of(points.reshape(-1, 3)).warnings


@pytest.mark.parametrize(
    ('scale', 'move', 'said'),
    [(1.0, (60.0, 20.0, 0.0), 'the origin of the cloud is not the sensor'),
     (1.0, (700.0, 0.0, 30.0), 'the origin of the cloud is not the sensor'),
     (1.0, (0.0, 230.0, 0.0), 'the origin of the cloud is not the sensor'),
     *((scale, (0.0, 0.0, 0.0), 'the cloud is not in metres') for scale in (100.0, 120.0)),
     (0.001, (0.0, 0.0, 0.0), 'the cloud is not in metres')],
)  # fmt: skip
def test_a_cloud_in_another_frame_or_unit_is_named_and_its_origin_centres_it(scale, move, said):
    points = scan_of('urban', SMALL_VLP, 0.8).points[:, :3].astype(np.float64)
    assert said in pose_of(points * scale + move).warnings[1]
    if not any(move):
        return
    own, there = SEGMENTER.segment(points), SEGMENTER.segment(points + move, origin=move)
    np.testing.assert_array_equal(there.label, own.label)
    np.testing.assert_allclose(there.ground_z - move[2], own.ground_z, atol=1e-9)
    assert there.pose.height == pytest.approx(own.pose.height - move[2], abs=1e-4)
    assert there.pose.sensor_height == pytest.approx(own.pose.height, abs=1e-4)
    model, ours = GroundModel.of(there), GroundModel.of(own)
    np.testing.assert_allclose(model.knot_points() - move, ours.knot_points(), atol=1e-9)
    (height, _), (wanted, _) = model.at(*(points + move)[:, :2].T), ours.at(*points[:, :2].T)
    np.testing.assert_allclose(height - move[2], wanted, atol=1e-6)


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
