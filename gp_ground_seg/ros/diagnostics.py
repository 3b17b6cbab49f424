"""Four tasks on /diagnostics, held at their worst level; ``now`` is on a steady clock [s]."""

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

from gp_ground_seg.core.frame import FloatArray, Label
from gp_ground_seg.core.parameters.config import DiagnosticsConfig
from gp_ground_seg.core.pipeline.sensor_pose import SensorPose
from gp_ground_seg.core.result import FitReport, Segmentation
from gp_ground_seg.ros.input import STEADY_CLOCK

RATE_WINDOW = 10.0  # time over which rates are taken [s]
LOG_PERIOD = 10.0  # shortest time between two lines of the log that say that the node works [s]
CLOUD_WINDOW = 100  # clouds over which percentiles are taken
MIN_RATE_SPAN = 1.0  # shortest time from which the load is computed [s]: a burst is no rate
Level = IntEnum('Level', 'OK WARN ERROR STALE', start=0)
"""Severity, with the values of ``diagnostic_msgs/DiagnosticStatus``."""
Finding = tuple[Level, str]


class Status(NamedTuple):
    """One judged task: name, level, one line of text, and the values behind it."""

    task: str
    level: Level
    message: str
    values: dict[str, str]


class Hysteresis:
    """Holds the worst level of the latest time, so that a passing fault can be seen.

    STALE ends with the first cloud: it is held as a warning.
    """

    def __init__(self) -> None:
        # Levels fall from old to new: a status that is older and no worse than another goes.
        self._held: deque[tuple[float, Status]] = deque()

    def hold(self, now: float, found: Status, recover_after: float) -> Status:
        """Return `found` with the worst level and message of the last `recover_after` [s]."""
        while self._held and now - self._held[0][0] > recover_after:
            self._held.popleft()
        level = Level.WARN if found.level == Level.STALE else found.level
        while self._held and self._held[-1][1].level <= level:
            self._held.pop()
        if level > Level.OK:
            self._held.append((now, found._replace(level=level)))
        since, worst = self._held[0] if self._held else (now, found)
        if found.level == Level.STALE or worst.level <= found.level:
            return found
        message = f'{found.message}; {now - since:.1f} s ago: {worst.message}'
        return found._replace(level=worst.level, message=message)


class Rate:
    """Events in all, and in the last `RATE_WINDOW` seconds."""

    def __init__(self) -> None:
        self.n_total = 0
        self._events: deque[tuple[float, int]] = deque()

    def count(self, now: float, n: int = 1) -> None:
        """Count `n` events."""
        self.n_total += n
        self._events.append((now, n))

    def window(self, now: float) -> tuple[int, float, float | None]:
        """Return events in the window, the time they span [s], their rate [Hz] if they do."""
        while self._events and now - self._events[0][0] > RATE_WINDOW:
            self._events.popleft()
        n_events = sum(n for _, n in self._events)
        span = self._events[-1][0] - self._events[0][0] if self._events else 0.0
        # The first event opens the span over which the others are counted.
        return n_events, span, (n_events - self._events[0][1]) / span if span > 0.0 else None


class InputFacts(NamedTuple):
    """State of the input at the time of a report."""

    topic: str
    qos: str
    n_publishers: int
    ros_time: float  # by the clock of the node [s]
    is_simulated: bool = False  # that clock
    fault: str = ''  # of the way clouds are received
    idle: str = ''  # why none are wanted


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

    def arrived(self, now: float, stamp: float, frame: str, fields: Sequence[str]) -> None:
        """Count a cloud; `stamp` is the time in its header [s]."""
        if self._is_reported:
            self._n_recent = self._n_refused_recent = 0
        self._is_reported = False
        self._n_recent += 1
        self._last_arrival = now
        self._arrivals.count(now)
        self._stamp, self._frame, self._fields = stamp, frame, ' '.join(fields)

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
        return Status('input', *self._judge(now, facts, limits), values)

    def _judge(self, now: float, facts: InputFacts, limits: DiagnosticsConfig) -> Finding:
        silence = now - max(self._last_arrival, self._listening_since)
        n_received, n_refused = self._n_recent, self._n_refused_recent
        if facts.idle:
            return Level.OK, f'not listening to {facts.topic}: {facts.idle}'
        if silence > limits.stale_after:
            source = f'publishers: {facts.n_publishers}' if facts.n_publishers else 'nobody sends'
            why = f'; {facts.fault}' if facts.fault else ''
            return Level.STALE, f'no cloud on {facts.topic} for {silence:.1f} s ({source}){why}'
        # A stamp may be of any age: a recording is played at any time.
        if n_refused == 0:
            waiting = f'waiting for the first cloud on {facts.topic}'
            found = Level.OK, 'receiving' if n_received else waiting
            return (Level.WARN, facts.fault) if facts.fault else found
        share = 'every cloud' if n_refused == n_received else f'{n_refused} of {n_received} clouds'
        is_error = n_refused > min(limits.max_refused_ratio * n_received, n_received - 1)
        return Level.ERROR if is_error else Level.WARN, f'{share} refused: {self._last_error}'


class ProcessingTask:
    """Latencies, load and losses."""

    def __init__(self) -> None:
        # Latency and duration of the newest clouds, and of their stages [s].
        self._times: deque[tuple[float, float, Mapping[str, float]]] = deque(maxlen=CLOUD_WINDOW)
        self._sent = Rate()
        self._n_processed = self._n_dropped = 0
        self._n_sent_recent = self._n_dropped_recent = 0
        self._backend = ''

    def arrived(self, now: float, n_lost: int) -> None:
        """Count a cloud that arrived, and `n_lost` before it that did not."""
        self._sent.count(now, 1 + n_lost)
        self._n_sent_recent += 1 + n_lost
        self._n_dropped += n_lost
        self._n_dropped_recent += n_lost

    def processed(self, duration: float, stages: Mapping[str, float], fit: FitReport) -> None:
        """Count a cloud processed in `duration` [s]; `stages` has its wait too, as ``queue``."""
        self._n_processed += 1
        self._times.append((stages['queue'] + duration, duration, stages))
        self._backend = fit.backend

    def load(self, now: float) -> float | None:
        """Time that the clouds sent in a second take to process [s/s]; None if unknown."""
        _, span, rate = self._sent.window(now)
        if rate is None or not self._times or span < MIN_RATE_SPAN:
            return None
        return rate * self._median(1)

    def _median(self, k: int) -> float:
        return float(np.median([times[k] for times in self._times]))

    def report(self, now: float, limits: DiagnosticsConfig) -> Status:
        """Judge the latest clouds, and the losses since the last report."""
        level, message = self._judge(now, limits)
        self._n_sent_recent = self._n_dropped_recent = 0
        load = self.load(now)
        values = {
            'Clouds since startup': str(self._n_processed),
            'Clouds in window': str(len(self._times)),
            'Dropped since startup': str(self._n_dropped),
            'Load (%)': _digits(None if load is None else 100.0 * load, '.1f'),
            **_percentiles('Latency', [latency for latency, _, _ in self._times]),
        }
        for stage in self._times[-1][2] if self._times else ():
            times = [stages[stage] for _, _, stages in self._times if stage in stages]
            values.update(_percentiles(f'Stage {stage}', times))
        values['Backend'] = self._backend
        return Status('processing', level, message, values)

    def _judge(self, now: float, limits: DiagnosticsConfig) -> Finding:
        if not self._times:
            return Level.OK, 'no cloud processed yet'
        latency, duration = 1e3 * self._median(0), 1e3 * self._median(1)
        max_latency = 1e3 * limits.max_latency
        load = self.load(now)
        n_dropped, n_sent = self._n_dropped_recent, self._n_sent_recent
        faults = []
        if latency > max_latency:
            faults.append(f'median latency {latency:.0f} ms, above {max_latency:g} ms')
        if load is not None and load > limits.max_load:
            faults.append(f'{duration:.0f} ms per cloud at {1e3 * load / duration:.1f} Hz')
        if n_dropped > limits.max_drop_ratio * n_sent:
            faults.append(f'{n_dropped} of {n_sent} clouds dropped since the last report')
        if faults:
            return Level.WARN, f'too slow for the input: {"; ".join(faults)}'
        return Level.OK, f'median latency {latency:.1f} ms'


def frame_quality(fit: FitReport, n_occupied: int, certainty: float) -> float:
    """Return how reliable a frame is, 0 to 1: a product of shares (docs/node.md)."""
    if fit.status == 'failed' or not fit.n_candidates or not n_occupied:
        return 0.0
    share = min(1.0, fit.n_segments / n_occupied) * (fit.n_inliers / fit.n_candidates)
    return share * (1.0 if np.isnan(certainty) else certainty)


class ModelTask:
    """The newest scan; its statistics are computed for a report only."""

    _newest: Segmentation | None = None
    _n_learned = 0

    def segmented(self, segmentation: Segmentation) -> None:
        """Keep a scan."""
        self._newest = segmentation
        self._n_learned += segmentation.fit.n_evaluations > 0

    def report(self, limits: DiagnosticsConfig) -> Status:
        """Judge the newest scan."""
        scan = self._newest
        if scan is None:
            return Status('model', Level.OK, 'no cloud segmented yet', {})
        fit, label = scan.fit, scan.label
        n_occupied = int(np.count_nonzero(np.diff(scan.candidates.offsets)))
        has_model = np.isfinite(scan.labelled.height)
        certainty = _mean(np.abs(2.0 * scan.p_ground[has_model] - 1.0))
        quality = frame_quality(fit, n_occupied, certainty)
        without_model = _mean(~has_model & (label != Label.UNKNOWN))
        per_candidate = fit.n_inliers / fit.n_candidates if fit.n_candidates else np.nan
        values = {
            'frame_quality': f'{quality:.3f}',
            'Segments with a model': f'{fit.n_segments} of {len(scan.surface.mean)}',
            'Segments with candidates': str(n_occupied),
            'Ground fraction': _digits(_mean(label == Label.GROUND), '.4f'),
            'Unknown fraction': _digits(_mean(label == Label.UNKNOWN), '.4f'),
            'Fraction without model': _digits(without_model, '.4f'),
            'Label certainty': _digits(certainty, '.3f'),
            'Candidates': str(fit.n_candidates),
            'Inliers': str(fit.n_inliers),
            **_pose_values(scan.pose),
            'Noise (m)': _digits(fit.theta.get('sigma_n'), '.4g'),
            'Learning mode': fit.mode,
            'Learned since startup': str(self._n_learned),
            'Optimiser status': fit.status,
            'Evaluations': str(fit.n_evaluations),
            'At bound': ' '.join(fit.at_bound) or 'none',
            'Objective per candidate': _digits(fit.objective * per_candidate, '.4f'),
            **{f'theta {name}': f'{value:.4g}' for name, value in fit.theta.items()},
        }
        return Status('model', *_judge_model(scan, quality, limits), values)


def _judge_model(scan: Segmentation, quality: float, limits: DiagnosticsConfig) -> Finding:
    message = f'frame quality {quality:.2f}'
    doubtful = (*scan.pose.contradictions, *_pose_warnings(scan))
    if doubtful:
        message = '; '.join(doubtful)
    elif not scan.fit.n_segments:
        message = 'no ground found in the newest cloud'
    elif scan.fit.status == 'failed':
        message = 'the hyper-parameters could not be learned'
    elif quality < limits.min_quality:
        message += f', below {limits.min_quality:g}'
    else:
        return Level.OK, message
    return Level.WARN, message


def kept_height(pose: SensorPose) -> str:
    """Say that a cloud has the pose of an earlier one."""
    return (
        'the cloud does not show the ground near the sensor well: the height of '
        f'{pose.height:.2f} m of an earlier one is kept; set sensor.height'
    )


def _pose_warnings(scan: Segmentation) -> tuple[str, ...]:
    """Warnings of the pose used; an empty cloud has none."""
    if not scan.label.any():
        return ()
    return (kept_height(scan.pose),) if scan.pose.is_fallback else scan.pose.warnings


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


class OutputTask:
    """Messages per topic."""

    def __init__(self) -> None:
        self._rates: defaultdict[str, Rate] = defaultdict(Rate)

    def published(self, now: float, topics: Sequence[str]) -> None:
        """Count one message on each of the `topics`."""
        for topic in topics:
            self._rates[topic].count(now)

    def report(self, now: float, n_subscribers: Mapping[str, int]) -> Status:
        """List all topics, with their subscribers."""
        values = {}
        for topic, n in n_subscribers.items():
            values[f'{topic} subscribers'] = str(n)
            values[f'{topic} rate (Hz)'] = _digits(self._rates[topic].window(now)[2], '.2f')
            values[f'{topic} since startup'] = str(self._rates[topic].n_total)
        heard = [topic for topic, n in n_subscribers.items() if n]
        message = f'subscribed to: {", ".join(heard)}' if heard else 'nobody subscribes'
        return Status('output', Level.OK, message, values)


State = tuple[InputFacts, Mapping[str, int]]
"""State of the input, and the number of subscribers of each output topic."""


class Diagnostics:
    """The four tasks of `node`, published every ``diagnostics.period``."""

    def __init__(self, node: Node, state: Callable[[], State], limits: DiagnosticsConfig) -> None:
        self.input = InputTask(time.monotonic())
        self.processing, self.model, self.output = ProcessingTask(), ModelTask(), OutputTask()
        self._node, self._state, self._limits = node, state, limits
        self._hysteresis: defaultdict[str, Hysteresis] = defaultdict(Hysteresis)
        self._logged, self._n_logged = -np.inf, '0'
        self._publisher = node.create_publisher(DiagnosticArray, '/diagnostics', 10)
        self._timer = node.create_timer(limits.period, self._publish, clock=STEADY_CLOCK)

    def configure(self, limits: DiagnosticsConfig) -> None:
        """Use `limits` from now on; with another period, the next report comes after it."""
        if limits.period != self._limits.period:
            self._timer.timer_period_ns = round(1e9 * limits.period)
            self._timer.reset()
        self._limits = limits

    def report(self, now: float) -> list[Status]:
        """Return the status of each task."""
        (facts, n_subscribers), limits = self._state(), self._limits
        found = (
            self.input.report(now, facts, limits),
            self.processing.report(now, limits),
            self.model.report(limits),
            self.output.report(now, n_subscribers),
        )
        self._log(now, {name: text for status in found for name, text in status.values.items()})
        return [self._hysteresis[s.task].hold(now, s, limits.recover_after) for s in found]

    def _log(self, now: float, values: Mapping[str, str]) -> None:
        """Log that the node works, if it has processed clouds since the last such line."""
        n = values['Clouds since startup']
        if n == self._n_logged or now - self._logged < LOG_PERIOD:
            return
        self._logged, self._n_logged = now, n
        self._node.get_logger().info(
            f'{n} clouds segmented so far, {values["Actual frequency (Hz)"]} Hz, '
            f'median latency {values["Latency p50 (ms)"]} ms, '
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


def _percentiles(name: str, seconds: Sequence[float]) -> dict[str, str]:
    percents = (50, 95, 99) if seconds else ()
    return {f'{name} p{q} (ms)': f'{1e3 * np.percentile(seconds, q):.2f}' for q in percents}
