"""``node-bench``: a real node in a second process, small and short."""

import json
import os

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='ROS is not installed')
pytest.importorskip('rosbags', reason='rosbags is not installed')

import ros_helpers  # noqa: F401  imports type support, which warns
from conftest import hilly_scan

from gp_ground_seg.cli import main as cli


@pytest.fixture
def scans(tmp_path):
    folder = tmp_path / 'scans'
    folder.mkdir()
    for k in range(3):
        scan = np.zeros((6000, 4), '<f4')
        scan[:, :3] = hilly_scan(6000, seed=k)
        scan.tofile(folder / f'{k:06d}.bin')
    return folder


def test_losses_are_reported(scans, tmp_path, capsys):
    file = tmp_path / 'node.json'
    words = [
        'node-bench', str(scans), '--rates', '5,1000', '--frames', '30',
        '--json', str(file), '--quiet',
        '--ros-args', '-p', 'learning.mode:=fixed',
    ]  # fmt: skip
    assert cli.main(words) == 0
    document = json.loads(file.read_text())
    said = capsys.readouterr().out
    slow, fast = document['rates']
    assert (slow['n_sent'], fast['n_sent']) == (30, 30)
    # Clouds that take some milliseconds, 1 ms apart: the oldest have to go.
    assert fast['n_lost'] > 0
    for rate in (slow, fast):
        assert rate['n_lost'] == rate['n_dropped'] == rate['n_sent'] - rate['n_back']
        assert rate['is_newest_back']
        assert 0.0 < rate['p50'] <= rate['p95'] <= rate['p99'] <= rate['worst']
    assert slow['n_lost'] == 0
    assert document['source']['n_clouds'] == 3
    assert document['source']['node_arguments'] == ['-p', 'learning.mode:=fixed']
    assert document['environment']['n_cores'] == len(os.sched_getaffinity(0))
    assert 'Rate [Hz]' in said
    assert '1000' in said


def test_a_node_that_cannot_start_is_an_error(scans, capsys):
    words = ['node-bench', str(scans), '--quiet']
    assert cli.main([*words, '--ros-args', '-p', 'label.ground_tolerance:=9.0']) == 2
    said = capsys.readouterr().err
    assert said.startswith('gp-ground-seg: error: the node ended with code 2')
    assert 'label.ground_tolerance = 9.0' in said


@pytest.mark.parametrize(
    ('words', 'complaint'),
    [
        (['--topic', '/points'], '--topic /points: goes with a bag'),
        (['nowhere'], 'nowhere: no such file or folder'),
    ],
)
def test_what_cannot_be_measured_is_said_first(words, complaint, capsys):
    assert cli.main(['node-bench', *words]) == 2
    assert capsys.readouterr().err == f'gp-ground-seg: error: {complaint}\n'


@pytest.mark.parametrize('words', [['--rates', 'fast'], ['--rates', '0'], ['--frames', '9']])
def test_numbers_out_of_range_are_refused(words, capsys):
    with pytest.raises(SystemExit, match='2'):
        cli.main(['node-bench', *words])
    assert 'must be' in capsys.readouterr().err
