"""Differences of two methods and their intervals, by hand; the command `evaluate --against`."""

import itertools
import json
import re

import numpy as np
import pytest
from cli_runner import run
from evaluation_samples import scores_of, street, write_streets

from gp_ground_seg import Config, GroundSegmenter
from gp_ground_seg.lab.scoring import tables
from gp_ground_seg.lab.scoring.metrics import height_sums
from gp_ground_seg.lab.scoring.objects import SHARES
from gp_ground_seg.lab.scoring.report import records


def sequences_of(*hits, of=100, n_frames=1):
    """Rows of sequences with `hits` of `of` ground points in each of their frames."""
    return [
        {'sequence': str(k), 'index': str(j), 'tp': n, 'fp': 0, 'fn': of - n, 'tn': 0}
        for k, n in enumerate(hits)
        for j in range(n_frames)
    ]


def text(ours, theirs):
    return tables.interval_text(scores_of(a=ours, b=theirs), 'b', tables.MEASURES['iou'])


def interval(ours, theirs):
    """The ends [%]."""
    return [float(word) for word in text(ours, theirs).removesuffix(' tie').split(' to ')]


def test_interval_is_that_of_all_draws_weighted_alike():
    """With three clusters all 27 draws can be counted by hand."""
    ours, theirs = (90, 70, 50), (80, 71, 20)
    draws = itertools.product(range(3), repeat=3)
    difference = [sum(ours[k] - theirs[k] for k in draw) / 3 for draw in draws]
    # A draw is of 1 of 27: the ends lie in the lowest and in the highest.
    found = interval(sequences_of(*ours), sequences_of(*theirs))
    assert found == pytest.approx((min(difference), max(difference)), abs=0.006)


def test_large_clusters_weigh_more_and_scans_of_a_sequence_are_drawn_together():
    """Pooled, as the IoU is: not a mean of ratios; ten equal scans are not ten observations."""

    def mixed(large, small):
        rows = sequences_of(*[large] * 20, of=1000)
        small_ones = sequences_of(*[small] * 20, of=10)
        return rows + [{**row, 'sequence': f'small {row["sequence"]}'} for row in small_ones]

    low, high = interval(mixed(1000, 0), mixed(900, 10))
    assert 7 < low < 180_000 / 20_200 < high < 10
    halves, other = (sequences_of(*hits, n_frames=5) for hits in ((60, 40), (50, 50)))
    assert interval(halves, other) == [-10, 10]


def test_words():
    ours, theirs = sequences_of(90, 80, 70), sequences_of(80, 75, 71)
    assert text(ours, theirs) == '-1.00 to +10.00 tie'
    assert text(ours, sequences_of(80, 75, 60)) == '+5.00 to +10.00'
    assert text(ours, ours) == '+0.00 to +0.00 tie'
    assert text(ours[:1], theirs[:1]) is None
    # Of a sequence without a scored point the ratio is not known, if it is drawn alone.
    empty = [sequences_of(90)[0], {**sequences_of(0, of=0)[0], 'sequence': '9'}]
    assert text(empty, empty) is None


def test_rows_of_a_part_are_drawn_by_the_clusters_of_all_scans():
    """A sequence without a row counts as one without a point: with twelve it is seldom alone."""
    hits = [*range(60, 72)]
    ours, theirs = sequences_of(*hits), sequences_of(*reversed(hits))
    scores = scores_of(a=ours, b=theirs)
    part = scores.scans[scores.scans['sequence'] != '5']
    nothing = dict.fromkeys(('tp', 'fn'), 0)
    emptied = [[{**row, **nothing} if row['sequence'] == '5' else row for row in its]
               for its in (ours, theirs)]  # fmt: skip
    assert (
        tables.interval_text(scores, 'b', tables.MEASURES['iou'], part)
        == text(*emptied)
        != text(ours, theirs)
    )


def test_of_a_single_sequence_blocks_of_successive_frames_are_drawn():
    for n, sizes in ((1, [1]), (9, [9]), (10, [5, 5]), (23, [5, 6, 6, 6]), (500, [50] * 10)):
        scores = scores_of(a=sequences_of(50, n_frames=n))
        parts = tables.clusters(scores)
        assert parts.groupby('cluster').size().tolist() == sizes
        assert parts['cluster'].is_monotonic_increasing
        assert parts['index'].tolist() == [*map(str, range(n))]
        found = 'blocks of successive frames' if n >= 10 else 'they need two sequences'
        assert found in tables.interval_note(scores)
    scores = scores_of(a=[
        {'sequence': 'vlp-16 kerb', 'index': str(k), 'cluster': f'kerb {k % 3}'} for k in range(6)
    ])  # fmt: skip
    parts = {
        name: own.tolist() for name, own in tables.clusters(scores).groupby('cluster')['index']
    }
    assert parts == {'kerb 0': ['0', '3'], 'kerb 1': ['1', '4'], 'kerb 2': ['2', '5']}
    assert 'bootstrap over 3 scenes (few: too narrow)' in tables.interval_note(scores)
    assert 'few' not in tables.interval_note(scores_of(a=sequences_of(*range(20))))


def rows_of(*frames, n_changed=0):
    """One frame of each sequence; `frames` are hits of 100 ground returns, and errors [m]."""
    rows = []
    for sequence, (hits, *errors) in zip(('00', '08'), frames, strict=False):
        shares = {f'{name}_n': 50 for name in SHARES}
        shares |= {f'{name}_wrong': 100 - hits for name in SHARES}
        rows.append({
            **sequences_of(hits)[0], 'sequence': sequence, 'seconds': 1e-3 * hits,
            'n_changed': n_changed * len(rows),
            **height_sums(np.zeros(len(errors)), np.array(errors), np.full(len(errors), 0.1)),
            'n_returns': 10, 'n_ground': 100 - hits, 'n_objects': 4, 'n_lost': hits % 2,
            **shares,
        })  # fmt: skip
    return rows


DIFFERENCES = {
    'IoU [%]': (0.92, 0.85, '+5.00 to +9.00'),  # twice the one sequence and twice the other
    'precision [%]': (1.0, 1.0, '+0.00 to +0.00 tie'),
    'recall [%]': (0.92, 0.85, '+5.00 to +9.00'),
    'returns on objects called ground [%]': (16 / 20, 30 / 20, '-90.00 to -50.00'),
    'objects lost [%]': (2 / 8, 0.0, '+25.00 to +25.00'),
    'returns on low objects called ground [%]': (0.16, 0.3, '-18.00 to -10.00'),
    'RMSE of the height [cm]': (np.sqrt(0.12 / 4), np.sqrt(0.05 / 4), '-5.81 to +22.36 tie'),
    'heights within 1 std, ideally 68.3 [%]': (0.75, 0.75, '-50.00 to +50.00 tie'),
}


def test_differences_by_hand():
    ours = rows_of((85, 0.1, 0.1), (99, 0.3, 0.1))
    other = rows_of((80, 0.1, -0.2), (90, 0.0, 0.0), n_changed=30)
    table = tables.difference_table(scores_of(ours=ours, x=other))
    rows = {row['measure']: row for row in records(table.frame)}
    assert list(rows) == [*tables.COMPARED.values()]
    for name, (given, peer, interval) in DIFFERENCES.items():
        found = rows[name]
        assert (found['given'], found['peer']) == pytest.approx((given, peer)), name
        assert found['difference'] == pytest.approx(given - peer, abs=1e-12), name
        assert found['interval'] == interval, name
    assert 'bootstrap over 2 sequences' in table.title and 'Given minus x; ' in table.title
    assert re.search(r'IoU \[%\] +92.00 +85.00 +\+7.00 +\+5.00 to \+9.00', table.text())
    said = 'points with two labels: 15.00%; most in 08/0 (30.00%), 00/0 (0.00%); '
    assert said in table.title
    alone = tables.difference_table(scores_of(ours=ours[:1], x=other[:1]))
    assert 'no intervals: they need two sequences' in alone.title
    assert alone.frame['interval'].isna().all()


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
    assert iou['given'] == alone['iou'] < iou['peer'] == document['groundgrid'][-1]['peer_iou']
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
    assert 'RMSE' not in said and 'Empty' not in said
    assert re.search(rf'{tmp_path.name}/0(.bin)? \({share_changed(0):.2%}\)', said)
