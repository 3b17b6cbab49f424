"""What the newest scan's ground model is worth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gp_ground_seg.frame import BoolArray, Label
from gp_ground_seg.parameters.config import DiagnosticsConfig
from gp_ground_seg.pipeline.sensor_pose import SensorPose
from gp_ground_seg.result import FitReport, Segmentation
from gp_ground_seg.ros.health.status import Level, Status, in_digits

TASK = 'model'


@dataclass(frozen=True)
class ModelFacts:
    """A segmentation in numbers.

    Attributes
    ----------
    fit : FitReport
        What the learning did.
    pose : SensorPose
        Where the sensor was taken to be.
    n_segments : int
        Segments of the grid.
    n_occupied : int
        Those that hold ground candidates.
    ground, unknown, without_model : float
        Shares of the points that are labelled GROUND, labelled UNKNOWN, and that are
        finite but have no model under them. NaN without points.
    certainty : float
        Mean certainty of the labels over the model, 1 = sure of all; NaN where unknown.
    """

    fit: FitReport
    pose: SensorPose
    n_segments: int
    n_occupied: int
    ground: float
    unknown: float
    without_model: float
    certainty: float

    @classmethod
    def of(cls, segmentation: Segmentation) -> ModelFacts:
        """Sum up one scan."""
        label = segmentation.label
        n_points = len(label)
        n_ground = np.count_nonzero(label == Label.GROUND)
        n_unknown = np.count_nonzero(label == Label.UNKNOWN)
        has_model = np.isfinite(segmentation.ground_z)
        n_without = np.count_nonzero(~has_model & (label != Label.UNKNOWN))
        candidates = segmentation.candidates
        return cls(
            fit=segmentation.fit,
            pose=segmentation.pose,
            n_segments=len(segmentation.surface.mean),
            n_occupied=int(np.count_nonzero(np.diff(candidates.offsets))),
            ground=n_ground / n_points if n_points else np.nan,
            unknown=n_unknown / n_points if n_points else np.nan,
            without_model=n_without / n_points if n_points else np.nan,
            certainty=_certainty(segmentation, has_model),
        )

    @property
    def quality(self) -> float:
        """How much the frame can be relied on, from 0 to 1.

        The product of three shares: segments with a model among those that hold
        candidates, candidates that the surface explains, certainty of the labels
        (where that is known). 0 without any model, and where the learning failed.
        """
        fit = self.fit
        if fit.status == 'failed' or not fit.n_candidates or not self.n_occupied:
            return 0.0
        covered = min(1.0, fit.n_segments / self.n_occupied)
        certainty = 1.0 if np.isnan(self.certainty) else self.certainty
        return covered * fit.n_inliers / fit.n_candidates * certainty


class ModelStatistics:
    """Keeps the newest scan; what it was worth is worked out only for a report."""

    def __init__(self) -> None:
        self._newest: Segmentation | None = None
        self._n_learned = 0

    def segmented(self, segmentation: Segmentation) -> None:
        """Take note of a scan."""
        self._newest = segmentation
        self._n_learned += segmentation.fit.n_evaluations > 0

    def report(self, limits: DiagnosticsConfig) -> Status:
        """Judge the newest scan."""
        if self._newest is None:
            return Status(TASK, Level.OK, 'no cloud segmented yet', {})
        facts = ModelFacts.of(self._newest)
        level, message = _judge(facts, limits)
        fit = facts.fit
        per_candidate = fit.n_inliers / fit.n_candidates if fit.n_candidates else np.nan
        values = {
            'frame_quality': f'{facts.quality:.3f}',
            'Segments with a model': f'{fit.n_segments} of {facts.n_segments}',
            'Segments with candidates': str(facts.n_occupied),
            'Ground fraction': in_digits(facts.ground, '.4f'),
            'Unknown fraction': in_digits(facts.unknown, '.4f'),
            'Fraction without model': in_digits(facts.without_model, '.4f'),
            'Label certainty': in_digits(facts.certainty, '.3f'),
            'Candidates': str(fit.n_candidates),
            'Inliers': str(fit.n_inliers),
            **_pose_values(facts.pose),
            'Noise (m)': in_digits(fit.theta.get('sigma_n'), '.4g'),
            'Learning mode': fit.mode,
            'Learned since startup': str(self._n_learned),
            'Optimiser status': fit.status,
            'Evaluations': str(fit.n_evaluations),
            'At bound': ' '.join(fit.at_bound) or 'none',
            'Objective per candidate': in_digits(fit.objective * per_candidate, '.4f'),
            **{f'theta {name}': f'{value:.4g}' for name, value in fit.theta.items()},
        }
        return Status(TASK, level, message, values)


def _judge(facts: ModelFacts, limits: DiagnosticsConfig) -> tuple[Level, str]:
    if facts.pose.contradictions:
        return Level.WARN, '; '.join(facts.pose.contradictions)
    if not facts.fit.n_segments:
        return Level.WARN, 'no ground found in the newest cloud'
    if facts.fit.status == 'failed':
        return Level.WARN, 'the hyper-parameters could not be learned'
    if facts.quality < limits.min_quality:
        return Level.WARN, f'frame quality {facts.quality:.2f}, below {limits.min_quality:g}'
    return Level.OK, f'frame quality {facts.quality:.2f}'


def _pose_values(pose: SensorPose) -> dict[str, str]:
    is_estimated = {
        'height': pose.height_estimated,
        'roll': pose.roll_estimated,
        'pitch': pose.pitch_estimated,
    }
    values = {
        'Sensor height (m)': f'{pose.height:.4f}',
        'Sensor roll (rad)': f'{pose.roll:.4f}',
        'Sensor pitch (rad)': f'{pose.pitch:.4f}',
        'Taken from the scan': ' '.join(n for n, yes in is_estimated.items() if yes) or 'nothing',
    }
    seen = pose.measured
    height = seen.height if seen and seen.tells_height else None
    roll, pitch = (seen.roll, seen.pitch) if seen and seen.tells_tilt else (None, None)
    for name, value in (('height (m)', height), ('roll (rad)', roll), ('pitch (rad)', pitch)):
        values[f'Estimated {name}'] = in_digits(value, '.4f')
    return values


def _certainty(segmentation: Segmentation, has_model: BoolArray) -> float:
    p_ground = getattr(segmentation, 'p_ground', None)
    if p_ground is None or not has_model.any():
        return np.nan
    return float(np.abs(2.0 * p_ground[has_model] - 1.0).mean())
