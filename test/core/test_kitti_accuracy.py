"""Regression on real frames: scores of the defaults must not fall."""

import numpy as np
import pytest

from gp_ground_seg import Config, GroundSegmenter, Label
from gp_ground_seg.data.semantic_kitti import list_frames, list_sequences, read_labels, read_points
from gp_ground_seg.lab.scoring import evaluate as runner

pytestmark = pytest.mark.usefixtures('compiled_code')

GROUND_CLASSES = [40, 44, 48, 49, 60, 72]
LEFT_OUT = [0, 1, 70]
FLOOR = {'00': 98.5, '01': 98.9, '03': 94.4, '05': 95.1, '08': 97.1, '10': 97.7}


def classes_and_results(folder):
    """Sequence, classes of the points, and result of each frame."""
    segmenter = GroundSegmenter()
    for sequence in list_sequences(folder):
        for frame in list_frames(folder, sequence):
            points = read_points(frame.points_path)
            classes = read_labels(frame.labels_path, len(points))
            yield sequence, classes, segmenter.segment(points)


def test_iou_on_labelled_frames(kitti):
    """GroundGrid convention, counted here, with no code of lab/scoring."""
    counts = {}
    for sequence, classes, found in classes_and_results(kitti):
        truth, kept = np.isin(classes, GROUND_CLASSES), ~np.isin(classes, LEFT_OUT)
        said = found.label == Label.GROUND
        one = [(a & b & kept).sum() for a, b in ((said, truth), (said, ~truth), (~said, truth))]
        counts[sequence] = counts.get(sequence, np.zeros(3)) + one
    iou = {name: 100 * total[0] / total.sum() for name, total in counts.items()}
    pooled = sum(counts.values())
    assert 100 * pooled[0] / pooled.sum() >= 97.5
    for sequence, floor in FLOOR.items():
        if sequence in iou:
            assert iou[sequence] >= floor, sequence


def test_no_person_and_no_vehicle_is_lost(kitti):
    frames = [frame for one in list_sequences(kitti) for frame in list_frames(kitti, one)]
    ours = runner.OurMethod(Config())
    found = runner.score_methods(frames, [ours]).objects.groupby('class').sum(numeric_only=True)
    for name in ('person', 'cyclist'):
        assert found.loc[name, 'n_objects'] > 10
        assert found.loc[name, 'n_lost'] == 0, name
    vehicles = found.loc['vehicle']
    assert vehicles['n_returns'] > 50_000 and vehicles['n_lost'] == 0
    assert vehicles['n_ground'] < 0.002 * vehicles['n_returns']


def test_ground_lies_where_it_is_said_to(kitti):
    """Heights of labelled ground returns about `ground_z`, as uncertain as `return_std` says."""
    ratios, errors, before = {}, [], []
    for sequence, classes, found in classes_and_results(kitti):
        own = np.isin(classes, GROUND_CLASSES) & np.isfinite(found.height)
        errors.append(found.height[own])
        before.append(found.labelled.height[own])
        ratios.setdefault(sequence, []).append(np.abs(errors[-1]) / found.return_std[own])
    by_sequence = {name: np.concatenate(one) for name, one in ratios.items()}
    pooled = np.concatenate([*by_sequence.values()])
    assert 0.62 <= np.mean(pooled <= 1.0) <= 0.76
    assert 0.92 <= np.mean(pooled <= 2.0) <= 0.985
    for name, one in by_sequence.items():
        assert np.mean(one <= 1.0) >= 0.50, name
        assert np.mean(one <= 2.0) >= 0.85, name
    error, uncorrected = np.concatenate(errors), np.concatenate(before)
    assert abs(np.mean(error)) < 0.005
    assert np.sqrt(np.mean(error**2)) < 0.85 * np.sqrt(np.mean(uncorrected**2))
