"""The command `ablation`, and the height errors it rests on."""

import argparse
import json
import math
import re
import shlex
from pathlib import Path

import numpy as np
import pytest
from evaluation_samples import write_streets
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst

from gp_ground_seg import Config, GroundSegmenter, Label
from gp_ground_seg.cli import ablation as command
from gp_ground_seg.cli.leave_out import split_settings
from gp_ground_seg.cli.main import build_parser
from gp_ground_seg.cli.options import config_from_options
from gp_ground_seg.data.semantic_kitti import read_labels, read_points
from gp_ground_seg.errors import ConfigError, DataError
from gp_ground_seg.evaluation import ablation as runner
from gp_ground_seg.evaluation import ablation_synthetic as synthetic
from gp_ground_seg.evaluation.conventions import GROUNDGRID
from gp_ground_seg.evaluation.evaluate import labelled_frames
from gp_ground_seg.evaluation.height_error import height_error, pool_height_errors
from gp_ground_seg.evaluation.scores import count_confusion
from gp_ground_seg.experiments.ablation import METHODS, ablate, open_segmenters
from gp_ground_seg.experiments.ablation_synthetic import STRETCHES, ablate_synthetic
from gp_ground_seg.simulation import HDL_64E, SCENES, simulate_scan


def run(*words):
    parser = argparse.ArgumentParser()
    command.add_parser(parser.add_subparsers(required=True))
    arguments = parser.parse_args(['ablation', *(str(word) for word in words)])
    return arguments.run(arguments)


def table(output):
    """Rows below the rule, split at runs of two blanks, by first cell."""
    lines = output.splitlines()
    start = next(k for k, line in enumerate(lines) if line.startswith('----'))
    rows = {}
    for line in lines[start + 1 :]:
        if not line:
            break
        first, *cells = (cell.strip() for cell in line.split('  ') if cell.strip())
        rows[first] = cells
    return rows


def test_commands_of_the_docs_are_accepted():
    """Those above the tables of docs/experiments.md, and those in its text."""
    text = (Path(__file__).parents[1] / 'docs' / 'experiments.md').read_text(encoding='utf-8')
    commands = re.findall(r'`gp-ground-seg (.*?)`', text)
    names = {'table1', 'plot', 'ablation', 'evaluate', 'ideas', 'leave-out', 'scenes'}
    assert {words.split()[0] for words in commands} == names
    for words in commands:
        arguments = build_parser(words.split()[0]).parse_args(shlex.split(words))
        if words.startswith('leave-out'):
            grid, arguments.settings = split_settings(arguments.settings)
            for name, values in grid.items():
                for value in values:
                    Config().replace(**{name: value})
        if words.startswith('scenes'):  # each sensor has a preset of its own
            arguments.preset = arguments.preset or 'default'
        config_from_options(arguments)


def test_height_error_by_hand():
    error = height_error(np.array([0.0, 1.0, 2.0, 5.0]), np.array([0.5, 1.0, 1.0, np.nan]))
    assert (error.n_points, error.n_without_model) == (3, 1)
    assert error.rmse == pytest.approx(math.sqrt(1.25 / 3))
    assert error.bias == pytest.approx(-0.5 / 3)
    assert error.median_absolute == 0.5
    assert error.smse == pytest.approx((1.25 / 3) / (2 / 3))


def test_height_error_of_nothing():
    for error in (
        height_error(np.empty(0), np.empty(0)),
        height_error(np.ones(2), np.full(2, np.nan)),
        pool_height_errors([]),
    ):
        assert error.n_points == 0
        values = (error.rmse, error.bias, error.smse, error.median_absolute)
        assert all(math.isnan(value) for value in values)


HEIGHTS = npst.arrays(
    np.float64, st.tuples(st.integers(1, 30), st.just(2)), elements=st.floats(-50.0, 50.0)
)


@given(HEIGHTS, HEIGHTS)
def test_pooled_height_errors_are_those_of_all_points(first, second):
    frames = [first, second]
    pooled = pool_height_errors([height_error(*frame.T) for frame in frames])
    both = np.concatenate(frames)
    difference = both[:, 1] - both[:, 0]
    assert pooled.n_points == len(both)
    assert pooled.rmse == pytest.approx(np.sqrt(np.mean(difference**2)), abs=1e-9)
    assert pooled.bias == pytest.approx(difference.mean(), abs=1e-9)
    spread = sum(((frame[:, 0] - frame[:, 0].mean()) ** 2).sum() for frame in frames)
    if spread > 1e-6:
        assert pooled.smse == pytest.approx((difference**2).sum() / spread, rel=1e-6)


@pytest.fixture(scope='module')
def root(tmp_path_factory):
    return write_streets(tmp_path_factory.mktemp('kitti'), s00=3, s08=1)


def test_frame_results_follow_their_definitions(root):
    frames = labelled_frames(root)[:2]
    title = 'Z-L, not learned'
    (result,) = ablate(frames, {title: METHODS[title]}, Config())
    segmenter = GroundSegmenter(Config().replace(**{'learning.mode': 'fixed'}))
    for frame, found in zip(frames, result.frames, strict=True):
        points = read_points(frame.points_path)
        semantic = read_labels(frame.labels_path, len(points))
        truth = GROUNDGRID.truth(semantic, points[:, 2])
        expected = segmenter.segment(points)
        assert found.confusion == count_confusion(expected.label, truth)
        error = (expected.ground_z - points[:, 2])[truth == Label.GROUND]
        error = error[np.isfinite(error)]
        assert found.height.rmse == pytest.approx(np.sqrt(np.mean(error**2)))
        assert found.height.median_absolute == pytest.approx(np.median(np.abs(error)))
        assert found.seconds > 0.0


def test_methods_are_what_their_names_say():
    with open_segmenters(METHODS, Config()) as segmenters:
        assert list(segmenters) == list(METHODS)
        for title, segmenter in segmenters.items():
            config = segmenter.config
            models = {'constant': 'constant', 'Z': 'line_gradient', 'Z-L': 'latent'}
            assert config.length_scale.model == models[title.split(',')[0]]
            assert (config.learning.mode == 'fixed') == ('not learned' in title)
            assert (config.learning.scope == 'segment') == ('per segment' in title)
    *_, last = METHODS
    assert Config().replace(**METHODS[last]) == Config()


def test_table_says_what_the_json_says(root, tmp_path, capsys):
    words = ['--json', tmp_path / 'a.json', '--markdown', tmp_path / 'a.md', '--frame-step', 2]
    assert run(root, *words) == 0
    output = capsys.readouterr().out
    rows = table(output)
    document = json.loads((tmp_path / 'a.json').read_text())
    markdown = (tmp_path / 'a.md').read_text()
    assert markdown.startswith('`gp-ground-seg ablation KITTI_ROOT --frame-step 2`\n')
    assert str(root) not in markdown
    assert list(rows) == list(document['methods']) == list(METHODS)
    assert output.startswith('3 labelled frames of 2 sequences;')
    for title, method in document['methods'].items():
        assert [(f['sequence'], f['index']) for f in method['frames']] == [
            ('00', '000000'),
            ('00', '000002'),
            ('08', '000000'),
        ]
        worst = min(method['sequences'], key=lambda name: method['sequences'][name]['iou'])
        height = method['height']
        assert rows[title] == [
            f'{100 * method["iou"]:.2f}',
            f'{100 * method["sequences"][worst]["iou"]:.2f} ({worst})',
            f'{100 * height["rmse"]:.2f}',
            f'{100 * height["median_absolute"]:.2f}',
            f'{height["smse"]:.5f}',
            f'{method["median_ms"]:.1f}',
        ]
        assert f'| {title} | {" | ".join(rows[title])} |' in markdown
    assert document['method_changes'] == METHODS
    assert max(len(line) for line in output.splitlines() if 'written' not in line) <= 100


def test_learning_changes_theta(root):
    """Each way to learn gives hyper-parameters of its own."""
    results = ablate(labelled_frames(root)[:1], METHODS, Config())
    theta = {result.title: tuple(result.fit.theta.values()) for result in results}
    assert len(set(theta.values())) == len(METHODS) - 2
    # Nothing is learned: what the length-scale model is does not show in theta.
    given = {values for title, values in theta.items() if 'not learned' in title}
    assert len(given) == 1


def test_synthetic_table_says_what_the_json_says(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(synthetic, 'SENSOR_X', (12.0,))
    target = tmp_path / 'a.json'
    assert run('--synthetic', '--seeds', 1, '--json', target) == 0
    output = capsys.readouterr().out
    rows = table(output)
    document = json.loads(target.read_text())
    assert output.startswith('1 simulated scan of 1 scene,')
    assert document['command'] == 'gp-ground-seg ablation --synthetic --seeds 1'
    assert list(rows) == list(document['methods']) == list(synthetic.METHODS)
    for title, method in document['methods'].items():
        heights = [method['height'][stretch] for stretch in STRETCHES]
        expected = [f'{100 * height["rmse"]:.2f}' for height in heights]
        expected += [f'{100 * height["median_absolute"]:.2f}' for height in heights]
        assert rows[title][:-1] == expected
        n_all, n_smooth, n_rubble = (height['n_points'] for height in heights)
        assert min(n_smooth, n_rubble) > 10_000
        assert n_smooth + n_rubble < n_all


def test_stretches_are_smooth_and_rough():
    """By the exact heights: the road is level, the rubble is not."""
    scene = SCENES[synthetic.SCENE](3)
    scan = simulate_scan(scene, HDL_64E, np.random.default_rng(3), x=12.0)
    chosen = synthetic._stretches(scene, scan.is_ground, scan.points[:, 0] + 12.0)
    np.testing.assert_array_equal(chosen['all'], scan.is_ground)
    assert not (chosen['smooth'] & chosen['rubble']).any()
    assert np.ptp(scan.ground_z[chosen['smooth']]) < 1e-9
    assert 0.1 < np.std(scan.ground_z[chosen['rubble']]) < 0.2


def test_latent_length_scales_win_where_smoothness_changes():
    """The worth of the latent process; docs/experiments.md has the whole table."""
    titles = ('constant, 10 m', 'line gradient', 'latent')
    results = ablate_synthetic(2, {t: synthetic.METHODS[t] for t in titles}, Config())
    constant, line_gradient, latent = results
    for stretch in ('all', 'rubble'):
        for other in (constant, line_gradient):
            assert latent.height(stretch).rmse < 0.9 * other.height(stretch).rmse, stretch
    for other in (constant, line_gradient):
        median = other.height('rubble').median_absolute
        assert latent.height('rubble').median_absolute < 0.9 * median
    # On the road nobody errs by more than the sensor's noise.
    assert all(result.height('smooth').rmse < 0.02 for result in results)


def test_files_are_not_overwritten_without_force(root, tmp_path, monkeypatch):
    target = tmp_path / 'a.md'
    target.write_text('mine')
    monkeypatch.setattr(runner, 'read_points', None)  # refused before any frame is read
    with pytest.raises(DataError, match='--force'):
        run(root, '--markdown', target, '--json', tmp_path / 'a.json')
    assert [path.name for path in tmp_path.iterdir()] == ['a.md']
    assert target.read_text() == 'mine'


@pytest.mark.parametrize(
    ('words', 'error', 'message'),
    [
        ([], DataError, 'either ROOT or --synthetic'),
        (['ROOT', '--synthetic'], DataError, 'either ROOT or --synthetic'),
        (['ROOT', '--seeds', '2'], DataError, '--seeds: is for --synthetic only'),
        (['--synthetic', '--sequences', '00'], DataError, '--sequences: is for labelled frames'),
        (['--synthetic', '--frame-step', '2'], DataError, '--frame-step: is for labelled frames'),
        (['ROOT', '--sequences', '07'], DataError, 'no sequence 07; sequences here: 00, 08'),
        (['ROOT', '--set', 'learning.mode=fixed'], ConfigError, 'learning.mode = fixed: .* leave'),
        (['--synthetic', '--set', 'length_scale.constant=3'], ConfigError, 'leave it out'),
    ],
)
def test_errors_are_said(root, words, error, message):
    with pytest.raises(error, match=message):
        run(*(root if word == 'ROOT' else word for word in words))


@pytest.mark.parametrize('words', [['--seeds', '0'], ['--frame-step', 'x']])
def test_usage_errors(root, words, capsys):
    with pytest.raises(SystemExit) as caught:
        run(root, *words)
    assert caught.value.code == 2
    assert 'at least 1' in capsys.readouterr().err
