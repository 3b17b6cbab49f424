"""Edges of drops: constructed ground, exact rays, several sensors; and what is no edge."""

import dataclasses
import math

import numpy as np
import pytest
from conftest import simulated

from gp_ground_seg import Config, GroundSegmenter, Label
from gp_ground_seg.core.pipeline.points import rotation
from gp_ground_seg.data import costmap, step_edges
from gp_ground_seg.data.costmap import DIRECTIONS, OCCUPIED, SegmentedCloud
from gp_ground_seg.data.step_edges import SECTORS, find_edges
from gp_ground_seg.lab.simulation import SENSORS
from gp_ground_seg.lab.simulation.objects import car, wall
from gp_ground_seg.lab.simulation.scenes import Scene
from gp_ground_seg.lab.simulation.terrain import Sum, polyline, ramp, rough

MAX_STEP_DOWN = 0.2
# With fewer columns: the simulation takes most of the time of these tests.
MOUNTED = {
    name: dataclasses.replace(SENSORS[name], n_columns=900)
    for name in ('hdl-64e', 'vlp-16', 'os1-128')
}
MOUNTED['os1-128 low'] = dataclasses.replace(MOUNTED['os1-128'], height=0.5)
MOUNTED['os1-64'] = dataclasses.replace(
    MOUNTED['os1-128'],
    elevations=tuple(np.radians(np.linspace(22.5, -22.5, 64)).tolist()),
    range_std=0.02,
    height=0.8,
)
MOUNTED['os0-64'] = dataclasses.replace(
    MOUNTED['os1-64'], elevations=tuple(np.radians(np.linspace(45.0, -45.0, 64)).tolist())
)
MOUNTED['os0-64 low'] = dataclasses.replace(MOUNTED['os0-64'], height=0.4, min_range=0.1)
MIDDLE = (np.arange(SECTORS) + 0.5) * (2.0 * np.pi / SECTORS) - np.pi


def drop(at, depth, heading=0.0):
    """Level ground that ends `at` [m] along `heading`, and goes on `depth` [m] lower."""
    return polyline(heading, [(at, 0.0), (at, -depth)])


def descent(at, degrees, fall, heading=0.0):
    slope = math.tan(math.radians(degrees))
    return polyline(heading, [(at, 0.0), (at + fall / slope, -fall)])


def segmented(scene, sensor, seed=0, **values):
    """What is published of a scan of a scene, its name, or terrain."""
    scene = scene if isinstance(scene, Scene | str) else Scene('', scene)
    return published(simulated(scene, sensor, seed).points[:, :3], **values)


def published(xyz, **values):
    """What is published of points."""
    config = Config().replace(**{'output.max_step_down': MAX_STEP_DOWN, **values})
    return SegmentedCloud(None, GroundSegmenter(config).segment(xyz), config, xyz)


def found(cloud, max_step_down=MAX_STEP_DOWN):
    """What `find_edges` finds in a cloud that is in the level frame of its sensor."""
    result, xyz = cloud.segmentation, cloud.points.astype(np.float64)
    stands = (result.label == Label.OBSTACLE) & ~(result.labelled.height < 0.0)
    return find_edges(xyz, result.is_ground, stands, max_step_down, result.pose.sensor_height)


TOWARDS, AWAY, ASIDE = 0.0, math.pi, -1.0  # headings, also about the seam of the sectors


def ridge(at, depth, width, heading=0.0):
    """Ground that ends at a drop on both sides."""
    corners = [(at - width, -depth), (at - width, 0.0), (at, 0.0), (at, -depth)]
    return polyline(heading, corners)


def trench(at, width):
    far = at + width
    return polyline(0.0, [(at, 0.0), (at, -1.2), (far, -1.2), (far, 0.0)])


def uneven(seed, std, scales):
    return rough(np.random.default_rng(seed), std, scales)


# Terrain, its edge along a heading, sensors, the largest step that is none.
DROPS = [
    (drop(6.0, 1.2, 0.4), 6.0, 0.4, ['hdl-64e', 'os1-128'], 0.2),
    (drop(3.15, 0.6, AWAY), 3.15, AWAY, ['vlp-16'], 0.2),
    (drop(7.0, 0.3, ASIDE), 7.0, ASIDE, ['hdl-64e', 'os1-128'], 0.2),
    (drop(1.6, 0.6, 0.4), 1.6, 0.4, ['os1-128 low'], 0.2),
    (drop(5.0, 0.15), 5.0, TOWARDS, ['hdl-64e'], 0.1),
    (drop(2.5, 0.6), 2.5, TOWARDS, ['os1-64'], 0.5),
    (trench(5.0, 3.0), 5.0, TOWARDS, ['hdl-64e', 'os1-128'], 0.2),
    (Sum((drop(6.0, 0.6), uneven(3, 0.03, (0.6, 6.0)))), 6.0, TOWARDS, ['hdl-64e'], 0.2),
    # The limit: a ramp that is steeper than the line of sight over its edge.
    (descent(6.0, 20.0, 1.0), 6.0, TOWARDS, ['hdl-64e'], 0.2),
]


@pytest.mark.parametrize(
    ('terrain', 'at', 'heading', 'name', 'max_step_down'),
    [(*row, name, least) for *row, names, least in DROPS for name in names],
)
def test_drops_are_marked_at_the_last_ring_before_them(terrain, at, heading, name, max_step_down):
    sensor = MOUNTED[name]
    ahead = np.cos(MIDDLE - heading)
    r, distance = found(segmented(terrain, sensor), max_step_down).r, at / np.maximum(ahead, 0.05)
    # Where ground is seen before the edge, and over it more steeply than along a ramp.
    down = np.sort([-elevation for elevation in sensor.elevations if elevation < -1e-3])[::-1]
    rings = sensor.height / np.tan(down)
    over = np.append(np.tan(down), 0.0)[np.searchsorted(rings, 1.02 * distance)]
    towards = (over > step_edges.STEEPEST) & (distance > 1.05 * rings[0])
    assert towards.sum() > 40
    last = np.append(0.0, rings)[np.searchsorted(rings, 0.9 * distance)]
    is_marked = (r <= 1.02 * distance + 0.1) & (r >= 0.85 * last)
    assert is_marked[towards].mean() >= 0.95
    # None is marked on the side where the ground goes on.
    assert np.isinf(r[ahead < 0.0]).all()


@pytest.mark.parametrize(
    ('name', 'at', 'depth', 'width'),
    [
        ('hdl-64e', 5.0, 3.0, 90.0),  # a cliff
        ('vlp-16', 3.2, 1.2, 90.0),
        ('os1-128', 4.5, 2.0, 9.0),  # a dike
        ('os1-64', 3.0, 1.2, 90.0),  # a dock
    ],
)
def test_ground_goes_on_up_to_an_edge_and_below_it(name, at, depth, width):
    """And the edge is marked: it begins at ground that is seen as such."""
    scene = Scene('', ridge(at, depth, width, 0.3))
    cloud = segmented(scene, MOUNTED[name])
    x, y, _ = cloud.points.T
    along = x * math.cos(0.3) + y * math.sin(0.3)
    seen = simulated(scene, MOUNTED[name]).is_ground & (np.hypot(x, y) < 50.0)
    below = seen & (along > at)
    assert below.sum() > 500
    assert cloud.is_ground[below].mean() > 0.97
    assert cloud.is_ground[seen & (along < at) & (along > at - 1.0)].mean() > 0.97
    r, distance = found(cloud).r, at / np.cos(MIDDLE - 0.3)
    towards = (distance > 0.0) & (distance <= 10.0)
    assert (r[towards] <= distance[towards] + 0.2).mean() >= 0.95


LOWER, RAMP = descent(5.5, 4.0, 0.4), descent(2.0, 10.2, 1.4)
# Largest step that is none, and scenes.
NO_EDGES = {
    'long ramps': (
        0.2, [ramp(at, -slope) for at in (2.0, 4.0, 10.0) for slope in (0.09, 0.18, 0.27)]
    ),
    'some long ramps': (0.2, [ramp(2.0, -0.27), ramp(4.0, -0.18), ramp(10.0, -0.09)]),
    'kerbs, level ground, a step up': (0.2, [
        drop(at, depth, 2.0) for at, depth in ((5.0, 0.15), (8.0, 0.15), (5.0, 0.0), (6.0, -0.3))
    ]),
    # From 1.73 m ramps of 15 degrees are seen that begin before 6.5 m, of 10 before 9.8 m.
    'short ramps': (0.2, [
        descent(at, degrees, fall)
        for degrees, at in ((5.0, 8.0), (10.0, 3.0), (10.0, 8.0), (15.0, 3.0), (15.0, 5.0))
        for fall in (0.6, 1.0, 2.0)
    ]),
    'a narrow view of a ramp': (0.2, [descent(at, 10.2, 1.4) for at in (1.0, 1.5)]),
    'rubble': (0.2, [uneven(1, 0.1, (0.6, 5.0)), 'road_then_rubble']),
    'streets': (0.2, ['urban', 'car_park', 'traffic_jam', 'wet_road']),
    'cars before a lower street': (0.2, [
        Scene('', LOWER, (*car(LOWER, 7.0, 0.0, math.pi / 2), *car(LOWER, 7.0, -6.0)))
    ]),
    'a step that is allowed': (0.5, [drop(5.0, 0.45)]),
    'a narrow trench': (0.2, [trench(8.0, 1.5)]),
}  # fmt: skip
OTHERS = [name for name in MOUNTED if name != 'hdl-64e']


@pytest.mark.parametrize(
    ('kind', 'name'),
    [
        *((kind, 'hdl-64e') for kind in NO_EDGES if kind[:6] not in ('a narr', 'some l')),
        *((kind, name) for kind in [*NO_EDGES][1:3] for name in OTHERS),
        *((kind, 'vlp-16') for kind in ('a narrow view of a ramp', 'rubble', 'streets')),
        ('rubble', 'os1-128'),
        ('a step that is allowed', 'os1-64'),
        ('a narrow trench', 'os1-64'),
    ],
)
def test_what_is_no_edge(kind, name):
    max_step_down, scenes = NO_EDGES[kind]
    for scene in scenes:
        xyz = segmented(scene, MOUNTED[name], seed=1)
        assert np.isinf(found(xyz, max_step_down).r).all(), scene


def level_scan(lower=()):
    """Level ground 1.73 m below in 12 rings; in the sectors `lower` 0.5 m lower from 7.5 m on."""
    sector, rings = np.arange(SECTORS), np.geomspace(4.0, 16.0, 24)
    r, azimuth = np.meshgrid(rings, MIDDLE)
    is_low = np.isin(sector, lower)[:, None] & (r > 7.5)
    scale = np.where(is_low, (1.73 + 0.5) / 1.73, 1.0)
    r, z = r * scale, -1.73 * scale
    xyz = np.stack([r * np.cos(azimuth), r * np.sin(azimuth), z], axis=-1).reshape(-1, 3)
    return xyz, np.ones(len(xyz), bool), np.zeros(len(xyz), bool)


@pytest.mark.parametrize(
    ('lower', 'expected'),
    [
        ([], []),
        ([7], []),
        ([7, 9], []),
        (range(100, 104), []),  # 0.51 m wide
        (range(100, 110), range(100, 110)),
        ([100, 101, 102, 105, 106, 107, 108, 109], range(100, 110)),
        ([*range(355, 360), *range(5)], [*range(355, 360), *range(5)]),
        (range(360), range(360)),
    ],
)
def test_neighbours_must_agree(lower, expected):
    edges = find_edges(*level_scan(list(lower)), MAX_STEP_DOWN, 1.73)
    assert set(np.flatnonzero(np.isfinite(edges.r))) == set(expected)
    np.testing.assert_array_equal(np.isfinite(edges.z), np.isfinite(edges.r))
    points = edges.points()
    assert len(points) == step_edges.SAMPLES * len(expected)
    if len(expected):
        r = np.hypot(points[:, 0], points[:, 1])
        last = np.geomspace(4.0, 16.0, 24)
        np.testing.assert_allclose(r, last[last <= 7.5].max())
        np.testing.assert_allclose(points[:, 2], -1.73)
        turn = np.arctan2(points[:, 1], points[:, 0]) / (2.0 * np.pi) + 0.5
        assert set((turn * SECTORS).astype(int)) == set(expected)


@pytest.mark.parametrize(('r', 'slope', 'is_hidden'), [(8.8, 0.2245, True), (12.0, 0.19, False)])
def test_what_stands_in_the_line_of_sight_hides_the_lower_ground(r, slope, is_hidden):
    """Between the last ring before the edge and the first behind it, or behind both."""
    xyz, is_ground, stands = level_scan(lower := range(100, 110))
    objects = [[r * np.cos(a), r * np.sin(a), -slope * r] for a in MIDDLE[lower]]
    masks = np.append(is_ground, np.zeros(10, bool)), np.append(stands, np.ones(10, bool))
    edges = find_edges(np.concatenate([xyz, objects]), *masks, MAX_STEP_DOWN, 1.73)
    assert (np.isinf(edges.r[lower]) == is_hidden).all()


def test_order_and_strange_points_do_not_matter():
    xyz, *masks = level_scan(range(50, 70))
    expected = find_edges(xyz, *masks, MAX_STEP_DOWN, 1.73).r
    order = np.random.default_rng(0).permutation(len(xyz))
    np.testing.assert_array_equal(
        find_edges(xyz[order], *(mask[order] for mask in masks), MAX_STEP_DOWN, 1.73).r, expected
    )
    strange = np.array([[np.nan] * 3, [np.inf, 0, -1], [1, 1, -np.inf], [0, 0, 0], [1e38] * 3])
    for value in (False, True):
        more = (np.append(mask, np.full(5, value)) for mask in masks)
        found = find_edges(np.concatenate([xyz, strange]), *more, MAX_STEP_DOWN, 1.73).r
        np.testing.assert_array_equal(found, expected)
    for n in (0, 1, 2, 3):
        assert np.isinf(find_edges(xyz[:n], *(m[:n] for m in masks), MAX_STEP_DOWN, 1.73).r).all()


def test_scan_ends_at_the_edge_and_occupancy_has_it():
    cloud = segmented(drop(6.0, 0.6), MOUNTED['hdl-64e'])
    returns = cloud.places(np.isfinite(cloud.points).all(axis=1))
    ranges = costmap.scan_ranges(cloud.blocked, returns)
    distance = 6.0 / np.maximum(np.cos(MIDDLE_OF_DIRECTIONS), 1e-6)
    near = distance < 9.0
    assert (ranges[near] <= distance[near] + 0.1).mean() > 0.98
    assert (ranges[near] >= 0.9 * distance[near]).mean() > 0.98
    assert not np.isfinite(ranges[np.cos(MIDDLE_OF_DIRECTIONS) < 0.0]).any()
    # A line of cells without holes: in every row about the x axis one before 6 m.
    reach, ground = np.full(DIRECTIONS, 100.0, np.float32), cloud.places(cloud.is_ground)
    occupied = costmap.occupancy(ground, cloud.blocked, reach, 0.1, 20.0) == OCCUPIED
    rows = occupied[100 - 60 : 100 + 60]
    column = 100 + rows[:, 100:].argmax(axis=1)
    assert rows.any(axis=1).all()
    assert (column >= 100 + 52).all() and (column <= 100 + 60).all()


MIDDLE_OF_DIRECTIONS = (np.arange(DIRECTIONS) + 0.5) * 2.0 * np.pi / DIRECTIONS - np.pi
AHEAD = abs(MIDDLE_OF_DIRECTIONS) < 0.5
LOW = ['os1-64', 'os1-128 low']


def ranges_and_cells(scene, name, **values):
    """``~/scan``, and cells of ``~/occupancy`` 1 m wide ahead, by tenths of metres."""
    heights = {'output.min_height': 0.15, 'sensor.height': MOUNTED[name].height}
    cloud = segmented(scene, MOUNTED[name], **heights, **values)
    ranges = costmap.scan_ranges(cloud.blocked, cloud.places(np.ones(len(cloud.points), bool)))
    reach, ground = np.full(DIRECTIONS, 100.0, np.float32), cloud.places(cloud.is_ground)
    cells = costmap.occupancy(ground, cloud.blocked, reach, 0.1, 40.0)
    return ranges, cells[195:205, 200:]


@pytest.mark.parametrize('name', LOW)
@pytest.mark.parametrize('depth', [0.25, 0.6, 1.2])
def test_a_drop_before_the_first_ring_is_not_free(name, depth):
    """NaN, whatever is behind, and unknown; on the other side all is free as before."""
    ground = drop(0.8, depth)
    scene = Scene('', ground, (*wall(ground, (9.0, -9.0), (9.0, 9.0), 3.0),))
    ranges, cells = ranges_and_cells(scene, name)
    assert np.isnan(ranges[AHEAD]).all()
    assert (cells[:, 10:80] == costmap.UNKNOWN).all()
    assert np.isposinf(ranges[np.cos(MIDDLE_OF_DIRECTIONS) < -0.5]).all()
    ranges, cells = ranges_and_cells(scene, name, **{'output.max_step_down': 2.0})
    assert np.isfinite(ranges[AHEAD]).mean() > 0.95
    assert depth > 0.5 or (cells[:, 40:60] == costmap.FREE).mean() > 0.9


@pytest.mark.parametrize('degrees', [-2.5, 1.5, 2.7])
@pytest.mark.parametrize(('at', 'expected'), [(3.0, 2.5), (0.8, math.nan), (90.0, math.inf)])
def test_pitching_hides_no_drop_and_makes_none(monkeypatch, degrees, at, expected):
    """By less than what a scan is levelled for; also where the first ring is behind the drop."""
    pitched = dataclasses.replace(MOUNTED['os1-64'], pitch=math.radians(degrees))
    monkeypatch.setitem(MOUNTED, 'pitched', pitched)
    ranges, _ = ranges_and_cells(drop(at, 0.25), 'pitched')
    np.testing.assert_allclose(ranges[AHEAD], expected, rtol=0.5)


def test_a_sensor_that_sees_nothing_but_lower_ground_calls_nothing_free():
    """It looks ahead only: nothing it sees is ground or stands, and none of it is a way."""
    sensor = MOUNTED['os1-128 low']
    xyz = simulated(Scene('', drop(0.5, 1.2)), sensor).points[:, :3]
    xyz = xyz[xyz[:, 0] > abs(xyz[:, 1])]
    cloud = published(xyz, **{'sensor.height': sensor.height})
    ranges = costmap.scan_ranges(cloud.blocked, cloud.places(np.ones(len(xyz), bool)))
    assert np.isnan(ranges[AHEAD]).all()


@pytest.mark.parametrize('at', [2.5, 0.8])
def test_stairs_with_a_landing_are_no_ramp(at):
    """Nor where the landing is the first ground that is seen."""
    rises = [(at + 0.29 * k + 1.2 * (k > 4), -0.17 * k) for k in range(11)]
    corners = [(x, z - down) for x, z in rises for down in (0.0, 0.17)]
    ranges, cells = ranges_and_cells(polyline(0.0, corners), 'os1-64')
    assert not np.isposinf(ranges[AHEAD]).any()
    assert not (cells[:, int(10 * at) + 3 :] == costmap.FREE).any()


@pytest.mark.parametrize(('at', 'name'), [(0.75, 'os0-64'), (1.2, 'os0-64'), (0.5, 'os0-64 low')])
def test_stairs_of_which_each_step_is_seen_and_allowed_are_a_drop(at, name):
    corners = [(at + 0.29 * (k // 2), -0.17 * (k - k // 2)) for k in range(16)]
    ranges, cells = ranges_and_cells(polyline(0.0, corners), name)
    assert np.isfinite(ranges[AHEAD]).mean() > 0.9
    assert (cells[:, int(10 * at) + 3 : 20] == costmap.FREE).mean() < 0.05


@pytest.mark.parametrize('name', LOW)
@pytest.mark.parametrize('degrees', [3.0, 6.0, 10.0])
@pytest.mark.parametrize('at', [0.6, 2.0])
def test_a_ramp_that_is_seen_is_free(name, degrees, at):
    ranges, cells = ranges_and_cells(descent(at, degrees, 1.0), name)
    assert np.isposinf(ranges[AHEAD]).mean() > 0.99
    assert (cells[:, 30:50] == costmap.FREE).mean() > 0.9


def test_a_hidden_slope_is_neither_marked_nor_free():
    """The same returns, of a ramp that robots drive, and of a dock."""
    for ground in (descent(3.5, 11.0, 1.2), drop(3.5, 1.2)):
        ranges, cells = ranges_and_cells(ground, 'os1-128 low')
        assert np.isnan(ranges[AHEAD]).all()
        assert (cells[:, 15:30] == costmap.FREE).mean() > 0.9
        assert (cells[:, 40:] == costmap.UNKNOWN).all()


def test_a_drop_that_is_seen_only_on_both_sides_is_marked_ahead(monkeypatch):
    """Where a ramp would be seen: the sensor looks down less steeply than that."""
    monkeypatch.setitem(MOUNTED, 'flat', dataclasses.replace(SENSORS['mid-360'], height=0.5))
    for ground, expected in ((drop(2.0, 1.2), 2.1), (drop(2.0, 0.25), 2.1), (RAMP, math.nan)):
        ranges, cells = ranges_and_cells(ground, 'flat')
        np.testing.assert_allclose(ranges[AHEAD], expected, rtol=0.15)
        assert not (cells[:, 25:60] == costmap.FREE).any()


def test_own_level_behind_a_ditch_is_free():
    ranges, cells = ranges_and_cells(trench(2.5, 1.5), 'os1-64')
    assert (cells[:, 22:27] == OCCUPIED).any(axis=1).all()
    assert not (cells[:, 27:39] == costmap.FREE).any()
    assert (cells[:, 50:80] == costmap.FREE).mean() > 0.2
    assert np.isfinite(ranges[AHEAD]).all()


def test_off_nothing_is_looked_for(monkeypatch):
    off = segmented(drop(6.0, 0.6), MOUNTED['hdl-64e'], **{'output.max_step_down': 0.0})
    monkeypatch.setattr(step_edges, 'find_edges', None)
    assert Config().output.max_step_down == 0.0
    for place, obstacle in zip(off.blocked, off.places(off.is_obstacle), strict=True):
        np.testing.assert_array_equal(place, obstacle)


def test_edges_lie_where_the_ground_ends_in_any_frame():
    """A level sensor, a tilted one, and a cloud in the frame of the vehicle."""
    terrain, sensor, turn = drop(6.0, 0.6, 0.3), MOUNTED['hdl-64e'], rotation(0.15, -0.2)
    level = segmented(terrain, sensor)
    tilt = {'sensor.roll': 0.15, 'sensor.pitch': -0.2}
    given = {f'sensor.{name}': value for name, value in
             (('height', 0.0), ('origin_x', 1.0), ('origin_z', sensor.height))}  # fmt: skip
    mounted = dataclasses.replace(sensor, origin=(1.0, 0.0, sensor.height))
    vehicle = segmented(terrain, mounted, **given)
    clouds = [
        (level, np.eye(3), 0.0),
        (published(level.points @ turn.astype(np.float32), **tilt), turn, 0.0),
        (vehicle, np.eye(3), math.cos(0.3)),
    ]
    for cloud, matrix, forward in clouds:
        x, y, *_ = cloud.blocked
        x, y = (np.stack([x, y, 0.0 * x], axis=-1) @ matrix.T)[:, :2].T
        along = (x * math.cos(0.3) + y * math.sin(0.3))[np.count_nonzero(cloud.is_obstacle) :]
        assert np.median(along) == pytest.approx(5.85 + forward, abs=0.15)
        assert 800 < len(along) == pytest.approx(len(level._found.points()), rel=0.05)
