"""What ideas are worth: the list, the sums, the command."""

import argparse
import json

import pytest
from evaluation_samples import write_streets

from gp_ground_seg import Config
from gp_ground_seg.cli import ideas as command
from gp_ground_seg.cli.ideas import parse_idea
from gp_ground_seg.errors import ConfigError, DataError
from gp_ground_seg.evaluation import ablation as runner
from gp_ground_seg.evaluation.evaluate import labelled_frames
from gp_ground_seg.experiments.ablation import ablate
from gp_ground_seg.experiments.ideas import IDEAS, Idea, weigh_ideas


def run(*words):
    parser = argparse.ArgumentParser()
    command.add_parser(parser.add_subparsers(required=True))
    arguments = parser.parse_args(['ideas', *(str(word) for word in words)])
    return arguments.run(arguments)


@pytest.fixture(scope='module')
def root(tmp_path_factory):
    return write_streets(tmp_path_factory.mktemp('kitti'), s00=2, s08=1)


@pytest.mark.parametrize('idea', IDEAS, ids=lambda idea: idea.title)
def test_every_switch_of_the_list_is_accepted_and_turns_something(idea):
    switched = Config().replace(**idea.changes)
    for name in idea.changes:
        assert switched[name] != Config()[name], name


def test_worth_is_what_having_the_idea_adds(root):
    frames = labelled_frames(root)
    far = {'grid.r_max': 15.0}
    ideas = [Idea('far grid', far), Idea('near grid', far, kept=False)]
    given, (kept, dropped) = weigh_ideas(frames, ideas, Config())
    expected = ablate(frames, {'given': {}, 'near': far}, Config())
    assert given.pooled() == expected[0].pooled()
    assert kept.switched.pooled() == expected[1].pooled()
    gain = expected[0].pooled().iou - expected[1].pooled().iou
    assert gain > 0.1
    assert (kept.worth(), dropped.worth()) == (gain, -gain)
    assert kept.worth('08') == expected[0].pooled('08').iou - expected[1].pooled('08').iou


def test_time_ratio_is_the_median_of_the_ratios_by_frame(root):
    given, (one,) = weigh_ideas(labelled_frames(root), [Idea('a', {'grid.n_bins': 40})], Config())
    ratios = sorted(
        a.seconds / b.seconds for a, b in zip(one.switched.frames, given.frames, strict=True)
    )
    assert one.time_ratio == ratios[1]


def test_a_switch_works_on_what_is_given_too(root):
    """Unlike the ablation of the paper, ideas may be weighed from any configuration."""
    config = Config().replace(**{'grid.n_bins': 60})
    given, (one,) = weigh_ideas(
        labelled_frames(root)[:1], [Idea('a', {'grid.n_bins': 40})], config
    )
    assert one.switched.frames != given.frames


@pytest.mark.parametrize(
    ('ideas', 'message'),
    [
        ([Idea('a', {'grid.n_bins': 80})], "'a': its switch changes nothing"),
        ([Idea('a', {'grid.n_bins': 40})] * 2, "'a': there is one"),
        ([Idea('a', {'grid.bins': 40})], 'grid.bins'),
        ([Idea('as given', {'grid.n_bins': 40})], "'as given': there is one"),
    ],
)
def test_lists_that_cannot_be(root, monkeypatch, ideas, message):
    monkeypatch.setattr(runner, 'read_points', None)
    with pytest.raises(ConfigError, match=message):
        weigh_ideas(labelled_frames(root), ideas, Config())


def test_an_idea_in_words():
    idea = parse_idea('gate: at all: growth.max_std=1 learning.mode=fixed')
    assert idea.title == 'gate: at all'
    assert idea.changes == {'growth.max_std': 1, 'learning.mode': 'fixed'}
    for text in ('growth.max_std=1', 'title: ', ': growth.max_std=1', 'title: x'):
        with pytest.raises(ConfigError):
            parse_idea(text)


def rows_of(output):
    lines = output.splitlines()
    start = next(k for k, line in enumerate(lines) if line.startswith('---'))
    rows = {}
    for line in lines[start + 1 :]:
        if not line:
            break
        first, *cells = [cell.strip() for cell in line.split('  ') if cell.strip()]
        rows[first] = cells
    return rows


def test_table_says_what_the_json_says(root, tmp_path, capsys):
    target, page = tmp_path / 'a.json', tmp_path / 'a.md'
    words = ['--only-given', '--json', target, '--markdown', page]
    words += ['--idea', 'small: grid.n_bins=79', '--idea', 'large: grid.r_max=15']
    assert run(root, *words) == 0
    output = capsys.readouterr().out
    rows = rows_of(output)
    document = json.loads(target.read_text())
    assert set(document['ideas']) == {'small', 'large'}
    # Worth most first.
    assert list(rows) == ['as given', 'large', 'small']
    for title, one in document['ideas'].items():
        worst = min(one['sequences'], key=lambda name: one['sequences'][name]['iou'])
        expected = [
            'off',
            f'{100 * one["iou"]:.2f}',
            f'{100 * one["worth"]:+.2f}',
            f'{100 * one["sequences"][worst]["iou"]:.2f} ({worst})',
            f'{100 * one["height"]["rmse"]:.2f}',
            f'{one["time_ratio"]:.2f}',
        ]
        assert rows[title] == expected
        assert f'| {title} | {" | ".join(expected)} |' in page.read_text()
        assert one['worth'] == pytest.approx(document['as given']['iou'] - one['iou'])
    assert page.read_text().startswith('`gp-ground-seg ideas KITTI_ROOT --only-given --idea ')
    assert str(root) not in page.read_text()


def test_files_are_not_overwritten_and_a_list_is_needed(root, tmp_path, monkeypatch):
    monkeypatch.setattr(runner, 'read_points', None)
    target = tmp_path / 'a.md'
    target.write_text('mine')
    with pytest.raises(DataError, match='--force'):
        run(root, '--markdown', target)
    assert target.read_text() == 'mine'
    with pytest.raises(ConfigError, match='no idea given'):
        run(root, '--only-given')
