import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gp_ground_seg.gp.kernels import paciorek
from gp_ground_seg.gp.observation import posterior


def random_inputs(seed, n):
    rng = np.random.default_rng(seed)
    return np.sort(rng.uniform(2, 60, n)), rng.uniform(0.5, 30, n)


@given(st.integers(0, 10_000), st.integers(1, 25), st.floats(0.05, 3.0))
def test_kernel_contract(seed, n, sigma_f):
    r, length_scale = random_inputs(seed, n)
    k = paciorek(r, length_scale, r, length_scale, sigma_f)
    np.testing.assert_allclose(k, k.T)
    np.testing.assert_allclose(np.diag(k), sigma_f**2)
    assert np.linalg.eigvalsh(k).min() > -1e-9 * sigma_f**2 * n


def test_kernel_is_the_printed_formula():
    for r_a, l_a, r_b, l_b in [(3.0, 2.0, 7.5, 9.0), (10.0, 1.0, 10.5, 0.5)]:
        printed = (
            0.7**2
            * (l_a**2) ** 0.25
            * (l_b**2) ** 0.25
            * ((l_a**2 + l_b**2) / 2) ** -0.5
            * np.exp(-((r_a - r_b) ** 2) / (l_a**2 + l_b**2))
        )
        value = paciorek(*(np.array([v]) for v in (r_a, l_a, r_b, l_b)), 0.7)
        assert value[0, 0] == pytest.approx(printed, rel=1e-14)


def test_constant_length_scale_is_the_squared_exponential():
    r, _ = random_inputs(0, 20)
    same = np.full(20, 4.0)
    expected = np.exp(-((r[:, None] - r) ** 2) / (2 * 4.0**2))
    np.testing.assert_allclose(paciorek(r, same, r, same, 1.0), expected, rtol=1e-14)


@settings(deadline=None)
@given(st.integers(0, 10_000), st.integers(1, 15), st.floats(0.0, 0.2))
def test_posterior_is_the_conditional_of_the_joint_gaussian(seed, n, slope_std):
    """Against the textbook form: invert the joint covariance, read off the block."""
    r, length_scale = random_inputs(seed, n + 4)
    order = np.random.default_rng(seed + 1).permutation(n + 4)
    r, length_scale = r[order], length_scale[order]
    z = np.sin(r[:n])
    sigma_f, sigma_n = 0.6, 0.1
    joint = paciorek(r, length_scale, r, length_scale, sigma_f) + slope_std**2 * np.outer(r, r)
    joint[:n, :n] += sigma_n**2 * np.eye(n)
    gain = np.linalg.solve(joint[:n, :n], joint[:n, n:]).T
    mean, variance = posterior(
        r[:n], z, length_scale[:n], r[n:], length_scale[n:], sigma_f, sigma_n, slope_std
    )
    np.testing.assert_allclose(mean, gain @ z, atol=1e-9)
    np.testing.assert_allclose(variance, np.diag(joint[n:, n:] - gain @ joint[:n, n:]), atol=1e-9)


def test_far_from_data_the_mean_follows_the_slope_and_the_uncertainty_grows():
    r = np.arange(3.0, 20.0)
    flat = np.full(len(r), 3.0)
    far = np.array([60.0])
    mean, variance = posterior(r, 0.05 * r, flat, far, np.array([3.0]), 0.2, 0.05, 0.1)
    assert mean[0] == pytest.approx(3.0, abs=0.3)
    level_mean, level_variance = posterior(r, 0.05 * r, flat, far, np.array([3.0]), 0.2, 0.05, 0.0)
    assert level_mean[0] == pytest.approx(0.0, abs=1e-6)
    assert variance[0] > level_variance[0]


def test_noise_free_data_are_interpolated_with_no_uncertainty():
    r = np.array([3.0, 6.0, 9.0])
    z = np.array([0.1, -0.2, 0.3])
    flat = np.full(3, 2.0)
    mean, variance = posterior(r, z, flat, r, flat, 0.5, 1e-6)
    np.testing.assert_allclose(mean, z, atol=1e-6)
    np.testing.assert_allclose(variance, 0.0, atol=1e-9)
