"""Colours, scores, sliders and the server of `tune`, and what it refuses."""

import re
import sys

import numpy as np
import pytest
from cli_runner import error_line, run
from conftest import ROAD, simulated

from gp_ground_seg import Config, GroundSegmenter, Label
from gp_ground_seg.core.errors import DataError
from gp_ground_seg.data.inputs import list_inputs
from gp_ground_seg.lab import tuner as page
from gp_ground_seg.lab.scoring.evaluate import MethodResult, score_scan

pytestmark = pytest.mark.usefixtures('compiled_code')

CAR = 10 | 7 << 16  # class of SemanticKITTI, and an instance of it


def test_colours_are_those_of_the_legends():
    points = simulated('urban').points.copy()
    points[0, 0] = np.nan
    label, n = GroundSegmenter().segment(points).label, len(points)
    by_class = page.point_colours('class', label, label)
    assert np.array_equal(by_class, page.palette('class')[label])
    unknown, ground, obstacle = page.palette('class')
    assert (by_class[0] == unknown).all() and not (ground == obstacle).all()

    before = label.copy()
    first, second = (np.flatnonzero(label == kind)[0] for kind in (Label.GROUND, Label.OBSTACLE))
    before[[first, second]] = Label.OBSTACLE, Label.GROUND
    others = np.delete(np.arange(n), [0, first, second])
    for name in ('changes', 'errors'):
        colours = page.point_colours(name, label, before)
        assert np.array_equal(colours[[first, second]], page.palette(name))
        assert np.array_equal(colours[others], by_class[others])
    before[first] = Label.UNKNOWN
    assert np.array_equal(page.point_colours('errors', label, before)[first], ground)


def test_scores_of_labels(tmp_path):
    """A car of 20 returns that is called ground is lost; labels can be named."""
    points = np.random.default_rng(0).uniform(-10.0, 10.0, (1620, 4)).astype('<f4')
    points[:, 2], points[1600:] = -1.7, [8.0, 0.0, -0.9, 1.0]
    points.tofile(tmp_path / 'a.bin')
    np.repeat([ROAD, CAR], [1600, 20]).astype('<u4').tofile(tmp_path / 'b.label')
    (item,) = list_inputs(tmp_path / 'a.bin')
    assert page.read_view(item).truth is None
    view = page.read_view(item, str(tmp_path / 'b.label'))
    result = GroundSegmenter().segment(view.points)
    right = np.repeat([Label.GROUND, Label.OBSTACLE], [1600, 20]).astype(np.uint8)
    for label, n_lost, iou in ((np.full(1620, Label.GROUND), 1, 1600 / 1620), (right, 0, 1.0)):
        (sums,) = score_scan(view, MethodResult(label, result.ground_z))['scans']
        rows = page._table(result, right, [sums, sums]).splitlines()
        assert f'| objects lost | {n_lost} of 1 | {n_lost} of 1 |' in rows
        assert f'| IoU | {100.0 * iou:.2f} % | {100.0 * iou:.2f} % |' in rows


def test_a_slider_goes_through_accepted_values_and_holds_the_one_at_hand():
    for spec in (spec for spec in page.tunable() if spec.type in (int, float)):
        low, high, step = page.slider_range(spec, spec.default)
        assert [spec.check(value) for value in (low, high)] == [low, high]
        assert 0 < step < high - low
        assert spec.default == 'auto' or low <= spec.default <= high
    spec = Config.find_spec('label.ground_tolerance')
    low, high, step = page.slider_range(spec, 0.1234)
    assert (low, high, step) == pytest.approx((0.02, 0.5, 1e-4))
    assert page.slider_range(spec, 3.0)[1] == 3.0
    assert page.slider_range(Config.find_spec('sensor.roll'), 'auto')[:2] == (-0.3, 0.3)


@pytest.fixture
def viser():
    return pytest.importorskip('viser', reason='viser is not installed')


@pytest.mark.usefixtures('viser')
def test_what_is_set_on_the_page_is_the_configuration(sequence):
    names = ['sensor.height', 'learning.mode', 'grid.n_segments']
    config = Config().replace(**{'sensor.height': 1.5, 'grid.n_segments': 90})
    with page.open_server(0) as (server, _):
        tuner = page.Tuner(server, list_inputs(sequence), config, names)
        assert tuner.config == config
        shown = {h.label: h for h in server.gui._gui_input_handle_from_uuid.values()}
        shown['auto'].value = True
        shown['learning.mode'].value = 'fixed'
        shown['grid.n_segments'].value = 120
        expected = {'learning.mode': 'fixed', 'grid.n_segments': 120}
        assert tuner.config == Config().replace(**expected)
        shown['auto'].value = False
        assert tuner.config == Config().replace(**expected, **{'sensor.height': 1.5})


@pytest.mark.usefixtures('viser')
def test_the_tuner_draws_the_labels_of_its_parameters(sequence):
    name = 'label.ground_tolerance'
    with page.open_server(0) as (server, _):
        tuner = page.Tuner(server, list_inputs(sequence), Config(), [name])
        assert tuner.config == Config()
        for tolerance, changed in ((Config()[name], '0 changed: 0 now ground'), (0.01, 'changed')):
            tuner.show(0, 'changes', Config().replace(**{name: tolerance}))
            assert changed in tuner._table.content
        n_ground, n_before = re.search(
            r'ground \| ([\d ]+) \| ([\d ]+)', tuner._table.content
        ).groups()
        assert int(n_ground.replace(' ', '')) < int(n_before.replace(' ', ''))


@pytest.mark.usefixtures('viser')
def test_a_server_that_cannot_be_guarded_is_refused():
    with pytest.raises(DataError, match='install viser'), page._guarded('token'):
        pass  # as a later viser might do: another function serves


@pytest.mark.usefixtures('viser')
def test_the_next_free_port_is_taken_and_said(caplog):
    with page.open_server(0) as (server, _):
        port = server.get_port()
        with page.open_server(port) as (_, address):
            assert f':{port}/' not in address
    (said,) = caplog.messages
    assert re.fullmatch(rf'port {port} is in use: \d+ instead', said)
    with (
        pytest.raises(DataError, match=r'--port 65536: must be at most 64535'),
        page.open_server(65536),
    ):
        pass


def test_what_is_refused(sequence, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / 'tuned.yaml').write_text('mine')
    monkeypatch.setitem(sys.modules, 'viser', None)
    cases = {
        (sequence, '-o', 'a.yaml'): 'viser is not installed, or does not work here',
        (tmp_path / 'none',): f'{tmp_path / "none"}: no such file or folder',
        (sequence, '--frame', 2): '--frame 2: must be 0 to 1 here',
        (sequence,): 'tuned.yaml: exists already; --force replaces it',
        (sequence, '--topic', '/a'): f'--topic: is for bags, which {sequence} is not',
    }
    for words, expected in cases.items():
        assert run('tune', *words, '--quiet') == 2
        assert error_line(capsys).startswith(expected)
    assert [file.read_text() for file in tmp_path.iterdir()] == ['mine']
