import numpy as np
import pytest
from conftest import simulated

from gp_ground_seg.core.errors import PointCloudError
from gp_ground_seg.core.pipeline import points


def test_points_are_taken_as_they_lie_if_they_can_be_computed_with():
    wide = np.zeros((9, 7), dtype=np.float32)
    assert np.shares_memory(points.take_points(wide), wide)
    assert not np.shares_memory(points.check_points(wide), wide)
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


def test_columns_for_rows_are_refused():
    scan = simulated('flat', seed=1).points
    for wrong in (scan.T, scan[:, :3].T, scan[:65].T):
        with pytest.raises(PointCloudError, match=r'a point is a row; pass points\.T'):
            points.take_points(wrong)
    # Few points of many columns.
    assert points.take_points(np.zeros((4, 64))).shape == (4, 3)


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
