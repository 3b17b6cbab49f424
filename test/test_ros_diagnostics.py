"""Judgements of the node on its input and itself, without ROS: time is passed in."""

import dataclasses
from types import SimpleNamespace
from unittest.mock import MagicMock

import numpy as np
import pytest
from conftest import hilly_scan
from hypothesis import given
from hypothesis import strategies as st

from gp_ground_seg import Config, GroundSegmenter
from gp_ground_seg.core.parameters.config import DiagnosticsConfig

pytest.importorskip('rclpy', reason='ROS is not installed')

import ros_helpers  # noqa: F401  imports type support without its warnings
from rclpy.duration import Duration

from gp_ground_seg.ros import diagnostics
from gp_ground_seg.ros.diagnostics import (
    RATE_WINDOW,
    Hysteresis,
    InputFacts,
    InputTask,
    Level,
    ModelTask,
    ProcessingTask,
    Rate,
    Status,
)  # fmt: skip
from gp_ground_seg.ros.input import JUMP_TOLERANCE, TimeJumps

LIMITS = DiagnosticsConfig(stale_after=2.0, max_latency=0.1)
FACTS = InputFacts('/points', 'reliable, keep_last 5, volatile', n_publishers=1, ros_time=1000.5)
NO_FIT = GroundSegmenter().segment(np.zeros((0, 3))).fit

times = st.floats(0.0, 5.0)
shares = st.integers(0, 200)


def arrive(statistics, now, stamp=1000.0):
    statistics.arrived(now, stamp, 'velo_link', ['x', 'y', 'z', 'intensity'])


def process(statistics, latencies):
    """Clouds whose processing took so long [s]."""
    fit = dataclasses.replace(NO_FIT, backend='numba')
    for latency in latencies:
        stages = {'queue': 0.0, 'grid': 0.25 * latency, 'total': latency}
        statistics.processed(latency, stages, fit)
    return statistics


@given(st.lists(times))
def test_a_stamp_far_behind_the_newest_is_a_jump(stamps):
    jumps, expected, newest, node = [], [], None, MagicMock()
    watch = TimeJumps(node, jumps.append)
    for stamp in stamps:
        behind = 0.0 if newest is None else newest - stamp
        is_jump = behind > JUMP_TOLERANCE
        expected += [behind] * is_jump
        watch.note(stamp)
        newest = stamp if is_jump or newest is None else max(newest, stamp)
    assert jumps == expected
    # A jump of the clock is said once, whatever stamps follow it.
    clock_jumped = node.get_clock().create_jump_callback.call_args.kwargs['post_callback']
    clock_jumped(SimpleNamespace(delta=Duration(seconds=-3.0)))
    watch.note(-100.0)
    assert jumps == [*expected, 3.0]


@given(st.lists(st.tuples(times, st.integers(1, 4)), min_size=1))
def test_rate_is_that_of_the_window(steps):
    rate, now, events = Rate(), 0.0, []
    for step, n in steps:
        now += step
        rate.count(now, n)
        events = [(t, m) for t, m in [*events, (now, n)] if now - t <= RATE_WINDOW]
        span = events[-1][0] - events[0][0]
        expected = sum(m for _, m in events[1:]) / span if span else None
        assert rate.window(now) == (sum(m for _, m in events), span, expected)
    assert rate.window(now + RATE_WINDOW + 0.1) == (0, 0.0, None)
    assert rate.n_total == sum(n for _, n in steps)


@given(st.lists(st.tuples(times, st.sampled_from(Level)), min_size=1), st.floats(0.0, 8.0))
def test_a_level_is_the_worst_of_the_latest_time(steps, recover_after):
    """Against the definition, with everything ever found kept; STALE is held as a warning."""
    hysteresis, now, history = Hysteresis(), 0.0, []
    for k, (step, level) in enumerate(steps):
        now += step
        status = Status('task', level, f'{k}', {'k': f'{k}'})
        reported = hysteresis.hold(now, status, recover_after)
        held = [
            Level.WARN if before == Level.STALE else before
            for when, before in history
            if now - when <= recover_after
        ]
        assert reported.level == max([level, *held])
        assert reported.values == {'k': f'{k}'}
        # What is found now is always said, and why the level is worse than that.
        assert reported.message.startswith(f'{k}')
        assert (' s ago: ' in reported.message) == (reported.level > level)
        history.append((now, level))


def test_one_line_of_the_log_in_ten_seconds_while_clouds_come():
    node = MagicMock()
    reporter = diagnostics.Diagnostics(node, lambda: (FACTS, {}), LIMITS)
    said = node.get_logger().info
    lines = []
    for second in range(60):
        if second < 25 or second == 50:
            arrive(reporter.input, second)
            process(reporter.processing, [0.0125])
            reporter.model.segmented(GroundSegmenter().segment(np.zeros((0, 3))))
        reporter.report(second + 0.5)
        lines += [second] * (said.call_count > len(lines))
    # The line at 30 is on clouds that came after the line at 20.
    assert lines == [0, 10, 20, 30, 50]
    assert said.call_args_list[1].args == (
        '11 clouds segmented so far, 1.00 Hz, median latency 12.50 ms, share of ground unknown',
    )


def test_every_task_is_reported_and_holds_its_own_level():
    nothing = SimpleNamespace(create_publisher=lambda *_: None, create_timer=lambda *_, **__: None)
    reporter = diagnostics.Diagnostics(nothing, lambda: (FACTS, {'/ground': 1}), LIMITS)
    reporter.input = InputTask(0.0)
    arrive(reporter.input, 0.5)
    reporter.input.refused('no field named z')
    first = reporter.report(1.0)
    assert [s.task for s in first] == ['input', 'processing', 'model', 'output']
    assert [s.level for s in first] == [Level.ERROR, Level.OK, Level.OK, Level.OK]
    arrive(reporter.input, 1.5)
    second = reporter.report(2.0)[0]
    assert second.level == Level.ERROR
    assert second.message == 'receiving; 1.0 s ago: every cloud refused: no field named z'
    arrive(reporter.input, 4.5)
    assert reporter.report(5.0)[0].level == Level.OK


def test_input_waits_then_is_stale_and_recovers():
    statistics, unknown = InputTask(now=10.0), 'unknown'
    waiting = statistics.report(11.0, FACTS, LIMITS)
    assert waiting.level == Level.OK
    assert 'waiting' in waiting.message
    # Nothing is invented before the first cloud.
    assert waiting.values['Actual frequency (Hz)'] == unknown
    assert waiting.values['Age of last stamp (s)'] == unknown
    stale = statistics.report(12.1, FACTS, LIMITS)
    assert stale.level == Level.STALE
    assert 'no cloud on /points for 2.1 s' in stale.message
    nobody = statistics.report(12.1, FACTS._replace(n_publishers=0), LIMITS)
    assert 'nobody sends' in nobody.message
    arrive(statistics, 12.2)
    assert statistics.report(12.3, FACTS, LIMITS).level == Level.OK
    assert statistics.report(14.3, FACTS, LIMITS).level == Level.STALE


def test_input_reports_what_it_saw():
    statistics = InputTask(now=0.0)
    for k in range(11):
        arrive(statistics, 1.0 + 0.1 * k)
    expected = {
        'Events since startup': '11',
        'Events in window': '11',
        'Actual frequency (Hz)': '10.00',
        'Duration of window (s)': '1.000',
        'Time since last cloud (s)': '0.250',
        'Age of last stamp (s)': '0.500',  # of any age: no fault
        'Clock': 'system time',
        'Frame': 'velo_link',
        'Fields': 'x y z intensity',
        'QoS': FACTS.qos,
        'Refused since startup': '0',
    }
    assert expected.items() <= statistics.report(2.25, FACTS, LIMITS).values.items()
    statistics.time_jumped()
    jumped = {'Time jumps since startup': '1', 'Age of last stamp (s)': 'unknown'}
    assert jumped.items() <= statistics.report(2.3, FACTS, LIMITS).values.items()


@given(st.floats(-1e10, 1e10), st.floats(0.0, 1e10), st.booleans())
def test_a_stamp_of_any_age_is_no_fault(stamp, ros_time, is_simulated):
    statistics = InputTask(0.0)
    arrive(statistics, 0.1, stamp)
    facts = InputFacts('/points', '', 1, ros_time, is_simulated)
    assert statistics.report(0.2, facts, LIMITS).level == Level.OK


@given(st.lists(st.booleans(), min_size=1, max_size=20), st.floats(0.0, 1.0))
def test_refusals_are_an_error_above_their_limit(are_refused, max_ratio):
    statistics = InputTask(0.0)
    limits = dataclasses.replace(LIMITS, max_refused_ratio=max_ratio)
    for refused in are_refused:
        arrive(statistics, 0.1)
        if refused:
            statistics.refused('no field named z')
    report = statistics.report(0.2, FACTS, limits)
    ratio = sum(are_refused) / len(are_refused)
    if ratio == 1.0 or sum(are_refused) > max_ratio * len(are_refused):
        assert report.level == Level.ERROR
    else:
        assert report.level == (Level.WARN if ratio else Level.OK)
    assert ('no field named z' in report.message) == (ratio > 0.0)
    # Nothing new came: what was wrong is still wrong.
    assert statistics.report(1.2, FACTS, limits).level == report.level
    arrive(statistics, 1.3)
    assert statistics.report(1.4, FACTS, limits).level == Level.OK
    assert report.values['Refused since startup'] == str(sum(are_refused))


def test_processing_percentiles_in_milliseconds_and_a_slow_median():
    assert ProcessingTask().report(0.0, LIMITS).message == 'no cloud processed yet'
    statistics = process(ProcessingTask(), [0.001 * k for k in range(101)])
    values = statistics.report(0.0, LIMITS).values
    # The window holds the newest 100 of them: 1 ms to 100 ms.
    expected = {
        'Clouds since startup': '101',
        'Clouds in window': str(diagnostics.CLOUD_WINDOW),
        'Latency p50 (ms)': '50.50',
        'Latency p95 (ms)': '95.05',
        'Latency p99 (ms)': '99.01',
        'Backend': 'numba',
    }
    assert expected.items() <= values.items()
    assert float(values['Stage grid p50 (ms)']) == pytest.approx(12.62, abs=0.011)
    assert statistics.report(0.0, LIMITS).level == Level.OK
    report = process(statistics, 60 * [0.2]).report(0.0, LIMITS)
    assert report.level == Level.WARN
    assert 'median latency 200 ms, above 100 ms' in report.message


def test_drops_are_a_warning_once_and_counted_for_ever():
    statistics = process(ProcessingTask(), [0.01])
    tolerant = dataclasses.replace(LIMITS, max_drop_ratio=0.75)
    reports = []
    for k, (n_lost, limits) in enumerate([(0, LIMITS), (3, LIMITS), (3, tolerant), (4, tolerant)]):
        statistics.arrived(0.1 * k, n_lost)
        reports.append(statistics.report(0.1 * k, limits))
    assert [report.level for report in reports] == [Level.OK, Level.WARN, Level.OK, Level.WARN]
    assert '3 of 4 clouds dropped' in reports[1].message
    after = statistics.report(0.5, LIMITS)
    assert (after.level, after.values['Dropped since startup']) == (Level.OK, '10')


@given(st.floats(0.005, 1.0), st.floats(0.005, 0.2), st.integers(0, 5))
def test_load_is_work_over_the_time_between_clouds_sent(period, duration, n_lost):
    """What is dropped belongs to the rate: else a full queue would look like a load of one."""
    statistics = ProcessingTask()
    limits = dataclasses.replace(LIMITS, max_latency=10.0, max_drop_ratio=1.0, max_load=0.9)
    now = 0.0
    while now <= 3.0:
        # A burst is no rate.
        assert now >= diagnostics.MIN_RATE_SPAN or statistics.load(now) is None
        statistics.arrived(now, n_lost)
        process(statistics, [duration])
        now += period
    load = duration * (1 + n_lost) / period
    assert statistics.load(now) == pytest.approx(load)
    report = statistics.report(now, limits)
    if not 0.899 < load < 0.901:
        assert report.level == (Level.WARN if load > 0.9 else Level.OK)
    assert float(report.values['Load (%)']) == pytest.approx(100.0 * load, abs=0.051)


def status_of(points, limits=LIMITS, **changes):
    """Segmentation, and what is reported of it."""
    statistics = ModelTask()
    assert statistics.report(limits).level == Level.OK
    segmentation = GroundSegmenter(Config().replace(**changes)).segment(points)
    statistics.segmented(segmentation)
    return segmentation, statistics.report(limits)


def test_model_reports_the_newest_scan():
    xyz = hilly_scan()
    xyz[:400, 2] = np.nan
    xyz[400:600, :2] = [500.0, 0.0]  # beyond the grid: no model
    segmentation, status = status_of(xyz, **{'grid.n_segments': 24})
    values, fit = status.values, segmentation.fit
    assert values['Segments with a model'] == f'{fit.n_segments} of 24'
    assert float(values['Unknown fraction']) == 0.1
    assert float(values['Fraction without model']) >= 0.05
    assert 0.3 < float(values['Ground fraction']) < 0.9
    assert float(values['Noise (m)']) == pytest.approx(fit.theta['sigma_n'], rel=1e-3)
    assert values['Optimiser status'] == fit.status
    assert values['Learned since startup'] == '1'
    assert values['Evaluations'] == str(fit.n_evaluations)
    objective = fit.objective * fit.n_inliers / fit.n_candidates
    assert float(values['Objective per candidate']) == pytest.approx(objective, abs=1e-4)
    assert 0.2 < float(values['frame_quality']) < 1.0
    assert status.level == Level.OK
    strict = dataclasses.replace(LIMITS, min_quality=1.0)
    assert status_of(xyz, strict)[1].level == Level.WARN


@pytest.mark.parametrize('height', ['auto', 1.73, 3.5])
def test_model_reports_where_the_sensor_is(height):
    """Estimated or given; given wrongly is a warning that says so, not a repair."""
    segmentation, status = status_of(hilly_scan(20_000), **{'sensor.height': height})
    values = status.values
    assert values['Sensor height (m)'] == f'{segmentation.pose.height:.4f}'
    assert ('height' in values['Taken from the scan']) == (height == 'auto')
    assert float(values['Estimated height (m)']) == pytest.approx(1.73, abs=0.2)
    assert abs(float(values['Estimated pitch (rad)'])) < 0.1
    assert status.level == (Level.WARN if height == 3.5 else Level.OK)
    assert ('sensor.height' in status.message) == (height == 3.5)


def test_model_warns_of_a_height_that_is_assumed_or_of_an_earlier_cloud():
    points, segmenter, statistics = hilly_scan(20_000), GroundSegmenter(), ModelTask()
    part = points[np.abs(np.arctan2(points[:, 1], points[:, 0])) < 0.1]
    whole, alone = segmenter.segment(points), segmenter.segment(part)
    statistics.segmented(alone)
    status = statistics.report(LIMITS)
    assert (status.level, status.message) == (Level.WARN, alone.pose.warnings[0])
    statistics.segmented(segmenter.segment(part, fallback=whole.pose))
    status = statistics.report(LIMITS)
    assert status.level == Level.WARN
    assert f'{whole.pose.height:.2f} m of an earlier one is kept' in status.message
    statistics.segmented(whole)
    assert statistics.report(LIMITS).level == Level.OK


@pytest.mark.parametrize('points', [np.zeros((0, 3)), np.full((9, 3), np.nan)])
def test_a_scan_without_ground_is_a_warning(points):
    _, status = status_of(points)
    assert (status.level, status.message) == (Level.WARN, 'no ground found in the newest cloud')
    assert status.values['frame_quality'] == '0.000'


@given(shares, shares, shares, shares, st.floats(0.0, 1.0), st.sampled_from(['failed', 'kept']))
def test_quality_is_a_share(n_segments, n_occupied, n_inliers, n_more, certainty, status):
    counts = {'n_inliers': n_inliers, 'n_candidates': n_inliers + n_more}
    fit = dataclasses.replace(NO_FIT, n_segments=n_segments, status=status, **counts)
    quality = diagnostics.frame_quality(fit, n_occupied, certainty)
    assert 0.0 <= quality <= diagnostics.frame_quality(fit, n_occupied, np.nan) <= 1.0
    assert diagnostics.frame_quality(fit, n_occupied, 0.5 * certainty) <= quality
    if status == 'failed' or not n_segments or not n_inliers:
        assert quality == 0.0


def test_output_lists_every_topic():
    statistics = diagnostics.OutputTask()
    assert statistics.report(0.0, {'/ground': 0}).message == 'nobody subscribes'
    for k in range(5):
        statistics.published(0.2 * k, ['/ground'])
    status = statistics.report(1.0, {'/ground': 2, '/labeled': 0})
    assert (status.level, status.message) == (Level.OK, 'subscribed to: /ground')
    assert status.values == {
        '/ground subscribers': '2',
        '/ground rate (Hz)': '5.00',
        '/ground since startup': '5',
        '/labeled subscribers': '0',
        '/labeled rate (Hz)': 'unknown',
        '/labeled since startup': '0',
    }
