"""The command `table1`: its numbers against their definitions, its files, its refusals."""

import argparse
import csv

import numpy as np
import pytest
from evaluation_samples import write_streets

from gp_ground_seg import Config, GroundSegmenter
from gp_ground_seg.cli import table1 as command
from gp_ground_seg.data.semantic_kitti import read_labels, read_points
from gp_ground_seg.errors import ConfigError, DataError
from gp_ground_seg.evaluation import table1 as runner
from gp_ground_seg.experiments.table1 import DEFAULT_CHOICES, Choice, is_candidate, table1
from gp_ground_seg.simulation import HDL_32E, SCENES, simulate_scan, write_semantic_kitti

SEGMENTS = (90, 91)
ROAD = 40


def run(*words):
    parser = argparse.ArgumentParser()
    command.add_parser(parser.add_subparsers(required=True))
    arguments = parser.parse_args(['table1', *(str(word) for word in words)])
    return arguments.run(arguments)


@pytest.fixture(scope='module')
def root(tmp_path_factory):
    """Rubble ahead, from segment 90 on."""
    folder = tmp_path_factory.mktemp('kitti')
    scan = simulate_scan(SCENES['road_then_rubble'](1), HDL_32E, np.random.default_rng(1), x=12.0)
    write_semantic_kitti([scan], folder, '00')
    return folder


@pytest.fixture(scope='module')
def frame(root):
    points = read_points(root / 'sequences/00/velodyne/000000.bin')
    return points, read_labels(root / 'sequences/00/labels/000000.label', len(points))


@pytest.fixture(scope='module')
def measured(root):
    return table1(root, [Choice('00', '000000', SEGMENTS)], Config(), n_repeats=1)


@pytest.mark.parametrize(
    ('method', 'model'), [('Z-L', 'latent'), ('Z', 'line_gradient')], ids=['Z-L', 'Z']
)
def test_columns_follow_their_definitions(measured, frame, method, model):
    """Everything anew from a segmentation of its own, but for the times."""
    points, semantic = frame
    z = points[:, 2].astype(float)
    result = GroundSegmenter(Config().replace(**{'length_scale.model': model})).segment(points)
    candidates, surface = result.candidates, result.surface
    for row, segment in zip(measured.rows, SEGMENTS, strict=True):
        columns = row.methods[method]
        own = slice(*candidates.offsets[segment : segment + 2])
        assert row.segment == segment
        assert row.n_candidates == own.stop - own.start
        assert row.n_pseudo_inputs == np.count_nonzero(
            np.repeat(np.arange(180), np.diff(result.pseudo.offsets)) == segment
        )
        names = ('sigma_f', 'sigma_n', 'sigma_f_bar', 'sigma_l_bar', 'sigma_n_bar')
        sigma = np.array([result.fit.theta[name] for name in names])
        np.testing.assert_allclose(columns.variances, sigma**2, rtol=1e-12)

        inlier = surface.inlier[own]
        y = candidates.z[own][inlier]
        mu = np.interp(candidates.r[own][inlier], surface.knots, surface.mean[segment])
        assert columns.n_inliers == len(y)
        smse = np.mean((y - mu) ** 2 / np.var(y))
        assert columns.smse_in_sample == pytest.approx(smse, rel=1e-6)

        r = np.hypot(points[:, 0].astype(float), points[:, 1].astype(float))
        azimuth = np.degrees(np.arctan2(points[:, 1], points[:, 0]))
        held_out = (azimuth >= 2 * (segment - 90)) & (azimuth < 2 * (segment - 89)) & (r < 90)
        held_out &= (semantic == ROAD) & ~np.isin(z, candidates.z[own])
        assert row.n_held_out == held_out.sum() > 100
        y = z[held_out]
        mu = np.interp(r[held_out], surface.knots, surface.mean[segment])
        smse = np.mean((y - mu) ** 2 / np.var(y))
        # The segmenter takes ranges in the precision of the points.
        assert columns.smse_held_out == pytest.approx(smse, rel=1e-6)
        assert columns.seconds > 0.0


def test_theta_is_of_the_whole_frame(measured):
    first, second = (row.methods['Z-L'].variances for row in measured.rows)
    np.testing.assert_array_equal(first, second)
    # Z has no latent process: those three stay as given.
    given = np.square([0.9, 2.0, 0.25])
    np.testing.assert_allclose(measured.rows[0].methods['Z'].variances[2:], given)
    assert (np.abs(first[2:] / given - 1.0) > 1e-4).all()


def test_each_candidate_is_one_point(frame):
    points, _ = frame
    result = GroundSegmenter().segment(points)
    z = points[:, 2].astype(float)
    found = is_candidate(result, z)
    assert found.sum() == len(result.candidates.z)
    order = np.argsort(result.grid.segment[found] * 10_000 + result.grid.bin[found])
    np.testing.assert_array_equal(z[found][order], result.candidates.z)


def test_times_are_medians_of_what_the_clock_says(root):
    ticks = iter(range(10**9))
    table = table1(
        root, [Choice('00', '000000', (90,))], Config(), 3, clock=lambda: float(next(ticks))
    )
    # Every stage of a run is one tick of this clock, so all runs last as long.
    stages = GroundSegmenter().segment(np.empty((0, 3))).timings
    assert table.rows[0].methods['Z'].seconds == len(stages) - 1


def test_without_segments_the_pair_with_the_most_varied_ground(root, frame):
    """Found by brute force."""
    points, semantic = frame
    segment = GroundSegmenter().segment(points).grid.segment
    near = np.hypot(points[:, 0], points[:, 1]) < 90.0
    std = np.zeros(180)
    for m in range(180):
        z = points[(segment == m) & near & (semantic == ROAD), 2].astype(float)
        std[m] = z.std() if len(z) >= runner.MIN_GROUND_POINTS else 0.0
    pairs = {(m, (m + 1) % 180): min(std[m], std[(m + 1) % 180]) for m in range(180)}
    table = table1(root, [Choice('00', '000000')], Config(), n_repeats=1)
    assert tuple(row.segment for row in table.rows) == max(pairs, key=pairs.get)


def test_files_and_text_say_the_same(root, tmp_path, capsys):
    target = tmp_path / 'out'
    words = ['--kitti', root, '--frames', '00/000000:90,91', '--repeats', 2, '--output', target]
    assert run(*words) == 0
    text = capsys.readouterr().out
    with (target / 'table1.csv').open(newline='') as file:
        rows = list(csv.DictReader(file))
    assert [row['segment'] for row in rows] == ['90', '91']
    markdown = (target / 'table1.md').read_text()
    command_line, _, header, *_ = markdown.splitlines()
    assert command_line == '`gp-ground-seg table1 --kitti KITTI_ROOT --frames 00/000000:90,91`'
    assert 'median of 2 runs' in markdown and 'numba' in markdown
    titles = [cell.strip() for cell in header.strip('|').split('|')]
    for row in rows:
        line = next(
            x for x in markdown.splitlines() if x.startswith(f'| 00/000000:{row["segment"]}')
        )
        cells = dict(zip(titles, (c.strip() for c in line.strip('|').split('|')), strict=True))
        assert cells['n_PG / n_L'] == f'{row["n_candidates"]} / {row["n_pseudo_inputs"]}'
        for title, column in (
            ('sigma_n^2', 'sigma_n_squared'),
            ('sigma_l_bar^2', 'sigma_l_bar_squared'),
            ('SMSE Z-L, held out', 'smse_held_out_z_l'),
            ('SMSE Z, in sample', 'smse_in_sample_z'),
            ('t Z [s]', 'seconds_z'),
        ):
            assert float(cells[title]) == pytest.approx(float(row[column]), rel=2e-3, abs=1e-4)
            assert cells[title] in text


def test_files_are_not_overwritten_without_force(root, tmp_path, monkeypatch, capsys):
    (tmp_path / 'table1.md').write_text('mine')
    words = ['--kitti', root, '--frames', '00/000000:90', '--repeats', 1, '--output', tmp_path]
    with monkeypatch.context() as patched:
        patched.setattr(runner, 'read_points', None)  # refused before any frame is read
        with pytest.raises(DataError, match='--force'):
            run(*words)
    assert [path.name for path in tmp_path.iterdir()] == ['table1.md']
    run(*words, '--force')
    assert 'mine' not in (tmp_path / 'table1.md').read_text()
    assert sorted(path.name for path in tmp_path.iterdir()) == ['table1.csv', 'table1.md']


@pytest.mark.parametrize(
    ('words', 'error', 'message'),
    [
        (['--frames', '00/000007'], DataError, 'no frame 000007 in sequence 00; there are 000000'),
        (['--frames', '07/000000'], DataError, 'sequences here: 00'),
        (['--frames', '00/000000:180'], ConfigError, r'segment 180: must be in \[0, 179\]'),
        (['--set', 'length_scale.model=constant'], ConfigError, 'leave it out'),
        (['--set', 'learning.mode=fixed'], ConfigError, 'leave it out'),
    ],
)
def test_errors_are_said(root, words, error, message):
    with pytest.raises(error, match=message):
        run('--kitti', root, *words)


def test_frames_without_labels_or_with_little_ground(tmp_path):
    root = write_streets(tmp_path, s00=1)
    with pytest.raises(DataError, match='name segments'):
        run('--kitti', root, '--frames', '00/000000')
    (root / 'sequences/00/labels/000000.label').unlink()
    with pytest.raises(DataError, match='has no labels'):
        run('--kitti', root, '--frames', '00/000000:3')


@pytest.mark.parametrize(
    'words', [['--frames', '000000'], ['--frames', '00/1:a'], ['--repeats', '0'], []]
)
def test_usage_errors(root, words, capsys):
    with pytest.raises(SystemExit) as caught:
        run(*(['--kitti', root, *words] if words else words))
    assert caught.value.code == 2
    assert 'table1' in capsys.readouterr().err


def test_default_segments_of_real_frames(kitti, capsys):
    """A pair on a slope and one on uneven ground, both predicted better than by their mean."""
    run('--kitti', kitti, '--repeats', '1')
    output = capsys.readouterr().out
    assert max(len(line) for line in output.splitlines()) <= 100
    table = table1(kitti, DEFAULT_CHOICES, Config(), n_repeats=1)
    assert [row.segment for row in table.rows] == [157, 158, 147, 148]
    for row in table.rows:
        assert row.n_held_out > 200
        for columns in row.methods.values():
            assert 0.0 < columns.smse_held_out < 0.5
            assert 0.0 < columns.smse_in_sample < 0.5
