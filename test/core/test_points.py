import numpy as np
import pytest
from conftest import simulated

from gp_ground_seg import Config, GroundSegmenter, Label
from gp_ground_seg.core.errors import PointCloudError
from gp_ground_seg.core.pipeline import points


def test_points_are_taken_as_they_lie_if_they_can_be_computed_with():
    wide = np.zeros((9, 7), dtype=np.float32)
    assert np.shares_memory(points.take_points(wide), wide)
    assert points.take_points(np.zeros((4, 64))).shape == (4, 3)  # few points of many columns
    packed = np.zeros(9, dtype=[('flag', 'u1'), ('xyz', '<f4', 3)])['xyz']
    for array, dtype in ((wide.astype('>f8'), 'f8'), (wide.astype('f2'), 'f4'), (packed, 'f4')):
        assert points.take_points(array).dtype == np.dtype(dtype)
        assert points.take_points(array).flags.aligned


def test_single_precision_keeps_finite_what_is():
    xyz = np.array([[1.0, 1e300, -1e300], [np.inf, -np.inf, np.nan], [0.1, 2.0, 3.0]])
    single = points.single_precision(xyz)
    np.testing.assert_array_equal(single[[0, 2], 0], np.float32([1.0, 0.1]))
    np.testing.assert_array_equal(np.isfinite(single), np.isfinite(xyz))
    assert list(points.finite_points(single)) == [True, False, True]
    assert single[0, 1] > 3e38 and single[0, 2] < -3e38
    assert points.single_precision(single) is single


@pytest.mark.parametrize(('share', 'is_refused'), [(0.0, False), (0.05, False), (0.2, True)])
def test_points_farther_than_a_sensor_measures(share, is_refused):
    scan = simulated('flat', seed=1).points[:, :3].astype(float)
    for far in (10_001.0, -1e30, np.inf, np.nan):
        placed = np.where(np.arange(len(scan))[:, None] % 100 < 100 * share, far, scan)
        if is_refused and np.isfinite(far):
            with pytest.raises(PointCloudError, match='20% of the points are beyond 10 km'):
                points.take_points(placed)
        else:
            assert len(points.take_points(placed)) == len(scan)


MOUNT = 0.9, -0.3, 1.73


@pytest.mark.parametrize('dtype', ['f4', '>f4', 'f8', 'f2'])
@pytest.mark.parametrize('origin', [(0.0, 0.0, 0.0), MOUNT, (0.0, 1e-17, 1.73)])
def test_points_at_the_sensor_become_nan(dtype, origin):
    rng = np.random.default_rng(0)
    array = rng.uniform(-9.0, 9.0, (400, 4)).astype(dtype)
    array[:9, :3], array[9:20, :3], array[20, :3] = 0.0, origin, -0.0
    array[9:20, 1] *= abs(origin[1]) > 1e-9  # TF is a rounding beside the driver's zero
    for k in range(3):  # near it, or with two coordinates of it
        array[21 + k, :3] = origin
        array[21 + k, k] += 0.02
    before = array.copy()
    taken = points.take_points(array, origin)
    np.testing.assert_array_equal(np.isnan(taken).all(axis=1), np.arange(400) < 21)
    np.testing.assert_array_equal(taken[21:], points.take_points(array)[21:])
    np.testing.assert_array_equal(array, before)
    # Rounded to single precision once, and of another type now.
    single = array.astype('f4').astype('f8') if dtype != 'f2' else array
    np.testing.assert_array_equal(
        np.isnan(points.take_points(single, origin)[:, 0]), np.arange(400) < 21
    )
    # Of its own, each coordinate contiguous: laid out once, and never written to again.
    assert taken.flags.f_contiguous and not np.shares_memory(taken, array)
    laid_out = points.in_columns(taken)
    assert np.shares_memory(laid_out, taken) and not laid_out.flags.writeable
    assert points.in_columns(taken.copy('C')).flags.f_contiguous


def test_places_that_many_points_share_are_sensors():
    rng = np.random.default_rng(0)
    places = np.float32([MOUNT, (1.35, 0.5, 1.9), (6.0, 1.0, 0.0)])
    for n_rings, share in ((64, 0.04), (40, 0.04), (1, 0.9), (1, 0.01)):
        scan = rng.uniform(-20.0, 20.0, (40_000, 3)).astype('f4').round(2)
        spot = rng.integers(3, size=40_000)
        shared = (
            rng.random(40_000) < 3.0 * share if n_rings == 1 else np.arange(40_000) % n_rings < 8
        )
        scan[shared] = places[spot[shared]]
        empty = np.isnan(points.take_points(scan, (0.0, 0.0, 0.0))[:, 0])
        # Not those that few points share, nor those that are farther away than a sensor.
        np.testing.assert_array_equal(empty, shared & (spot < 2) & (share > 0.03))
    few = np.tile(places[:1], (999, 1))
    assert np.isfinite(points.take_points(few, (0.0, 0.0, 0.0))).all()


BOX = -2.0, 1.0, -0.8, 0.8, -1.5, 0.5
VALUES = {'learning.mode': 'fixed', 'input.crop_box': BOX}


def scan_with_own_body(dtype=np.float32):
    """A scan with a thousand returns of the robot's own body, in `BOX`; which points are in it."""
    scan = simulated('urban', seed=1).points[:, :3]
    body = np.random.default_rng(0).uniform(BOX[::2], BOX[1::2], (1000, 3))
    cloud = np.concatenate([body, scan]).astype(dtype)
    return cloud, ((cloud >= BOX[::2]) & (cloud <= BOX[1::2])).all(axis=1)


@pytest.mark.parametrize('backend', ['numpy', 'numba'])
def test_points_in_the_crop_box_are_no_returns(backend):
    cloud, is_body = scan_with_own_body()
    config = Config().replace(**{'runtime.backend': backend, **VALUES})
    before = cloud.copy()
    found = GroundSegmenter(config).segment(cloud)
    np.testing.assert_array_equal(cloud, before)
    # In no class, without a height, and nothing else hangs on them.
    np.testing.assert_array_equal(found.label == Label.UNKNOWN, is_body)
    assert np.isnan(found.height[is_body]).all()
    outside = cloud[~is_body]
    assert points.without_box(outside, BOX, None) is outside
    without = config.replace(**{'input.crop_box': 'none'})
    expected = GroundSegmenter(without).segment(outside)
    assert found.pose == expected.pose
    for name in ('label', 'height', 'ground_z', 'ground_std', 'p_ground'):
        np.testing.assert_array_equal(getattr(found, name)[~is_body], getattr(expected, name))


def test_the_crop_box_may_be_in_another_frame():
    cloud, is_body = scan_with_own_body(np.float64)
    turn, move = points.rotation(0.2, -0.3), np.array([1.0, -2.0, 0.5])
    moved = (cloud - move) @ turn  # in the frame of the box it is R p + t
    config = Config().replace(**{'runtime.backend': 'numpy', **VALUES})
    found = GroundSegmenter(config).segment(moved, (0.2, -0.3), box_frame=(turn, move))
    np.testing.assert_array_equal(found.label == Label.UNKNOWN, is_body)
