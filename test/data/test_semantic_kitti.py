"""SemanticKITTI folders: what is read, and what is refused."""

import numpy as np
import pytest
from evaluation_samples import street, write_frame, write_streets

from gp_ground_seg.core.errors import DataError
from gp_ground_seg.data import semantic_kitti
from gp_ground_seg.data.semantic_kitti import list_frames, list_sequences


def test_sequences_and_frames_are_sorted_and_need_scans(tmp_path):
    with pytest.raises(DataError, match='no sequences/'):
        list_sequences(tmp_path)
    write_streets(tmp_path, s08=1, s10=1)
    points, semantic = street()
    for index in (10, 2, 1):
        write_frame(tmp_path, '00', index, points, semantic if index != 2 else None)
    (tmp_path / 'sequences' / '03').mkdir()
    (tmp_path / 'sequences' / 'notes.txt').write_text('')
    assert list_sequences(tmp_path) == list_sequences(str(tmp_path)) == ['00', '08', '10']
    frames = list_frames(tmp_path, '00')
    assert [frame.index for frame in frames] == ['000001', '000002', '000010']
    assert [frame.labels_path is not None for frame in frames] == [True, False, True]
    assert all(frame.sequence == '00' for frame in frames)
    assert frames[0].points.tobytes() == points.tobytes()
    frame, *_, other = semantic_kitti.frames(tmp_path)
    assert (frame, [other]) == (frames[0], semantic_kitti.frames(tmp_path, '10'))
    assert str(other) == '10/000000'
    np.testing.assert_array_equal(frame.is_ground, semantic == 40)
    np.testing.assert_array_equal(frame.is_scored, ~np.isin(semantic, [0, 1, 70]))
    with pytest.raises(DataError, match=r'000002\.bin: has no labels'):
        _ = frames[1].is_ground
    (tmp_path / 'sequences/08/velodyne/000000.bin').unlink()
    with pytest.raises(DataError, match=r'no velodyne/\*\.bin in it'):
        list_frames(tmp_path, '08')


def test_times_belong_to_the_numbers_of_the_files(tmp_path):
    for index in (1, 3):
        write_frame(tmp_path, '00', index, street()[0])
    found = [frame.time for frame in list_frames(tmp_path, '00')]
    assert found == [0.0, semantic_kitti.FRAME_PERIOD]
    times = tmp_path / 'sequences/00/times.txt'
    times.write_text('0.000000e+00\n1.036e-01\n2.1e-01\n3.2e-01\n')
    assert [frame.time for frame in list_frames(tmp_path, '00')] == [0.1036, 0.32]
    (tmp_path / 'sequences/00/velodyne/000003.bin').rename(times.parent / 'velodyne/first.bin')
    with pytest.raises(DataError, match=r"times of these frames .*'first'"):
        list_frames(tmp_path, '00')
    times.unlink()
    assert len(list_frames(tmp_path, '00')) == 2


@pytest.mark.parametrize(
    ('content', 'message'),
    [
        (b'0.0\n0.1\n', 'index 2 is out of bounds for axis 0 with size 2'),
        (b'0.0\nnow\n0.2\n', 'now'),
        (b'0.0\nnan\n0.2\n', 'times must be numbers that increase'),
        (b'0.0 0.1 0.1', 'times must be numbers that increase'),
        (b'\xff\xfe', 'cannot be read as'),
        (None, r'Is a directory'),
    ],
)
def test_times_that_cannot_be_used_are_refused(tmp_path, content, message):
    write_streets(tmp_path, s00=3)
    path = tmp_path / 'sequences/00/times.txt'
    path.mkdir() if content is None else path.write_bytes(content)
    with pytest.raises(DataError, match=message) as caught:
        list_frames(tmp_path, '00')
    assert str(caught.value).startswith(str(path))
