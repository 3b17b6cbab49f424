"""The command `demo`: what it says, writes and leaves running; its counts."""

import importlib
import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from bag_samples import read_messages
from cli_runner import PATIENCE, children, is_running, start, until_ctrl_c, wait_for
from conftest import REPOSITORY

from gp_ground_seg.cli import demo
from gp_ground_seg.cli.demo import Tally
from gp_ground_seg.core.errors import GroundSegError
from gp_ground_seg.core.frame import Label
from gp_ground_seg.data.bags import cloud_from_points, decode_cloud
from gp_ground_seg.data.point_cloud2 import select_points
from gp_ground_seg.ros import loader, session
from gp_ground_seg.ros.node_process import NodeProcess, private_session


def test_labels_are_scored():
    """Of a scan of road 40 and car 10, half and half, one outlier 1, one point not finite."""
    points = np.random.default_rng(0).normal(0.0, 5.0, (40, 4)).astype(np.float32)
    is_road = np.arange(40) % 2 == 0
    semantic = np.where(is_road, 40, 10).astype(np.uint32)
    points[3, 2], semantic[1] = np.nan, 1
    cloud = cloud_from_points(points, 5_000_000_007, demo.FRAME_ID, label=semantic)
    tally = Tally()

    def back(is_ground):
        """What a right node makes of it: the point that is not finite in neither cloud."""
        finite = np.isfinite(points).all(axis=1)
        parts = ('ground', is_ground & finite), ('obstacles', ~is_ground & finite)
        return {topic: select_points(cloud, chosen) for topic, chosen in parts}

    tally.add(cloud, back(is_road), 0.05, False)
    wrong = back(is_road ^ np.isin(np.arange(40), (0, 2, 5)))
    tally.add(cloud, wrong, 0.07, True)
    # The outlier does not count.
    assert tally.counts == {'tp': 38, 'fp': 1, 'fn': 2, 'tn': 35}
    assert (tally.label == Label.GROUND).sum() == 19
    text = tally.summary()
    assert '78 in 2 scans sent, 78 back' in text
    assert f'IoU {100 * 38 / 41:.2f} %' in text and 'median 60.0 ms' in text
    assert 'numpy for 1 scans, compiled code for 1' in text and 'FAILED' not in text
    wrong['ground'] = select_points(wrong['ground'], np.arange(19) != 4)
    tally.add(cloud, wrong, 0.05, True)
    assert '117 in 3 scans sent, 116 back' in tally.summary()
    assert 'FAILED: each point must come back once' in tally.summary()


@pytest.fixture
def rclpy():
    pytest.importorskip('rclpy', reason='ROS is not installed')
    importlib.import_module('ros_helpers')  # imports type support without its warnings


@pytest.mark.slow
def test_demo_without_data(rclpy, tmp_path):
    command = [sys.executable, '-m', 'gp_ground_seg', 'demo', '--frames', '4']
    first, again = (
        subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=PATIENCE)
        for _ in range(2)
    )
    assert first.returncode == 0, first.stdout + first.stderr
    assert 85.0 < float(re.search(r'ground IoU ([\d.]+) %', first.stdout)[1]) < 100.0
    assert re.search(r'median [\d.]+ ms, 99 % within [\d.]+ ms', first.stdout)
    folder = tmp_path / 'demo_output'
    files = sorted(path.name for path in folder.iterdir())
    assert files == ['drive.mcap', 'node.log', 'scan.png']
    assert (folder / 'scan.png').read_bytes().startswith(b'\x89PNG')
    # Fast DDS only warns about a profile that it cannot read, and goes on without.
    assert 'XML' not in (folder / 'node.log').read_text()
    messages = read_messages(folder / 'drive.mcap', demo.TOPIC)
    n_points = sum(decode_cloud(raw).width for _, _, raw in messages)
    count = f'{n_points:,}'.replace(',', ' ')
    assert f'{count} in 4 scans sent, {count} back' in first.stdout
    assert again.returncode == 2 and len(again.stderr.splitlines()) == 1
    assert '--force' in again.stderr


@pytest.mark.slow
def test_a_demo_whose_node_dies_keeps_bag_and_log_and_says_how_to_go_on(rclpy, tmp_path):
    with start('demo', '--frames', 20, cwd=tmp_path) as process:
        while '[3/3]' not in (line := process.stdout.readline()):
            assert line
        (node,) = children(process.pid)
        os.kill(node, signal.SIGKILL)
        _, errors = process.communicate(timeout=PATIENCE)
    assert process.returncode == 2
    lines = errors.splitlines()
    assert any('listening to' in line for line in lines)
    assert lines[-1].startswith('gp-ground-seg: error: the node was killed by signal 9; ')
    assert 'try again with --force' in lines[-1]
    files = sorted(path.name for path in (tmp_path / 'demo_output').iterdir())
    assert files == ['drive.mcap', 'node.log']


def test_an_interrupted_demo_leaves_no_node(rclpy, tmp_path):
    with until_ctrl_c('demo', '--frames', 500, cwd=tmp_path) as process:
        wait_for(lambda: children(process.pid), 'node')
        nodes = children(process.pid)
    assert not any(is_running(pid) for pid in nodes)
    assert {*map(str, tmp_path.rglob('*.*'))} <= {str(tmp_path / 'demo_output/node.log')}


@pytest.mark.slow
def test_a_killed_demo_leaves_no_node(rclpy, tmp_path):
    with start('demo', '--frames', 500, cwd=tmp_path) as process:
        wait_for(lambda: children(process.pid), 'node')
        nodes = children(process.pid)
        process.kill()
    wait_for(lambda: not any(is_running(pid) for pid in nodes), 'end of the node')


def test_a_node_that_ends_is_said(rclpy, tmp_path):
    said = pytest.raises(GroundSegError, match='the node ended with code 2')
    with NodeProcess(tmp_path / 'node.log', ['-p', 'grid.r_max:=-1.0']) as node, said:
        wait_for(node.check, 'end of the node')
    assert any('grid.r_max' in line for line in node.log_lines())


def test_the_log_says_whether_the_node_has_its_compiled_code(tmp_path):
    for text in ('', loader.FOLLOWS, loader.STAYS, loader.CHANGED):
        (tmp_path / 'node.log').write_text(text)
        assert NodeProcess(tmp_path / 'node.log').is_compiled() == (text == loader.CHANGED)


def test_the_profile_for_large_clouds(monkeypatch, tmp_path):
    """That of a checkout, or of an installation; none where the user chose, or without memory."""

    def profile_in_use():
        before = dict(os.environ)
        with session.large_cloud_transport():
            found = [value for name, value in os.environ.items() if name not in before]
        assert dict(os.environ) == before
        return [Path(value) for value in found]

    for name in session._TRANSPORT_VARIABLES:
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(session, '_free_shared_memory', lambda: 1 << 30)
    assert profile_in_use() == [REPOSITORY / 'config/fastdds_large_clouds.xml']
    for name in session._TRANSPORT_VARIABLES:
        with monkeypatch.context() as patched:
            patched.setenv(name, 'mine')
            assert profile_in_use() == []
    module = tmp_path / 'lib/python3.12/site-packages/gp_ground_seg/ros/session.py'
    monkeypatch.setattr(session, '__file__', str(module))
    assert profile_in_use() == []
    installed = tmp_path / 'share/gp_ground_seg/config/fastdds_large_clouds.xml'
    installed.parent.mkdir(parents=True)
    installed.touch()
    assert profile_in_use() == [installed]
    monkeypatch.setattr(session, '_free_shared_memory', lambda: 64 << 20)
    assert profile_in_use() == []


def test_each_session_has_a_namespace_of_its_own(rclpy):
    names = []
    for _ in range(2):
        with private_session('link') as (link, _):
            names.append(link.node.get_namespace())
    assert names[0] != names[1] and '/' not in names
