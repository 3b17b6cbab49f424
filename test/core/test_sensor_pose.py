"""Height and tilt of the sensor from one scan: found, applied, refused, contradicted."""

import dataclasses
import math
from itertools import cycle

import numpy as np
import pytest
from conftest import fewer, simulated
from hypothesis import given, settings
from hypothesis import strategies as st
from rooms import ROOM, room

from gp_ground_seg import Config, GroundSegmenter, PointCloudError
from gp_ground_seg.core.backend import NumpyBackend
from gp_ground_seg.core.compiled.backend import NumbaBackend
from gp_ground_seg.core.jit import JIT_ENABLED
from gp_ground_seg.core.pipeline.points import angles_of, rotate, rotation
from gp_ground_seg.core.pipeline.sensor_pose import CLEAR_TILT, DEFAULT_HEIGHT
from gp_ground_seg.data.semantic_kitti import list_frames, list_sequences
from gp_ground_seg.lab import simulation
from gp_ground_seg.lab.simulation import HDL_64E, OS1_128, SCENES, VLP_16

# Scans of 100,000 points, too many for the compiled twins as plain Python.
BACKEND = NumbaBackend() if JIT_ENABLED else NumpyBackend()
TILTS = st.floats(-0.2, 0.2)
SLOW = pytest.mark.slow
# Every beam, and a third to a half of the columns.
SMALL_HDL, SMALL_VLP, SMALL_OS1 = (
    dataclasses.replace(sensor, n_columns=600) for sensor in (HDL_64E, VLP_16, OS1_128)
)
SENSORS = pytest.mark.parametrize(
    'sensor', [SMALL_HDL, SMALL_VLP, SMALL_OS1], ids=lambda sensor: sensor.name
)


def segmenter(backend=BACKEND, **sensor):
    values = {f'sensor.{name}': value for name, value in sensor.items()}
    config = Config().replace(**{'learning.mode': 'fixed'}, **values)
    return GroundSegmenter(config, backend=backend)


SEGMENTER = segmenter()


def pose_of(points, **sensor):
    return segmenter(**sensor).segment(points).pose


def tilted(points, roll, pitch):
    """What a sensor tilted so would see where a level one sees `points`."""
    return points[:, :3] @ rotation(roll, pitch)


def scan_of(scene, sensor, height, seed=0, roll=0.0, pitch=0.0):
    mounted = dataclasses.replace(sensor, height=height, roll=roll, pitch=pitch)
    return simulated(scene, mounted, seed)


def cluttered_plane(seed, height, roll, pitch):
    """Rings on a plane, a third of the directions blocked by obstacles, some noise."""
    rng = np.random.default_rng(seed)
    depression = np.radians(np.arange(2.0, 26.0, 1.0))
    azimuth = np.linspace(-np.pi, np.pi, 360, endpoint=False)
    r = (height / np.tan(depression))[:, None] * np.ones(len(azimuth))
    z = np.full(r.shape, -height)
    obstacle = np.repeat(rng.uniform(2.0, 30.0, 36), 10)
    blocked = (r > obstacle) & np.repeat(rng.random(36) < 0.33, 10)
    z = np.where(blocked, -height * obstacle / r, z)
    r = np.where(blocked, obstacle, r)
    points = np.stack([r * np.cos(azimuth), r * np.sin(azimuth), z], axis=-1).reshape(-1, 3)
    mirrored = rng.random(len(points)) < 0.01
    points[mirrored] *= rng.uniform(1.0, 2.0, (int(mirrored.sum()), 1))
    return points @ rotation(roll, pitch) + rng.normal(0.0, 0.01, points.shape)


@given(st.floats(-3.1, 3.1), st.floats(-1.5, 1.5))
def test_angles_and_rotation_are_inverse_of_each_other(roll, pitch):
    matrix = rotation(roll, pitch)
    np.testing.assert_allclose(matrix @ matrix.T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(angles_of(matrix[2]), (roll, pitch), atol=1e-4)
    mounted = dataclasses.replace(HDL_64E, roll=roll / 2.1, pitch=pitch)
    np.testing.assert_allclose(rotation(roll / 2.1, pitch), mounted.rotation(), atol=1e-12)
    # By REP 103 positive roll lifts the left side, positive pitch lowers the nose.
    assert (rotation(0.1, 0.0) @ [0.0, 1.0, 0.0])[2] > 0.0
    assert (rotation(0.0, 0.1) @ [1.0, 0.0, 0.0])[2] < 0.0


@pytest.mark.parametrize('dtype', [np.float32, np.float64])
def test_rotated_points_keep_their_precision_and_stay_finite(dtype):
    xyz = np.array([[1.0, 2.0, 3.0], [np.finfo(dtype).max] * 3, [np.nan, 1.0, np.inf]], dtype)
    turned = rotate(xyz, rotation(0.3, -0.2))
    assert turned.dtype == dtype
    np.testing.assert_allclose(turned[0], rotation(0.3, -0.2) @ xyz[0], rtol=1e-6)
    assert list(np.isfinite(turned).all(axis=1)) == [True, True, False]


@settings(max_examples=fewer(8, 3))
@given(st.integers(0, 2**32 - 1), st.floats(0.3, 4.0), TILTS, TILTS, st.floats(-np.pi, np.pi))
def test_a_cluttered_plane_is_recovered(seed, height, roll, pitch, yaw):
    points = cluttered_plane(seed, height, roll, pitch)
    pose = pose_of(points)
    assert pose.height_estimated
    np.testing.assert_allclose((pose.measured.roll, pose.measured.pitch), (roll, pitch), atol=0.01)
    assert 0.5 < pose.measured.plane.support <= 1.0
    if not pose.is_level:
        assert pose.height == pytest.approx(height, abs=0.04)
    order = np.random.default_rng(seed).permutation(len(points))
    assert pose_of(points[order]) == pose
    # Turning about the vertical of the ground keeps the height.
    c, s = np.cos(yaw), np.sin(yaw)
    level = points @ rotation(roll, pitch).T
    turned = pose_of(level @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]]))
    assert turned.height == pytest.approx(pose_of(level).height, abs=0.02)
    other = segmenter(NumpyBackend()).segment(points).pose
    assert dataclasses.replace(other, measured=None) == dataclasses.replace(pose, measured=None)


def moved(points, lift):
    """Points of a frame whose origin is `lift` lower [m]."""
    return points[:, :3].astype(np.float64) + np.array([0.0, 0.0, lift])


@pytest.mark.parametrize(
    ('scene', 'sensor'),
    [(s, SMALL_HDL) for s in ('kerb', 'rough')]
    + [(s, SMALL_VLP) for s in ('urban', 'lying_persons')],
)
@pytest.mark.parametrize('height', [0.4, 1.73])
def test_the_origin_may_be_at_any_height(scene, sensor, height):
    """In the frame of a vehicle z is 0 on the ground, and labels are those of the sensor's own."""
    points = scan_of(scene, sensor, height).points
    own = SEGMENTER.segment(points)
    assert own.pose.height_estimated and own.warnings == ()
    for lift in (height, height + 0.33, height - 15.0):
        # What is as high as a low sensor is no seed: its place must be known.
        origin = (0.0, 0.0, lift if height < 1.0 else 0.0)
        found = SEGMENTER.segment(moved(points, lift), origin=origin)
        assert found.pose.height_estimated and found.warnings == ()
        assert found.pose.height == pytest.approx(own.pose.height - lift, abs=1e-4)
        assert (found.label != own.label).mean() < 0.002
        np.testing.assert_allclose(found.height, own.height, atol=0.01)
        # It can be given, also if it is 0 or below.
        given_height = round(found.pose.height, 2)
        told = pose_of(moved(points, lift), height=given_height)
        assert told.height == given_height and told.contradictions == () == told.warnings


def with_beams(sensor, *elevations):
    return dataclasses.replace(sensor, elevations=tuple(np.radians(elevations)))


@pytest.mark.parametrize('lift', [0.0, 0.3])
@pytest.mark.parametrize(
    ('scene', 'sensor', 'height'),
    [
        ('urban', with_beams(VLP_16, 0.0), 0.3),
        (ROOM, with_beams(VLP_16, 0.0), 0.3),
        # This sensor sees the ceiling well, and the floor hardly.
        (ROOM, with_beams(SMALL_HDL, *np.linspace(52.0, -7.0, 60)), 1.8),
    ],
    ids=['street, one beam', 'room, one beam', 'ceiling'],
)
def test_a_scan_that_shows_no_ground(scene, sensor, height, lift):
    pose = pose_of(moved(scan_of(scene, sensor, height).points, lift * height / 0.3))
    assert not pose.height_estimated
    assert 'sensor.height' in pose.warnings[0]
    assert scene == 'urban' or pose.measured is None


def test_where_the_rays_start_tells_a_floor_from_a_cone_on_the_walls():
    """In the frame of a vehicle, and with a ring or two on the floor, or none."""
    points = moved(scan_of(ROOM, SMALL_VLP, 1.2).points, 1.2)
    assert not pose_of(points).height_estimated
    assert pose_of(points, origin_z=1.2).height == pytest.approx(0.0, abs=0.03)
    assert SEGMENTER.segment(points, origin=(0.0, 0.0, 1.2)).pose.height_estimated
    # Turned with the cloud.
    lean = tilted(points, 0.1, 0.0)
    x, y, z = (rotation(0.1, 0.0).T @ (0.0, 0.0, 1.2)).tolist()
    given_angles = {'roll': 0.1, 'pitch': 0.0, 'origin_x': x, 'origin_y': y, 'origin_z': z}
    assert pose_of(lean, **given_angles).height == pytest.approx(0.0, abs=0.03)
    # Here the lowest beam ends on the walls: seen from where it starts, that is a cone.
    walls = moved(scan_of(ROOM, SMALL_VLP, 1.8).points, 1.0)
    assert not pose_of(walls).height_estimated
    assert not pose_of(walls, origin_z=1.0).height_estimated
    # The plane is that of the verges of a crowned road, and the first ring lies on a cone.
    crown = simulation.terrain.polyline(math.pi / 2, [(-4.5, -0.55), (0.0, 0.0), (4.5, -0.55)])
    own = scan_of(simulation.Scene('crown', crown), SMALL_VLP, 0.3).points
    assert pose_of(own).starts_rays and not pose_of(moved(own, 0.2)).starts_rays


@pytest.mark.parametrize(('sensor', 'degrees'), [(SMALL_HDL, 45), (SMALL_VLP, 35)])
def test_a_large_tilt_is_levelled(sensor, degrees):
    """Beyond what is searched below z: in a frame of its own the ground is found all the same."""
    for direction in (0.0, 0.8, 2.5):
        tilt = math.radians(degrees)
        roll, pitch = tilt * math.cos(direction), tilt * math.sin(direction)
        pose = pose_of(scan_of('urban', sensor, 1.5, roll=roll, pitch=pitch).points)
        assert pose.roll_estimated and pose.height == pytest.approx(1.5, abs=0.15)
        lean = pose.rotation[2] @ rotation(roll, pitch)[2]
        assert math.acos(min(lean, 1.0)) < 0.03


def test_a_room_too_small_to_see_the_floor_determines_nothing_and_that_is_said_once(caplog):
    """Walls cut by the lowest beam alone are no plane; the default is said to be one."""
    closet = room('closet', [(-1.5, -1.0), (1.5, -1.0), (1.5, 2.0), (-1.5, 2.0)])
    points = scan_of(closet, SMALL_VLP, 1.2).points
    own = segmenter()
    results = [own.segment(points) for _ in range(3)]
    said = [record.getMessage() for record in caplog.records if record.name == 'gp_ground_seg']
    pose = results[0].pose
    assert pose.is_level and pose.is_height_default and not pose.height_estimated
    assert pose.height == DEFAULT_HEIGHT
    assert said == list(results[0].warnings)
    assert 'does not show the ground' in said[0] and 'next to nothing' in said[-1]
    # An empty cloud has no ground to show; a height that is given is not guessed.
    assert own.segment(points[:0]).warnings == ()
    told = segmenter(height=30.0 - 11.0).segment(points)
    assert [line.split(' of the scan')[0] for line in told.warnings] == ['next to nothing']


def test_what_is_given_is_used_and_contradicted():
    points = scan_of('flat', HDL_64E, 1.73).points
    for height in ({}, {'height': 1.6}):
        assert pose_of(points, **height).contradictions == ()
    wrong = pose_of(points, height=0.9)
    assert (wrong.height, wrong.height_estimated) == (0.9, False)
    assert wrong.measured.height == pytest.approx(1.73, abs=0.03)
    (line,) = wrong.contradictions
    assert 'sensor.height = 0.9' in line and '1.7' in line
    rolled = pose_of(points, height=1.73, roll=0.3, pitch=0.0)
    assert (rolled.roll, rolled.pitch) == (0.3, 0.0)
    assert any('sensor.roll = 0.3' in line for line in rolled.contradictions)
    # Angles of one scan, as from tf, are given ones too.
    assert SEGMENTER.segment(points, tilt=(0.3, 0.0)).pose.roll == 0.3
    points = scan_of('flat', HDL_64E, 1.73, roll=0.1, pitch=0.12).points
    for known in ({}, {'roll': 0.1}, {'pitch': 0.12}):
        pose = pose_of(points, **known)
        for name, value in {'roll': 0.1, 'pitch': 0.12}.items():
            assert getattr(pose, f'{name}_estimated') == (name not in known)
            assert getattr(pose, name) == pytest.approx(value, abs=0.0 if name in known else 0.005)
        assert pose.height == pytest.approx(1.73, abs=0.03)


def test_a_slight_tilt_is_left_alone_and_a_clear_one_is_levelled():
    points = scan_of('flat', HDL_64E, 1.73).points
    for tilt in (CLEAR_TILT, -CLEAR_TILT):
        assert pose_of(tilted(points, 0.8 * tilt, 0.0)).is_level
        assert pose_of(tilted(points, 0.0, 0.8 * tilt)).is_level
        clear = 1.3 * tilt
        assert pose_of(tilted(points, clear, 0.0)).roll == pytest.approx(clear, abs=0.004)
        assert pose_of(tilted(points, 0.0, clear)).pitch == pytest.approx(clear, abs=0.004)


@pytest.mark.parametrize(('roll', 'pitch'), [(0.09, 0.0), (0.0, -0.09), (-0.1, 0.15)])
def test_labels_of_a_tilted_scan_are_those_of_the_level_one(roll, pitch):
    points = scan_of('kerb', HDL_64E, 1.73).points[:, :3].astype(np.float64)
    lean = tilted(points, roll, pitch)
    lean.flags.writeable = False
    level, found = SEGMENTER.segment(points), SEGMENTER.segment(lean)
    given_angles = segmenter(roll=roll, pitch=pitch).segment(lean)
    assert (found.label != level.label).mean() < 0.005
    assert (given_angles.label != level.label).mean() < 1e-4
    np.testing.assert_allclose(given_angles.height, level.height, atol=1e-6)
    assert given_angles.pose.height == pytest.approx(level.pose.height, abs=1e-4)
    np.testing.assert_array_equal(SEGMENTER.segment(lean, (roll, pitch)).label, given_angles.label)
    np.testing.assert_array_equal(lean, tilted(points, roll, pitch))


def test_a_sensor_hung_upside_down_works_when_its_roll_is_given():
    points = scan_of('kerb', HDL_64E, 1.73).points[:, :3].astype(np.float64)
    hung, level = tilted(points, math.pi, 0.0), SEGMENTER.segment(points)
    for angles in ({'roll': 3.1416}, {'roll': 3.1416, 'pitch': 0.0}):
        result = segmenter(**angles).segment(hung)
        assert (result.label != level.label).mean() < 1e-3
        known = np.isfinite(result.ground_z)
        np.testing.assert_allclose(result.ground_z[known], -level.ground_z[known], atol=0.02)


UPS = {
    '-z': (math.pi, 0.0),
    'y': (math.pi / 2, 0.0),
    '-y': (-math.pi / 2, 0.0),
    'x': (0.0, -math.pi / 2),
    '-x': (0.0, math.pi / 2),
}

OVER = [('z does not point up: ', f'with {up} nearest to up', turn) for up, turn in UPS.items()]
LEANING = [
    ('z does not point up: ', '', (math.radians(50.0), 0.0)),
    ('z is tilted by 47 degrees: ', '', (math.radians(33.5), math.radians(35.0))),
]


@pytest.mark.parametrize(
    ('scene', 'sensor', 'turns', 'tolerance'),
    [
        ('slope', SMALL_HDL, OVER, 0.15),
        ('urban', SMALL_VLP, OVER, 0.05),
        ('rough', SMALL_OS1, OVER, 0.05),
        ('urban', SMALL_OS1, LEANING, 0.03),
        ('traffic_jam', SMALL_VLP, OVER[1:], 0.05),  # more of facades is seen
    ],
)
def test_z_not_up_is_refused_with_angles_that_can_be_given(scene, sensor, turns, tolerance):
    for start, part, turn in turns:
        points = tilted(scan_of(scene, sensor, 1.5).points, *turn)
        with pytest.raises(PointCloudError) as caught:
            pose_of(points)
        line = str(caught.value)
        assert line.startswith(start) and part in line and '\n' not in line
        words = (line.split(f'sensor.{name} to ')[1].split()[0] for name in ('roll', 'pitch'))
        roll, pitch = map(float, words)
        np.testing.assert_allclose(rotation(roll, pitch)[2], rotation(*turn)[2], atol=tolerance)
        told = pose_of(points, roll=roll, pitch=pitch)
        assert told.contradictions == () and told.height == pytest.approx(1.5, abs=0.15)
        assert pose_of(points, roll=0.0, pitch=0.0).contradictions == (line,)


MOUNTS = [
    # Each scene once by each sensor; the others in the long run.
    pytest.param(scene, sensor, height, marks=[] if (i + j) % 3 == 0 and height == 1.73 else SLOW)
    for i, scene in enumerate(SCENES)
    for j, sensor in enumerate((SMALL_HDL, SMALL_VLP, SMALL_OS1))
    for height in (0.4, 1.2, 1.73, 2.5)
]


@pytest.mark.parametrize(('scene', 'sensor', 'height'), MOUNTS)
def test_simulated_mounts_are_found_and_none_is_refused(scene, sensor, height):
    pose = pose_of(scan_of(scene, sensor, height, seed=3).points)
    # On a wet road many lowest returns are mirror images: it may be assumed, with a warning.
    assert pose.height_estimated or scene == 'wet_road'
    if scene in ('flat', 'urban', 'ditch', 'crest'):
        assert pose.height == pytest.approx(height, abs=0.1)
        assert pose.is_level


@pytest.mark.parametrize('n_missing', [2, 3])
def test_roofs_that_hide_the_ground_do_not_turn_z_over(n_missing):
    """Without the steepest beams; these roofs are above the sensor if z is down."""
    whole = simulation.SENSORS['vlp-32c']
    sparse = dataclasses.replace(whole, elevations=whole.elevations[:-n_missing])
    assert pose_of(scan_of('car_park', sparse, whole.height, seed=1).points).is_level


@pytest.mark.parametrize('first', [0, pytest.param(3, marks=SLOW)])
def test_real_frames(kitti, first):
    """The sensor is 1.73 m high; camber and verges move the plane by less than 0.15 m."""
    for sequence, (up, angles) in zip(list_sequences(kitti), cycle(UPS.items()), strict=False):
        for frame in list_frames(kitti, sequence)[first::6]:
            points = frame.points
            pose = pose_of(points)
            assert pose.height_estimated
            assert pose.height == pytest.approx(1.73, abs=0.15), frame
            assert pose.is_level, frame
            base, lean = pose.measured, pose_of(tilted(points, 0.1, -0.08)).measured
            np.testing.assert_allclose(
                (lean.roll - base.roll, lean.pitch - base.pitch), (0.1, -0.08), atol=0.02
            )
        for axis, turn in ((up, angles), ('-z', (3.0, 0.1))):
            with pytest.raises(PointCloudError, match=f'with {axis} nearest to up'):
                pose_of(tilted(points, *turn))
