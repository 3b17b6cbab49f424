"""Time per frame: alternation, sizes, ratios, report."""

import json
import math

import numpy as np
import pytest
from conftest import REPOSITORY, hilly_scan
from hypothesis import given
from hypothesis import strategies as st

from gp_ground_seg import Config, Label
from gp_ground_seg.cli.bench import read_record
from gp_ground_seg.cli.bench_input import RUN_LENGTH, runs
from gp_ground_seg.cli.bench_text import DOCS_BEGIN, DOCS_END, replace_section
from gp_ground_seg.errors import DataError
from gp_ground_seg.evaluation.bench import (
    BenchCase,
    BenchFrame,
    CaseTimes,
    FrameTime,
    bench_cases,
    run_cases,
)
from gp_ground_seg.evaluation.bench_report import bench_report
from gp_ground_seg.evaluation.bench_scaling import (
    SIZES,
    merged_groups,
    spread,
    time_merged,
    time_scaling,
)
from gp_ground_seg.evaluation.environment import describe_environment

NUMPY = Config().replace(
    **{'runtime.backend': 'numpy', 'grid.n_segments': 8, 'learning.max_evaluations': 1}
)


class Ruler:
    """A yardstick that takes a known number of ticks and writes down when it ran."""

    name = 'ruler'

    def __init__(self, clock, log):
        self._clock, self._log = clock, log
        self.n_sequences = 0

    def start_sequence(self):
        self.n_sequences += 1

    def run(self, points):
        self._log.append('ruler')
        self._clock.now += 7.0

    def label(self):
        return np.full(1, Label.GROUND, dtype=np.uint8)

    def stages(self):
        return {}


class Clock:
    """Every reading is one tick later."""

    now = 0.0

    def __call__(self):
        self.now += 1.0
        return self.now


def frames_of(*sequences, n_points=300):
    return [
        BenchFrame(name, str(k), with_intensity(hilly_scan(n_points, seed=k)))
        for name, n in sequences
        for k in range(n)
    ]


def with_intensity(points):
    return np.column_stack([points, np.ones(len(points))]).astype(np.float32)


def test_every_case_runs_on_every_frame_beside_its_own_yardstick():
    clock, log, rulers = Clock(), [], []

    def make():
        rulers.append(Ruler(clock, log))
        return rulers[-1]

    frames = frames_of(('a', 3), ('b', 2))
    cases = bench_cases(NUMPY, [1, 2], with_numpy=True)
    assert [case.name for case in cases] == [
        'theta fixed, 1 thread', 'theta fixed, 2 threads',
        'learning, 1 thread', 'learning, 2 threads', 'learning, numpy',
    ]  # fmt: skip
    measured = run_cases(frames, cases, make, n_passes=2, clock=clock)
    assert len(rulers) == len(cases)
    for ruler, found in zip(rulers, measured, strict=True):
        assert [one.frame for one in found.times] == frames * 2
        # Its reading of the clock, and seven ticks within.
        assert {one.yardstick for one in found.times} == {8.0}
        assert all(one.seconds >= 1.0 for one in found.times)
        # Once to warm up, then at each change of sequence.
        assert ruler.n_sequences == 1 + 4
    assert len(log) == len(cases) * (1 + 2 * len(frames))
    assert [m.fit.mode for m in measured] == ['fixed'] * 2 + ['every_frame'] * 3


def test_half_of_the_time_the_yardstick_goes_first():
    order = []

    class Noting(Ruler):
        def run(self, points):
            order.append('ruler')

    class NotingClock(Clock):
        def __call__(self):
            order.append('clock')
            return super().__call__()

    frames = frames_of(('a', 4))
    case = BenchCase('only', NUMPY.replace(**{'learning.mode': 'fixed'}))
    run_cases(frames, [case], lambda: Noting(None, None), clock=NotingClock())
    warm_up, *letters = (word[0] for word in order)
    assert warm_up == 'r'
    yardstick, ours = 'crc', 'cc'
    assert ''.join(letters) == 2 * (yardstick + ours + ours + yardstick)


def test_a_new_sequence_forgets_the_one_before():
    frames = frames_of(('a', 2), ('b', 2))
    config = NUMPY.replace(**{'learning.mode': 'first_frame'})
    (measured,) = run_cases(frames, [BenchCase('only', config)], clock=Clock())
    # The last frame keeps what the third one taught.
    assert measured.fit.status == 'kept'
    assert all(math.isnan(one.yardstick) for one in measured.times)


@given(st.integers(1, 500), st.integers(1, 100))
def test_spread_is_even(n_available, n_wanted):
    found = spread(n_available, n_wanted)
    assert len(found) == min(n_available, n_wanted)
    steps = np.diff([-1, *found, n_available])
    assert (steps > 0).all()
    if len(found) > 1:
        assert np.ptp(steps[1:-1]) <= 1


@given(st.integers(1, 500), st.integers(1, 100))
def test_runs_hold_successive_frames(n_available, n_wanted):
    found = runs(n_available, n_wanted)
    taken = [k for run in found for k in run]
    assert len(taken) <= min(n_available, n_wanted)
    assert len(taken) > min(n_available, n_wanted) - RUN_LENGTH
    assert taken == sorted(set(taken))
    assert taken[-1] < n_available


def test_merged_clouds_are_of_one_sequence_each():
    frames = frames_of(('a', 5), ('b', 3), ('c', 8))
    groups = merged_groups(frames)
    assert [[frame.sequence + frame.index for frame in group] for group in groups] == [
        ['a0', 'a1', 'a2', 'a3'], ['c0', 'c1', 'c2', 'c3'], ['c4', 'c5', 'c6', 'c7'],
    ]  # fmt: skip
    merged = time_merged(frames, NUMPY, clock=Clock())
    assert merged.n_points == (1200,) * 3
    assert time_merged(frames[5:8], NUMPY) is None


def test_series_grow_in_what_they_are_named_after():
    series = time_scaling(frames_of(('a', 4)), NUMPY, clock=Clock())
    assert list(series) == list(SIZES)
    for name, found in series.items():
        sizes = [point.size for point in found]
        assert sizes == sorted(sizes), name
        assert sizes[-1] > 2 * sizes[0], name
        # Every measurement takes one tick of this clock.
        assert all(set(point.ratio.values()) == {1.0} for point in found)
    assert [point.size for point in series['points']] == [38, 75, 150, 300, 600, 1200]
    assert [point.size for point in series['segments']] == [8, 16, 32]


def test_series_of_a_single_frame_stop_at_its_size():
    series = time_scaling(frames_of(('a', 1)), NUMPY, clock=Clock())
    assert [point.size for point in series['points']] == [38, 75, 150, 300]


def reported(ours, peers):
    frames = frames_of(('a', len(ours)), n_points=50)
    case = BenchCase('only', NUMPY)
    fit = run_cases(frames[:1], [case])[0].fit
    times = tuple(
        FrameTime(frame, a, {'grid': 0.25 * a, 'label': 0.5 * a}, b)
        for frame, a, b in zip(frames, ours, peers, strict=True)
    )
    return bench_report(
        [CaseTimes(case, times, fit)], None, {}, NUMPY, describe_environment(), 'ruler', 'frames'
    )


def test_ratios_pair_each_frame_with_its_yardstick():
    # The machine slows down tenfold half-way; the ratio stays.
    document = reported([0.01, 0.01, 0.1, 0.1, 0.1], [0.02, 0.02, 0.2, 0.2, 0.2])
    (case,) = document['cases']
    assert case['ratio']['median'] == pytest.approx(0.5)
    assert case['ratio']['p99'] == pytest.approx(0.1 / 0.2)
    assert case['ms']['median'] == pytest.approx(100.0)
    assert case['stages_ms'] == {'grid': 25.0, 'label': 50.0, 'rest': 25.0}
    assert document['yardstick_ms']['median'] == pytest.approx(200.0)
    assert document['config_changes']['grid.n_segments'] == 8
    assert json.loads(json.dumps(document, allow_nan=False)) == document


def test_section_is_replaced_and_only_it():
    document = reported([0.01], [0.02])
    text = f'before\n{DOCS_BEGIN}\nold\n{DOCS_END}\nafter\n'
    once = replace_section(text, document)
    assert once.startswith(f'before\n{DOCS_BEGIN}\n')
    assert once.endswith(f'{DOCS_END}\nafter\n')
    assert 'old' not in once
    assert replace_section(once, document) == once
    for broken in ('no marks', f'{DOCS_END}{DOCS_BEGIN}', text + text):
        with pytest.raises(DataError, match='once each'):
            replace_section(broken, document)


def test_docs_show_the_record():
    docs = REPOSITORY / 'docs'
    text = (docs / 'performance.md').read_text(encoding='utf-8')
    assert text == replace_section(text, read_record(docs / 'performance.json'))
