"""Stage 5: hyper-parameters by maximum a posteriori over the whole frame (paper, section III-E).

Theta is a vector of logarithms: sigma_f, sigma_n, sigma_f_bar, sigma_l_bar, sigma_n_bar, then a
factor on the length-scales that the lines suggest, or with ``learning.length_scale = classes`` one
for each class of lines. All segments of a frame share it.

The search is a quasi-Newton one in plain loops, which are compiled too, with the steps of BFGS.
Divided by the number of data, the curvature in the logarithm of a standard deviation is about one:
the first step is of a sensible size (the paper's scaled gradient-based optimisation). SciPy's
L-BFGS-B takes longer between two evaluations than most evaluations take.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from gp_ground_seg.core.frame import BoolArray, FloatArray, Frame, Inliers
from gp_ground_seg.core.gp.evidence import Evidence
from gp_ground_seg.core.gp.ground import grow_inliers
from gp_ground_seg.core.gp.kernels import single_threaded_blas
from gp_ground_seg.core.gp.latent import given_theta, latent_log_length_scales
from gp_ground_seg.core.gp.likelihood import log_likelihood
from gp_ground_seg.core.gp.model import Model, SegmentSurfaces
from gp_ground_seg.core.jit import shared
from gp_ground_seg.core.parameters.config import Config, ObservationConfig
from gp_ground_seg.core.pipeline.lines import N_CLASSES, class_middles

THETA_NAMES = (
    'sigma_f', 'sigma_n', 'sigma_f_bar', 'sigma_l_bar', 'sigma_n_bar', 'length_scale_factor'
)  # fmt: skip
"""Entries of theta; with classes the last one is there for each, numbered."""

WIDEST = 5.0
"""Distance from the given value to the bounds, in standard deviations of the prior."""
AT_BOUND = 1e-6
"""Distance to a bound at which an entry counts as at it."""
BUDGET, CONVERGED, FAILED = range(3)
STATUSES = ('budget', 'converged', 'failed')
"""How a learning ended; failed: no finite objective was found."""
LEVEL = 1e-3
"""Gradient below which the objective counts as level."""
NO_GAIN = 1e-7
"""Gain below which a step was the last."""
LONGEST_STEP = 1.0
SHRINK = 0.3
"""Factor on a step that made things worse."""
SHORTEST = SHRINK**3
"""Factor on a step below which the search goes along the slope instead."""


class ThetaSpace(NamedTuple):
    """Bounds and priors of the hyper-parameters, all in log space."""

    centre: FloatArray  # (T,) values given by the configuration; centres of the priors
    lower: FloatArray  # (T,) bounds
    upper: FloatArray
    free: BoolArray  # (T,) entries that are learned
    prior_std: float  # standard deviation of the priors


def theta_names(n: int) -> tuple[str, ...]:
    """Names of the `n` entries of theta."""
    *names, factor = THETA_NAMES
    numbered = (f'{factor}_{k}' for k in range(1, N_CLASSES + 1))
    return THETA_NAMES if n == len(THETA_NAMES) else (*names, *numbered)


@lru_cache(maxsize=4)
def theta_space(config: Config) -> ThetaSpace:
    """Bounds, priors and free entries by the configuration; not to be written to."""
    learning, centre = config.learning, given_theta(config)
    width = WIDEST * learning.prior_std
    free = np.ones(len(centre), dtype=np.bool_)
    if config.length_scale.model != 'latent' or learning.fixed == 'length_scales':
        free[2:] = False
    elif learning.fixed == 'latent':
        free[2:5] = False
    elif learning.fixed == 'sigma_f_bar':
        free[2] = False
    lower, upper = centre - width, centre + width
    if learning.length_scale == 'classes':
        limits = config.length_scale
        lower[5:] = math.log(limits.min) - class_middles(limits)
        upper[5:] = math.log(limits.max) - class_middles(limits)
    return ThetaSpace(centre, lower, upper, free, learning.prior_std)


class Learned(NamedTuple):
    """Outcome of one learning."""

    theta: FloatArray  # (T,) best hyper-parameters evaluated, log space
    objective: float  # there, with the priors if any
    n_evaluations: int  # of objective and gradient
    status: str  # one of `STATUSES`; 'kept' where nothing was learned
    at_bound: BoolArray  # (T,) free entries that ended at a bound

    @classmethod
    def of(
        cls, theta: FloatArray, objective: float, n: int, status: int, space: ThetaSpace
    ) -> Learned:
        """Outcome of `n` evaluations, with `status` as its place in `STATUSES`."""
        near_bound = (theta <= space.lower + AT_BOUND) | (theta >= space.upper - AT_BOUND)
        at_bound = space.free & near_bound & (n > 0)
        return cls(theta, objective, n, STATUSES[status], at_bound)

    @classmethod
    def given(cls, config: Config) -> Learned:
        """Values given by the configuration, and nothing learned."""
        theta = given_theta(config)
        return cls(theta, math.nan, 0, 'kept', np.zeros(len(theta), np.bool_))


def learn_frame(frame: Frame, config: Config, fit: Callable[..., int] | None = None) -> Learned:
    """Learn theta on the inliers that grow under the values given, of some segments.

    These are every ``learning.segment_step``-th, each by itself. `fit` is `fit_theta`, compiled.
    """
    space, theta, outcome = theta_space(config), given_theta(config), np.empty(2)
    no_knots = frame._replace(knots=frame.knots[:0])
    found = SegmentSurfaces.to_be_set(no_knots, config)
    n = (fit or single_threaded_blas()(fit_theta))(
        no_knots, space, Model.of(no_knots, config), found, theta, outcome
    )
    return Learned.of(theta, float(outcome[0]), n, int(outcome[1]), space)


@shared
def fit_theta(
    frame: Frame,
    space: ThetaSpace,
    model: Model,
    found: SegmentSurfaces,
    theta: FloatArray,
    outcome: FloatArray,
) -> int:
    """Set `theta` (T,), which holds the given values; for `outcome` and the result see `maximise`.

    The frame has no knots; `found` is overwritten.
    """
    learning, step = model.learning, model.learning.segment_step
    u, knot_u = found.log_length_scale, found.knot_log_length_scale
    if model.is_latent:
        latent_log_length_scales(frame, theta, step, u, knot_u)
    nothing = Evidence(np.empty((0, 0)), np.empty((0, 0)))
    grow_inliers(frame, theta, model, nothing, step, found)
    inliers = take_inliers(frame, step, bool(space.free[2:].any()), found)
    budget = learning.max_evaluations
    return maximise(space, inliers, model.observation, model.is_map, budget, theta, outcome)


@shared
def take_inliers(frame: Frame, step: int, has_latent: bool, found: SegmentSurfaces) -> Inliers:
    """Inliers of every `step`-th segment; with `has_latent` pseudo-inputs give length-scales."""
    candidates, pseudo, n = frame.candidates, frame.pseudo, 0
    offsets = np.zeros(len(candidates.offsets), np.int64)
    own = np.empty(len(candidates.r), np.int64)
    for m in range(len(offsets) - 1):
        if m % step == 0:
            for c in range(candidates.offsets[m], candidates.offsets[m + 1]):
                if found.inlier[c]:
                    own[n] = c
                    n += 1
        offsets[m + 1] = n
    own = own[:n]
    return Inliers(
        offsets,
        candidates.r[own],
        candidates.z[own] - frame.prior_mean,
        found.log_length_scale[own],
        pseudo.offsets if has_latent else np.zeros(len(offsets), np.int64),
        pseudo.r_bar,
        pseudo.log_extent,
        pseudo.kind,
    )


@shared
def maximise(
    space: ThetaSpace,
    inliers: Inliers,
    observation: ObservationConfig,
    is_map: bool,
    max_evaluations: int,
    theta: FloatArray,
    outcome: FloatArray,
) -> int:
    """Maximise likelihood, and with `is_map` log priors, from `theta` (T,), within the bounds.

    The best theta so far replaces `theta` after `max_evaluations`. Sets `outcome` (2,) to the
    objective and the place of the status in `STATUSES`, and returns the number of evaluations.
    """
    n_data, any_free = len(inliers.r), False
    lower, upper = np.empty(len(theta)), np.empty(len(theta))
    for i in range(len(theta)):
        theta[i] = min(max(theta[i], space.lower[i]), space.upper[i])
        any_free |= space.free[i]
        lower[i] = space.lower[i] if space.free[i] else theta[i]
        upper[i] = space.upper[i] if space.free[i] else theta[i]
    outcome[0], outcome[1] = -math.inf, CONVERGED
    if n_data == 0 or not any_free:
        return 0
    d, start = len(theta), np.array([-math.inf, 1.0])
    search = Search(
        lower, upper, theta.copy(), np.zeros(d), theta.copy(), np.empty(d), np.eye(d), start
    )
    n_evaluations, status = 0, BUDGET
    while n_evaluations < max_evaluations:
        for i in range(len(theta)):
            theta[i] = search.trial[i]
        value, slope = log_likelihood(theta, inliers, observation, not is_map)
        for i in range(len(theta)):
            if not space.free[i]:
                slope[i] = 1.0  # it stays at its upper bound
                continue
            if is_map:
                deviation = (theta[i] - space.centre[i]) / space.prior_std
                value -= 0.5 * deviation * deviation
                slope[i] -= deviation / space.prior_std
            slope[i] /= n_data
        n_evaluations += 1
        if n_evaluations == 1 and not math.isfinite(value):
            status = FAILED
            break
        if take_outcome(search, value / n_data, slope) or not propose(search):
            status = CONVERGED
            break
    for i in range(len(theta)):
        theta[i] = search.x[i]
    outcome[0], outcome[1] = search.value[0] * n_data, status
    return n_evaluations


class Search(NamedTuple):
    """Where a search in d dimensions is; its functions change the arrays.

    The caller evaluates the objective at `trial` and gives the outcome to `take_outcome`; then
    `propose` sets the next trial.
    """

    lower: FloatArray  # (d,) bounds
    upper: FloatArray
    x: FloatArray  # (d,) the best place so far
    gradient: FloatArray  # (d,) there
    trial: FloatArray  # (d,) where the objective is wanted
    turned: FloatArray  # (d,) working space
    inverse: FloatArray  # (d, d) of the negative curvature
    value: FloatArray  # (2,) at the best place; factor on the next step


@shared
def take_outcome(search: Search, value: float, gradient: FloatArray) -> bool:
    """Take value and gradient of the objective at the trial; return whether that was the last.

    A value of ``-inf`` or NaN is worse than any.
    """
    x, inverse, trial, turned = search.x, search.inverse, search.trial, search.turned
    d, bent = len(x), search.gradient
    gain = value - search.value[0]
    if not gain > 0.0:
        search.value[1] *= SHRINK
        if search.value[1] < SHORTEST:
            search.value[1] = 1.0
            for i in range(d):
                for j in range(d):
                    inverse[i, j] = SHORTEST if i == j else 0.0
        return False
    for i in range(d):
        bent[i] -= gradient[i]
    along = across = 0.0
    for i in range(d):
        along += (trial[i] - x[i]) * bent[i]
        turned[i] = 0.0
        for j in range(d):
            turned[i] += inverse[i, j] * bent[j]
        across += bent[i] * turned[i]
    if along > 0.0:
        for i in range(d):
            moved = trial[i] - x[i]
            for j in range(d):
                beside = trial[j] - x[j]
                inverse[i, j] += (along + across) / (along * along) * moved * beside
                inverse[i, j] -= (turned[i] * beside + moved * turned[j]) / along
    for i in range(d):
        x[i], search.gradient[i] = trial[i], gradient[i]
    search.value[0], search.value[1] = value, 1.0
    return bool(gain < NO_GAIN)


@shared
def propose(search: Search) -> bool:
    """Set the next trial; return False where the objective is level, up to the bounds."""
    x, gradient, trial, d = search.x, search.gradient, search.trial, len(search.x)
    is_held, steepest, longest = np.zeros(d, np.bool_), 0.0, 0.0
    for i in range(d):
        is_held[i] = (x[i] <= search.lower[i] and gradient[i] < 0.0) or (
            x[i] >= search.upper[i] and gradient[i] > 0.0
        )
        if not is_held[i]:
            steepest = max(steepest, abs(gradient[i]))
    if steepest < LEVEL:
        return False
    for i in range(d):
        trial[i] = 0.0
        for j in range(d):
            if not (is_held[i] or is_held[j]):
                trial[i] += search.inverse[i, j] * gradient[j]
        longest = max(longest, abs(trial[i]))
    factor = search.value[1] * min(1.0, LONGEST_STEP / longest)
    for i in range(d):
        trial[i] = min(max(x[i] + factor * trial[i], search.lower[i]), search.upper[i])
    return True
