"""Simulated drives written and read back as SemanticKITTI sequences."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from gp_ground_seg.data.semantic_kitti import list_frames, list_sequences, read_labels, read_points
from gp_ground_seg.errors import DataError
from gp_ground_seg.simulation import (
    HDL_64E,
    SCENES,
    SEMANTIC_KITTI_CLASS,
    Kind,
    simulate_drive,
    write_semantic_kitti,
)

SENSOR = dataclasses.replace(HDL_64E, n_columns=180)


def drive(n_frames=3):
    return simulate_drive(SCENES['urban'](0), SENSOR, n_frames, speed=10.0, seed=1)


def test_round_trip(tmp_path):
    folder = write_semantic_kitti(drive(), tmp_path, '42')
    assert folder == tmp_path / 'sequences' / '42'
    assert list_sequences(tmp_path) == ['42']
    assert [path.name for path in tmp_path.iterdir()] == ['sequences']
    frames = list_frames(tmp_path, '42')
    for frame, scan in zip(frames, drive(), strict=True):
        assert frame.time == pytest.approx(scan.time)
        np.testing.assert_array_equal(read_points(frame.points_path), scan.points)
        classes = read_labels(frame.labels_path, len(scan.points))
        expected = [SEMANTIC_KITTI_CLASS[Kind(code)] for code in scan.kind]
        np.testing.assert_array_equal(classes, expected)


def test_every_kind_has_a_class_and_only_terrain_is_ground():
    ground = {40, 44, 48, 49, 60, 72}
    assert set(SEMANTIC_KITTI_CLASS) == set(Kind)
    assert {kind for kind, label in SEMANTIC_KITTI_CLASS.items() if label in ground} == {
        Kind.TERRAIN
    }


def broken_drive():
    yield from drive(1)
    raise KeyboardInterrupt


@pytest.mark.parametrize(
    ('scans', 'kind', 'message'),
    [(broken_drive(), KeyboardInterrupt, None), (iter(()), DataError, 'no scan')],
)
def test_a_drive_that_fails_leaves_nothing(tmp_path, scans, kind, message):
    with pytest.raises(kind, match=message):
        write_semantic_kitti(scans, tmp_path, '00')
    assert [path for path in tmp_path.rglob('*') if path.is_file()] == []
    assert list((tmp_path / 'sequences').iterdir()) == []


@pytest.mark.parametrize('name', ['', '.', '..', 'a/b', '../00', 'mine'])
def test_bad_and_taken_names_are_refused(tmp_path, name):
    mine = tmp_path / 'sequences' / 'mine'
    mine.mkdir(parents=True)
    with pytest.raises(DataError, match='exists' if name == 'mine' else 'one folder'):
        write_semantic_kitti(drive(1), tmp_path, name)
    assert [*tmp_path.rglob('*')] == [mine.parent, mine]


def test_unwritable_root_is_one_line(tmp_path):
    (tmp_path / 'file').write_text('')
    with pytest.raises(DataError, match='file'):
        write_semantic_kitti(drive(1), tmp_path / 'file', '00')
