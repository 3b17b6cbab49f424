"""The JSON of an evaluation, and what it says of machine and source."""

import json
import os
import platform
import shutil
import subprocess

import pytest
from evaluation_samples import HeightRule, write_streets

from gp_ground_seg import Config, __version__
from gp_ground_seg.evaluation.environment import _commit, describe_environment
from gp_ground_seg.evaluation.evaluate import evaluate, labelled_frames
from gp_ground_seg.evaluation.report import changed_parameters, report, write_json
from gp_ground_seg.evaluation.scores import Confusion, FrameScore, MethodScore


def make_report(scores, config=None):
    return report(
        scores,
        config if config is not None else Config(),
        describe_environment(),
        n_threads=2,
        backend='numpy',
        data='somewhere',
    )


def test_report_holds_every_number(tmp_path):
    write_streets(tmp_path, s00=2, s08=1)
    methods = [HeightRule('ours', -1.5), HeightRule('peer', -1.72)]
    scores = evaluate(labelled_frames(tmp_path), methods)
    document = make_report(scores)
    write_json(document, tmp_path / 'scores.json')
    read = json.loads((tmp_path / 'scores.json').read_text())
    assert read == document

    assert read['n_frames'] == 3
    assert read['sequences'] == ['00', '08']
    ours = read['methods']['ours']
    pooled = scores[0].pooled('patchwork', '08')
    assert ours['sequences']['08']['patchwork'] == {
        'tp': pooled.tp, 'fp': pooled.fp, 'fn': pooled.fn, 'tn': pooled.tn,
        'precision': pooled.precision, 'recall': pooled.recall, 'f1': pooled.f1,
        'accuracy': pooled.accuracy, 'iou': pooled.iou,
    }  # fmt: skip
    frames = [f['groundgrid'] for f in ours['frames']]
    for count in ('tp', 'fp', 'fn', 'tn'):
        assert sum(f[count] for f in frames) == ours['pooled']['groundgrid'][count]
    assert ours['classes']['40']['name'] == 'road'
    assert ours['classes']['40']['share_ground'] == 1.0
    times = {name: read['methods'][name]['ms_per_frame']['median'] for name in ('ours', 'peer')}
    assert read['median_time_ratio'] == {'peer': pytest.approx(times['ours'] / times['peer'])}


def test_undefined_ratios_are_null(tmp_path):
    frame = FrameScore('00', '0', 0.5, {}, {'groundgrid': Confusion(), 'patchwork': Confusion()})
    document = make_report([MethodScore('x', (frame,))])
    write_json(document, tmp_path / 'scores.json')
    text = (tmp_path / 'scores.json').read_text()
    assert 'NaN' not in text
    assert json.loads(text)['methods']['x']['pooled']['groundgrid']['iou'] is None


def test_parameters_are_recorded():
    config = Config().replace(**{'label.ground_tolerance': 0.123, 'runtime.backend': 'numpy'})
    assert changed_parameters(Config()) == {}
    changes = {'label.ground_tolerance': 0.123, 'runtime.backend': 'numpy'}
    assert changed_parameters(config) == changes
    document = make_report([MethodScore('x', ())], config)
    assert document['config_changes'] == changes
    assert Config().replace(**document['config_changes']) == config
    assert document['config'] == config.nested()


def test_environment():
    environment = describe_environment('no-such-package')
    assert environment.versions['gp_ground_seg'] == __version__
    assert environment.versions['no-such-package'] is None
    assert environment.n_cores == len(os.sched_getaffinity(0))
    assert environment.python == platform.python_version()
    assert environment.cpu


def git(folder, *words):
    identity = ['-c', 'user.name=a', '-c', 'user.email=a@b', '-c', 'commit.gpgsign=false']
    run = ['git', *identity, *words]
    return subprocess.run(run, cwd=folder, check=True, capture_output=True, text=True).stdout


def test_commit_is_that_of_the_source_or_none(tmp_path):
    source = tmp_path / 'package' / '__init__.py'
    source.parent.mkdir()
    source.write_text('')
    assert _commit(source) is None
    if shutil.which('git') is None:
        return
    git(tmp_path, 'init')
    (tmp_path / 'other').write_text('')
    git(tmp_path, 'add', 'other')
    git(tmp_path, 'commit', '-m', 'somebody else')
    assert _commit(source) is None  # inside a repository that is not its own
    git(tmp_path, 'add', 'package')
    git(tmp_path, 'commit', '-m', 'ours')
    commit = git(tmp_path, 'rev-parse', 'HEAD').strip()
    assert _commit(source) == commit
    source.write_text('changed')
    assert _commit(source) == f'{commit}-dirty'
