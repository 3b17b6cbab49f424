"""Poses that a scan hardly shows, and an earlier one replaces; sensors close to the ground."""

import dataclasses

import numpy as np
import pytest
from test_sensor_pose import (
    ROOM,
    SEGMENTER,
    SENSORS,
    SMALL_HDL,
    SMALL_VLP,
    moved,
    pose_of,
    scan_of,
    segmenter,
)

from gp_ground_seg import Config, ConfigError, Label
from gp_ground_seg.core.pipeline import low_sensor
from gp_ground_seg.core.pipeline.sensor_pose import (
    LITTLE_GROUND,
    LOW_GROUND,
    NO_HEIGHT,
)
from gp_ground_seg.lab import simulation
from gp_ground_seg.lab.simulation import SCENES, Scene, simulate_scan
from gp_ground_seg.lab.simulation.objects import floating_box


def test_a_low_sensor_has_narrower_gates_and_is_told_from_the_origin_of_a_vehicle():
    config, reference = Config(), low_sensor.REFERENCE_HEIGHT
    for height, lift, expected in (
        (0.6, 0.0, 0.6),
        (0.15, 0.0, 0.15),
        (1.73, 0.0, reference),
        (1.73, 1.53, reference),
        (1.73, 1.73, reference),
    ):
        pose = pose_of(moved(scan_of('kerb', SMALL_VLP, height).points, lift))
        assert low_sensor.sensor_height_of(pose, config.sensor) == pytest.approx(
            expected, abs=0.04
        )
        own, share = low_sensor.for_sensor(config, pose, config.sensor), expected / reference
        if share == 1.0:
            assert own is config
            continue
        assert own.growth.max_std == pytest.approx(0.35 * share, rel=0.3)
        assert own.growth.seed_height_tolerance == pytest.approx(0.45 * share, rel=0.3)
        assert own.label.obstacle_min_height == pytest.approx(0.2 * share, rel=0.3)
        least = max(0.1 * share, low_sensor.LEAST_TOLERANCE)
        assert own.label.ground_tolerance == pytest.approx(least, abs=0.005)
        # A smaller one that is given stays, and the paper's rule knows no height of the sensor.
        fine = config.replace(**{'label.ground_tolerance': 0.02})
        assert low_sensor.for_sensor(fine, pose, fine.sensor).label.ground_tolerance == 0.02
        # What is at its least already is not refused.
        least_of_all = {
            'growth.max_std': 0.001,
            'growth.seed_height_tolerance': 0.01,
            'label.obstacle_min_height': 0.01,
            'label.ground_tolerance': 0.001,
        }
        tiny = Config().replace(**least_of_all)
        found = low_sensor.for_sensor(tiny, pose, tiny.sensor)
        assert {name: found[name] for name in least_of_all} == least_of_all
        paper = config.replace(**{'label.rule': 'tolerance'})
        assert low_sensor.for_sensor(paper, pose, paper.sensor) is paper
    # The sensor is where the origin is given to be.
    points = moved(scan_of('kerb', SMALL_VLP, 0.15).points, 0.15)
    given = dataclasses.replace(config.sensor, origin_z=0.15)
    pose = pose_of(points, origin_z=0.15)
    assert low_sensor.sensor_height_of(pose, given) == pytest.approx(0.15, abs=0.04)
    assert low_sensor.sensor_height_of(pose_of(points), config.sensor) == reference


def desks(gap):
    """A room full of desks, 0.74 m high, but for a `gap` [m] that a robot stands in."""
    tops = [
        floating_box(ROOM.terrain, sign * x, sign * y, (*size, 0.04), 0.7)
        for sign in (-1.0, 1.0)
        for x, y, size in (
            (0.5 * gap + 1.5, 0.0, (3.0, 8.0)),
            (0.0, 0.5 * gap + 1.5, (gap, 3.0)),
        )
    ]
    return Scene('desks', ROOM.terrain, (*ROOM.solids, *tops))


@pytest.mark.parametrize('over', [0.1, 0.15])
def test_a_sensor_just_over_table_tops_warns(over, caplog):
    points = scan_of(desks(0.6), SMALL_VLP, 0.74 + over).points
    own = segmenter()
    results = [own.segment(points) for _ in range(2)]
    pose = results[0].pose
    assert pose.height == pytest.approx(over, abs=0.04)
    assert pose.warnings == (LOW_GROUND,)
    assert [record.getMessage() for record in caplog.records].count(LOW_GROUND) == 1
    assert not pose.is_well_seen
    # What is given is not doubted.
    assert segmenter(height=pose.height).segment(points).pose.warnings == ()


@pytest.mark.parametrize('scene', ['slope', 'blind_slope'])
def test_the_origin_of_a_vehicle_on_a_slope_is_not_over_table_tops(scene):
    """Its ground lies at as many angles of depression as that of a low sensor."""
    for name in ('hdl-64e-vehicle', 'vlp-32c-pair'):
        made = simulate_scan(SCENES[scene](0), simulation.SENSORS[name], np.random.default_rng(0))
        pose = pose_of(made.points)
        assert abs(pose.height) < 0.2 and pose.warnings == ()


def part_of(points, start, width):
    """Points in a sector of an azimuth [degrees]."""
    azimuth = np.degrees(np.arctan2(points[:, 1], points[:, 0]))
    return points[(azimuth - start) % 360.0 < width]


@SENSORS
@pytest.mark.parametrize('scene', ['urban', 'rough'])
def test_a_part_of_a_scan_shows_little_ground_and_the_whole_enough(sensor, scene):
    points = scan_of(scene, sensor, 1.2).points
    whole = pose_of(points)
    assert whole.is_well_seen and whole.warnings == ()
    for width in (10.0, 30.0, 60.0):
        for start in (-180.0, -60.0, 60.0):
            pose = pose_of(part_of(points, start, width))
            assert pose.warnings in ((NO_HEIGHT,), (LITTLE_GROUND,))
            assert not pose.is_well_seen


@pytest.mark.parametrize(('roll', 'pitch'), [(0.0, 0.0), (0.1, -0.07)])
@pytest.mark.parametrize('scene', ['urban', ROOM], ids=['urban', 'room'])
def test_parts_of_a_scan_have_its_labels_with_its_pose(scene, roll, pitch):
    """Packets of a driver that sends parts of a turn, 10 degrees each."""
    points = scan_of(scene, SMALL_HDL, 1.2, roll=roll, pitch=pitch).points
    whole, parts, ground = SEGMENTER.segment(points), [], []
    assert whole.pose.is_well_seen and whole.pose.is_level == (roll == 0.0)
    # The pose of an earlier scan does not matter where a scan has its own.
    other = dataclasses.replace(whole.pose, height=3.0)
    with_other = SEGMENTER.segment(points, fallback=other)
    assert with_other.pose == whole.pose
    np.testing.assert_array_equal(with_other.label, whole.label)
    for start in range(-180, 180, 10):
        part = part_of(points, start, 10.0)
        if len(part):
            found = SEGMENTER.segment(part, fallback=whole.pose)
            assert found.pose.is_fallback and not found.pose.height_estimated
            assert found.pose.warnings == ()
            pose = found.pose
            assert (pose.height, pose.roll, pose.pitch) == (
                whole.pose.height, whole.pose.roll, whole.pose.pitch,
            )  # fmt: skip
            parts.append(part)
            ground.append(found.label == Label.GROUND)
    rows = {row.tobytes() for row in points[whole.label == Label.GROUND]}
    found = {row.tobytes() for row in np.concatenate(parts)[np.concatenate(ground)]}
    assert len(rows & found) / len(rows | found) >= 0.95


def test_the_pose_of_an_earlier_scan_replaces_nothing_that_is_given():
    points = scan_of('urban', SMALL_HDL, 1.2, roll=0.1).points
    earlier, part = pose_of(points), part_of(points, 0.0, 10.0)
    assert not earlier.is_level
    told = segmenter(height=1.0).segment(part, fallback=earlier).pose
    assert (told.height, told.roll, told.is_fallback) == (1.0, 0.0, False)
    tilted_so = SEGMENTER.segment(part, tilt=(0.2, 0.05), fallback=earlier).pose
    assert (tilted_so.roll, tilted_so.pitch) == (0.2, 0.05)
    assert (tilted_so.height, tilted_so.is_fallback) == (earlier.height, True)
    with pytest.raises(ConfigError, match=r'fallback = 1\.2: must be a SensorPose'):
        SEGMENTER.segment(part, fallback=1.2)
