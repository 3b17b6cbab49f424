"""The experiment `speed`: order, ratios, stages; a run on real files."""

import itertools
import json

import numpy as np
import pytest
from cli_runner import run
from evaluation_samples import write_streets

from gp_ground_seg import Config
from gp_ground_seg.data.semantic_kitti import labelled_frames
from gp_ground_seg.lab.experiments import speed
from gp_ground_seg.lab.scoring.evaluate import PATCHWORKPP, make_scores

SMALL = {'grid.n_segments': 8, 'learning.max_evaluations': 1}
NUMPY = Config().replace(**{'runtime.backend': 'numpy', **SMALL})


@pytest.fixture(scope='module')
def root(tmp_path_factory):
    return write_streets(tmp_path_factory.mktemp('kitti'), s00=3, s08=2)


@pytest.fixture(scope='module')
def timed(root):
    """Each reading of the clock is a tick later."""
    clock = itertools.count()
    frames = labelled_frames(root)
    return speed.time_methods(frames, NUMPY, with_peer=True, clock=lambda: next(clock))


def test_every_method_runs_on_every_frame_in_each_pass(root, timed):
    """In which order, and what is forgotten between sequences, test_evaluate.py says."""
    assert timed.methods == ['learning', 'theta fixed', PATCHWORKPP]
    wanted = [(frame.sequence, frame.index) for frame in labelled_frames(root)] * speed.N_PASSES
    for name in timed.methods:
        rows = [row for row in timed.rows['scans'] if row['method'] == name]
        assert [(row['sequence'], row['index']) for row in rows] == wanted
        assert {row['seconds'] for row in rows} == {1}
    modes = timed.scans.groupby('method')['mode'].unique()
    assert modes['learning'] == ['every_frame'] and modes['theta fixed'] == ['fixed']


def scores_of(timed, ours, peer):
    """The scores with other times of the first method and of the last, and stages of these."""
    rows = {name: [dict(row) for row in timed.rows[name]] for name in ('scans', 'times')}
    for method, seconds in ((timed.methods[0], ours), (PATCHWORKPP, peer)):
        own = [row for row in rows['scans'] if row['method'] == method]
        for row, value in zip(own, seconds, strict=True):
            row['seconds'] = value
    own = [row for row in rows['times'] if row['method'] == timed.methods[0]]
    keys = ('method', 'sequence', 'index')
    for row, value in zip(own, ours, strict=True):
        row |= {name: 0.0 for name in row if name not in keys}
        row |= {'grid': 0.25 * value, 'label': 0.5 * value}
    return make_scores([rows])


def test_ratios_pair_each_frame_with_patchworkpp(timed):
    # The machine slows down tenfold after a third; the ratio stays.
    peer = np.repeat([0.02, 0.2], [5, 10])
    scores = scores_of(timed, 0.5 * peer, peer)
    first, *_, last = speed._times(scores).json()
    assert first['ratio'] == pytest.approx(0.5)
    assert first['p99_ratio'] == pytest.approx(0.1 / 0.2)
    assert first['median'] == pytest.approx(0.1) and last['median'] == pytest.approx(0.2)
    assert (last['method'], last['ratio']) == ('Patchwork++', 1.0)
    stages = speed._stages(scores).json()
    assert [row['method'] for row in stages] == ['learning', 'theta fixed']
    found = {name: stages[0][name] for name in ('grid', 'label', 'rest')}
    assert found == pytest.approx({'grid': 0.025, 'label': 0.05, 'rest': 0.025})


def test_both_backends_are_timed_where_there_are_two(root, tmp_path, capsys):
    path = tmp_path / 'a.json'
    words = [word for name, value in SMALL.items() for word in ('--set', f'{name}={value}')]
    assert run('experiment', 'speed', root, '--no-peer', *words, '--json', path) == 0
    assert 'Patchwork++' not in capsys.readouterr().out
    document = json.loads(path.read_text())
    backends = {row['method']: row['ratio'] for row in document['times'] if 'ratio' in row}
    assert not backends
    names = [row['method'] for row in document['times']]
    assert names == ['learning', 'theta fixed', 'learning, numpy', 'theta fixed, numpy']
    assert all(row['median'] > 0.0 for row in document['times'])
    assert len(document['rows']) == 4 * 5 * speed.N_PASSES
    assert run('experiment', 'speed', root, '--set', 'runtime.backend=numpy', '--no-peer') == 0
    assert 'learning, numpy' not in capsys.readouterr().out
