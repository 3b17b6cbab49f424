import numpy as np

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
