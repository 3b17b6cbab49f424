"""Length-scales, inlier growth and the surface: both backends, and the paper's rules by loops."""

import numpy as np
import pytest
import reference_gp
from conftest import BACKENDS, fewer, hilly_scan

from gp_ground_seg import Config, ConfigError, GroundSegmenter
from gp_ground_seg.core.backend import NumpyBackend
from gp_ground_seg.core.frame import Frame
from gp_ground_seg.core.gp.learning import given_theta

# Compiled code predicts in single precision: errors of length-scale, mean, std in tests.
TOLERANCES = {'numpy': (1e-9, 1e-7, 1e-5), 'numba': (1e-5, 1e-5, 1e-5)}


def frame_of(xyz, config):
    scan = NumpyBackend().build_grid(np.asarray(xyz, dtype=float), config)
    faces = NumpyBackend().find_faces(scan, 1.73, config)
    found = NumpyBackend().extract_lines(scan.candidates, faces, config)
    return Frame(*found, faces.is_face[found[0].tile], scan.grid.edges, prior_mean=-1.73)


def config_of(**changes):
    return Config().replace(**{
        'grid.r_max': 90.0,
        'length_scale.constant': 8.0,
        'observation.sigma_f': 0.2,
        'observation.sigma_n': 0.07,
        **changes,
    })  # fmt: skip


def draw_frame(seed, of_paper):
    """Arguments of a surface, with the rules of the paper alone or with ours."""
    rng = np.random.default_rng(seed)
    xyz = hilly_scan(int(rng.choice([30, 600, 600])) * (seed > 0), seed)
    has_sill = seed % 2 == 1
    if has_sill:  # 0.4 m high: it hides what is behind it, and is low enough for a seed
        r = np.hypot(xyz[:, 0], xyz[:, 1])
        behind = (xyz[:, 0] > 0.0) & (r > 6.0)
        xyz[behind, :2] *= (6.0 / r[behind])[:, None]
        xyz[behind, 2] = -1.33
    config = config_of(**{
        'length_scale.model': str(rng.choice(['latent', 'latent', 'line_gradient', 'constant'])),
        'observation.slope_std': 0.05 * (has_sill or int(rng.integers(0, 2))),
        'observation.slope_drift': 0.03 * int(rng.integers(0, 2)),
        'surface.look_aside': not of_paper,
        # Fewer segments than fit into one batch, or more; some of them empty.
        'grid.n_segments': int(rng.choice([5, 7, 35, fewer(96, 12)])),
        'grid.n_bins': 80,
        'label.rule': 'tolerance' if of_paper else 'roughness',
        'growth.max_slope': 0.0 if of_paper else float(rng.choice([0.1, 0.4])),
        'growth.max_std': float(rng.choice([0.1, 0.35, 1.0])),
        'growth.max_standardised_residual': float(rng.choice([1.0, 2.0, 8.0])),
        'growth.seed_range': float(rng.choice([5.5, 20.0])),
        'growth.seed_height_tolerance': 0.45 if has_sill else float(rng.choice([0.2, 0.45])),
    })  # fmt: skip
    frame = frame_of(xyz[rng.random() * xyz[:, 1] > -5.0], config)
    theta = given_theta(config)
    theta += np.where(np.arange(6) < 5, 0.3, 1.0) * rng.normal(size=theta.shape)
    if rng.random() < 0.3 and not has_sill:
        frame = frame._replace(knots=frame.knots[:0])
    return frame, theta, config


@pytest.mark.parametrize('of_paper', [True, False], ids=['paper', 'ours'])
@pytest.mark.parametrize('seed', range(fewer(16, 6)))
def test_backends_estimate_one_surface_and_the_paper_s_is_the_reference(
    compiled_code, seed, of_paper
):
    arguments = draw_frame(seed, of_paper)
    first, *others = [reference_gp, *BACKENDS] if of_paper else BACKENDS
    expected, *expected_u = first.estimate_surface(*arguments)
    for backend in others:
        found, *found_u = backend.estimate_surface(*arguments)
        np.testing.assert_array_equal(found.inlier, expected.inlier)
        of_u, of_mean, of_std = TOLERANCES[backend.name]
        for u, other in zip(found_u, expected_u, strict=True):
            np.testing.assert_allclose(u, other, rtol=0.0, atol=of_u)
        np.testing.assert_allclose(found.mean, expected.mean, rtol=0.0, atol=of_mean)
        np.testing.assert_allclose(found.std, expected.std, rtol=0.0, atol=of_std)


def test_rounding_beside_little_noise_is_no_fault(backend):
    config = config_of(**{
        'length_scale.model': 'constant',
        'length_scale.constant': 30.0,
        'observation.slope_std': 2.0,
        'observation.sigma_f': 10.0,
        'surface.look_aside': False,
        'grid.r_max': 500.0,
        'faces.cell_size': 1.0,
    })  # fmt: skip
    r = np.arange(3.0, 499.0)
    frame = frame_of(np.column_stack([r, 0.01 * r, np.full_like(r, -1.73)]), config)
    theta = given_theta(config)
    theta[1] = np.log(1e-5)
    surface, *_ = backend.estimate_surface(frame, theta, config)
    assert surface.inlier.all()
    rounding = {'numpy': 1e-3, 'numba': 1e-2}[backend.name]
    np.testing.assert_allclose(surface.mean[frame.candidates.segment[0]], -1.73, atol=rounding)


def test_a_segment_is_as_in_the_paper_in_the_frame_of_the_sensor():
    """Heights are those of points and of the sensor; mean and covariance follow equations 6, 7."""
    xyz = hilly_scan().astype(np.float32)
    result = GroundSegmenter('paper', learning_mode='fixed', sensor_height=1.6).segment(xyz)
    own, theta = result.segment(90), np.exp(result.theta)
    lowest = np.isin(own.z.astype(np.float32), xyz[result.grid.segment == 90, 2])
    assert lowest.all() and own.inlier.sum() > 5
    u, knot_u = reference_gp.log_length_scales(result.frame, result.theta, result.config, 90)
    r = np.concatenate([own.r[own.inlier], own.knots])
    l = np.exp(np.concatenate([u[own.inlier], knot_u]))  # noqa: E741
    prior, n = reference_gp.paciorek(r, l, r, l, theta[0]), own.inlier.sum()
    gain = prior[n:, :n] @ np.linalg.inv(prior[:n, :n] + theta[1] ** 2 * np.eye(n))
    np.testing.assert_allclose(own.mean, gain @ (own.z[own.inlier] + 1.6) - 1.6, atol=1e-4)
    np.testing.assert_allclose(own.cov, prior[n:, n:] - gain @ prior[:n, n:], atol=1e-5)
    np.testing.assert_allclose(own.length_scale, np.exp(knot_u), rtol=1e-4)
    l_bar = np.exp(result.pseudo.log_extent) * theta[5 + result.pseudo.kind]
    bar = slice(*result.pseudo.offsets[90:92])
    np.testing.assert_allclose(
        [own.pseudo_r, own.pseudo_l], [result.pseudo.r_bar[bar], l_bar[bar]]
    )
    with pytest.raises(ConfigError, match=r'segment 180: must be in \[0, 179\]'):
        result.segment(180)
    # Over a relief, with neighbours, doubts and tilt: still the points' heights and one posterior.
    result = GroundSegmenter(sensor_roll=0.05).segment(xyz)
    assert not result.relief.is_level
    own, level = result.segment(90), result.pose.level(xyz)
    heights = level[result.grid.segment == 90, 2]
    assert np.abs(own.z[:, None] - heights).min(axis=1).max() < 1e-5
    np.testing.assert_allclose(np.diag(own.cov), own.std**2)
    assert np.linalg.eigvalsh(own.cov)[0] > -1e-9
    assert np.abs(own.mean - np.interp(own.knots, own.r[own.inlier], own.z[own.inlier])).max() < 1
