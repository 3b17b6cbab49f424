"""The command `demo`: what it says, writes and leaves running; its counts."""

import contextlib
import importlib
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from cli_runner import INTERRUPTED, children, is_running, start

from gp_ground_seg.cli import demo
from gp_ground_seg.cli.bags import scan_cloud
from gp_ground_seg.cli.demo import Tally
from gp_ground_seg.cli.main import main
from gp_ground_seg.core.errors import GroundSegError
from gp_ground_seg.core.frame import Label
from gp_ground_seg.data import point_cloud2
from gp_ground_seg.data.bags import BagReader
from gp_ground_seg.data.point_cloud2 import read_xyz, select_points
from gp_ground_seg.ros import start_stop
from gp_ground_seg.ros.node_process import NodeProcess, private_session

COMMAND = (sys.executable, '-m', 'gp_ground_seg', 'demo')
PATIENCE = 120.0
OTHER_SIGNALS = signal.SIGTERM, signal.SIGHUP


def sent_cloud(n=40, seed=0, stamp=5_000_000_007):
    """A scan of road 40 and car 10, half and half, one outlier 1, one point not finite."""
    rng = np.random.default_rng(seed)
    points = rng.normal(0.0, 5.0, (n, 4)).astype(np.float32)
    semantic = np.where(np.arange(n) % 2 == 0, 40, 10)
    semantic[1] = 1
    points[3, 2] = np.nan
    return scan_cloud(points, stamp, demo.FRAME_ID, label=semantic.astype(np.uint32))


def split(cloud, is_ground):
    """What a right node makes of a scan: NaN in neither."""
    finite = np.isfinite(read_xyz(cloud)).all(axis=1)
    return {
        'ground': select_points(cloud, is_ground & finite),
        'obstacles': select_points(cloud, ~is_ground & finite),
    }


def perfect(n=40):
    return np.arange(n) % 2 == 0


def test_labels_are_scored():
    cloud, tally, is_ground = sent_cloud(), Tally(), perfect()
    tally.add(cloud, split(cloud, is_ground), 0.05)
    # The outlier does not count, what is not finite is in neither cloud.
    assert tally.counts == {'tp': 20, 'fp': 0, 'fn': 0, 'tn': 18}
    assert (tally.n_sent, tally.n_back) == (39, 39)
    is_ground[[0, 2, 5]] ^= True
    other = sent_cloud(seed=1)
    tally.add(other, split(other, is_ground), 0.07)
    assert tally.counts == {'tp': 38, 'fp': 1, 'fn': 2, 'tn': 35}
    assert (tally.label == Label.GROUND).sum() == 19
    text = tally.summary()
    assert '78 in 2 scans sent, 78 back' in text
    assert f'IoU {100 * 38 / 41:.2f} %' in text and 'median 60.0 ms' in text
    assert 'FAILED' not in text


def test_a_point_that_does_not_come_back_is_a_failure():
    cloud, tally = sent_cloud(), Tally()
    results = split(cloud, perfect())
    results['ground'] = select_points(results['ground'], np.arange(20) != 4)
    tally.add(cloud, results, 0.05)
    assert '39 in 1 scans sent, 38 back' in tally.summary()
    assert 'FAILED: each point must come back once' in tally.summary()


@pytest.fixture
def rclpy():
    pytest.importorskip('rclpy', reason='ROS is not installed')
    importlib.import_module('ros_helpers')  # imports type support without its warnings


def run_demo(folder, *words):
    done = subprocess.run(
        [*COMMAND, *map(str, words)],
        cwd=folder, capture_output=True, text=True, check=False, timeout=PATIENCE,
    )  # fmt: skip
    if done.returncode == 2:
        return done.stderr
    assert done.returncode == 0, done.stdout + done.stderr
    iou = float(re.search(r'ground IoU ([\d.]+) %', done.stdout).group(1))
    return done.stdout, iou


@pytest.mark.slow
def test_demo_without_data(rclpy, tmp_path):
    said, iou = run_demo(tmp_path, '--frames', 4)
    assert 85.0 < iou < 100.0
    assert re.search(r'median [\d.]+ ms, 99 % within [\d.]+ ms', said)
    folder = tmp_path / 'demo_output'
    files = sorted(path.name for path in folder.iterdir())
    assert files == ['drive.mcap', 'node.log', 'scan.png']
    assert (folder / 'scan.png').read_bytes().startswith(b'\x89PNG')
    # Fast DDS only warns about a profile that it cannot read, and goes on without.
    assert 'XML' not in (folder / 'node.log').read_text()
    with BagReader(folder / 'drive.mcap') as bag:
        n_points = sum(
            point_cloud2.decode_cloud(raw).width for _, _, raw in bag.messages([demo.TOPIC])
        )
    count = f'{n_points:,}'.replace(',', ' ')
    assert f'{count} in 4 scans sent, {count} back' in said
    (error,) = run_demo(tmp_path, '--frames', 4).splitlines()
    assert '--force' in error


@contextlib.contextmanager
def running_demo(folder):
    """A demo of 500 scans, and the processes that it has started: the node."""
    with start('demo', '--frames', 500, cwd=folder) as process:
        wait_until(lambda: children(process.pid))
        yield process, children(process.pid)


@pytest.mark.parametrize(
    'number', [signal.SIGINT, *(pytest.param(n, marks=pytest.mark.slow) for n in OTHER_SIGNALS)]
)
def test_interrupted_demo_leaves_nothing(rclpy, tmp_path, heeded_hangup, number):
    with running_demo(tmp_path) as (process, nodes):
        # To this process alone, as `kill` does; a terminal tells the node too.
        process.send_signal(number)
        _, errors = process.communicate(timeout=PATIENCE)
    assert process.returncode in INTERRUPTED
    assert errors.splitlines()[-1] == 'gp-ground-seg: interrupted'
    assert not any(is_running(pid) for pid in nodes)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_the_node_ends_with_a_demo_that_is_killed(rclpy, tmp_path):
    with running_demo(tmp_path) as (process, nodes):
        process.send_signal(signal.SIGKILL)
        process.communicate(timeout=PATIENCE)
    wait_until(lambda: not any(is_running(pid) for pid in nodes))


def test_refused_options(tmp_path, capsys):
    for words, message in (
        (['--kitti', 'ROOT'], 'kitti-to-bag, node and play'),
        (['--rate', '20'], 'play --rate'),
    ):
        assert main(['demo', *words]) == 2
        assert message in capsys.readouterr().err
    for words in (['--frames', '0'], ['--frames', '1.5']):
        assert main(['demo', *words]) == 2
        assert words[0] in capsys.readouterr().err


def wait_until(condition):
    end = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.02)


def test_node_that_does_not_start_and_node_that_ends_with_its_block(rclpy, tmp_path):
    words = ('-p', 'label.ground_tolerance:=-1.0')
    message = r'^the node ended with code 2; its last words:\n[\s\S]*label\.ground_tolerance'
    with (
        NodeProcess(tmp_path / 'node.log', words) as node,
        pytest.raises(GroundSegError, match=message),
    ):
        wait_until(node.check)
    node = NodeProcess(tmp_path / 'node.log')
    with contextlib.suppress(ZeroDivisionError), node:
        assert is_running(node.pid)
        raise ZeroDivisionError
    assert not is_running(node.pid)


@pytest.mark.slow
def test_the_node_imports_nothing_from_the_current_folder(rclpy, tmp_path, monkeypatch):
    for name in ('numpy', 'yaml', 'rclpy', 'gp_ground_seg'):
        (tmp_path / f'{name}.py').write_text(f'raise SystemExit({name!r})')
    monkeypatch.chdir(tmp_path)
    log = tmp_path / 'log'
    with private_session('link') as (session, words), NodeProcess(log, words) as node:
        wait_until(lambda: node.check() or 'listening to' in log.read_text())
        namespace = session.node.get_namespace()
        assert f'listening to {namespace}/points' in log.read_text()
    with private_session('link') as (session, _):
        assert session.node.get_namespace() != namespace


@pytest.fixture
def no_profile(monkeypatch):
    """A machine with plenty of shared memory, where the user has chosen no transport."""
    for name in start_stop._TRANSPORT_VARIABLES:
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(start_stop, '_free_shared_memory', lambda: 1 << 30)


def profile_in_use():
    before = dict(os.environ)
    with start_stop.large_cloud_transport():
        (found,) = {*os.environ.items()} - {*before.items()} or {(None, None)}
    assert dict(os.environ) == before
    return found[1]


def test_profile_of_a_checkout_and_of_an_installation(no_profile, monkeypatch, tmp_path):
    shipped = Path(__file__).parents[1] / 'config' / 'fastdds_large_clouds.xml'
    assert Path(profile_in_use()) == shipped
    module = tmp_path / 'lib/python3.12/site-packages/gp_ground_seg/ros/start_stop.py'
    monkeypatch.setattr(start_stop, '__file__', str(module))
    assert profile_in_use() is None
    installed = tmp_path / 'share/gp_ground_seg/config/fastdds_large_clouds.xml'
    installed.parent.mkdir(parents=True)
    installed.touch()
    assert Path(profile_in_use()) == installed


@pytest.mark.parametrize('name', start_stop._TRANSPORT_VARIABLES)
def test_no_profile_where_the_user_chose_or_shared_memory_is_short(no_profile, monkeypatch, name):
    with monkeypatch.context() as patched:
        patched.setenv(name, 'mine')
        assert profile_in_use() is None
    monkeypatch.setattr(start_stop, '_free_shared_memory', lambda: 64 << 20)
    assert profile_in_use() is None
