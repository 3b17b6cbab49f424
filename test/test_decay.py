import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from gp_ground_seg.compiled.decay import NEGLIGIBLE_EXPONENT, decay


@given(st.floats(0.0, 1e300))
def test_decay_is_the_exponential(x):
    assert abs(decay(x) - np.exp(-x)) <= 1e-14
    assert (decay(x) == 0.0) == (x > NEGLIGIBLE_EXPONENT)


@given(st.floats(-10.0, 0.0))
def test_growth_is_as_exact_for_its_size(x):
    np.testing.assert_allclose(decay(x), np.exp(-x), rtol=1e-11)
