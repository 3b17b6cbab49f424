"""Length-scales, inlier growth and the fused surface: both backends against loops."""

import numpy as np
import pytest
import reference
from conftest import fewer, sharing
from hypothesis import given, settings
from hypothesis import strategies as st

from gp_ground_seg import Config
from gp_ground_seg.compiled import ground as compiled_ground
from gp_ground_seg.frame import N_CLASSES, Candidates, Frame, Lines, PseudoInputs
from gp_ground_seg.gp.ground import fuse_neighbours
from gp_ground_seg.gp.latent import (
    given_log_length_scales,
    interpolate_along_segments,
    line_gradient_length_scale,
)
from gp_ground_seg.gp.learning import given_theta
from gp_ground_seg.gp.linalg import SEGMENTS_PER_BATCH
from gp_ground_seg.parameters.config import LengthScaleConfig

KNOTS = np.linspace(2.0, 60.0, 30)
# As the edges of the bins: for compiled code arrays that may be written to are another type.
KNOTS.setflags(write=False)


def frame_of(r, z, own_bin, counts, continues_line, lines=None, bar_counts=None, seed=0):
    """Frame with random pseudo-inputs; without `lines`, each candidate is one of its own."""
    rng, n = np.random.default_rng(seed), len(r)
    offsets = np.concatenate([[0], np.cumsum(counts)])
    bar_counts = np.minimum(counts, 1) if bar_counts is None else bar_counts
    r_bar = [np.empty(0), *(np.sort(rng.uniform(2, 50, k)) for k in bar_counts)]
    slope = np.where(rng.random(n) < 0.2, np.nan, rng.normal(0, 0.3, n))
    candidates = Candidates(r, z, own_bin, np.ones(n), offsets, np.zeros(n, np.int32))
    pseudo = PseudoInputs(
        np.concatenate(r_bar),
        rng.integers(0, N_CLASSES, bar_counts.sum()),
        np.concatenate([[0], np.cumsum(bar_counts)]),
        np.zeros(N_CLASSES),
    )
    lines = Lines(np.arange(n), slope, np.arange(n + 1)) if lines is None else lines
    return Frame(candidates, lines, pseudo, continues_line, KNOTS, -1.7)


def random_frame(seed, n_segments=5):
    """Ragged segments of gentle ground with a fifth of the candidates lifted off it; theta."""
    rng = np.random.default_rng(seed)
    counts = rng.integers(0, 30, n_segments)
    r = np.concatenate([np.sort(rng.uniform(2, 50, n)) for n in counts])
    z = 0.05 * np.sin(0.2 * r) + rng.normal(0, 0.03, len(r)) - 1.7
    lifted = rng.random(len(r)) < 0.2
    z[lifted] += rng.uniform(0.4, 2.0, lifted.sum())
    own_bin = [np.sort(rng.integers(0, len(KNOTS), n)) for n in counts]
    continues_line = rng.random(len(r)) < 0.3
    continues_line[(np.cumsum(counts) - counts)[counts > 0]] = False
    bar_counts = np.where(counts > 0, rng.integers(1, 9, n_segments), 0)
    frame = frame_of(
        r, z, np.concatenate(own_bin), counts, continues_line, bar_counts=bar_counts, seed=seed
    )
    # Each segment has its own.
    scalars = np.linspace([0.1, 0.1, 0.6, 2.0, 0.2], [0.5, 0.03, 1.2, 5.0, 0.4], n_segments)
    classes = rng.uniform(1.0, 12.0, (n_segments, N_CLASSES))
    return frame, np.log(np.hstack([scalars, classes]))


def config_of(model='latent', slope_std=0.05, n_neighbours=0, **growth):
    values = {f'growth.{name}': value for name, value in growth.items()}
    return Config().replace(
        **values,
        **{
            'length_scale.model': model,
            'length_scale.constant': 8.0,
            'observation.sigma_f': 0.2,
            'observation.sigma_n': 0.07,
            'observation.slope_std': slope_std,
            'surface.n_neighbours': n_neighbours,
        },
    )


@settings(max_examples=fewer(60, 6))
@given(
    st.integers(0, 100_000),
    # None, some, and more than fit into one batch.
    st.sampled_from([1, 2, 7, SEGMENTS_PER_BATCH + 3, 3 * SEGMENTS_PER_BATCH]),
    st.sampled_from(['latent', 'latent', 'line_gradient', 'constant']),
    st.sampled_from([0.0, 0.05]),
    st.integers(0, 2),
    st.sampled_from([1, 3]),
    st.booleans(),
)
def test_surfaces_are_the_reference(
    backend, seed, n_segments, model, slope_std, n_neighbours, step, with_knots
):
    frame, theta = random_frame(seed, n_segments)
    if not with_knots:
        frame = frame._replace(knots=KNOTS[:0])
    config = config_of(model, slope_std, n_neighbours, seed_height_tolerance=0.2)
    found, knot_u = backend.estimate_surface(frame, theta, config, step)
    expected, expected_u = reference.estimate_surface(frame, theta, config, step)
    np.testing.assert_array_equal(found.inlier, expected.inlier)
    assert not found.inlier[frame.candidates.segment % step > 0].any()
    np.testing.assert_allclose(knot_u, expected_u, atol=1e-9)
    np.testing.assert_allclose(found.mean, expected.mean, atol=1e-8)
    np.testing.assert_allclose(found.std, expected.std, atol=1e-6)


def test_threads_do_not_change_a_bit():
    frame, theta = random_frame(3, n_segments=fewer(120, 12))
    results = []
    for n_threads in (1, 2, 3, 7):
        with sharing(n_threads) as backend:
            surface, u = backend.estimate_surface(frame, theta, config_of(n_neighbours=2))
            results.append((surface.mean, surface.std, surface.inlier, u.copy()))
    for other in results[1:]:
        for a, b in zip(results[0], other, strict=True):
            np.testing.assert_array_equal(a, b)


# Length-scales


def test_latent_mean_is_the_conditional_of_the_joint_gaussian():
    rng = np.random.default_rng(2)
    r_bar, r = np.sort(rng.uniform(3, 40, 6)), rng.uniform(3, 60, 9)
    l_bar = rng.normal(1.0, 0.5, 6)
    b = reference.squared_exponential(r_bar, r_bar, 0.8, 4.0) + 0.3**2 * np.eye(6)
    gain = reference.squared_exponential(r, r_bar, 0.8, 4.0) @ np.linalg.inv(b)
    expected = l_bar.mean() + gain @ (l_bar - l_bar.mean())
    found = reference.log_length_scale(r_bar, l_bar, r, 0.8, 4.0, 0.3)
    np.testing.assert_allclose(found, expected)


def test_equal_pseudo_inputs_give_that_length_scale_everywhere(backend):
    frame, theta = random_frame(1)
    theta[:, 5:] = 1.3
    u = backend.estimate_surface(frame, theta, config_of())[1]
    assert np.isfinite(u).any()
    np.testing.assert_allclose(u[np.isfinite(u)], 1.3, rtol=1e-13)


def test_line_gradient_formula_flat_limit_and_bounds():
    parameters = LengthScaleConfig(gradient_gain=2.0, flat_gradient=0.05, min=0.5, max=5.0)
    slopes = np.array([0.0, 0.05, -0.2, 0.9, 3.0, np.nan, np.inf])
    flat = 2.0 * np.log(1 / 0.05)
    expected = [min(flat, 5.0), min(flat, 5.0), 2.0 * np.log(5.0), 0.5, 0.5, 0.5, 0.5]
    np.testing.assert_allclose(line_gradient_length_scale(slopes, parameters), expected)


def test_given_length_scales_at_candidates_and_knots():
    r, lines = np.array([2.0, 4.0, 8.0, 5.0]), np.array([0, 0, 1, 2])
    lines = Lines(lines, np.array([0.0, 0.5, np.nan]), np.array([0, 2, 3, 4]))
    nothing = np.zeros(4, dtype=bool)
    frame = frame_of(r, 0.0 * r, np.array([0, 1, 5, 9]), np.array([3, 0, 1]), nothing, lines)
    gradient = LengthScaleConfig(model='line_gradient')
    by_line = np.log(line_gradient_length_scale(lines.slope, gradient))
    u, at_knots = given_log_length_scales(frame, gradient)
    np.testing.assert_allclose(u, by_line[[0, 0, 1, 2]])
    assert list(np.isfinite(at_knots).sum(axis=1)) == [7, 0, 11]
    constant = given_log_length_scales(frame, LengthScaleConfig(model='constant', constant=7.0))[0]
    assert list(constant) == [np.log(7.0)] * 4
    value, knots = np.array([1.0, 3.0, -1.0, 6.0]), np.linspace(0.0, 100.0, 33)
    table = interpolate_along_segments(frame.candidates, value, knots)
    np.testing.assert_allclose(table[0], np.interp(knots, r[:3], value[:3]))
    assert np.isnan(table[1]).all()
    assert table[2] == pytest.approx(np.full(33, 6.0))


# Posterior


@settings(max_examples=30)
@given(st.integers(0, 10_000), st.integers(1, 15), st.floats(0.0, 0.2))
def test_posterior_is_the_conditional_of_the_joint_gaussian(seed, n, slope_std):
    """Against the textbook form: invert the joint covariance, read off the block."""
    rng = np.random.default_rng(seed)
    r, length_scale = rng.uniform(2, 60, n + 4), rng.uniform(0.5, 30, n + 4)
    z = np.sin(r[:n])
    joint = reference.paciorek(r, length_scale, r, length_scale, 0.6)
    joint += slope_std**2 * np.outer(r, r)
    joint[:n, :n] += 0.1**2 * np.eye(n)
    gain = np.linalg.solve(joint[:n, :n], joint[:n, n:]).T
    data, at = (r[:n], z, length_scale[:n]), (r[n:], length_scale[n:])
    mean, variance = reference.posterior(*data, *at, 0.6, 0.1, slope_std)
    np.testing.assert_allclose(mean, gain @ z, atol=1e-9)
    np.testing.assert_allclose(variance, np.diag(joint[n:, n:] - gain @ joint[:n, n:]), atol=1e-9)


# Growth


def grow_line(backend, z, r=None, continues=(), slope_std=0.05, **bounds):
    """Inliers, mean and std of one segment; those up to 5.5 m within 0.25 m are seeds."""
    z = np.asarray(z, dtype=float) - 1.7
    r = np.arange(3.0, 3.0 + len(z)) if r is None else np.asarray(r, dtype=float)
    own_bin = np.arange(len(z)) + len(KNOTS) - len(z) - 1
    continues_line = np.isin(np.arange(len(z)), continues)
    frame = frame_of(r, z, own_bin, np.array([len(z)]), continues_line)
    seeds = {'seed_range': 5.5, 'seed_height_tolerance': 0.25}
    config = config_of('constant', slope_std, **{**seeds, **bounds})
    surface, _ = backend.estimate_surface(frame, given_theta(frame, config), config)
    return list(np.flatnonzero(surface.inlier)), surface.mean[0] + 1.7, surface.std[0]


def test_growth_follows_ground_and_leaves_obstacles_out(backend):
    z = np.zeros(20)
    z[8:11] = 1.0
    inlier, mean, _ = grow_line(backend, z)
    assert inlier == [*range(8), *range(11, 20)]
    assert np.nanmax(np.abs(mean[KNOTS < 20])) < 0.02


def test_growth_stops_where_the_surface_is_uncertain(backend):
    inlier, _, std = grow_line(backend, np.zeros(8), r=[*range(3, 10), 60.0])
    assert inlier == list(range(7))
    assert np.nanmax(std) > Config().growth.max_std
    # Far from data the mean follows the slope, and is the less certain for it.
    rising = 0.05 * np.arange(3.0, 10.0)
    ends = [grow_line(backend, rising, slope_std=s, seed_range=20.0) for s in (0.1, 0.0)]
    last = np.flatnonzero(np.isfinite(ends[0][1]))[-1]
    assert ends[0][1][last] == pytest.approx(0.05 * KNOTS[last], abs=0.5)
    assert ends[1][1][last] == pytest.approx(0.0, abs=1e-3)
    assert ends[0][2][last] > ends[1][2][last]


def test_no_seed_no_model(backend):
    inlier, mean, std = grow_line(backend, np.full(5, 5.0))
    assert inlier == []
    assert np.isnan(mean).all() and np.isnan(std).all()


def test_looser_bounds_take_more(backend):
    z = np.where(np.arange(20) % 4 == 3, 0.35, 0.0)
    strict, loose = (
        len(grow_line(backend, z, max_standardised_residual=limit)[0]) for limit in (1.0, 8.0)
    )
    assert strict < loose == 20


def test_below_the_prediction_the_gate_is_wider_than_above(backend):
    z = np.zeros(12)
    # Beside the seeds, where the surface is certain.
    z[3] = 0.3
    without = [0, 1, 2, *range(4, 12)]
    assert grow_line(backend, z)[0] == without
    assert len(grow_line(backend, -z)[0]) == 12
    assert grow_line(backend, -z, max_standardised_depth=2.0)[0] == without


def test_a_line_is_followed_from_inliers_on(backend):
    z = np.concatenate([np.zeros(6), 0.8 * np.arange(1.0, 9.0)])
    assert grow_line(backend, z)[0] == list(range(6))
    # The line begins at 6, which is no inlier: nothing to continue.
    assert grow_line(backend, z, continues=range(7, 14))[0] == list(range(6))
    inlier, mean, _ = grow_line(backend, z, continues=range(5, 14))
    assert inlier == list(range(14))
    assert mean[np.searchsorted(KNOTS, 14.0)] > 1.0


# Fusion of neighbours


@pytest.fixture(params=['numpy', 'numba'])
def fuse(request):
    """Compute mean and std of fused surfaces."""

    def compiled(mean, std, knots, n_neighbours, slope_std):
        changes = {'surface.n_neighbours': n_neighbours, 'observation.slope_std': slope_std}
        params = compiled_ground.GroundParams.of(Config().replace(**changes), 1)
        n_knots = np.isfinite(mean).sum(axis=1)
        own = compiled_ground.SegmentSurfaces(
            np.empty(0), mean, np.empty(0, dtype=bool), mean, std, n_knots
        )
        fused = np.empty((2, *mean.shape))
        compiled_ground.fuse_neighbours(own, knots, params, -1.7, *fused)
        return fused[0] + 1.7, fused[1]

    return fuse_neighbours if request.param == 'numpy' else compiled


RANGES = np.array([2.0, 4.0, 6.0, 8.0, 10.0])
RANGES.setflags(write=False)


def test_fusing_weighs_by_certainty_and_distance(fuse):
    equal, equal_std = fuse(np.full((6, 5), 0.3), np.full((6, 5), 0.1), RANGES, 2, 0.05)
    np.testing.assert_allclose(equal, 0.3)
    assert (equal_std < 0.1).all()
    mean = np.zeros((8, 5))
    mean[3] = 1.0
    fused, _ = fuse(mean, np.full((8, 5), 0.1), RANGES, 1, 0.1)
    aside = 0.1 * RANGES * 2 * np.pi / 8
    weights = np.array([1 / (0.1**2 + aside**2), np.full(5, 1 / 0.1**2)])
    np.testing.assert_allclose(fused[3], weights[1] / (weights[1] + 2 * weights[0]))
    assert (np.diff(fused[3]) > 0).all()
    np.testing.assert_allclose(fused[6], 0.0, atol=1e-15)


def test_a_segment_without_a_model_gets_its_neighbours(fuse):
    mean, std = np.full((8, 5), 0.4), np.full((8, 5), 0.1)
    mean[:4] = std[:4] = np.nan
    fused, fused_std = fuse(mean, std, RANGES, 1, 0.05)
    np.testing.assert_allclose(fused[[0, 3]], 0.4)
    assert (fused_std[[0, 3]] > 0.1).all()
    assert np.isnan(fused[1:3]).all()
    np.testing.assert_allclose(fuse(mean, std, RANGES, 0, 0.05)[0], mean, rtol=1e-12)


@pytest.mark.parametrize('seed', range(12))
@pytest.mark.parametrize('n_neighbours', [0, 1, 3])
def test_fusing_is_the_reference(fuse, seed, n_neighbours):
    rng = np.random.default_rng(seed)
    mean, std = rng.normal(0, 0.3, (9, 5)), rng.uniform(0, 0.5, (9, 5))
    std[:, 2] = 0.0
    # Some segments have no model at all, some up to a knot.
    for m, n in enumerate(rng.integers(0, 6, 9) * rng.integers(0, 2, 9)):
        mean[m, n:] = std[m, n:] = np.nan
    found = fuse(mean, std, RANGES, n_neighbours, 0.05)
    for a, b in zip(found, reference.fuse(mean, std, RANGES, n_neighbours, 0.05), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-12)
