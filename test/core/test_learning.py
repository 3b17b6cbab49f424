"""Learning recovers what frames were drawn from, within budget and bounds."""

from unittest.mock import patch

import numpy as np
import pytest
import reference_gp
from conftest import fewer, hilly_scan

from gp_ground_seg import Config, GroundSegmenter
from gp_ground_seg.core.backend import NumpyBackend
from gp_ground_seg.core.compiled.backend import NumbaBackend
from gp_ground_seg.core.frame import Inliers
from gp_ground_seg.core.gp import learning
from gp_ground_seg.core.gp.learning import Learned, ThetaSpace, given_theta, theta_space
from gp_ground_seg.core.gp.likelihood import log_likelihood
from gp_ground_seg.core.jit import JIT_ENABLED
from gp_ground_seg.core.parameters.config import PRESETS, ObservationConfig
from gp_ground_seg.core.parameters.schema import numbers_of
from gp_ground_seg.core.pipeline.lines import class_middles

LEVEL = numbers_of(ObservationConfig(slope_std=0.0, slope_drift=0.0))
MODEL = NumbaBackend() if JIT_ENABLED else NumpyBackend()


def draw_inliers(seed, n_segments=120, n=50, sigma_f=0.3, sigma_n=0.05):
    """Inliers drawn from the model: smooth road to 25 m, rubble beyond; and the true theta."""
    rng = np.random.default_rng(seed)
    truth = np.log([sigma_f, sigma_n, 0.9, 3.0, 0.25, 1.0])
    r_bar = np.arange(4.0, 50.0, 3.0)
    log_extent = np.log(np.where(r_bar > 25.0, 1.5, 10.0))
    r, z = [], []
    for _ in range(n_segments):
        own = np.sort(rng.uniform(3, 50, n))
        length = np.exp(profile(truth, r_bar, log_extent, own))
        a = reference_gp.paciorek(own, length, own, length, sigma_f) + sigma_n**2 * np.eye(n)
        r.append(own)
        z.append(np.linalg.cholesky(a) @ rng.standard_normal(n))
    number = np.arange(n_segments + 1)
    bars = number * len(r_bar), np.tile(r_bar, n_segments), np.tile(log_extent, n_segments)
    kind = np.zeros(len(bars[1]), np.int64)
    inliers = Inliers(
        number * n, np.concatenate(r), np.concatenate(z), np.zeros(n_segments * n), *bars, kind
    )
    return inliers, truth


def profile(theta, r_bar, log_extent, r):
    return reference_gp.log_length_scale(r_bar, theta[5] + log_extent, r, *np.exp(theta[2:5]))


def space_about(centre, free=None, factor=20.0):
    width = np.log(factor)
    free = np.ones(len(centre), dtype=bool) if free is None else free
    return ThetaSpace(centre, centre - width, centre + width, free, 1.0)


def learn(inliers, space, start, use_priors=True, max_evaluations=200):
    """Outcome, and the values of the objective without priors."""
    values, theta, outcome = [], start.copy(), np.empty(2)

    def find(*arguments):
        found = log_likelihood(*arguments)
        values.append(found[0])
        return found

    with patch.object(learning, 'log_likelihood', find):
        n = learning.maximise(space, inliers, LEVEL, use_priors, max_evaluations, theta, outcome)
    assert n == len(values)
    return Learned.of(theta, float(outcome[0]), n, int(outcome[1]), space), values


def test_noise_and_length_scales_of_a_drawn_frame_are_recovered():
    inliers, truth = draw_inliers(seed=1, n_segments=60)
    # Far off: half the amplitude, twice the noise, short length-scales.
    start = truth + np.log([0.5, 2.0, 1.3, 0.7, 1.5, 0.4])
    theta = learn(inliers, space_about(start), start)[0].theta
    assert np.exp(theta[1]) == pytest.approx(0.05, rel=0.1)
    assert np.exp(theta[0]) == pytest.approx(0.3, rel=0.15)
    first = slice(0, inliers.bar_offsets[1])
    at = inliers.r_bar[first], inliers.log_extent[first], np.linspace(4, 48, 100)
    assert np.corrcoef(profile(theta, *at), profile(truth, *at))[0, 1] >= 0.9


def gradient_per_datum(inliers, space, theta):
    _, gradient = log_likelihood(theta, inliers, LEVEL, False)
    return np.abs(gradient - (theta - space.centre)) / len(inliers.r)


@pytest.mark.parametrize('noise_is_possible', [True, False])
def test_the_end_is_level_or_at_a_bound_and_said_to_be(noise_is_possible):
    inliers, truth = draw_inliers(3, n_segments=30)
    # Without the true noise in the box.
    centre = truth + np.log([1, 1 if noise_is_possible else 3, 1, 1, 1, 1])
    space, start = space_about(centre, factor=1.5), truth + 0.3
    learned, _ = learn(inliers, space, start)
    level = gradient_per_datum(inliers, space, learned.theta) < 1e-3
    assert gradient_per_datum(inliers, space, start).max() > 0.1
    assert list(learned.at_bound) == [False, not noise_is_possible, *4 * [False]]
    assert (level != learned.at_bound).all()
    assert noise_is_possible or learned.theta[1] == space.lower[1]
    assert learned.status == 'converged' or not noise_is_possible
    assert (np.abs(learned.theta - space.centre) <= space.upper - space.centre + 1e-12).all()
    # Fixed entries stay.
    free = np.array([True, True, False, False, False, True])
    theta = learn(inliers, space_about(start, free), start)[0].theta
    np.testing.assert_array_equal(theta[~free], start[~free])
    assert (theta[free] != start[free]).all()
    nothing, _ = learn(inliers, space_about(start, np.zeros(6, dtype=bool)), start)
    assert (nothing.status, nothing.n_evaluations) == ('converged', 0)
    np.testing.assert_array_equal(nothing.theta, start)


def test_priors_hold_theta_as_tight_as_they_are():
    inliers, truth = draw_inliers(7, n_segments=2)
    start = truth + 0.5
    wide = space_about(start)
    held, moved = (
        np.abs(learn(inliers, space, start)[0].theta - start)
        for space in (wide._replace(prior_std=0.01), wide)
    )
    assert held.max() < 0.05 < 0.2 < moved.max()


@pytest.mark.parametrize('budget', [1, 3, 6])
def test_budget_is_kept_and_the_best_so_far_is_used(budget):
    inliers, truth = draw_inliers(5, n_segments=20)
    start = truth + np.log(3.0)
    learned, values = learn(inliers, space_about(start), start, False, budget)
    assert (len(values), learned.status, learned.objective) == (budget, 'budget', max(values))
    assert log_likelihood(learned.theta, inliers, LEVEL, True)[0] == max(values)


def test_nowhere_finite_is_a_failure():
    inliers, truth = draw_inliers(6, n_segments=2)
    hopeless = inliers._replace(z=np.full_like(inliers.z, np.nan))
    learned, _ = learn(hopeless, space_about(truth), truth, max_evaluations=20)
    assert learned.status == 'failed'
    np.testing.assert_array_equal(learned.theta, truth)


@pytest.mark.parametrize(
    ('changes', 'n_free'),
    [
        ({}, [0, 1, 2, 3, 4, 5]),
        ({'learning.fixed': 'latent'}, [0, 1, 5]),
        ({'learning.fixed': 'sigma_f_bar'}, [0, 1, 3, 4, 5]),
        ({'learning.fixed': 'length_scales'}, [0, 1]),
        ({'length_scale.model': 'line_gradient'}, [0, 1]),
    ],
)
def test_space_follows_the_configuration(changes, n_free):
    config = Config().replace(**{'learning.fixed': 'none', 'observation.sigma_n': 0.1, **changes})
    space = theta_space(config)
    assert list(np.flatnonzero(space.free)) == n_free
    assert np.exp(space.centre[1]) == pytest.approx(0.1)
    assert np.exp(space.upper[1]) == pytest.approx(0.1 * np.exp(5.0 * config.learning.prior_std))
    assert space.centre[5] == 0.0


def test_what_is_learned_does_not_choose_inliers():
    scan = hilly_scan(30_000)
    learned, given = (
        GroundSegmenter(backend=MODEL, learning_mode=mode).segment(scan)
        for mode in ('every_frame', 'fixed')
    )
    assert np.abs(learned.theta[:2] - given.theta[:2]).min() > 0.1
    np.testing.assert_array_equal(learned.surface.inlier, given.surface.inlier)


def test_every_nth_segment_by_itself_has_the_inliers_it_has_in_the_frame():
    """These alone are learned from."""
    config = Config().replace(**{'surface.look_aside': False, 'learning.segment_step': 7})
    frame, taken = GroundSegmenter(config, backend=MODEL).segment(hilly_scan(900)).frame, []

    def find(theta, inliers, *others):
        taken.append(inliers)
        return log_likelihood(theta, inliers, *others)

    with patch.object(learning, 'log_likelihood', find):
        learned = NumpyBackend().learn_frame(frame, config)
    whole, _, whole_u = MODEL.estimate_surface(frame, given_theta(config), config)
    kept = whole.inlier & (frame.candidates.segment % 7 == 0)
    np.testing.assert_array_equal(taken[0].r, frame.candidates.r[kept])
    np.testing.assert_array_equal(taken[0].z, frame.candidates.z[kept] - frame.prior_mean)
    np.testing.assert_allclose(taken[0].log_length_scale, whole_u[kept], atol=1e-6)
    np.testing.assert_allclose(MODEL.learn_frame(frame, config).theta, learned.theta, atol=1e-6)


def test_the_preset_paper_learns_until_no_more_join():
    """Nine classes of lines share their length-scales, which stay between their limits."""
    config = PRESETS['paper'].config
    result = GroundSegmenter(config, backend=MODEL).segment(hilly_scan(fewer(16_000, 1600)))
    assert result.fit.status == 'converged'
    assert 20 < result.fit.n_evaluations < config.learning.max_evaluations
    assert len(result.fit.theta) == 14
    l_bar = np.exp(class_middles(config.length_scale) + result.theta[5:])
    assert (l_bar > config.length_scale.min - 1e-9).all()
    assert (l_bar < config.length_scale.max + 1e-9).all()
    used = np.unique(result.pseudo.kind)
    assert len(used) > 3 and (result.theta[5 + used] != 0.0).all()
