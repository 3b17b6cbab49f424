import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gp_ground_seg.gp.kernels import paciorek
from gp_ground_seg.gp.objective import TrainingFrame, objective_reference
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


def test_with_one_length_scale_it_is_scikit_learns_regression():
    """Posterior and log marginal likelihood of the stationary case, by another's code."""
    gaussian_process = pytest.importorskip('sklearn.gaussian_process')
    kernels = gaussian_process.kernels
    rng = np.random.default_rng(4)
    r, r_star = np.sort(rng.uniform(2, 40, 25)), np.linspace(0, 50, 30)
    z = 0.2 * np.sin(0.3 * r) + rng.normal(0, 0.05, 25)
    sigma_f, sigma_n, length = 0.4, 0.05, 3.0
    kernel = kernels.ConstantKernel(sigma_f**2) * kernels.RBF(length)
    theirs = gaussian_process.GaussianProcessRegressor(kernel, alpha=sigma_n**2, optimizer=None)
    theirs.fit(r[:, None], z)
    their_mean, their_std = theirs.predict(r_star[:, None], return_std=True)
    mean, variance = posterior(
        r, z, np.full(25, length), r_star, np.full(30, length), sigma_f, sigma_n
    )
    np.testing.assert_allclose(mean, their_mean, atol=1e-10)
    np.testing.assert_allclose(np.sqrt(variance), their_std, atol=1e-7)

    # The whole-frame objective of that one segment, its latent process constant.
    theta = np.log([sigma_f, sigma_n, 0.9, 2.0, 0.3, length])
    frame = TrainingFrame(
        np.array([0, 25]),
        r,
        z,
        np.zeros(25),
        np.array([0, 3]),
        np.array([5.0, 15.0, 30.0]),
        np.zeros(3, dtype=np.int64),
    )
    value, gradient = objective_reference(theta, frame, 0.0, False)
    their_value, their_gradient = theirs.log_marginal_likelihood(
        theirs.kernel_.theta, eval_gradient=True
    )
    assert value == pytest.approx(their_value, rel=1e-12)
    # Theirs is in log sigma_f^2 and log length-scale.
    assert gradient[0] == pytest.approx(2.0 * their_gradient[0], rel=1e-9)
    assert gradient[5] == pytest.approx(their_gradient[1], rel=1e-9)
