import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gp_ground_seg.compiled.growth_compiled import grow_surface_compiled
from gp_ground_seg.gp.growth import grow_surface_reference
from gp_ground_seg.parameters.config import GrowthConfig

KNOTS = np.linspace(2.0, 60.0, 30)


def random_frame(seed, n_segments=5):
    """Ragged segments of gentle ground with a fifth of the candidates lifted off it."""
    rng = np.random.default_rng(seed)
    counts = rng.integers(0, 30, n_segments)
    offsets = np.concatenate([[0], np.cumsum(counts)])
    r = np.concatenate([np.sort(rng.uniform(2, 50, n)) for n in counts] or [np.empty(0)])
    z = 0.05 * np.sin(0.2 * r) + rng.normal(0, 0.03, len(r))
    lifted = rng.random(len(r)) < 0.2
    z[lifted] += rng.uniform(0.4, 2.0, lifted.sum())
    length_scale = rng.uniform(1.0, 12.0, len(r))
    knot_length_scale = rng.uniform(1.0, 12.0, (n_segments, len(KNOTS)))
    n_wanted = rng.integers(0, len(KNOTS) + 1, (n_segments, 1))
    knot_length_scale[np.arange(len(KNOTS)) >= n_wanted] = np.nan
    seed_mask = (r < 15.0) & (np.abs(z) < 0.2)
    follows = rng.random(len(r)) < 0.3
    follows[offsets[:-1][counts > 0]] = False
    return offsets, r, z, length_scale, seed_mask, follows, KNOTS, knot_length_scale


def compiled(frame, growth, chunks=1, sigma_f=None, sigma_n=None, gate_noise=None, slope_std=0.05):
    offsets, r = frame[0], frame[1]
    n_segments = len(offsets) - 1
    sigma_f = np.full(n_segments, 0.2) if sigma_f is None else sigma_f
    sigma_n = np.full(n_segments, 0.07) if sigma_n is None else sigma_n
    gate_noise = sigma_n if gate_noise is None else gate_noise
    inlier = np.ones(len(r), dtype=bool)
    mean, std = np.zeros((2, n_segments, len(KNOTS)))
    for start, stop in zip(
        np.linspace(0, n_segments, chunks + 1)[:-1].astype(int),
        np.linspace(0, n_segments, chunks + 1)[1:].astype(int),
        strict=True,
    ):
        grow_surface_compiled(
            start,
            stop,
            *frame[:3],
            np.log(frame[3]),
            *frame[4:7],
            np.log(frame[7]),
            sigma_f,
            sigma_n,
            gate_noise,
            slope_std,
            growth.max_std,
            growth.max_standardised_residual,
            growth.max_standardised_depth,
            inlier,
            mean,
            std,
        )
    return inlier, mean, std


@settings(deadline=None)
@given(st.integers(0, 100_000), st.sampled_from([0.0, 0.05]))
def test_appending_rows_gives_what_refitting_gives(seed, slope_std):
    frame = random_frame(seed)
    # Every segment may have its own.
    sigma_f, sigma_n = np.linspace(0.1, 0.5, 5), np.linspace(0.1, 0.03, 5)
    noise = {'sigma_f': sigma_f, 'sigma_n': sigma_n, 'gate_noise': np.linspace(0.02, 0.2, 5)}
    growth = GrowthConfig()
    expected = grow_surface_reference(*frame, *noise.values(), slope_std, growth)
    found = compiled(frame, growth, **noise, slope_std=slope_std)
    np.testing.assert_array_equal(found[0], expected[0])
    np.testing.assert_allclose(found[1], expected[1], atol=1e-8)
    np.testing.assert_allclose(found[2], expected[2], atol=1e-6)


def test_chunks_do_not_matter():
    frame = random_frame(3, n_segments=12)
    whole = compiled(frame, GrowthConfig())
    parts = compiled(frame, GrowthConfig(), chunks=5)
    for a, b in zip(whole, parts, strict=True):
        np.testing.assert_array_equal(a, b)


def grow_line(z, r=None, seed=None, follows=None, **bounds):
    r = np.arange(3.0, 3.0 + len(z)) if r is None else r
    seed = np.arange(len(z)) < 3 if seed is None else seed
    flat = np.full(len(z), 8.0)
    return grow_surface_reference(
        np.array([0, len(z)]),
        r,
        np.asarray(z, dtype=float),
        flat,
        seed,
        np.zeros(len(z), dtype=bool) if follows is None else follows,
        KNOTS,
        np.full((1, len(KNOTS)), 8.0),
        np.array([0.2]),
        np.array([0.07]),
        np.array([0.07]),
        0.05,
        GrowthConfig(**bounds),
    )


def test_growth_follows_ground_and_leaves_obstacles_out():
    z = np.zeros(20)
    z[8:11] = 1.0
    inlier, mean, _ = grow_line(z)
    assert list(np.flatnonzero(~inlier)) == [8, 9, 10]
    assert np.abs(mean[0, KNOTS < 20]).max() < 0.02


def test_growth_stops_where_the_surface_is_uncertain():
    r = np.concatenate([np.arange(3.0, 10.0), [60.0]])
    inlier, _, std = grow_line(np.zeros(8), r=r)
    assert list(inlier) == [True] * 7 + [False]
    assert std[0, -1] > GrowthConfig().max_std


def test_no_seed_no_model():
    inlier, mean, std = grow_line(np.zeros(5), seed=np.zeros(5, dtype=bool))
    assert not inlier.any()
    assert np.isnan(mean).all()
    assert np.isnan(std).all()


def test_looser_bounds_take_more():
    z = np.where(np.arange(20) % 4 == 3, 0.35, 0.0)
    strict = grow_line(z, max_standardised_residual=1.0)[0].sum()
    loose = grow_line(z, max_standardised_residual=8.0)[0].sum()
    assert strict < loose == pytest.approx(20)


def test_what_lies_below_is_believed_sooner_than_what_lies_above():
    z = np.zeros(12)
    # Beside the seeds, where the surface is certain.
    z[3] = 0.3
    assert list(np.flatnonzero(~grow_line(z)[0])) == [3]
    assert grow_line(-z)[0].all()
    assert list(np.flatnonzero(~grow_line(-z, max_standardised_depth=2.0)[0])) == [3]


def test_a_line_is_followed_from_inliers_on_wherever_it_leads():
    z = np.concatenate([np.zeros(6), 0.8 * np.arange(1.0, 9.0)])
    follows = np.arange(14) > 6
    assert list(np.flatnonzero(grow_line(z)[0])) == list(range(6))
    # The line begins at 6, which is no inlier: nothing to follow.
    assert list(np.flatnonzero(grow_line(z, follows=follows)[0])) == list(range(6))
    follows[5:] = True
    inlier, mean, _ = grow_line(z, follows=follows)
    assert inlier.all()
    assert mean[0, np.searchsorted(KNOTS, 14.0)] > 1.0
