"""Compiled twin of `gp_ground_seg.core.gp.evidence`, and the stage of the surface."""

from __future__ import annotations

import math

import numpy as np

from gp_ground_seg.core.compiled.ground import SegmentSurfaces, grow_inliers, regress
from gp_ground_seg.core.compiled.latent import latent_log_length_scales
from gp_ground_seg.core.frame import BoolArray, FloatArray, Frame
from gp_ground_seg.core.gp.evidence import (
    CLEARLY,
    ODDS,
    STEP,
    combined_surface,
    is_low_and_near,
    is_on_object,
    odds_of,
    shown_by,
)
from gp_ground_seg.core.gp.kernels import prior_variance
from gp_ground_seg.core.jit import jit
from gp_ground_seg.core.parameters.config import GrowthConfig, ObservationConfig


@jit(entry=True)
def estimate_surface(
    frame: Frame,
    given: FloatArray,
    theta: FloatArray,
    observation: ObservationConfig,
    growth: GrowthConfig,
    is_latent: bool,
    uses_neighbours: bool,
    by_roughness: bool,
    by_itself: SegmentSurfaces,
) -> None:
    """Do what `gp_ground_seg.core.gp.ground.estimate_surface` does, into `by_itself`.

    `given` (T,) is `given_theta`, `is_latent` and `by_roughness` are the model of the length-scale
    and the rule of the labels by the parameters, `uses_neighbours` is `uses_neighbours_in`.
    """
    knots, (n_segments, n_knots) = frame.knots, by_itself.mean.shape
    own, table = np.empty((2, n_segments, n_knots)), np.empty((2, n_segments, n_knots))
    u, knot_u = by_itself.log_length_scale, by_itself.knot_log_length_scale
    if is_latent:
        latent_log_length_scales(frame, given, 1, u, knot_u)
    max_slope = CLEARLY * observation.slope_std if uses_neighbours else -1.0
    odds = _find_seeds(frame, given, growth, max_slope, own[0], by_itself.seed)
    odds = odds if by_roughness else 0.0
    from_neighbours = np.empty((2, 0, 0))
    if uses_neighbours:
        grow_inliers(frame, given, observation, growth, odds, from_neighbours, STEP, by_itself)
        regress(frame, given, observation, STEP, by_itself)
        _find_evidence(by_itself, given, knots, observation, own, table)
        from_neighbours = table
    grow_inliers(frame, given, observation, growth, odds, from_neighbours, 1, by_itself)
    if is_latent and (theta[2:] != given[2:]).any():
        latent_log_length_scales(frame, theta, 1, u, knot_u)
    regress(frame, theta, observation, 1, by_itself)
    if uses_neighbours:
        _find_evidence(by_itself, theta, knots, observation, own, table)
    _combine(by_itself, from_neighbours, theta, knots, observation, frame.prior_mean)


@jit(part=True)
def set_low_seeds(frame: Frame, growth: GrowthConfig, seed: BoolArray) -> int:
    """Set `seed` to all that are low and near; return the number of bins up to the last."""
    candidates, n_bins = frame.candidates, 0
    for c in range(len(seed)):
        z = candidates.z[c] - frame.prior_mean
        seed[c] = is_low_and_near(candidates.r[c], z, growth)
        n_bins = max(n_bins, candidates.bin[c] + 1) if seed[c] else n_bins
    return n_bins


@jit()
def _find_seeds(
    frame: Frame,
    theta: FloatArray,
    growth: GrowthConfig,
    max_slope: float,
    table: FloatArray,
    seed: BoolArray,
) -> float:
    """Do what `seeds` of the twin does, into `seed`; `max_slope` < 0: no neighbours are used.

    Returns the odds of obstacles; `table` (M, K) is overwritten.
    """
    candidates, knots = frame.candidates, frame.knots
    n_segments, n_bins = len(candidates.offsets) - 1, set_low_seeds(frame, growth, seed)
    if max_slope < 0.0 or n_bins == 0:
        return ODDS
    for m in range(n_segments):
        for j in range(n_bins):
            table[m, j] = np.inf
        for i in range(candidates.offsets[m], candidates.offsets[m + 1]):
            if seed[i]:
                table[m, candidates.bin[i]] = candidates.z[i] - frame.prior_mean
    _rise_along(table, n_bins, max_slope, knots)
    rise = np.empty(n_bins)
    for j in range(n_bins):
        rise[j] = max_slope * 2.0 * math.pi / n_segments * knots[j]
    # Twice around, either way, as the segments form a ring.
    for step in (1, -1):
        for k in range(1, 2 * n_segments):
            # Unsigned, as a signed index could count from the end.
            to, by = np.uintp(step * k % n_segments), np.uintp(step * (k - 1) % n_segments)
            for j in range(np.uintp(n_bins)):
                table[to, j] = min(table[to, j], table[by, j] + rise[j])
    _rise_along(table, n_bins, max_slope, knots)
    n_standing = n_near = 0
    sigma_n = math.exp(theta[1])
    for m in range(n_segments):
        for i in range(candidates.offsets[m], candidates.offsets[m + 1]):
            if candidates.bin[i] < n_bins:
                z = candidates.z[i] - frame.prior_mean
                stands = is_on_object(z, table[m, candidates.bin[i]], sigma_n)
                seed[i] &= not stands
                n_standing += stands and not frame.in_face[i]
                n_near += not frame.in_face[i]
    odds: float = odds_of(n_standing, n_near)
    return odds


@jit()
def _rise_along(table: FloatArray, n_bins: int, max_slope: float, knots: FloatArray) -> None:
    """Let the ground rise outwards, then inwards."""
    # Bin by bin: along one segment each minimum would wait for the one before.
    for step, first, stop in ((1, 1, n_bins), (-1, n_bins - 2, -1)):
        for j in range(first, stop, step):
            rise = max_slope * abs(knots[j] - knots[j - step])
            for m in range(len(table)):
                table[m, j] = min(table[m, j], table[m, j - step] + rise)


@jit()
def _find_evidence(
    by_itself: SegmentSurfaces,
    theta: FloatArray,
    knots: FloatArray,
    observation: ObservationConfig,
    own_evidence: FloatArray,
    from_neighbours: FloatArray,
) -> None:
    """Do what `evidence_of_neighbours` of the twin does, into `from_neighbours` (2, M, K).

    These are height and precision. `own_evidence` (2, M, K) is overwritten.
    """
    n_segments, n_knots = by_itself.mean.shape
    # Unsigned, as a signed index could count from the end.
    start, end = np.uintp(0), np.uintp(n_knots)
    nearest, nearest_std, rise = np.empty(n_knots), np.empty(n_knots), np.empty(n_knots)
    for j in range(start, end):
        rise[j] = observation.slope_std * 2.0 * math.pi / n_segments * knots[j]
    sill = math.exp(theta[0]) ** 2
    for m in range(n_segments):
        mean_m, std_m = by_itself.mean[m], by_itself.std[m]
        height, deviation = own_evidence[0, m], own_evidence[1, m]
        for j in range(start, end):
            prior = prior_variance(sill, observation, knots[j])
            height[j], deviation[j] = shown_by(mean_m[j], std_m[j], prior)
    from_neighbours[:] = 0.0
    for side in range(2):
        nearest[:], nearest_std[:] = 0.0, np.inf
        for k in range(2 * n_segments):
            m = k % n_segments if side == 0 else n_segments - 1 - k % n_segments
            height, deviation = own_evidence[0, m], own_evidence[1, m]
            weighted, total = from_neighbours[0, m], from_neighbours[1, m]
            # The first time around finds what the second begins with.
            if k >= n_segments:
                for j in range(start, end):
                    carried = nearest_std[j] + rise[j]
                    weight = 1.0 / (carried * carried)
                    total[j] += weight
                    weighted[j] += weight * nearest[j]
            for j in range(start, end):
                carried = nearest_std[j] + rise[j]
                is_better = deviation[j] <= carried
                nearest[j] = height[j] if is_better else nearest[j]
                nearest_std[j] = deviation[j] if is_better else carried
    for m in range(n_segments):
        weighted, total = from_neighbours[0, m], from_neighbours[1, m]
        for j in range(start, end):
            weighted[j] /= total[j] if total[j] > 0.0 else 1.0


@jit()
def _combine(
    by_itself: SegmentSurfaces,
    from_neighbours: FloatArray,
    theta: FloatArray,
    knots: FloatArray,
    observation: ObservationConfig,
    prior_mean: float,
) -> None:
    """Make the surface of each segment that of it and the evidence together.

    `from_neighbours` (2, M, K) is the evidence, (2, 0, 0) if none is wanted.
    """
    sill, mean, std = math.exp(theta[0]) ** 2, by_itself.mean, by_itself.std
    for m in range(len(mean)):
        for j in range(len(knots)):
            is_wanted = not math.isnan(by_itself.knot_log_length_scale[m, j])
            if is_wanted and from_neighbours.shape[1] > 0:
                prior = prior_variance(sill, observation, knots[j])
                beside = from_neighbours[0, m, j], from_neighbours[1, m, j]
                mean[m, j], std[m, j] = combined_surface(mean[m, j], std[m, j], prior, *beside)
            mean[m, j] += prior_mean
