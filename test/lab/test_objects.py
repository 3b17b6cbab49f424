"""Objects lost, low things and false cells: hand-made frames, the command."""

import itertools
import json
import math
import re

import numpy as np
import pytest
from cli_runner import run
from evaluation_samples import street, write_frame

from gp_ground_seg import GroundSegmenter, Label
from gp_ground_seg.lab.scoring.objects import (
    CLASSES,
    LOW_CLASSES,
    OBJECT_COUNTS,
    Objects,
    count_false_cells,
    count_objects,
    cut_objects,
    labelled_objects,
    local_ground,
)

LOW = [*CLASSES].index(LOW_CLASSES[0])
# Class, number, height over the ground, so many returns, and those of them called ground.
RETURNS = [
    (0, 1, 0.3, 10, 6), (0, 2, 0.31, 12, 6), (0, 3, 1.0, 9, 9), (0, 0, 1.0, 20, 20),
    (0, 1, 0.29, 30, 30), (1, 1, math.nan, 30, 30), (LOW, 1, 0.1, 3, 2), (LOW, 2, 0.2, 2, 2),
    (-1, 0, 1.0, 50, 50),
]  # fmt: skip
COUNTED = [('vehicle', 10 + 12 + 9 + 20, 6 + 6 + 9 + 20, 2, 1), (LOW_CLASSES[0], 3 + 2, 4, 1, 1)]


def test_counts_by_hand():
    """What is low, without a number, of few returns, or half obstacle is no object lost."""
    kind, number, height, n, _ = np.array(RETURNS).T
    rows = np.repeat(np.arange(len(RETURNS)), n.astype(int))
    rows = np.append(rows, [0, 0])  # of no place
    label = np.concatenate([np.arange(n) >= n_ground for *_, n, n_ground in RETURNS] + [[0, 0]])
    points = np.column_stack([rows, rows, height[rows]]).astype(float)
    points[-2:, 0] = math.inf
    objects = Objects(kind[rows].astype(int), number[rows].astype(int), np.zeros(len(rows)))
    found = count_objects(points, np.where(label, Label.UNKNOWN, Label.GROUND), objects)
    assert found == [dict(zip(('class', *OBJECT_COUNTS), row, strict=True)) for row in COUNTED]


# The local ground.


def lattice(low, high, step=0.25):
    ticks = np.arange(low, high, step) + 0.1
    return np.array([*itertools.product(ticks, ticks)])


def test_the_local_ground_follows_a_slope_and_holes_up_to_five_metres():
    xy = lattice(-15.0, 15.0)
    xy = xy[np.hypot(*xy.T) > 3.0]
    ground = np.column_stack([xy, 0.1 * xy[:, 0] - 2.0])
    asked = np.array([[0.0, 0.0, 5.0], [-8.0, 3.0, 7.0], [18.0, 0.0, 0.0], [20.5, 0.0, 0.0]])
    points = np.concatenate([ground, asked])
    is_asked = np.arange(len(points)) >= len(ground)
    height = local_ground(points, ~is_asked, is_asked)
    assert np.isnan(height[~is_asked]).all()
    at_hole, on_slope, beside, far = height[is_asked]
    assert on_slope == pytest.approx(-2.8, abs=0.05)
    assert at_hole == pytest.approx(-2.0, abs=0.35)
    assert beside == pytest.approx(-0.5, abs=0.1) and math.isnan(far)


def test_the_local_ground_is_a_median_of_medians():
    """A cell with a thousand returns weighs as much as one with three; outliers do nothing."""
    xy = lattice(0.0, 3.0)
    ground = np.column_stack([xy, np.zeros(len(xy))])
    ground[::7, 2] = -9.0
    dense = np.full((1000, 3), (1.6, 1.6, 0.8))
    points = np.concatenate([ground, dense, [[1.7, 1.7, 2.0], [math.nan, 0.0, math.inf]]])
    is_ground = np.arange(len(points)) < len(points) - 2
    is_ground[-1] = True
    height = local_ground(points, is_ground, ~is_ground | np.isnan(points[:, 0]))
    assert height[-2] == 0.0 and math.isnan(height[-1])


def test_without_enough_ground_it_is_not_known():
    cells = np.array([[x, 0.25, 0.0] for x in (0.25, 1.25, 2.25, 3.25, 9.25, 4.6, 4.1)])
    asked = np.arange(7) >= 5  # 4.65 and 5.15 m from the farthest of five cells
    assert local_ground(cells, ~asked, asked)[5:].tolist() == pytest.approx(
        [0, np.nan], nan_ok=True
    )
    points = np.zeros((10, 3))
    nothing, everything = np.zeros(10, dtype=bool), np.ones(10, dtype=bool)
    for is_ground in (nothing, everything):  # ten returns of one cell
        assert np.isnan(local_ground(points, is_ground, everything)).all()
    assert len(local_ground(points[:0], nothing[:0], nothing[:0])) == 0


# Objects of labels.


def test_objects_of_labels_are_instances_by_group():
    known = {10: 0, 252: 0, 13: 0, 18: 0, 258: 0, 16: 0, 20: 0, 259: 0, 30: 1, 254: 1, 11: 2,
             31: 2, 32: 2, 15: 2, 253: 2, 255: 2, 40: -1, 50: -1, 0: -1, 77: -1}  # fmt: skip
    entries = np.array([number | 5 << 16 for number in known] + [10, 30], dtype=np.uint32)
    points, nothing = np.zeros((len(entries), 3)), np.zeros(len(entries), dtype=bool)
    found = labelled_objects(points, entries, nothing)
    assert [*CLASSES] == ['vehicle', 'person', 'cyclist', 'vegetation', *LOW_CLASSES]
    assert found.class_of.tolist() == [*known.values(), 0, 1]
    assert found.object_id[-2:].tolist() == [0, 0]
    assert len(set(found.object_id[:-2].tolist())) == len(known)
    assert np.isnan(found.ground_z).all()


# Low things and false cells.


def test_objects_are_cut_and_what_counts_is_low_and_near():
    """Ground that falls by 0.1 to each side of x = 0, at places 0.05 m from the objects asked."""
    shifts = np.array([[0.0, 0.0], [0.05, 0.0], [-0.05, 0.0], [0.0, 0.05], [0.0, -0.05]])
    heights = np.array([0.0, 0.0, 0.0, 0.0, -5.0])  # of the five nearest the median
    over = (0.1, 0.2, 0.44, 0.46, 2.0)
    parts, expected = [], []
    for x, is_object in ((10.0, True), (10.0, False), (24.9, True), (25.1, True)):
        place, z = (x, 0.0), -1.73 - 0.1 * x
        parts.append((np.column_stack([place + shifts, z + heights]), False, True))
        parts.append((np.array([[*place, z + h] for h in over]), is_object, False))
        expected += [(True, False)] * 5
        expected += [(not is_object or h < 0.45, is_object and 0.15 < h < 0.45 and x < 25.0)
                     for h in over]  # fmt: skip
    parts.append((np.full((1, 3), math.nan), True, False))
    points = np.concatenate([p for p, _, _ in parts]).astype(np.float32)
    is_object, is_ground = (
        np.concatenate([np.full(len(part[0]), part[k]) for part in parts]) for k in (1, 2)
    )
    cut = cut_objects(points, is_object, is_ground, 0.45)
    assert list(zip(cut.is_kept, cut.is_low, strict=True)) == [*expected, (True, False)]
    # Labels are of what is left: ground is what lies 0.2 m over it, and so two of four are.
    left = points[cut.is_kept]
    label = np.where(left[:, 2] - (-1.73 - 0.1 * left[:, 0]) < 0.3, Label.GROUND, Label.OBSTACLE)
    assert cut.count_ground(label.astype(np.uint8)) == {'low_things_n': 4, 'low_things_wrong': 2}
    few = cut_objects(points[5:10], is_object[5:10], ~is_object[5:10], 0.45)
    assert few.is_kept.all() and not few.is_low.any()


def test_false_cells_by_hand():
    road, parking, walk, terrain, car = 40, 44, 48, 72, 10
    rows = [
        # x, y, class, label, height: two returns of road in one cell, one of them wrong
        (1.01, 1.01, road, Label.GROUND, 0.0),
        (1.09, 1.09, road, Label.OBSTACLE, 0.16),
        (1.05, 1.05, road, Label.OBSTACLE, 0.3),
        (-0.05, 0.05, parking, Label.OBSTACLE, 0.14),  # a costmap clears what is that low
        (0.05, 0.05, parking, Label.UNKNOWN, 0.5),
        (5.05, 0.05, walk, Label.OBSTACLE, 0.16),
        (6.05, 0.05, walk, Label.OBSTACLE, math.nan),
        (1.01, 1.01, car, Label.OBSTACLE, 0.5),
        (7.05, 0.05, terrain, Label.OBSTACLE, 0.5),
        (0.05, 19.95, road, Label.OBSTACLE, 0.15),
        (0.05, 20.05, road, Label.OBSTACLE, 0.5),
        (math.nan, 0.0, road, Label.OBSTACLE, 0.5),
    ]
    x, y, semantic, label, height = np.array(rows, dtype=float).T
    points = np.column_stack([x, y, 0 * x])
    counts = count_false_cells(points, label.astype(np.uint8), height, semantic.astype(int))
    assert counts == {
        'road_cells_n': 4, 'road_cells_wrong': 2, 'ground_cells_n': 6, 'ground_cells_wrong': 3,
    }  # fmt: skip


# The command.

CARS = ((8.0, -4.0), (12.0, 3.0))


def street_with_cars(seed):
    """The street of the samples, with two cars of 300 returns: points, entries."""
    points, semantic = street(seed)
    rng = np.random.default_rng(seed)
    parts, entries = [points], [semantic]
    for k, (x, y) in enumerate(CARS, 1):
        low, high = (x - 2.0, y - 0.9, -1.6), (x + 2.0, y + 0.9, -0.2)
        parts.append(np.column_stack([rng.uniform(low, high, (300, 3)), np.ones(300)]))
        entries.append(np.full(300, 10 | k << 16, dtype='<u4'))
    return np.concatenate(parts).astype('<f4'), np.concatenate(entries)


def test_tables_of_objects_low_things_and_false_cells_are_those_of_the_labels(tmp_path, capsys):
    """Both cars whole, and cut at 1 m; segmented by the library."""
    points, entries = street_with_cars(0)
    write_frame(tmp_path / 'kitti', '00', 0, points, entries)

    def evaluated(*words):
        target = tmp_path / 'a.json'
        assert run('evaluate', tmp_path / 'kitti', '--json', target, '--force', *words) == 0
        return json.loads(target.read_text())

    document = evaluated('--peer', 'patchworkpp', '--cut', 1)
    assert re.search(r'^ *vehicle +\d.* 2 +0 +\d', capsys.readouterr().out, re.MULTILINE)
    is_ground, segment = entries == 40, GroundSegmenter().segment
    result = segment(points)
    rows = count_objects(points, result.label, labelled_objects(points, entries, is_ground))
    row, own = document['objects'][0], rows[0]
    assert [one['class'] for one in rows] == ['vehicle', 'vegetation']
    names = 'class', 'n_returns', 'n_objects', 'n_lost'
    assert [row[name] for name in names] == [own[name] for name in names]
    assert row['share_ground'] == own['n_ground'] / own['n_returns']
    assert (row['n_objects'], row['n_lost']) == (2, 0) and row['peer_share_ground'] is not None

    cut = cut_objects(points, entries & 0xFFFF == 10, is_ground, 1.0)
    assert 50 < (~cut.is_kept).sum() < 500 and cut.is_low.sum() > 50
    sums = cut.count_ground(segment(points[cut.is_kept]).label)
    sums |= count_false_cells(points, result.label, result.height, entries & 0xFFFF)
    pooled = document['low_things'][-1]
    assert document['cut'] == 1.0
    for name in ('low_things', 'road_cells', 'ground_cells'):
        n, n_wrong = sums[f'{name}_n'], sums[f'{name}_wrong']
        assert (pooled[f'{name}_n'], pooled[name]) == (n, n_wrong / n)
    # The peer has no heights over a surface.
    assert pooled['peer_road_cells'] is None and pooled['peer_low_things'] is not None
    assert 'low_things_n' not in evaluated('--cut', 0)['low_things'][0]
