"""Regression on real frames: scores of the defaults must not fall."""

from collections import Counter

import numpy as np
import pytest

from gp_ground_seg import GroundSegmenter, Label
from gp_ground_seg.data.semantic_kitti import list_frames, list_sequences, read_entries
from gp_ground_seg.lab.scoring.objects import count_objects, labelled_objects

pytestmark = pytest.mark.usefixtures('compiled_code')

GROUND_CLASSES = [40, 44, 48, 49, 60, 72]
LEFT_OUT = [0, 1, 70]
FLOOR = {'00': 98.5, '01': 98.9, '03': 94.4, '05': 95.1, '08': 97.1, '10': 97.7}


def test_labels_and_heights_on_labelled_frames(kitti):
    """GroundGrid convention, counted here, with no code of lab/scoring.

    Heights of labelled ground returns are about `ground_z`, as uncertain as `return_std` says.
    """
    segmenter, counts, ratios, errors, before = GroundSegmenter(), {}, {}, [], []
    for frame in (f for name in list_sequences(kitti) for f in list_frames(kitti, name)):
        found, classes, sequence = segmenter.segment(frame.points), frame.semantic, frame.sequence
        truth, kept = np.isin(classes, GROUND_CLASSES), ~np.isin(classes, LEFT_OUT)
        said = found.label == Label.GROUND
        one = [(a & b & kept).sum() for a, b in ((said, truth), (said, ~truth), (~said, truth))]
        counts[sequence] = counts.get(sequence, np.zeros(3)) + one
        own = truth & np.isfinite(found.height)
        errors.append(found.height[own])
        before.append(found.labelled.height[own])
        ratios.setdefault(sequence, []).append(np.abs(errors[-1]) / found.return_std[own])
    pooled = sum(counts.values())
    assert 100 * pooled[0] / pooled.sum() >= 97.5
    for sequence in FLOOR.keys() & counts.keys():
        total = counts[sequence]
        assert 100 * total[0] / total.sum() >= FLOOR[sequence], sequence
    by_sequence = {name: np.concatenate(one) for name, one in ratios.items()}
    every = np.concatenate([*by_sequence.values()])
    assert 0.66 <= np.mean(every <= 1.0) <= 0.70
    assert 0.94 <= np.mean(every <= 2.0) <= 0.965
    for name, one in by_sequence.items():
        assert np.mean(one <= 1.0) >= 0.50, name
        assert np.mean(one <= 2.0) >= 0.85, name
    error, uncorrected = np.concatenate(errors), np.concatenate(before)
    assert abs(np.mean(error)) < 0.005
    assert np.sqrt(np.mean(error**2)) < 0.85 * np.sqrt(np.mean(uncorrected**2))


def test_no_person_and_no_vehicle_is_lost(kitti):
    segmenter, found = GroundSegmenter(), {}
    for frame in (f for name in list_sequences(kitti) for f in list_frames(kitti, name)):
        points = frame.points
        entries = read_entries(frame.labels_path, len(points))
        objects = labelled_objects(points, entries, np.isin(frame.semantic, GROUND_CLASSES))
        for row in count_objects(points, segmenter.segment(points).label, objects):
            found.setdefault(row.pop('class'), Counter()).update(row)
    for name in ('person', 'cyclist'):
        assert found[name]['n_objects'] > 10
        assert found[name]['n_lost'] == 0, name
    vehicles = found['vehicle']
    assert vehicles['n_returns'] > 50_000 and vehicles['n_lost'] == 0
    assert vehicles['n_ground'] < 0.002 * vehicles['n_returns']
