"""The experiment `table1`: its numbers against their definitions, and its refusals."""

import numpy as np
import pytest
from cli_runner import error_line, run
from evaluation_samples import write_frame, write_streets

from gp_ground_seg import Config, GroundSegmenter
from gp_ground_seg.data.semantic_kitti import read_labels, read_points
from gp_ground_seg.experiments.table1 import (
    DEFAULT_CHOICES,
    VARIANCES,
    Choice,
    is_candidate,
    table1,
)
from gp_ground_seg.simulation import HDL_32E, SCENES, semantic_kitti_labels, simulate_scan

SEGMENTS = (90, 91)
ROAD = 40


@pytest.fixture(scope='module')
def root(tmp_path_factory):
    """Rubble ahead, from segment 90 on."""
    folder = tmp_path_factory.mktemp('kitti')
    scan = simulate_scan(SCENES['road_then_rubble'](1), HDL_32E, np.random.default_rng(1), x=12.0)
    write_frame(folder, '00', 0, scan.points, semantic_kitti_labels(scan.kind))
    return folder


@pytest.fixture(scope='module')
def frame(root):
    points = read_points(root / 'sequences/00/velodyne/000000.bin')
    return points, read_labels(root / 'sequences/00/labels/000000.label', len(points))


def rows_of(root, *choices):
    return table1(root, choices, Config(), n_repeats=1).rows


@pytest.fixture(scope='module')
def measured(root):
    return rows_of(root, Choice('00', '000000', SEGMENTS))


@pytest.mark.parametrize(
    ('method', 'model'), [('Z-L', 'latent'), ('Z', 'line_gradient')], ids=['Z-L', 'Z']
)
def test_columns_follow_their_definitions(measured, frame, method, model):
    """Everything anew from a segmentation of its own, but for the times."""
    points, semantic = frame
    z = points[:, 2].astype(float)
    result = GroundSegmenter(Config().replace(**{'length_scale.model': model})).segment(points)
    candidates, surface = result.candidates, result.surface
    for row, segment in zip(measured, SEGMENTS, strict=True):
        own = slice(*candidates.offsets[segment : segment + 2])
        assert row['segment'] == f'00/000000:{segment}'
        assert row['n_PG'] == own.stop - own.start
        assert row['n_L'] == np.count_nonzero(
            np.repeat(np.arange(180), np.diff(result.pseudo.offsets)) == segment
        )
        names = ('sigma_f', 'sigma_n', 'sigma_f_bar', 'sigma_l_bar', 'sigma_n_bar')
        sigma = np.array([result.fit.theta[name] for name in names])
        if method == 'Z-L':
            found = [row[title] for title in VARIANCES]
            np.testing.assert_allclose(found, sigma**2, rtol=1e-12)

        inlier = surface.inlier[own]
        y = candidates.z[own][inlier]
        mu = np.interp(candidates.r[own][inlier], surface.knots, surface.mean[segment])
        assert row[f'inliers {method}'] == len(y)
        smse = np.mean((y - mu) ** 2 / np.var(y))
        assert row[f'in sample {method}'] == pytest.approx(smse, rel=1e-6)

        r = np.hypot(points[:, 0].astype(float), points[:, 1].astype(float))
        azimuth = np.degrees(np.arctan2(points[:, 1], points[:, 0]))
        held_out = (azimuth >= 2 * (segment - 90)) & (azimuth < 2 * (segment - 89)) & (r < 90)
        held_out &= (semantic == ROAD) & ~np.isin(z, candidates.z[own])
        assert row['held out'] == held_out.sum() > 100
        y = z[held_out]
        mu = np.interp(r[held_out], surface.knots, surface.mean[segment])
        smse = np.mean((y - mu) ** 2 / np.var(y))
        # The segmenter takes ranges in the precision of the points.
        assert row[f'held out {method}'] == pytest.approx(smse, rel=1e-6)
        assert row[f't {method} [s]'] > 0.0


def test_theta_is_of_the_whole_frame_and_learned(measured):
    first, second = ([row[title] for title in VARIANCES] for row in measured)
    assert first == second
    given = np.square([0.9, 2.0, 0.25])
    assert (np.abs(first[2:] / given - 1.0) > 1e-4).all()


def test_each_candidate_is_one_point(frame):
    points, _ = frame
    result = GroundSegmenter().segment(points)
    z = points[:, 2].astype(float)
    found = is_candidate(result, z)
    assert found.sum() == len(result.candidates.z)
    order = np.argsort(result.grid.segment[found] * 10_000 + result.grid.bin[found])
    np.testing.assert_array_equal(z[found][order], result.candidates.z)


@pytest.mark.parametrize(
    ('words', 'message'),
    [
        (['--frames', '00/000007:3'], 'no frame 000007 in sequence 00; there are 000000'),
        (['--frames', '07/000000:3'], 'sequences here: 00'),
        (['--frames', '00/000000:180'], 'segment 180: must be in [0, 179]'),
        (['--frames', '000000'], "'000000': must be as in 08/000005:151"),
        (['--frames', '00/1:a'], 'must be as in'),
        (['--set', 'length_scale.model=constant'], 'leave it out'),
        (['--set', 'learning.mode=fixed'], 'leave it out'),
    ],
)
def test_errors_are_said(root, words, message, capsys):
    assert run('experiment', 'table1', root, *words) == 2
    assert message in error_line(capsys)


def test_frames_without_labels(tmp_path, capsys):
    root = write_streets(tmp_path, s00=1)
    (root / 'sequences/00/labels/000000.label').unlink()
    assert run('experiment', 'table1', root, '--repeats', 1, '--frames', '00/000000:3') == 2
    assert 'has no labels' in capsys.readouterr().err


def test_default_segments_of_real_frames(kitti):
    """A pair on a slope and one on uneven ground, both predicted better than by their mean."""
    rows = rows_of(kitti, *map(Choice.parse, DEFAULT_CHOICES))
    assert [row['segment'][-3:] for row in rows] == ['157', '158', '147', '148']
    for row in rows:
        assert row['held out'] > 200
        for name in ('Z-L', 'Z'):
            assert 0.0 < row[f'held out {name}'] < 0.5
            assert 0.0 < row[f'in sample {name}'] < 0.5
