"""Stage 5: hyper-parameters by maximum a posteriori over the whole frame (paper, section III-E).

Theta is a vector of logarithms: sigma_f, sigma_n, sigma_f_bar, sigma_l_bar, sigma_n_bar, then the
length-scale of each surface class. A frame has one row of it per segment; learned over the whole
frame, the rows are equal.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple, Protocol

import numpy as np
from scipy.optimize import minimize

from gp_ground_seg.frame import BoolArray, FloatArray, Frame, GroundSurface, Inliers
from gp_ground_seg.gp.latent import given_log_length_scales
from gp_ground_seg.gp.linalg import single_threaded_blas
from gp_ground_seg.parameters.config import Config

THETA_NAMES = (
    'sigma_f', 'sigma_n', 'sigma_f_bar', 'sigma_l_bar', 'sigma_n_bar', 'length_scale_factor'
)  # fmt: skip
Objective = Callable[[FloatArray], tuple[float, FloatArray]]

_AT_BOUND = 1e-6


class ThetaSpace(NamedTuple):
    """Bounds and priors of the hyper-parameters, all in log space.

    Attributes
    ----------
    centre : (T,) float64
        Values given by the configuration and the first guess; centres of the priors.
    lower, upper : (T,) float64
        Bounds.
    free : (T,) bool
        Entries that are learned.
    prior_std : float
        Standard deviation of the priors.
    """

    centre: FloatArray
    lower: FloatArray
    upper: FloatArray
    free: BoolArray
    prior_std: float


def theta_centre(config: Config) -> FloatArray:
    """Values given by the configuration and the first guess, (5 + K,), in log space.

    Parameters
    ----------
    config : Config
        Values, and bounds of the length-scale.
    first_guess : (K,) float64
        First guess of the surface classes' log length-scales [log m].
    """
    observation, latent = config.observation, config.latent
    values = (
        observation.sigma_f,
        observation.sigma_n,
        latent.sigma_f_bar,
        latent.sigma_l_bar,
        latent.sigma_n_bar,
        1.0,
    )
    return np.log(values)


def theta_space(config: Config) -> ThetaSpace:
    """Space of theta for a frame; parameters are those of `theta_centre`."""
    learning = config.learning
    centre = theta_centre(config)
    width = np.log(learning.bound_factor)
    lower, upper = centre - width, centre + width
    free = np.ones(len(centre), dtype=np.bool_)
    if config.length_scale.model != 'latent' or learning.fixed == 'length_scales':
        free[2:] = False
    elif learning.fixed == 'latent':
        free[2:5] = False
    elif learning.fixed == 'sigma_f_bar':
        free[2] = False
    return ThetaSpace(centre, lower, upper, free, learning.prior_std)


def given_theta(frame: Frame, config: Config) -> FloatArray:
    """Theta before anything is learned, the same in every segment, (M, 5 + K)."""
    return np.tile(theta_centre(config), (len(frame.candidates.offsets) - 1, 1))


class Learned(NamedTuple):
    """Outcome of one learning.

    Attributes
    ----------
    theta : (T,) float64
        Best hyper-parameters evaluated, log space.
    objective : float
        Objective there, with the priors if any.
    n_evaluations : int
        Evaluations of objective and gradient.
    status : str
        ``converged``, ``budget`` or ``failed`` (no finite objective found).
    at_bound : (T,) bool
        Free entries that ended at a bound.
    """

    theta: FloatArray
    objective: float
    n_evaluations: int
    status: str
    at_bound: BoolArray


class Model(Protocol):
    """The part of a backend that learning needs, see `gp_ground_seg.backend.Backend`."""

    def estimate_surface(
        self, frame: Frame, theta: FloatArray, config: Config, segment_step: int = 1
    ) -> tuple[GroundSurface, FloatArray]:
        """Inliers under `theta`."""

    def log_likelihood(
        self, theta: FloatArray, inliers: Inliers, slope_std: float, latent_terms: bool
    ) -> tuple[float, FloatArray]:
        """Log marginal likelihood and its gradient."""


@single_threaded_blas()
def learn_frame(
    frame: Frame,
    start: FloatArray,
    config: Config,
    model: Model,
    out_of_time: Callable[[], bool],
) -> tuple[FloatArray, list[Learned]]:
    """Learn theta on the inliers that grow under it.

    Parameters
    ----------
    frame : Frame
        Candidates and pseudo-inputs.
    start : (M, 5 + K) float64
        Where to begin.
    config : Config
        Scope, objective, budget, priors.
    model : Model
        Backend.
    out_of_time : callable
        See `maximise`.

    Returns
    -------
    theta : (M, 5 + K) float64
        Hyper-parameters of each segment.
    learned : list of Learned
        One outcome for the frame, or one for each segment.
    """
    learning = config.learning
    by_frame = learning.scope == 'frame'
    step = learning.segment_step if by_frame else 1
    no_knots = frame.knots[:0]
    surface, _ = model.estimate_surface(frame._replace(knots=no_knots), start, config, step)
    inliers = take_inliers(frame._replace(knots=no_knots), surface.inlier, config)
    is_map = learning.objective == 'map'
    space = theta_space(config)

    def learn(begin: FloatArray, own: Inliers) -> Learned:
        def objective(theta: FloatArray) -> tuple[float, FloatArray]:
            return model.log_likelihood(theta, own, config.observation.slope_std, not is_map)

        return maximise(
            objective,
            space,
            begin,
            len(own.r),
            use_priors=is_map,
            max_evaluations=learning.max_evaluations,
            out_of_time=out_of_time,
        )

    if by_frame:
        learned = [learn(start[0], inliers)]
        return np.tile(learned[0].theta, (len(start), 1)), learned
    learned = [learn(begin, _one_segment(inliers, m)) for m, begin in enumerate(start)]
    return np.array([one.theta for one in learned]), learned


def take_inliers(frame: Frame, inlier: BoolArray, config: Config) -> Inliers:
    """Candidates of the mask `inlier` (C,), with the pseudo-inputs of their segments."""
    candidates, pseudo = frame.candidates, frame.pseudo
    taken = np.concatenate([[0], np.cumsum(inlier)])
    if config.length_scale.model == 'latent':
        u, bar_offsets = np.zeros(int(taken[-1])), pseudo.offsets
    else:
        u = given_log_length_scales(frame, config.length_scale)[0][inlier]
        bar_offsets = np.zeros_like(candidates.offsets)
    return Inliers(
        offsets=taken[candidates.offsets],
        r=candidates.r[inlier],
        z=candidates.z[inlier] - frame.prior_mean,
        log_length_scale=u,
        bar_offsets=bar_offsets,
        r_bar=pseudo.r_bar,
        log_extent=pseudo.log_extent,
    )


def _one_segment(inliers: Inliers, m: int) -> Inliers:
    own = slice(inliers.offsets[m], inliers.offsets[m + 1])
    bar = slice(inliers.bar_offsets[m], inliers.bar_offsets[m + 1])
    return Inliers(
        np.array([0, own.stop - own.start]),
        inliers.r[own],
        inliers.z[own],
        inliers.log_length_scale[own],
        np.array([0, bar.stop - bar.start]),
        inliers.r_bar[bar],
        inliers.log_extent[bar],
    )


class _BudgetSpentError(Exception):
    pass


def maximise(
    objective: Objective,
    space: ThetaSpace,
    start: FloatArray,
    n_data: int,
    *,
    use_priors: bool,
    max_evaluations: int,
    out_of_time: Callable[[], bool],
) -> Learned:
    """Maximise objective plus log priors from `start`, within bounds and budget.

    The variables are scaled by the priors' width and the objective by the number
    of data, so that the first step is of a sensible size (the paper's scaled
    gradient-based optimisation).

    Parameters
    ----------
    objective : callable
        theta -> log marginal likelihood and its gradient; ``-inf`` is allowed.
    space : ThetaSpace
        Bounds, priors, and which entries are free.
    start : (T,) float64
        Where to begin, log space.
    n_data : int
        Number of inliers.
    use_priors : bool
        Whether the log-normal priors are added.
    max_evaluations : int
        Budget; the best theta so far is returned when it is spent.
    out_of_time : callable
        Called before each evaluation after the first; True ends the learning.
    """
    free, scale = space.free, space.prior_std
    begin = np.clip(start, space.lower, space.upper)
    best_theta, best_value, n_evaluations = begin, -np.inf, 0

    def negative(x: FloatArray) -> tuple[float, FloatArray]:
        nonlocal best_theta, best_value, n_evaluations
        if n_evaluations >= max_evaluations or (n_evaluations > 0 and out_of_time()):
            raise _BudgetSpentError
        theta = begin.copy()
        theta[free] = x * scale
        value, gradient = objective(theta)
        n_evaluations += 1
        if use_priors:
            deviation = (theta - space.centre)[free] / scale
            value -= 0.5 * float(deviation @ deviation)
            gradient = gradient.copy()
            gradient[free] -= deviation / scale
        if value > best_value:
            best_theta, best_value = theta, value
        if not np.isfinite(value):
            # Large and level, so that the line search turns back.
            return 1e10, np.zeros(len(x))
        return -value / n_data, -gradient[free] * scale / n_data

    status = 'converged'
    if free.any() and n_data > 0:
        try:
            result = minimize(
                negative,
                begin[free] / scale,
                jac=True,
                method='L-BFGS-B',
                bounds=list(
                    zip(space.lower[free] / scale, space.upper[free] / scale, strict=True)
                ),
                options={'ftol': 1e-6, 'gtol': 1e-5},
            )
            status = 'converged' if result.success else 'budget'
        except _BudgetSpentError:
            status = 'budget'
        if not np.isfinite(best_value):
            status = 'failed'
    near_lower = best_theta <= space.lower + _AT_BOUND
    near_upper = best_theta >= space.upper - _AT_BOUND
    return Learned(best_theta, best_value, n_evaluations, status, free & (near_lower | near_upper))
