"""The command `demo`: what it says, writes and leaves running; its counts, against forgeries."""

import contextlib
import dataclasses
import importlib
import math
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
from hypothesis import given
from hypothesis import strategies as st

from gp_ground_seg.cli import demo
from gp_ground_seg.cli.demo import Tally, check_scan, numbered_cloud, result_text
from gp_ground_seg.cli.main import main
from gp_ground_seg.core.errors import GroundSegError
from gp_ground_seg.core.frame import Label
from gp_ground_seg.data import point_cloud2
from gp_ground_seg.data.bags import BagReader
from gp_ground_seg.data.point_cloud2 import read_xyz, select_points, stamp_of
from gp_ground_seg.ros import probe, start_stop
from gp_ground_seg.ros.probe import GROUND, OBSTACLES, NodeProcess, probe_session, rate_result

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
    return numbered_cloud(points, semantic, stamp)


def split(cloud, is_ground):
    """What a right node makes of a scan: NaN in neither."""
    finite = np.isfinite(read_xyz(cloud)).all(axis=1)
    return {
        GROUND: select_points(cloud, is_ground & finite),
        OBSTACLES: select_points(cloud, ~is_ground & finite),
    }


def perfect(n=40):
    return np.arange(n) % 2 == 0


def counts_of(cloud, results):
    """What a scan adds to the counts; it has come back exactly."""
    tally = Tally([stamp_of(cloud)])
    tally.add(cloud, results)
    assert (tally.n_points, tally.n_faulty) == (39, 0)
    return tally.counts


def test_labels_are_scored():
    is_ground, cloud = perfect(), sent_cloud()
    is_exact, label = check_scan(cloud, split(cloud, is_ground))
    assert is_exact
    assert label[3] == Label.UNKNOWN
    # The outlier does not count.
    assert counts_of(cloud, split(cloud, is_ground)) == {'tp': 20, 'fp': 0, 'fn': 0, 'tn': 19}
    is_ground[[0, 2, 5]] ^= True
    assert counts_of(cloud, split(cloud, is_ground)) == {'tp': 18, 'fp': 1, 'fn': 2, 'tn': 18}


def chosen(n, *where):
    mask = np.zeros(n, dtype=bool)
    mask[list(where)] = True
    return mask


def joined(one, other):
    width = one.width + other.width
    data = np.concatenate([one.data, other.data])
    row_step = width * one.point_step
    return dataclasses.replace(one, width=width, row_step=row_step, data=data)


def flipped(cloud, byte):
    data = cloud.data.copy()
    data[byte] ^= 1
    return dataclasses.replace(cloud, data=data)


def test_every_fault_is_found():
    cloud = sent_cloud()
    ground, obstacles = split(cloud, perfect()).values()
    again, not_finite = (select_points(cloud, chosen(40, k)) for k in (8, 3))
    # Each byte counts: of coordinates, intensity, label and number.
    forged = [flipped(ground, 24 * 7 + byte) for byte in range(24)]
    forged += [select_points(ground, ~chosen(20, 4)), joined(ground, again)]
    for change in (
        {'header': point_cloud2.with_header(cloud, (5, 8)).header},
        {'header': point_cloud2.with_header(ground, (5, 7), 'map').header},
        {'fields': cloud.fields[:-1]},
        {'data': ground.data[:-1]},
    ):
        forged.append(dataclasses.replace(ground, **change))
    pairs = [(one, obstacles) for one in forged]
    pairs += [(ground, joined(obstacles, one)) for one in (again, not_finite)]
    for first, second in pairs:
        assert not check_scan(cloud, {GROUND: first, OBSTACLES: second})[0]


def trips(*latencies):
    """Trips of scans sent every 0.1 s, None = lost."""
    sent = [(1000 + k * 10**8, latency) for k, latency in enumerate(latencies)]
    return [probe.Trip(t, None if late is None else t + round(1e9 * late)) for t, late in sent]


@given(st.lists(st.none() | st.floats(0.0, 5.0), min_size=2))
def test_counts_and_percentiles_of_trips(latencies):
    result = rate_result(10.0, trips(*latencies))
    back = [latency for latency in latencies if latency is not None]
    assert (result['n_sent'], result['n_back']) == (len(latencies), len(back))
    assert result['n_lost'] == latencies.count(None)
    assert result['sent'] == pytest.approx(10.0)
    if back:
        expected = np.percentile(back, [50, 95, 99, 100])
        found = [result['p50'], result['p95'], result['p99'], result['worst']]
        np.testing.assert_allclose(found, expected, atol=1e-8)
    else:
        assert math.isnan(result['p50'])


def test_counts_and_words():
    clouds = [sent_cloud(seed=k, stamp=k * 10**8) for k in range(5)]
    tally = Tally([stamp_of(cloud) for cloud in clouds])
    # 0 comes back whole, 1 and 2 not, 3 with other labels, 4 with a fault.
    tally.add(clouds[0], split(clouds[0], perfect()))
    tally.add(clouds[3], split(clouds[3], ~perfect()))
    result = rate_result(10.0, trips(0.05, None, None, 0.07, 0.02))
    text, is_good = result_text(tally, result, 0, 'the truth')
    assert not is_good
    assert '5 sent, 3 back, 2 lost' in text and 'median 50.0 ms' in text
    assert 'each is in exactly one of the two clouds, not a byte changed' in text
    assert text.endswith('FAILED: 2 of 5 scans were lost')
    results = split(clouds[4], perfect())
    results[GROUND] = select_points(results[GROUND], ~chosen(20, 1, 2))
    tally.add(clouds[4], results)
    assert (tally.n_points, tally.n_faulty, tally.counts['tp']) == (117, 1, 20 + 0 + 18)
    # The middle one was lost: the one before it that came back.
    assert tally.picture[0] == 0
    assert 'FAILED: the two clouds are not the scan' in result_text(tally, result, 0, '')[0]


@pytest.mark.parametrize(
    ('rate', 'n_stray', 'is_good', 'words'),
    [
        (10.0, 0, True, 'rate     10.0 scans per second sent, 10 were wanted'),
        (10.0, 1, False, '1 clouds too many'),
        (5.0, 0, False, 'FAILED: 1 of 3 scans were lost'),
        (50.0, 0, False, 'too slow for that rate, try a lower --rate'),
    ],
)
def test_what_failed_is_said(rate, n_stray, is_good, words):
    cloud = sent_cloud()
    tally = Tally([stamp_of(cloud)])
    tally.add(cloud, split(cloud, perfect()))
    latencies = (0.15, 0.15, 0.15) if rate == 10.0 else (0.15, 0.15, None)
    result = rate_result(rate, trips(*latencies))
    text, found = result_text(tally, result, n_stray, 'the truth')
    assert (found, words in text) == (is_good, True)


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
    assert '4 sent, 4 back, 0 lost' in said
    assert 'each is in exactly one of the two clouds, not a byte changed' in said
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
    assert f'{n_points:,}'.replace(',', ' ') + ' of these scans' in said
    (error,) = run_demo(tmp_path, '--frames', 4).splitlines()
    assert '--force' in error


@pytest.mark.slow
def test_demo_on_real_scans(rclpy, kitti, tmp_path):
    said, iou = run_demo(tmp_path, '--kitti', kitti, '--frames', 3, '--output', 'real')
    assert 'KITTI sequence 00' in said
    assert '3 sent, 3 back, 0 lost' in said
    assert iou > 95.0
    assert (tmp_path / 'real' / 'scan.png').is_file()


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


def test_refused_options(rclpy, tmp_path, capsys):
    target = ['--output', str(tmp_path / 'out')]
    for words, message in (
        (['--sequence', '08'], '--sequence 08: goes with --kitti ROOT'),
        (['--kitti', str(tmp_path)], 'SemanticKITTI layout'),
    ):
        assert main(['demo', *words, *target]) == 2
        assert message in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []
    for words in (['--frames', '0'], ['--frames', '1.5'], ['--rate', '0']):
        with pytest.raises(SystemExit, match='2'):
            main(['demo', *words])
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
    with probe_session('probe') as (session, words), NodeProcess(log, words) as node:
        wait_until(lambda: node.check() or 'listening to' in log.read_text())
        namespace = session.node.get_namespace()
        assert f'listening to {namespace}/points' in log.read_text()
    with probe_session('probe') as (session, _):
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
