"""Methods over labelled frames: order and scores; the command `evaluate`: tables and files."""

import itertools
import json
import logging
import re
from functools import partial
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pypatchworkpp
import pytest
from cli_runner import run
from evaluation_samples import HeightRule, street, write_frame, write_streets

from gp_ground_seg import Config, GroundSegmenter
from gp_ground_seg.core.errors import DataError, PointCloudError
from gp_ground_seg.core.parameters.config import SensorConfig
from gp_ground_seg.data.semantic_kitti import labelled_frames
from gp_ground_seg.lab.experiments import SimulatedFrame, load_scan
from gp_ground_seg.lab.scoring import evaluate as runner
from gp_ground_seg.lab.scoring import metrics
from gp_ground_seg.lab.scoring.evaluate import OURS, PATCHWORKPP, STAGE, OurMethod, sums
from gp_ground_seg.lab.scoring.metrics import COUNTS, label_ratios
from gp_ground_seg.lab.scoring.peers import PatchworkppMethod
from gp_ground_seg.lab.scoring.tables import MEASURES

pytestmark = pytest.mark.usefixtures('compiled_code')


def evaluate(root, *methods, **options):
    return runner.score_methods(labelled_frames(root), methods, **options)


def counts(scores, method, frame=None):
    """TP, FP, FN and TN of a method over all scans."""
    pooled = sums(scores.scans if frame is None else frame).loc[method]
    return tuple(pooled[name] for name in COUNTS)


def test_frames_without_labels_are_named_and_sequences_without_any_left_out(tmp_path, caplog):
    caplog.set_level(logging.INFO)
    write_frame(tmp_path, '11', 5, street()[0])
    with pytest.raises(DataError, match='no sequence has labels, of 11'):
        labelled_frames(tmp_path)
    write_streets(tmp_path, s00=2, s08=1)
    names = ['08', '00', '08']
    assert [frame.sequence for frame in labelled_frames(tmp_path, names)] == ['08', '00', '00']
    assert [frame.index for frame in labelled_frames(tmp_path)] == ['000000', '000001', '000000']
    assert caplog.messages == ['sequences without labels left out: 11']
    write_streets(tmp_path, s11=1)
    with pytest.raises(DataError, match='frames of sequence 11 have no labels, as 000005'):
        labelled_frames(tmp_path)


@pytest.mark.parametrize('each_alone', [False, True])
def test_methods_alternate_after_one_warm_up(tmp_path, each_alone, monkeypatch):
    """Of cut scans a second run follows, which is not timed: all write into one journal here."""
    write_streets(tmp_path, s00=2, s08=1)
    first = ['Ra', 'a', 'Rb', 'b']
    second, after = (['Rb', 'b', 'Ra', 'a'], first) if each_alone else (['b', 'a'], ['a', 'b'])
    for cut, expected in (
        (0.0, [*first, *second, *first]),
        (0.45, [*first, *first, *second, *after, *first, *first]),
    ):
        journal, ticks = [], itertools.count()
        clock = SimpleNamespace(perf_counter=lambda t=ticks: float(next(t)))
        monkeypatch.setattr(runner, 'time', clock)
        rules = [HeightRule(name, -1.5, journal) for name in 'ab']
        load = partial(runner.load_kitti, cut=cut)
        scores = evaluate(tmp_path, *rules, each_alone=each_alone, load=load)
        assert journal == ['a', 'b', *expected]
        assert scores.methods == ['a', 'b']
        for name in scores.methods:
            # The clock is read right before and right after.
            own = scores.scans[scores.scans['method'] == name]
            assert own['index'].tolist() == ['000000', '000001', '000000']
            assert own['seconds'].tolist() == [1.0, 1.0, 1.0]


class Learner(HeightRule):
    """A height rule that rises by 0.1 m with each scan of a sequence."""

    depends_on_past = True

    def reset(self, scan):
        self.height = -1.75

    def run(self, points):
        super().run(points)
        self.height += 0.1


def test_what_a_method_learns_from_cut_scans_it_does_not_know_in_whole_ones(tmp_path):
    write_streets(tmp_path, s00=3)
    plain, cut = (
        evaluate(tmp_path, Learner('a', -1.75), load=partial(runner.load_kitti, cut=height)).scans
        for height in (0.0, 0.45)
    )
    assert plain[[*COUNTS]].equals(cut[[*COUNTS]])
    assert plain['fp'].nunique() == 3
    assert 'low_things_n' in cut and 'low_things_n' not in plain


def test_scores_of_rules_known_by_hand(tmp_path):
    write_streets(tmp_path, s00=1, s08=1)
    points, semantic = street()
    heights = {'rule': -1.5, 'misses': -1.72, 'invents': -1.0}
    scores = evaluate(tmp_path, *(HeightRule(*one) for one in heights.items()))
    road, wall, z = semantic == 40, semantic == 50, points[:, 2]
    for name, height in heights.items():
        low = z < height
        expected = [2 * int(x.sum()) for x in (road & low, wall & low, road & ~low, wall & ~low)]
        assert [*counts(scores, name)] == [*counts(scores, name, scores.rings)] == expected
        # The rule has a surface at its height.
        errors = metrics.height_sums(z[road].astype(float), np.full(road.sum(), height))
        row = scores.scans[scores.scans['method'] == name].iloc[0]
        assert row[[*errors]].to_dict() == pytest.approx(errors, nan_ok=True)


def test_data_that_does_not_fit_is_an_error_and_a_refused_scan_is_named(tmp_path):
    points, semantic = street()
    points[:, 2] *= -1  # upside down
    write_frame(tmp_path, '00', 3, points, semantic)
    ours = OurMethod(Config())
    with pytest.raises(PointCloudError, match='00/000003: gp_ground_seg: '):
        evaluate(tmp_path, ours)
    path = tmp_path / 'sequences/00/labels/000003.label'
    path.write_bytes(path.read_bytes()[:-4])
    with pytest.raises(DataError, match=r'000003\.label'):
        evaluate(tmp_path, HeightRule('rule', -1.5))


def test_ours_is_the_library(tmp_path):
    write_streets(tmp_path, s00=1)
    scores = evaluate(tmp_path, OurMethod(Config()))
    scan = runner.load_kitti(labelled_frames(tmp_path)[0])
    result, ground = GroundSegmenter().segment(scan.points), scan.truth == 1
    heights = scan.points[:, 2].astype(float), result.ground_z, result.return_std
    expected = metrics.height_sums(*(values[ground] for values in heights))
    expected |= metrics.count_labels(result.label, scan.truth)
    expected['sensor_height'] = result.pose.height
    (scored,) = scores.scans.to_dict('records')
    assert expected.items() <= scored.items()
    times = {name: t for name, t in scored.items() if name.startswith(STAGE)}
    assert times.keys() == {f'{STAGE}{name}' for name in result.timings} - {f'{STAGE}total'}
    assert 0.0 < sum(times.values()) <= scored['seconds']


def run_peer(scene, sensor='vlp-16', **options):
    scan = load_scan(SimulatedFrame(sensor, scene, 0))
    method = PatchworkppMethod(**options)
    method.run(scan.points)
    return scan, method


def test_the_peer_has_the_place_and_the_height_of_the_sensor():
    """It takes the origin of a cloud to be the sensor, which that of a vehicle's frame is not."""
    scan, own = run_peer('slope', sensor_height=0.8)
    expected, place = own.result(), np.array([1.35, -0.2, 0.8, 0.0], dtype=np.float32)
    sensor = SensorConfig(0.0, 0.0, 0.0, *place[:3].tolist())

    def alike(method, points):
        method.run(points)
        return np.mean(method.result().label == expected.label)

    told, moved = PatchworkppMethod.of_sensor(sensor), scan.points + place
    # But for rounding to the single precision of the points.
    assert alike(told, moved) > 0.997
    assert np.median(np.abs(told.result().ground_z - 0.8 - expected.ground_z)) < 1e-3
    assert alike(PatchworkppMethod(0.8), moved) < 0.8
    # By default it has the published height; a slope is where that matters.
    published = PatchworkppMethod(pypatchworkpp.Parameters().sensor_height)
    assert alike(PatchworkppMethod(), scan.points) == alike(published, scan.points) < 0.995
    own.run(scan.points[:0])
    assert own.result().ground_z.shape == (0,)


@pytest.mark.slow
def test_patchworkpp_on_real_frames_scores_as_measured_elsewhere(kitti):
    """A check of our scoring by a number that is not ours: 95.15 % on these 60 frames."""
    frames = labelled_frames(kitti, ['00', '01', '03', '05', '08', '10'])
    frames = [frame for frame in frames if int(frame.index) < 10]
    scores = runner.score_methods(frames, [PatchworkppMethod()])
    assert len(scores.scans) == 60
    (iou,) = MEASURES['iou'](sums(scores.scans))
    assert iou == pytest.approx(0.9515, abs=0.001)


def test_tables_hold_the_sums_of_the_frames(tmp_path, capfd):
    root = write_streets(tmp_path / 'kitti', s00=2, s08=1)
    assert run('evaluate', root, '--peer', 'patchworkpp', '--json', tmp_path / 'a.json') == 0
    output, errors = capfd.readouterr()
    # No progress where standard error is no terminal; nothing of what Patchwork++ prints.
    assert errors == ''
    document = json.loads((tmp_path / 'a.json').read_text())
    frames = pd.DataFrame(document['rows'])
    for row, name, n_scans in zip(
        document['groundgrid'], ('00', '08', 'all'), (2, 1, 3), strict=True
    ):
        own = frames if name == 'all' else frames[frames['sequence'] == name]
        ratios = label_ratios(own.groupby('method')[[*COUNTS]].sum())
        ours, its = (
            {key: by[method] for key, by in ratios.items()} for method in (OURS, PATCHWORKPP)
        )
        compared = {'peer_iou': its['iou'], 'difference': ours['iou'] - its['iou']}
        assert row == {'sequence': name, 'n_scans': n_scans, **ours, **compared}
    *_, parameters, counted, theirs, last = output.splitlines()
    assert parameters == 'parameters: defaults'
    assert counted == '3 frames of 2 sequences; GroundGrid convention; median time of a frame'
    assert theirs.startswith('Patchwork++: IoU ')
    shown = [f'{100 * ours[key]:.2f}' for key in ('iou', 'precision', 'recall')]
    assert re.findall(r'(\S+) %', last) == shown
    assert last.startswith('gp_ground_seg: IoU ') and last.endswith(' ms')
    assert document['environment']['versions']['pypatchworkpp']
    # State of learning is that of our method only.
    assert (frames['status'].notna() == (frames['method'] == OURS)).all()
    (plants,) = document['objects']  # there are no others
    assert (plants['class'], plants['n_returns']) == ('vegetation', 300 * len(frames) // 2)
    rings = {row['range']: row for row in document['rings']}
    assert rings['> 50 m']['iou'] is rings['> 50 m']['peer_iou'] is None
    assert rings['all']['iou'] == document['groundgrid'][-1]['iou']
    assert ' to ' in rings['all']['interval']
    own, pooled = frames[frames['method'] == OURS], document['heights'][-1]
    assert own['n_points'].sum() == pooled['n_points']
    assert pooled['rmse'] ** 2 == pytest.approx(
        np.average(own['rmse'] ** 2, weights=own['n_points'])
    )
    assert pooled['median_absolute'] == own['median_absolute'].median()


def test_frames_without_a_scored_point(tmp_path):
    root = write_streets(tmp_path / 'kitti', s00=1)
    label = root / 'sequences/00/labels/000000.label'
    label.write_bytes(bytes(len(label.read_bytes())))  # all unlabelled
    assert run('evaluate', root) == 0
