"""Time per frame: alternation, sizes, ratios, record."""

import itertools
import json
import math

import numpy as np
import pytest
from conftest import REPOSITORY, hilly_scan
from evaluation_samples import HeightRule
from hypothesis import given
from hypothesis import strategies as st

from gp_ground_seg import Config
from gp_ground_seg.cli.bench import RUN_LENGTH, bench_text, read_record, runs
from gp_ground_seg.evaluation.benchmark import (
    BenchFrame,
    FrameTime,
    bench_cases,
    bench_document,
    merged_groups,
    run_cases,
    spread,
    time_growth,
)
from gp_ground_seg.evaluation.environment import describe_environment
from gp_ground_seg.evaluation.evaluate import PATCHWORKPP

NUMPY = Config().replace(
    **{'runtime.backend': 'numpy', 'grid.n_segments': 8, 'learning.max_evaluations': 1}
)


class Clock:
    """Every reading is one tick later; the journal gets a ``t`` for each."""

    def __init__(self, journal=None):
        self.now = 0.0
        self.journal = [] if journal is None else journal

    def __call__(self):
        self.now += 1.0
        self.journal.append('t')
        return self.now


class Ruler(HeightRule):
    """A baseline that takes seven ticks."""

    def __init__(self, clock):
        super().__init__('b', -1.5, clock.journal)
        self._clock = clock

    def run(self, points):
        super().run(points)
        self._clock.now += 7.0


def frames_of(*sequences, n_points=300):
    return [
        BenchFrame(name, str(k), with_intensity(hilly_scan(n_points, seed=k)))
        for name, n in sequences
        for k in range(n)
    ]


def with_intensity(points):
    return np.column_stack([points, np.ones(len(points))]).astype(np.float32)


def test_every_case_runs_on_every_frame_beside_its_own_baseline():
    rulers = []

    def make(_):
        rulers.append(Ruler(clock))
        rulers[-1].journal = []
        return rulers[-1]

    clock = Clock()
    frames = frames_of(('a', 3), ('b', 2))
    cases = bench_cases(NUMPY, [1, 2], with_numpy=True)
    assert list(cases) == [
        'theta fixed, 1 thread', 'theta fixed, 2 threads',
        'learning, 1 thread', 'learning, 2 threads', 'learning, numpy',
    ]  # fmt: skip
    measured = run_cases(frames, cases, make, n_passes=2, clock=clock)
    assert list(measured) == list(cases)
    for ruler, times in zip(rulers, measured.values(), strict=True):
        assert [one.frame for one in times] == frames * 2
        # Its reading of the clock, and seven ticks within.
        assert {one.baseline for one in times} == {8.0}
        assert all(one.seconds >= 1.0 and one.ratio == one.seconds / 8.0 for one in times)
        # Once to warm up, then on each frame; forgotten at each change of sequence.
        assert (ruler.journal.count('b'), ruler.journal.count('Rb')) == (1 + 10, 4)
    modes = [times[-1].fit.mode for times in measured.values()]
    assert modes == ['fixed'] * 2 + ['every_frame'] * 3


def test_half_of_the_time_the_baseline_goes_first():
    journal = []
    clock = Clock(journal)
    cases = {'only': NUMPY.replace(**{'learning.mode': 'fixed'})}
    run_cases(frames_of(('a', 4)), cases, lambda _: Ruler(clock), clock=clock)
    warm_up, letters = journal[:7], ''.join(journal[7:]).replace('Rb', '')
    assert warm_up == ['t'] * 5 + ['b', 't']
    baseline, ours = 'tbt', 'tt'
    assert letters == 2 * (baseline + ours + ours + baseline)


def test_a_new_sequence_forgets_the_one_before():
    config = NUMPY.replace(**{'learning.mode': 'first_frame'})
    frames = frames_of(('a', 2), ('b', 2))
    measured = run_cases(frames, {'only': config}, clock=Clock())['only']
    status = [one.fit.status == 'kept' for one in measured]
    assert status == [False, True, False, True]
    assert all(math.isnan(one.baseline) for one in measured)


@given(st.integers(1, 500), st.integers(1, 100))
def test_spread_is_even_and_runs_hold_successive_frames(n_available, n_wanted):
    found = spread(n_available, n_wanted)
    assert len(found) == min(n_available, n_wanted)
    steps = np.diff([-1, *found, n_available])
    assert (steps > 0).all()
    if len(found) > 1:
        assert np.ptp(steps[1:-1]) <= 1
    taken = runs('a', n_available, n_wanted)
    numbers = [k for _, k in taken]
    assert min(n_available, n_wanted) - RUN_LENGTH < len(taken) <= min(n_available, n_wanted)
    assert numbers == sorted(set(numbers)) and numbers[-1] < n_available
    for (name, k), (after, next_k) in itertools.pairwise(taken):
        assert name != after or next_k == k + 1


def test_merged_clouds_are_of_one_sequence_each():
    groups = merged_groups(frames_of(('a', 5), ('b', 3), ('c', 8)))
    assert [[frame.sequence + frame.index for frame in group] for group in groups] == [
        ['a0', 'a1', 'a2', 'a3'], ['c0', 'c1', 'c2', 'c3'], ['c4', 'c5', 'c6', 'c7'],
    ]  # fmt: skip


@pytest.mark.parametrize(('n_frames', 'n_most'), [(4, 1200), (1, 300)])
def test_series_grow_in_what_they_are_named_after(n_frames, n_most):
    rows = time_growth(frames_of(('a', n_frames)), NUMPY, clock=Clock())
    sizes = {}
    for row in rows:
        sizes.setdefault(row['series'], []).append(row['size'])
        # Every measurement takes one tick of this clock.
        assert row['fixed_ratio'] == row['every_frame_ratio'] == 1.0
        assert row['fixed_ms'] == row['every_frame_ms'] == 1000.0
    assert list(sizes) == ['points', 'grid.n_segments', 'grid.n_bins', 'pseudo-inputs']
    assert sizes['points'] == [n for n in (38, 75, 150, 300, 600, 1200) if n <= n_most]
    assert sizes['grid.n_segments'] == [8, 16, 32]  # a grid of 2 or 4 segments is not accepted
    for found in sizes.values():
        assert found == sorted(found)
        assert found[-1] > 2 * found[0]


def recorded(ours, peers):
    frames = frames_of(('a', len(ours)), n_points=50)
    fit = run_cases(frames[:1], {'only': NUMPY})['only'][0].fit
    times = [
        FrameTime(frame, a, {'grid': 0.25 * a, 'label': 0.5 * a}, b, fit)
        for frame, a, b in zip(frames, ours, peers, strict=True)
    ]
    return bench_document(
        {'only': times}, [], NUMPY, describe_environment(), PATCHWORKPP, 'frames'
    )


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
