"""Covariance functions, and the padding of many segments into batches."""

import numpy as np
import reference_gp
from hypothesis import given
from hypothesis import strategies as st

from gp_ground_seg.core.gp.kernels import paciorek, squared_exponential
from gp_ground_seg.core.gp.linalg import SEGMENTS_PER_BATCH, Padded, batches


def kernels(r_a, l_a, r_b, l_b, sigma_f):
    """Of `gp.kernels`, and of the reference."""
    found = paciorek(r_a[:, None], l_a[:, None], r_b, l_b, sigma_f**2)
    return found, reference_gp.paciorek(r_a, l_a, r_b, l_b, sigma_f)


def random_inputs(seed, n):
    rng = np.random.default_rng(seed)
    return np.sort(rng.uniform(2, 60, n)), rng.uniform(0.5, 30, n)


@given(st.integers(0, 10_000), st.integers(1, 25), st.floats(0.05, 3.0))
def test_kernel_contract(seed, n, sigma_f):
    r, length_scale = random_inputs(seed, n)
    k, expected = kernels(r, length_scale, r, length_scale, sigma_f)
    np.testing.assert_allclose(k, expected, rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(k, k.T)
    np.testing.assert_allclose(np.diag(k), sigma_f**2)
    assert np.linalg.eigvalsh(k).min() > -1e-9 * sigma_f**2 * n
    # A constant length-scale gives the squared exponential.
    same = np.full(n, 4.0)
    stationary = sigma_f**2 * np.exp(-((r[:, None] - r) ** 2) / (2 * 4.0**2))
    ours = squared_exponential(r[:, None], r, sigma_f**2, 0.5 / 4.0**2)
    plain = reference_gp.squared_exponential(r, r, sigma_f, 4.0)
    for k in (*kernels(r, same, r, same, sigma_f), ours, plain):
        np.testing.assert_allclose(k, stationary, rtol=1e-12, atol=1e-15)


@given(st.lists(st.integers(0, 20), max_size=100))
def test_batches_hold_every_segment_once_and_similar_sizes_together(counts):
    offsets = np.concatenate([[0], np.cumsum(counts, dtype=np.int64)])
    values = np.arange(offsets[-1]) + 0.5
    found = batches(offsets)
    taken = np.sort(np.concatenate([np.empty(0, dtype=int), *found]))
    np.testing.assert_array_equal(taken, np.flatnonzero(counts))
    longest = 0
    for segments in found:
        assert len(segments) <= SEGMENTS_PER_BATCH
        padded = Padded.of(segments, offsets)
        assert padded.mask.sum(axis=1).min() >= longest
        longest = padded.mask.shape[1]
        for row, mask, m in zip(padded.take(values, -1.0), padded.mask, segments, strict=True):
            np.testing.assert_array_equal(row[mask], values[offsets[m] : offsets[m + 1]])
            assert (row[~mask] == -1.0).all()
    nothing = Padded.of(np.array([0]), np.array([0, 0]))
    assert nothing.take(values).shape == (1, 0)
