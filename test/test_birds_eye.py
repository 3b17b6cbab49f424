"""The bird's-eye picture, by its pixels."""

import subprocess
import sys

import numpy as np
import pytest
from matplotlib.colors import to_rgb
from matplotlib.image import imread

from gp_ground_seg import Label
from gp_ground_seg.errors import ConfigError, DataError, MissingDependencyError, PointCloudError
from gp_ground_seg.plotting import birds_eye, canvas
from gp_ground_seg.plotting.birds_eye import plot_birds_eye

# In pixels: panels of 7.2 inches, the square 0.8 from the left and 0.4 from the top.
LEFT, TOP, SQUARE, PANEL = (round(inches * canvas.DPI) for inches in (0.8, 0.4, 6.2, 7.2))


def patch(x, y, half=2.0, n=4000, seed=0):
    rng = np.random.default_rng(seed)
    xyz = rng.uniform((x - half, y - half, -1.8), (x + half, y + half, -1.7), (n, 3))
    return xyz.astype(np.float32)


def where(path, colour, panel=0):
    """Centre in metres (x forward, y left) and number of the pixels of a colour in a panel."""
    image = imread(path)[:, :, :3]
    left = LEFT + panel * PANEL
    square = image[TOP : TOP + SQUARE, left : left + SQUARE]
    close = np.abs(square - np.array(to_rgb(colour))).max(axis=2) < 0.005
    rows, columns = np.nonzero(close)
    if not len(rows):
        return None, 0
    # The median: here and there an edge of a letter or ring is of nearly the same grey.
    forward, left = np.median(rows), np.median(columns)
    return (50.0 - forward * 100.0 / SQUARE, 50.0 - left * 100.0 / SQUARE), len(rows)


def test_colours_are_where_the_points_are(tmp_path):
    points = np.concatenate([patch(20, 30), patch(-10, -25)])
    label = np.repeat([Label.GROUND, Label.OBSTACLE], 4000).astype(np.uint8)
    plot_birds_eye(points, label, tmp_path / 'a.png')
    for colour, expected in (
        (birds_eye.GROUND_COLOUR, (20, 30)),
        (birds_eye.OBSTACLE_COLOUR, (-10, -25)),
    ):
        centre, n = where(tmp_path / 'a.png', colour)
        assert n > 500
        assert centre == pytest.approx(expected, abs=0.5)


def test_errors_have_a_panel_of_their_own(tmp_path):
    corners = {'right': (25, 25), 'false': (25, -25), 'missed': (-25, 25), 'left out': (-25, -25)}
    points = np.concatenate([patch(*corner) for corner in corners.values()])
    label = np.repeat([1, 1, 2, 2], 4000).astype(np.uint8)
    truth = np.repeat([1, 2, 1, 0], 4000).astype(np.uint8)
    plot_birds_eye(points, label, tmp_path / 'a.png', truth=truth)
    assert imread(tmp_path / 'a.png').shape[1] == 2 * PANEL
    colours = (
        birds_eye.RIGHT_COLOUR,
        birds_eye.FALSE_GROUND_COLOUR,
        birds_eye.MISSED_GROUND_COLOUR,
        birds_eye.LEFT_OUT_COLOUR,
    )
    for colour, corner in zip(colours, corners.values(), strict=True):
        centre, n = where(tmp_path / 'a.png', colour, panel=1)
        assert n > 500
        assert centre == pytest.approx(corner, abs=0.5)


def test_unknown_that_is_ground_is_missed(tmp_path):
    points = patch(20, 20)
    label = np.full(4000, Label.UNKNOWN, dtype=np.uint8)
    truth = np.full(4000, Label.GROUND, dtype=np.uint8)
    plot_birds_eye(points, label, tmp_path / 'a.png', truth=truth)
    assert where(tmp_path / 'a.png', birds_eye.UNKNOWN_COLOUR, panel=0)[1] > 500
    assert where(tmp_path / 'a.png', birds_eye.MISSED_GROUND_COLOUR, panel=1)[1] > 500


def test_extent_cuts(tmp_path):
    label = np.full(4000, Label.GROUND, dtype=np.uint8)
    plot_birds_eye(patch(45, 0), label, tmp_path / 'far.png', extent=50.0)
    plot_birds_eye(patch(45, 0), label, tmp_path / 'near.png', extent=20.0)
    assert where(tmp_path / 'far.png', birds_eye.GROUND_COLOUR)[1] > 500
    assert where(tmp_path / 'near.png', birds_eye.GROUND_COLOUR)[1] == 0


def test_counts_are_in_the_titles():
    label = np.array([0, 1, 1, 2, 2, 2], dtype=np.uint8)
    truth = np.array([1, 1, 2, 1, 2, 0], dtype=np.uint8)
    assert birds_eye._label_title(label) == '6 points: 2 ground, 3 obstacle, 1 unknown'
    assert birds_eye._label_title(label[1:]) == '5 points: 2 ground, 3 obstacle'
    assert birds_eye._error_title(label, truth) == '1 false ground, 2 missed ground, IoU 25.00 %'
    assert birds_eye._error_title(label[:0], truth[:0]) == '0 false ground, 0 missed ground'


@pytest.mark.parametrize(
    ('least', 'step'), [(10.0, 10.0), (10.1, 20.0), (0.3, 0.5), (1.0, 1.0), (6.0, 10.0)]
)
def test_rings_are_round_numbers(least, step):
    assert birds_eye._round_step(least) == pytest.approx(step)


@pytest.mark.parametrize('points', [np.zeros((0, 3)), np.full((3, 4), np.nan), np.zeros((1, 3))])
def test_clouds_with_nothing_to_see(tmp_path, points):
    label = np.zeros(len(points), dtype=np.uint8)
    plot_birds_eye(points, label, tmp_path / 'a.png', truth=label, title=r'$\nothing _ %')
    assert imread(tmp_path / 'a.png').ndim == 3


def test_colours_differ_in_grey_too():
    """Ground and obstacles must be told apart in print and with any colour vision."""

    def grey(colour):
        return np.dot(to_rgb(colour), (0.2126, 0.7152, 0.0722))

    ground, obstacle = grey(birds_eye.GROUND_COLOUR), grey(birds_eye.OBSTACLE_COLOUR)
    assert ground - obstacle > 0.3
    for error in (birds_eye.FALSE_GROUND_COLOUR, birds_eye.MISSED_GROUND_COLOUR):
        assert grey(birds_eye.RIGHT_COLOUR) - grey(error) > 0.25


def test_an_older_picture_is_replaced_and_nothing_is_left_beside_it(tmp_path):
    path = tmp_path / 'a.png'
    path.write_text('old')
    label = np.full(4000, Label.GROUND, dtype=np.uint8)
    plot_birds_eye(patch(0, 20), label, path)
    assert imread(path).ndim == 3
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize(
    ('keywords', 'error', 'message'),
    [
        ({'label': np.zeros(9, np.uint8)}, PointCloudError, r'label of shape \(9,\) for 4000'),
        ({'truth': np.zeros(9, np.uint8)}, PointCloudError, r'truth of shape \(9,\) for 4000'),
        ({'points': np.zeros(5)}, PointCloudError, r'\(5,\)'),
        ({'extent': 0.0}, ConfigError, 'extent = 0.0'),
        ({'extent': float('nan')}, ConfigError, 'extent = nan'),
        ({'path': '/no/such/folder/a.png'}, DataError, '/no/such/folder'),
        ({'path': '/'}, DataError, 'not a file'),
    ],
)
def test_bad_input_is_said(tmp_path, keywords, error, message):
    good = {
        'points': patch(0, 0),
        'label': np.zeros(4000, np.uint8),
        'path': tmp_path / 'a.png',
    }
    with pytest.raises(error, match=message):
        plot_birds_eye(**{**good, **keywords})
    assert list(tmp_path.iterdir()) == []


def test_matplotlib_is_optional_and_its_global_state_untouched(tmp_path, monkeypatch):
    script = (
        'import sys, numpy as np\n'
        'from gp_ground_seg.plotting.birds_eye import plot_birds_eye\n'
        'assert "matplotlib" not in sys.modules\n'
        'plot_birds_eye(np.zeros((2, 3)), np.ones(2, np.uint8), sys.argv[1])\n'
        'assert "matplotlib" in sys.modules and "matplotlib.pyplot" not in sys.modules\n'
    )
    words = [sys.executable, '-c', script, str(tmp_path / 'a.png')]
    subprocess.run(words, check=True, timeout=60)
    for module in ('matplotlib.backends.backend_agg', 'matplotlib.figure'):
        monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(MissingDependencyError, match='matplotlib'):
        plot_birds_eye(np.zeros((2, 3)), np.ones(2, np.uint8), tmp_path / 'b.png')
    assert not (tmp_path / 'b.png').exists()
