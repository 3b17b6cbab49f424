"""The command `bench` on real files, and its picture."""

import json
import sys

import numpy as np
import pytest
from bag_samples import scan, write_ros1_bag, write_ros2_bag
from cli_runner import run
from matplotlib.image import imread

from gp_ground_seg.cli import bench as command
from gp_ground_seg.cli.bench import load_frames
from gp_ground_seg.errors import DataError, PointCloudError

QUICK = ('--quick', '--threads', '1', '--set', 'grid.n_segments=24')


def bench(*words):
    return run('bench', *words)


@pytest.fixture(scope='module')
def scans(tmp_path_factory):
    folder = tmp_path_factory.mktemp('scans')
    for k in range(5):
        scan(k).tofile(folder / f'{k:06d}.bin')
    return folder


@pytest.fixture(scope='module')
def record(scans, tmp_path_factory):
    path = tmp_path_factory.mktemp('record') / 'bench.json'
    assert bench(scans, '--threads', '1,2', '--numpy', '--json', path) == 0
    return path


def test_record_holds_machine_cases_stages_and_series(record, scans):
    document = json.loads(record.read_text())
    assert document['data'] == scans.name
    assert document['n_frames'] == 5
    environment = document['environment']
    assert environment['cpu']
    assert {'numpy', 'numba', 'scipy', 'pypatchworkpp'} <= set(environment['versions'])
    assert [(c['mode'], c['backend'], c['n_threads']) for c in document['cases']] == [
        ('fixed', 'numba', 1), ('fixed', 'numba', 2),
        ('every_frame', 'numba', 1), ('every_frame', 'numba', 2), ('every_frame', 'numpy', 1),
    ]  # fmt: skip
    for case in document['cases']:
        assert len(case['frames']) == 5
        assert all(frame['ms'] > 0 and frame['baseline_ms'] > 0 for frame in case['frames'])
        assert {'grid', 'learning', 'label', 'rest'} <= set(case['stages_ms'])
        assert all(case['stages_ms'][stage] > 0 for stage in ('grid', 'label'))
        assert case['ratio']['median'] > 0
    series = {row['series'] for row in document['growth']}
    assert series == {'points', 'grid.n_segments', 'grid.n_bins', 'pseudo-inputs'}
    # Four frames merged are the largest clouds.
    sizes = [row['size'] for row in document['growth'] if row['series'] == 'points']
    assert sizes[-1] > 3.9 * document['n_points']['median']


def test_a_record_shows_what_measuring_showed(record, scans, capsys, tmp_path):
    assert bench(scans, *QUICK, '--json', tmp_path / 'bench.json') == 0
    measured = capsys.readouterr().out
    assert 'Patchwork++' in measured
    assert bench('--from', tmp_path / 'bench.json') == 0
    assert capsys.readouterr().out == measured
    assert bench('--from', record) == 0
    shown = capsys.readouterr().out
    assert 'pseudo-inputs' in shown
    assert max(len(line) for line in shown.splitlines()) <= 100


@pytest.mark.parametrize('kind', ['mcap', 'ros1', 'scan', 'sequences'])
def test_frames_come_from_whatever_holds_scans(kind, tmp_path):
    if kind == 'mcap':
        source = tmp_path / 'drive.mcap'
        write_ros2_bag(source, n_clouds=3)
    elif kind == 'ros1':
        source = tmp_path / 'drive.bag'
        write_ros1_bag(source, n_clouds=3)
    elif kind == 'scan':
        source = tmp_path / 'scan.bin'
        scan(0).tofile(source)
    else:
        source = tmp_path
        for name in ('00', '01'):
            (tmp_path / 'sequences' / name / 'velodyne').mkdir(parents=True)
            for k in range(2):
                scan(k).tofile(tmp_path / 'sequences' / name / 'velodyne' / f'{k:06d}.bin')
    frames = load_frames(source, 60)
    expected = {'mcap': [0, 1, 2], 'ros1': [0, 1, 2], 'scan': [0], 'sequences': [0, 1, 0, 1]}[kind]
    assert len(frames) == len(expected)
    for frame, k in zip(frames, expected, strict=True):
        assert frame.points.dtype == np.float32
        np.testing.assert_array_equal(frame.points[:, :3], scan(k)[:, :3])
    assert len({frame.sequence for frame in frames}) == (2 if kind == 'sequences' else 1)


def test_more_frames_than_wanted_are_thinned_in_runs(tmp_path):
    for k in range(45):
        scan(k, n_ground=20, n_wall=5).tofile(tmp_path / f'{k:06d}.bin')
    frames = load_frames(tmp_path, 20)
    assert [int(frame.index) for frame in frames] == [*range(10, 20), *range(30, 40)]
    assert [frame.sequence for frame in frames] == 10 * [f'{tmp_path.name}:10'] + 10 * [
        f'{tmp_path.name}:30'
    ]


@pytest.mark.parametrize(
    ('words', 'says'),
    [
        ((), 'either DATA'),
        (('DATA', '--from', 'x.json'), 'either DATA'),
        (('nowhere',), 'no such file'),
        (('DATA', '--topic', '/points'), 'is for bags'),
        (('DATA', '--threads', '0'), '--threads 0'),
        (('DATA', '--threads', 'two'), '--threads two'),
        (('DATA', '--set', 'grid.n_segments=0'), 'grid.n_segments'),
        (('--from', 'nowhere.json'), 'nowhere.json'),
        (('--from', 'OTHER'), 'not a record'),
        (('DATA', '--quick', '--json', 'OTHER'), 'exists already'),
        (('EMPTY',), 'no point'),
        (('--from', 'RECORD', '--docs', 'OTHER'), 'once each'),
        (('--from', 'RECORD', '--docs', 'nowhere.md'), 'nowhere.md: cannot be read'),
    ],
)
def test_what_is_wrong_is_said(scans, record, words, says, tmp_path, capsys):
    other, empty = tmp_path / 'other.json', tmp_path / 'empty.bin'
    other.write_text('{"cases": []}')
    empty.touch()
    named = {'DATA': scans, 'OTHER': other, 'EMPTY': empty, 'RECORD': record}
    assert bench(*(named.get(word, word) for word in words)) == 2
    assert says in capsys.readouterr().err
    assert other.read_text() == '{"cases": []}'


def test_tables_go_between_the_marks(record, tmp_path, capsys):
    page = tmp_path / 'page.md'
    page.write_text('a\n<!-- bench:begin --><!-- bench:end -->\nb\n')
    assert bench('--from', record, '--docs', page, '--plot', tmp_path / 'a.png') == 0
    assert capsys.readouterr().out in page.read_text()
    assert imread(tmp_path / 'a.png').shape[2] == 4


def test_a_broken_cloud_of_a_bag_is_named(tmp_path, monkeypatch):
    def refuse(_):
        raise PointCloudError('no field x')

    monkeypatch.setattr('gp_ground_seg.cli.bench.decode_cloud', refuse)
    write_ros2_bag(tmp_path / 'drive.mcap', n_clouds=2)
    with pytest.raises(DataError, match=r'drive\.mcap: message 0 of topic .*: no field x'):
        load_frames(tmp_path / 'drive.mcap', 60)


def test_without_the_baseline_there_are_no_ratios(scans, monkeypatch, tmp_path, capsys):
    monkeypatch.setitem(sys.modules, 'pypatchworkpp', None)
    assert bench(scans, *QUICK, '--json', tmp_path / 'a.json') == 0
    assert 'pip install pypatchworkpp' in capsys.readouterr().err
    document = json.loads((tmp_path / 'a.json').read_text())
    assert document['baseline'] is document['baseline_ms'] is None
    assert 'ratio' not in document['cases'][0]


def test_the_picture_leaves_out_cases_without_compiled_code(record, tmp_path, monkeypatch):
    drawn = []
    monkeypatch.setattr(command, 'plot_stage_bars', lambda cases, *_, force: drawn.append(cases))
    assert bench('--from', record, '--plot', tmp_path / 'bars.png') == 0
    cases = json.loads(record.read_text())['cases']
    compiled = {case['name']: case['stages_ms'] for case in cases if case['backend'] == 'numba'}
    assert drawn == [compiled] and len(compiled) < len(cases)
