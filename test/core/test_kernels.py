"""The numerics of compiled code."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gp_ground_seg.core.compiled import numerics
from gp_ground_seg.core.compiled.numerics import exp_neg
from gp_ground_seg.core.gp import kernels
from gp_ground_seg.core.jit import JIT_ENABLED


def compiled(function):
    """The function in compiled code: called from Python, it is plain."""
    if not JIT_ENABLED:
        return function
    import numba

    return numba.njit(function)


inverted, solve_in_place = map(compiled, (numerics.inverted, numerics.solve_in_place))


@given(st.floats(0.0, 1e300), st.floats(-10.0, 0.0))
def test_exp_neg_is_the_exponential(x, negative):
    assert abs(exp_neg(x) - np.exp(-x)) <= 2e-15
    assert (exp_neg(x) == 0.0) == (x >= numerics.NEGLIGIBLE_EXPONENT)
    np.testing.assert_allclose(exp_neg(negative), np.exp(-negative), rtol=1e-11)


@given(st.floats(0.0, 2.0**100, width=32))
def test_exp_neg_in_single_precision(x):
    found = numerics.exp_neg_single(np.float32(x))
    assert type(found) is np.float32
    # Next to 1 it is as exact as single precision is.
    expected = np.exp(-np.float64(x))
    assert abs(found - expected) <= 6e-8 + 1.5e-7 * (1.0 - expected)
    assert (found == 0.0) == (x >= numerics.NEGLIGIBLE_SINGLE)


def positive_definite(n, seed):
    root = np.random.default_rng(seed).normal(size=(n, n + 2))
    return root @ root.T / n + 0.1 * np.eye(n)


@given(st.integers(0, 10_000), st.integers(1, 13))
def test_small_systems(seed, n):
    a = positive_definite(n, seed)
    rng, room = np.random.default_rng(seed), (n + numerics.LANES - 1) & -numerics.LANES
    # Arbitrary values left of the diagonal and behind column n.
    matrix = np.where(np.tri(n, room, -1), rng.normal(size=(n, room)), 7.0)
    matrix[:, :n][np.triu_indices(n)] = a[np.triu_indices(n)]
    vector = np.append(rng.normal(size=n), np.zeros(room - n))
    expected = np.linalg.solve(a, vector[:n])
    assert solve_in_place(matrix, n, vector)
    np.testing.assert_allclose(vector[:n], expected, rtol=1e-8, atol=1e-8)
    factor = a.copy()
    inverse, log_root = inverted(factor)
    np.testing.assert_allclose(np.triu(factor).T, np.linalg.cholesky(a), rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(inverse, np.linalg.inv(a), rtol=1e-7, atol=1e-7)
    np.testing.assert_array_equal(inverse, inverse.T)
    assert [log_root, kernels.inverted(a)[1]] == pytest.approx(2 * [np.linalg.slogdet(a)[1] / 2])


@pytest.mark.parametrize('worst', [0.0, -1.0, np.nan])
def test_no_positive_definite_matrix_no_solution(worst):
    matrix = np.zeros((4, numerics.LANES))
    np.fill_diagonal(matrix, [1.0, 2.0, worst, 1.0])
    assert not solve_in_place(matrix.copy(), 4, np.ones(4))
    for find in (inverted, kernels.inverted):
        assert np.isnan(find(matrix[:, :4].copy())[1])
