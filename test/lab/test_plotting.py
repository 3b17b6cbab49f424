"""The pictures of scans and scores, by their pixels."""

import re
import subprocess
import sys

import numpy as np
import pytest
from cli_runner import error_line, run
from conftest import hilly_scan
from matplotlib.colors import to_rgb
from matplotlib.image import imread

from gp_ground_seg import GroundSegmenter
from gp_ground_seg.core.errors import DataError, MissingDependencyError, PointCloudError
from gp_ground_seg.lab import plotting
from gp_ground_seg.lab.plotting import (
    CAMERA,
    COLOURS,
    TARGET,
    ZOOM,
    camera_at,
    label_layers,
    plot_scan_view,
    project,
)


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
    plot_scan_view(points, label, tmp_path / 'a.png', truth=truth)
    for name, (x, y) in places.items():
        centre, n = where(tmp_path / 'a.png', COLOURS[name])
        assert n > 300
        np.testing.assert_allclose(centre, project(np.array([x, y, -1.75]))[0], atol=0.01)
    # Without the truth, and from above.
    above = camera_at(0, 89, 60)
    plot_scan_view(points, label, tmp_path / 'a.png', camera=above)
    assert where(tmp_path / 'a.png', COLOURS['missed ground'])[1] == 0
    assert where(tmp_path / 'a.png', COLOURS['obstacle'])[1] > 1000


def test_counts_are_in_words():
    label = np.array([0, 1, 1, 2, 2, 2], dtype=np.uint8)
    truth = np.array([1, 1, 2, 1, 2, 0], dtype=np.uint8)
    words = [label_layers(label)[0], label_layers(label[1:])[0]]
    assert words == ['6 points: 2 ground, 3 obstacle, 1 unknown', '5 points: 2 ground, 3 obstacle']
    assert label_layers(label, truth)[0] == '1 false ground, 2 missed ground, IoU 25.00 %'
    assert label_layers(label[:0], truth[:0])[0] == '0 false ground, 0 missed ground'


@pytest.mark.parametrize('points', [np.zeros((0, 3)), np.full((3, 4), np.nan), np.zeros((1, 3))])
def test_clouds_with_nothing_to_see(tmp_path, points):
    label = np.zeros(len(points), dtype=np.uint8)
    (tmp_path / 'a.png').write_text('old')
    plot_scan_view(points, label, tmp_path / 'a.png', r'$\nothing _ %', truth=label)
    assert imread(tmp_path / 'a.png').ndim == 3
    assert list(tmp_path.iterdir()) == [tmp_path / 'a.png']


def test_colours_differ_in_grey_too():
    """Ground and obstacles must be told apart in print and with any colour vision."""
    grey = {name: np.dot(to_rgb(c), (0.2126, 0.7152, 0.0722)) for name, c in COLOURS.items()}
    assert grey['ground'] - grey['obstacle'] > 0.3
    assert grey['ground'] - max(grey['false ground'], grey['missed ground']) > 0.25


@pytest.mark.parametrize(
    ('keywords', 'error', 'message'),
    [
        ({'label': np.zeros(9, np.uint8)}, PointCloudError, r'label of shape \(9,\) for 4000'),
        ({'truth': np.zeros(9, np.uint8)}, PointCloudError, r'truth of shape \(9,\) for 4000'),
        ({'points': np.zeros(5)}, PointCloudError, r'\(5,\)'),
        ({'path': '/no/such/folder/a.png'}, DataError, '/no/such/folder'),
        ({'path': '/'}, DataError, 'not a file'),
    ],
)
def test_bad_input_is_said(tmp_path, keywords, error, message):
    good = {'points': patch(0, 0), 'label': repeat(0), 'path': tmp_path / 'a.png'}
    with pytest.raises(error, match=message):
        plot_scan_view(**{**good, **keywords})
    assert list(tmp_path.iterdir()) == []


def test_matplotlib_is_optional_and_its_global_state_untouched(tmp_path, monkeypatch):
    script = (
        'import sys, numpy as np\n'
        'from gp_ground_seg.lab.plotting import plot_scan_view\n'
        'assert "matplotlib" not in sys.modules\n'
        'plot_scan_view(np.zeros((2, 3)), np.ones(2, np.uint8), sys.argv[1])\n'
        'assert "matplotlib" in sys.modules and "matplotlib.pyplot" not in sys.modules\n'
    )
    words = [sys.executable, '-c', script, str(tmp_path / 'a.png')]
    subprocess.run(words, check=True, timeout=60)
    monkeypatch.setitem(sys.modules, 'matplotlib.figure', None)
    with pytest.raises(MissingDependencyError, match='matplotlib'):
        plot_scan_view(np.zeros((2, 3)), np.ones(2, np.uint8), tmp_path / 'b.png')
    assert not (tmp_path / 'b.png').exists()


def test_camera_projects_as_a_camera_does():
    forward = np.subtract(TARGET, CAMERA)
    forward /= np.linalg.norm(forward)
    right = np.array([forward[1], -forward[0], 0.0])
    right /= np.linalg.norm(right)
    up = np.cross(right, forward)
    assert up[2] > 0.0
    seen = [(10, 0, 0), (10, 2, 0), (10, 0, 4), (20, 0, 4), (-5, 0, 0)]
    place, depth = project(CAMERA + np.array(seen) @ [forward, right, up])
    expected = ZOOM * np.array([(0, 0), (0.2, 0), (0, 0.4), (0, 0.2)])
    np.testing.assert_allclose(place[:4], expected, atol=1e-12)
    np.testing.assert_allclose(depth, [10, 10, 10, 20, -5])
    assert np.isnan(place[4]).all()


def test_picture_has_its_title_above_and_its_legend_below(tmp_path):
    points = hilly_scan(8000).astype(np.float32)
    points[:10] = np.nan
    label = GroundSegmenter().segment(points).label
    for title, height in (('title with $ and _', 840), ('', 792)):
        plot_scan_view(points, label, tmp_path / 'scan.png', title)
        picture = imread(tmp_path / 'scan.png')
        assert picture.shape[:2] == (height, 1440)
        for name in ('ground', 'obstacle'):
            assert close_to(picture[60:650], COLOURS[name]).sum() > 400
            # The legend is below the scene, not in it.
            assert close_to(picture[-72:, :720], COLOURS[name]).sum() > 50


def on_screen(camera, *points):
    return project(np.array(points, dtype=float), camera)[0]


def test_a_camera_stands_where_it_is_told():
    turn = np.degrees(np.arctan2(*np.subtract(CAMERA, TARGET)[1::-1]))
    distance = np.linalg.norm(np.subtract(CAMERA, TARGET))
    up = np.degrees(np.arcsin((CAMERA[2] - TARGET[2]) / distance))
    assert (turn + 360, up, distance) == pytest.approx((196, 24, 32), abs=0.2)  # as --help says
    np.testing.assert_allclose(camera_at(turn, up, distance), CAMERA, atol=1e-9)
    ahead, left = np.add(TARGET, (5, 0, 0)), np.add(TARGET, (0, 5, 0))
    # From the left what is ahead is to the left; from ahead what is left is to the right.
    (x, _), (_, y) = on_screen(camera_at(90, 0, 20), ahead, np.add(TARGET, (0, 0, 1)))
    assert x == pytest.approx(-0.25 * ZOOM) and y > 0
    assert on_screen(camera_at(0, 10, 20), left)[0, 0] > 0.2 * ZOOM
    assert on_screen(camera_at(0, 10, 40), left)[0, 0] < 0.2 * ZOOM


@pytest.fixture(scope='module')
def drawn(tmp_path_factory):
    """Scan of level ground with a wall, and its file."""
    rng = np.random.default_rng(0)
    ground = rng.uniform((-20, -20, -1.75), (30, 20, -1.71), (20000, 3))
    wall = rng.uniform((20, -10, -1.7), (20.1, 10, 0.3), (4000, 3))
    points = np.column_stack([np.concatenate([ground, wall]), np.zeros(24000)]).astype('<f4')
    path = tmp_path_factory.mktemp('scans') / 'a.bin'
    points.tofile(path)
    return path


def test_pdf_and_svg_hold_points_as_pixels_and_are_the_same_each_time(drawn, tmp_path):
    for name, begin in (('a.pdf', b'%PDF'), ('a.svg', b'<?xml')):
        found = []
        for _ in range(2):
            assert run('plot', 'scan', drawn, '-o', tmp_path / name, '--force') == 0
            found.append((tmp_path / name).read_bytes())
        assert found[0] == found[1]
        assert found[0].startswith(begin) and len(found[0]) < 2_000_000
    assert found[0].count(b'<image') >= 1 and found[0].count(b'<use') < 100


@pytest.mark.parametrize('camera', ['90', '90,30', 'a,b,c', '0,90,20', '0,20,0.5', '0,20,nan'])
def test_a_camera_that_sees_nothing_is_refused(capsys, camera):
    assert run('plot', 'scan', 'a.bin', f'--camera={camera}', '-o', 'a.png') == 2
    assert 'as in 90,30,40' in error_line(capsys)


def test_command_draws_a_scan_and_keeps_what_is_there(drawn, tmp_path, capsys):
    path = tmp_path / 'a.png'
    words = ['plot', 'scan', drawn, '-o']
    assert run(*words, path) == 0
    said = r'[\d ]+ points: [\d ]+ ground, [\d ]+ obstacle, written to .*a\.png\n'
    assert re.fullmatch(said, capsys.readouterr().out)
    before = path.read_bytes()
    for wrong, message in (
        ([path], '--force replaces it'),
        ([tmp_path / 'a.jpg'], 'must end in .png or .pdf or .svg'),
    ):
        assert run(*words, *wrong) == 2
        assert message in error_line(capsys)
    assert path.read_bytes() == before
    np.zeros((9, 4), '<f4').tofile(tmp_path / 'x.bin')
    assert run('plot', 'scan', tmp_path / 'x.bin', '-o', path, '--force') == 0
    assert path.read_bytes() != before


def test_command_draws_the_errors(tmp_path, capsys):
    points = np.column_stack([hilly_scan(8000), np.zeros(8000)]).astype('<f4')
    points.tofile(tmp_path / 'a.bin')
    np.full(8000, 40, '<u4').tofile(tmp_path / 'a.label')
    words = ['--labels', tmp_path / 'a.label', '-o', tmp_path / 'a.png']
    assert run('plot', 'scan', tmp_path / 'a.bin', *words) == 0
    said = r'0 false ground, [\d ]+ missed ground, IoU [\d.]+ %, written to'
    assert re.match(said, capsys.readouterr().out.splitlines()[-1])
    assert where(tmp_path / 'a.png', COLOURS['missed ground'])[1] > 500


DEFICIENCIES = {
    'none': np.eye(3),
    'protanopia': [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216],
                   [-0.003882, -0.048116, 1.051998]],
    'deuteranopia': [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413],
                     [-0.011820, 0.042940, 0.968881]],
    'tritanopia': [[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602],
                   [0.004733, 0.691367, 0.303900]],
}  # fmt: skip


@pytest.mark.parametrize('name', DEFICIENCIES)
def test_lightness_of_the_colours_rises_for_every_eye(name):
    colours = plotting.ramp_colours(np.linspace(1.0, 50.0, 30), 1.0, 50.0)
    linear = np.where(colours <= 0.04045, colours / 12.92, ((colours + 0.055) / 1.055) ** 2.4)
    seen = np.clip(linear @ np.transpose(DEFICIENCIES[name]), 0.0, 1.0)
    lightness = 116.0 * np.cbrt(seen @ [0.2126, 0.7152, 0.0722]) - 16.0
    assert np.diff(lightness).min() > 1.0
    assert np.ptp(lightness) > 60.0


def test_colours_end_at_the_limits_and_nan_is_grey():
    values = np.array([1.0, 50.0, 0.01, 500.0, np.inf, -np.inf, np.nan])
    ends = plotting.ramp_colours(values, 1.0, 50.0)
    np.testing.assert_array_equal(ends[2], ends[0])
    np.testing.assert_array_equal(ends[3], ends[1])
    assert not np.array_equal(ends[0], ends[1])
    np.testing.assert_array_equal(ends[4:], [plotting.UNKNOWN] * 3)
