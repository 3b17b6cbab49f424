"""Intervals of differences: known answers, ties, and that they are the same each time."""

import itertools

import numpy as np
import pytest

from gp_ground_seg.lab.scoring.evaluate import MethodScore, ScanScore
from gp_ground_seg.lab.scoring.intervals import difference_interval, interval_text, mse_sums
from gp_ground_seg.lab.scoring.metrics import Confusion, height_error


def clusters(*hits, of=100):
    """One scan of `of` ground points for each number of hits, in a sequence of its own."""
    return [
        MethodScore('x', (ScanScore(str(k), '0', 0.0, confusions={'g': Confusion(n, 0, of - n)}),))
        for k, n in enumerate(hits)
    ]


def test_interval_is_that_of_all_draws_weighted_alike():
    """With three clusters all 27 draws can be counted by hand."""
    ours, theirs = (90, 70, 50), (80, 71, 20)
    draws = itertools.product(range(3), repeat=3)
    difference = [sum(ours[k] - theirs[k] for k in draw) / 300 for draw in draws]
    found = difference_interval(clusters(*ours), clusters(*theirs))
    # A draw is of 1 of 27: the ends lie in the lowest and in the highest.
    assert found == pytest.approx((min(difference), max(difference)))
    assert found.is_tie


def test_interval_of_many_clusters_is_that_of_a_mean():
    """Points alike in each cluster: the difference is a mean, and the mean is nearly normal."""
    rng = np.random.default_rng(1)
    gains = rng.integers(0, 21, 200)
    found = difference_interval(clusters(*(50 + gains)), clusters(*[50] * 200))
    mean, half = gains.mean() / 100, 1.96 * gains.std() / 100 / np.sqrt(200)
    assert found == pytest.approx((mean - half, mean + half), abs=0.0005)
    assert not found.is_tie


def test_large_clusters_weigh_more():
    """Pooled, as the IoU is: not a mean of ratios."""
    ours = clusters(*[1000] * 20, of=1000) + clusters(*[0] * 20, of=10)
    theirs = clusters(*[900] * 20, of=1000) + clusters(*[10] * 20, of=10)
    low, high = difference_interval(ours, theirs)
    assert 0.07 < low < 1800 / 20200 < high < 0.1


def test_scans_of_a_sequence_are_drawn_together():
    """Ten equal scans in two sequences are not ten observations."""
    halves = [MethodScore('x', 5 * one.scans) for one in clusters(60, 40)]
    other = [MethodScore('x', 5 * one.scans) for one in clusters(50, 50)]
    assert difference_interval(halves, other) == pytest.approx((-0.1, 0.1))


def test_words():
    ours, theirs = clusters(90, 80, 70), clusters(80, 75, 71)
    assert interval_text(ours, theirs) == '-1.00 to +10.00 tie'
    assert interval_text(ours, clusters(80, 75, 60)) == '+5.00 to +10.00'
    assert interval_text(ours, ours) == '+0.00 to +0.00 tie'
    assert interval_text(ours[:1], theirs[:1]) is None
    empty = [MethodScore('x', (ScanScore('9', '0', 0.0, confusions={'g': Confusion()}),))]
    assert interval_text(ours[:1] + empty, theirs[:1] + empty) is None


def test_it_is_the_same_each_time_and_follows_the_generator_given():
    ours, theirs = clusters(*range(50, 62)), clusters(*range(61, 49, -1))
    assert difference_interval(ours, theirs) == difference_interval(ours, theirs)
    np.random.seed(5)  # noqa: NPY002 - the state that must not matter
    before = difference_interval(ours, theirs)
    np.random.seed(6)  # noqa: NPY002
    assert difference_interval(ours, theirs) == before
    found = [difference_interval(ours, theirs, rng=np.random.default_rng(k)) for k in (1, 2)]
    assert found[0] != found[1] and found[0] == pytest.approx(found[1], abs=0.01)


def test_heights_are_compared_by_their_rmse():
    def score(name, *errors):
        found = height_error(np.zeros(len(errors)), np.array(errors))
        return MethodScore('x', (ScanScore(name, '0', 0.0, height=found),))

    ours, theirs = [score('0', 0.3, 0.3), score('1', 0.1)], [score('0', 0.0, 0.0), score('1', 0.1)]
    # Twice the first: 0.3 - 0; twice the second: no difference.
    assert difference_interval(ours, theirs, mse_sums) == pytest.approx((0.0, 0.3))
    assert interval_text(ours, theirs, mse_sums) == '+0.00 to +30.00 tie'
