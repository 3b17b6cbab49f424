"""Conventions, counts, ratios, rings, classes and height errors, against loops and by hand."""

import itertools
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from gp_ground_seg import Label
from gp_ground_seg.evaluation.metrics import (
    CONVENTIONS,
    GROUNDGRID,
    LOW_VEGETATION_Z,
    PATCHWORK,
    RATIOS,
    RING_EDGES,
    RING_TITLES,
    ClassCount,
    Confusion,
    SemanticClass,
    class_errors,
    class_name,
    count_classes,
    count_confusion,
    count_rings,
    height_error,
    pool_height_errors,
)

GROUND_NUMBERS = {40, 44, 48, 49, 60, 72}
ANY_LABEL = st.sampled_from([0, 1, 2])
ANY_LABELS = hnp.arrays(np.uint8, st.integers(0, 60), elements=ANY_LABEL)


@pytest.mark.parametrize('convention', CONVENTIONS, ids=lambda c: c.key)
def test_ground_classes_are_ground_and_unlabelled_is_left_out(convention):
    for number in SemanticClass:
        if number == SemanticClass.VEGETATION:
            continue
        expected = Label.GROUND if number in GROUND_NUMBERS else Label.OBSTACLE
        for z in (-5.0, -1.3, 0.0, 3.0):
            (truth,) = convention.truth(np.array([number]), np.array([z]))
            assert truth == (Label.UNKNOWN if number in (0, 1) else expected)


def test_vegetation_by_convention_and_unknown_numbers():
    z = np.array([np.nextafter(LOW_VEGETATION_Z, -9), LOW_VEGETATION_Z, -1.29, np.nan])
    semantic = np.full(4, 70)
    assert pytest.approx(-1.2975) == LOW_VEGETATION_Z
    assert GROUNDGRID.truth(semantic, z).tolist() == [Label.UNKNOWN] * 4
    assert PATCHWORK.truth(semantic, z).tolist() == [Label.GROUND] + [Label.OBSTACLE] * 3
    assert GROUNDGRID.truth(np.array([77, 65535]), np.zeros(2)).tolist() == [Label.OBSTACLE] * 2
    assert [class_name(n) for n in (49, 259, 77)] == [
        'other ground', 'moving other vehicle', 'class 77',
    ]  # fmt: skip


def test_ratios_by_hand():
    confusion = Confusion(tp=6, fp=2, fn=4, tn=8)
    assert (confusion.precision, confusion.recall, confusion.iou) == (6 / 8, 6 / 10, 6 / 12)
    assert confusion.f1 == pytest.approx(2 * 0.75 * 0.6 / 1.35)
    assert confusion.accuracy == 14 / 20
    assert all(math.isnan(getattr(Confusion(), name)) for name in RATIOS)
    only_obstacles = Confusion(tn=5)
    assert math.isnan(only_obstacles.iou)
    assert only_obstacles.accuracy == 1.0


@given(ANY_LABELS, st.data())
def test_counts_against_a_loop(label, data):
    truth = data.draw(hnp.arrays(np.uint8, len(label), elements=ANY_LABEL))
    counts = dict.fromkeys(itertools.product((True, False), repeat=2), 0)
    for given_label, true_label in zip(label, truth, strict=True):
        if true_label != Label.UNKNOWN:  # an unknown label is scored as an obstacle
            counts[given_label == Label.GROUND, true_label == Label.GROUND] += 1
    pairs = ((True, True), (True, False), (False, True), (False, False))
    assert count_confusion(label, truth) == Confusion(*(counts[pair] for pair in pairs))


@given(ANY_LABELS, st.data())
def test_class_counts_against_a_loop(label, data):
    numbers = st.sampled_from([0, 40, 70, 259, 65535])
    semantic = data.draw(hnp.arrays(np.uint16, len(label), elements=numbers))
    counts = count_classes(label, semantic)
    assert list(counts) == sorted(set(semantic.tolist()))
    for number, count in counts.items():
        of_it = label[semantic == number]
        assert count == ClassCount(len(of_it), int((of_it == Label.GROUND).sum()))


def test_class_errors_by_hand():
    counts = {40: ClassCount(10, 7), 50: ClassCount(9, 4), 70: ClassCount(8, 8)}
    found = [(one.number, one.missed, one.false, one.errors) for one in class_errors(counts)]
    assert found == [(50, 0, 4, 4), (40, 3, 0, 3), (70, 0, 0, 0)]


POINTS = hnp.arrays(
    np.float32, st.tuples(st.integers(0, 40), st.just(2)), elements=st.floats(-60, 60, width=32)
)


@given(POINTS, st.data())
def test_rings_against_a_loop(xy, data):
    label, truth = (data.draw(hnp.arrays(np.uint8, len(xy), elements=ANY_LABEL)) for _ in 'ab')
    rings = count_rings(label, truth, xy)
    assert len(rings) == len(RING_TITLES) == len(RING_EDGES) - 1
    for k, ring in enumerate(rings):
        reach = [math.hypot(*map(float, p)) for p in xy]
        inside = np.array([RING_EDGES[k] <= r < RING_EDGES[k + 1] for r in reach], bool)
        assert ring == count_confusion(label[inside], truth[inside])
    assert sum(rings, Confusion()) == count_confusion(label, truth)


def test_rings_hold_their_inner_edge_and_no_point_without_a_range():
    xy = np.array([[0, 0], [10, 0], [0, -50], [3e3, 0], [np.nan, 1], [np.inf, 0]], np.float32)
    ones = np.ones(6, dtype=np.uint8)
    assert [ring.tp for ring in count_rings(ones, ones, xy)] == [1, 1, 0, 0, 0, 2]
    assert (RING_TITLES[0], RING_TITLES[-1]) == ('0-10 m', '> 50 m')


def test_height_error_by_hand():
    error = height_error(np.array([0.0, 1.0, 2.0, 5.0]), np.array([0.5, 1.0, 1.0, np.nan]))
    assert (error.n_points, error.n_without_model) == (3, 1)
    assert error.rmse == pytest.approx(math.sqrt(1.25 / 3))
    assert error.bias == pytest.approx(-0.5 / 3)
    assert error.median_absolute == 0.5
    assert error.smse == pytest.approx((1.25 / 3) / (2 / 3))


@pytest.mark.parametrize(
    'error',
    [
        height_error(np.empty(0), np.empty(0)),
        height_error(np.ones(2), np.full(2, np.nan)),
        pool_height_errors([]),
    ],
)
def test_height_error_of_nothing(error):
    assert error.n_points == 0
    values = (error.rmse, error.bias, error.smse, error.median_absolute)
    assert all(math.isnan(value) for value in values)


HEIGHTS = hnp.arrays(
    np.float64, st.tuples(st.integers(1, 30), st.just(2)), elements=st.floats(-50.0, 50.0)
)


@given(HEIGHTS, HEIGHTS)
def test_pooled_height_errors_are_those_of_all_points(first, second):
    frames = [first, second]
    pooled = pool_height_errors([height_error(*frame.T) for frame in frames])
    both = np.concatenate(frames)
    difference = both[:, 1] - both[:, 0]
    assert pooled.n_points == len(both)
    assert pooled.rmse == pytest.approx(np.sqrt(np.mean(difference**2)), abs=1e-9)
    assert pooled.bias == pytest.approx(difference.mean(), abs=1e-9)
    spread = sum(((frame[:, 0] - frame[:, 0].mean()) ** 2).sum() for frame in frames)
    if spread > 1e-6:
        assert pooled.smse == pytest.approx((difference**2).sum() / spread, rel=1e-6)
