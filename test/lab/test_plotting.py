"""The pictures of `plot`, by their pixels: scans in perspective, segments from the side."""

import re

import numpy as np
import pytest
from cli_runner import run
from conftest import hilly_scan
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.image import imread

from gp_ground_seg import GroundSegmenter
from gp_ground_seg.lab import plotting

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


def close_to(pixels, colour, tolerance=0.005):
    return np.abs(pixels[..., :3] - np.array(to_rgb(colour))).max(axis=-1) < tolerance


def patch(x, y, half=2.0, n=4000, seed=0):
    rng = np.random.default_rng(seed)
    xyz = rng.uniform((x - half, y - half, -1.8), (x + half, y + half, -1.7), (n, 3))
    return xyz.astype(np.float32)


def repeat(values, n=4000):
    return np.repeat(values, n).astype(np.uint8)


def where(path, colour):
    """Centre of the pixels of a colour in the scene, in widths right and up, and their number."""
    scene = imread(path)[: -round(plotting.FOOT * plotting.DPI)]
    rows, columns = np.nonzero(close_to(scene, colour))
    if not len(rows):
        return None, 0
    height, width = scene.shape[:2]
    x, y = np.median(columns), np.median(rows)
    return np.array([x / width - 0.5, (0.5 * height - y) / width]), len(rows)


def test_labels_and_errors_are_where_the_points_are(tmp_path):
    places = {'ground': (10, 8), 'obstacle': (10, -8), 'false ground': (25, 12),
              'missed ground': (25, -12)}  # fmt: skip
    points = np.concatenate([patch(*place) for place in places.values()])
    points[-1, 2] = np.nan
    label, truth = repeat([1, 2, 1, 2]), repeat([1, 0, 2, 1])
    plotting.plot_scan_view(points, label, tmp_path / 'a.png', truth=truth)
    for name, (x, y) in places.items():
        centre, n = where(tmp_path / 'a.png', plotting.COLOURS[name])
        assert n > 300
        np.testing.assert_allclose(centre, plotting.project(np.array([x, y, -1.75]))[0], atol=0.01)
    # A room is drawn as large as a street.
    plotting.plot_scan_view(0.1 * points, label, tmp_path / 'a.png', truth=truth)
    assert all(where(tmp_path / 'a.png', plotting.COLOURS[name])[1] > 300 for name in places)
    # Without the truth, and from above.
    above = plotting.camera_at(0, 89, 60)
    plotting.plot_scan_view(points, label, tmp_path / 'a.png', camera=above)
    assert where(tmp_path / 'a.png', plotting.COLOURS['missed ground'])[1] == 0
    assert where(tmp_path / 'a.png', plotting.COLOURS['obstacle'])[1] > 1000


def test_counts_are_in_words():
    label = np.array([0, 1, 1, 2, 2, 2], dtype=np.uint8)
    truth = np.array([1, 1, 2, 1, 2, 0], dtype=np.uint8)
    words = [plotting.label_layers(label)[0], plotting.label_layers(label[1:])[0]]
    assert words == ['6 points: 2 ground, 3 obstacle, 1 unknown', '5 points: 2 ground, 3 obstacle']
    assert plotting.label_layers(label, truth)[0] == '1 false ground, 2 missed ground, IoU 25.00 %'
    assert plotting.label_layers(label[:0], truth[:0])[0] == '0 false ground, 0 missed ground'


@pytest.mark.parametrize(
    'points', [np.zeros((0, 3)), np.full((3, 4), np.nan), np.array([[5.0, 0.1, 4.0]])]
)
def test_clouds_with_nothing_to_see(tmp_path, points):
    result, path = GroundSegmenter().segment(points), tmp_path / 'a.png'
    path.write_text('old')
    for truth in (result.label, None):
        plotting.plot_scan_view(points, result.label, path, r'$\nothing _ %', truth=truth)
        assert imread(path).ndim == 3
        plotting.plot_segment(result, points, [SEGMENT], path, truth, title=r'$\none _ %')
        assert imread(path).ndim == 3
    assert [*tmp_path.iterdir()] == [path]


def test_camera_projects_as_a_camera_does():
    forward = np.subtract(plotting.TARGET, plotting.CAMERA)
    forward /= np.linalg.norm(forward)
    right = np.array([forward[1], -forward[0], 0.0])
    right /= np.linalg.norm(right)
    up = np.cross(right, forward)
    assert up[2] > 0.0
    seen = [(10, 0, 0), (10, 2, 0), (10, 0, 4), (20, 0, 4), (-5, 0, 0)]
    place, depth = plotting.project(plotting.CAMERA + np.array(seen) @ [forward, right, up])
    expected = plotting.ZOOM * np.array([(0, 0), (0.2, 0), (0, 0.4), (0, 0.2)])
    np.testing.assert_allclose(place[:4], expected, atol=1e-12)
    np.testing.assert_allclose(depth, [10, 10, 10, 20, -5])
    assert np.isnan(place[4]).all()


def test_a_camera_stands_where_it_is_told():
    # The direction of the default is that of the command's --help.
    np.testing.assert_allclose(plotting.camera_at(196, 24, 32), plotting.CAMERA, atol=0.3)
    # From the left what is ahead is to the left; from ahead what is left is to the right.
    ahead, left = np.add(plotting.TARGET, (5, 0, 0)), np.add(plotting.TARGET, (0, 5, 0))
    assert plotting.project(ahead, plotting.camera_at(90, 0, 20))[0][0] == pytest.approx(
        -0.25 * plotting.ZOOM
    )
    assert plotting.project(left, plotting.camera_at(0, 10, 20))[0][0] > 0.2 * plotting.ZOOM
    assert plotting.project(left, plotting.camera_at(0, 10, 40))[0][0] < 0.2 * plotting.ZOOM


def test_pdf_and_svg_hold_points_as_pixels(scan, tmp_path):
    for name, begin in (('a.pdf', b'%PDF'), ('a.svg', b'<?xml')):
        assert run('plot', 'scan', scan, '-o', tmp_path / name) == 0
        found = (tmp_path / name).read_bytes()
        assert found.startswith(begin) and len(found) < 2_000_000
    assert found.count(b'<image') >= 1 and found.count(b'<use') < 100


def test_command_draws_a_scan_and_its_errors(scan, tmp_path, capsys):
    path = tmp_path / 'a.png'
    assert run('plot', 'scan', scan, '-o', path) == 0
    said = r'sensor: .*\n[\d ]+ points: [\d ]+ ground, [\d ]+ obstacle, written to .*a\.png\n'
    assert re.fullmatch(said, capsys.readouterr().out)
    assert where(path, plotting.COLOURS['missed ground'])[1] == 0
    words = ['--labels', scan.with_suffix('.label'), '-o', path, '--force']
    assert run('plot', 'scan', scan, *words) == 0
    assert where(path, plotting.COLOURS['missed ground'])[1] > 10


# Segments from the side.


def test_command_draws_segments_side_by_side(scan, tmp_path, capsys):
    """The wall ahead is in the first of the two only; its errors are where they are known."""
    path = tmp_path / 'a.png'
    words = '--segment', f'{SEGMENT},91', '--labels', scan.with_suffix('.label'), '-o', path
    assert run('plot', 'segment', scan, *words) == 0
    result = GroundSegmenter().segment(ahead()[0])
    first, last = result.candidates.offsets[SEGMENT : SEGMENT + 2]
    assert capsys.readouterr().out.partition('\n')[2] == (
        f'segment 90: {last - first} candidates, {result.surface.inlier[first:last].sum()} '
        f'inliers, {np.diff(result.pseudo.offsets)[SEGMENT]} pseudo-inputs; '
        f'segment 91: 0 candidates, 0 inliers, 0 pseudo-inputs, written to {path}\n'
    )
    # Both panels, without the legend.
    left, right = np.split(imread(path)[..., :3], [972, 1880], axis=1)[:2]
    for name in ('ground', 'obstacle', 'missed ground'):
        assert close_to(left, plotting.COLOURS[name], 0.01).sum() > 10
    assert not close_to(right, plotting.COLOURS['obstacle'], 0.01).any()


def test_what_is_drawn_is_the_result():
    """The curves' data, read back from the axes."""
    points = hilly_scan().astype(np.float32)
    result = GroundSegmenter().segment(points)
    above, below = Figure().subplots(2)
    view = plotting.SegmentView(result, SEGMENT, points[:, 2])
    view.draw_ground(above)
    view.draw_length_scale(below)

    drawn = {line.get_label(): line for line in above.lines}
    own, inside = result.segment(SEGMENT), result.candidates.segment == SEGMENT
    begins = np.flatnonzero(np.diff(result.lines.line[inside])) + 1
    assert len(begins) > 0
    np.testing.assert_array_equal(drawn['critical points'].get_xdata(), own.r[begins])
    np.testing.assert_array_equal(drawn['candidates, inliers'].get_ydata(), own.z[own.inlier])
    np.testing.assert_array_equal(drawn['surface'].get_ydata(), own.mean)
    relief = result.relief.at_knots(own.knots, result.grid.n_segments)[SEGMENT]
    assert relief.any()
    over = result.surface.mean[SEGMENT, : len(own.knots)]
    np.testing.assert_array_equal(own.mean, over + relief)
    # A line over the relief ends where its first and its last candidate are, nearly.
    lines = [line for line in above.lines if len(line.get_xdata()) == 16]
    assert len(lines) > 1
    for line in lines:
        ends = np.interp(line.get_xdata()[[0, -1]], own.r, own.z)
        np.testing.assert_allclose(line.get_ydata()[[0, -1]], ends, atol=0.15)

    length_scale, pseudo, *_ = (line.get_data() for line in below.lines)
    np.testing.assert_array_equal(length_scale[1], own.length_scale)
    np.testing.assert_array_equal(pseudo, [own.pseudo_r, own.pseudo_l])
    # The curve follows the pseudo-inputs: it stays among them and near each.
    off = np.abs(np.log(np.interp(pseudo[0], *length_scale) / pseudo[1]))
    assert off.mean() < 0.5 and off.max() < 1.0
