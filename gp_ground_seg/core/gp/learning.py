"""Stage 5: hyper-parameters by maximum a posteriori over the whole frame (paper, section III-E).

Theta is a vector of logarithms: sigma_f, sigma_n, sigma_f_bar, sigma_l_bar, sigma_n_bar, then a
factor on the length-scales that the lines suggest, or with ``learning.length_scale = classes`` one
for each class of lines. All segments of a frame share it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple, Protocol

import numpy as np

from gp_ground_seg.core.frame import (
    BoolArray,
    Candidates,
    FloatArray,
    Frame,
    GroundSurface,
    Inliers,
    IntArray,
    PseudoInputs,
)
from gp_ground_seg.core.parameters.config import Config
from gp_ground_seg.core.pipeline.lines import N_CLASSES, class_middles

THETA_NAMES = (
    'sigma_f', 'sigma_n', 'sigma_f_bar', 'sigma_l_bar', 'sigma_n_bar', 'length_scale_factor'
)  # fmt: skip
"""Entries of theta; with classes the last one is there for each, numbered."""
Objective = Callable[[FloatArray], tuple[float, FloatArray]]

WIDEST = 5.0
"""Distance from the given value to the bounds, in standard deviations of the prior."""
FARTHEST_START = 5.0
"""Distance of the start of learning from the given values, at most: a factor of 148."""
_AT_BOUND = 1e-6
_LEVEL = 1e-3
"""Gradient for each datum below which the objective counts as level."""
_NO_GAIN = 1e-7
"""Gain for each datum below which a step was the last."""
_LONGEST_STEP = 1.0
_SHRINK = 0.3
"""Factor on a step that made things worse."""


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


def given_theta(config: Config) -> FloatArray:
    """Values given by the configuration, (T,), in log space; T is 6, with classes 14."""
    observation, latent = config.observation, config.latent
    values = (
        observation.sigma_f,
        observation.sigma_n,
        latent.sigma_f_bar,
        latent.sigma_l_bar,
        latent.sigma_n_bar,
    )
    n_factors = N_CLASSES if config.learning.length_scale == 'classes' else 1
    return np.append(np.log(values), np.zeros(n_factors))


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


def first_theta(frame: Frame, config: Config) -> FloatArray:
    """Where learning begins, (T,), in log space: what the lines show, else the given values.

    sigma_f is the root mean square height, over the prior mean, of the near candidates on
    lines that may be ground. sigma_n follows from the distances of candidates
    to the line through the two beside them. Both are cut at ``growth.seed_height_tolerance``, and
    kept within `FARTHEST_START` of the given values: lines without any noise would make
    covariances singular.
    """
    candidates, lines, growth = frame.candidates, frame.lines, config.growth
    theta, r, line = given_theta(config), candidates.r, lines.line
    is_ground = np.abs(lines.slope) <= growth.max_line_slope
    is_ground &= np.diff(lines.start) >= growth.min_line_size
    height = candidates.z - frame.prior_mean
    may_show = is_ground[line] & (r <= growth.seed_range)
    height = height[may_show]
    inner = np.flatnonzero(line[2:] == line[:-2]) + 1
    share = (r[inner] - r[inner - 1]) / (r[inner + 1] - r[inner - 1])
    z = candidates.z
    missed = z[inner] - (1.0 - share) * z[inner - 1] - share * z[inner + 1]
    missed /= np.sqrt(1.0 + share**2 + (1.0 - share) ** 2)
    for i, values in enumerate((height, missed)):
        values = np.minimum(np.abs(values), growth.seed_height_tolerance)
        mean_square = float(values @ values) / max(len(values), 1)
        if mean_square > 0.0:
            theta[i] = 0.5 * math.log(mean_square)
    given = given_theta(config)
    return np.clip(theta, given - FARTHEST_START, given + FARTHEST_START)


class Learned(NamedTuple):
    """Outcome of one learning."""

    theta: FloatArray  # (T,) best hyper-parameters evaluated, log space
    objective: float  # there, with the priors if any
    n_evaluations: int  # of objective and gradient
    status: str  # ``converged``, ``budget`` or ``failed`` (no finite objective found)
    at_bound: BoolArray  # (T,) free entries that ended at a bound


class Model(Protocol):
    """The part of a backend that learning needs, see `gp_ground_seg.core.backend.Backend`."""

    def estimate_surface(
        self, frame: Frame, theta: FloatArray, config: Config
    ) -> tuple[GroundSurface, FloatArray, FloatArray]:
        """Inliers and log length-scales under `theta`."""

    def log_likelihood(
        self, theta: FloatArray, inliers: Inliers, slope_std: float, latent_terms: bool
    ) -> tuple[float, FloatArray]:
        """Log marginal likelihood and its gradient."""


def learn_frame(frame: Frame, config: Config, model: Model) -> Learned | None:
    """Learn theta on the inliers that grow under it, then on those under what was learned, ...

    It ends when the inliers of a later round are no more than before, or when
    ``learning.max_evaluations`` are spent, of which the first round has half. None if
    ``learning.mode`` is fixed.
    """
    learning, space = config.learning, theta_space(config)
    if learning.mode == 'fixed':
        return None
    thin = every_segment(frame, learning.segment_step)
    has_latent = bool(space.free[2:].any())
    is_map, slope_std = learning.objective == 'map', config.observation.slope_std

    def learn(begin: FloatArray, data: Inliers, budget: int) -> Learned:
        def objective(theta: FloatArray) -> tuple[float, FloatArray]:
            return model.log_likelihood(theta, data, slope_std, not is_map)

        return maximise(
            objective, space, begin, len(data.r), use_priors=is_map, max_evaluations=budget
        )

    none_at_bound = np.zeros_like(space.free)
    learned = Learned(first_theta(frame, config), -math.inf, 0, 'budget', none_at_bound)
    numbers: list[int] = []
    budget = max(learning.max_evaluations // 2, 1)
    while budget > 0:
        surface, _, u = model.estimate_surface(thin, learned.theta, config)
        numbers.append(int(surface.inlier.sum()))
        if len(numbers) > 2 and numbers[-1] <= numbers[-2]:
            break
        found = learn(learned.theta, take_inliers(thin, surface.inlier, u, has_latent), budget)
        learned = found._replace(n_evaluations=learned.n_evaluations + found.n_evaluations)
        budget = learning.max_evaluations - learned.n_evaluations
    return learned


def every_segment(frame: Frame, step: int) -> Frame:
    """Every `step`-th segment of a frame, by itself and without knots."""
    no_knots = frame._replace(knots=frame.knots[:0])
    if step == 1:
        return no_knots
    candidates, pseudo = frame.candidates, frame.pseudo

    def thin(offsets: IntArray) -> tuple[IntArray, IntArray]:
        """Places of the values that are kept, and their offsets."""
        first, stop = offsets[:-1:step], offsets[1::step]
        places = [np.arange(*ends) for ends in zip(first.tolist(), stop.tolist(), strict=False)]
        return np.concatenate(places), np.concatenate([[0], np.cumsum(stop - first)])

    kept, offsets = thin(candidates.offsets)
    kept_bar, bar_offsets = thin(pseudo.offsets)
    return no_knots._replace(
        candidates=Candidates(
            candidates.r[kept],
            candidates.z[kept],
            candidates.bin[kept],
            candidates.density[kept],
            offsets,
            candidates.tile[kept],
            candidates.x[kept],
            candidates.y[kept],
        ),
        lines=frame.lines._replace(line=frame.lines.line[kept]),
        pseudo=PseudoInputs(
            pseudo.r_bar[kept_bar],
            pseudo.log_extent[kept_bar],
            bar_offsets,
            pseudo.kind[kept_bar],
        ),
        continues_line=frame.continues_line[kept],
        in_face=frame.in_face[kept],
    )


def take_inliers(frame: Frame, inlier: BoolArray, u: FloatArray, has_latent: bool) -> Inliers:
    """Inliers of a frame.

    `inlier` (C,) says which candidates they are, `u` (C,) are log length-scales there [log m].
    With `has_latent` the pseudo-inputs go with them, and give the length-scales instead of `u`.
    """
    candidates, pseudo = frame.candidates, frame.pseudo
    taken = np.concatenate([[0], np.cumsum(inlier)])
    return Inliers(
        offsets=taken[candidates.offsets],
        r=candidates.r[inlier],
        z=candidates.z[inlier] - frame.prior_mean,
        log_length_scale=u[inlier],
        bar_offsets=pseudo.offsets if has_latent else np.zeros_like(candidates.offsets),
        r_bar=pseudo.r_bar,
        log_extent=pseudo.log_extent,
        kind=pseudo.kind,
    )


def maximise(
    objective: Objective,
    space: ThetaSpace,
    start: FloatArray,
    n_data: int,
    *,
    use_priors: bool,
    max_evaluations: int,
) -> Learned:
    """Maximise objective plus log priors from `start`, within bounds and budget.

    Quasi-Newton steps (BFGS). Divided by the number of data, the curvature in the logarithm of
    a standard deviation is about one: the first step is of a sensible size (the paper's scaled
    gradient-based optimisation). SciPy's L-BFGS-B takes longer between two evaluations than
    most evaluations take.

    `objective` gives the log marginal likelihood of a theta and its gradient, ``-inf`` is allowed;
    `start` is in log space, `n_data` the number of inliers. The best theta so far is returned
    after `max_evaluations`.
    """
    free, theta = space.free, np.clip(start, space.lower, space.upper)
    lower, upper = space.lower[free], space.upper[free]
    if not free.any() or n_data == 0 or max_evaluations == 0:
        return Learned(theta, -math.inf, 0, 'converged', np.zeros_like(free))

    evaluate = _of_free_entries(objective, space, theta, n_data, use_priors)
    x = theta[free]
    value, gradient = evaluate(x)
    n_evaluations, status, reach = 1, 'budget' if math.isfinite(value) else 'failed', 1.0
    unit = inverse = np.eye(len(x))
    while status == 'budget':
        held = ((x <= lower) & (gradient < 0.0)) | ((x >= upper) & (gradient > 0.0))
        slope = np.where(held, 0.0, gradient)
        step = np.where(held, 0.0, inverse @ slope)
        longest = float(np.abs(step).max())
        if float(np.abs(slope).max()) < _LEVEL:
            status = 'converged'
            break
        if n_evaluations >= max_evaluations:
            break
        trial = x + step * (reach * min(1.0, _LONGEST_STEP / longest))
        trial = np.minimum(np.maximum(trial, lower), upper)
        trial_value, trial_gradient = evaluate(trial)
        n_evaluations += 1
        if not trial_value > value:
            reach *= _SHRINK
            # The step from here on goes along the slope if it does not get any shorter.
            if reach < _SHRINK**3:
                inverse, reach = _SHRINK**3 * unit, 1.0
            continue
        gain, moved, bent = trial_value - value, trial - x, gradient - trial_gradient
        x, value, gradient, reach = trial, trial_value, trial_gradient, 1.0
        if (along := float(moved @ bent)) > 0.0:
            mixed = unit - moved[:, None] * bent / along
            inverse = mixed @ inverse @ mixed.T + moved[:, None] * moved / along
        if gain < _NO_GAIN:
            status = 'converged'
    theta[free] = x
    near_bound = (theta <= space.lower + _AT_BOUND) | (theta >= space.upper - _AT_BOUND)
    return Learned(theta, value * n_data, n_evaluations, status, free & near_bound)


def _of_free_entries(
    objective: Objective, space: ThetaSpace, theta: FloatArray, n_data: int, use_priors: bool
) -> Objective:
    """Objective and gradient in the free entries, for each datum; the others are as in `theta`."""
    free = space.free

    def evaluate(x: FloatArray) -> tuple[float, FloatArray]:
        trial = theta.copy()
        trial[free] = x
        value, slope = objective(trial)
        slope = slope[free]
        if use_priors:
            deviation = (x - space.centre[free]) / space.prior_std
            value -= 0.5 * float(deviation @ deviation)
            slope = slope - deviation / space.prior_std
        return value / n_data, slope / n_data

    return evaluate
