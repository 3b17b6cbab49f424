"""``kitti-to-bag``: a sequence in SemanticKITTI layout as a rosbag2."""

import functools
import re
from datetime import datetime, timezone

import bag_samples as samples
import cli_runner
import numpy as np
import pytest

from gp_ground_seg.cli.bags import EPOCH
from gp_ground_seg.data.bag_files import POINT_CLOUD2
from gp_ground_seg.data.bags import BagReader, decode_cloud, stamp_of

TOPIC = '/kitti/velo/pointcloud'
TIMES = [0.0, 0.1036219, 0.2072, 0.311, 0.415]


convert = functools.partial(cli_runner.run, 'kitti-to-bag')


def write_sequence(root, n_labelled=5, times=TIMES):
    folder = root / 'sequences' / '04'
    (folder / 'velodyne').mkdir(parents=True)
    (folder / 'labels').mkdir()
    for k in range(5):
        scan = samples.scan(k)
        scan.tofile(folder / 'velodyne' / f'{k:06d}.bin')
        if k < n_labelled:
            semantic_and_instance = np.arange(len(scan), dtype='<u4') % 260 + (7 << 16)
            semantic_and_instance.tofile(folder / 'labels' / f'{k:06d}.label')
    if times is not None:
        (folder / 'times.txt').write_text(''.join(f'{time:e}\n' for time in times))
    return folder


def read_clouds(path):
    with BagReader(path) as bag:
        assert bag.topics == {TOPIC: POINT_CLOUD2}
        return [(time, decode_cloud(raw)) for _, time, raw in bag.messages()]


@pytest.mark.parametrize(
    ('name', 'storage'), [('out', 'mcap'), ('out.mcap', 'mcap'), ('out.db3', 'sqlite3')]
)
def test_sequence_as_bag(tmp_path, capsys, name, storage):
    day = datetime.fromtimestamp(EPOCH, timezone.utc).isoformat()
    assert day == '2011-09-26T00:00:00+00:00'  # as the help says
    write_sequence(tmp_path / 'kitti')
    out = tmp_path / name
    assert convert(tmp_path / 'kitti', '--sequence', '04', out) == 0
    assert capsys.readouterr() == (
        f'5 frames (5 with labels), 9 005 points, 0.4 s, written to {out}\n', '',
    )  # fmt: skip
    assert out.is_file() == ('.' in name)
    with BagReader(out) as bag:
        assert bag.storage == storage
    clouds = read_clouds(out)
    assert len(clouds) == 5
    for k, (recorded, cloud) in enumerate(clouds):
        assert recorded == EPOCH * 10**9 + round(TIMES[k] * 1e9)
        assert stamp_of(cloud) == divmod(recorded, 10**9)
        assert (cloud.header.frame_id, cloud.height, cloud.width) == ('velo_link', 1, 1801)
        assert (cloud.point_step, cloud.row_step) == (20, 20 * 1801)
        assert [(f.name, f.offset, f.datatype, f.count) for f in cloud.fields] == [
            ('x', 0, 7, 1), ('y', 4, 7, 1), ('z', 8, 7, 1), ('intensity', 12, 7, 1),
            ('label', 16, 6, 1),
        ]  # fmt: skip
        points = cloud.data.reshape(-1, 20)
        assert points[:, :16].tobytes() == samples.scan(k).tobytes()
        label = points[:, 16:].copy().view('<u4')[:, 0]
        np.testing.assert_array_equal(label, np.arange(1801) % 260)


def test_scans_without_labels_have_no_label_field(tmp_path, capsys):
    write_sequence(tmp_path, n_labelled=1)
    assert convert(tmp_path, '--sequence', '04', tmp_path / 'out') == 0
    assert capsys.readouterr().out.startswith('5 frames (1 with labels), ')
    for k, (_, cloud) in enumerate(read_clouds(tmp_path / 'out')):
        assert ('label' in [field.name for field in cloud.fields]) == (k == 0)
        assert cloud.data.reshape(1801, -1)[:, :16].tobytes() == samples.scan(k).tobytes()


def test_without_times_the_bag_has_ten_hertz(tmp_path):
    write_sequence(tmp_path, times=None)
    assert convert(tmp_path, '--sequence', '04', tmp_path / 'out') == 0
    recorded = [time - EPOCH * 10**9 for time, _ in read_clouds(tmp_path / 'out')]
    assert recorded == [0, 100_000_000, 200_000_000, 300_000_000, 400_000_000]


@pytest.mark.parametrize(
    ('times', 'words', 'message'),
    [
        (TIMES, ['--sequence', '99'], r'sequences/99: no velodyne folder.*sequences here: 04'),
        ([-0.2, 0.1, 0.2, 0.3, 0.4], [], r'time -0\.2 s of frame 000000: must be in'),
        ([0, 0.1, 0.2, 0.3, 1e10], [], r'time 1e\+10 s of frame 000004: must be in'),
        (None, [], r'000003\.label: 8 bytes, expected 7204'),
    ],
)
def test_refused(tmp_path, capsys, times, words, message):
    folder = write_sequence(tmp_path / 'kitti', times=times)
    if times is None:
        (folder / 'labels/000003.label').write_bytes(b'0' * 8)
    assert convert(tmp_path / 'kitti', tmp_path / 'out.db3', '--sequence', '04', *words) == 2
    assert re.search(message, cli_runner.error_line(capsys))
    assert [path.name for path in tmp_path.iterdir()] == ['kitti']
