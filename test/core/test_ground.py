"""Length-scales, inlier growth and the surface: both backends against loops."""

from functools import cache

import numpy as np
import pytest
import reference_gp
from conftest import fewer, hilly_scan

from gp_ground_seg import Config
from gp_ground_seg.core.backend import NumpyBackend
from gp_ground_seg.core.frame import Frame
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
    xyz = hilly_scan(int(rng.choice([30, 900, 900])) * (seed > 0), seed)
    if seed % 2:  # a sill, 0.4 m high, hides what is behind it
        r = np.hypot(xyz[:, 0], xyz[:, 1])
        behind = (xyz[:, 0] > 0.0) & (r > 6.0)
        xyz[behind, :2] *= (6.0 / r[behind])[:, None]
        xyz[behind, 2] = -1.33
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
