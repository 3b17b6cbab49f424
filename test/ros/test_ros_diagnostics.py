"""Judgements of the node on its input and itself, without ROS: time is passed in."""

from unittest.mock import MagicMock

import numpy as np
import pytest
import ros_helpers as ros
from conftest import hilly_scan
from hypothesis import given
from hypothesis import strategies as st

from gp_ground_seg import Config, GroundSegmenter
from gp_ground_seg.core.parameters.config import DiagnosticsConfig
from gp_ground_seg.ros import diagnostics
from gp_ground_seg.ros.diagnostics import (
    RATE_WINDOW,
    InputFacts,
    InputTask,
    Level,
    ProcessingTask,
    Rate,
    model_status,
    output_status,
)  # fmt: skip
from gp_ground_seg.ros.input import JUMP_TOLERANCE, TimeJumps

pytestmark = pytest.mark.usefixtures('compiled_code')

LIMITS = DiagnosticsConfig(stale_after=2.0, max_latency=0.1)
FACTS = InputFacts('/points', 'reliable, keep_last 1, volatile', n_publishers=1, ros_time=1000.5)
CLOUD = ros.to_message(ros.street(1), stamp=(1000, 0), frame='velo_link')

times = st.floats(0.0, 5.0)


def process(statistics, latencies):
    """Clouds that were published so long after their arrival [s]."""
    for latency in latencies:
        statistics.processed(latency, 'numba')
    return statistics


@given(st.lists(times))
def test_a_stamp_far_behind_the_newest_is_a_jump(stamps):
    jumps, expected, newest = [], [], None
    watch = TimeJumps(MagicMock(), jumps.append)
    for stamp in stamps:
        behind = 0.0 if newest is None else newest - stamp
        is_jump = behind > JUMP_TOLERANCE
        expected += [behind] * is_jump
        watch.note(stamp)
        newest = stamp if is_jump or newest is None else max(newest, stamp)
    assert jumps == expected


@given(st.lists(times, min_size=1))
def test_rate_is_that_of_the_window(steps):
    rate, now, events = Rate(), 0.0, []
    for step in steps:
        now += step
        rate.count(now)
        events = [t for t in [*events, now] if now - t <= RATE_WINDOW]
        span = events[-1] - events[0]
        expected = (len(events) - 1) / span if span else None
        assert rate.window(now) == (len(events), span, expected)
    assert rate.window(now + RATE_WINDOW + 0.1) == (0, 0.0, None)
    assert rate.n_total == len(steps)


def test_a_line_of_the_log_after_ten_seconds_then_one_in_a_minute_while_clouds_come():
    node = MagicMock()
    reporter = diagnostics.Diagnostics(node, lambda: (FACTS, {}), LIMITS)
    said = node.get_logger().info
    lines = []
    for second in range(160):
        if second < 25 or second == 150:
            reporter.arrived(CLOUD, second, 0)
            process(reporter.processing, [0.0125])
            reporter._newest = GroundSegmenter().segment(np.zeros((0, 3)))
        reporter.report(second + 0.5)
        lines += [second] * (said.call_count > len(lines))
    # The line at 70 is on clouds that came after the line at 10.
    assert lines == [10, 70, 150]
    assert said.call_args_list[0].args == (
        '11 clouds segmented so far, 1.00 Hz, median latency 12.50 ms, share of ground unknown',
    )


def test_input_waits_then_is_stale_and_recovers():
    statistics = InputTask(now=10.0)
    waiting = statistics.report(11.0, FACTS, LIMITS)
    assert waiting.level == Level.OK
    assert 'waiting' in waiting.message
    # Nothing is invented before the first cloud.
    assert waiting.values['Actual frequency (Hz)'] == 'unknown'
    assert waiting.values['Age of last stamp (s)'] == 'unknown'
    stale = statistics.report(12.1, FACTS, LIMITS)
    assert stale.level == Level.STALE
    assert 'no cloud on /points for 2.1 s' in stale.message
    nobody = statistics.report(12.1, FACTS._replace(n_publishers=0), LIMITS)
    assert 'nobody sends' in nobody.message
    statistics.arrived(12.2, CLOUD)
    assert statistics.report(12.3, FACTS, LIMITS).level == Level.OK
    assert statistics.report(14.3, FACTS, LIMITS).level == Level.STALE


def test_input_reports_what_it_saw():
    statistics = InputTask(now=0.0)
    for k in range(11):
        statistics.arrived(1.0 + 0.1 * k, CLOUD)
    # Names and their order are part of the interface: dashboards read them.
    assert [*statistics.report(2.25, FACTS, LIMITS).values.items()] == [
        ('Topic', '/points'),
        ('Publishers', '1'),
        ('QoS', FACTS.qos),
        ('Events since startup', '11'),
        ('Events in window', '11'),
        ('Duration of window (s)', '1.000'),
        ('Actual frequency (Hz)', '10.00'),
        ('Time since last cloud (s)', '0.250'),
        ('Age of last stamp (s)', '0.500'),  # of any age: no fault
        ('Clock', 'system time'),
        ('Time jumps since startup', '0'),
        ('Frame', 'velo_link'),
        ('Fields', 'intensity x y z'),
        ('Refused since startup', '0'),
        ('Last error', ''),
    ]
    statistics.time_jumped()
    jumped = {'Time jumps since startup': '1', 'Age of last stamp (s)': 'unknown'}
    assert jumped.items() <= statistics.report(2.3, FACTS, LIMITS).values.items()


@given(st.lists(st.booleans(), min_size=1, max_size=20))
def test_a_refusal_is_an_error(are_refused):
    statistics = InputTask(0.0)
    for refused in are_refused:
        statistics.arrived(0.1, CLOUD)
        if refused:
            statistics.refused('no field named z')
    report = statistics.report(0.2, FACTS, LIMITS)
    assert report.level == (Level.ERROR if any(are_refused) else Level.OK)
    assert ('no field named z' in report.message) == any(are_refused)
    assert report.message.startswith('every cloud refused: ') == all(are_refused)
    # Nothing new came: what was wrong is still wrong.
    assert statistics.report(1.2, FACTS, LIMITS).level == report.level
    statistics.arrived(1.3, CLOUD)
    assert statistics.report(1.4, FACTS, LIMITS).level == Level.OK
    assert report.values['Refused since startup'] == str(sum(are_refused))


def test_processing_has_the_median_latency_and_a_slow_one_is_a_warning():
    nothing = ProcessingTask().report(LIMITS)
    assert nothing.message == 'no cloud processed yet'
    assert nothing.values['Median latency (ms)'] == 'unknown'
    # The window holds the newest 100 of them: 1 ms to 100 ms.
    statistics = process(ProcessingTask(), [0.001 * k for k in range(101)])
    report = statistics.report(LIMITS)
    assert [*report.values.items()] == [
        ('Clouds since startup', '101'),
        ('Dropped since startup', '0'),
        ('Median latency (ms)', '50.50'),
        ('Backend', 'numba'),
    ]
    assert (report.level, report.message) == (Level.OK, 'median latency 50.5 ms')
    report = process(statistics, 60 * [0.2]).report(LIMITS)
    assert (report.level, report.message) == (Level.WARN, 'median latency 200 ms, above 100 ms')


def test_drops_are_a_warning_once_and_counted_for_ever():
    statistics, reports = process(ProcessingTask(), [0.01]), []
    for n_lost in (0, 3, 0):
        statistics.arrived(n_lost)
        reports.append(statistics.report(LIMITS))
    assert [report.level for report in reports] == [Level.OK, Level.WARN, Level.OK]
    assert reports[1].message == '3 of 4 clouds dropped since the last report'
    assert [report.values['Dropped since startup'] for report in reports] == ['0', '3', '3']
    # Also before a cloud is processed, as while the first takes long.
    late = ProcessingTask()
    late.arrived(2)
    assert late.report(LIMITS).level == Level.WARN


def status_of(points, **changes):
    """Segmentation, and what is reported of it."""
    segmentation = GroundSegmenter(Config().replace(**changes)).segment(points)
    return segmentation, model_status(segmentation, 3)


MODEL_KEYS = (
    'Segments with a model; Ground fraction; Unknown fraction; Points without a return; '
    'Fraction without model; Candidates; Inliers; Sensor height (m); Sensor roll (rad); '
    'Sensor pitch (rad); Taken from the scan; Estimated height (m); Estimated roll (rad); '
    'Estimated pitch (rad); Noise (m); Learning mode; Learned since startup; Optimiser status; '
    'Evaluations; At bound; Objective per candidate; theta '
)


def test_model_reports_the_newest_scan():
    assert model_status(None, 0).level == Level.OK
    xyz = hilly_scan()
    xyz[:300, 2], xyz[300:400] = np.nan, 0.0
    xyz[400:600, :2] = [500.0, 0.0]  # beyond the grid: no model
    segmentation, status = status_of(xyz, **{'grid.n_segments': 24})
    values, fit = status.values, segmentation.fit
    expected = {
        'Segments with a model': f'{fit.n_segments} of 24',
        'Unknown fraction': '0.1000',
        'Points without a return': '400',
        'Optimiser status': fit.status,
        'Learned since startup': '3',
        'Evaluations': str(fit.n_evaluations),
    }
    assert expected.items() <= values.items()
    assert '; '.join(values).startswith(MODEL_KEYS)
    assert float(values['Fraction without model']) >= 0.05
    assert 0.3 < float(values['Ground fraction']) < 0.9
    assert float(values['Noise (m)']) == pytest.approx(fit.theta['sigma_n'], rel=1e-3)
    objective = fit.objective * fit.n_inliers / fit.n_candidates
    assert float(values['Objective per candidate']) == pytest.approx(objective, abs=1e-4)
    assert (status.level, status.message) == (Level.OK, 'ground found in the newest cloud')


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


@pytest.mark.parametrize('points', [np.zeros((0, 3)), np.full((9, 3), np.nan)])
def test_a_scan_without_ground_is_a_warning(points):
    _, status = status_of(points)
    assert (status.level, status.message) == (Level.WARN, 'no ground found in the newest cloud')


def test_output_lists_every_topic():
    rates = {'/ground': Rate(), '/labeled': Rate()}
    assert output_status(0.0, rates, {'/ground': 0}).message == 'nobody subscribes'
    for k in range(5):
        rates['/ground'].count(0.2 * k)
    status = output_status(1.0, rates, {'/ground': 2, '/labeled': 0})
    assert (status.level, status.message) == (Level.OK, 'subscribed to: /ground')
    facts = 'subscribers', 'rate (Hz)', 'since startup'
    expected = {'/ground': ('2', '5.00', '5'), '/labeled': ('0', 'unknown', '0')}
    assert [*status.values.items()] == [
        (f'{topic} {fact}', value)
        for topic, values in expected.items()
        for fact, value in zip(facts, values, strict=True)
    ]
