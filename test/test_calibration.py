"""Reliability of probabilities: against slow references, scikit-learn's among them."""

import math

import numpy as np
import pytest
from evaluation_samples import HeightRule, write_streets
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from sklearn.calibration import calibration_curve
from sklearn.metrics import brier_score_loss

from gp_ground_seg import Label
from gp_ground_seg.errors import PointCloudError
from gp_ground_seg.evaluation.calibration import BIN_EDGES, N_BINS, THRESHOLDS, count_calibration
from gp_ground_seg.evaluation.evaluate import labelled_frames, load_kitti, score_methods
from gp_ground_seg.evaluation.evaluate import MethodResult
from gp_ground_seg.evaluation.metrics import count_confusion

PROBABILITY = st.one_of(
    st.floats(0.0, 1.0, width=32), st.sampled_from([0.0, 1.0, 0.5, 0.001, 0.999, math.nan])
)
TRUTHS = st.sampled_from([Label.UNKNOWN, Label.GROUND, Label.OBSTACLE])


def draw(data, n):
    p = data.draw(hnp.arrays(np.float32, n, elements=PROBABILITY))
    return p, data.draw(hnp.arrays(np.uint8, n, elements=TRUTHS))


def slow(p, truth):
    """ECE, Brier, and IoU by threshold, point by point."""
    bins = {k: [] for k in range(N_BINS)}
    squares = []
    for one, true_label in zip(p.astype(float), truth, strict=True):
        if true_label == Label.UNKNOWN or math.isnan(one):
            continue
        k = max(k for k in range(N_BINS) if BIN_EDGES[k] <= one)
        bins[k].append((one, true_label == Label.GROUND))
        squares.append((one - (true_label == Label.GROUND)) ** 2)
    n = len(squares)
    gaps = [abs(sum(y for _, y in b) - sum(q for q, _ in b)) for b in bins.values()]
    ious = [
        count_confusion(
            np.where(p.astype(float) >= t, Label.GROUND, Label.OBSTACLE).astype(np.uint8), truth
        ).iou
        for t in THRESHOLDS[::50]
    ]
    return (sum(gaps) / n, sum(squares) / n, ious) if n else (math.nan, math.nan, ious)


@given(st.integers(0, 60), st.data())
def test_against_a_loop(n, data):
    p, truth = draw(data, n)
    found = count_calibration(p, truth)
    ece, brier, ious = slow(p, truth)
    assert found.ece == pytest.approx(ece, nan_ok=True, abs=1e-12)
    assert found.brier == pytest.approx(brier, nan_ok=True, abs=1e-12)
    steps = range(0, len(THRESHOLDS), 50)
    assert [found.confusion_at(k).iou for k in steps] == pytest.approx(ious, nan_ok=True)
    scored = truth != Label.UNKNOWN
    assert found.n_total + found.ground_without + found.obstacles_without == scored.sum()


@given(st.integers(0, 40), st.integers(0, 40), st.data())
def test_those_of_frames_add_up(n, m, data):
    (p, truth), (q, other) = draw(data, n), draw(data, m)
    both = count_calibration(np.concatenate([p, q]), np.concatenate([truth, other]))
    total = count_calibration(p, truth) + count_calibration(q, other)
    assert total.n_points.tolist() == both.n_points.tolist()
    assert (total.ece, total.brier) == pytest.approx((both.ece, both.brier), nan_ok=True)
    assert total.best_step == both.best_step
    assert total.confusion_at(500) == both.confusion_at(500)


def synthetic(n=20_000, seed=0, power=1.0):
    """Probabilities p; the truth is ground with probability p ** power."""
    rng = np.random.default_rng(seed)
    p = rng.beta(0.3, 0.3, n).astype(np.float32)
    ground = rng.random(n) < p.astype(float) ** power
    return p, np.where(ground, Label.GROUND, Label.OBSTACLE).astype(np.uint8)


@pytest.mark.parametrize('power', [1.0, 3.0])
def test_against_scikit_learn(power):
    p, truth = synthetic(power=power)
    found = count_calibration(p, truth)
    ground = truth == Label.GROUND
    assert found.brier == pytest.approx(brier_score_loss(ground, p.astype(float)), rel=1e-12)
    share, mean = calibration_curve(ground, p.astype(float), n_bins=N_BINS)
    np.testing.assert_allclose(found.mean_p, mean, rtol=1e-9)
    np.testing.assert_allclose(found.share_ground, share, rtol=1e-9)


def test_true_probabilities_have_no_calibration_error_and_wrong_ones_do():
    assert count_calibration(*synthetic()).ece < 0.01
    # E[p - p^3] of Beta(a, a): 1/2 - a (a+1) (a+2) / (2a (2a+1) (2a+2)).
    assert count_calibration(*synthetic(power=3.0)).ece == pytest.approx(0.1406, abs=0.01)


def test_best_threshold_by_hand():
    p = np.array([0.95, 0.9, 0.4, 0.3, 0.2, np.nan], dtype=np.float32)
    truth = np.array([1, 1, 2, 1, 2, 1], dtype=np.uint8)
    found = count_calibration(p, truth)
    # From 0.3 on: three hits, one false, one without a probability missed.
    assert found.confusion_at(found.best_step).iou == 3 / 5
    # float32(0.2) is a little more than 0.2: the threshold has to be above it.
    assert THRESHOLDS[found.best_step] == 0.201
    assert (found.ground_without, found.obstacles_without) == (1, 0)
    certain = count_calibration(np.array([1.0, 0.0]), np.array([1, 2], dtype=np.uint8))
    assert (certain.ece, certain.brier) == (0.0, 0.0)
    assert THRESHOLDS[certain.best_step] == 0.001
    assert certain.confusion_at(len(THRESHOLDS) - 1).iou == 1.0


@pytest.mark.parametrize('p', [[0.5, 1.01], [-0.01, 0.5], [0.5, np.inf], [0.5]])
def test_what_is_no_probability_is_refused(p):
    with pytest.raises(PointCloudError, match='p_ground'):
        count_calibration(np.array(p), np.array([1, 2], dtype=np.uint8))


class GuessedProbabilities(HeightRule):
    """A height rule that also gives a probability, by height."""

    def result(self):
        p = np.clip(-0.5 - self.points[:, 2], 0.0, 1.0).astype(np.float32)
        return MethodResult(super().result().label, p)


def test_sequences_are_pooled_by_their_points(tmp_path):
    write_streets(tmp_path, s00=2, s08=1)
    methods = [GuessedProbabilities('p', -1.5), HeightRule('none', -1.5)]
    score, none = score_methods(labelled_frames(tmp_path), load_kitti, methods)
    parts, pooled = [score.of(s).calibration for s in ('00', '08')], score.calibration
    n_scored = sum(ring.points for ring in score.rings)
    assert pooled.n_total == sum(part.n_total for part in parts) == n_scored
    assert pooled.brier == pytest.approx(
        sum(part.brier * part.n_total for part in parts) / n_scored
    )
    assert score.ece == pooled.ece
    assert none.calibration is None
