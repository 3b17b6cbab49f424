"""Gradient, twins and dense references of the whole-frame objective."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import multivariate_normal

from gp_ground_seg.compiled.backend import CompiledBackend
from gp_ground_seg.gp.kernels import paciorek, squared_exponential
from gp_ground_seg.gp.latent import latent_rows_compiled, latent_rows_reference, log_length_scale
from gp_ground_seg.gp.objective import TrainingFrame, objective_reference

N_CLASSES = 4
TYPICAL = np.log([0.3, 0.05, 0.9, 3.0, 0.25, 1.5, 3.0, 6.0, 10.0])


def random_frame(seed, n_segments=6, latent=True, most=25):
    """Ragged: some segments have no inliers, some one."""
    rng = np.random.default_rng(seed)
    counts = rng.integers(0, most, n_segments)
    counts[0] = 0
    bar_counts = rng.integers(1, 9, n_segments) if latent else np.zeros(n_segments, dtype=int)
    r = np.concatenate([np.sort(rng.uniform(3, 50, n)) for n in counts])
    r_bar = np.concatenate([np.sort(rng.uniform(3, 50, n)) for n in bar_counts])
    return TrainingFrame(
        np.concatenate([[0], np.cumsum(counts)]),
        r,
        rng.normal(0, 0.2, len(r)),
        rng.normal(1.0, 0.5, len(r)),
        np.concatenate([[0], np.cumsum(bar_counts)]),
        r_bar,
        rng.integers(0, N_CLASSES, len(r_bar)),
    )


def central_differences(theta, frame, slope_std, latent_terms):
    """Richardson's extrapolation of central differences: error of sixth order."""
    gradient = np.zeros(len(theta))
    for i in range(len(theta)):

        def slope(step, i=i):
            up, down = theta.copy(), theta.copy()
            up[i] += step
            down[i] -= step
            above = objective_reference(up, frame, slope_std, latent_terms)[0]
            return (above - objective_reference(down, frame, slope_std, latent_terms)[0]) / (
                2 * step
            )

        coarse, middle, fine = slope(8e-3), slope(4e-3), slope(2e-3)
        gradient[i] = (64 * fine - 20 * middle + coarse) / 45
    return gradient


# Typical, and near either bound in every coordinate (factors of 20 about the centre).
THETAS = {
    'typical': TYPICAL,
    'small sigma_f': TYPICAL + np.log([1 / 18, 1, 1, 1, 1, 1, 1, 1, 1]),
    'large sigma_f': TYPICAL + np.log([18, 1, 1, 1, 1, 1, 1, 1, 1]),
    'small sigma_n': TYPICAL + np.log([1, 1 / 10, 1, 1, 1, 1, 1, 1, 1]),
    'large sigma_n': TYPICAL + np.log([1, 18, 1, 1, 1, 1, 1, 1, 1]),
    'short latent': TYPICAL + np.log([1, 1, 1, 1 / 18, 1, 1, 1, 1, 1]),
    'long latent': TYPICAL + np.log([1, 1, 1, 18, 1, 1, 1, 1, 1]),
    'stiff latent': TYPICAL + np.log([1, 1, 1 / 18, 1, 18, 1, 1, 1, 1]),
    'loose latent': TYPICAL + np.log([1, 1, 4, 1, 1 / 10, 1, 1, 1, 1]),
    'bounds of length-scale': np.concatenate([TYPICAL[:5], np.log([1.0, 50.0, 1.01, 49.0])]),
}


@pytest.mark.parametrize('latent_terms', [False, True])
@pytest.mark.parametrize('name', THETAS)
def test_gradient_is_that_of_central_differences(name, latent_terms):
    frame = random_frame(7)
    _, gradient = objective_reference(THETAS[name], frame, 0.05, latent_terms)
    numeric = central_differences(THETAS[name], frame, 0.05, latent_terms)
    # A component far smaller than the others is only as exact as their rounding.
    floor = 1e-4 * np.abs(numeric).max()
    error = np.abs(gradient - numeric) / np.maximum(np.abs(numeric), floor)
    assert error.max() <= 1e-6


def test_gradient_without_a_latent_process():
    frame = random_frame(8, latent=False)
    _, gradient = objective_reference(TYPICAL, frame, 0.05, False)
    numeric = central_differences(TYPICAL, frame, 0.05, False)
    np.testing.assert_allclose(gradient[:2], numeric[:2], rtol=1e-6)
    assert not gradient[2:].any()


@settings(deadline=None, max_examples=40)
@given(st.integers(0, 100_000), st.booleans(), st.booleans(), st.sampled_from(sorted(THETAS)))
def test_compiled_objective_is_the_reference(seed, latent, latent_terms, name):
    frame = random_frame(seed, latent=latent)
    value, gradient = objective_reference(THETAS[name], frame, 0.05, latent_terms)
    backend = CompiledBackend(1)
    found, found_gradient = backend.objective(THETAS[name], frame, 0.05, latent_terms)
    assert found == pytest.approx(value, rel=1e-8, abs=1e-6)
    scale = np.abs(gradient).max() + 1.0
    np.testing.assert_allclose(found_gradient / scale, gradient / scale, atol=1e-7)


def test_threads_do_not_change_a_bit():
    frame = random_frame(3, n_segments=40)
    one, two = CompiledBackend(1), CompiledBackend(2)
    a, b = (x.objective(TYPICAL, frame, 0.05, True) for x in (one, two))
    two.close()
    assert a[0] == b[0]
    np.testing.assert_array_equal(a[1], b[1])


def test_value_is_the_density_of_the_printed_model():
    """Sum over segments of log N(z | 0, A), and -1/2 log|2 pi B|, by scipy.stats."""
    frame = random_frame(5)
    sigma_f, sigma_n, sigma_f_bar, sigma_l_bar, sigma_n_bar = np.exp(TYPICAL[:5])
    expected = printed = 0.0
    for m in range(frame.n_segments):
        own = slice(frame.offsets[m], frame.offsets[m + 1])
        bar = slice(frame.bar_offsets[m], frame.bar_offsets[m + 1])
        r, r_bar = frame.r[own], frame.r_bar[bar]
        if len(r) == 0:
            continue
        l_bar = TYPICAL[5 + frame.surface_class[bar]]
        length = np.exp(log_length_scale(r_bar, l_bar, r, sigma_f_bar, sigma_l_bar, sigma_n_bar))
        a = paciorek(r, length, r, length, sigma_f) + 0.05**2 * np.outer(r, r)
        a += sigma_n**2 * np.eye(len(r))
        expected += multivariate_normal(np.zeros(len(r)), a).logpdf(frame.z[own])
        b = squared_exponential(r_bar, r_bar, sigma_f_bar, sigma_l_bar)
        b += sigma_n_bar**2 * np.eye(len(r_bar))
        # The density at its mean: the quadratic term, which the paper leaves out, is zero.
        printed += multivariate_normal(np.zeros(len(r_bar)), b).logpdf(np.zeros(len(r_bar)))
    assert objective_reference(TYPICAL, frame, 0.05, False)[0] == pytest.approx(expected)
    assert objective_reference(TYPICAL, frame, 0.05, True)[0] == pytest.approx(expected + printed)


def test_the_printed_objective_has_no_upper_bound_and_ours_does_not_move():
    """Scaling the latent process changes no prediction, yet the printed objective grows."""
    frame = random_frame(6)
    printed, ours = [], []
    for shrink in (1.0, 1e-1, 1e-2, 1e-3):
        theta = TYPICAL + np.log([1, 1, shrink, 1, shrink, 1, 1, 1, 1])
        printed.append(objective_reference(theta, frame, 0.05, True)[0])
        ours.append(objective_reference(theta, frame, 0.05, False)[0])
    n_bar = sum(
        int(np.diff(frame.bar_offsets)[m])
        for m in range(frame.n_segments)
        if frame.offsets[m] < frame.offsets[m + 1]
    )
    np.testing.assert_allclose(np.diff(printed), n_bar * np.log(10.0), rtol=1e-6)
    np.testing.assert_allclose(ours, ours[0], rtol=1e-6)


def test_a_covariance_that_cannot_be_factored_is_minus_infinity_not_an_exception():
    frame = random_frame(4)
    theta = TYPICAL.copy()
    theta[0], theta[1] = np.log(1e8), np.log(1e-9)
    assert objective_reference(theta, frame, 0.0, False)[0] == -np.inf
    value, gradient = CompiledBackend(1).objective(theta, frame, 0.0, False)
    assert value == -np.inf
    assert not gradient.any()


def test_equal_pseudo_inputs_give_that_length_scale_everywhere():
    r_bar = np.array([3.0, 8.0, 20.0])
    values = log_length_scale(r_bar, np.full(3, 1.3), np.linspace(0, 90, 50), 0.9, 3.0, 0.2)
    np.testing.assert_allclose(values, 1.3, rtol=1e-13)


def test_equal_pseudo_inputs_give_the_stationary_objective():
    frame = random_frame(9)
    theta = TYPICAL.copy()
    theta[5:] = 1.3
    stationary = TrainingFrame(
        frame.offsets,
        frame.r,
        frame.z,
        np.full(len(frame.r), 1.3),
        np.zeros_like(frame.offsets),
        frame.r_bar,
        frame.surface_class,
    )
    a = objective_reference(theta, frame, 0.05, False)[0]
    assert a == pytest.approx(objective_reference(theta, stationary, 0.05, False)[0], rel=1e-12)


def test_latent_mean_is_the_conditional_of_the_joint_gaussian():
    rng = np.random.default_rng(2)
    r_bar, r = np.sort(rng.uniform(3, 40, 6)), rng.uniform(3, 60, 9)
    l_bar = rng.normal(1.0, 0.5, 6)
    b = squared_exponential(r_bar, r_bar, 0.8, 4.0) + 0.3**2 * np.eye(6)
    gain = squared_exponential(r, r_bar, 0.8, 4.0) @ np.linalg.inv(b)
    expected = l_bar.mean() + gain @ (l_bar - l_bar.mean())
    np.testing.assert_allclose(log_length_scale(r_bar, l_bar, r, 0.8, 4.0, 0.3), expected)


@settings(deadline=None)
@given(st.integers(0, 100_000))
def test_compiled_latent_rows_are_the_reference(seed):
    rng = np.random.default_rng(seed)
    counts = rng.integers(0, 12, 5)
    bar_counts = np.where(counts > 0, rng.integers(1, 7, 5), 0)
    theta = np.tile(TYPICAL, (5, 1)) + rng.normal(0, 0.2, (5, 9))
    arguments = (
        theta,
        np.concatenate([[0], np.cumsum(bar_counts)]),
        rng.uniform(3, 40, bar_counts.sum()),
        rng.integers(0, N_CLASSES, bar_counts.sum()),
        np.concatenate([[0], np.cumsum(counts)]),
        rng.uniform(3, 40, counts.sum()),
        np.linspace(2, 60, 7),
        rng.integers(0, 8, 5),
    )
    expected = latent_rows_reference(*arguments)
    found = np.empty(counts.sum()), np.zeros((5, 7))
    latent_rows_compiled(0, 5, *arguments, *found)
    for a, b in zip(found, expected, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-9)
