"""Conventions, counts, ratios, and runs over frames."""

import itertools
import math
import sys

import numpy as np
import pytest
from evaluation_samples import HeightRule, real_kitti, street, write_frame, write_streets
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from gp_ground_seg import Config, GroundSegmenter, Label
from gp_ground_seg.data.semantic_kitti import read_labels, read_points
from gp_ground_seg.errors import DataError, MissingDependencyError, PointCloudError
from gp_ground_seg.evaluation.conventions import (
    CONVENTIONS,
    GROUNDGRID,
    LOW_VEGETATION_Z,
    PATCHWORK,
)
from gp_ground_seg.evaluation.evaluate import evaluate, labelled_frames
from gp_ground_seg.evaluation.methods import OurMethod, PatchworkppMethod
from gp_ground_seg.evaluation.scores import (
    ClassCount,
    Confusion,
    FrameScore,
    MethodScore,
    count_classes,
    count_confusion,
)
from gp_ground_seg.evaluation.semantic_classes import SemanticClass, class_name

GROUND_NUMBERS = {40, 44, 48, 49, 60, 72}
ANY_LABELS = hnp.arrays(np.uint8, st.integers(0, 60), elements=st.sampled_from([0, 1, 2]))


@pytest.mark.parametrize('convention', CONVENTIONS, ids=lambda c: c.key)
def test_ground_classes_are_ground_and_unlabelled_is_left_out(convention):
    for number in SemanticClass:
        if number == SemanticClass.VEGETATION:
            continue
        for z in (-5.0, -1.3, 0.0, 3.0):
            (truth,) = convention.truth(np.array([number]), np.array([z]))
            if number in (0, 1):
                assert truth == Label.UNKNOWN
            else:
                assert truth == (Label.GROUND if number in GROUND_NUMBERS else Label.OBSTACLE)


def test_vegetation_by_convention():
    below, at, above = np.nextafter(LOW_VEGETATION_Z, -9), LOW_VEGETATION_Z, -1.29
    z = np.array([below, at, above, np.nan])
    semantic = np.full(4, 70)
    assert pytest.approx(-1.2975) == LOW_VEGETATION_Z
    assert GROUNDGRID.truth(semantic, z).tolist() == [Label.UNKNOWN] * 4
    assert PATCHWORK.truth(semantic, z).tolist() == [Label.GROUND] + [Label.OBSTACLE] * 3


def test_numbers_outside_the_list_are_obstacles():
    assert GROUNDGRID.truth(np.array([77, 65535]), np.zeros(2)).tolist() == [Label.OBSTACLE] * 2


def test_class_names():
    assert class_name(49) == 'other ground'
    assert class_name(259) == 'moving other vehicle'
    assert class_name(77) == 'class 77'


def test_ratios_by_hand():
    confusion = Confusion(tp=6, fp=2, fn=4, tn=8)
    assert confusion.precision == 6 / 8
    assert confusion.recall == 6 / 10
    assert confusion.f1 == pytest.approx(2 * 0.75 * 0.6 / 1.35)
    assert confusion.accuracy == 14 / 20
    assert confusion.iou == 6 / 12


def test_undefined_ratios_are_nan():
    empty = Confusion()
    ratios = (empty.precision, empty.recall, empty.f1, empty.accuracy, empty.iou)
    assert all(math.isnan(ratio) for ratio in ratios)
    only_obstacles = Confusion(tn=5)
    assert math.isnan(only_obstacles.iou)
    assert only_obstacles.accuracy == 1.0


@given(st.data())
def test_counts_against_a_loop(data):
    label = data.draw(ANY_LABELS)
    truth = data.draw(hnp.arrays(np.uint8, len(label), elements=st.sampled_from([0, 1, 2])))
    counts = dict.fromkeys(itertools.product((True, False), repeat=2), 0)
    for given_label, true_label in zip(label, truth, strict=True):
        if true_label != Label.UNKNOWN:
            counts[given_label == Label.GROUND, true_label == Label.GROUND] += 1
    expected = Confusion(
        counts[True, True], counts[True, False], counts[False, True], counts[False, False]
    )
    assert count_confusion(label, truth) == expected


@given(ANY_LABELS)
def test_unknown_is_scored_as_an_obstacle(label):
    truth = np.resize(np.array([1, 2, 0], dtype=np.uint8), len(label))
    as_obstacle = np.where(label == Label.UNKNOWN, Label.OBSTACLE, label).astype(np.uint8)
    assert count_confusion(label, truth) == count_confusion(as_obstacle, truth)


@given(ANY_LABELS, st.integers(0, 60))
def test_counts_of_parts_add_up(label, cut):
    truth = np.resize(np.array([1, 2, 2, 0, 1], dtype=np.uint8), len(label))
    parts = [count_confusion(label[s], truth[s]) for s in (slice(cut), slice(cut, None))]
    assert parts[0] + parts[1] == count_confusion(label, truth)


@given(ANY_LABELS, st.data())
def test_class_counts_against_a_loop(label, data):
    numbers = st.sampled_from([0, 40, 70, 259, 65535])
    semantic = data.draw(hnp.arrays(np.uint16, len(label), elements=numbers))
    counts = count_classes(label, semantic)
    assert list(counts) == sorted(set(semantic.tolist()))
    for number, count in counts.items():
        of_it = label[semantic == number]
        assert count == ClassCount(len(of_it), int((of_it == Label.GROUND).sum()))


def frame_score(sequence, confusion, seconds=0.0, **stages):
    return FrameScore(
        sequence, '0', seconds, stages, {'groundgrid': confusion}, {40: ClassCount(4, 3)}
    )


def test_pooling_sums_counts_and_does_not_average_ratios():
    large, small = Confusion(tp=90, fp=10), Confusion(fn=1)
    score = MethodScore('x', (frame_score('08', large), frame_score('00', small)))
    assert score.sequences == ['08', '00']
    assert score.pooled('groundgrid').iou == 90 / 101
    assert score.pooled('groundgrid', '00') == small
    assert score.classes() == {40: ClassCount(8, 6)}
    assert score.classes()[40].share_ground == 0.75


def test_times():
    frames = (
        frame_score('00', Confusion(), 0.010, grid=0.004, label=0.001),
        frame_score('00', Confusion(), 0.020, grid=0.006),
        frame_score('00', Confusion(), 0.090, grid=0.050),
    )
    score = MethodScore('x', frames)
    assert score.median_seconds == 0.020
    assert score.mean_seconds == pytest.approx(0.040)
    assert score.median_stage_seconds() == {'grid': 0.006, 'label': 0.001}
    assert math.isnan(MethodScore('x', ()).median_seconds)
    assert math.isnan(MethodScore('x', ()).mean_seconds)


def test_labelled_frames_of_all_and_of_some(tmp_path):
    write_streets(tmp_path, s00=2, s08=1)
    found = [(f.sequence, f.index) for f in labelled_frames(tmp_path)]
    assert found == [('00', '000000'), ('00', '000001'), ('08', '000000')]
    assert [f.sequence for f in labelled_frames(tmp_path, ['08', '00'])] == ['08', '00', '00']


@pytest.mark.parametrize(
    ('sequences', 'message'),
    [
        (['00', '4', '99'], 'no sequence 4, 99; sequences here: 00, 08'),
        ([], 'no sequence asked for; sequences here: 00, 08'),
        (['00', '08', '00'], 'named twice'),
        (['../sequences/00'], 'no sequence ../sequences/00'),
    ],
)
def test_sequences_that_cannot_be(tmp_path, sequences, message):
    write_streets(tmp_path, s00=1, s08=1)
    with pytest.raises(DataError, match=message):
        labelled_frames(tmp_path, sequences)


def test_frames_without_labels_are_named(tmp_path):
    write_streets(tmp_path, s00=1, s11=1)
    write_frame(tmp_path, '11', 5, street()[0])
    with pytest.raises(DataError, match=r'1 of 2 frames of sequence 11 .*000005.*labelled: 00'):
        labelled_frames(tmp_path)
    assert len(labelled_frames(tmp_path, ['00'])) == 1


def test_methods_alternate_after_one_warm_up(tmp_path):
    write_streets(tmp_path, s00=2, s08=1)
    journal = []
    methods = [HeightRule(name, -1.5, journal) for name in 'ab']
    n = len(street()[0])
    ticks = itertools.count()
    scores = evaluate(labelled_frames(tmp_path), methods, clock=lambda: float(next(ticks)))
    assert journal == [
        ('a', 'start'), ('a', n), ('b', 'start'), ('b', n),  # warm-up
        ('a', 'start'), ('b', 'start'), ('a', n), ('b', n), ('b', n), ('a', n),
        ('a', 'start'), ('b', 'start'), ('a', n), ('b', n),
    ]  # fmt: skip
    assert [score.name for score in scores] == ['a', 'b']
    for score in scores:
        # The clock is read right before and right after.
        assert [frame.seconds for frame in score.frames] == [1.0] * 3
        assert [frame.index for frame in score.frames] == ['000000', '000001', '000000']


def test_scores_of_a_rule_known_by_hand(tmp_path):
    write_streets(tmp_path, s00=1)
    points, semantic = street()
    low = points[:, 2] < -1.5
    (score,) = evaluate(labelled_frames(tmp_path), [HeightRule('rule', -1.5)])
    road, wall, tree = semantic == 40, semantic == 50, semantic == 70
    assert score.pooled('groundgrid') == Confusion(
        tp=int(road.sum()), fp=int((wall & low).sum()), fn=0, tn=int((wall & ~low).sum())
    )
    grass = tree & (points[:, 2] < -1.2975)
    assert grass.sum() == 200
    assert score.pooled('patchwork') == Confusion(
        tp=int(road.sum()) + 200,
        fp=int((wall & low).sum()),
        fn=0,
        tn=int((wall & ~low).sum()) + 300,
    )
    assert score.classes()[0] == ClassCount(50, 50)
    assert score.classes()[70] == ClassCount(500, 200)


def test_labels_that_do_not_fit_are_an_error(tmp_path):
    write_streets(tmp_path, s00=1)
    path = tmp_path / 'sequences/00/labels/000000.label'
    path.write_bytes(path.read_bytes()[:-4])
    with pytest.raises(DataError, match=r'000000\.label'):
        evaluate(labelled_frames(tmp_path), [HeightRule('rule', -1.5)])


def test_a_scan_that_is_refused_is_named(tmp_path):
    points, semantic = street()
    points[:, 2] *= -1  # upside down
    write_frame(tmp_path, '00', 3, points, semantic)
    ours = OurMethod(Config())
    with pytest.raises(PointCloudError, match=r'000003\.bin: gp_ground_seg: '):
        evaluate(labelled_frames(tmp_path), [ours])
    ours.close()


def test_ours_is_the_library(tmp_path):
    write_streets(tmp_path, s00=2)
    frames = labelled_frames(tmp_path)
    config = Config().replace(**{'runtime.n_threads': 1})
    ours = OurMethod(config)
    (score,) = evaluate(frames, [ours])
    segmenter = GroundSegmenter(config)
    for frame, scored in zip(frames, score.frames, strict=True):
        points = read_points(frame.points_path)
        semantic = read_labels(frame.labels_path, len(points))
        label = segmenter.segment(points).label
        for convention in CONVENTIONS:
            truth = convention.truth(semantic, points[:, 2])
            assert scored.confusions[convention.key] == count_confusion(label, truth)
        assert 'total' not in scored.stages
        assert 0.0 < sum(scored.stages.values()) <= scored.seconds
    assert ours.fit.n_threads == 1
    ours.close()


def test_a_missing_peer_is_said(monkeypatch):
    monkeypatch.setitem(sys.modules, 'pypatchworkpp', None)
    with pytest.raises(MissingDependencyError, match='pip install pypatchworkpp'):
        PatchworkppMethod()


def test_patchworkpp_keeps_standard_output_clean(tmp_path, capfd):
    write_streets(tmp_path, s00=1)
    (score,) = evaluate(labelled_frames(tmp_path), [PatchworkppMethod()])
    assert capfd.readouterr() == ('', '')
    assert score.pooled('groundgrid').recall > 0.5


def test_patchworkpp_on_real_frames_scores_as_measured_elsewhere():
    """A check of our scoring by a number that is not ours: 95.15 % on these 60 frames."""
    frames = labelled_frames(real_kitti(), ['00', '01', '03', '05', '08', '10'])
    frames = [frame for frame in frames if int(frame.index) < 10]
    (score,) = evaluate(frames, [PatchworkppMethod()])
    assert len(score.frames) == 60
    assert score.pooled('groundgrid').iou == pytest.approx(0.9515, abs=0.001)
