"""Scenes, recordings for Rerun, sliders; and what the commands refuse."""

import functools
import re
import socket
import sys
import urllib.request
from pathlib import Path

import numpy as np
import pytest
from bag_samples import write_ros2_bag
from cli_runner import error_line, run, until_ctrl_c
from conftest import ROAD, simulated

from gp_ground_seg import Config, GroundSegmenter, Label
from gp_ground_seg.core.errors import DataError
from gp_ground_seg.core.parameters.config import find_spec
from gp_ground_seg.data.inputs import list_inputs
from gp_ground_seg.lab.viewers import html_page
from gp_ground_seg.lab.viewers.html_page import open_server
from gp_ground_seg.lab.viewers.scene import View, make_scene, palette, point_colours, read_view
from gp_ground_seg.lab.viewers.tuner import Tuner, slider_values, tunable

CAR = 10 | 7 << 16  # class of SemanticKITTI, and an instance of it
PATIENCE = 60.0


def segment(points):
    segmenter = GroundSegmenter()
    return segmenter.segment(points), segmenter


def test_colours_are_those_of_the_legends():
    points = simulated('urban').points.copy()
    points[0, 0] = np.nan
    result, _ = segment(points)
    label, n = result.label, len(points)
    by_class = point_colours('class', result)
    assert np.array_equal(by_class, palette('class')[label])
    unknown, ground, obstacle = palette('class')
    assert (by_class[0] == unknown).all() and not (ground == obstacle).all()

    before = label.copy()
    first, second = (np.flatnonzero(label == kind)[0] for kind in (Label.GROUND, Label.OBSTACLE))
    before[[first, second]] = Label.OBSTACLE, Label.GROUND
    changes = point_colours('changes', result, before)
    assert np.array_equal(changes[[first, second]], palette('changes'))
    others = np.delete(np.arange(n), [0, first, second])
    assert np.array_equal(changes[others], by_class[others])

    errors = point_colours('errors', result, before)
    _, right, missed, false = palette('errors')
    assert np.array_equal(errors[[first, second]], [false, missed])
    assert (errors[others] == right).all()
    before[first] = Label.UNKNOWN
    assert np.array_equal(point_colours('errors', result, before)[first], palette('errors')[0])

    # The ramp rises in lightness with the quantity.
    lightness = point_colours('height', result).astype(float).sum(axis=1)
    known = np.flatnonzero(np.isfinite(result.height))
    order = known[np.argsort(result.height[known])]
    assert (np.diff(lightness[order]) >= -2.0).all() and np.ptp(lightness[order]) > 200.0


def test_a_tilted_scan_is_drawn_level_and_the_mesh_lies_under_its_ground():
    tilt = 0.3
    cosine, sine = np.cos(tilt), np.sin(tilt)
    turned = simulated('flat').points[:, :3] @ [[1, 0, 0], [0, cosine, sine], [0, -sine, cosine]]
    turned = turned.astype(np.float32)
    result, segmenter = segment(turned)
    assert not result.pose.is_level
    scene = make_scene(View('a', turned), result, segmenter.config, segmenter.backend)
    ground = scene.clouds['class'].points[result.label == Label.GROUND]
    assert np.ptp(np.quantile(ground[:, 2], [0.01, 0.99])) < 0.3
    assert np.median(np.abs(result.height[result.label == Label.GROUND])) < 0.05

    vertices, triangles, colours = scene.surface
    assert len(triangles) > 1000 and colours.shape == vertices.shape
    a, b, c = (vertices[triangles[:, k]].astype(float) for k in range(3))
    normal = np.cross(b - a, c - a)
    assert (normal[:, 2] > 0.0).all()
    assert np.median(normal[:, 2] / np.linalg.norm(normal, axis=1)) > 0.99
    used = np.unique(triangles)
    distance = np.abs(vertices[used, 2] - np.median(ground[:, 2]))
    assert np.quantile(distance, 0.9) < 0.1 and distance.max() < 1.0
    # The band is as many vertices below as above.
    low, high = np.split(scene.band.vertices, 2)
    assert (low[used, 2] < vertices[used, 2]).all() and (vertices[used, 2] < high[used, 2]).all()
    assert len(scene.clouds['candidates'].points) == len(result.candidates.r)


def test_faces_are_on_walls(sequence):
    view = read_view(list_inputs(sequence)[0])
    result, segmenter = segment(view.points)
    scene = make_scene(view, result, segmenter.config, segmenter.backend)
    kinds = simulated('urban')
    tall = np.isin(scene.clouds['faces'].points, kinds.points[~kinds.is_ground, :3]).all(axis=1)
    assert len(tall) > 300 and tall.mean() > 0.8
    assert set(scene.clouds) == {'class', 'height', 'p_ground', 'errors', 'faces', 'candidates'}


def test_scores_of_labels(tmp_path):
    """A car of 20 returns that is called ground is lost; labels can be named."""
    x, y = np.meshgrid(np.linspace(3.0, 20.0, 40), np.linspace(-8.0, 8.0, 40))
    ground = np.column_stack([x.ravel(), y.ravel(), np.full(1600, -1.7), np.zeros(1600)])
    car = np.column_stack(
        [np.full(20, 8.0), np.linspace(-1, 1, 20), np.full(20, -0.9), np.ones(20)]
    )
    np.concatenate([ground, car]).astype('<f4').tofile(tmp_path / 'a.bin')
    np.repeat([ROAD, CAR], [1600, 20]).astype('<u4').tofile(tmp_path / 'b.label')
    (item,) = list_inputs(tmp_path / 'a.bin')
    assert read_view(item).scores(np.full(1620, 1)) == {}
    view = read_view(item, str(tmp_path / 'b.label'))
    scores = view.scores(np.full(1620, Label.GROUND, np.uint8))
    assert (scores['lost'], scores['objects']) == (1, 1)
    assert scores['IoU'] == pytest.approx(100.0 * 1600 / 1620)
    right = np.repeat([Label.GROUND, Label.OBSTACLE], [1600, 20]).astype(np.uint8)
    assert view.scores(right) == {'IoU': 100.0, 'lost': 0, 'objects': 1}


@pytest.mark.parametrize('name', [s.name for s in tunable() if s.type in (int, float)])
def test_a_slider_goes_through_accepted_values(name):
    spec = find_spec(name)
    values = slider_values(spec, spec.default)
    assert [spec.check(value) for value in values] == values == sorted(set(values))
    assert len(values) > 20 or spec.type is int
    assert spec.default in values or spec.default == 'auto'


def test_a_slider_holds_the_value_at_hand_and_is_logarithmic_where_that_helps():
    spec = find_spec('label.ground_tolerance')
    values = slider_values(spec, 0.1234)
    assert 0.1234 in values
    assert (values[0], values[-1]) == (0.02, 0.5)
    middle = values[len(values) // 2]
    assert 0.05 < middle < 0.15
    assert 3.0 in slider_values(spec, 3.0)
    roll = slider_values(find_spec('sensor.roll'), 'auto')
    assert (roll[0], roll[-1]) == (-0.3, 0.3)


rerun = functools.partial(pytest.importorskip, 'rerun', reason='rerun is not installed')


@pytest.fixture
def record(tmp_path):
    """Values by frame and by path of what `view --save` records, and what its views show."""
    rerun()
    from rerun.chunk import RrdReader

    def record(*words):
        path = tmp_path / 'a.rrd'
        assert run('view', *words, '--save', path, '--quiet') == 0
        reader, found = RrdReader(path), {}
        (blueprint,) = reader.blueprints()
        for chunk in reader.stream():
            if not chunk.is_static:
                batch = chunk.to_record_batch()
                values = (':positions', ':scalars', ':vertex_positions')
                (name,) = (n for n in batch.schema.names if n.endswith(values))
                pairs = zip(batch['frame'].to_pylist(), batch[name].to_pylist(), strict=True)
                found.setdefault(chunk.entity_path, {}).update(pairs)
        batches = [chunk.to_record_batch() for chunk in reader.stream(store=blueprint)]
        origin = 'ViewBlueprint:space_origin'
        origins = [b[origin].to_pylist() for b in batches if origin in b.schema.names]
        return found, {name for ((name,),) in origins} - {'scan', 'about'}

    return record


def test_a_recording_has_every_frame(sequence, record):
    found, shown = record(sequence)
    assert shown == {'latency', 'IoU', 'lost'}
    layers = {'class', 'height', 'p_ground', 'errors', 'faces', 'candidates', 'surface', 'band'}
    assert {f'/scan/{name}' for name in layers} | {'/IoU', '/lost', '/latency'} <= found.keys()
    assert any(name.startswith('/theta/') for name in found)
    assert all(sorted(values) == [0, 1] for values in found.values())
    segmenter = GroundSegmenter()
    for k, item in enumerate(list_inputs(sequence)):
        view = read_view(item)
        result = segmenter.segment(view.points)
        assert found['/IoU'][k] == [pytest.approx(view.scores(result.label)['IoU'])]
        assert np.array_equal(np.float32(found['/scan/class'][k]), view.points[:, :3])


def test_only_the_frames_asked_for_and_no_series_that_need_labels(tmp_path, record):
    write_ros2_bag(tmp_path / 'drive.mcap')
    for words, expected in ((['--frame', 1], [1]), (['--frame-step', 2, '--force'], [0, 2])):
        found, shown = record(tmp_path / 'drive.mcap', *words)
        assert sorted(found['/scan/class']) == expected
        assert shown == {'latency'}


def free_ports():
    """Return the first of two free ports in a row."""
    while True:
        with socket.socket() as one, socket.socket() as next_one:
            one.bind(('127.0.0.1', 0))
            port = one.getsockname()[1]
            try:
                next_one.bind(('127.0.0.1', port + 1))
            except OSError:
                continue
            return port


def test_the_tuner_draws_the_labels_of_its_parameters(sequence):
    pytest.importorskip('viser', reason='viser is not installed')
    name = 'label.ground_tolerance'
    with open_server(0) as (server, _):
        tuner = Tuner(server, list_inputs(sequence), Config(), [name])
        assert tuner.config == Config()
        for tolerance, changed in ((Config()[name], '0 changed: 0 now ground'), (0.01, 'changed')):
            tuner.show(0, 'changes', Config().replace(**{name: tolerance}))
            assert changed in tuner._table.content
        n_ground, n_before = re.search(
            r'ground \| ([\d ]+) \| ([\d ]+)', tuner._table.content
        ).groups()
        assert int(n_ground.replace(' ', '')) < int(n_before.replace(' ', ''))


def test_a_server_that_cannot_be_guarded_is_refused():
    pytest.importorskip('viser', reason='viser is not installed')
    with pytest.raises(DataError, match='install viser'), html_page._guarded('token'):
        pass  # as a later viser might do: another function serves


@pytest.mark.slow
def test_the_web_viewer_is_served_here_only_and_ends_with_ctrl_c(sequence):
    rerun()
    port = free_ports()
    with until_ctrl_c('view', sequence, '--web', '--port', port) as process:
        address = process.stdout.readline().strip()
        assert address.startswith(f'http://127.0.0.1:{port}/?url=rerun%2Bhttp')
        with urllib.request.urlopen(address, timeout=PATIENCE) as answer:
            assert b'Rerun' in answer.read()
        assert listening(port) == listening(port + 1) == {'0100007F'}
    assert listening(port) == listening(port + 1) == set()


def test_the_next_free_port_is_taken_and_said(caplog):
    port = free_ports()
    assert html_page.free_port(port, 2) == port and not caplog.messages
    with socket.create_server(('127.0.0.1', port + 1)):
        assert html_page.free_port(port) == port
        found = html_page.free_port(port, 2)
    assert found >= port + 2
    assert caplog.messages == [f'port {port} is in use: {found} instead']
    with pytest.raises(DataError, match=r'--port 65536: no free port there'):
        html_page.free_port(65536)


def test_a_page_beside_another_one(sequence):
    pytest.importorskip('viser', reason='viser is not installed')
    port = free_ports()
    with open_server(port) as (_, first), open_server(port) as (_, second):
        assert f':{port}/' in first and f':{port}/' not in second


def listening(port):
    """Addresses that a port listens on, as hexadecimal words; see proc_net_tcp(5)."""
    tables = [Path(f'/proc/net/{name}').read_text() for name in ('tcp', 'tcp6')]
    lines = [line.split() for table in tables for line in table.splitlines()[1:]]
    found = [line[1].split(':') for line in lines if line[3] == '0A']
    return {address for address, number in found if int(number, 16) == port}


def test_what_is_refused(sequence, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv('DISPLAY', raising=False)
    monkeypatch.delenv('WAYLAND_DISPLAY', raising=False)
    taken = {name: tmp_path / name for name in ('a.html', 'a.rrd', 'tuned.yaml')}
    for path in taken.values():
        path.write_text('mine')
    cases = {
        ('view', sequence): 'no display here: --web, --save FILE and --html FILE need none',
        ('view', sequence, '--html', 'a.htm'): 'a.htm: must end in .html',
        ('view', sequence, '--save', 'a.html'): 'a.html: must end in .rrd',
        ('view', sequence, '--html', 'a.html'): 'a.html: exists already; --force replaces it',
        ('view', sequence, '--frame', 2): '--frame 2: must be 0 to 1 here',
        ('view', tmp_path / 'none'): f'{tmp_path / "none"}: no such file or folder',
        ('tune', sequence): 'tuned.yaml: exists already; --force replaces it',
        ('tune', sequence, '--topic', '/a'): f'--topic: is for bags, which {sequence} is not',
    }
    if sys.version_info >= (3, 11):
        cases['view', sequence, '--save', 'a.rrd'] = 'a.rrd: exists already; --force replaces it'
    for words, expected in cases.items():
        assert run(*words, '--quiet') == 2
        assert error_line(capsys) == expected
    assert [path.read_text() for path in taken.values()] == ['mine'] * 3


@pytest.mark.parametrize(
    ('words', 'module', 'package'),
    [
        (('view', '--save', 'a.rrd'), 'rerun', 'rerun-sdk'),
        (('view', '--web'), 'rerun', 'rerun-sdk'),
        (('view', '--html', 'a.html'), 'viser', 'viser'),
        (('tune', '-o', 'a.yaml'), 'viser', 'viser'),
    ],
)
def test_a_missing_library_is_one_line(
    words, module, package, sequence, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, module, None)
    command, *more = words
    assert run(command, sequence, '--quiet', *more) == 2
    line = error_line(capsys)
    assert line.startswith(f'{module} is not installed')
    assert line.endswith(f'pip install {package}')
    assert not list(tmp_path.iterdir())
