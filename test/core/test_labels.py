import numpy as np
import pytest
import scipy.stats
from conftest import BACKENDS, fewer
from hypothesis import given, settings
from hypothesis import strategies as st

from gp_ground_seg import Config, Label
from gp_ground_seg.core.frame import Faces, GroundSurface, at_points
from gp_ground_seg.core.pipeline.labels import ground_probability
from gp_ground_seg.core.pipeline.relief import Relief

CONFIG = Config().replace(
    **{
        'grid.n_segments': 4,
        'grid.n_bins': 4,
        'grid.r_min': 2.0,
        'grid.r_max': 10.0,
        'grid.bin_growth': 1.0,
        'surface.look_aside': True,
    }
)
KNOTS = np.array([2.0, 4.0, 6.0, 8.0, 10.0])
KNOTS.setflags(write=False)
LEVEL = Relief.level()


def ground_about(side, std, rng):
    """Places and heights of returns of ground about (5, 0), 20 in each square of half a metre."""
    x, y = np.meshgrid(*(middle + np.arange(-side, side, 0.1) for middle in (5.0, 0.0)))
    return np.column_stack([x.ravel(), y.ravel(), np.abs(rng.normal(0.0, std, x.size))])


def labels_of(backend, points):
    """Labels and margins of points (N, 3) over a level surface."""
    config = CONFIG.replace(**{'grid.r_max': 12.0, 'grid.r_min': 1.2})
    mean, std = np.zeros((4, 5)), np.full((4, 5), 0.1)
    knots = np.linspace(1.2, 12.0, 5)
    knots.setflags(write=False)  # as a frame has them: another type would be compiled by itself
    surface = GroundSurface(knots, mean, std, np.ones(0, dtype=bool))
    scan = backend.build_grid(points, config)
    return backend.label_points(scan, Faces.none(scan.tiles), surface, LEVEL, 1.0, config)


@pytest.mark.parametrize('nearest', [5.0, 5.2])
def test_ground_before_a_wall_is_ground_where_its_cell_is_flat(backend, nearest):
    """It rises more within the tile than the foot of a face, or lies in the plane of the wall."""
    x = np.concatenate([np.linspace(nearest, 5.24, 100), np.full(100, 5.26)])
    z = np.concatenate([0.35 * (x[:100] - 5.0), np.linspace(0.11, 0.9, 100)])
    points, is_ground = np.stack([x, np.tile([0.01, 0.02], 100), z], axis=-1), x < 5.25
    config = CONFIG.replace(**{'grid.n_bins': 32, 'label.rule': 'tolerance'})
    scan, mean = backend.build_grid(points, config), np.zeros((4, 33))
    surface = GroundSurface(scan.grid.edges, mean, mean, np.ones(0, dtype=bool))
    faces = backend.find_faces(scan, 0.0, config)
    found = backend.label_points(scan, faces, surface, LEVEL, 1.0, config)
    np.testing.assert_array_equal(found.label == Label.GROUND, is_ground)


@pytest.mark.parametrize('std', [0.0, 0.03])
@pytest.mark.parametrize('size', [0.4, 1.0, 2.0])
def test_a_thing_on_the_ground_is_no_roughness(backend, std, size):
    # The front and the top of a box, 0.3 m high: nothing is seen of the ground below it.
    ground = ground_about(4.5, std, np.random.default_rng(7))
    is_box = (abs(ground[:, 0] - 5.0) < size / 2) & (abs(ground[:, 1]) < size / 2)
    points = np.where(is_box[:, None], ground * [1, 1, 0] + [0, 0, 0.3], ground)
    found = labels_of(backend, points)
    assert (found.label[is_box] == Label.OBSTACLE).all()
    assert (found.label[~is_box] == Label.GROUND).mean() > 0.98


def test_ground_as_rough_as_that_everywhere_is_ground(backend):
    rng = np.random.default_rng(7)
    points = ground_about(4.5, 0.0, rng)
    points[:, 2] = rng.uniform(0.0, 0.3, len(points))
    found = labels_of(backend, points)
    assert (found.label == Label.GROUND).all()
    band = (found.margin + found.height)[found.height < 0.02]
    np.testing.assert_allclose(band, 2.1 * 0.3 / np.sqrt(3.0), rtol=0.15)


def test_probability_is_a_half_at_the_edge_and_follows_the_certainty():
    margin = np.array([0.0, 0.1, 0.1, -0.1, np.nan])
    std = np.array([0.1, 0.01, 0.3, 0.01, np.nan])
    found = ground_probability(margin, std)
    expected = scipy.stats.norm.cdf(margin / np.sqrt(std**2 + 0.02**2))
    np.testing.assert_allclose(found[:4], expected[:4], rtol=1e-6)
    assert found[0] == 0.5
    assert found[1] > found[2] > 0.5
    assert found[4] == 0.0


@settings(max_examples=fewer(20, 10))
@given(st.integers(0, 10_000), st.sampled_from([np.float32, np.float64]))
def test_backends_give_the_same_labels(compiled_code, seed, dtype):
    rng = np.random.default_rng(seed)
    xyz = rng.uniform(-12, 12, (300, 3)).astype(dtype)
    xyz[:, 2] *= rng.choice([0.01, 0.1])
    # Posts, so that there are faces.
    places = np.repeat(rng.uniform(-6, 6, (5, 2)), 20, axis=0)
    xyz[100:200, :2] = places + rng.normal(0, 0.02, (100, 2))
    xyz[100:200, 2] = rng.uniform(-0.1, 0.8, 100)
    xyz[::20] = np.nan
    mean, std = rng.normal(0, 0.3, (4, 5)), rng.uniform(0, rng.choice([0.05, 1.0]), (4, 5))
    mean[seed % 4] = std[seed % 4] = np.nan
    surface = GroundSurface(KNOTS, mean, std, np.ones(0, dtype=bool))
    is_ground = np.zeros(len(xyz), dtype=bool)
    rule = ('roughness', 'tolerance')[seed % 2]
    for tolerance in (0.05, 0.1, 0.2, rng.uniform(0.2, 1.0)):
        config = CONFIG.replace(**{'label.rule': rule, 'label.ground_tolerance': tolerance})
        found = []
        for backend in BACKENDS:
            scan = backend.build_grid(xyz, CONFIG)
            faces = backend.find_faces(scan, 0.0, CONFIG)
            assert faces.is_face.any()
            found.append(backend.label_points(scan, faces, surface, LEVEL, 0.3, config))
        np.testing.assert_array_equal(found[0].label, found[1].label)
        margins, eps = (one.margin for one in found), np.finfo(dtype).eps
        np.testing.assert_allclose(*margins, atol=max(1e-9, 8 * eps))
        height = scan.xyz[:, 2] - at_points(KNOTS, mean, scan.grid)
        for one in found:
            np.testing.assert_allclose(one.height, height, atol=max(1e-12, 8 * eps))
        # More tolerance moves points from obstacle to ground; none the other way, but by votes.
        assert rule == 'roughness' or not (is_ground & (found[0].label != Label.GROUND)).any()
        is_ground = found[0].label == Label.GROUND
