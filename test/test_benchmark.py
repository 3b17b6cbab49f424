"""Time per frame: alternation, ratios, record; the command `bench` on real files."""

import itertools
import json
import sys

import numpy as np
import pytest
from bag_samples import scan, write_ros1_bag, write_ros2_bag
from cli_runner import error_line, run
from conftest import REPOSITORY, hilly_scan
from evaluation_samples import HeightRule, write_streets
from hypothesis import given
from hypothesis import strategies as st

from gp_ground_seg import Config
from gp_ground_seg.cli.bench import RUN_LENGTH, bench_text, load_frames, read_record, runs
from gp_ground_seg.core.errors import DataError, PointCloudError
from gp_ground_seg.lab.scoring.benchmark import BESIDE, bench_cases, bench_document, run_cases
from gp_ground_seg.lab.scoring.evaluate import PATCHWORKPP, KnownScan
from gp_ground_seg.lab.scoring.frames import make_scores
from gp_ground_seg.lab.scoring.report import describe_environment

QUICK = ('--set', 'grid.n_segments=24')
NUMPY = Config().replace(
    **{'runtime.backend': 'numpy', 'grid.n_segments': 8, 'learning.max_evaluations': 1}
)


class Ruler(HeightRule):
    """A baseline that takes seven ticks of the clock."""

    def __init__(self, clock):
        super().__init__('b', -1.5)
        self._clock = clock

    def run(self, points):
        super().run(points)
        for _ in range(7):
            next(self._clock)


def frames_of(*sequences, n_points=300):
    return [
        KnownScan(name, str(k), with_intensity(hilly_scan(n_points, seed=k)), {})
        for name, n in sequences
        for k in range(n)
    ]


def with_intensity(points):
    return np.column_stack([points, np.ones(len(points))]).astype(np.float32)


def test_every_case_runs_on_every_frame_beside_its_own_baseline():
    """In which order, and what is forgotten between sequences, test_evaluate.py says."""
    rulers, clock = [], itertools.count()

    def make():
        rulers.append(Ruler(clock))
        return rulers[-1]

    frames = frames_of(('a', 3), ('b', 2))
    cases = bench_cases(NUMPY, with_numpy=True)
    assert list(cases) == [
        'theta fixed, 1 thread', 'learning, 1 thread', 'theta fixed, numpy', 'learning, numpy',
    ]  # fmt: skip
    measured = run_cases(frames, cases, make, n_passes=2, clock=lambda: next(clock))
    pairs = [(name, f'{BESIDE}{name}') for name in cases]
    assert measured.methods == [*itertools.chain(*pairs)]
    rows = {name: [row for row in measured.rows['scans'] if row['method'] == name]
            for name in measured.methods}  # fmt: skip
    for ruler, (ours, baseline) in zip(rulers, pairs, strict=True):
        for name in (ours, baseline):
            assert [(row['sequence'], row['index']) for row in rows[name]] == [
                (frame.sequence, frame.index) for frame in frames * 2
            ]
        # Its reading of the clock, and seven ticks within.
        assert {row['seconds'] for row in rows[baseline]} == {8}
        assert {row['seconds'] for row in rows[ours]} == {1}
        # Once to warm up, then on each frame; forgotten at each change of sequence.
        n_runs = len(ruler.journal) - ruler.journal.count(f'R{baseline}')
        assert (n_runs, len(ruler.journal) - n_runs) == (1 + 10, 4)
    modes = [rows[ours][-1]['mode'] for ours, _ in pairs]
    assert modes == ['fixed', 'every_frame'] * 2


@given(st.integers(1, 500), st.integers(1, 100))
def test_runs_are_spread_and_hold_successive_frames(n_available, n_wanted):
    taken = runs('a', n_available, n_wanted)
    numbers = [k for _, k in taken]
    assert min(n_available, n_wanted) - RUN_LENGTH < len(taken) <= min(n_available, n_wanted)
    assert numbers == sorted(set(numbers)) and numbers[-1] < n_available
    for (name, k), (after, next_k) in itertools.pairwise(taken):
        assert name != after or next_k == k + 1
    length = min(RUN_LENGTH, n_wanted)
    steps = np.diff(numbers[::length])
    assert n_available <= n_wanted or len(steps) < 2 or np.ptp(steps) <= length


def recorded(ours, peers):
    frames = frames_of(('a', len(ours)), n_points=50)
    rows = run_cases(frames, {'only': NUMPY}).rows
    found = {'scans': [], 'times': []}
    for name, seconds in (('only', ours), (f'{BESIDE}only', peers)):
        for row, a in zip(rows['scans'], seconds, strict=True):
            found['scans'].append({**row, 'method': name, 'seconds': a})
            stages = {'grid': 0.25 * a, 'label': 0.5 * a}
            key = {key: row[key] for key in ('sequence', 'index')}
            found['times'].append({'method': name, **key, **stages})
    scores = make_scores([found])
    return bench_document(scores, NUMPY, describe_environment(), PATCHWORKPP, 'frames')


def test_ratios_pair_each_frame_with_its_baseline():
    # The machine slows down tenfold half-way; the ratio stays.
    document = recorded([0.01, 0.01, 0.1, 0.1, 0.1], [0.02, 0.02, 0.2, 0.2, 0.2])
    (case,) = document['cases']
    assert case['ratio']['median'] == pytest.approx(0.5)
    assert case['ratio']['p99'] == pytest.approx(0.1 / 0.2)
    assert case['ms']['median'] == pytest.approx(100.0)
    assert case['stages_ms'] == {'grid': 25.0, 'label': 50.0, 'rest': 25.0}
    assert document['baseline_ms']['median'] == pytest.approx(200.0)
    assert document['config_changes']['grid.n_segments'] == 8
    assert json.loads(json.dumps(document, allow_nan=False)) == document


def test_docs_show_the_record():
    docs = REPOSITORY / 'docs'
    text = (docs / 'performance.md').read_text(encoding='utf-8')
    assert f'```text\n{bench_text(read_record(docs / "performance.json"))}\n```' in text


@pytest.fixture(scope='module')
def scans(tmp_path_factory):
    folder = tmp_path_factory.mktemp('scans')
    for k in range(5):
        scan(k).tofile(folder / f'{k:06d}.bin')
    return folder


@pytest.fixture(scope='module')
def record(scans, tmp_path_factory):
    path = tmp_path_factory.mktemp('record') / 'bench.json'
    assert run('bench', scans, '--numpy', '--json', path) == 0
    return path


def test_record_holds_machine_cases_stages_and_series(record, scans):
    document = json.loads(record.read_text())
    assert document['data'] == scans.name
    assert document['n_frames'] == 5
    environment = document['environment']
    assert environment['cpu']
    assert {'numpy', 'numba', 'scipy', 'pypatchworkpp'} <= set(environment['versions'])
    assert [(case['mode'], case['backend']) for case in document['cases']] == [
        (mode, backend) for backend in ('numba', 'numpy') for mode in ('fixed', 'every_frame')
    ]
    for case in document['cases']:
        assert len(case['frames']) == 5
        assert all(frame['ms'] > 0 and frame['baseline_ms'] > 0 for frame in case['frames'])
        assert {'grid', 'learning', 'label', 'rest'} <= set(case['stages_ms'])
        assert all(case['stages_ms'][stage] > 0 for stage in ('grid', 'label'))
        assert case['ratio']['median'] > 0


def test_a_record_shows_what_measuring_showed(record, scans, capsys, tmp_path):
    assert run('bench', scans, *QUICK, '--json', tmp_path / 'bench.json') == 0
    measured = capsys.readouterr().out
    assert 'Patchwork++' in measured
    assert run('bench', '--from', tmp_path / 'bench.json') == 0
    assert capsys.readouterr().out == measured
    assert run('bench', '--from', record) == 0
    shown = capsys.readouterr().out
    assert max(len(line) for line in shown.splitlines()) <= 100


def write_sequences(root):
    for name in ('00', '01'):
        folder = root / 'sequences' / name / 'velodyne'
        folder.mkdir(parents=True)
        for k in range(2):
            scan(k).tofile(folder / f'{k:06d}.bin')


@pytest.mark.parametrize(
    ('name', 'write', 'expected'),
    [
        ('drive.mcap', lambda path: write_ros2_bag(path, n_clouds=3), [0, 1, 2]),
        ('drive.bag', lambda path: write_ros1_bag(path, n_clouds=3), [0, 1, 2]),
        ('scan.bin', lambda path: scan(0).tofile(path), [0]),
        ('root', write_sequences, [0, 1, 0, 1]),
    ],
)
def test_frames_come_from_whatever_holds_scans(name, write, expected, tmp_path):
    write(tmp_path / name)
    frames = load_frames(tmp_path / name, 60)
    for frame, k in zip(frames, expected, strict=True):
        assert frame.points.dtype == np.float32
        np.testing.assert_array_equal(frame.points[:, :3], scan(k)[:, :3])
    assert len({frame.sequence for frame in frames}) == (2 if name == 'root' else 1)


@pytest.mark.parametrize('n_wanted', [1, 2, 7, 10])
def test_frames_wanted_are_shared_out_over_sequences(n_wanted, tmp_path):
    write_streets(tmp_path, s00=3, s01=3, s02=3, s03=3)
    assert len(load_frames(tmp_path, n_wanted)) == n_wanted


def test_more_frames_than_wanted_are_thinned_in_runs(tmp_path):
    for k in range(45):
        scan(k, n_ground=20, n_wall=5).tofile(tmp_path / f'{k:06d}.bin')
    frames = load_frames(tmp_path, 20)
    assert [int(frame.index) for frame in frames] == [*range(10, 20), *range(30, 40)]
    names = [f'{tmp_path.name}:{start}' for start in (10, 30)]
    assert [frame.sequence for frame in frames] == 10 * names[:1] + 10 * names[1:]


@pytest.mark.parametrize(
    ('words', 'says'),
    [
        ((), 'either DATA'),
        (('DATA', '--from', 'x.json'), 'either DATA'),
        (('nowhere',), 'no such file'),
        (('DATA', '--topic', '/points'), 'is for bags'),
        (('DATA', '--set', 'grid.n_segments=0'), 'grid.n_segments'),
        (('--from', 'nowhere.json'), 'nowhere.json'),
        (('--from', 'OTHER'), 'not a record'),
        (('DATA', '--json', 'OTHER'), 'exists already'),
        (('EMPTY',), 'no point'),
    ],
)
def test_what_is_wrong_is_said(scans, words, says, tmp_path, capsys):
    other, empty = tmp_path / 'other.json', tmp_path / 'empty.bin'
    other.write_text('{"cases": []}')
    empty.touch()
    named = {'DATA': scans, 'OTHER': other, 'EMPTY': empty}
    assert run('bench', *(named.get(word, word) for word in words)) == 2
    assert says in error_line(capsys)
    assert other.read_text() == '{"cases": []}'


def test_a_broken_cloud_of_a_bag_is_named(tmp_path, monkeypatch):
    def refuse(*_):
        raise PointCloudError('no field x')

    monkeypatch.setattr('gp_ground_seg.data.inputs.decode_cloud', refuse)
    write_ros2_bag(tmp_path / 'drive.mcap', n_clouds=2)
    with pytest.raises(DataError, match=r'drive\.mcap: message 0 of topic .*: no field x'):
        load_frames(tmp_path / 'drive.mcap', 60)


def test_without_the_baseline_there_are_no_ratios(scans, monkeypatch, tmp_path, capsys):
    monkeypatch.setitem(sys.modules, 'pypatchworkpp', None)
    assert run('bench', scans, *QUICK, '--json', tmp_path / 'a.json') == 0
    assert 'pip install pypatchworkpp' in capsys.readouterr().err
    document = json.loads((tmp_path / 'a.json').read_text())
    assert document['baseline'] is document['baseline_ms'] is None
    assert 'ratio' not in document['cases'][0]
