"""Differences of two methods and their intervals, by hand; the command `evaluate --against`."""

import itertools
import json
import re

import numpy as np
import pytest
import scipy.stats
from cli_runner import error_line, run
from evaluation_samples import street, write_streets

from gp_ground_seg import Config, GroundSegmenter
from gp_ground_seg.lab.scoring.comparison import (
    MEASURES,
    clusters,
    difference_interval,
    difference_table,
    interval_note,
    interval_text,
    mse_sums,
    without_one_table,
)
from gp_ground_seg.lab.scoring.evaluate import MethodScore, ScanScore
from gp_ground_seg.lab.scoring.metrics import Confusion, height_error
from gp_ground_seg.lab.scoring.objects import SHARES, ObjectCount, Share


def sequences_of(*hits, of=100, n_frames=1):
    """Sequences with `hits` of `of` ground points in each of their frames."""
    return MethodScore('x', tuple(
        ScanScore(str(k), str(j), 0.0, confusions={'g': Confusion(n, 0, of - n)})
        for k, n in enumerate(hits)
        for j in range(n_frames)
    ))  # fmt: skip


def heights_of(**errors):
    """Scans with errors of the height [m], by sequence."""
    return MethodScore('x', tuple(
        ScanScore(name, '0', 0.0, height=height_error(np.zeros(len(own)), np.array(own)))
        for name, own in errors.items()
    ))  # fmt: skip


def test_interval_is_that_of_all_draws_weighted_alike():
    """With three clusters all 27 draws can be counted by hand."""
    ours, theirs = (90, 70, 50), (80, 71, 20)
    draws = itertools.product(range(3), repeat=3)
    difference = [sum(ours[k] - theirs[k] for k in draw) / 300 for draw in draws]
    found = difference_interval(sequences_of(*ours), sequences_of(*theirs))
    # A draw is of 1 of 27: the ends lie in the lowest and in the highest.
    assert found == pytest.approx((min(difference), max(difference)))
    assert found.is_tie


def test_one_sequence_left_out_after_the_other():
    ours, theirs = (90, 70, 50, 60), (80, 71, 20, 55)
    table = without_one_table(sequences_of(*ours), sequences_of(*theirs))
    without = [(sum(ours) - a - sum(theirs) + b) / 300 for a, b in zip(ours, theirs, strict=True)]
    found = [row['difference'] for row in table.json()]
    assert found == pytest.approx([*without, (sum(ours) - sum(theirs)) / 400])
    # As by pseudo-values, whose mean is that of all, as the sequences are equally large.
    pseudo = 4 * found[-1] - 3 * np.array(without)
    low, high = scipy.stats.t.interval(0.95, 3, pseudo.mean(), scipy.stats.sem(pseudo))
    assert table.title.endswith(f'{100 * low:+.2f} to {100 * high:+.2f} tie')


def test_large_clusters_weigh_more_and_scans_of_a_sequence_are_drawn_together():
    """Pooled, as the IoU is: not a mean of ratios; ten equal scans are not ten observations."""

    def mixed(large, small):
        parts = sequences_of(*[large] * 20, of=1000), sequences_of(*[small] * 20, of=10)
        scans = [
            *parts[0].scans,
            *(
                ScanScore(f'small {s.sequence}', '0', 0.0, confusions=s.confusions)
                for s in parts[1].scans
            ),
        ]
        return MethodScore('x', tuple(scans))  # fmt: skip

    low, high = difference_interval(mixed(1000, 0), mixed(900, 10))
    assert 0.07 < low < 1800 / 20200 < high < 0.1
    halves, other = (sequences_of(*hits, n_frames=5) for hits in ((60, 40), (50, 50)))
    assert difference_interval(halves, other) == pytest.approx((-0.1, 0.1))


def test_words():
    ours, theirs = sequences_of(90, 80, 70), sequences_of(80, 75, 71)
    assert interval_text(ours, theirs) == '-1.00 to +10.00 tie'
    assert interval_text(ours, sequences_of(80, 75, 60)) == '+5.00 to +10.00'
    assert interval_text(ours, ours) == '+0.00 to +0.00 tie'
    assert interval_text(ours.of('0'), theirs.of('0')) is None
    empty = sequences_of(90, 0, of=90)
    empty = MethodScore('x', (empty.scans[0], ScanScore('9', '0', 0.0)))
    assert interval_text(empty, empty) is None
    ours, theirs = heights_of(a=[0.3, 0.3], b=[0.1]), heights_of(a=[0.0, 0.0], b=[0.1])
    # Twice the first: 0.3 - 0; twice the second: no difference.
    assert difference_interval(ours, theirs, mse_sums) == pytest.approx((0.0, 0.3))
    assert interval_text(ours, theirs, mse_sums) == '+0.00 to +30.00 tie'


def test_it_is_the_same_each_time_and_follows_the_generator_given():
    ours, theirs = sequences_of(*range(50, 62)), sequences_of(*range(61, 49, -1))
    np.random.seed(5)  # noqa: NPY002 - the state that must not matter
    before = difference_interval(ours, theirs)
    np.random.seed(6)  # noqa: NPY002
    assert difference_interval(ours, theirs) == before
    found = [difference_interval(ours, theirs, rng=np.random.default_rng(k)) for k in (1, 2)]
    assert found[0] != found[1] and found[0] == pytest.approx(found[1], abs=0.01)


def test_of_a_single_sequence_blocks_of_successive_frames_are_drawn():
    for n, sizes in ((1, [1]), (9, [9]), (10, [5, 5]), (23, [5, 6, 6, 6]), (500, [50] * 10)):
        score = sequences_of(50, n_frames=n)
        parts = clusters(score)
        assert [len(part.scans) for part in parts] == sizes
        assert [scan.index for part in parts for scan in part.scans] == [*map(str, range(n))]
        found = 'blocks of successive frames' if n >= 10 else 'they need two sequences'
        assert found in interval_note(score)
    scenes = [ScanScore('vlp-16 kerb', str(k), 0.0, cluster=f'kerb {k % 3}') for k in range(6)]
    score = MethodScore('x', tuple(scenes))
    assert [[scan.index for scan in part.scans] for part in clusters(score)] == [
        ['0', '3'], ['1', '4'], ['2', '5'],
    ]  # fmt: skip
    assert 'bootstrap over 3 scenes' in interval_note(score)


def score(*frames, sequences=('00', '08'), n_changed=0):
    """One frame of each sequence; `frames` are hits of 100 ground returns, and errors [m]."""
    scans = []
    for sequence, (hits, *errors) in zip(sequences, frames, strict=True):
        height = height_error(np.zeros(len(errors)), np.array(errors), np.full(len(errors), 0.1))
        objects = {'person': (ObjectCount(10, 100 - hits, 4, hits % 2),)}
        shares = {name: Share(50, 100 - hits) for name in SHARES}
        confusions = {'g': Confusion(hits, 0, 100 - hits)}
        scans.append(
            ScanScore(sequence, '0', 1e-3 * hits, {}, confusions, height, objects=objects,
                      shares=shares, n_points=100, n_changed=n_changed * len(scans))
        )  # fmt: skip
    return MethodScore('x', tuple(scans))


def test_differences_by_hand():
    ours = score((85, 0.1, 0.1), (99, 0.3, 0.1))
    other = score((80, 0.1, -0.2), (90, 0.0, 0.0), n_changed=30)
    table = difference_table(ours, other)
    rows = {row['measure']: row for row in table.json()}
    assert list(rows) == [column.title for column, _ in MEASURES]
    iou, rmse = rows['IoU [%]'], rows['RMSE of the height [cm]']
    assert (iou['given'], iou['peer'], iou['difference']) == pytest.approx((0.92, 0.85, 0.07))
    # Of two sequences the ends are twice the one and twice the other.
    assert iou['interval'] == '+5.00 to +9.00'
    assert (rmse['peer'], rmse['given']) == pytest.approx((np.sqrt(0.05 / 4), np.sqrt(0.12 / 4)))
    assert rmse['interval'].endswith(' tie')
    time = rows['time per frame, mean [ms]']
    assert (time['peer'], time['difference']) == pytest.approx((0.085, 0.007))
    assert time['interval'] == '+5.0 to +9.0'
    assert (rows['recall [%]']['peer'], rows['precision [%]']['given']) == pytest.approx((0.85, 1))
    returns = rows['returns on objects called ground [%]']
    assert returns['difference'] == pytest.approx((16 - 30) / 20)
    low = rows['returns on low things called ground [%]']
    assert (low['given'], low['peer'], low['interval']) == (0.16, 0.3, '-18.00 to -10.00')
    lost = rows['objects lost [%]']
    assert (lost['peer'], lost['given']) == (0.0, 2 / 8)
    within = [rows[f'heights within {k} std, ideally {n} [%]'] for k, n in ((1, 68.3), (2, 95.4))]
    assert (within[0]['peer'], within[1]['given']) == pytest.approx((0.75, 0.75))
    assert 'bootstrap over 2 sequences' in table.title and 'Given minus x; ' in table.title
    assert re.search(r'measure +given +x +difference', table.text())
    assert '92.00   85.00       +7.00  +5.00 to +9.00' in table.text()
    assert table.notes == ['points with two labels: 15.00%; most in 08/0 (30.00%), 00/0 (0.00%)']
    alone = difference_table(ours.of('00'), other.of('00'))
    assert 'no intervals: they need two sequences' in alone.title
    assert {row['interval'] for row in alone.json()} == {None}


@pytest.fixture(scope='module')
def root(tmp_path_factory):
    return write_streets(tmp_path_factory.mktemp('kitti'), s00=2, s08=1)


@pytest.fixture(scope='module')
def strict(tmp_path_factory):
    """A file whose parameters call less ground."""
    path = tmp_path_factory.mktemp('config') / 'strict.yaml'
    path.write_text('label: {rule: tolerance, ground_tolerance: 0.01}\n')
    return path


def share_changed(seed):
    strict = {'label.rule': 'tolerance', 'label.ground_tolerance': 0.01}
    configs = (Config(), Config().replace(**strict))
    one, other = (GroundSegmenter(config).segment(street(seed)[0]).label for config in configs)
    return np.mean(one != other)


def test_two_sets_of_parameters_are_compared(root, strict, tmp_path, capsys):
    settings = 'label.rule=tolerance', 'label.ground_tolerance=0.01'
    words = ['evaluate', root, *(word for one in settings for word in ('--set', one))]
    assert run(*words, '--against', 'default', '--json', tmp_path / 'a.json') == 0
    said = capsys.readouterr().out
    assert 'default -> given:\n' in said
    assert 'label.ground_tolerance: 0.1 -> 0.01 m\n' in said
    document = json.loads((tmp_path / 'a.json').read_text())
    assert run('evaluate', root, '--config', strict, '--json', tmp_path / 'b.json') == 0
    alone = json.loads((tmp_path / 'b.json').read_text())['groundgrid'][-1]
    measures = {row['measure']: row for row in document['measures']}
    iou = measures['IoU [%]']
    assert iou['given'] == alone['iou'] < iou['peer'] == document['groundgrid'][-1]['default_iou']
    assert measures['recall [%]']['interval'].startswith('-')
    expected = [share_changed(seed) for seed in (0, 1, 0)]
    found = [row for row in document['rows'] if row['method'] == 'default']
    assert [row['n_changed'] / row['points'] for row in found] == expected
    worst = found[int(np.argmax(expected))]
    assert f'most in {worst["sequence"]}/{worst["index"]} ({max(expected):.2%})' in said


def test_scans_without_labels_have_points_that_differ_and_time_only(strict, tmp_path, capsys):
    for k in range(3):
        street(k)[0].tofile(tmp_path / f'{k}.bin')
    assert run('evaluate', tmp_path, '--against', strict) == 0
    said = capsys.readouterr().out
    assert said.startswith(f'{strict} -> given:')
    *_, theirs, ours = said.splitlines()
    for line, name in ((theirs, strict.name), (ours, 'gp_ground_seg')):
        assert re.fullmatch(rf'{name}: no labels of the ground, [\d.]+ ms', line)
    assert 'RMSE' not in said and 'Probabilities' not in said
    assert f'{tmp_path.name}/0.bin ({share_changed(0):.2%})' in said.replace('\n  ', ' ') or (
        f'{tmp_path.name}/0 ({share_changed(0):.2%})' in said.replace('\n  ', ' ')
    )


@pytest.mark.parametrize(
    ('words', 'message'),
    [
        (['ROOT', '--against', 'default'], '--against default: the same parameters as given'),
        (['ROOT', '--against', 'no.yaml'], 'no.yaml: No such file'),
        (['no', '--against', 'paper'], 'no: no such file or folder'),
        (['ROOT', '--against', 'paper', '--sequences', '99'], 'no sequence 99'),
        (['ROOT', '--against', 'paper', '--peer', 'patchworkpp'], '--against: compares with p'),
        *((['SCAN', '--against', 'paper', option, '2'], f'{option}: ')
          for option in ('--sequences', '--frame-step', '--cut', '--workers')),
        (['SCAN'], 'no sequences/*/velodyne folder below it (SemanticKITTI layout); scans without '
         'labels need --against'),
    ],
)  # fmt: skip
def test_bad_input_is_one_line(words, message, root, capsys):
    scan = root / 'sequences/00/velodyne/000000.bin'
    given = {'ROOT': root, 'SCAN': scan}
    assert run('evaluate', *(given.get(word, word) for word in words)) == 2
    assert message in error_line(capsys)
