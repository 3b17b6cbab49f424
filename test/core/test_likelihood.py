"""Log marginal likelihood of a frame: gradient, reference, GPy."""

import functools
import math

import numpy as np
import pytest
import reference_gp
from test_gpy import CONFIG, TABLE, THETA, column, offsets

import gp_ground_seg.core.compiled.likelihood  # noqa: F401 - the compiled form of a part
from gp_ground_seg.core.frame import Inliers
from gp_ground_seg.core.gp.latent import MAX_ABS_LOG_LENGTH_SCALE
from gp_ground_seg.core.gp.likelihood import log_likelihood
from gp_ground_seg.core.jit import jit
from gp_ground_seg.core.parameters.config import ObservationConfig
from gp_ground_seg.core.parameters.schema import numbers_of

COMPILED = jit(part=True)(log_likelihood)
# With a factor for each class of lines.
FACTORS = np.array([0.8, 0.5, 1.3, 1.0, 0.7, 2.0, 0.9, 1.1, 0.6])
PRIOR = numbers_of(ObservationConfig(slope_std=0.05, slope_drift=0.01))
LEVEL = numbers_of(ObservationConfig(slope_std=0.0, slope_drift=0.0))
TYPICAL = np.log([0.3, 0.05, 0.9, 3.0, 0.25, *FACTORS])


@pytest.fixture(params=[log_likelihood, COMPILED], ids=['numpy', 'numba'])
def likelihood(request):
    return request.param


def scaled(*factors):
    return TYPICAL + np.log(np.append(factors, np.ones(len(TYPICAL) - len(factors))))


# Typical, and near either bound in every coordinate (factors of 20 about the centre).
THETAS = {
    'typical': TYPICAL,
    'small sigma_f': scaled(1 / 18),
    'large sigma_f': scaled(18),
    'small sigma_n': scaled(1, 1 / 10),
    'large sigma_n': scaled(1, 18),
    'short latent': scaled(1, 1, 1, 1 / 18),
    'long latent': scaled(1, 1, 1, 18),
    'stiff latent': scaled(1, 1, 1 / 18, 1, 18),
    'loose latent': scaled(1, 1, 4, 1, 1 / 10),
    'short length-scales': scaled(1, 1, 1, 1, 1, *[1 / 10] * 9),
    'long length-scales': scaled(1, 1, 1, 1, 1, *[10] * 9),
}


def random_inliers(seed, bars='all', n_segments=6):
    """Ragged: some segments have no inliers, some one; `bars` says which have pseudo-inputs."""
    rng = np.random.default_rng(seed)
    counts = rng.integers(0, 25, n_segments)
    counts[0] = 0
    bar_counts = rng.integers(1, 9, n_segments)
    bar_counts *= {'all': 1, 'none': 0, 'some': np.arange(n_segments) % 3 > 0}[bars]
    r, r_bar = (
        np.concatenate([np.sort(rng.uniform(3, 50, n)) for n in own])
        for own in (counts, bar_counts)
    )
    return Inliers(
        np.concatenate([[0], np.cumsum(counts)]),
        r,
        rng.normal(0, 0.2, len(r)),
        rng.normal(1.0, 0.5, len(r)),
        np.concatenate([[0], np.cumsum(bar_counts)]),
        r_bar,
        rng.choice(np.log([1.5, 3.0, 6.0, 10.0]), len(r_bar)),
        rng.integers(0, 9, len(r_bar)),
    )


@functools.cache
def expected(name, latent_terms, bars):
    return reference_gp.log_likelihood(
        THETAS[name], random_inliers(7, bars, 4), PRIOR, latent_terms
    )


@pytest.mark.parametrize('latent_terms', [False, True])
@pytest.mark.parametrize('name', THETAS)
@pytest.mark.parametrize('bars', ['all', 'some', 'none'])
def test_value_and_gradient_are_those_of_the_reference(likelihood, name, latent_terms, bars):
    inliers = random_inliers(7, bars, 4)
    value, gradient = likelihood(THETAS[name], inliers, PRIOR, latent_terms)
    expected_value, numeric = expected(name, latent_terms, bars)
    assert value == pytest.approx(expected_value, rel=1e-8, abs=1e-6)
    # A component far smaller than the others is only as exact as their rounding.
    floor = 1e-4 * np.abs(numeric).max()
    error = np.abs(gradient - numeric) / np.maximum(np.abs(numeric), floor)
    assert error.max() <= 1e-6
    assert bars != 'none' or not gradient[2:].any()


def test_value_and_gradient_are_those_of_gpy(likelihood):
    places = column('r'), column('z'), np.zeros(len(column('r')))
    bars = offsets('r_bar'), column('r_bar'), column('log_extent'), column('kind')
    prior = numbers_of(CONFIG.observation)
    value, gradient = likelihood(THETA, Inliers(offsets('r'), *places, *bars), prior, False)
    assert value == pytest.approx(TABLE['log_likelihood'], rel=1e-9)
    np.testing.assert_allclose(gradient, TABLE['gradient'], rtol=1e-6)


NOISELESS, NOISELESS_LATENT = TYPICAL.copy(), TYPICAL.copy()
NOISELESS[:2], NOISELESS_LATENT[4] = np.log([1e8, 1e-9]), -400.0


@pytest.mark.parametrize(
    ('theta', 'changes'),
    [(NOISELESS, {}), (TYPICAL, {'z': math.nan}), (NOISELESS_LATENT, {'r_bar': 5.0})],
)
def test_without_a_factor_the_value_is_minus_infinity_and_nothing_is_raised(
    likelihood, theta, changes
):
    inliers = random_inliers(4)
    inliers = inliers._replace(**{k: np.full_like(inliers.z, v) for k, v in changes.items()})
    for find in (likelihood, reference_gp.log_likelihood):
        value, gradient = find(theta, inliers, LEVEL, False)
        assert value == -np.inf
        assert not gradient.any()


def test_beyond_the_bound_of_length_scales_nothing_depends_on_the_latent_process(likelihood):
    inliers = random_inliers(5)
    beyond = TYPICAL.copy()
    beyond[5:] = MAX_ABS_LOG_LENGTH_SCALE + 10.0
    assert not likelihood(beyond, inliers, PRIOR, False)[1][2:].any()
