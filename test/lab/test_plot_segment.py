"""The command `plot segment`, by the pixels of its pictures."""

import math

import numpy as np
import pytest
from cli_runner import error_line, run
from conftest import hilly_scan
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.image import imread

from gp_ground_seg import Config, GroundSegmenter
from gp_ground_seg.core.errors import PointCloudError
from gp_ground_seg.core.parameters.config import GridConfig
from gp_ground_seg.core.pipeline.polar_grid import build_polar_grid, grid_geometry
from gp_ground_seg.lab import plotting as colours
from gp_ground_seg.lab.plotting import COLOURS, SegmentView, line_ends, plot_segment, segment_at

SEGMENT = 90
ROAD, BUILDING = 40, 50


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
    """A .bin file, with labels beside it."""
    path = tmp_path_factory.mktemp('scan') / 'scan.bin'
    points, wall = ahead()
    points.tofile(path)
    semantic = np.where(wall, BUILDING, ROAD).astype('<u4')
    semantic[np.flatnonzero(wall)[:40]] = ROAD  # missed ground
    semantic.tofile(path.with_suffix('.label'))
    return path


@pytest.fixture
def draw(scan, tmp_path):
    """Draw with the command, and return the upper and the lower panel of the picture."""

    def command(*words, segment=('--segment', SEGMENT), name='a.png'):
        assert run('plot', 'segment', scan, *segment, '-o', tmp_path / name, *words) == 0
        image = imread(tmp_path / name)[:, :, :3]
        height, width = image.shape[:2]
        inside = image[:, round(0.075 * width) : round(0.775 * width)]
        rows = [round(share * height) for share in (0.08, 0.65, 0.71, 0.91)]
        return inside[rows[0] : rows[1]], inside[rows[2] : rows[3]]

    return command


def count(pixels, colour):
    return int((np.abs(pixels - np.array(to_rgb(colour))).max(axis=2) < 0.01).sum())


@given(azimuth=st.floats(-10.0, 10.0), n_segments=st.integers(4, 400))
def test_segment_at_is_that_of_the_grid(azimuth, n_segments):
    xyz = np.array([[10.0 * math.cos(azimuth), 10.0 * math.sin(azimuth), 0.0]])
    geometry = grid_geometry(GridConfig(n_segments=n_segments), 0.5, xyz.dtype)
    grid = build_polar_grid(xyz, geometry)
    # On the edge between two segments rounding decides.
    position = (azimuth / math.tau + 0.5) * n_segments
    if abs(position - round(position)) > 1e-9:
        assert segment_at(azimuth, n_segments) == grid.segment[0]


@pytest.mark.parametrize(
    ('slope', 'ends'),
    [
        (1.0, [[1.0, 3.0], [5.0, 7.0]]),
        (0.0, [[1.0, 3.0], [6.0, 6.0]]),
        (math.inf, [[2.0, 2.0], [5.0, 7.0]]),
        (-math.inf, [[2.0, 2.0], [7.0, 5.0]]),
    ],
)
def test_line_ends_by_hand(slope, ends):
    r, z = np.array([1.0, 2.0, 3.0]), np.array([5.0, 6.0, 7.0])
    np.testing.assert_allclose(line_ends(r, z, slope), ends, atol=1e-12)


def test_everything_is_drawn(draw, scan, tmp_path, capsys):
    upper, lower = draw('--labels', scan.with_suffix('.label'))
    drawn = [COLOURS['ground'], COLOURS['obstacle'], COLOURS['missed ground']]
    for colour in (*drawn, colours.CANDIDATE_COLOUR, colours.SURFACE_COLOUR):
        assert count(upper, colour) > 10, colour
    assert count(lower, colours.PSEUDO_INPUT_COLOUR) > 30
    assert count(lower, colours.SURFACE_COLOUR) > 300
    result = GroundSegmenter().segment(ahead()[0])
    first, last = result.candidates.offsets[SEGMENT : SEGMENT + 2]
    assert capsys.readouterr().out == (
        f'segment 90: {last - first} candidates, {result.surface.inlier[first:last].sum()} '
        f'inliers, {np.diff(result.pseudo.offsets)[SEGMENT]} pseudo-inputs, '
        f'written to {tmp_path / "a.png"}\n'
    )


@pytest.mark.parametrize('model', ['line_gradient', 'constant'])
def test_pseudo_inputs_only_where_they_act(draw, model):
    upper, lower = draw('--set', f'length_scale.model={model}')
    assert count(lower, colours.PSEUDO_INPUT_COLOUR) == 0
    assert count(lower, colours.SURFACE_COLOUR) > 300
    # Without labels no errors are known.
    assert count(upper, COLOURS['ground']) > 100
    assert count(upper, COLOURS['missed ground']) == 0


def test_azimuth_is_another_way_to_say_segment(draw, tmp_path):
    draw(segment=('--azimuth', 1), name='a.png')
    draw(name='b.png')
    assert (tmp_path / 'a.png').read_bytes() == (tmp_path / 'b.png').read_bytes()


def test_segments_side_by_side(scan, tmp_path, capsys):
    """The wall ahead is in the first of the two only; both have the same axes."""
    path = tmp_path / 'pair.png'
    assert run('plot', 'segment', scan, '--segment', f'{SEGMENT},91', '-o', path) == 0
    said = capsys.readouterr().out
    assert said.startswith('segment 90: ') and '; segment 91: 0 candidates' in said
    image = imread(path)[:, :, :3]
    left, right = image[:, : 9 * image.shape[1] // 20], image[:, 9 * image.shape[1] // 20 :]
    violet = colours.PSEUDO_INPUT_COLOUR
    assert count(left, violet) > 30 > count(right, violet)


def test_what_is_drawn_is_the_result():
    """The curves' data, read back from the axes."""
    points = hilly_scan().astype(np.float32)
    result = GroundSegmenter().segment(points)
    above, below = Figure().subplots(2)
    view = SegmentView(result, SEGMENT, points[:, 2])
    view.draw_ground(above)
    view.draw_length_scale(below, 40.0, with_pseudo_inputs=True)

    drawn = {line.get_label().split(' (')[0]: line for line in above.lines}
    inside = slice(*result.candidates.offsets[SEGMENT : SEGMENT + 2])
    own = result.candidates.where(result.candidates.segment == SEGMENT)
    r, z = own.r, own.z + result.relief.at(own.x, own.y)
    inlier = result.surface.inlier[inside]
    begins = np.flatnonzero(np.diff(result.lines.line[inside])) + 1
    assert len(begins) > 0
    np.testing.assert_array_equal(drawn['critical points'].get_xdata(), r[begins])
    np.testing.assert_array_equal(drawn['candidates, inliers'].get_ydata(), z[inlier])
    knots, n_segments = result.surface.knots, result.grid.n_segments
    surface = result.surface.mean + result.relief.at_knots(knots, n_segments)
    assert not result.relief.is_level
    np.testing.assert_array_equal(drawn['surface'].get_ydata(), surface[SEGMENT])
    # A line over the relief ends where its first and its last candidate are, nearly.
    lines = [line for line in above.lines if len(line.get_xdata()) == 16]
    assert len(lines) > 1
    for line in lines:
        ends = np.interp(line.get_xdata()[[0, -1]], r, z)
        np.testing.assert_allclose(line.get_ydata()[[0, -1]], ends, atol=0.15)

    length_scale, pseudo = below.lines
    np.testing.assert_array_equal(
        length_scale.get_ydata(), np.exp(result.log_length_scale[SEGMENT])
    )
    first, last = result.pseudo.offsets[SEGMENT : SEGMENT + 2]
    np.testing.assert_array_equal(pseudo.get_xdata(), result.pseudo.r_bar[first:last])
    values = np.exp(result.pseudo.log_extent[first:last])
    values *= result.fit.theta['length_scale_factor']  # one for all
    np.testing.assert_allclose(pseudo.get_ydata(), values)
    # The curve follows the pseudo-inputs: it stays among them and near each.
    at_pseudo = np.interp(pseudo.get_xdata(), length_scale.get_xdata(), length_scale.get_ydata())
    off = np.abs(np.log(at_pseudo / values))
    assert off.mean() < 0.5 and off.max() < 1.0


@pytest.mark.parametrize('points', [np.full((3, 4), np.nan), np.array([[5.0, 0.1, 4.0]])])
def test_segments_with_nothing_to_see(tmp_path, points):
    result, path = GroundSegmenter().segment(points), tmp_path / 'a.png'
    for truth in (result.label, None):
        plot_segment(result, Config(), points, [SEGMENT], path, truth, title=r'$\none _ %')
        assert imread(path).ndim == 3


@pytest.mark.parametrize(
    ('words', 'message'),
    [
        (['--segment', '180'], 'segment 180: must be in [0, 179]'),
        (['--segment', '-1'], 'segment -1'),
        (['--segment', '90;91'], '90;91'),
        (['--azimuth', 'nan'], 'number of degrees'),
        (['--azimuth', '400'], '--azimuth 400: must be a number of degrees, -360'),
        (['--segment', '1', '--labels', '/no.label'], '/no.label'),
        ([], '--segment'),
        (['--segment', '1', '--azimuth', '1'], '--azimuth'),
    ],
)
def test_errors_are_said(scan, tmp_path, monkeypatch, capsys, words, message):
    monkeypatch.chdir(tmp_path)
    # The height is given, as this scan does not show it.
    assert run('plot', 'segment', scan, '-o', 'a.png', '--set', 'sensor.height=1.73', *words) == 2
    assert message in error_line(capsys)
    assert list(tmp_path.iterdir()) == []


def test_shapes_have_to_fit(tmp_path):
    points = ahead()[0]
    result = GroundSegmenter().segment(points)
    with pytest.raises(PointCloudError, match=r'result of shape \(1500,\) for 9 points'):
        plot_segment(result, Config(), points[:9], [0], tmp_path / 'a.png')
    with pytest.raises(PointCloudError, match=r'truth of shape \(9,\)'):
        plot_segment(result, Config(), points, [0], tmp_path / 'a.png', np.zeros(9, np.uint8))
