"""Learning recovers what frames were drawn from, within budget and bounds."""

import numpy as np
import pytest
from conftest import hilly_scan

from gp_ground_seg import Config, GroundSegmenter
from gp_ground_seg.compiled.backend import CompiledBackend
from gp_ground_seg.gp.kernels import paciorek
from gp_ground_seg.gp.latent import log_length_scale
from gp_ground_seg.gp.learning import learn
from gp_ground_seg.gp.objective import TrainingFrame
from gp_ground_seg.gp.theta import ThetaSpace, theta_names, theta_space


def never():
    return False


def draw_frame(seed, n_segments=120, n=50, sigma_f=0.3, sigma_n=0.05):
    """Frame drawn from the model: smooth road to 25 m, rubble beyond.

    Returns the frame, and theta with the log length-scales of two classes.
    """
    rng = np.random.default_rng(seed)
    truth = np.log([sigma_f, sigma_n, 0.9, 3.0, 0.25, 10.0, 1.5])
    r_bar = np.arange(4.0, 50.0, 3.0)
    surface_class = (r_bar > 25.0).astype(np.int64)
    l_bar = truth[5 + surface_class]
    r, z = [], []
    for _ in range(n_segments):
        own = np.sort(rng.uniform(3, 50, n))
        length = np.exp(log_length_scale(r_bar, l_bar, own, *np.exp(truth[2:5])))
        a = paciorek(own, length, own, length, sigma_f) + sigma_n**2 * np.eye(n)
        r.append(own)
        z.append(np.linalg.cholesky(a) @ rng.standard_normal(n))
    frame = TrainingFrame(
        np.arange(n_segments + 1) * n,
        np.concatenate(r),
        np.concatenate(z),
        np.zeros(n_segments * n),
        np.arange(n_segments + 1) * len(r_bar),
        np.tile(r_bar, n_segments),
        np.tile(surface_class, n_segments),
    )
    return frame, truth


def space_about(centre, free=None, factor=20.0):
    width = np.log(factor)
    free = np.ones(len(centre), dtype=bool) if free is None else free
    return ThetaSpace(centre, centre - width, centre + width, free, 1.0)


def learn_frame(frame, space, start, use_priors=True, max_evaluations=200):
    backend = CompiledBackend(1)
    return learn(
        lambda theta: backend.objective(theta, frame, 0.0, not use_priors),
        space,
        start,
        len(frame.r),
        use_priors=use_priors,
        max_evaluations=max_evaluations,
        out_of_time=never,
    )


@pytest.mark.parametrize('seed', [0, 1, 2])
def test_noise_and_length_scales_of_a_drawn_frame_are_recovered(seed):
    frame, truth = draw_frame(seed)
    # Far off: half the amplitude, twice the noise, one length-scale for all.
    start = truth + np.log([0.5, 2.0, 1.3, 0.7, 1.5, 0.4, 2.7])
    learned = learn_frame(frame, space_about(start), start)
    found = np.exp(learned.theta)
    assert found[1] == pytest.approx(0.05, rel=0.1)
    assert found[0] == pytest.approx(0.3, rel=0.15)
    r = np.linspace(4, 48, 100)
    r_bar = frame.r_bar[: frame.bar_offsets[1]]
    classes = frame.surface_class[: frame.bar_offsets[1]]
    profile = log_length_scale(r_bar, learned.theta[5 + classes], r, *found[2:5])
    true_profile = log_length_scale(r_bar, truth[5 + classes], r, *np.exp(truth[2:5]))
    assert np.corrcoef(profile, true_profile)[0, 1] >= 0.9


def gradient_per_datum(frame, space, theta):
    _, gradient = CompiledBackend(1).objective(theta, frame, 0.0, False)
    return np.abs(gradient - (theta - space.centre)) / len(frame.r)


def test_the_end_is_level():
    frame, truth = draw_frame(3, n_segments=30)
    space, start = space_about(truth, factor=1.5), truth + 0.3
    learned = learn_frame(frame, space, start)
    assert learned.status == 'converged'
    assert not learned.at_bound.any()
    assert gradient_per_datum(frame, space, start).max() > 0.1
    assert gradient_per_datum(frame, space, learned.theta).max() < 1e-3


def test_an_end_that_is_not_level_is_at_a_bound_and_said_to_be():
    frame, truth = draw_frame(3, n_segments=30)
    # The box leaves the true noise out.
    space = space_about(truth + np.log([1, 3, 1, 1, 1, 1, 1]), factor=1.5)
    learned = learn_frame(frame, space, space.centre)
    level = gradient_per_datum(frame, space, learned.theta) < 1e-3
    assert learned.at_bound[1]
    assert learned.theta[1] == space.lower[1]
    assert not level[1]
    assert (level | learned.at_bound).all()
    assert (space.lower - 1e-12 <= learned.theta).all()
    assert (learned.theta <= space.upper + 1e-12).all()


def test_fixed_entries_stay():
    frame, truth = draw_frame(4, n_segments=20)
    free = np.array([True, True, False, False, False, True, True])
    start = truth + 0.3
    learned = learn_frame(frame, space_about(start, free), start)
    np.testing.assert_array_equal(learned.theta[~free], start[~free])
    assert (learned.theta[free] != start[free]).all()


@pytest.mark.parametrize('budget', [1, 3, 6])
def test_budget_is_kept_and_the_best_so_far_is_used(budget):
    frame, truth = draw_frame(5, n_segments=20)
    start = truth + np.log(3.0)
    values = []
    backend = CompiledBackend(1)

    def objective(theta):
        value, gradient = backend.objective(theta, frame, 0.0, False)
        values.append(value)
        return value, gradient

    learned = learn(
        objective,
        space_about(start),
        start,
        len(frame.r),
        use_priors=False,
        max_evaluations=budget,
        out_of_time=never,
    )
    assert learned.n_evaluations == len(values) == budget
    assert learned.status == 'budget'
    assert learned.objective == max(values)
    assert backend.objective(learned.theta, frame, 0.0, False)[0] == max(values)


def test_no_time_means_one_evaluation():
    frame, truth = draw_frame(6, n_segments=5)
    backend = CompiledBackend(1)
    learned = learn(
        lambda theta: backend.objective(theta, frame, 0.0, False),
        space_about(truth),
        truth,
        len(frame.r),
        use_priors=True,
        max_evaluations=50,
        out_of_time=lambda: True,
    )
    assert learned.n_evaluations == 1


def test_an_objective_that_is_nowhere_finite_fails_without_an_exception():
    theta = np.zeros(7)
    learned = learn(
        lambda theta: (-np.inf, np.zeros(7)),
        space_about(theta),
        theta,
        10,
        use_priors=True,
        max_evaluations=20,
        out_of_time=never,
    )
    assert learned.status == 'failed'
    np.testing.assert_array_equal(learned.theta, theta)


def test_printed_objective_runs_to_the_bounds_and_map_does_not():
    frame, truth = draw_frame(7, n_segments=30)
    space = space_about(truth, factor=1000.0)
    printed = np.exp(learn_frame(frame, space, truth, use_priors=False).theta - truth)
    ours = np.exp(learn_frame(frame, space, truth).theta - truth)
    assert printed[2] < 0.05
    assert (ours > 0.3).all()
    assert (ours < 3.0).all()


def test_space_follows_the_configuration():
    guess = np.log([1.0, 3.0])
    config = Config().replace(**{'learning.fixed': 'latent', 'observation.sigma_n': 0.1})
    space = theta_space(config, guess)
    assert list(space.free) == [True, True, False, False, False, True, True]
    assert np.exp(space.centre[1]) == pytest.approx(0.1)
    assert np.exp(space.upper[1]) == pytest.approx(0.1 * config.learning.bound_factor)
    np.testing.assert_allclose(np.exp(space.lower[5:]), config.length_scale.min)
    for model in ('line_gradient', 'constant'):
        config = Config().replace(**{'length_scale.model': model})
        assert theta_space(config, guess).free.sum() == 2
    assert theta_names(7)[5:] == ['length_scale_bar_0', 'length_scale_bar_1']


def segment_twice(**changes):
    segmenter = GroundSegmenter(Config().replace(**changes))
    return segmenter, [segmenter.segment(hilly_scan(seed=s)) for s in (1, 2)]


def test_modes():
    _, results = segment_twice()
    assert [r.fit.status != 'kept' for r in results] == [True, True]
    _, results = segment_twice(**{'learning.mode': 'first_frame'})
    assert [r.fit.status != 'kept' for r in results] == [True, False]
    assert results[0].fit.theta == results[1].fit.theta
    _, results = segment_twice(**{'learning.mode': 'fixed'})
    assert results[1].fit.n_evaluations == 0
    assert results[1].fit.theta['sigma_n'] == pytest.approx(Config().observation.sigma_n)
    segmenter, results = segment_twice(**{'learning.mode': 'every_k', 'learning.period': 3})
    statuses = [r.fit.status for r in results]
    statuses += [segmenter.segment(hilly_scan(seed=s)).fit.status for s in (3, 4, 5)]
    assert [s == 'kept' for s in statuses] == [False, True, True, False, True]
    segmenter.reset()
    assert segmenter.segment(hilly_scan(seed=6)).fit.status != 'kept'


def test_a_warm_start_needs_fewer_evaluations_on_the_same_scan():
    changes = {'learning.max_evaluations': 200}
    cold = GroundSegmenter(Config().replace(**changes))
    warm = GroundSegmenter(Config().replace(**changes, **{'learning.warm_start': True}))
    scan = hilly_scan(8000)
    first = [s.segment(scan).fit.n_evaluations for s in (cold, warm)]
    again = [s.segment(scan).fit.n_evaluations for s in (cold, warm)]
    assert first[0] == first[1] == again[0]
    assert again[1] < again[0]


@pytest.mark.parametrize('model', ['latent', 'line_gradient', 'constant'])
@pytest.mark.parametrize('scope', ['frame', 'segment'])
def test_every_model_learns_in_both_scopes_and_backends_agree(model, scope):
    changes = {
        'length_scale.model': model,
        'learning.scope': scope,
        'learning.max_evaluations': 3,
        'grid.n_segments': 12,
    }
    scan = hilly_scan(1500)
    results = [
        GroundSegmenter(Config().replace(**changes, **{'runtime.backend': backend})).segment(scan)
        for backend in ('numba', 'numpy')
    ]
    np.testing.assert_array_equal(results[0].label, results[1].label)
    np.testing.assert_allclose(results[0].ground_z, results[1].ground_z, atol=1e-5)
    assert results[0].fit.n_evaluations == results[1].fit.n_evaluations > 0
