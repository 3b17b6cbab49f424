"""Height and tilt of the sensor from one scan: found, applied, refused, contradicted."""

import dataclasses
import itertools
import math

import numpy as np
import pytest
from conftest import hilly_scan
from hypothesis import given, settings
from hypothesis import strategies as st

from gp_ground_seg import Config, GroundSegmenter, Label, PointCloudError
from gp_ground_seg.compiled.plane_passes import (
    ALLOWED,
    INVERSE,
    N_LARGEST,
    RANGE,
    X,
    Y,
    Z,
    plane_below,
    tabulate,
)
from gp_ground_seg.data.semantic_kitti import list_frames, list_sequences, read_points
from gp_ground_seg.frame import Candidates
from gp_ground_seg.ground_model import GroundModel
from gp_ground_seg.pipeline.low_cells import directions, low_cells
from gp_ground_seg.pipeline.points import check_points
from gp_ground_seg.pipeline.polar_grid import build_polar_grid, ground_candidates, reduce_cells
from gp_ground_seg.pipeline.sensor_pose import (
    CLEAR_TILT,
    DEFAULT_HEIGHT,
    SensorPose,
    estimate_pose,
)
from gp_ground_seg.pipeline.tilt import angles_of, rotation, turned_sample
from gp_ground_seg.simulation import (
    HDL_64E,
    OS1_128,
    SCENES,
    VLP_16,
    Scene,
    simulate_scan,
)
from gp_ground_seg.simulation import terrain as landforms
from gp_ground_seg.simulation.objects import floating_box, wall

FIXED = {'learning.mode': 'fixed'}
SEGMENTER = GroundSegmenter(Config().replace(**FIXED))


def segmenter(**sensor):
    values = {f'sensor.{name}': value for name, value in sensor.items()}
    return GroundSegmenter(Config().replace(**FIXED, **values))


def candidates_of(points):
    """Slow and obvious: no compiled code, no backend."""
    xyz = check_points(points)
    grid = build_polar_grid(xyz, Config().grid)
    nowhere = np.zeros(len(xyz), dtype=np.int32)
    return ground_candidates(reduce_cells(grid, xyz[:, 2], nowhere), grid.edges, 0.05)


def pose_of(points, use_compiled=True, **sensor):
    xyz = check_points(points)
    values = {f'sensor.{name}': value for name, value in sensor.items()}
    return estimate_pose(
        candidates_of(xyz),
        Config().replace(**values).sensor,
        use_compiled,
        lambda turn: candidates_of(turned_sample(xyz, turn)),
    )


def assert_same_cells(candidates):
    """What the compiled code makes of the candidates is what its twin does."""
    slow = low_cells(candidates)
    cells, sectors = np.empty((6, N_LARGEST)), np.empty(N_LARGEST, dtype=np.int64)
    offsets = candidates.offsets
    n = tabulate(offsets, candidates.r, candidates.z, directions(len(offsets) - 1), cells, sectors)
    rows = {X: slow.x, Y: slow.y, Z: slow.z, RANGE: slow.r, ALLOWED: slow.tolerance}
    for row, expected in {**rows, INVERSE: 1.0 / slow.tolerance}.items():
        np.testing.assert_array_equal(cells[row, :n], expected)
    np.testing.assert_array_equal(sectors[:n], slow.sector)


def tilted(points, roll, pitch):
    """What a sensor tilted so would see where a level one sees `points`."""
    return points @ rotation(roll, pitch)


def scan_of(scene, sensor, height, seed=0, roll=0.0, pitch=0.0):
    mounted = dataclasses.replace(sensor, height=height, roll=roll, pitch=pitch)
    made = SCENES[scene](seed) if isinstance(scene, str) else scene
    return simulate_scan(made, mounted, np.random.default_rng(seed))


def cluttered_plane(seed, height, roll, pitch):
    """Rings on a plane, a third of the directions blocked by what stands there, some noise."""
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
    return tilted(points, roll, pitch) + rng.normal(0.0, 0.01, points.shape)


# Angles


@given(st.floats(-3.1, 3.1), st.floats(-1.5, 1.5))
def test_angles_and_rotation_are_inverse_of_each_other(roll, pitch):
    matrix = rotation(roll, pitch)
    np.testing.assert_allclose(matrix @ matrix.T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(angles_of(matrix[2]), (roll, pitch), atol=1e-4)


def test_signs_are_those_of_rep_103_and_of_the_simulator():
    """Positive roll lifts the left side, positive pitch lowers the nose."""
    assert (rotation(0.1, 0.0) @ [0.0, 1.0, 0.0])[2] > 0.0
    assert (rotation(0.0, 0.1) @ [1.0, 0.0, 0.0])[2] < 0.0
    mounted = dataclasses.replace(HDL_64E, roll=0.2, pitch=-0.1)
    np.testing.assert_allclose(rotation(0.2, -0.1), mounted.rotation(), atol=1e-12)


# Estimation


@settings(max_examples=40)
@given(
    st.integers(0, 2**32 - 1),
    st.floats(0.3, 4.0),
    st.floats(-0.2, 0.2),
    st.floats(-0.2, 0.2),
)
def test_a_cluttered_plane_is_recovered(seed, height, roll, pitch):
    pose = pose_of(cluttered_plane(seed, height, roll, pitch))
    assert pose.height_estimated
    measured = pose.measured
    np.testing.assert_allclose((measured.roll, measured.pitch), (roll, pitch), atol=0.01)
    if not pose.is_level:
        assert pose.height == pytest.approx(height, abs=0.04)
    assert measured.plane.residual < 0.1


@settings(max_examples=20)
@given(st.integers(0, 2**32 - 1))
def test_twins_agree_and_the_order_of_points_does_not_matter(seed):
    points = cluttered_plane(seed, 1.5, 0.1, -0.05)
    candidates = candidates_of(points)
    assert_same_cells(candidates)
    a, b = (plane_below(candidates, 0.5, compiled) for compiled in (False, True))
    np.testing.assert_allclose(dataclasses.astuple(a), dataclasses.astuple(b), atol=1e-9)
    order = np.random.default_rng(seed).permutation(len(points))
    assert pose_of(points) == pose_of(points[order])
    same, other = (
        dataclasses.replace(pose_of(points, use_compiled=compiled), measured=None)
        for compiled in (True, False)
    )
    assert same == other


@settings(max_examples=60)
@given(st.integers(0, 2**32 - 1), st.integers(1, 400), st.integers(0, 40), st.floats(0.0, 1.0))
def test_twins_agree_on_anything(seed, n_segments, n_bins, share):
    """Few cells or many, equally low ones, nearer, farther, lower than what counts."""
    rng = np.random.default_rng(seed)
    n = rng.binomial(n_bins, share, n_segments)
    offsets = np.concatenate([[0], np.cumsum(n)])
    r = [np.sort(rng.choice(np.geomspace(0.4, 50.0, 60), k, replace=False)) for k in n]
    z = np.round(rng.choice([-1.7, 0.0, 70.0], offsets[-1], p=[0.8, 0.15, 0.05]), 1)
    z += np.round(rng.normal(0.0, 0.1, offsets[-1]), 1)
    nothing = np.zeros(offsets[-1])
    candidates = Candidates(
        np.concatenate(r), z, nothing.astype(np.int64), nothing, offsets, nothing.astype(np.int32)
    )
    assert_same_cells(candidates)
    a, b = (plane_below(candidates, 0.577, compiled) for compiled in (False, True))
    assert (a is None) == (b is None)
    if a is not None and b is not None:
        np.testing.assert_allclose(dataclasses.astuple(a), dataclasses.astuple(b), atol=1e-9)


@settings(max_examples=20)
@given(st.integers(0, 2**32 - 1), st.floats(-np.pi, np.pi))
def test_turning_about_the_vertical_keeps_the_height(seed, yaw):
    points = cluttered_plane(seed, 1.5, 0.0, 0.0)
    c, s = np.cos(yaw), np.sin(yaw)
    pose = pose_of(points @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]).T)
    assert pose.height == pytest.approx(pose_of(points).height, abs=0.02)


@pytest.mark.parametrize('sensor', [HDL_64E, VLP_16, OS1_128], ids=lambda s: s.name)
@pytest.mark.parametrize('height', [0.4, 1.2, 1.73, 2.5])
@pytest.mark.parametrize('scene', ['flat', 'urban', 'ditch', 'crest'])
def test_simulated_mounts(sensor, height, scene):
    pose = pose_of(scan_of(scene, sensor, height).points)
    assert pose.height_estimated
    assert pose.height == pytest.approx(height, abs=0.1)
    assert pose.is_level


@pytest.mark.parametrize('sensor', [HDL_64E, VLP_16, OS1_128], ids=lambda s: s.name)
@pytest.mark.parametrize('scene', ['flat', 'kerb', 'urban', 'ramp'])
def test_simulated_tilt(sensor, scene):
    pose = pose_of(scan_of(scene, sensor, 1.5, roll=0.07, pitch=-0.05).points)
    assert pose.roll_estimated and pose.pitch_estimated
    np.testing.assert_allclose((pose.roll, pose.pitch), (0.07, -0.05), atol=0.008)
    assert pose.height == pytest.approx(1.5, abs=0.12)


@pytest.mark.parametrize(('sensor', 'height'), [(VLP_16, 0.4), (OS1_128, 0.5), (HDL_64E, 1.73)])
def test_indoors_the_floor_is_found_and_not_the_ceiling(sensor, height):
    ground = landforms.flat()
    ends = [(-8.0, -5.0), (12.0, -5.0), (12.0, 7.0), (-8.0, 7.0), (-8.0, -5.0)]
    solids = [s for a, b in itertools.pairwise(ends) for s in wall(ground, a, b, 3.0)]
    solids.append(floating_box(ground, 2.0, 1.0, (20.0, 12.0, 0.2), 3.0))
    pose = pose_of(scan_of(Scene('room', ground, tuple(solids)), sensor, height).points)
    assert pose.height_estimated
    assert pose.height == pytest.approx(height, abs=0.05)
    assert pose.is_level


def test_a_room_too_small_to_see_the_floor_tells_nothing():
    """Walls cut by the lowest beam alone are no plane; the default is said to be one."""
    ground = landforms.flat()
    ends = [(-1.5, -1.0), (1.5, -1.0), (1.5, 2.0), (-1.5, 2.0), (-1.5, -1.0)]
    solids = [s for a, b in itertools.pairwise(ends) for s in wall(ground, a, b, 3.0)]
    pose = pose_of(scan_of(Scene('closet', ground, tuple(solids)), VLP_16, 1.2).points)
    assert not pose.height_estimated
    assert pose.height == DEFAULT_HEIGHT
    assert pose.is_level


def test_the_roof_of_the_own_vehicle_is_not_the_ground():
    rng = np.random.default_rng(0)
    roof = np.column_stack([rng.uniform(-1.5, 1.5, (20000, 2)), np.full(20000, -0.3)])
    street = scan_of('flat', HDL_64E, 1.9).points[:, :3]
    pose = pose_of(np.concatenate([street, roof]))
    assert pose.height == pytest.approx(1.9, abs=0.05)


@pytest.mark.parametrize(
    'points',
    [
        np.empty((0, 3)),
        np.full((7, 3), np.nan),
        np.array([[10.0, 0.0, -1.0]]),
        np.array([[10.0, 0.0, -1.0], [0.0, 10.0, -1.0], [-10.0, 0.0, -1.0]]),
        np.full((50, 3), 1e200),
        np.full((50, 3), -1e308),
    ],
)
def test_too_little_to_tell(points):
    pose = pose_of(points)
    assert (pose.height, pose.roll, pose.pitch) == (DEFAULT_HEIGHT, 0.0, 0.0)
    assert not (pose.height_estimated or pose.roll_estimated or pose.pitch_estimated)
    assert SEGMENTER.segment(points).pose == pose
    assert len(segmenter(roll=2.0, pitch=0.3).segment(points).label) == len(points)


# What is given


def test_what_is_given_is_used_and_contradicted():
    points = scan_of('flat', HDL_64E, 1.73).points
    pose = SEGMENTER.segment(points).pose
    assert pose.contradictions == ()
    wrong = segmenter(height=0.9).segment(points).pose
    assert wrong.height == 0.9
    assert not wrong.height_estimated
    assert wrong.measured.height == pytest.approx(1.73, abs=0.03)
    (said,) = wrong.contradictions
    assert 'sensor.height = 0.9' in said
    assert '1.7' in said
    assert segmenter(height=1.6).segment(points).pose.contradictions == ()
    rolled = segmenter(height=1.73, roll=0.3, pitch=0.0).segment(points).pose
    assert (rolled.roll, rolled.pitch) == (0.3, 0.0)
    assert any('sensor.roll = 0.3' in line for line in rolled.contradictions)


def test_angles_given_are_kept_and_the_other_is_found():
    points = scan_of('flat', HDL_64E, 1.73, roll=0.1, pitch=0.12).points
    both = pose_of(points)
    np.testing.assert_allclose((both.roll, both.pitch), (0.1, 0.12), atol=0.005)
    for known in ('roll', 'pitch'):
        given_one = SEGMENTER_FOR[known].segment(points).pose
        assert getattr(given_one, known) == {'roll': 0.1, 'pitch': 0.12}[known]
        assert not getattr(given_one, f'{known}_estimated')
        np.testing.assert_allclose((given_one.roll, given_one.pitch), (0.1, 0.12), atol=0.005)
        assert given_one.height == pytest.approx(1.73, abs=0.03)
    level = segmenter(roll=0.0, pitch=0.0).segment(points).pose
    assert level.is_level


SEGMENTER_FOR = {'roll': segmenter(roll=0.1), 'pitch': segmenter(pitch=0.12)}


def test_a_slight_tilt_is_left_alone_and_a_clear_one_is_levelled():
    points = scan_of('flat', HDL_64E, 1.73).points[:, :3]
    for tilt in (0.8 * CLEAR_TILT, -0.8 * CLEAR_TILT):
        assert pose_of(tilted(points, tilt, 0.0)).is_level
        assert pose_of(tilted(points, 0.0, tilt)).is_level
    for tilt in (1.3 * CLEAR_TILT, -1.3 * CLEAR_TILT):
        assert pose_of(tilted(points, tilt, 0.0)).roll == pytest.approx(tilt, abs=0.004)
        assert pose_of(tilted(points, 0.0, tilt)).pitch == pytest.approx(tilt, abs=0.004)


# What the segmentation makes of it


@pytest.mark.parametrize(('roll', 'pitch'), [(0.09, 0.0), (0.0, -0.09), (-0.1, 0.15)])
def test_labels_of_a_tilted_scan_are_those_of_the_level_one(roll, pitch):
    scan = scan_of('kerb', HDL_64E, 1.73)
    points = scan.points[:, :3].astype(np.float64)
    lean = tilted(points, roll, pitch)
    lean.flags.writeable = False
    level, found = SEGMENTER.segment(points), SEGMENTER.segment(lean)
    told = segmenter(roll=roll, pitch=pitch).segment(lean)
    assert (found.label != level.label).mean() < 0.005
    assert (told.label != level.label).mean() < 1e-4
    np.testing.assert_allclose(told.height, level.height, atol=1e-6)
    assert told.pose.height == pytest.approx(level.pose.height, abs=1e-4)
    np.testing.assert_array_equal(lean, tilted(points, roll, pitch))


def test_ground_z_is_along_the_sensors_own_axis():
    roll, pitch = 0.1, -0.12
    scan = scan_of('flat', HDL_64E, 1.73, roll=roll, pitch=pitch)
    result = segmenter(roll=roll, pitch=pitch).segment(scan.points)
    near = scan.is_ground & (np.hypot(scan.points[:, 0], scan.points[:, 1]) < 30.0)
    # The simulator's truth: where a line along the sensor's z meets the terrain.
    error = result.ground_z[near] - scan.ground_z[near]
    assert np.nanmedian(np.abs(error)) < 0.02
    cosine = math.cos(roll) * math.cos(pitch)
    own_z = scan.points[:, 2].astype(np.float64)
    np.testing.assert_allclose(result.ground_z, own_z - result.height / cosine, atol=1e-9)


def test_without_tilt_ground_z_and_height_add_up(scan):
    result = SEGMENTER.segment(scan)
    assert result.pose.is_level
    np.testing.assert_array_equal(result.height, scan[:, 2] - result.ground_z)


def test_the_ground_model_of_a_tilted_scan_is_in_the_sensors_frame():
    scan = scan_of('flat', HDL_64E, 1.73, roll=0.1, pitch=-0.12)
    result = segmenter(roll=0.1, pitch=-0.12).segment(scan.points)
    model = GroundModel.of(result)
    near = scan.is_ground & (np.hypot(scan.points[:, 0], scan.points[:, 1]) < 20.0)
    height, std = model.at(scan.points[near, 0], scan.points[near, 1])
    assert np.nanmedian(np.abs(height - scan.ground_z[near])) < 0.02
    assert np.isfinite(height).mean() > 0.99
    assert np.nanmax(np.abs(height - result.ground_z[near])) < 0.3
    assert (std[np.isfinite(height)] > 0.0).all()


def test_a_sensor_hung_upside_down_works_when_it_is_told():
    scan = scan_of('kerb', HDL_64E, 1.73)
    points = scan.points[:, :3].astype(np.float64)
    hung = tilted(points, math.pi, 0.0)
    with pytest.raises(PointCloudError):
        SEGMENTER.segment(hung)
    level = SEGMENTER.segment(points)
    for told in (segmenter(roll=3.1416), segmenter(roll=3.1416, pitch=0.0)):
        result = told.segment(hung)
        assert (result.label != level.label).mean() < 1e-3
        known = np.isfinite(result.ground_z)
        np.testing.assert_allclose(result.ground_z[known], -level.ground_z[known], atol=0.02)


# What is refused

UPS = {
    '-z': (math.pi, 0.0),
    'y': (math.pi / 2, 0.0),
    '-y': (-math.pi / 2, 0.0),
    'x': (0.0, -math.pi / 2),
    '-x': (0.0, math.pi / 2),
}


def refusal(points):
    with pytest.raises(PointCloudError) as caught:
        pose_of(points)
    said = str(caught.value)
    assert said.startswith('z does not point up: ')
    assert '\n' not in said
    return said


@pytest.mark.parametrize('sensor', [HDL_64E, VLP_16, OS1_128], ids=lambda s: s.name)
@pytest.mark.parametrize('scene', ['flat', 'slope', 'rough', 'urban'])
@pytest.mark.parametrize('up', UPS)
def test_z_not_up_is_refused_with_the_axis_that_is(sensor, scene, up):
    points = tilted(scan_of(scene, sensor, 1.5).points[:, :3], *UPS[up])
    said = refusal(points)
    assert f'with {up} up' in said
    roll, pitch = (float(said.split(f'sensor.{name} to ')[1].split()[0]) for name in UPS_NAMES)
    expected, found = (rotation(*angles)[2] for angles in (UPS[up], (roll, pitch)))
    slope = 0.15 if scene == 'slope' else 0.05
    np.testing.assert_allclose(found, expected, atol=slope)


UPS_NAMES = ('roll', 'pitch')


def test_what_the_refusal_says_to_set_is_taken(scan):
    points = tilted(scan_of('kerb', OS1_128, 1.5).points[:, :3], -math.pi / 2, 0.0)
    said = refusal(points)
    roll, pitch = (float(said.split(f'sensor.{name} to ')[1].split()[0]) for name in UPS_NAMES)
    result = segmenter(roll=roll, pitch=pitch).segment(points)
    assert result.pose.height == pytest.approx(1.5, abs=0.1)
    assert (result.label == Label.GROUND).mean() > 0.4
    assert np.isnan(result.ground_z).all()  # its z axis is level


def test_angles_given_silence_the_refusal_but_not_the_contradiction():
    points = tilted(scan_of('flat', HDL_64E, 1.73).points[:, :3], math.pi, 0.0)
    pose = segmenter(roll=0.0, pitch=0.0, height=1.73).segment(points).pose
    assert (pose.height, pose.roll, pose.pitch) == (1.73, 0.0, 0.0)
    (said,) = pose.contradictions
    assert said.startswith('z does not point up: ')


@pytest.mark.parametrize('sensor', [HDL_64E, VLP_16, OS1_128], ids=lambda s: s.name)
@pytest.mark.parametrize('scene', SCENES)
@pytest.mark.parametrize('height', [0.4, 2.5])
def test_no_simulated_scene_is_refused(sensor, scene, height):
    assert pose_of(scan_of(scene, sensor, height, seed=3).points).height_estimated


@pytest.mark.parametrize('gradient', [0.15, 0.3, 0.45])
def test_steep_ground_is_not_refused(gradient):
    scene = Scene('steep', landforms.slope(gradient, 0.7))
    pose = pose_of(scan_of(scene, OS1_128, 1.2).points)
    assert pose.height_estimated
    tilt = math.acos(pose.rotation[2, 2])
    assert tilt == pytest.approx(math.atan(gradient), abs=0.02)


# Real frames


def test_real_frames(kitti):
    """The car's roof is 1.73 m high; camber and verges move the plane by less than 0.15 m."""
    for sequence in list_sequences(kitti):
        for frame in list_frames(kitti, sequence)[::3]:
            points = read_points(frame.points_path)[:, :3]
            pose = pose_of(points)
            assert pose.height_estimated
            assert pose.height == pytest.approx(1.73, abs=0.15), frame
            assert pose.is_level, frame
            base = pose.measured
            lean = pose_of(tilted(points, 0.1, -0.08)).measured
            np.testing.assert_allclose(
                (lean.roll - base.roll, lean.pitch - base.pitch), (0.1, -0.08), atol=0.02
            )


@pytest.mark.parametrize('up', UPS)
def test_real_frames_turned_are_refused(kitti, up):
    for sequence in list_sequences(kitti):
        frame = list_frames(kitti, sequence)[0]
        points = read_points(frame.points_path)[:, :3]
        assert f'with {up} up' in refusal(tilted(points, *UPS[up])), frame


def test_level_copies_nothing_and_reports_so():
    xyz = hilly_scan(100)
    pose = SensorPose(1.0, 0.0, 0.0)
    assert pose.level(xyz) is xyz
    assert pose.is_level
    np.testing.assert_array_equal(pose.rotation, np.eye(3))
