"""The command `demo`: what it says, writes and leaves running; its counts, against forgeries."""

import dataclasses
import os
import re
import signal
import subprocess
import sys
import time
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np
import pytest

from gp_ground_seg.cli import demo
from gp_ground_seg.cli.demo_check import check_scan
from gp_ground_seg.cli.demo_frames import TOPIC, numbered_cloud
from gp_ground_seg.cli.demo_node import NodeProcess, private_network
from gp_ground_seg.cli.demo_tally import BACKLOG, GROUND, OBSTACLES, Tally
from gp_ground_seg.cli.demo_text import result_text
from gp_ground_seg.cli.main import main
from gp_ground_seg.data.bags import BagReader
from gp_ground_seg.data.point_cloud2 import (
    decode_cloud,
    encode_cloud,
    read_xyz,
    select_points,
    with_header,
)
from gp_ground_seg.errors import GroundSegError, PointCloudError
from gp_ground_seg.frame import Label
from gp_ground_seg.ros import transport

REPOSITORY = Path(__file__).parents[1]
COMMAND = (sys.executable, '-m', 'gp_ground_seg', 'demo')
PATIENCE = 120.0


# --- what comes back, compared to what was sent


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
    return select_points(cloud, is_ground & finite), select_points(cloud, ~is_ground & finite)


def perfect(n=40):
    return np.arange(n) % 2 == 0


def test_perfect_answer():
    cloud = sent_cloud()
    check = check_scan(cloud, *split(cloud, perfect()))
    assert check.is_exact
    assert check.n_points == 39
    # The outlier does not count.
    assert (check.confusion.tp, check.confusion.tn) == (20, 19)
    assert check.confusion.errors == 0
    assert check.label[3] == Label.UNKNOWN
    np.testing.assert_array_equal(check.points[:, :3], read_xyz(cloud))


def test_wrong_labels_are_scored():
    is_ground = perfect()
    is_ground[[0, 2, 5]] ^= True
    cloud = sent_cloud()
    check = check_scan(cloud, *split(cloud, is_ground))
    assert check.is_exact
    assert (check.confusion.fn, check.confusion.fp) == (2, 1)


def chosen(n, *where):
    mask = np.zeros(n, dtype=bool)
    mask[list(where)] = True
    return mask


def joined(one, other):
    width = one.width + other.width
    return dataclasses.replace(
        one,
        width=width,
        row_step=width * one.point_step,
        data=np.concatenate([one.data, other.data]),
    )


def flipped(cloud, byte):
    data = cloud.data.copy()
    data[byte] ^= 1
    return dataclasses.replace(cloud, data=data)


def test_every_fault_is_found():
    cloud = sent_cloud()
    ground, obstacles = split(cloud, perfect())

    def faults(ground, obstacles):
        check = check_scan(cloud, ground, obstacles)
        assert not check.is_exact
        return check.n_missing, check.n_repeated, check.n_altered, check.n_foreign

    assert faults(select_points(ground, ~chosen(20, 4)), obstacles) == (1, 0, 0, 0)
    in_both = joined(obstacles, select_points(cloud, chosen(40, 8)))
    assert faults(ground, in_both) == (0, 1, 0, 0)
    twice_in_one = joined(ground, select_points(cloud, chosen(40, 8)))
    assert faults(twice_in_one, obstacles) == (0, 1, 0, 0)
    not_finite = joined(obstacles, select_points(cloud, chosen(40, 3)))
    assert faults(ground, not_finite) == (0, 0, 0, 1)
    # Each byte counts: of coordinates, intensity, label. One of the index makes it another point.
    for byte in range(20):
        assert faults(flipped(ground, 24 * 7 + byte), obstacles) == (0, 0, 1, 0)
    assert faults(flipped(ground, 24 * 7 + 20), obstacles) == (1, 1, 1, 0)
    assert faults(flipped(ground, 24 * 7 + 23), obstacles) == (1, 0, 0, 1)
    for change in ({'header': with_header(cloud, (5, 8)).header}, {'fields': cloud.fields[:-1]}):
        changed = dataclasses.replace(ground, **change)
        assert faults(changed, obstacles) == (20, 0, 20, 0)
    assert faults(dataclasses.replace(ground, data=ground.data[:-1]), obstacles) == (20, 0, 20, 0)


def test_a_cloud_without_numbers_is_refused():
    cloud = sent_cloud()
    fields = tuple(field for field in cloud.fields if field.name != 'index')
    bare = dataclasses.replace(cloud, fields=fields)
    with pytest.raises(PointCloudError, match='x y z intensity label'):
        check_scan(bare, bare, bare)


# --- counts over a drive


def test_tally():
    tally = Tally(shown=2)
    clouds = [sent_cloud(seed=k, stamp=k * 10**8) for k in range(5)]
    for k, cloud in enumerate(clouds):
        tally.sent(TOPIC, encode_cloud(cloud), 1000 + k * 10**8)
    # 0 comes back whole, 1 by half, 2 not at all, 3 in the other order, 4 with a fault.
    ground, obstacles = split(clouds[0], perfect())
    tally.arrived(GROUND, ground, 1000 + 30_000_000)
    tally.arrived(OBSTACLES, obstacles, 1000 + 50_000_000)
    tally.arrived(GROUND, split(clouds[1], perfect())[0], 10**9)
    ground, obstacles = split(clouds[3], ~perfect())
    tally.arrived(OBSTACLES, obstacles, 1000 + 3 * 10**8 + 70_000_000)
    tally.arrived(GROUND, ground, 1000 + 3 * 10**8 + 60_000_000)
    assert tally.is_partition_exact
    ground, obstacles = split(clouds[4], perfect())
    tally.arrived(GROUND, select_points(ground, ~chosen(20, 1, 2)), 1000 + 4 * 10**8 + 10_000_000)
    tally.arrived(OBSTACLES, obstacles, 1000 + 4 * 10**8 + 20_000_000)
    tally.look()

    assert (tally.n_sent, tally.n_back, tally.n_lost) == (5, 3, 2)
    assert tally.latencies == pytest.approx([0.05, 0.07, 0.02])
    assert tally.latency(50) == pytest.approx(0.05)
    assert tally.rate == pytest.approx(2 / 0.37)
    assert (tally.n_points, tally.n_missing, tally.n_stray) == (3 * 39, 2, 0)
    assert not tally.is_partition_exact
    assert tally.confusion.tp == 20 + 0 + 18
    # The one to show was lost: the one before it that came back.
    assert tally.picture_number == 0
    text = result_text(tally, 10.0, 'the truth')
    assert '5 sent, 3 back, 2 lost' in text
    assert 'FAILED: 2 of 5 scans were lost\n' in text
    assert 'FAILED: the two clouds are not the scan that was sent' in text


def test_strangers_and_copies_are_noticed():
    tally = Tally(shown=0)
    cloud = sent_cloud()
    ground, obstacles = split(cloud, perfect())
    tally.arrived(GROUND, ground, 5)
    assert tally.n_stray == 1
    tally.sent(TOPIC, encode_cloud(cloud), 10)
    tally.arrived(GROUND, ground, 20)
    tally.arrived(GROUND, ground, 21)
    assert tally.n_stray == 2
    tally.arrived(OBSTACLES, obstacles, 22)
    tally.arrived(OBSTACLES, obstacles, 23)
    assert tally.n_stray == 3
    tally.look()
    assert (tally.n_back, tally.n_lost) == (1, 0)
    assert not tally.is_partition_exact


def test_long_drives_do_not_pile_up():
    tally = Tally(shown=0)
    for k in range(BACKLOG + 10):
        cloud = sent_cloud(seed=k, stamp=k)
        tally.sent(TOPIC, encode_cloud(cloud), k)
        for topic, back in zip((GROUND, OBSTACLES), split(cloud, perfect()), strict=True):
            tally.arrived(topic, back, k)
    assert tally.n_points == 10 * 39
    tally.look()
    assert tally.n_points == (BACKLOG + 10) * 39


def test_a_drive_that_is_too_fast_is_told_so():
    tally = Tally(shown=0)
    for k in range(2):
        cloud = sent_cloud(stamp=k)
        tally.sent(TOPIC, encode_cloud(cloud), 0)
    for topic, back in zip((GROUND, OBSTACLES), split(cloud, perfect()), strict=True):
        tally.arrived(topic, back, 150_000_000)
    assert 'too slow for that rate, try a lower --rate' in result_text(tally, 10.0, 'the truth')
    assert 'too slow' not in result_text(tally, 5.0, 'the truth')


# --- the whole command


def gone(pid):
    """Whether a process has ended, waited for by its parent or not."""
    try:
        state = Path(f'/proc/{pid}/stat').read_text().rpartition(')')[2].split()[0]
    except FileNotFoundError:
        return True
    return state == 'Z'


def children(pid):
    listing = Path(f'/proc/{pid}/task/{pid}/children').read_text()
    return [int(word) for word in listing.split()]


@pytest.fixture
def rclpy():
    return pytest.importorskip('rclpy', reason='ROS is not installed')


def run_demo(folder, *words):
    return subprocess.run(
        [*COMMAND, *map(str, words)],
        cwd=folder, capture_output=True, text=True, check=False, timeout=PATIENCE,
    )  # fmt: skip


def test_demo_without_data(rclpy, tmp_path):
    result = run_demo(tmp_path, '--frames', 4)
    assert result.returncode == 0, result.stdout + result.stderr
    assert '4 sent, 4 back, 0 lost' in result.stdout
    assert 'each is in exactly one of the two clouds, not a byte changed' in result.stdout
    iou = float(re.search(r'ground IoU ([\d.]+) %', result.stdout).group(1))
    assert 85.0 < iou < 100.0
    assert re.search(r'median [\d.]+ ms, 99 % within [\d.]+ ms', result.stdout)
    folder = tmp_path / 'demo_output'
    assert sorted(path.name for path in folder.iterdir()) == [
        'birds_eye.png', 'drive.mcap', 'node.log'
    ]  # fmt: skip
    assert (folder / 'birds_eye.png').read_bytes().startswith(b'\x89PNG')
    with BagReader(folder / 'drive.mcap') as bag:
        n_points = sum(decode_cloud(raw).width for _, _, raw in bag.messages([TOPIC]))
    assert f'{n_points:,}'.replace(',', ' ') + ' of these scans' in result.stdout

    again = run_demo(tmp_path, '--frames', 4)
    assert again.returncode == 2
    assert again.stdout == ''
    assert '--force' in again.stderr
    assert len(again.stderr.splitlines()) == 1


def test_demo_on_real_scans(rclpy, kitti, tmp_path):
    result = run_demo(tmp_path, '--kitti', kitti, '--frames', 3, '--output', 'real')
    assert result.returncode == 0, result.stdout + result.stderr
    assert 'KITTI sequence 00' in result.stdout
    assert '3 sent, 3 back, 0 lost' in result.stdout
    iou = float(re.search(r'ground IoU ([\d.]+) %', result.stdout).group(1))
    assert iou > 95.0
    assert (tmp_path / 'real' / 'birds_eye.png').is_file()


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_interrupted_demo_leaves_nothing(rclpy, tmp_path, heeded_hangup, number):
    command = [*COMMAND, '--frames', '500']
    with subprocess.Popen(
        command, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout.readline().startswith('[1/3]')
        end = time.monotonic() + PATIENCE
        while not (nodes := children(process.pid)):
            assert time.monotonic() < end
            time.sleep(0.01)
        # To this process alone, as `kill` does; a terminal tells the node too.
        process.send_signal(number)
        _, errors = process.communicate(timeout=PATIENCE)
    assert process.returncode == 130
    assert errors.splitlines()[-1] == 'gp-ground-seg: interrupted'
    assert all(gone(pid) for pid in nodes)
    assert list(tmp_path.iterdir()) == []


def test_sequence_without_kitti(rclpy, tmp_path, capsys):
    assert main(['demo', '--sequence', '08', '--output', str(tmp_path / 'out')]) == 2
    assert '--sequence 08: goes with --kitti ROOT' in capsys.readouterr().err
    assert main(['demo', '--kitti', str(tmp_path), '--output', str(tmp_path / 'out')]) == 2
    assert 'SemanticKITTI layout' in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize('words', [('--frames', '0'), ('--frames', '1.5'), ('--rate', '0')])
def test_refused_options(words, capsys):
    with pytest.raises(SystemExit, match='2'):
        main(['demo', *words])
    assert words[0] in capsys.readouterr().err


# --- its parts


@pytest.mark.parametrize(
    ('seconds', 'rate'),
    [(0.05, 10.0), (0.08, 10.0), (0.095, 7.0), (0.2, 3.0), (0.7, 1.0), (1.0, 0.7), (30.0, 0.02)],
)
def test_rate_that_a_machine_can_do(seconds, rate, capsys):
    class Receiver:
        def time_answer(self, _topic, cloud, n_times, _timeout):
            assert (cloud.width, n_times) == (40, demo.N_TRIALS)
            return seconds

    class Bag:
        def messages(self, _topics):
            yield TOPIC, 0, encode_cloud(sent_cloud())

    assert demo._sustainable_rate(Bag(), Receiver()) == pytest.approx(rate)
    assert ('instead of 10' in capsys.readouterr().out) == (rate < 10.0)


def test_node_that_does_not_start(rclpy, tmp_path):
    words = ('-p', 'label.ground_tolerance:=-1.0')
    with private_network(), NodeProcess(tmp_path / 'node.log', words) as node:
        end = time.monotonic() + PATIENCE
        error = None
        while error is None and time.monotonic() < end:
            try:
                node.check()
            except GroundSegError as raised:
                error = str(raised)
            time.sleep(0.02)
    assert error.startswith('the node ended with code 2; its last words:\n')
    assert 'label.ground_tolerance' in error


def test_node_ends_with_its_block(rclpy, tmp_path):
    node = NodeProcess(tmp_path / 'node.log')

    def fail():
        with private_network(), node:
            assert not gone(node.pid)
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail()
    assert gone(node.pid)


def test_private_network(monkeypatch):
    own = 1 + os.getpid() % 101
    monkeypatch.setenv('ROS_DOMAIN_ID', str(own))
    monkeypatch.setenv('ROS_LOCALHOST_ONLY', '0')
    monkeypatch.delenv('ROS_AUTOMATIC_DISCOVERY_RANGE', raising=False)
    before = dict(os.environ)
    with private_network():
        assert os.environ['ROS_DOMAIN_ID'] != str(own)
        assert 1 <= int(os.environ['ROS_DOMAIN_ID']) <= 101
        assert os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] == 'LOCALHOST'
        assert 'ROS_LOCALHOST_ONLY' not in os.environ
    assert dict(os.environ) == before


def test_transport_profile_is_the_one_in_config(monkeypatch):
    """What the commands generate and what is shipped for LiDAR drivers say the same."""
    for name in transport._USERS_CHOICE:
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(transport, 'segment_size', lambda: transport.SEGMENT_SIZE)
    with transport.large_cloud_transport():
        file = Path(os.environ[transport.PROFILES_FILE])
        generated = file.read_text()
    assert transport.PROFILES_FILE not in os.environ
    assert not file.exists()
    shipped = (REPOSITORY / 'config' / 'fastdds_large_clouds.xml').read_text()

    def elements(text):
        return [
            (element.tag, element.attrib, (element.text or '').strip())
            for element in ElementTree.fromstring(text).iter()
        ]

    assert elements(generated) == elements(shipped)


def test_transport_of_the_user_is_kept(monkeypatch):
    for name in transport._USERS_CHOICE:
        monkeypatch.delenv(name, raising=False)
    for name in transport._USERS_CHOICE:
        with monkeypatch.context() as patch:
            patch.setenv(name, 'mine')
            before = dict(os.environ)
            with transport.large_cloud_transport():
                assert dict(os.environ) == before
    # A container with 4 MB of shared memory: an eighth is not more than the stock size.
    monkeypatch.setattr(transport, 'segment_size', lambda: transport.MEGABYTE // 2)
    before = dict(os.environ)
    with transport.large_cloud_transport():
        assert dict(os.environ) == before


def test_share_of_shared_memory(tmp_path, monkeypatch):
    monkeypatch.setattr(transport, 'SHARED_MEMORY', tmp_path / 'missing')
    assert transport.segment_size() == 0
    monkeypatch.setattr(transport, 'SHARED_MEMORY', tmp_path)
    free = os.statvfs(tmp_path).f_bavail * os.statvfs(tmp_path).f_frsize
    assert transport.segment_size() == pytest.approx(min(32 << 20, free / 8), rel=0.1)
