"""The three tasks on /diagnostics; ``now`` is a time of a steady clock [s]."""

import time
from collections import deque
from collections.abc import Mapping, Sequence
from enum import IntEnum
from typing import NamedTuple

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.node import Node
from sensor_msgs.msg import PointCloud2

from gp_ground_seg.core.frame import Label
from gp_ground_seg.core.parameters.config import Config, DiagnosticsConfig
from gp_ground_seg.core.pipeline.sensor_pose import SensorPose
from gp_ground_seg.core.result import Segmentation
from gp_ground_seg.data.point_cloud2 import stamp_of
from gp_ground_seg.ros.input import STEADY_CLOCK, CloudSubscription
from gp_ground_seg.ros.loader import BackendLoader

RATE_WINDOW = 10.0  # time over which the rate is taken [s]
LOG_PERIOD = 60.0  # time between two lines of the log on the clouds so far [s]
CLOUD_WINDOW = 100  # clouds over which the median of the latency is taken
MAX_AGE = 0.05  # time between a cloud and a transform from which on TF is called late [s]
SLOW = {
    'queue': 'waiting for its turn',
    'frames': 'waiting for TF or IMU',
    'total': 'segmentation with {}',
    'publish': 'publishing, as when a subscriber is slow',
}
"""Stages of a cloud, as they are named when they take long."""
Level = IntEnum('Level', 'OK WARN ERROR STALE', start=0)
"""Severity, with the values of ``diagnostic_msgs/DiagnosticStatus``."""


class Status(NamedTuple):
    """One judged task: name, level, one line of text, and the values behind it."""

    task: str
    level: Level
    message: str
    values: dict[str, str]


def judged(task: str, faults: Sequence[str], good: str, values: dict[str, str]) -> Status:
    """Return a WARN with all `faults`; without any, OK with the message `good`."""
    return Status(task, Level.WARN if faults else Level.OK, '; '.join(faults) or good, values)


class InputTask:
    """Clouds that arrived from `source`, and those that were refused."""

    def __init__(self, now: float, source: CloudSubscription) -> None:
        self._source = source
        self._last_arrival = self._listening_since = now
        self._arrivals: deque[float] = deque()  # of the last `RATE_WINDOW`
        self._n_arrived = self.n_refused = self._n_time_jumps = 0
        # Clouds of the newest reporting period that had any.
        self._n_recent = self._n_refused_recent = 0
        self._is_reported = True
        self.frame = self._fields = self._last_error = ''
        self._stamp: float | None = None

    def arrived(self, now: float, cloud: PointCloud2) -> None:
        """Count a cloud."""
        if self._is_reported:
            self._n_recent = self._n_refused_recent = 0
        self._is_reported = False
        self._n_recent += 1
        self._last_arrival = now
        self._n_arrived += 1
        self._arrivals.append(now)
        self._stamp, self.frame = 1e-9 * stamp_of(cloud.header), cloud.header.frame_id
        self._fields = ' '.join(field.name for field in cloud.fields)

    def refused(self, reason: str) -> None:
        """Count the cloud that arrived last as one that could not be processed."""
        self._n_refused_recent += 1
        self.n_refused += 1
        self._last_error = reason

    def time_jumped(self) -> None:
        """Count a jump back in time; the age of earlier stamps has no meaning after it."""
        self._n_time_jumps += 1
        self._stamp = None

    def report(self, now: float, ros_time: float, limits: DiagnosticsConfig) -> Status:
        """Judge the time since the last report; `ros_time` is by the clock of the node [s]."""
        self._is_reported = True
        if self._source.idle:
            self._listening_since = now
        while self._arrivals and now - self._arrivals[0] > RATE_WINDOW:
            self._arrivals.popleft()
        n_events = len(self._arrivals)
        span = self._arrivals[-1] - self._arrivals[0] if n_events else 0.0
        # The first event opens the span over which the others are counted.
        rate = (n_events - 1) / span if span > 0.0 else None
        age = None if self._stamp is None else ros_time - self._stamp
        values = {
            'Topic': self._source.topic,
            'Publishers': str(self._source.n_publishers),
            'QoS': self._source.qos_words,
            'Events since startup': str(self._n_arrived),
            'Events in window': str(n_events),
            'Duration of window (s)': f'{span:.3f}',
            'Actual frequency (Hz)': _digits(rate, '.2f'),
            'Time since last cloud (s)': f'{now - self._last_arrival:.3f}',
            'Age of last stamp (s)': _digits(age, '.3f'),
            'Time jumps since startup': str(self._n_time_jumps),
            'Frame': self.frame,
            'Fields': self._fields,
            'Refused since startup': str(self.n_refused),
            'Last error': self._last_error,
        }
        return Status('input', *self._judge(now, limits.stale_after), values)

    def _judge(self, now: float, stale_after: float) -> tuple[Level, str]:
        source, n_received = self._source, self._n_recent
        silence = now - max(self._last_arrival, self._listening_since)
        if source.idle:
            return Level.OK, f'not listening to {source.topic}: {source.idle}'
        if silence > stale_after:
            n = source.n_publishers
            senders = f'publishers: {n}' if n else 'nobody sends clouds'
            said = f'no cloud on {source.topic} for {silence:.1f} s ({senders})'
            return Level.STALE, f'{said}; {source.fault}' if source.fault else said
        if n_refused := self._n_refused_recent:
            every = n_refused == n_received
            share = 'every cloud' if every else f'{n_refused} of {n_received} clouds'
            return Level.ERROR, f'{share} refused: {self._last_error}'
        if source.fault:
            return Level.WARN, source.fault
        waiting = f'waiting for the first cloud on {source.topic}'
        return Level.OK, 'receiving' if n_received else waiting


class ProcessingTask:
    """Latency and losses."""

    loader: BackendLoader | None = None  # of compiled code; until it is done, numpy segments

    def __init__(self) -> None:
        # Of the newest clouds, from arrival to publication, and of each stage in `SLOW` [s].
        self._latencies: deque[float] = deque(maxlen=CLOUD_WINDOW)
        self._stages: deque[list[float]] = deque(maxlen=CLOUD_WINDOW)
        self.n_processed = self.n_dropped = 0
        self._n_reported = 0  # those dropped before the last report
        self._backend = ''
        self._age: float | None = None

    def processed(
        self, latency: float, backend: str, stages: Mapping[str, float], age: float | None
    ) -> None:
        """Count a cloud that was published `latency` [s] after it arrived.

        `age` is how far the pose by TF or an IMU is from its stamp [s], None without these.
        """
        self.n_processed += 1
        self._latencies.append(latency)
        self._stages.append([stages[name] for name in SLOW])
        self._backend, self._age = backend, age

    def report(self, limits: DiagnosticsConfig) -> Status:
        """Judge the latest clouds, and the losses since the last report."""
        latency = 1e3 * float(np.median(self._latencies)) if self._latencies else None
        limit, n_dropped = 1e3 * limits.max_latency, self.n_dropped - self._n_reported
        faults, meanwhile = [], ' while compiling' * bool(self.loader and not self.loader.is_done)
        if latency is not None and latency > limit:
            times = zip(1e3 * np.median(self._stages, axis=0), SLOW.values(), strict=True)
            longest, stage = max(times)
            faults.append(
                f'median latency {latency:.0f} ms, above {limit:g} ms, of it {longest:.0f} ms '
                f'{stage.format(self._backend + meanwhile)}'
            )
        if self._age is not None and self._age > MAX_AGE:
            faults.append(
                f'the pose by TF or IMU is {self._age:.2f} s from the stamp of the newest cloud: '
                'what sends it is late, or has another clock'
            )
        if n_dropped:
            faults.append(f'clouds dropped since the last report: {n_dropped}{meanwhile}')
        self._n_reported = self.n_dropped
        good = 'no cloud processed yet' if latency is None else f'median latency {latency:.1f} ms'
        values = {
            'Clouds since startup': str(self.n_processed),
            'Dropped since startup': str(self.n_dropped),
            'Median latency (ms)': _digits(latency, '.2f'),
            'Backend': self._backend,
            'Age of transform (s)': _digits(self._age, '.3f'),
        }
        return judged('processing', faults, good, values)


def by_what_was_set(fault: str, level: str) -> str:
    """Return a fault of the tilt under the value of ``frame.level``, where that has given it."""
    is_given = level != 'sensor' and fault.startswith(('sensor.roll', 'sensor.pitch'))
    return f'frame.level = {level}, which gives {fault}' if is_given else fault


def model_status(scan: Segmentation | None, level: str = 'sensor') -> Status:
    """Judge the newest scan, whose tilt is by the `level` of ``frame.level``."""
    if scan is None:
        return Status('model', Level.OK, 'no cloud segmented yet', {})
    fit, n_points = scan.fit, max(1, len(scan.label))
    shares = np.bincount(scan.label, minlength=len(Label)) / n_points
    values = {
        'Segments with a model': f'{fit.n_segments} of {len(scan.surface.mean)}',
        'Ground fraction': f'{shares[Label.GROUND]:.4f}',
        'Unknown fraction': f'{shares[Label.UNKNOWN]:.4f}',
        'Candidates': str(fit.n_candidates),
        'Inliers': str(fit.n_inliers),
        **_pose_values(scan.pose),
        'Learning mode': fit.mode,
        'Optimiser status': fit.status,
        **{f'theta {name}': f'{value:.4g}' for name, value in fit.theta.items()},
    }
    faults = [by_what_was_set(fault, level) for fault in _faults_of(scan)]
    return judged('model', faults, 'ground found in the newest cloud', values)


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
    return ['the hyper-parameters could not be learned'] if scan.fit.status == 'failed' else []


def kept_height(pose: SensorPose) -> str:
    """Say that a cloud has the pose of an earlier one."""
    return (
        'the cloud does not show the ground near the sensor well: the height of '
        f'{pose.height:.2f} m of an earlier one is kept; set sensor.height'
    )


def _pose_values(pose: SensorPose) -> dict[str, str]:
    """Return height and tilt as used, and as the scan shows them."""
    seen, values, taken = pose.measured, {}, []
    for name, unit in (('height', 'm'), ('roll', 'rad'), ('pitch', 'rad')):
        is_shown = seen and (seen.tells_height if name == 'height' else seen.tells_tilt)
        taken += [name] if getattr(pose, f'{name}_estimated') else []
        values[f'Sensor {name} ({unit})'] = f'{getattr(pose, name):.4f}'
        shown = getattr(seen, name) if is_shown else None
        values[f'Estimated {name} ({unit})'] = _digits(shown, '.4f')
    values['Height over another level (m)'] = _digits(seen.other_height if seen else None, '.4f')
    return {**values, 'Taken from the scan': ' '.join(taken) or 'nothing'}


class Diagnostics:
    """The three tasks of `node`, published every ``diagnostics.period``."""

    def __init__(self, node: Node, source: CloudSubscription, config: Config) -> None:
        self.input = InputTask(time.monotonic(), source)
        self.processing = ProcessingTask()
        self._newest: Segmentation | None = None  # its statistics are computed for a report only
        self._node, self._config = node, config
        self._log_due = time.monotonic() + LOG_PERIOD
        self._publisher = node.create_publisher(DiagnosticArray, '/diagnostics', 10)
        period = config.diagnostics.period
        self._timer = node.create_timer(period, self._publish, clock=STEADY_CLOCK)

    def configure(self, config: Config) -> None:
        """Use `config` from now on; with another period, the next report comes after it."""
        period, before = config.diagnostics.period, self._config.diagnostics.period
        self._config = config
        if period != before:
            self._timer.timer_period_ns = round(1e9 * period)
            self._timer.reset()

    def published(
        self, scan: Segmentation, arrival: float, stages: Mapping[str, float], age: float | None
    ) -> None:
        """Count the cloud that came at `arrival` [s], as in `processed`; log its stages."""
        logger, backend = self._node.get_logger(), scan.backend
        times = ', '.join(f'{name} {1e3 * seconds:.2f}' for name, seconds in stages.items())
        logger.debug(f'times of the stages [ms]: {times}')
        if self._newest is None:
            logger.info(
                f'first cloud: frame {self.input.frame!r}, {len(scan.label)} points, sensor '
                f'{scan.pose.sensor_height:.2f} m over the ground, segmented with {backend}'
            )
        self.processing.processed(time.monotonic() - arrival, backend, stages, age)
        self._newest = scan

    def summary(self) -> str:
        """Return what became of the clouds so far."""
        n_done, n_lost = self.processing.n_processed, self.processing.n_dropped
        return f'{n_done} clouds segmented, {n_lost} lost, {self.input.n_refused} refused'

    def _publish(self) -> None:
        limits, now = self._config.diagnostics, self._node.get_clock().now()
        statuses = [
            self.input.report(time.monotonic(), 1e-9 * now.nanoseconds, limits),
            self.processing.report(limits),
            model_status(self._newest, self._config.frame.level),
        ]
        array, node_name = DiagnosticArray(), self._node.get_fully_qualified_name()
        array.header.stamp = now.to_msg()
        if time.monotonic() >= self._log_due:  # the throttle of rclpy takes 1 ms
            self._log_due = time.monotonic() + LOG_PERIOD
            said = '; '.join(f'{own.task} {own.level.name}: {own.message}' for own in statuses)
            self._node.get_logger().info(f'so far: {self.summary()}; {said}')
        array.status = [
            DiagnosticStatus(
                level=bytes([status.level]),
                name=f'{node_name.lstrip("/")}: {status.task}',
                message=status.message,
                hardware_id=node_name,
                values=[KeyValue(key=k, value=v) for k, v in status.values.items()],
            )
            for status in statuses
        ]
        self._publisher.publish(array)


def _digits(value: float | None, form: str) -> str:
    return 'unknown' if value in (None, np.inf) else format(value, form)
