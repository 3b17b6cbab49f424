"""Judgements of the node on its input and itself, without ROS."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gp_ground_seg.config import DiagnosticsConfig
from gp_ground_seg.ros.statistics import (
    WINDOW,
    InputFacts,
    InputStatistics,
    Level,
    ProcessingStatistics,
    SequenceGaps,
)

LIMITS = DiagnosticsConfig(stale_after=2.0, max_latency=0.1)
FACTS = InputFacts('/points', 'reliable, keep_last 5, volatile', n_publishers=1, ros_time=1000.5)


def arrive(statistics, now, stamp=1000.0):
    statistics.arrived(now, stamp, 'velo_link', ['x', 'y', 'z', 'intensity'])


@given(st.lists(st.booleans(), min_size=1))
def test_gaps_count_what_is_missing_between_arrivals(is_received):
    gaps = SequenceGaps()
    counted = sum(gaps.note(k) for k, received in enumerate(is_received, 1) if received)
    inner = ''.join('x' if received else '.' for received in is_received).strip('.')
    assert counted == inner.count('.')


def test_gaps_start_again_with_another_publisher():
    gaps = SequenceGaps()
    assert [gaps.note(n) for n in (7, 8, 1, 2, 5)] == [0, 0, 0, 0, 2]
    gaps.reset()
    assert gaps.note(100) == 0
    assert gaps.note(None) == 0
    assert gaps.note(200) == 0


def test_input_waits_then_is_stale_and_recovers():
    statistics = InputStatistics(now=10.0)
    waiting = statistics.report(11.0, FACTS, LIMITS)
    assert waiting.level == Level.OK
    assert 'waiting' in waiting.message
    stale = statistics.report(12.1, FACTS, LIMITS)
    assert stale.level == Level.STALE
    assert 'no cloud on /points for 2.1 s' in stale.message
    arrive(statistics, 12.2)
    assert statistics.report(12.3, FACTS, LIMITS).level == Level.OK
    assert statistics.report(14.3, FACTS, LIMITS).level == Level.STALE


def test_stale_says_that_nobody_sends():
    facts = InputFacts('/points', '', n_publishers=0, ros_time=0.0)
    assert 'nobody sends' in InputStatistics(0.0).report(9.0, facts, LIMITS).message


def test_input_reports_what_it_saw():
    statistics = InputStatistics(now=0.0)
    for k in range(11):
        arrive(statistics, 1.0 + 0.1 * k)
    values = statistics.report(2.25, FACTS, LIMITS).values
    assert values['Events since startup'] == '11'
    assert values['Actual frequency (Hz)'] == '10.00'
    assert values['Duration of window (s)'] == '1.000'
    assert values['Time since last cloud (s)'] == '0.250'
    assert values['Age of last stamp (s)'] == '0.500'
    assert values['Frame'] == 'velo_link'
    assert values['Fields'] == 'x y z intensity'
    assert values['QoS'] == FACTS.qos
    assert values['Refused since startup'] == '0'


def test_nothing_is_invented_before_the_first_cloud():
    values = InputStatistics(0.0).report(0.1, FACTS, LIMITS).values
    assert values['Actual frequency (Hz)'] == 'unknown'
    assert values['Age of last stamp (s)'] == 'unknown'


def test_stamp_of_2011_is_no_fault():
    statistics = InputStatistics(0.0)
    arrive(statistics, 0.1, stamp=1317000000.0)
    facts = InputFacts('/points', '', 1, ros_time=1795000000.0)
    assert statistics.report(0.2, facts, LIMITS).level == Level.OK


def test_refusals_are_error_when_all_and_warning_when_some():
    statistics = InputStatistics(0.0)
    for now in (0.1, 0.2):
        arrive(statistics, now)
        statistics.refused('no field named z')
    report = statistics.report(0.3, FACTS, LIMITS)
    assert report.level == Level.ERROR
    assert 'no field named z' in report.message
    # Nothing new came: what was wrong is still wrong.
    assert statistics.report(1.3, FACTS, LIMITS).level == Level.ERROR
    arrive(statistics, 1.4)
    statistics.refused('no field named z')
    arrive(statistics, 1.5)
    report = statistics.report(1.6, FACTS, LIMITS)
    assert report.level == Level.WARN
    assert report.message.startswith('1 of 2 clouds refused')
    arrive(statistics, 1.7)
    report = statistics.report(1.8, FACTS, LIMITS)
    assert report.level == Level.OK
    assert report.values['Refused since startup'] == '3'
    assert report.values['Last error'] == 'no field named z'


def process(statistics, latency):
    statistics.processed(latency, {'grid': 0.25 * latency, 'total': latency}, 'numba', 2)


def test_processing_percentiles_in_milliseconds():
    statistics = ProcessingStatistics()
    assert statistics.report(LIMITS).message == 'no cloud processed yet'
    for k in range(101):
        process(statistics, 0.001 * k)
    values = statistics.report(LIMITS).values
    # The window holds the newest 100 of them: 1 ms to 100 ms.
    assert values['Clouds since startup'] == '101'
    assert values['Clouds in window'] == str(WINDOW) == '100'
    assert values['Latency p50 (ms)'] == '50.50'
    assert values['Latency p95 (ms)'] == '95.05'
    assert values['Latency p99 (ms)'] == '99.01'
    assert float(values['Stage grid p50 (ms)']) == pytest.approx(12.62, abs=0.011)
    assert values['Backend'] == 'numba'
    assert values['Threads'] == '2'


def test_processing_warns_when_the_median_is_too_slow():
    statistics = ProcessingStatistics()
    for latency in (0.05, 0.09, 5.0):
        process(statistics, latency)
    assert statistics.report(LIMITS).level == Level.OK
    process(statistics, 0.2)
    process(statistics, 0.2)
    report = statistics.report(LIMITS)
    assert report.level == Level.WARN
    assert 'median latency 200 ms, above 100 ms' in report.message


def test_drops_are_a_warning_once_and_counted_for_ever():
    statistics = ProcessingStatistics()
    process(statistics, 0.01)
    statistics.dropped(0)
    assert statistics.report(LIMITS).level == Level.OK
    statistics.dropped(3)
    report = statistics.report(LIMITS)
    assert report.level == Level.WARN
    assert report.message.startswith('3 clouds dropped')
    report = statistics.report(LIMITS)
    assert report.level == Level.OK
    assert report.values['Dropped since startup'] == '3'
