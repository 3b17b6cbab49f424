"""Compiled twin of `gp_ground_seg.core.gp.learning`: all rounds of a frame in one call."""

from __future__ import annotations

import math

import numpy as np

from gp_ground_seg.core.compiled.ground import SegmentSurfaces, grow_surfaces
from gp_ground_seg.core.compiled.latent import latent_log_length_scales
from gp_ground_seg.core.compiled.likelihood import log_likelihood
from gp_ground_seg.core.frame import FloatArray, Frame, Inliers
from gp_ground_seg.core.gp.evidence import is_low_and_near
from gp_ground_seg.core.gp.learning import (
    BUDGET,
    FARTHEST_START,
    ThetaSpace,
    maximise,
    missed_by_line,
    set_likelihood,
)
from gp_ground_seg.core.jit import compiled_form, jit
from gp_ground_seg.core.parameters.config import GrowthConfig, LearningConfig, ObservationConfig


@compiled_form(set_likelihood)
def _set_likelihood(
    theta: FloatArray,
    inliers: Inliers,
    slope_std: float,
    latent_terms: bool,
    gradient: FloatArray,
) -> float:
    return log_likelihood(theta, inliers, slope_std, latent_terms, gradient)


@jit(entry=True)
def learn_frame(
    frame: Frame,
    space: ThetaSpace,
    observation: ObservationConfig,
    growth: GrowthConfig,
    learning: LearningConfig,
    is_map: bool,
    is_latent: bool,
    odds: float,
    by_itself: SegmentSurfaces,
    theta: FloatArray,
    outcome: FloatArray,
) -> int:
    """Do what the twin does, into `theta` (T,), which holds the given values.

    The frame has no knots. `is_map` and `is_latent` are the objective and the model of the
    length-scale, `odds` as of `grow_surfaces`; `by_itself` has no knots, and the log length-scales
    at the candidates if these are given. Sets `outcome` (2,) to the objective and the place of the
    status in `STATUSES`, and returns the number of evaluations.
    """
    _set_first_theta(frame, growth, theta)
    step, nothing, has_latent = learning.segment_step, np.empty((2, 0, 0)), False
    for i in range(2, len(theta)):
        has_latent |= space.free[i]
    outcome[0], outcome[1] = -math.inf, BUDGET
    n_rounds = n_before = n_evaluations = 0
    budget = max(learning.max_evaluations // 2, 1)
    while budget > 0:
        if is_latent:
            at_knots = by_itself.knot_log_length_scale
            latent_log_length_scales(frame, theta, step, by_itself.log_length_scale, at_knots)
        _set_seeds(frame, growth, step, by_itself)
        grow_surfaces(frame, theta, observation, growth, odds, nothing, step, by_itself)
        inliers = _take_inliers(frame, step, has_latent, by_itself)
        n_rounds += 1
        if n_rounds > 2 and len(inliers.r) <= n_before:
            break
        n_before = len(inliers.r)
        slope_std = observation.slope_std
        n_evaluations += maximise(space, inliers, slope_std, is_map, budget, theta, outcome)
        budget = learning.max_evaluations - n_evaluations
    return n_evaluations


@jit(part=True)
def _set_first_theta(frame: Frame, growth: GrowthConfig, theta: FloatArray) -> None:
    """See the plain `first_theta`."""
    candidates, lines = frame.candidates, frame.lines
    r, z, line, most = candidates.r, candidates.z, lines.line, growth.seed_height_tolerance
    numbers, squares = np.zeros(2), np.zeros(2)
    for c in range(len(r)):
        q = line[c]
        is_ground = abs(lines.slope[q]) <= growth.max_line_slope
        is_ground &= lines.start[q + 1] - lines.start[q] >= growth.min_line_size
        if is_ground and r[c] <= growth.seed_range:
            numbers[0] += 1.0
            squares[0] += min(abs(z[c] - frame.prior_mean), most) ** 2
        if 0 < c < len(r) - 1 and line[c - 1] == line[c + 1]:
            before, behind = (r[c - 1], z[c - 1]), (r[c + 1], z[c + 1])
            numbers[1] += 1.0
            squares[1] += min(abs(missed_by_line(before, (r[c], z[c]), behind)), most) ** 2
    for i in range(2):
        if squares[i] > 0.0:
            shown = 0.5 * math.log(squares[i] / numbers[i])
            theta[i] = min(max(shown, theta[i] - FARTHEST_START), theta[i] + FARTHEST_START)


@jit(part=True)
def _set_seeds(frame: Frame, growth: GrowthConfig, step: int, by_itself: SegmentSurfaces) -> None:
    """Set the seeds of every `step`-th segment: without neighbours, all that are low."""
    candidates = frame.candidates
    for m in range(0, len(candidates.offsets) - 1, step):
        for c in range(candidates.offsets[m], candidates.offsets[m + 1]):
            z = candidates.z[c] - frame.prior_mean
            by_itself.seed[c] = is_low_and_near(candidates.r[c], z, growth)


@jit(part=True)
def _take_inliers(
    frame: Frame, step: int, has_latent: bool, by_itself: SegmentSurfaces
) -> Inliers:
    """Inliers of every `step`-th segment, and with `has_latent` their pseudo-inputs."""
    candidates, pseudo = frame.candidates, frame.pseudo
    n_segments, most, most_bar = len(candidates.offsets) - 1, len(candidates.r), len(pseudo.r_bar)
    values, bar_values = np.empty((3, most)), np.empty((2, most_bar))
    r, z, u, r_bar, log_extent = values[0], values[1], values[2], bar_values[0], bar_values[1]
    kind = np.empty(most_bar, np.int64)
    n_used = (n_segments + step - 1) // step
    offsets, bar_offsets = np.empty(n_used + 1, np.int64), np.empty(n_used + 1, np.int64)
    n = p = offsets[0] = bar_offsets[0] = 0
    for k in range(n_used):
        m = k * step
        for c in range(candidates.offsets[m], candidates.offsets[m + 1]):
            if by_itself.inlier[c]:
                r[n], z[n] = candidates.r[c], candidates.z[c] - frame.prior_mean
                u[n] = by_itself.log_length_scale[c]
                n += 1
        if has_latent:
            for c in range(pseudo.offsets[m], pseudo.offsets[m + 1]):
                r_bar[p], log_extent[p] = pseudo.r_bar[c], pseudo.log_extent[c]
                kind[p] = pseudo.kind[c]
                p += 1
        offsets[k + 1], bar_offsets[k + 1] = n, p
    return Inliers(offsets, r[:n], z[:n], u[:n], bar_offsets, r_bar, log_extent, kind)
