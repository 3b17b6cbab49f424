"""``kitti-to-bag``: a sequence in SemanticKITTI layout as a rosbag2."""

import functools
from datetime import datetime, timezone

import bag_samples as samples
import cli_runner
import numpy as np
import pytest
from evaluation_samples import write_frame

from gp_ground_seg.cli.bags import EPOCH
from gp_ground_seg.data.bags import POINT_CLOUD2, BagReader, decode_cloud, storage_of

TOPIC = '/kitti/velo/pointcloud'
TIMES = [0.0, 0.1036219, 0.2072, 0.311, 0.415]


convert = functools.partial(cli_runner.run, 'kitti-to-bag')


def write_sequence(root, n_labelled=5, times=TIMES):
    for k in range(5):
        scan = samples.scan(k)
        semantic_and_instance = np.arange(len(scan), dtype='<u4') % 260 + (7 << 16)
        write_frame(root, '04', k, scan, semantic_and_instance if k < n_labelled else None)
    if times is not None:
        text = ''.join(f'{time:e}\n' for time in times)
        (root / 'sequences/04/times.txt').write_text(text)


def read_clouds(path):
    with BagReader(path) as bag:
        assert bag.topics == {TOPIC: POINT_CLOUD2}
        return [(time, decode_cloud(raw)) for _, time, raw in bag.messages()]


@pytest.mark.parametrize(
    ('name', 'storage', 'times'),
    [('out', 'mcap', None), ('out.mcap', 'mcap', TIMES), ('out.db3', 'sqlite3', TIMES)],
)
def test_sequence_as_bag(tmp_path, capsys, name, storage, times):
    """Every scan with its stamp (10 Hz without times) and, where it has labels, their classes."""
    day = datetime.fromtimestamp(EPOCH, timezone.utc).isoformat()
    assert day == '2011-09-26T00:00:00+00:00'  # as the help says
    write_sequence(tmp_path / 'kitti', n_labelled=4, times=times)
    out = tmp_path / name
    assert convert(tmp_path / 'kitti', '--sequence', '04', out) == 0
    assert capsys.readouterr() == (
        f'5 frames (4 with labels), 9 005 points, 0.4 s, written to {out}\n', '',
    )  # fmt: skip
    assert out.is_file() == ('.' in name)
    assert storage_of(out) == storage
    clouds = read_clouds(out)
    assert len(clouds) == 5
    for k, (recorded, cloud) in enumerate(clouds):
        assert recorded == EPOCH * 10**9 + round((times[k] if times else 0.1 * k) * 1e9)
        assert (cloud.header.stamp.sec, cloud.header.stamp.nanosec) == divmod(recorded, 10**9)
        assert (cloud.header.frame_id, cloud.height, cloud.width) == ('velo_link', 1, 1801)
        columns = ['x', 'y', 'z', 'intensity', 'label'][: 4 + (k < 4)]
        assert [(f.name, f.offset, f.datatype, f.count) for f in cloud.fields] == [
            (name, 4 * j, 6 if name == 'label' else 7, 1) for j, name in enumerate(columns)
        ]
        points = cloud.data.reshape(1801, -1)
        assert cloud.point_step == points.shape[1] == 4 * len(columns)
        assert points[:, :16].tobytes() == samples.scan(k).tobytes()
        if k < 4:
            label = points[:, 16:].copy().view('<u4')[:, 0]
            np.testing.assert_array_equal(label, np.arange(1801) % 260)


def test_times_that_no_stamp_holds_are_refused(tmp_path, capsys):
    write_sequence(tmp_path / 'kitti', times=[0, 0.1, 0.2, 0.3, 1e10])
    assert convert(tmp_path / 'kitti', tmp_path / 'out.db3', '--sequence', '04') == 2
    assert 'sequence 04: 0 to 1e+10 s: no stamps of ROS' in cli_runner.error_line(capsys)
    assert [path.name for path in tmp_path.iterdir()] == ['kitti']
