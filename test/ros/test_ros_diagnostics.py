"""Judgements of the node on its input and itself, without ROS: time is passed in."""

from types import SimpleNamespace

import numpy as np
import pytest
import ros_helpers as ros
from conftest import hilly_scan
from hypothesis import given
from hypothesis import strategies as st

from gp_ground_seg import Config, GroundSegmenter
from gp_ground_seg.core.parameters.config import DiagnosticsConfig
from gp_ground_seg.ros.diagnostics import (
    RATE_WINDOW,
    SLOW,
    InputTask,
    Level,
    ProcessingTask,
    model_status,
)

pytestmark = pytest.mark.usefixtures('compiled_code')

LIMITS = DiagnosticsConfig(stale_after=2.0, max_latency=0.1)
CLOUD = ros.to_message(ros.street(1), stamp=(1000, 0), frame='velo_link')
ROS_TIME = 1000.5


def input_task(now=0.0, **facts):
    """The task of a subscription about which these facts hold."""
    known = {'topic': '/points', 'qos_words': 'reliable', 'n_publishers': 1}
    return InputTask(now, SimpleNamespace(**{**known, 'fault': '', 'idle': '', **facts}))


def process(statistics, latencies, slow='total', age=None):
    """Clouds that were published so long after their arrival [s], most of it in one stage."""
    for latency in latencies:
        stages = {**dict.fromkeys(SLOW, 0.1 * latency), slow: 0.8 * latency}
        statistics.processed(latency, 'numba', stages, age)
    return statistics


def test_input_waits_then_is_stale_and_recovers():
    task = input_task(10.0)
    waiting = task.report(11.0, ROS_TIME, LIMITS)
    assert (waiting.level, waiting.message) == (Level.OK, 'waiting for the first cloud on /points')
    # Nothing is invented before the first cloud.
    assert waiting.values['Actual frequency (Hz)'] == 'unknown'
    assert waiting.values['Age of last stamp (s)'] == 'unknown'
    for n_publishers, who in ((1, 'publishers: 1'), (0, 'nobody sends clouds')):
        task._source.n_publishers = n_publishers
        stale = task.report(12.1, ROS_TIME, LIMITS)
        assert stale.level == Level.STALE
        assert stale.message == f'no cloud on /points for 2.1 s ({who})'
    task.arrived(12.2, CLOUD)
    assert task.report(12.3, ROS_TIME, LIMITS).level == Level.OK
    assert task.report(14.3, ROS_TIME, LIMITS).level == Level.STALE


def test_input_reports_what_it_saw():
    task = input_task()
    for k in range(11):
        task.arrived(1.0 + 0.1 * k, CLOUD)
    # Names and their order are part of the interface: dashboards read them.
    assert [*task.report(2.25, ROS_TIME, LIMITS).values.items()] == [
        ('Topic', '/points'),
        ('Publishers', '1'),
        ('QoS', 'reliable'),
        ('Events since startup', '11'),
        ('Events in window', '11'),
        ('Duration of window (s)', '1.000'),
        ('Actual frequency (Hz)', '10.00'),
        ('Time since last cloud (s)', '0.250'),
        ('Age of last stamp (s)', '0.500'),
        ('Time jumps since startup', '0'),
        ('Frame', 'velo_link'),
        ('Fields', 'intensity x y z'),
        ('Refused since startup', '0'),
        ('Last error', ''),
    ]
    task.time_jumped()
    later = {
        'Time jumps since startup': '1', 'Age of last stamp (s)': 'unknown',
        'Events since startup': '11', 'Events in window': '5', 'Duration of window (s)': '0.400',
    }  # fmt: skip
    found = task.report(1.55 + RATE_WINDOW, ROS_TIME, LIMITS).values
    assert later.items() <= found.items()
    empty = task.report(2.1 + RATE_WINDOW, ROS_TIME, LIMITS).values
    assert (empty['Events in window'], empty['Actual frequency (Hz)']) == ('0', 'unknown')


@given(st.lists(st.booleans(), min_size=1, max_size=20))
def test_a_refusal_is_an_error(are_refused):
    task = input_task()
    for refused in are_refused:
        task.arrived(0.1, CLOUD)
        if refused:
            task.refused('no field named z')
    report = task.report(0.2, ROS_TIME, LIMITS)
    assert report.level == (Level.ERROR if any(are_refused) else Level.OK)
    assert ('no field named z' in report.message) == any(are_refused)
    assert report.message.startswith('every cloud refused: ') == all(are_refused)
    # Nothing new came: what was wrong is still wrong.
    assert task.report(1.2, ROS_TIME, LIMITS).level == report.level
    task.arrived(1.3, CLOUD)
    assert task.report(1.4, ROS_TIME, LIMITS).level == Level.OK
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
        ('Age of transform (s)', 'unknown'),
    ]
    assert (report.level, report.message) == (Level.OK, 'median latency 50.5 ms')
    assert process(statistics, 50 * [0.2]).report(LIMITS).level == Level.WARN
    for stage, name in SLOW.items():
        report = process(statistics, 100 * [0.2], stage).report(LIMITS)
        said = f'median latency 200 ms, above 100 ms, of it 160 ms {name.format("numba")}'
        assert (report.level, report.message) == (Level.WARN, said)
    statistics.loader = SimpleNamespace(is_done=False)
    report = process(statistics, 100 * [0.2]).report(LIMITS)
    assert report.message.endswith('160 ms segmentation with numba while compiling')
    # Late TF is said, whatever the latency.
    for age, level in ((0.04, Level.OK), (0.4, Level.WARN)):
        report = process(ProcessingTask(), [0.01], age=age).report(LIMITS)
        assert (report.level, report.values['Age of transform (s)']) == (level, f'{age:.3f}')
        assert ('by TF or IMU is 0.40 s from the stamp' in report.message) == (age == 0.4)


def test_drops_are_a_warning_once_and_counted_for_ever():
    # Also before a cloud is processed, as while the first takes long.
    statistics, reports = ProcessingTask(), []
    for n_lost in (0, 3, 0):
        statistics.n_dropped += n_lost
        reports.append(statistics.report(LIMITS))
    assert [report.level for report in reports] == [Level.OK, Level.WARN, Level.OK]
    assert reports[1].message == 'clouds dropped since the last report: 3'
    assert [report.values['Dropped since startup'] for report in reports] == ['0', '3', '3']


def test_model_reports_the_newest_scan():
    assert model_status(None).level == Level.OK
    xyz = hilly_scan()
    xyz[:300, 2], xyz[300:400] = np.nan, 0.0
    segmentation = GroundSegmenter(Config().replace(**{'grid.n_segments': 24})).segment(xyz)
    status = model_status(segmentation)
    fit, pose, ground = segmentation.fit, segmentation.pose, segmentation.label == 1
    assert [*status.values.items()] == [
        ('Segments with a model', f'{fit.n_segments} of 24'),
        ('Ground fraction', f'{ground.mean():.4f}'),
        ('Unknown fraction', '0.1000'),
        ('Candidates', str(fit.n_candidates)),
        ('Inliers', str(fit.n_inliers)),
        ('Sensor height (m)', f'{pose.height:.4f}'),
        ('Estimated height (m)', f'{pose.measured.height:.4f}'),
        ('Sensor roll (rad)', f'{pose.roll:.4f}'),
        ('Estimated roll (rad)', f'{pose.measured.roll:.4f}'),
        ('Sensor pitch (rad)', f'{pose.pitch:.4f}'),
        ('Estimated pitch (rad)', f'{pose.measured.pitch:.4f}'),
        ('Height over another level (m)', 'unknown'),
        ('Taken from the scan', 'height'),
        ('Learning mode', 'every_frame'),
        ('Optimiser status', fit.status),
        *((f'theta {name}', f'{value:.4g}') for name, value in fit.theta.items()),
    ]
    assert (status.level, status.message) == (Level.OK, 'ground found in the newest cloud')


def test_a_tilt_that_the_scan_contradicts_has_the_name_of_what_gave_it():
    scan = GroundSegmenter().segment(hilly_scan(20_000), (0.4, 0.0))
    (fault,) = scan.pose.contradictions
    assert fault.startswith('sensor.roll = 0.4, sensor.pitch = 0: ')
    for level, said in (('sensor', fault), ('tf', f'frame.level = tf, which gives {fault}')):
        assert model_status(scan, level).message.startswith(said)


@pytest.mark.parametrize(
    ('points', 'changes', 'fault', 'height'),
    [
        (hilly_scan(20_000), {'sensor.height': 1.73}, '', '1.7'),
        # Given wrongly: a warning that says so, not a repair.
        (hilly_scan(20_000), {'sensor.height': 3.5}, 'sensor.height', '1.7'),
        (np.zeros((0, 3)), {}, 'no ground found in the newest cloud', 'unknown'),
        (np.full((9, 3), np.nan), {}, 'no ground found in the newest cloud', 'unknown'),
    ],
)
def test_a_wrong_height_and_no_ground_are_warnings(points, changes, fault, height):
    status = model_status(GroundSegmenter(Config().replace(**changes)).segment(points))
    assert status.level == (Level.WARN if fault else Level.OK)
    assert fault in status.message
    assert status.values['Estimated height (m)'].startswith(height)
    assert status.values['Taken from the scan'] == 'nothing'
