"""Numpy on many segments at once gives what the plain loops over segments give."""

import dataclasses

import numpy as np
import pytest
from conftest import hilly_scan
from hypothesis import given, settings
from hypothesis import strategies as st
from test_growth import random_frame as random_candidates
from test_objective import N_CLASSES, THETAS, TYPICAL
from test_objective import random_frame as random_training_frame

from gp_ground_seg import Config, GroundSegmenter
from gp_ground_seg.gp import numpy_backend
from gp_ground_seg.gp.batched import grow_surface_batched, latent_rows_batched
from gp_ground_seg.gp.batched_objective import objective_batched
from gp_ground_seg.gp.growth import grow_surface_reference
from gp_ground_seg.gp.latent import latent_rows_reference
from gp_ground_seg.gp.objective import objective_reference
from gp_ground_seg.gp.padding import SEGMENTS_PER_BATCH, Padded, batches
from gp_ground_seg.parameters.config import GrowthConfig

SEEDS = st.integers(0, 100_000)
# None, some, and more than go into one batch.
N_SEGMENTS = st.sampled_from([1, 2, 7, SEGMENTS_PER_BATCH + 3, 3 * SEGMENTS_PER_BATCH])


@given(st.lists(st.integers(0, 20), max_size=100))
def test_batches_hold_every_segment_once_and_like_sizes_together(counts):
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


@settings(max_examples=50)
@given(SEEDS, N_SEGMENTS, st.sampled_from([0.0, 0.05]), st.booleans())
def test_growth(seed, n_segments, slope_std, with_knots):
    frame = random_candidates(seed, n_segments)
    if not with_knots:
        frame = (*frame[:6], np.empty(0), np.empty((n_segments, 0)))
    # Every segment may have its own.
    ends = (0.1, 0.5), (0.1, 0.03), (0.02, 0.2)
    noise = [np.linspace(*both, n_segments) for both in ends]
    expected = grow_surface_reference(*frame, *noise, slope_std, GrowthConfig())
    found = grow_surface_batched(*frame, *noise, slope_std, GrowthConfig())
    np.testing.assert_array_equal(found[0], expected[0])
    np.testing.assert_allclose(found[1], expected[1], atol=1e-9)
    np.testing.assert_allclose(found[2], expected[2], atol=1e-7)


@settings(max_examples=50)
@given(SEEDS, N_SEGMENTS)
def test_latent_rows(seed, n_segments):
    rng = np.random.default_rng(seed)
    counts = rng.integers(0, 30, n_segments)
    bar_counts = np.where(counts > 0, rng.integers(1, 9, n_segments), 0)
    arguments = (
        TYPICAL + rng.normal(0.0, 0.2, (n_segments, len(TYPICAL))),
        np.concatenate([[0], np.cumsum(bar_counts)]),
        rng.uniform(3, 50, bar_counts.sum()),
        rng.integers(0, N_CLASSES, bar_counts.sum()),
        np.concatenate([[0], np.cumsum(counts)]),
        rng.uniform(3, 50, counts.sum()),
        np.linspace(2.0, 60.0, 9),
        rng.integers(0, 10, n_segments),
    )
    for found, expected in zip(
        latent_rows_batched(*arguments), latent_rows_reference(*arguments), strict=True
    ):
        np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9)


def assert_same_objective(theta, frame, slope_std, latent_terms):
    expected = objective_reference(theta, frame, slope_std, latent_terms)
    found = objective_batched(theta, frame, slope_std, latent_terms)
    assert found[0] == pytest.approx(expected[0], rel=1e-9, abs=1e-9)
    scale = np.abs(expected[1]).max()
    np.testing.assert_allclose(found[1], expected[1], rtol=1e-7, atol=1e-9 * max(scale, 1.0))


@settings(max_examples=50)
@given(SEEDS, N_SEGMENTS, st.booleans(), st.booleans(), st.sampled_from([0.0, 0.05]))
def test_objective_and_gradient(seed, n_segments, latent, latent_terms, slope_std):
    frame = random_training_frame(seed, n_segments, latent)
    assert_same_objective(TYPICAL, frame, slope_std, latent_terms)


@pytest.mark.parametrize('name', THETAS)
def test_objective_near_bounds(name):
    assert_same_objective(THETAS[name], random_training_frame(1), 0.05, True)


def test_segments_without_pseudo_inputs_keep_their_length_scales():
    frame = random_training_frame(4)
    offsets = frame.bar_offsets.copy()
    gone = slice(offsets[2], offsets[3])
    offsets[3:] -= gone.stop - gone.start
    mixed = dataclasses.replace(
        frame,
        bar_offsets=offsets,
        r_bar=np.delete(frame.r_bar, gone),
        surface_class=np.delete(frame.surface_class, gone),
    )
    assert np.diff(mixed.bar_offsets)[2] == 0 < np.diff(mixed.offsets)[2]
    assert_same_objective(TYPICAL, mixed, 0.05, False)


def test_an_impossible_covariance_is_minus_infinity():
    frame = random_training_frame(0)
    hopeless = dataclasses.replace(frame, z=np.full(len(frame.z), np.nan))
    value, gradient = objective_batched(TYPICAL, hopeless, 0.05, False)
    assert value == -np.inf
    assert not gradient.any()
    twice = dataclasses.replace(frame, r=np.full(len(frame.r), 5.0))
    without_noise = TYPICAL.copy()
    without_noise[1] = -400.0
    assert objective_batched(without_noise, twice, 0.0, False)[0] == -np.inf


@pytest.mark.parametrize('model', ['latent', 'line_gradient', 'constant'])
@pytest.mark.parametrize('mode', ['fixed', 'every_frame'])
def test_frames_are_labelled_as_by_the_loops(monkeypatch, mode, model):
    config = Config().replace(
        **{'runtime.backend': 'numpy', 'learning.mode': mode, 'length_scale.model': model}
    )
    points = hilly_scan(3000)
    found = GroundSegmenter(config).segment(points)
    monkeypatch.setattr(numpy_backend, 'grow_surface_batched', grow_surface_reference)
    monkeypatch.setattr(numpy_backend, 'latent_rows_batched', latent_rows_reference)
    monkeypatch.setattr(numpy_backend, 'objective_batched', objective_reference)
    expected = GroundSegmenter(config).segment(points)
    np.testing.assert_array_equal(found.label, expected.label)
    np.testing.assert_allclose(found.ground_z, expected.ground_z, atol=1e-6)
    np.testing.assert_allclose(found.theta, expected.theta, atol=1e-6)
