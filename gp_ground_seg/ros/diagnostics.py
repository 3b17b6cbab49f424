"""The four tasks on /diagnostics; ``now`` is a time of a steady clock [s]."""

from __future__ import annotations

import time
from collections import defaultdict, deque
from collections.abc import Callable, Mapping, Sequence
from enum import IntEnum
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.node import Node
from sensor_msgs.msg import PointCloud2

from gp_ground_seg.core.frame import FloatArray, Label
from gp_ground_seg.core.parameters.config import DiagnosticsConfig
from gp_ground_seg.core.pipeline.sensor_pose import SensorPose
from gp_ground_seg.core.result import Segmentation
from gp_ground_seg.ros.input import STEADY_CLOCK, seconds_of

RATE_WINDOW = 10.0  # time over which rates are taken [s]
FIRST_LOG, LOG_PERIOD = 10.0, 60.0
"""Time from the first cloud to the first line of the log on the clouds so far, and from a line to
the next [s]."""
CLOUD_WINDOW = 100  # clouds over which the median of the latency is taken
Level = IntEnum('Level', 'OK WARN ERROR STALE', start=0)
"""Severity, with the values of ``diagnostic_msgs/DiagnosticStatus``."""
Finding = tuple[Level, str]


class Status(NamedTuple):
    """One judged task: name, level, one line of text, and the values behind it."""

    task: str
    level: Level
    message: str
    values: dict[str, str]


def judged(task: str, faults: Sequence[str], good: str, values: dict[str, str]) -> Status:
    """Return a WARN with all `faults`; without any, OK with the message `good`."""
    return Status(task, Level.WARN if faults else Level.OK, '; '.join(faults) or good, values)


class Rate:
    """Events in all, and in the last `RATE_WINDOW` seconds."""

    def __init__(self) -> None:
        self.n_total = 0
        self._events: deque[float] = deque()

    def count(self, now: float) -> None:
        """Count an event."""
        self.n_total += 1
        self._events.append(now)

    def window(self, now: float) -> tuple[int, float, float | None]:
        """Return events in the window, the time they span [s], their rate [Hz] if they do."""
        while self._events and now - self._events[0] > RATE_WINDOW:
            self._events.popleft()
        n_events = len(self._events)
        span = self._events[-1] - self._events[0] if self._events else 0.0
        # The first event opens the span over which the others are counted.
        return n_events, span, (n_events - 1) / span if span > 0.0 else None


class InputFacts(NamedTuple):
    """State of the input at the time of a report."""

    topic: str
    qos: str
    n_publishers: int
    ros_time: float  # by the clock of the node [s]
    is_simulated: bool = False  # whether that clock is /clock
    fault: str = ''  # in the way clouds are received
    idle: str = ''  # why no clouds are wanted


class InputTask:
    """Clouds that arrived, and those that were refused."""

    def __init__(self, now: float) -> None:
        self._last_arrival = self._listening_since = now
        self._arrivals = Rate()
        self._n_refused = self._n_time_jumps = 0
        # Clouds of the newest reporting period that had any.
        self._n_recent = self._n_refused_recent = 0
        self._is_reported = True
        self._frame = self._fields = self._last_error = ''
        self._stamp: float | None = None

    def arrived(self, now: float, cloud: PointCloud2) -> None:
        """Count a cloud."""
        if self._is_reported:
            self._n_recent = self._n_refused_recent = 0
        self._is_reported = False
        self._n_recent += 1
        self._last_arrival = now
        self._arrivals.count(now)
        self._stamp, self._frame = seconds_of(cloud.header.stamp), cloud.header.frame_id
        self._fields = ' '.join(field.name for field in cloud.fields)

    def refused(self, reason: str) -> None:
        """Count the cloud that arrived last as one that could not be processed."""
        self._n_refused_recent += 1
        self._n_refused += 1
        self._last_error = reason

    def time_jumped(self) -> None:
        """Count a jump back in time; the age of earlier stamps has no meaning after it."""
        self._n_time_jumps += 1
        self._stamp = None

    def report(self, now: float, facts: InputFacts, limits: DiagnosticsConfig) -> Status:
        """Judge the time since the last report."""
        self._is_reported = True
        if facts.idle:
            self._listening_since = now
        n_events, span, rate = self._arrivals.window(now)
        age = None if self._stamp is None else facts.ros_time - self._stamp
        values = {
            'Topic': facts.topic,
            'Publishers': str(facts.n_publishers),
            'QoS': facts.qos,
            'Events since startup': str(self._arrivals.n_total),
            'Events in window': str(n_events),
            'Duration of window (s)': f'{span:.3f}',
            'Actual frequency (Hz)': _digits(rate, '.2f'),
            'Time since last cloud (s)': f'{now - self._last_arrival:.3f}',
            'Age of last stamp (s)': _digits(age, '.3f'),
            'Clock': 'simulated, from /clock' if facts.is_simulated else 'system time',
            'Time jumps since startup': str(self._n_time_jumps),
            'Frame': self._frame,
            'Fields': self._fields,
            'Refused since startup': str(self._n_refused),
            'Last error': self._last_error,
        }
        return Status('input', *self._judge(now, facts, limits.stale_after), values)

    def _judge(self, now: float, facts: InputFacts, stale_after: float) -> Finding:
        silence = now - max(self._last_arrival, self._listening_since)
        n_received, n_refused = self._n_recent, self._n_refused_recent
        if facts.idle:
            return Level.OK, f'not listening to {facts.topic}: {facts.idle}'
        if silence > stale_after:
            n = facts.n_publishers
            source = f'publishers: {n}' if n else 'nobody sends clouds'
            said = f'no cloud on {facts.topic} for {silence:.1f} s ({source})'
            return Level.STALE, f'{said}; {facts.fault}' if facts.fault else said
        if n_refused:
            every = n_refused == n_received
            share = 'every cloud' if every else f'{n_refused} of {n_received} clouds'
            return Level.ERROR, f'{share} refused: {self._last_error}'
        # A stamp may be of any age: a recording is played at any time.
        if facts.fault:
            return Level.WARN, facts.fault
        waiting = f'waiting for the first cloud on {facts.topic}'
        return Level.OK, 'receiving' if n_received else waiting


class ProcessingTask:
    """Latency and losses."""

    def __init__(self) -> None:
        # Of the newest clouds, from arrival to publication [s].
        self._latencies: deque[float] = deque(maxlen=CLOUD_WINDOW)
        self._n_processed = self._n_dropped = 0
        # Since the last report.
        self._n_sent_recent = self._n_dropped_recent = 0
        self._backend = ''

    def arrived(self, n_lost: int) -> None:
        """Count a cloud that arrived, and `n_lost` before it that did not."""
        self._n_sent_recent += 1 + n_lost
        self._n_dropped += n_lost
        self._n_dropped_recent += n_lost

    def processed(self, latency: float, backend: str) -> None:
        """Count a cloud that was published `latency` [s] after it arrived."""
        self._n_processed += 1
        self._latencies.append(latency)
        self._backend = backend

    def report(self, limits: DiagnosticsConfig) -> Status:
        """Judge the latest clouds, and the losses since the last report."""
        latency = 1e3 * float(np.median(self._latencies)) if self._latencies else None
        limit, n_dropped = 1e3 * limits.max_latency, self._n_dropped_recent
        faults = []
        if latency is not None and latency > limit:
            faults.append(f'median latency {latency:.0f} ms, above {limit:g} ms')
        if n_dropped:
            faults.append(
                f'{n_dropped} of {self._n_sent_recent} clouds dropped since the last report'
            )
        self._n_sent_recent = self._n_dropped_recent = 0
        good = 'no cloud processed yet' if latency is None else f'median latency {latency:.1f} ms'
        values = {
            'Clouds since startup': str(self._n_processed),
            'Dropped since startup': str(self._n_dropped),
            'Median latency (ms)': _digits(latency, '.2f'),
            'Backend': self._backend,
        }
        return judged('processing', faults, good, values)


def model_status(scan: Segmentation | None, n_learned: int) -> Status:
    """Judge the newest scan; `n_learned` scans had their hyper-parameters learned."""
    if scan is None:
        return Status('model', Level.OK, 'no cloud segmented yet', {})
    fit, label = scan.fit, scan.label
    has_model = np.isfinite(scan.labelled.height)
    without_model = _mean(~has_model & (label != Label.UNKNOWN))
    per_candidate = fit.n_inliers / fit.n_candidates if fit.n_candidates else np.nan
    values = {
        'Segments with a model': f'{fit.n_segments} of {len(scan.surface.mean)}',
        'Ground fraction': _digits(_mean(label == Label.GROUND), '.4f'),
        'Unknown fraction': _digits(_mean(label == Label.UNKNOWN), '.4f'),
        'Points without a return': str(np.count_nonzero(label == Label.UNKNOWN)),
        'Fraction without model': _digits(without_model, '.4f'),
        'Candidates': str(fit.n_candidates),
        'Inliers': str(fit.n_inliers),
        **_pose_values(scan.pose),
        'Noise (m)': _digits(fit.theta.get('sigma_n'), '.4g'),
        'Learning mode': fit.mode,
        'Learned since startup': str(n_learned),
        'Optimiser status': fit.status,
        'Evaluations': str(fit.n_evaluations),
        'At bound': ' '.join(fit.at_bound) or 'none',
        'Objective per candidate': _digits(fit.objective * per_candidate, '.4f'),
        **{f'theta {name}': f'{value:.4g}' for name, value in fit.theta.items()},
    }
    return judged('model', _faults_of(scan), 'ground found in the newest cloud', values)


def _faults_of(scan: Segmentation) -> list[str]:
    """Return what is wrong with the pose that was used; if nothing is, with the model."""
    pose = scan.pose
    faults = [*pose.contradictions]
    if scan.label.any():  # an empty cloud shows nothing of the pose
        faults += [kept_height(pose)] if pose.is_fallback else pose.warnings
    if faults:
        return faults
    if not scan.fit.n_segments:
        return ['no ground found in the newest cloud']
    is_failed = scan.fit.status == 'failed'
    return ['the hyper-parameters could not be learned'] if is_failed else []


def kept_height(pose: SensorPose) -> str:
    """Say that a cloud has the pose of an earlier one."""
    return (
        'the cloud does not show the ground near the sensor well: the height of '
        f'{pose.height:.2f} m of an earlier one is kept; set sensor.height'
    )


def _pose_values(pose: SensorPose) -> dict[str, str]:
    taken = [name for name in ('height', 'roll', 'pitch') if getattr(pose, f'{name}_estimated')]
    seen = pose.measured
    height = seen.height if seen and seen.tells_height else None
    roll, pitch = (seen.roll, seen.pitch) if seen and seen.tells_tilt else (None, None)
    return {
        'Sensor height (m)': f'{pose.height:.4f}',
        'Sensor roll (rad)': f'{pose.roll:.4f}',
        'Sensor pitch (rad)': f'{pose.pitch:.4f}',
        'Taken from the scan': ' '.join(taken) or 'nothing',
        'Estimated height (m)': _digits(height, '.4f'),
        'Estimated roll (rad)': _digits(roll, '.4f'),
        'Estimated pitch (rad)': _digits(pitch, '.4f'),
    }


def output_status(
    now: float, rates: Mapping[str, Rate], n_subscribers: Mapping[str, int]
) -> Status:
    """List all topics, with their subscribers, and the rates of their messages."""
    values = {}
    for topic, n in n_subscribers.items():
        values[f'{topic} subscribers'] = str(n)
        values[f'{topic} rate (Hz)'] = _digits(rates[topic].window(now)[2], '.2f')
        values[f'{topic} since startup'] = str(rates[topic].n_total)
    heard = ', '.join(topic for topic, n in n_subscribers.items() if n)
    good = f'subscribed to: {heard}' if heard else 'nobody subscribes'
    return judged('output', [], good, values)


State = tuple[InputFacts, Mapping[str, int]]
"""State of the input, and the number of subscribers of each output topic."""


class Diagnostics:
    """The four tasks of `node`, published every ``diagnostics.period``."""

    def __init__(self, node: Node, state: Callable[[], State], limits: DiagnosticsConfig) -> None:
        self.input = InputTask(time.monotonic())
        self.processing = ProcessingTask()
        self._newest: Segmentation | None = None  # its statistics are computed for a report only
        self._n_learned = 0
        self._rates: defaultdict[str, Rate] = defaultdict(Rate)  # of the output topics
        self._node, self._state, self._limits = node, state, limits
        self._next_log, self._n_logged = np.inf, '0'
        self._publisher = node.create_publisher(DiagnosticArray, '/diagnostics', 10)
        self._timer = node.create_timer(limits.period, self._publish, clock=STEADY_CLOCK)

    def configure(self, limits: DiagnosticsConfig) -> None:
        """Use `limits` from now on; with another period, the next report comes after it."""
        if limits.period != self._limits.period:
            self._timer.timer_period_ns = round(1e9 * limits.period)
            self._timer.reset()
        self._limits = limits

    def arrived(self, cloud: PointCloud2, arrival: float, n_lost: int) -> None:
        """Count a cloud that came at the time `arrival` [s], and `n_lost` before it."""
        self.input.arrived(arrival, cloud)
        self.processing.arrived(n_lost)

    def published(
        self,
        scan: Segmentation,
        arrival: float,
        stages: Mapping[str, float],
        topics: Sequence[str],
    ) -> None:
        """Count the cloud that came at the time `arrival` [s]; log the times of its stages."""
        now = time.monotonic()
        times = ', '.join(f'{name} {1e3 * seconds:.2f}' for name, seconds in stages.items())
        self._node.get_logger().debug(f'times of the stages [ms]: {times}')
        self.processing.processed(now - arrival, scan.fit.backend)
        self._newest = scan
        self._n_learned += scan.fit.n_evaluations > 0
        for topic in topics:
            self._rates[topic].count(now)

    def report(self, now: float) -> list[Status]:
        """Return the status of each task."""
        facts, n_subscribers = self._state()
        found = [
            self.input.report(now, facts, self._limits),
            self.processing.report(self._limits),
            model_status(self._newest, self._n_learned),
            output_status(now, self._rates, n_subscribers),
        ]
        self._log(now, {name: text for status in found for name, text in status.values.items()})
        return found

    def _log(self, now: float, values: Mapping[str, str]) -> None:
        """Log that the node works, if it has processed clouds since the last such line."""
        n = values['Clouds since startup']
        if n != '0' and self._next_log == np.inf:
            self._next_log = now + FIRST_LOG
        if n == self._n_logged or now < self._next_log:
            return
        self._next_log, self._n_logged = now + LOG_PERIOD, n
        self._node.get_logger().info(
            f'{n} cloud{"s" * (n != "1")} segmented so far, {values["Actual frequency (Hz)"]} Hz, '
            f'median latency {values["Median latency (ms)"]} ms, '
            f'share of ground {values["Ground fraction"]}'
        )

    def _publish(self) -> None:
        array = DiagnosticArray()
        array.header.stamp = self._node.get_clock().now().to_msg()
        node_name = self._node.get_fully_qualified_name()
        try:
            statuses = self.report(time.monotonic())
        except Exception as error:
            # Raised from a timer, it would end the node.
            statuses = [Status('diagnostics', Level.ERROR, f'{type(error).__name__}: {error}', {})]
        for status in statuses:
            message = DiagnosticStatus(level=bytes([status.level]), message=status.message)
            message.name = f'{node_name.lstrip("/")}: {status.task}'
            message.hardware_id = node_name
            message.values = [KeyValue(key=k, value=v) for k, v in status.values.items()]
            array.status.append(message)
        self._publisher.publish(array)


def _digits(value: float | None, form: str) -> str:
    return 'unknown' if value is None or np.isnan(value) else format(value, form)


def _mean(values: npt.NDArray[np.bool_] | FloatArray) -> float:
    return float(np.mean(values)) if len(values) else np.nan
