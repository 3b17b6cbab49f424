"""Result of segmenting a scan."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple, TypeVar

import numpy as np
import numpy.typing as npt

from gp_ground_seg.core.errors import ConfigError, in_thousands
from gp_ground_seg.core.frame import (
    BoolArray,
    Candidates,
    FloatArray,
    Frame,
    GroundSurface,
    Label,
    Labelled,
    Lines,
    PointArray,
    PolarGrid,
    PseudoInputs,
    at_points,
    usual_errors,
)
from gp_ground_seg.core.gp.ground import posterior_covariance
from gp_ground_seg.core.gp.learning import Learned, theta_names
from gp_ground_seg.core.parameters.config import Config
from gp_ground_seg.core.pipeline.labels import ground_probability
from gp_ground_seg.core.pipeline.relief import Relief
from gp_ground_seg.core.pipeline.residuals import CorrectedSurface, correct_surface
from gp_ground_seg.core.pipeline.sensor_pose import SensorPose

LEAST_GROUND = 0.001
"""Share of the points below which next to nothing of a scan is ground."""
WITHIN_STD = 0.6827
"""Share of normally distributed values within one standard deviation of their mean."""
NO_GROUND = 'next to nothing of the scan is ground: is sensor.height right, and z up?'

_Value = TypeVar('_Value')


def cached_property(compute: Callable[[Any], _Value]) -> functools.cached_property[_Value]:
    """``functools.cached_property``, computed whatever ``np.seterr`` the caller has."""
    return functools.cached_property(usual_errors()(compute))


@dataclass(frozen=True)
class FitReport:
    """Outcome of the learning and of the inlier growth.

    - `mode`: ``learning.mode``; `backend`: ``numba`` or ``numpy``
    - `status`: ``converged``, ``budget``, ``failed``; ``kept``: nothing was learned on this frame
    - `n_evaluations` of the objective; `objective` per inlier at the end, NaN if ``kept``
    - `theta`: values, not logarithms: sigma_f, sigma_n, sigma_l_bar [m], sigma_f_bar, sigma_n_bar,
      and the factor on lines' length-scales, or one for each class; `at_bound`: those at a bound
    - `n_segments` with a model, `n_candidates`, `n_inliers` that the surface rests on, `n_lines`
      among the candidates, `n_pseudo_inputs` of the latent process
    """

    mode: str
    status: str
    n_evaluations: int
    objective: float
    theta: dict[str, float]
    at_bound: tuple[str, ...]
    n_segments: int
    n_candidates: int
    n_inliers: int
    n_lines: int
    n_pseudo_inputs: int
    backend: str


class Segment(NamedTuple):
    """One segment of a scan: what the processes of the paper observe, and what they predict.

    Ranges are horizontal, from the sensor; heights are over it, along the vertical: its z axis if
    ``pose`` has no tilt. With the preset ``paper`` `mean` and `cov` are equations 6 and 7; else
    neighbours, relief, a sloping mean and weights of the inliers act on them too.

    - `r`, `z`, `inlier` (C,): range and height of candidates [m]; does the surface rest on them?
    - `pseudo_r`, `pseudo_l` (P,): range and length-scale of the latent pseudo-inputs [m]
    - `knots`, `mean`, `std`, `length_scale` (K,): ranges of prediction; height of the ground,
      its standard deviation, length-scale of the kernel there [m]; none without a model
    - `cov` (K, K): posterior covariance of these heights [m^2]; its diagonal is ``std**2``
    """

    r: FloatArray
    z: FloatArray
    inlier: BoolArray
    pseudo_r: FloatArray
    pseudo_l: FloatArray
    knots: FloatArray
    mean: FloatArray
    std: FloatArray
    cov: FloatArray
    length_scale: FloatArray


@dataclass(frozen=True, eq=False, repr=False)
class Segmentation:
    """A segmented scan; per-point arrays are in input order.

    Two are equal only if they are the same object: compare their arrays. `grid`, `frame` and
    `surface` are intermediate results, for plots and diagnostics, in the level frame.
    """

    #: labels, and what decides them: heights over `surface`, margins
    labelled: Labelled
    timings: dict[str, float]  #: seconds per stage, and ``total``
    learned: Learned  #: outcome of the learning; `fit` sums it up
    backend: str  #: ``numba`` or ``numpy``
    grid: PolarGrid  #: cell of each point
    frame: Frame  #: what the processes are fitted to
    #: the surface of the process, which decides the labels; `height` comes from `corrected`
    surface: GroundSurface
    #: (M, K) log length-scale at the K knots of the surface [log m]; NaN in segments without
    #: candidates
    log_length_scale: FloatArray
    #: height and tilt of the sensor that were used, and what the scan shows of them;
    #: ``pose.level(xyz)`` gives points in the level frame
    pose: SensorPose
    relief: Relief  #: height of the terrain in plan; those in `frame` and `surface` are over it
    z: PointArray  #: (N,) height of each point in the sensor frame [m]
    config: Config  #: parameters of the frame (those given, with narrower gates for a low sensor)

    @property
    def theta(self) -> FloatArray:
        """Logarithms of the hyper-parameters, (T,) float64, named by `theta_names`."""
        return self.learned.theta

    @property
    def candidates(self) -> Candidates:
        """Ground candidates that the lines were found in."""
        return self.frame.candidates

    @property
    def lines(self) -> Lines:
        """Lines through the candidates."""
        return self.frame.lines

    @property
    def pseudo(self) -> PseudoInputs:
        """Pseudo-inputs on the lines."""
        return self.frame.pseudo

    @property
    def label(self) -> npt.NDArray[np.uint8]:
        """`gp_ground_seg.Label` of each point, (N,) uint8.

        Returns are GROUND or OBSTACLE, and OBSTACLE where there is no model. Points that are not
        finite, or exactly at the sensor, are UNKNOWN.
        """
        return self.labelled.label

    @property
    def is_ground(self) -> BoolArray:
        """Whether each point is GROUND, (N,)."""
        # Comparing with an enumeration is five times slower.
        return np.asarray(self.label == int(Label.GROUND))

    def __repr__(self) -> str:
        """One line: a scan has too many numbers to print."""
        _, n_ground, n_obstacle = map(in_thousands, np.bincount(self.label, minlength=3))
        return (
            f'<Segmentation of {in_thousands(len(self.label))} points: {n_ground} ground, '
            f'{n_obstacle} obstacle; origin {self.pose.height:.2f} m over the ground>'
        )

    @property
    def margin(self) -> FloatArray:
        """Distance of each point to the nearer edge of the band that is ground, (N,) float64 [m].

        Not negative for ground; NaN where there is no model.
        """
        return self.labelled.margin.astype(np.float64)

    @property
    def warnings(self) -> tuple[str, ...]:
        """Warnings for the user, a line for each; logged by the segmenter."""
        n_finite = np.count_nonzero(self.label)  # UNKNOWN is 0
        if not n_finite:
            return ()
        is_lost = np.count_nonzero(self.is_ground) < LEAST_GROUND * n_finite
        return (*self.pose.warnings, *((NO_GROUND,) if is_lost else ()))

    def segment(self, m: int) -> Segment:
        """Candidates, pseudo-inputs and ground of segment `m`, counter-clockwise from -x.

        The surface is the process's own, that of the labels; `corrected` is without the bias of
        lowest points. Raises a ConfigError if there is no such segment.
        """
        n_segments = self.grid.n_segments
        if not 0 <= m < n_segments:
            raise ConfigError(f'segment {m}: must be in [0, {n_segments - 1}]')
        surface, own = self.surface, self.candidates.segment == m
        known = np.isfinite(surface.mean[m])
        knots, candidates = surface.knots[known], self.candidates.where(own)
        is_latent = self.config.length_scale.model == 'latent'
        bar = slice(*self.pseudo.offsets[m : m + 2]) if is_latent else slice(0)
        l_bar = self.pseudo.log_extent[bar] + self.theta[5 + self.pseudo.kind[bar]]
        return Segment(
            candidates.r,
            candidates.z + self.relief.at(candidates.x, candidates.y),
            surface.inlier[own],
            self.pseudo.r_bar[bar],
            np.exp(l_bar),
            knots,
            surface.mean[m, known] + self.relief.at_knots(knots, n_segments)[m],
            surface.std[m, known],
            posterior_covariance(self.frame, self.theta, self.config, surface, m),
            np.exp(self.log_length_scale[m, known]),
        )

    # What follows is computed when it is first asked for: not every user asks.

    @cached_property
    def fit(self) -> FitReport:
        """Outcome of the learning and of the inlier growth."""
        learned = self.learned
        values, names = np.exp(learned.theta), theta_names(len(learned.theta))
        n_inliers = int(self.surface.inlier.sum())
        return FitReport(
            mode='fixed' if learned.status == 'kept' else 'every_frame',
            status=learned.status,
            n_evaluations=learned.n_evaluations,
            objective=learned.objective / n_inliers if n_inliers else float('nan'),
            theta={name: float(value) for name, value in zip(names, values, strict=True)},
            at_bound=tuple(n for n, hit in zip(names, learned.at_bound, strict=True) if hit),
            n_segments=int(np.isfinite(self.surface.mean[:, 0]).sum()),
            n_candidates=len(self.candidates.r),
            n_inliers=n_inliers,
            n_lines=len(self.lines.slope),
            n_pseudo_inputs=len(self.pseudo.r_bar),
            backend=self.backend,
        )

    @cached_property
    def corrected(self) -> CorrectedSurface:
        """The ground without the bias of lowest points; its deviations are from its residuals.

        See `gp_ground_seg.core.pipeline.residuals.correct_surface`. The relief is that in the
        middle of each segment.
        """
        noise_std, slope_std = float(np.exp(self.theta[1])), self.config.observation.slope_std
        found = correct_surface(self.surface, self.labelled, self.grid, noise_std, slope_std)
        relief = self.relief.at_knots(found.knots, self.grid.n_segments)
        return found._replace(mean=found.mean + relief)

    @cached_property
    def height(self) -> FloatArray:
        """Height of each point over the ground, (N,) float64 [m]; negative below it.

        NaN where there is no model. Vertical in the level frame, like `ground_std`; where
        `pose` has no tilt, that is the sensor's own, and the height is ``z - ground_z``. The
        labels follow from ``labelled.height``, which is that over the uncorrected `surface`.
        """
        return self.labelled.height - self._at_points(self.corrected.correction)

    @cached_property
    def ground_z(self) -> FloatArray:
        """Height of the ground under each point along the sensor's z axis, (N,) float64 [m].

        In the sensor frame; NaN where there is no model. Without tilt ``z - height``;
        with it ``z - height / cos(tilt)``, exact where the ground is level (see
        `gp_ground_seg.core.pipeline.sensor_pose.SensorPose.ground_z`).
        """
        return self.pose.ground_z(self.z, self.height)

    @cached_property
    def ground_std(self) -> FloatArray:
        """Standard deviation of the height of the ground, (N,) float64 [m]; NaN without a model.

        It grows with the distance to the nearest return called ground.
        """
        return self._at_points(self.corrected.std)

    @cached_property
    def return_std(self) -> FloatArray:
        """Standard deviation of the height of a ground return, (N,) float64 [m].

        About `ground_z`: surface, roughness and range noise together. NaN without a model. A few
        large errors make their root mean square too wide: it is scaled until as many returns
        called ground are within it as in a normal distribution, to a hundredth.
        """
        rms, own = self._at_points(self.corrected.return_rms), self.is_ground
        errors = np.abs(self.height[own]) / rms[own]
        # Backends differ in labels of a few returns: they do not move a hundredth.
        scale = np.round(np.quantile(errors, WITHIN_STD), 2) if len(errors) else 1.0
        return np.maximum(scale * rms, self.ground_std)

    def _at_points(self, table: FloatArray) -> FloatArray:
        return at_points(self.surface.knots, table, self.grid).astype(np.float64)

    @cached_property
    def p_ground(self) -> npt.NDArray[np.float32]:
        """Probability that each point is ground, (N,) float32.

        At least 0.5 for points labelled ground; 0 where there is no model, NaN for
        points that are not finite.
        """
        result = ground_probability(self.margin, self._at_points(self.surface.std))
        result[self.label == Label.UNKNOWN] = np.nan
        return result
