"""``segment``: scans and bags of every kind, and what happens when it goes wrong."""

import dataclasses
import functools
import math
import re
import signal
from pathlib import Path

import bag_samples as samples
import numpy as np
import pytest
from bag_samples import read_messages
from cli_runner import PATIENCE, error_line, run, start, wait_for
from conftest import simulated

from gp_ground_seg import Config, GroundSegmenter, Label
from gp_ground_seg.cli.segment import _pose_summary
from gp_ground_seg.core.errors import in_thousands
from gp_ground_seg.core.pipeline.sensor_pose import MeasuredPose
from gp_ground_seg.data.bags import decode_cloud, encode_cloud, storage_of
from gp_ground_seg.data.point_cloud2 import read_xyz, select_points
from gp_ground_seg.lab.simulation import HDL_64E

pytestmark = pytest.mark.usefixtures('compiled_code')

SUMMARY = re.compile(
    r'(\d+) frames?, ([\d ]+) points?, (\d+\.\d)% ground, \d+\.\d ms per frame \(median, '
    r'segmentation only\), written to (.*)\n'
    r'measured in \d+ frames?: sensor.height=.*\n'
)


segment = functools.partial(run, 'segment')


@pytest.fixture(scope='module', autouse=True)
def segmenter():
    """Compiled, or the first command would say that it does."""
    found = GroundSegmenter(Config())
    found.segment(samples.scan())
    return found


def write_bag(path, topics=('/points',)):
    if path.suffix == '.bag':
        samples.write_ros1_bag(path, topic=topics[0])
    else:
        samples.write_ros2_bag(path, topics=topics)
    return path


def write_scans(folder, n_scans=3):
    folder.mkdir(parents=True)
    for k in range(n_scans):
        samples.scan(k).tofile(folder / f'{k:06d}.bin')
    return folder


def hidden(folder):
    return [path.name for path in folder.iterdir() if '.partial-' in path.name]


def assert_splits(source, result, topic, segmenter):
    """Every finite point of each cloud in one of two clouds, bit for bit, and nothing else."""
    before, after = read_messages(source), read_messages(result)
    clouds = [m for m in before if m[0] == topic]
    parts = [[m for m in after if m[0] == name] for name in ('/ground', '/obstacles')]
    assert len(after) == 2 * len(clouds)
    for (_, recorded, raw), *found in zip(clouds, *parts, strict=True):
        cloud = decode_cloud(raw)
        label = segmenter.segment(read_xyz(cloud)).label
        assert {Label.GROUND, Label.OBSTACLE} <= set(label)
        points = cloud.data.reshape(-1, cloud.point_step)
        for (_, time_of_part, part_raw), wanted in zip(found, (1, 2), strict=True):
            part = decode_cloud(part_raw)
            assert time_of_part == recorded
            assert part.header == cloud.header
            assert (part.fields, part.point_step) == (cloud.fields, cloud.point_step)
            kept = part.data.reshape(-1, cloud.point_step)
            np.testing.assert_array_equal(kept, points[label == wanted])
    return len(clouds)


@pytest.mark.parametrize(
    ('name', 'words', 'out', 'storage'),
    [
        ('drive', '', 'drive_ground', 'mcap'),
        ('drive.mcap', '', 'drive_ground.mcap', 'mcap'),
        ('drive.db3', '', 'drive_ground.db3', 'sqlite3'),
        ('drive.bag', '', 'drive_ground', 'mcap'),
        ('drive.db3', '-o out', 'out', 'sqlite3'),
        ('drive', '-o out.db3', 'out.db3', 'sqlite3'),
        ('two.mcap', '--topic /ground', 'two_ground.mcap', 'mcap'),
    ],
)
def test_bag_gets_ground_and_obstacles(
    segmenter, tmp_path, capsys, monkeypatch, name, words, out, storage
):
    monkeypatch.chdir(tmp_path)
    topics = {'drive.bag': ['/kitti/velo/pointcloud'], 'two.mcap': ['/front', '/ground']}
    source = write_bag(tmp_path / name, topics=topics.get(name, ['/points']))
    assert segment(source, '--quiet', *words.split()) == 0
    said = capsys.readouterr()
    n_frames, n_points, share, written_to = SUMMARY.fullmatch(said.out).groups()
    assert (n_frames, n_points) == ('3', in_thousands(3 * 1801))
    assert 80 < float(share) < 84
    assert tmp_path / written_to == tmp_path / out
    assert said.err == ''
    assert hidden(tmp_path) == []
    topic = words.split()[-1] if '--topic' in words else topics.get(name, ['/points'])[0]
    assert assert_splits(source, tmp_path / out, topic, segmenter) == 3
    assert storage_of(tmp_path / out) == storage


def test_empty_and_all_nan_clouds_give_empty_clouds(tmp_path):
    nothing = select_points(samples.cloud(0), np.zeros(1801, dtype=bool))
    nan = select_points(samples.cloud(0), np.arange(1801) == 1800)
    samples.write_clouds(tmp_path / 'in.mcap', map(encode_cloud, (nothing, nan)))
    assert segment(tmp_path / 'in.mcap', '--format', 'npz', '-o', tmp_path / 'arrays') == 0
    assert segment(tmp_path / 'in.mcap') == 0
    messages = read_messages(tmp_path / 'in_ground.mcap')
    widths = [(topic, decode_cloud(raw).width) for topic, _, raw in messages]
    assert widths == [('/ground', 0), ('/obstacles', 0)] * 2


def test_bad_cloud_stops_the_run_and_is_named(tmp_path, capsys):
    out = tmp_path / 'out'
    before = samples.write_ros2_bag(out)
    raws = [encode_cloud(samples.cloud(k)) for k in range(4)]
    raws[2] = raws[2][:5000]
    samples.write_clouds(tmp_path / 'in.mcap', raws, 1000)
    assert segment(tmp_path / 'in.mcap', '-o', out, '--force') == 2
    place = 'in.mcap: message 2 of topic /points, recorded at 1002 ns: '
    assert f'{place}5000 bytes that are no sensor_msgs/msg/PointCloud2' in error_line(capsys)
    assert sorted(path.name for path in tmp_path.iterdir()) == ['in.mcap', 'out']
    assert read_messages(out) == before


@pytest.mark.parametrize(
    ('scans', 'given', 'expected'),
    [
        ('velodyne', 'velodyne', 'velodyne_ground'),
        ('00/velodyne', '00', '00_ground'),
        ('velodyne', 'velodyne/000000.bin', 'velodyne/000000_ground'),
        ('velodyne', '.', 'velodyne_ground'),
    ],
)
def test_scans_give_label_files(segmenter, tmp_path, capsys, monkeypatch, scans, given, expected):
    folder = write_scans(tmp_path / scans)
    if given == '.':
        monkeypatch.chdir(folder)
    assert segment(given if given == '.' else tmp_path / given) == 0
    out = tmp_path / expected
    n_scans = 1 if given.endswith('.bin') else 3
    assert len(list(out.glob('*.label'))) == n_scans
    for k in range(n_scans):
        written = np.fromfile(out / f'{k:06d}.label', dtype='<u4')
        label = segmenter.segment(samples.scan(k)).label
        np.testing.assert_array_equal(written, np.choose(label, (0, 40, 99)))
        assert set(written) == {0, 40, 99}
    said = capsys.readouterr()
    n_frames, n_points, _, written_to = SUMMARY.fullmatch(said.out).groups()
    assert (n_frames, n_points) == (str(n_scans), in_thousands(n_scans * 1801))
    assert Path(written_to) == out
    assert said.err == ''
    assert hidden(out.parent) == hidden(out) == []


# Height and tilt of the sensor.


def test_the_summary_has_height_and_tilt_of_the_sensor_and_what_they_contradict(tmp_path, capsys):
    tilt = math.radians(5.0), math.radians(-4.0)
    mounted = dataclasses.replace(HDL_64E, n_columns=500, height=1.2, roll=tilt[0], pitch=tilt[1])
    simulated('flat', mounted, 1).points.tofile(tmp_path / 'a.bin')
    words = ['-o', tmp_path / 'a.label', '--set', 'sensor.height=2.5']
    assert segment(tmp_path / 'a.bin', *words) == 0
    _, line, contradiction = capsys.readouterr().out.splitlines()
    assert line.startswith('measured in 1 frame: ')
    height, *angles = map(float, re.findall(r'sensor\.\w+=(\S+) (?:m|rad)', line))
    assert height == pytest.approx(1.2, abs=0.03)
    assert angles == pytest.approx(tilt, abs=0.003)
    assert contradiction.startswith('sensor.height = 2.5: the ground near the sensor is 1.2')
    assert contradiction.endswith('(1 frame: docs/pose.md)')
    told = [(1.2, 0.0, 0.0), (1.1, 0.1, -0.2), (1.3, 0.1, -0.2)]
    poses = [MeasuredPose(*one, True, True, None) for one in told]
    assert _pose_summary([*poses, MeasuredPose(9.0, 1.0, 1.0, False, False, None)]) == (
        'measured in 3 frames: sensor.height=1.20 (std 0.10) m, '
        'sensor.roll=0.100 (std 0.058) rad, sensor.pitch=-0.200 (std 0.115) rad'
    )


@pytest.mark.parametrize(('how', 'code'), [(signal.SIGKILL, -9), (signal.SIGINT, 130)])
def test_a_stopped_run_leaves_the_old_bag(tmp_path, capsys, how, code):
    before = samples.write_ros2_bag(tmp_path / 'out')
    samples.write_ros2_bag(tmp_path / 'long', n_clouds=40, n_ground=30_000, n_wall=5000)
    # So the bag takes 20 s: this process may be kept from its work for some seconds.
    slow = 'runtime.backend=numpy', 'learning.segment_step=1', 'grid.n_segments=1024'
    words = [word for value in slow for word in ('--set', value)]
    process = start('segment', tmp_path / 'long', '-o', tmp_path / 'out', '--force', *words)

    parts = '.*.partial-*/**/*.mcap'
    wait_for(lambda: sum(p.stat().st_size for p in tmp_path.glob(parts)) > 500_000, 'output')
    process.send_signal(how)
    _, said = process.communicate(timeout=PATIENCE)
    assert process.returncode == code
    assert how == signal.SIGKILL or said == 'gp-ground-seg: interrupted\n'
    is_old = read_messages(tmp_path / 'out') == before  # pytest would compare them for hours
    assert is_old
    assert len(hidden(tmp_path)) == (how == signal.SIGKILL)
