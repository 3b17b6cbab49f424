"""Length-scales, inlier growth and the surface: both backends against loops."""

from functools import cache

import numpy as np
import pytest
import reference_gp
from conftest import fewer, hilly_scan
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import norm

from gp_ground_seg import Config
from gp_ground_seg.core.backend import NumpyBackend
from gp_ground_seg.core.frame import Frame
from gp_ground_seg.core.gp.evidence import ODDS, highest_ground, seeds
from gp_ground_seg.core.gp.ground import ODDS_IN_FACE, noise_in_doubt
from gp_ground_seg.core.gp.learning import given_theta

# Compiled code predicts in single precision: errors of length-scale, mean, std in tests.
TOLERANCES = {'numpy': (1e-9, 1e-7, 1e-5), 'numba': (1e-5, 1e-5, 1e-5)}


def frame_of(xyz, config):
    scan = NumpyBackend().build_grid(np.asarray(xyz, dtype=float), config)
    faces = NumpyBackend().find_faces(scan, config)
    found = NumpyBackend().extract_lines(scan.candidates, faces, config)
    return Frame(*found, scan.grid.edges, prior_mean=-1.73)


def config_of(model='latent', slope_std=0.05, look_aside=False, **growth):
    values = {f'growth.{name}': value for name, value in growth.items()}
    return Config().replace(
        **values,
        **{
            'grid.r_max': 90.0,
            'length_scale.model': model,
            'length_scale.constant': 8.0,
            'observation.sigma_f': 0.2,
            'observation.sigma_n': 0.07,
            'observation.slope_std': slope_std,
            'surface.look_aside': look_aside,
        },
    )


@cache
def surface_by_the_loops(seed):
    """Arguments of a surface and what the loops make of them, for each backend in turn."""
    rng = np.random.default_rng(seed)
    model = rng.choice(['latent', 'latent', 'line_gradient', 'constant'])
    # Fewer segments than fit into one batch, or more; some of them empty.
    config = config_of(model, rng.choice([0.0, 0.05]), bool(rng.integers(0, 2))).replace(
        **{'grid.n_segments': int(rng.choice([5, 7, 35, fewer(96, 12)])), 'grid.n_bins': 80}
    )
    xyz = hilly_scan(int(rng.choice([0, 30, 900])), seed)
    config = config.replace(**{
        'label.rule': str(rng.choice(['roughness', 'roughness', 'tolerance'])),
        'growth.max_std': float(rng.choice([0.1, 0.35, 1.0])),
        'growth.max_standardised_residual': float(rng.choice([1.0, 2.0, 8.0])),
        'growth.max_standardised_depth': float(rng.choice([2.0, 4.0])),
        'growth.seed_range': float(rng.choice([5.5, 20.0])),
        'growth.seed_height_tolerance': float(rng.choice([0.2, 0.45])),
    })  # fmt: skip
    frame = frame_of(xyz[rng.random() * xyz[:, 1] > -5.0], config)
    if rng.random() < 0.5:  # lines that are steep, as of walls, are followed too
        frame = frame._replace(continues_line=rng.random(len(frame.candidates.r)) < 0.5)
    theta = given_theta(config)
    theta += np.where(np.arange(6) < 5, 0.3, 1.0) * rng.normal(size=theta.shape)
    if rng.random() < 0.3:
        frame = frame._replace(knots=frame.knots[:0])
    arguments = frame, theta, config
    return arguments, reference_gp.estimate_surface(*arguments)


@pytest.mark.parametrize('seed', range(fewer(16, 6)))
def test_surfaces_are_the_reference(backend, seed):
    arguments, (expected, expected_knot_u, expected_u) = surface_by_the_loops(seed)
    found, knot_u, u = backend.estimate_surface(*arguments)
    np.testing.assert_array_equal(found.inlier, expected.inlier)
    of_u, of_mean, of_std = TOLERANCES[backend.name]
    np.testing.assert_allclose(knot_u, expected_knot_u, rtol=0.0, atol=of_u)
    np.testing.assert_allclose(u, expected_u, rtol=0.0, atol=of_u)
    np.testing.assert_allclose(found.mean, expected.mean, rtol=0.0, atol=of_mean)
    np.testing.assert_allclose(found.std, expected.std, rtol=0.0, atol=of_std)


@settings(max_examples=30)
@given(st.integers(0, 10_000), st.integers(1, 15), st.floats(0.0, 0.2))
def test_the_oracle_is_the_conditional_of_the_joint_gaussian(seed, n, slope_std):
    """Against the textbook form: invert the joint covariance, read off the block."""

    def conditional(joint, values):
        gain = np.linalg.solve(joint[:n, :n], joint[:n, n:]).T
        return gain @ values, np.diag(joint[n:, n:] - gain @ joint[:n, n:])

    rng = np.random.default_rng(seed)
    r, length_scale = rng.uniform(2, 60, n + 4), rng.uniform(0.5, 30, n + 4)
    noise, values = np.diag(np.arange(n + 4) < n), rng.normal(1.0, 0.5, n)
    joint = reference_gp.paciorek(r, length_scale, r, length_scale, 0.6)
    joint += slope_std**2 * np.outer(r, r) + 0.1**2 * noise
    at = (r[:n], values, length_scale[:n], r[n:], length_scale[n:], 0.6, 0.1, slope_std)
    for found, expected in zip(
        reference_gp.posterior(*at), conditional(joint, values), strict=True
    ):
        np.testing.assert_allclose(found, expected, atol=1e-9)
    latent = reference_gp.squared_exponential(r, r, 0.8, 4.0) + 0.3**2 * noise
    found = reference_gp.log_length_scale(r[:n], values, r[n:], 0.8, 4.0, 0.3)
    mean = values.mean()
    np.testing.assert_allclose(found, mean + conditional(latent, values - mean)[0], atol=1e-9)


@pytest.mark.parametrize(('rule', 'n_shown'), [('roughness', 1), ('tolerance', 3)])
def test_candidates_close_together_show_as_much_as_one(backend, rule, n_shown):
    config = config_of('constant', slope_std=0.0).replace(
        **{'length_scale.constant': 50.0, 'label.rule': rule}
    )
    sigma_f, sigma_n = np.exp(given_theta(config)[:2])
    for r, n in ([4.0, 4.75, 5.5], n_shown), ([4.0, 8.0, 12.0], 3):
        r = np.array(r)
        frame = frame_of(np.column_stack([r, 0.01 * r, np.full(3, -1.73)]), config)
        surface, *_ = backend.estimate_surface(frame, given_theta(config), config)
        assert surface.inlier.all() and len(surface.inlier) == 3
        expected = (1.0 / sigma_f**2 + n / sigma_n**2) ** -0.5
        std = surface.std[frame.candidates.segment[0]]
        assert np.nanmin(std) == pytest.approx(expected, rel=0.02)


def test_rounding_beside_little_noise_is_no_fault(backend):
    config = config_of('constant', slope_std=2.0).replace(
        **{
            'length_scale.constant': 30.0,
            'observation.sigma_f': 10.0,
            'grid.r_max': 500.0,
            'faces.cell_size': 1.0,
        }
    )
    r = np.arange(3.0, 499.0)
    frame = frame_of(np.column_stack([r, 0.01 * r, np.full_like(r, -1.73)]), config)
    theta = given_theta(config)
    theta[1] = np.log(1e-5)
    surface, *_ = backend.estimate_surface(frame, theta, config)
    m = frame.candidates.segment[0]
    assert surface.inlier.all()
    rounding = {'numpy': 1e-3, 'numba': 1e-2}[backend.name]
    np.testing.assert_allclose(surface.mean[m], -1.73, atol=rounding)


def ring_of_ground(backend, lift, **values):
    """Surface of 180 segments of level ground, eight of them with a car of height `lift` [m]."""
    config = config_of(seed_height_tolerance=0.45, **values)
    azimuth = (np.arange(180) + 0.5) * 2.0 * np.pi / 180.0
    r, azimuth = (a.ravel() for a in np.meshgrid(np.arange(3.0, 30.0), azimuth))
    is_car = azimuth < 8 * 2.0 * np.pi / 180.0
    seen = ~is_car | (r < 7.0)
    r, azimuth, z = r[seen], azimuth[seen], np.where(is_car, lift - 1.73, -1.73)[seen]
    frame = frame_of(np.column_stack([r * np.cos(azimuth), r * np.sin(azimuth), z]), config)
    surface = backend.estimate_surface(frame, given_theta(config), config)[0]
    return frame.knots, surface, frame.candidates.z > 0.5 * lift - 1.73


def test_a_segment_without_a_model_gets_its_neighbours(backend):
    knots, surface, on_car = ring_of_ground(backend, 1.4, look_aside=True)
    _, alone, _ = ring_of_ground(backend, 1.4)
    (m,) = np.flatnonzero(np.isnan(alone.mean[:, 7]))[[4]]
    assert np.isfinite(surface.mean[:, 7]).all()
    assert surface.mean[m, 7] == pytest.approx(-1.73, abs=0.02)
    # As uncertain as the ground on either side is far away.
    arc = knots[7] * 2.0 * np.pi / 180.0 * 4.5
    assert 0.5 * arc * 0.05 < surface.std[m, 7] < 0.05 + arc * 0.05
    assert not surface.inlier[on_car].any() and surface.inlier[~on_car].all()


def test_what_stands_over_the_ground_beside_it_starts_nothing(backend):
    # 0.4 m over the plane is low enough for a seed: by itself the segment would grow on it. Three
    # of the 32 are in a tile that reaches down to the road: a face, whose lowest is no candidate.
    _, surface, on_car = ring_of_ground(backend, 0.4, look_aside=True)
    assert on_car.sum() == 29 and not surface.inlier[on_car].any()
    assert surface.inlier[~on_car].all()
    _, alone, _ = ring_of_ground(backend, 0.4)
    assert alone.inlier.all()


@given(
    st.floats(0.01, 1.0),
    st.floats(1e-3, 0.35),
    st.floats(1e-3, 0.2),
    st.booleans(),
    st.floats(ODDS, 10.0),
)
def test_what_joins_in_doubt_shows_as_much_as_it_is_likely_ground(
    residual, std, noise, in_face, odds
):
    variance, noise = std**2, noise**2
    found = noise_in_doubt(residual, 0.0, variance, noise, in_face, odds)
    density = norm.pdf(residual, scale=np.sqrt(variance + noise))
    likely = density / (density + (max(odds, ODDS_IN_FACE) if in_face else odds))
    taken, certain = (variance**2 / (variance + n) for n in (found, noise))
    assert taken == pytest.approx(likely * certain, rel=1e-6, abs=1e-12)
    # Obstacles stand above the ground.
    assert noise_in_doubt(-residual, 0.0, variance, noise, in_face, odds) == noise


def frame_of_a_sill(n_walls):
    """Frame of level ground, 90 of its segments with a sill at 8 m, and some with a wall."""
    config = config_of('constant', seed_height_tolerance=0.3, look_aside=True)
    segment, r = (a.ravel() for a in np.meshgrid(np.arange(180), np.arange(3.0, 20.0)))
    z = np.where(segment < 90, np.where(r == 8.0, 0.4, 0.0), 0.0)
    z[(segment >= 180 - n_walls) & (r >= 8.0)] = 1.5
    # The sill lies between two rings, and hides what is behind it.
    seen = (segment >= 90) | (r < 5.0) | (r == 8.0)
    azimuth = (segment + 0.5) * 2.0 * np.pi / 180.0
    xyz = np.column_stack([r * np.cos(azimuth), r * np.sin(azimuth), z - 1.73])[seen]
    return frame_of(xyz, config), config


def test_ground_rises_around_the_ring_to_both_sides_by_the_arc():
    config = config_of().replace(**{'grid.n_segments': 12})
    n_segments, r = 12, config.grid.r_min + 0.01  # in the first bin: no way is shorter
    azimuth = (np.arange(n_segments) + 0.5) * 2.0 * np.pi / n_segments
    ring = np.column_stack([r * np.cos(azimuth), r * np.sin(azimuth), np.full(n_segments, -1.73)])
    frame = frame_of(ring, config)
    segment = frame.candidates.segment
    for start in (0, 5, 11):
        highest = highest_ground(frame, np.zeros(n_segments), segment == start, max_slope=0.1)
        steps = np.abs((segment - start + 6) % n_segments - 6)
        arc = frame.knots[frame.candidates.bin] * 2.0 * np.pi / n_segments
        np.testing.assert_allclose(highest, 0.1 * arc * steps)


@pytest.mark.parametrize('n_walls', [0, 20, 70])
def test_the_odds_of_an_obstacle_are_those_of_the_frame(n_walls):
    frame, config = frame_of_a_sill(n_walls)
    stands = frame.candidates.z > -1.0
    odds = seeds(frame, given_theta(config), config)[1]
    assert odds == pytest.approx(max(stands.sum() / (~stands).sum(), ODDS), rel=0.02)


def test_among_many_obstacles_sills_lift_less(backend):
    def lifted(n_walls):
        frame, config = frame_of_a_sill(n_walls)
        config = config.replace(**{'observation.sigma_f': 0.35})
        surface = backend.estimate_surface(frame, given_theta(config), config)[0]
        return surface.mean[135, np.searchsorted(frame.knots, 8.0)] + 1.73

    assert lifted(85) < 0.7 * lifted(0)
