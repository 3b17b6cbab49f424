"""Leave-one-sequence-out: the search, its bookkeeping, and the command."""

import argparse
import itertools
import json

import pytest
from evaluation_samples import write_streets
from hypothesis import given
from hypothesis import strategies as st

from gp_ground_seg import Config
from gp_ground_seg.cli import leave_out as command
from gp_ground_seg.errors import ConfigError, DataError
from gp_ground_seg.evaluation import leave_out as runner
from gp_ground_seg.evaluation.evaluate import evaluate, labelled_frames
from gp_ground_seg.evaluation.methods import OurMethod
from gp_ground_seg.evaluation.scores import Confusion
from gp_ground_seg.experiments.leave_out import (
    ConfigScorer,
    SequenceScore,
    coordinate_search,
    leave_one_out,
    pool,
)

GRID = {'a': [0, 1, 2], 'b': [0, 1, 2]}


@given(st.lists(st.integers(0, 9), min_size=9, max_size=9))
def test_no_single_change_betters_the_choice(heights):
    worth = dict(zip(itertools.product(range(3), range(3)), heights, strict=True))

    def of(choice):
        return worth[choice['a'], choice['b']]

    best = coordinate_search(GRID, {'a': 0, 'b': 0}, of)
    for name, value in itertools.product(GRID, range(3)):
        assert of({**best, name: value}) <= of(best)
    assert of(best) >= worth[0, 0]


def test_a_separable_maximum_is_found_and_ties_keep_the_given_value():
    best = coordinate_search(GRID, {'a': 0, 'b': 0}, lambda c: -abs(c['a'] - 1) - abs(c['b'] - 2))
    assert best == {'a': 1, 'b': 2}
    assert coordinate_search(GRID, {'a': 1, 'b': 2}, lambda c: 0.0) == {'a': 1, 'b': 2}


HITS = {0.1: (50, 50, 50), 0.2: (90, 60, 40), 0.3: (60, 70, 80)}


class Table:
    """Scores known by hand instead of a scorer: `HITS` of 100 by value and sequence."""

    def __init__(self, frames, base, progress=iter):
        self.asked = []

    def scores(self, choice):
        (value,) = choice.values()
        self.asked.append(value)
        return {
            name: SequenceScore(Confusion(tp=tp, fn=100 - tp), 0)
            for name, tp in zip(('00', '05', '08'), HITS[value], strict=True)
        }

    n_configurations = 3


class Place:
    def __init__(self, sequence):
        self.sequence = sequence


def test_each_sequence_is_scored_with_values_chosen_without_it(monkeypatch):
    monkeypatch.setattr(runner, 'ConfigScorer', Table)
    frames = [Place(name) for name in ('00', '05', '08')]
    name = 'label.ground_tolerance'
    base = Config().replace(**{name: 0.1})
    result = leave_one_out(frames, base, {name: [0.2, 0.3]})
    # By hand: on all 150, 190, 210; without 00 100, 100, 150; without 05 100, 130, 140;
    # without 08 100, 150, 130.
    assert result.tuned_choice == {name: 0.3}
    assert {fold.left_out: fold.choice[name] for fold in result.folds} == {
        '00': 0.3, '05': 0.3, '08': 0.2,
    }  # fmt: skip
    assert [fold.score.confusion.tp for fold in result.folds] == [60, 70, 40]
    assert result.left_out.confusion.iou == pytest.approx(170 / 300)
    assert pool(result.tuned.values()).confusion.iou == pytest.approx(210 / 300)
    assert pool(result.base.values()).confusion.iou == pytest.approx(150 / 300)


@pytest.fixture(scope='module')
def root(tmp_path_factory):
    return write_streets(tmp_path_factory.mktemp('kitti'), s00=2, s08=1)


def test_scores_are_those_of_evaluate_and_each_configuration_runs_once(root):
    frames = labelled_frames(root)
    seen = []

    def progress(items):
        seen.append(len(items))
        return items

    scorer = ConfigScorer(frames, Config(), progress)
    choice = {'grid.r_max': 15.0, 'label.ground_tolerance': 0.05}
    found = scorer.scores(choice)
    assert scorer.scores(dict(reversed(choice.items()))) is found
    scorer.scores({'grid.r_max': 20.0, 'label.ground_tolerance': 0.05})
    assert seen == [3, 3] and scorer.n_configurations == 2
    ours = OurMethod(Config().replace(**choice))
    (score,) = evaluate(frames, [ours])
    ours.close()
    for name in ('00', '08'):
        assert found[name].confusion == score.pooled('groundgrid', name)
        assert found[name].calibration.ece == score.calibration(name).ece
    assert pool(found.values()).confusion == score.pooled('groundgrid')


def run(*words):
    parser = argparse.ArgumentParser()
    command.add_parser(parser.add_subparsers(required=True))
    arguments = parser.parse_args(['leave-out', *(str(word) for word in words)])
    return arguments.run(arguments)


def rows_of(output, first_title):
    lines = output.splitlines()
    start = next(k for k, line in enumerate(lines) if line.startswith(first_title))
    rows = {}
    for line in lines[start + 1 :]:
        if not line:
            break
        if not line.startswith('---'):
            first, *cells = line.split()
            rows[first] = cells
    return rows


def test_tables_say_what_the_json_says(root, tmp_path, capsys):
    target = tmp_path / 'a.json'
    words = ['--set', 'grid.r_max=5,20.0,60', '--set', 'grid.n_bins=40', '--json', target]
    assert run(root, *words) == 0
    output = capsys.readouterr().out
    document = json.loads(target.read_text())
    rows = rows_of(output, 'sequence')
    folds = document['left_out']['folds']
    assert list(rows) == ['00', '08', 'all']
    for name in ('00', '08', 'all'):
        of = [document['given'], document['tuned']]
        scores = [one['pooled'] if name == 'all' else one['sequences'][name] for one in of]
        scores.append(document['left_out']['pooled'] if name == 'all' else folds[name])
        assert rows[name][:3] == [f'{100 * score["iou"]:.2f}' for score in scores]
        assert rows[name][3:] == [f'{score["ece"]:.4f}' for score in scores]
    # At 5 m nearly all ground is missed; at 20 m what lies beyond.
    assert document['tuned']['choice'] == {'grid.r_max': pytest.approx(60, abs=31)}
    assert document['tuned']['pooled']['iou'] >= document['given']['pooled']['iou']
    assert document['config_changes'] == {'grid.n_bins': 40}
    values = rows_of(output, 'parameter')['grid.r_max']
    assert values[:2] == ['90', f'{document["tuned"]["choice"]["grid.r_max"]:g}']
    assert values[2:] == [f'{folds[name]["choice"]["grid.r_max"]:g}' for name in ('00', '08')]
    assert document['n_configurations'] == 4


def test_a_bad_value_is_refused_before_any_frame_is_read(root, monkeypatch):
    monkeypatch.setattr(runner, 'read_points', None)
    for words, message in (
        (['--set', 'grid.r_max=50,0.001'], 'grid.r_max'),
        (['--set', 'grid.rmax=50,60'], 'grid.rmax'),
        (['--set', 'grid.r_max=50'], 'nothing to choose'),
        (['--set', 'grid.r_max=50,60', '--set', 'grid.r_max=5,6'], 'searched twice'),
    ):
        with pytest.raises(ConfigError, match=message):
            run(root, *words)


def test_one_sequence_is_too_few(root, tmp_path):
    with pytest.raises(DataError, match='at least two sequences'):
        run(root, '--sequences', '00', '--set', 'grid.r_max=50,60')
    target = tmp_path / 'a.json'
    target.write_text('mine')
    with pytest.raises(DataError, match='--force'):
        run(root, '--set', 'grid.r_max=50,60', '--json', target)
