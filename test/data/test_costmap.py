"""What a costmap takes, against plain loops and the exact obstacles of simulated streets."""

import math

import numpy as np
import pytest
from conftest import simulated
from scipy import ndimage

from gp_ground_seg import Config, GroundSegmenter, Label
from gp_ground_seg.core.errors import PointCloudError
from gp_ground_seg.core.frame import GroundSurface
from gp_ground_seg.core.pipeline.points import rotation
from gp_ground_seg.data import costmap
from gp_ground_seg.data.costmap import DIRECTIONS, FREE, OCCUPIED, UNKNOWN, SegmentedCloud
from gp_ground_seg.lab.simulation import Kind
from gp_ground_seg.lab.simulation.objects import standing_box
from gp_ground_seg.lab.simulation.scenes import Scene
from gp_ground_seg.lab.simulation.terrain import flat


def segmented_points(xyz, config):
    """What is published of points."""
    return SegmentedCloud(None, GroundSegmenter(config).segment(xyz), config, xyz)


def street(scene='urban', sensor='hdl-64e', seed=0, lowest=0.2, highest=2.0):
    """Simulated scan, and what is published of it between two heights."""
    scan = simulated(scene, sensor, seed)
    heights = {'output.min_height': lowest, 'output.max_height': highest}
    return scan, segmented_points(scan.points[:, :3], Config().replace(**heights))


def in_sight(cloud):
    """What `scan_ranges` gives of a cloud."""
    return costmap.scan_ranges(cloud.places(cloud.is_obstacle), tuple(cloud.points.T[:2]))


def occupancy_of(segmented):
    output = segmented.config.output
    surface, std = segmented.segmentation.surface, segmented.config.label.ground_tolerance
    reach = costmap.reach_of_model(surface, segmented.heading, std)
    places = map(segmented.places, (segmented.is_ground, segmented.is_obstacle))
    return costmap.occupancy(*places, reach, output.cell_size, output.grid_size)


def direction_by_hand(x, y):
    return int((math.atan2(y, x) + math.pi) // (2.0 * math.pi / DIRECTIONS)) % DIRECTIONS


def test_ranges_are_those_of_the_nearest_obstacle():
    rng = np.random.default_rng(0)
    obstacles, ground = rng.normal(0.0, 5.0, (2, 300)), rng.normal(0.0, 5.0, (2, 300))
    expected = np.full(DIRECTIONS, np.nan)
    for x, y in np.hstack([obstacles, ground]).T:
        expected[direction_by_hand(x, y)] = np.inf
    for x, y in obstacles.T:
        direction = direction_by_hand(x, y)
        expected[direction] = min(expected[direction], math.hypot(x, y))
    returns = tuple(np.hstack([obstacles, ground]))
    np.testing.assert_allclose(costmap.scan_ranges(tuple(obstacles), returns), expected, rtol=1e-6)
    assert np.isnan(expected).any() and np.isinf(expected).any()


def test_cells_are_free_where_ground_was_seen_and_before_obstacles():
    """One ray of returns along x: ground at 3 and 9 m, an obstacle at 6 m."""
    ground = np.array([3.05, 9.05, 0.0]), np.array([0.02, 0.02, 4.0])
    obstacles = np.array([6.05]), np.array([0.02])
    reach = np.full(DIRECTIONS, 100.0, np.float32)

    def row(reach, obstacles=obstacles):
        state = costmap.occupancy(ground, obstacles, reach, 0.1, 20.0)
        assert state.shape == (200, 200)
        assert state[140, 100] == FREE  # (0, 4)
        return state[100, 100:]  # cells of y from 0 to 0.1, x from 0 on

    state = row(reach)
    # No direction has its middle in the row's nearest cells: (x, 0.05) is in that of y > 0.0044 x.
    assert (state[:30] == UNKNOWN).all()
    assert state[60] == OCCUPIED and state[90] == FREE
    assert (state[91:] == UNKNOWN).all() and (state[61:90] == UNKNOWN).all()
    beyond = row(reach, (np.empty(0), np.empty(0)))
    assert (beyond[30:] == UNKNOWN).sum() < (state[30:] == UNKNOWN).sum()
    assert (row(0.0 * reach)[31:60] == UNKNOWN).all()


def test_places_beyond_the_grid_or_beyond_all_numbers_are_no_cells():
    far = np.array([3e38, -20.01, np.nan, np.inf, 19.99], np.float32), np.zeros(5, np.float32)
    state = costmap.occupancy(far, far, np.zeros(DIRECTIONS, np.float32), 0.1, 40.0)
    assert (state != UNKNOWN).sum() == 1
    assert np.nanmin(costmap.scan_ranges(far, far)) == np.float32(19.99)


def test_the_ground_is_known_as_far_as_that_of_the_segment_of_a_direction():
    knots, n_known = np.array([5.0, 10.0, 20.0]), np.array([0, 1, 2, 3])
    std = np.where(np.arange(3) < n_known[:, None], 0.01, 1.0)
    surface = GroundSurface(knots, np.zeros_like(std), std, np.ones(0, dtype=bool))
    quarters = np.repeat([0.0, 5.0, 10.0, 20.0], DIRECTIONS // 4)
    for quarter_turns in range(4):
        heading = np.linalg.matrix_power(np.array([[0.0, -1.0], [1.0, 0.0]]), quarter_turns)
        reach = costmap.reach_of_model(surface, heading, 0.1)
        np.testing.assert_array_equal(reach, np.roll(quarters, -quarter_turns * DIRECTIONS // 4))


@pytest.mark.parametrize(
    ('scene', 'sensor', 'seed'), [('urban', 'os1-128', 7), ('car_park', 'hdl-64e', 7)]
)
def test_nothing_that_stands_is_missing_and_ground_is_no_obstacle(scene, sensor, seed):
    """Of the simulated street, within the grid: objects of 0.3 to 2 m over its exact ground."""
    scan, segmented = street(scene, sensor, seed)
    state = occupancy_of(segmented)
    xyz = segmented.points.astype(np.float64)
    height, r = xyz[:, 2] - scan.ground_z, np.hypot(xyz[:, 0], xyz[:, 1])
    near = (r < 19.8) & (scan.kind != Kind.REFLECTION)
    stands = near & ~scan.is_ground & (height >= 0.3) & (height < 2.0)
    cell = tuple(np.floor(xyz[:, [1, 0]] / 0.1).astype(int).T + 200)

    def cells_of(chosen):
        count = np.zeros(state.shape, int)
        np.add.at(count, tuple(axis[chosen] for axis in cell), 1)
        return count

    n_returns = cells_of(stands)
    missing = (n_returns > 0) & (state != OCCUPIED)
    assert missing.sum() <= 0.002 * np.count_nonzero(n_returns)
    objects, n_objects = ndimage.label(n_returns > 0, np.ones((3, 3)))
    numbers = np.arange(1, n_objects + 1)
    found = ndimage.maximum(state, objects, numbers) == OCCUPIED
    assert n_objects > 10
    assert found[ndimage.sum(n_returns, objects, numbers) >= 3].all()
    # What is ground and nothing else.
    is_free = (cells_of(near & scan.is_ground) > 0) & (cells_of(~scan.is_ground & (r < 20.0)) == 0)
    assert is_free.sum() > 5000
    assert np.count_nonzero(is_free & (state == OCCUPIED)) <= 0.01 * is_free.sum()


def test_heights_choose_and_unknown_heights_stay():
    _, every = street(lowest=-100.0, highest=100.0)
    label, height = every.segmentation.label, every.segmentation.labelled.height
    np.testing.assert_array_equal(every.is_obstacle, label == Label.OBSTACLE)
    np.testing.assert_array_equal(every.is_ground, label == Label.GROUND)
    _, some = street()
    kept = (label == Label.OBSTACLE) & ((height >= 0.2) & (height <= 2.0) | np.isnan(height))
    np.testing.assert_array_equal(some.is_obstacle, kept)
    assert np.isnan(height[some.is_obstacle]).any()


def test_a_map_is_upright_whatever_the_tilt_of_the_cloud():
    """Verticals through the points meet z = 0 of the cloud, unless that is level."""
    _, level = street()
    config, matrix = level.config, rotation(0.2, -0.3)
    xyz = level.points @ matrix.astype(np.float32)
    tilted = segmented_points(xyz, config.replace(**{'sensor.roll': 0.2, 'sensor.pitch': -0.3}))
    x, y = tilted.places(np.ones(len(xyz), bool))
    upright = np.stack([x, y, 0.0 * x], axis=-1) @ matrix.T
    np.testing.assert_allclose(upright[:, :2], level.points[:, :2], atol=1e-3)
    np.testing.assert_allclose(tilted.heading, matrix[:2, :2], atol=1e-12)
    known, found = occupancy_of(level), occupancy_of(tilted)
    for value in (FREE, OCCUPIED):
        assert (found == value).sum() == pytest.approx((known == value).sum(), rel=0.2)
    xyz = level.points @ rotation(1.55, 0.0).astype(np.float32)
    upright = {'sensor.roll': 1.55, 'sensor.pitch': 0.0}
    with pytest.raises(PointCloudError, match='its plane is no map'):
        in_sight(segmented_points(xyz, config.replace(**upright)))


@pytest.mark.parametrize('sensor', ['hdl-64e', 'os1-128', 'vlp-16'])
def test_a_low_wall_is_in_the_way_in_every_direction(sensor):
    # 0.4 m high and 12 m long, across the way: all of it is seen from 0.15 m over the ground on.
    terrain = flat()
    wall = Scene('wall', terrain, (standing_box(terrain, 6.0, 0.0, (0.3, 12.0, 0.4)),))
    scan, segmented = street(wall, sensor, 1, lowest=0.15)
    found = in_sight(segmented)
    # Each direction in the middle of which the wall lies.
    middle = (np.arange(DIRECTIONS) + 0.5) * 2.0 * np.pi / DIRECTIONS - np.pi
    towards = (abs(np.tan(middle)) < 5.8 / 5.85) & (np.cos(middle) > 0.0)
    assert abs(found[towards] * np.cos(middle[towards]) - 5.85).max() < 0.2
    rows = np.flatnonzero((occupancy_of(segmented) == OCCUPIED).any(axis=1))
    is_wall = ~scan.is_ground & (scan.points[:, 2] > scan.ground_z + 0.2)
    cells = np.floor(scan.points[is_wall, 1] / 0.1).astype(int) + 200
    assert set(cells.tolist()) <= set(rows.tolist())
    # None of the ground is.
    assert not (segmented.is_obstacle & scan.is_ground).any()
