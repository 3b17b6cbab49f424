"""The exponential of compiled code; its small systems are solved in test_likelihood."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from gp_ground_seg.core.compiled import numerics
from gp_ground_seg.core.compiled.numerics import exp_neg


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
