"""Compiled twin of `gp_ground_seg.core.gp.evidence`."""

import math

import numpy as np

from gp_ground_seg.core.frame import BoolArray, FloatArray, Frame
from gp_ground_seg.core.gp import evidence
from gp_ground_seg.core.gp.kernels import prior_variance
from gp_ground_seg.core.gp.model import SegmentSurfaces
from gp_ground_seg.core.jit import compiled_form, jit
from gp_ground_seg.core.parameters.config import ObservationConfig


@compiled_form(evidence.find_seeds)
def find_seeds(frame: Frame, theta: FloatArray, slope_std: float, seed: BoolArray) -> None:
    """Do what the twin does."""
    if not seed.any():
        return
    candidates, knots, sigma_n = frame.candidates, frame.knots, math.exp(theta[1])
    n_segments, max_slope = len(candidates.offsets) - 1, evidence.CLEARLY * slope_std
    n_bins = candidates.bin[seed].max() + 1
    table = np.full((n_segments, n_bins), np.inf)
    for m in range(n_segments):
        for i in range(candidates.offsets[m], candidates.offsets[m + 1]):
            if seed[i]:
                table[m, candidates.bin[i]] = candidates.z[i]
    _rise_along(table, n_bins, max_slope, knots)
    rise = max_slope * 2.0 * math.pi / n_segments * knots[:n_bins]
    # Twice around, either way, as the segments form a ring.
    for step in (1, -1):
        for k in range(1, 2 * n_segments):
            # Unsigned, as a signed index could count from the end.
            to, by = np.uintp(step * k % n_segments), np.uintp(step * (k - 1) % n_segments)
            for j in range(np.uintp(n_bins)):
                table[to, j] = min(table[to, j], table[by, j] + rise[j])
    _rise_along(table, n_bins, max_slope, knots)
    for m in range(n_segments):
        for i in range(candidates.offsets[m], candidates.offsets[m + 1]):
            if seed[i]:
                seed[i] = not evidence.is_on_object(
                    candidates.z[i], table[m, candidates.bin[i]], sigma_n
                )


@jit()
def _rise_along(table: FloatArray, n_bins: int, max_slope: float, knots: FloatArray) -> None:
    """Let the ground rise outwards, then inwards."""
    # Bin by bin: along one segment each minimum would wait for the one before.
    for step, first, stop in ((1, 1, n_bins), (-1, n_bins - 2, -1)):
        for j in range(first, stop, step):
            rise = max_slope * abs(knots[j] - knots[j - step])
            for m in range(len(table)):
                table[m, j] = min(table[m, j], table[m, j - step] + rise)


@compiled_form(evidence.evidence_of_neighbours)
def evidence_of_neighbours(
    mean: FloatArray,
    std: FloatArray,
    knots: FloatArray,
    theta: FloatArray,
    observation: ObservationConfig,
) -> evidence.Evidence:
    """Do what the twin does: once around and again, either way."""
    n_segments, n_knots = mean.shape
    # Unsigned, as a signed index could count from the end.
    start, end = np.uintp(0), np.uintp(n_knots)
    nearest, nearest_std = np.empty(n_knots), np.empty(n_knots)
    rise = observation.slope_std * 2.0 * math.pi / n_segments * knots
    sill, own = math.exp(theta[0]) ** 2, np.empty((2, n_segments, n_knots))
    for m in range(n_segments):
        mean_m, std_m, height, deviation = mean[m], std[m], own[0, m], own[1, m]
        for j in range(start, end):
            prior = prior_variance(sill, observation, knots[j])
            height[j], deviation[j] = evidence.shown_by(mean_m[j], std_m[j], prior)
    heights, precisions = np.zeros((n_segments, n_knots)), np.zeros((n_segments, n_knots))
    for side in range(2):
        nearest[:], nearest_std[:] = 0.0, np.inf
        for k in range(2 * n_segments):
            m = k % n_segments if side == 0 else n_segments - 1 - k % n_segments
            height, deviation, weighted, total = own[0, m], own[1, m], heights[m], precisions[m]
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
    return evidence.Evidence(heights / np.where(precisions > 0.0, precisions, 1.0), precisions)


@compiled_form(evidence.join_evidence)
def join_evidence(
    found: SegmentSurfaces,
    from_neighbours: evidence.Evidence,
    knots: FloatArray,
    theta: FloatArray,
    observation: ObservationConfig,
) -> None:
    """Do what the twin does."""
    sill, mean, std = math.exp(theta[0]) ** 2, found.mean, found.std
    for m in range(len(mean)):
        for j in range(len(knots)):
            if not math.isnan(found.knot_log_length_scale[m, j]):
                prior = prior_variance(sill, observation, knots[j])
                beside = from_neighbours.height[m, j], from_neighbours.precision[m, j]
                mean[m, j], std[m, j] = evidence.combined_surface(
                    mean[m, j], std[m, j], prior, *beside
                )
