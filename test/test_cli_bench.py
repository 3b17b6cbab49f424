"""The command `bench` on real files, and its picture."""

import argparse
import json

import numpy as np
import pytest
from bag_samples import scan, write_ros1_bag, write_ros2_bag

from gp_ground_seg.cli import bench as command
from gp_ground_seg.cli.bench_input import load_frames
from gp_ground_seg.errors import ConfigError, DataError

QUICK = ('--quick', '--threads', '1', '--set', 'grid.n_segments=24')


def run(*words):
    parser = argparse.ArgumentParser()
    command.add_parser(parser.add_subparsers(required=True))
    arguments = parser.parse_args(['bench', *(str(word) for word in words)])
    return arguments.run(arguments)


@pytest.fixture(scope='module')
def scans(tmp_path_factory):
    folder = tmp_path_factory.mktemp('scans')
    for k in range(5):
        scan(k).tofile(folder / f'{k:06d}.bin')
    return folder


@pytest.fixture(scope='module')
def record(scans, tmp_path_factory):
    path = tmp_path_factory.mktemp('record') / 'bench.json'
    assert run(scans, '--threads', '1,2', '--numpy', '--json', path) == 0
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
        assert all(frame['ms'] > 0 and frame['yardstick_ms'] > 0 for frame in case['frames'])
        assert {'grid', 'learning', 'label', 'rest'} <= set(case['stages_ms'])
        assert all(case['stages_ms'][stage] > 0 for stage in ('grid', 'label'))
        assert case['ratio']['median'] > 0
    assert document['merged']['n_clouds'] == 1
    assert set(document['scaling']) == {'points', 'segments', 'bins', 'pseudo_inputs'}


def test_a_record_shows_what_measuring_showed(record, scans, capsys, tmp_path):
    assert run(scans, *QUICK, '--json', tmp_path / 'bench.json') == 0
    measured = capsys.readouterr().out
    assert 'Patchwork++' in measured
    assert run('--from', tmp_path / 'bench.json') == 0
    assert capsys.readouterr().out == measured
    assert run('--from', record) == 0
    shown = capsys.readouterr().out
    assert 'four frames merged' in shown
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
    ('words', 'error', 'says'),
    [
        ((), DataError, 'either DATA'),
        (('DATA', '--from', 'x.json'), DataError, 'either DATA'),
        (('nowhere',), DataError, 'no such file'),
        (('DATA', '--topic', '/points'), DataError, 'is for bags'),
        (('DATA', '--threads', '0'), DataError, '--threads 0'),
        (('DATA', '--threads', 'two'), DataError, '--threads two'),
        (('DATA', '--frames', '0'), DataError, '--frames'),
        (('DATA', '--set', 'grid.n_segments=0'), ConfigError, 'grid.n_segments'),
        (('--from', 'nowhere.json'), DataError, 'nowhere.json'),
    ],
)
def test_what_is_wrong_is_said(scans, words, error, says):
    with pytest.raises(error, match=says):
        run(*(scans if word == 'DATA' else word for word in words))


def test_other_json_is_no_record_and_nothing_is_overwritten(scans, tmp_path):
    other = tmp_path / 'other.json'
    other.write_text('{"cases": []}')
    with pytest.raises(DataError, match='not a record'):
        run('--from', other)
    with pytest.raises(DataError, match='exists already'):
        run(scans, *QUICK, '--json', other)
    assert other.read_text() == '{"cases": []}'
    empty = tmp_path / 'empty.bin'
    empty.touch()
    with pytest.raises(DataError, match='no point'):
        run(empty, *QUICK)


def test_the_picture_leaves_out_cases_without_compiled_code(record, tmp_path, monkeypatch):
    drawn = []
    monkeypatch.setattr(command, 'plot_stage_bars', lambda cases, *_, force: drawn.append(cases))
    assert run('--from', record, '--plot', tmp_path / 'bars.png') == 0
    cases = json.loads(record.read_text())['cases']
    compiled = {case['name']: case['stages_ms'] for case in cases if case['backend'] == 'numba'}
    assert drawn == [compiled] and len(compiled) < len(cases)
