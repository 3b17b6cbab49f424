"""The command `plot segment`, by the pixels of its pictures."""

import argparse
import math
import subprocess
import sys

import numpy as np
import pytest
from conftest import hilly_scan
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.colors import to_rgb
from matplotlib.image import imread

from gp_ground_seg import Config, GroundSegmenter
from gp_ground_seg.cli import plot as command
from gp_ground_seg.errors import ConfigError, DataError, MissingDependencyError, PointCloudError
from gp_ground_seg.parameters.config import GridConfig
from gp_ground_seg.pipeline.polar_grid import build_polar_grid
from gp_ground_seg.plotting import segment_view
from gp_ground_seg.plotting.segment_profile import plot_segment, segment_at
from gp_ground_seg.plotting.segment_view import SegmentView, line_ends

SEGMENT = 90
ROAD, BUILDING, UNLABELLED = 40, 50, 0


def run(*words):
    parser = argparse.ArgumentParser()
    command.add_parser(parser.add_subparsers(required=True))
    arguments = parser.parse_args(['plot', 'segment', *(str(word) for word in words)])
    return arguments.run(arguments)


def ahead(n_points=1500, seed=0):
    """Rising ground and a wall in a sector ahead that is narrower than a segment."""
    rng = np.random.default_rng(seed)
    r = rng.uniform(4.0, 30.0, n_points)
    angle = rng.uniform(0.002, 0.033, n_points)
    z = -1.73 + 0.02 * r + rng.normal(0.0, 0.01, n_points)
    wall = rng.random(n_points) < 0.2
    r[wall] = 15.0 + rng.uniform(0.0, 0.3, wall.sum())
    z[wall] = rng.uniform(-1.4, -0.9, wall.sum())
    points = np.column_stack([r * np.cos(angle), r * np.sin(angle), z, np.zeros(n_points)])
    return points.astype('<f4'), wall


@pytest.fixture(scope='module')
def scan(tmp_path_factory):
    """A .bin file and its labels."""
    folder = tmp_path_factory.mktemp('scan')
    points, wall = ahead()
    points.tofile(folder / 'scan.bin')
    semantic = np.where(wall, BUILDING, ROAD).astype('<u4')
    semantic[:40] = UNLABELLED
    semantic.tofile(folder / 'scan.label')
    return folder / 'scan.bin', folder / 'scan.label'


def panel(path, which):
    """Pixels inside the upper or lower panel."""
    image = imread(path)[:, :, :3]
    height, width = image.shape[:2]
    left, right = round(0.075 * width), round(0.775 * width)
    rows = {'upper': (0.08, 0.65), 'lower': (0.71, 0.91)}[which]
    return image[round(rows[0] * height) : round(rows[1] * height), left:right]


def count(pixels, colour):
    return int((np.abs(pixels - np.array(to_rgb(colour))).max(axis=2) < 0.01).sum())


@given(
    azimuth=st.floats(-10.0, 10.0),
    n_segments=st.integers(4, 400),
)
def test_segment_at_is_that_of_the_grid(azimuth, n_segments):
    xyz = np.array([[10.0 * math.cos(azimuth), 10.0 * math.sin(azimuth), 0.0]])
    grid = build_polar_grid(xyz, GridConfig(n_segments=n_segments))
    # On the edge between two segments rounding decides.
    position = (azimuth / math.tau + 0.5) * n_segments
    if abs(position - round(position)) > 1e-9:
        assert segment_at(azimuth, n_segments) == grid.segment[0]


def test_line_ends_by_hand():
    r, z = np.array([1.0, 2.0, 3.0]), np.array([5.0, 6.0, 7.0])
    np.testing.assert_allclose(line_ends(r, z, 1.0), [[1.0, 3.0], [5.0, 7.0]])
    np.testing.assert_allclose(line_ends(r, z, 0.0), [[1.0, 3.0], [6.0, 6.0]], atol=1e-12)
    np.testing.assert_allclose(line_ends(r, z, math.inf), [[2.0, 2.0], [5.0, 7.0]], atol=1e-12)
    np.testing.assert_allclose(line_ends(r, z, -math.inf), [[2.0, 2.0], [7.0, 5.0]], atol=1e-12)


def test_everything_is_drawn(scan, tmp_path, capsys):
    picture = tmp_path / 'a.png'
    assert run(scan[0], '--segment', SEGMENT, '-o', picture, '--labels', scan[1]) == 0
    upper, lower = panel(picture, 'upper'), panel(picture, 'lower')
    for colour in (
        segment_view.TRUE_GROUND_COLOUR,
        segment_view.TRUE_OBSTACLE_COLOUR,
        segment_view.POINT_COLOUR,
        segment_view.INLIER_COLOUR,
        segment_view.SURFACE_COLOUR,
    ):
        assert count(upper, colour) > 10, colour
    assert count(lower, segment_view.PSEUDO_INPUT_COLOUR) > 30
    assert count(lower, segment_view.SURFACE_COLOUR) > 300
    result = GroundSegmenter().segment(ahead()[0])
    own = slice(*result.candidates.offsets[SEGMENT : SEGMENT + 2])
    assert capsys.readouterr().out == (
        f'segment 90: {own.stop - own.start} candidates, {result.surface.inlier[own].sum()} '
        f'inliers, {np.diff(result.pseudo.offsets)[SEGMENT]} pseudo-inputs, '
        f'written to {picture}\n'
    )


def test_without_labels_the_truth_is_not_coloured(scan, tmp_path):
    run(scan[0], '--segment', SEGMENT, '-o', tmp_path / 'a.png')
    upper = panel(tmp_path / 'a.png', 'upper')
    assert count(upper, segment_view.POINT_COLOUR) > 100
    assert count(upper, segment_view.TRUE_GROUND_COLOUR) == 0


@pytest.mark.parametrize('model', ['line_gradient', 'constant'])
def test_pseudo_inputs_only_where_they_act(scan, tmp_path, model):
    setting = f'length_scale.model={model}'
    run(scan[0], '--segment', SEGMENT, '-o', tmp_path / 'a.png', '--set', setting)
    lower = panel(tmp_path / 'a.png', 'lower')
    assert count(lower, segment_view.PSEUDO_INPUT_COLOUR) == 0
    assert count(lower, segment_view.SURFACE_COLOUR) > 300


def test_azimuth_is_another_way_to_say_segment(scan, tmp_path):
    run(scan[0], '--azimuth', 1, '-o', tmp_path / 'a.png')
    run(scan[0], '--segment', SEGMENT, '-o', tmp_path / 'b.png')
    assert (tmp_path / 'a.png').read_bytes() == (tmp_path / 'b.png').read_bytes()


def test_pdf_is_the_same_each_time(scan, tmp_path):
    for name in ('a.pdf', 'b.pdf'):
        run(scan[0], '--segment', SEGMENT, '-o', tmp_path / name)
    document = (tmp_path / 'a.pdf').read_bytes()
    assert document.startswith(b'%PDF-')
    assert document == (tmp_path / 'b.pdf').read_bytes()


def test_profile_is_that_of_the_result():
    """What is drawn: the curves' data, read back from the axes."""
    from matplotlib.figure import Figure

    points = hilly_scan()
    result = GroundSegmenter().segment(points)
    axes = Figure().subplots()
    view = SegmentView(result, points[:, 2], SEGMENT, None)
    view.draw_length_scale(axes, 40.0, with_pseudo_inputs=True)
    length_scale, pseudo = axes.lines
    np.testing.assert_array_equal(
        length_scale.get_ydata(), np.exp(result.log_length_scale[SEGMENT])
    )
    first, last = result.pseudo.offsets[SEGMENT : SEGMENT + 2]
    np.testing.assert_array_equal(pseudo.get_xdata(), result.pseudo.r_bar[first:last])
    values = [
        result.fit.theta[f'length_scale_bar_{k}'] for k in result.pseudo.surface_class[first:last]
    ]
    np.testing.assert_allclose(pseudo.get_ydata(), values)
    # The curve follows the pseudo-inputs: it stays among them and near each.
    at_pseudo = np.interp(pseudo.get_xdata(), length_scale.get_xdata(), length_scale.get_ydata())
    assert np.abs(np.log(at_pseudo / values)).max() < 1.0


def test_critical_points_begin_lines():
    from matplotlib.figure import Figure

    points = hilly_scan()
    result = GroundSegmenter().segment(points)
    axes = Figure().subplots()
    SegmentView(result, points[:, 2], SEGMENT, None).draw_heights(axes, 40.0)
    drawn = {line.get_label().split(' (')[0]: line for line in axes.lines}
    own = slice(*result.candidates.offsets[SEGMENT : SEGMENT + 2])
    line_of = result.lines.line[own]
    begins = np.flatnonzero(np.diff(line_of)) + 1
    assert len(begins) > 0
    np.testing.assert_array_equal(
        drawn['critical points'].get_xdata(), result.candidates.r[own][begins]
    )
    np.testing.assert_array_equal(
        drawn['candidates, inliers'].get_ydata(),
        result.candidates.z[own][result.surface.inlier[own]],
    )
    np.testing.assert_array_equal(drawn['ground'].get_ydata(), result.surface.mean[SEGMENT])


@pytest.mark.parametrize(
    'points', [np.zeros((0, 3)), np.full((3, 4), np.nan), np.array([[5.0, 0.1, 4.0]])]
)
def test_segments_with_nothing_to_see(tmp_path, points):
    config = Config()
    result = GroundSegmenter(config).segment(points)
    plot_segment(result, config, points, SEGMENT, tmp_path / 'a.png', title=r'$\none _ %')
    assert imread(tmp_path / 'a.png').ndim == 3


def test_an_existing_file_is_kept_without_force(scan, tmp_path):
    picture = tmp_path / 'a.png'
    picture.write_text('mine')
    with pytest.raises(DataError, match='--force'):
        run(scan[0], '--segment', SEGMENT, '-o', picture)
    assert picture.read_text() == 'mine'
    run(scan[0], '--segment', SEGMENT, '-o', picture, '--force')
    assert imread(picture).ndim == 3
    assert list(tmp_path.iterdir()) == [picture]


@pytest.mark.parametrize(
    ('words', 'error', 'message'),
    [
        (['--segment', '180', '-o', 'a.png'], ConfigError, r'segment 180: must be in \[0, 179\]'),
        (['--segment', '-1', '-o', 'a.png'], ConfigError, 'segment -1'),
        (['--azimuth', 'nan', '-o', 'a.png'], DataError, 'number of degrees'),
        (['--segment', '1', '-o', 'a.svg'], ConfigError, r'must end in \.png or \.pdf'),
        (['--segment', '1', '-o', 'a.png', '--max-range', '0'], ConfigError, 'max_range = 0'),
        (['--segment', '1', '-o', '/no/such/folder/a.png'], DataError, '/no/such/folder'),
        (['--segment', '1', '-o', 'a.png', '--labels', '/no.label'], DataError, r'/no\.label'),
    ],
)
def test_errors_are_said(scan, tmp_path, monkeypatch, words, error, message):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(error, match=message):
        run(scan[0], *words)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    'words', [['-o', 'a.png'], ['--segment', '1', '--azimuth', '1', '-o', 'a.png']]
)
def test_one_way_to_name_the_segment(scan, words, capsys):
    with pytest.raises(SystemExit) as caught:
        run(scan[0], *words)
    assert caught.value.code == 2


def test_shapes_have_to_fit(tmp_path):
    points = ahead()[0]
    result = GroundSegmenter().segment(points)
    with pytest.raises(PointCloudError, match=r'result of shape \(1500,\) for 9 points'):
        plot_segment(result, Config(), points[:9], 0, tmp_path / 'a.png')
    with pytest.raises(PointCloudError, match=r'truth of shape \(9,\)'):
        plot_segment(result, Config(), points, 0, tmp_path / 'a.png', np.zeros(9, np.uint8))


def test_matplotlib_is_optional_and_its_global_state_untouched(tmp_path, monkeypatch):
    script = (
        'import sys, numpy as np\n'
        'from gp_ground_seg import Config, GroundSegmenter\n'
        'from gp_ground_seg.plotting.segment_profile import plot_segment\n'
        'assert "matplotlib" not in sys.modules\n'
        'points = np.zeros((2, 3))\n'
        'result = GroundSegmenter().segment(points)\n'
        'plot_segment(result, Config(), points, 0, sys.argv[1])\n'
        'assert "matplotlib" in sys.modules and "matplotlib.pyplot" not in sys.modules\n'
    )
    words = [sys.executable, '-c', script, str(tmp_path / 'a.png')]
    subprocess.run(words, check=True, timeout=120)
    monkeypatch.setitem(sys.modules, 'matplotlib.figure', None)
    points = np.zeros((2, 3))
    with pytest.raises(MissingDependencyError, match='matplotlib'):
        plot_segment(GroundSegmenter().segment(points), Config(), points, 0, tmp_path / 'b.png')
    assert not (tmp_path / 'b.png').exists()
