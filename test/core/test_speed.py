"""The experiment `speed`: order, ratios, stages; a run on real files."""

import itertools
import json

import numpy as np
import pytest
from cli_runner import run
from evaluation_samples import write_streets

from gp_ground_seg import Config
from gp_ground_seg.data.semantic_kitti import labelled_frames
from gp_ground_seg.lab import experiments
from gp_ground_seg.lab.scoring.evaluate import KEYS, PATCHWORKPP

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
    return experiments.time_methods(frames, NUMPY, with_peer=True, clock=lambda: next(clock))


def test_every_method_runs_on_every_frame_in_each_pass(root, timed):
    """In which order, and what is forgotten between sequences, test_evaluate.py says."""
    assert timed.methods == ['learning', 'theta fixed', PATCHWORKPP]
    wanted = [(frame.sequence, frame.index) for frame in labelled_frames(root)]
    for _, own in timed.scans.groupby('method'):
        assert [*zip(own['sequence'], own['index'], strict=True)] == wanted * experiments.N_PASSES
        assert set(own['seconds']) == {1}
    modes = timed.scans.groupby('method')['mode'].unique()
    assert modes['learning'] == ['every_frame'] and modes['theta fixed'] == ['fixed']


def test_ratios_pair_each_frame_with_patchworkpp(timed):
    # The machine slows down tenfold after a third; the ratio stays.
    peer = np.repeat([0.02, 0.2], [5, 10])
    scans, times = timed.scans.copy(), timed.times.copy()
    scans['seconds'] = scans['seconds'].astype(float)
    for name, seconds in (('learning', 0.5 * peer), (PATCHWORKPP, peer)):
        scans.loc[scans['method'] == name, 'seconds'] = seconds
    first = times['method'] == 'learning'
    times.loc[first, [name for name in times if name not in KEYS]] = 0.0
    times.loc[first, 'grid'], times.loc[first, 'label'] = 0.125 * peer, 0.25 * peer
    tables = experiments.speed_tables(timed._replace(scans=scans, times=times))
    first, *_, last = tables['times'].json()
    assert first['ratio'] == pytest.approx(0.5)
    assert first['p99_ratio'] == pytest.approx(0.1 / 0.2)
    assert first['median'] == pytest.approx(0.1) and last['median'] == pytest.approx(0.2)
    assert (last['method'], last['ratio']) == ('Patchwork++', 1.0)
    stages = tables['stages'].json()
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
    assert len(document['rows']) == 4 * 5 * experiments.N_PASSES
    assert run('experiment', 'speed', root, '--set', 'runtime.backend=numpy', '--no-peer') == 0
    assert 'learning, numpy' not in capsys.readouterr().out
