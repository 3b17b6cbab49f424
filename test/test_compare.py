"""Two configurations on the same frames: signs, intervals, labels that differ, files."""

import json

import numpy as np
import pytest
from cli_runner import error_line, run
from evaluation_samples import street, write_streets
from matplotlib.image import imread

from gp_ground_seg import Config, GroundSegmenter
from gp_ground_seg.lab.scoring.comparison import MEASURES, difference_table, find_differences
from gp_ground_seg.lab.scoring.evaluate import MethodScore, ScanScore
from gp_ground_seg.lab.scoring.intervals import clusters
from gp_ground_seg.lab.scoring.metrics import Confusion, height_error
from gp_ground_seg.lab.scoring.objects import ObjectCount


def score(*frames, sequences=('00', '08')):
    """One frame of each sequence; `frames` are hits of 100 ground returns, and errors [m]."""
    scans = []
    for sequence, (hits, *errors) in zip(sequences, frames, strict=True):
        height = height_error(np.zeros(len(errors)), np.array(errors), np.full(len(errors), 0.1))
        objects = {'person': (ObjectCount(10, 100 - hits, 4, hits % 2),)}
        confusions = {'g': Confusion(hits, 0, 100 - hits)}
        scans.append(
            ScanScore(sequence, '0', 1e-3 * hits, {}, confusions, height, objects=objects)
        )
    return MethodScore('x', tuple(scans))


def test_differences_are_those_of_the_second_to_the_first_by_hand():
    first, second = score((80, 0.1, -0.2), (90, 0.0, 0.0)), score((85, 0.1, 0.1), (99, 0.3, 0.1))
    found = {one.measure: one for one in find_differences(first, second)}
    assert list(found) == [column.key for column, _ in MEASURES]
    iou, rmse, time = found['iou'], found['rmse'], found['seconds']
    assert (iou.first, iou.second, iou.difference) == pytest.approx((0.85, 0.92, 0.07))
    # Of two sequences the ends are twice the one and twice the other.
    assert (iou.low, iou.high) == pytest.approx((0.05, 0.09))
    assert (rmse.first, rmse.second) == pytest.approx((np.sqrt(0.05 / 4), np.sqrt(0.12 / 4)))
    assert rmse.low < 0 < rmse.high
    assert (time.first, time.difference) == pytest.approx((0.085, 0.007))
    assert (found['recall'].first, found['precision'].second) == pytest.approx((0.85, 1.0))
    assert found['share_ground'].difference == pytest.approx((16 - 30) / 20)
    assert (found['share_lost'].first, found['share_lost'].second) == (0.0, 2 / 8)
    assert (found['within_1'].first, found['within_2'].second) == pytest.approx((0.75, 0.75))
    table = difference_table(first, list(found.values()), ['A', 'B'])
    rows = {row[0]: row[1:] for row in table.rows}
    assert rows['IoU [%]'] == ['85.00', '92.00', '+7.00', '+5.00 to +9.00']
    assert rows['RMSE of the height [cm]'][-1].endswith(' tie')
    assert rows['time per frame, mean [ms]'] == ['85.0', '92.0', '+7.0', '+5.0 to +9.0']
    assert 'bootstrap over the 2 sequences' in table.title and 'B minus A' in table.title


def test_of_a_single_sequence_blocks_of_successive_frames_are_drawn():
    def of(n):
        return MethodScore('x', tuple(ScanScore('00', str(k), 0.0) for k in range(n)))

    for n, sizes in ((1, [1]), (9, [9]), (10, [5, 5]), (23, [5, 6, 6, 6]), (500, [50] * 10)):
        parts = clusters(of(n))
        assert [len(part.scans) for part in parts] == sizes
        assert [scan.index for part in parts for scan in part.scans] == [*map(str, range(n))]
    one = score((80, 0.1), sequences=['00'])
    table = difference_table(one, find_differences(one, one), ['A', 'B'])
    assert 'no intervals: they need two sequences' in table.title
    assert {row[-1] for row in table.rows} == {None}


@pytest.fixture(scope='module')
def root(tmp_path_factory):
    return write_streets(tmp_path_factory.mktemp('kitti'), s00=2, s08=1)


@pytest.fixture(scope='module')
def other(tmp_path_factory):
    """A file whose parameters call less ground."""
    path = tmp_path_factory.mktemp('config') / 'strict.yaml'
    path.write_text('label: {rule: tolerance, ground_tolerance: 0.01}\n')
    return path


def labels_of(points):
    strict = {'label.rule': 'tolerance', 'label.ground_tolerance': 0.01}
    configs = (Config(), Config().replace(**strict))
    return [GroundSegmenter(config).segment(points).label for config in configs]


def test_command_tells_measures_and_draws_the_frames_that_differ_most(
    root, other, tmp_path, capsys
):
    words = ['compare', 'default', other, root, '--frames', 2]
    assert run(*words, '-o', tmp_path / 'new', '--json', tmp_path / 'a.json') == 0
    said = capsys.readouterr().out
    assert f'A: default, B: {other}\n' in said
    assert 'label.ground_tolerance: 0.1 -> 0.01 m\n' in said
    document = json.loads((tmp_path / 'a.json').read_text())
    assert run('evaluate', root, '--config', other, '--json', tmp_path / 'b.json') == 0
    alone = json.loads((tmp_path / 'b.json').read_text())['groundgrid'][-1]
    measures = {one['measure']: one for one in document['measures']}
    assert measures['iou']['second'] == alone['iou'] < measures['iou']['first']
    assert measures['recall']['high'] < 0.0
    expected = {}
    for sequence, seed in (('00', 0), ('00', 1), ('08', 0)):
        one, two = labels_of(street(seed)[0])
        expected[sequence, f'{seed:06d}'] = np.mean(one != two), np.mean((one == 1) & (two != 1))
    found = {
        (s['sequence'], s['frame']): (s['share_different'], s['share_A_only'])
        for s in document['scans']
    }
    assert found == expected
    worst = max(expected, key=lambda key: expected[key][0])
    rows = [line.split() for line in said.partition('Points with two')[2].splitlines()]
    assert tuple(rows[3][:2]) == worst
    assert rows[6][:3] == ['all', '3', 'frames']
    pictures = sorted((tmp_path / 'new').iterdir())
    assert [path.name for path in pictures] == ['differs_1.png', 'differs_2.png']
    height, width = imread(pictures[0]).shape[:2]
    assert width > 2.5 * height  # A, B, and where they differ
    before = pictures[0].read_bytes()
    assert run(*words, '-o', tmp_path / 'new') == 2
    assert '--force replaces them' in capsys.readouterr().err
    assert pictures[0].read_bytes() == before


def test_scans_without_labels_tell_what_differs_and_the_time_only(other, tmp_path, capsys):
    for k in range(3):
        street(k)[0].tofile(tmp_path / f'{k}.bin')
    assert run('compare', other, 'default', tmp_path, '--markdown') == 0
    said = capsys.readouterr().out
    assert 'time per frame' in said
    assert 'IoU' not in said and 'RMSE' not in said
    one, two = labels_of(street(0)[0])
    (row,) = [line.split(' | ') for line in said.splitlines() if ' | 0 | ' in line]
    assert row[3] == f'{100 * np.mean(one != two):.2f}'
    assert row[4] == '0.00'  # B is the more generous here.


@pytest.mark.parametrize(
    ('words', 'message'),
    [
        (['default', 'default', 'ROOT'], 'default and default: the same parameters'),
        (['default', 'no.yaml', 'ROOT'], 'no.yaml: No such file'),
        (['default', 'paper', 'no'], 'no: no such file or folder'),
        (['default', 'paper', 'ROOT', '--sequences', '99'], 'no sequence 99'),
        (['default', 'paper', 'SCAN', '--sequences', '00'], '--sequences: '),
        (['default', 'paper', 'SCAN', '--frame-step', '2'], '--frame-step: '),
    ],
)
def test_bad_input_is_one_line(words, message, root, capsys):
    scan = root / 'sequences/00/velodyne/000000.bin'
    given = {'ROOT': root, 'SCAN': scan}
    assert run('compare', *(given.get(word, word) for word in words)) == 2
    assert message in error_line(capsys)
