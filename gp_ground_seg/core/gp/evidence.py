"""Stage 5a: what the segments beside a segment show of its ground.

Where a car hides the ground of a segment, that segment by itself would take the car for ground.
Its neighbours see the ground at the same range, lower. Two sources of evidence are used: seeds
must not stand higher than seeds near them allow, and the surfaces of the segments beside decide
with a segment's own which candidates join.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from gp_ground_seg.core.frame import BoolArray, Candidates, FloatArray, Frame
from gp_ground_seg.core.parameters.config import Config

STEP = 4
"""One of how many segments shows its ground to those beside it: neighbours see much the same."""
LEAST_STD = 1e-3
"""Standard deviation of a surface below which it counts as that [m]."""
LEAST_PRECISION = 1e-3
"""Precision below which a surface shows nothing [1/m^2]: rounding is left of the prior."""


class Evidence(NamedTuple):
    """Height of the ground at places of segments, by the segments beside them.

    Attributes
    ----------
    height : float64 array
        Height about the prior mean [m]; 0 where there is no evidence.
    precision : float64 array
        Inverse variance [1/m^2]; 0 where there is no evidence.
    """

    height: FloatArray
    precision: FloatArray

    def contradicts(self, z: FloatArray, noise: FloatArray, limit: float) -> BoolArray:
        """Whether heights `z` [m] with variances `noise` stand above it by `limit` deviations."""
        known = self.precision > 0.0
        variance = 1.0 / np.where(known, self.precision, 1.0) + noise
        result: BoolArray = known & (z - self.height > limit * np.sqrt(variance))
        return result

    def combined(self, height: FloatArray, variance: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Height and variance of an estimate together with the evidence."""
        own_share = 1.0 / (1.0 + np.maximum(variance, 0.0) * self.precision)
        return own_share * height + (1.0 - own_share) * self.height, own_share * variance

    def combined_surface(
        self, mean: FloatArray, std: FloatArray, prior_variance: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Height and standard deviation of surfaces together with the evidence [m].

        NaN where there is neither.
        """
        has_own = np.isfinite(std)
        variance = np.where(has_own, np.maximum(std, LEAST_STD) ** 2, prior_variance)
        height, variance = self.combined(np.where(has_own, mean, 0.0), variance)
        known = has_own | (self.precision > 0.0)
        return np.where(known, height, np.nan), np.where(known, np.sqrt(variance), np.nan)


def looks_aside_in(frame: Frame, config: Config) -> bool:
    """Whether segments look aside: without a prior slope others would be right at any distance."""
    wanted = config.surface.look_aside and config.observation.slope_std > 0.0
    return wanted and len(frame.knots) > 0


def seeds(frame: Frame, theta: FloatArray, config: Config) -> BoolArray:
    """Candidates that start the inlier set, (C,) bool.

    They are low and near (``growth.seed_height_tolerance``, ``growth.seed_range``). One that
    stands higher over another than noise and prior slope explain stands on something.
    """
    candidates, growth = frame.candidates, config.growth
    z = candidates.z - frame.prior_mean
    seed = (candidates.r <= growth.seed_range) & (np.abs(z) <= growth.seed_height_tolerance)
    if looks_aside_in(frame, config):
        limit = growth.max_standardised_residual
        highest = highest_ground(frame, z, seed, limit * config.observation.slope_std)
        noise = limit * math.sqrt(2.0) * np.exp(theta[candidates.segment, 1])
        seed &= z <= highest + noise
    return seed


def highest_ground(frame: Frame, z: FloatArray, seed: BoolArray, max_slope: float) -> FloatArray:
    """Largest height of ground that rises by `max_slope` from the seeds, (C,) [m].

    Distances are taken along ranges and arcs, between the near edges of bins: outwards and
    inwards, around, and outwards and inwards again.

    Parameters
    ----------
    frame : Frame
        Candidates and knots.
    z : (C,) float64
        Heights of the candidates [m].
    seed : (C,) bool
        Candidates that the ground rises from.
    max_slope : float
        Rise per metre.
    """
    candidates, segment = frame.candidates, frame.candidates.segment
    if not seed.any():
        return np.full(len(z), np.inf)
    n_segments, n_bins = len(candidates.offsets) - 1, int(candidates.bin[seed].max()) + 1
    table = np.full((n_segments, n_bins), np.inf)
    table[segment[seed], candidates.bin[seed]] = z[seed]
    edges = frame.knots[:n_bins]
    _rise_along(table, max_slope * np.diff(edges))
    _rise_around(table, max_slope * 2.0 * math.pi / n_segments * edges)
    _rise_along(table, max_slope * np.diff(edges))
    own_bin = candidates.bin
    near = own_bin < n_bins
    return np.where(near, table[segment, np.minimum(own_bin, n_bins - 1)], np.inf)


def _rise_along(table: FloatArray, rise: FloatArray) -> None:
    n_bins = table.shape[1]
    for j in range(1, n_bins):
        np.minimum(table[:, j], table[:, j - 1] + rise[j - 1], out=table[:, j])
    for j in range(n_bins - 2, -1, -1):
        np.minimum(table[:, j], table[:, j + 1] + rise[j], out=table[:, j])


def _rise_around(table: FloatArray, rise: FloatArray) -> None:
    n = len(table)
    # Twice around, as the segments form a ring.
    for m in range(1, 2 * n):
        np.minimum(table[m % n], table[(m - 1) % n] + rise, out=table[m % n])
    for m in range(2 * n - 2, -1, -1):
        np.minimum(table[m % n], table[(m + 1) % n] + rise, out=table[m % n])


def evidence_aside(
    mean: FloatArray,
    std: FloatArray,
    prior_variance: FloatArray,
    knots: FloatArray,
    slope_std: float,
) -> Evidence:
    """Evidence at the knots of every segment from the surfaces of the others, (M, K).

    On either side the nearest segment that knows: the standard deviation of its evidence grows
    by `slope_std` for each metre of arc. What a surface knows by the prior alone is no evidence:
    its observations are what is left of it divided by the prior.

    Parameters
    ----------
    mean, std : (M, K) float64
        Height about the prior mean and standard deviation of the segments' own surfaces [m]; NaN
        where there is none.
    prior_variance : (M, K) float64
        Variance of the prior [m^2].
    knots : (K,) float64
        Ranges of the knots [m].
    slope_std : float
        Standard deviation of the ground's slope.
    """
    square = np.maximum(std, LEAST_STD) ** 2
    with np.errstate(invalid='ignore'):
        precision = 1.0 / square - 1.0 / prior_variance
        known = precision > LEAST_PRECISION
    safe = np.where(known, precision, 1.0)
    height = np.where(known, mean / (square * safe), 0.0)
    own = np.where(known, 1.0 / np.sqrt(safe), np.inf)
    step = slope_std * 2.0 * math.pi / len(mean) * knots
    total, weighted = np.zeros_like(own), np.zeros_like(own)
    for order in (range(2 * len(own)), range(2 * len(own) - 1, -1, -1)):
        nearest, nearest_std = np.zeros(len(knots)), np.full(len(knots), np.inf)
        for k, turn in enumerate(order):
            m = turn % len(own)
            nearest_std = nearest_std + step
            # The first time around finds what the second begins with.
            if k >= len(own):
                weight = 1.0 / nearest_std**2
                total[m] += weight
                weighted[m] += weight * nearest
            better = own[m] <= nearest_std
            nearest = np.where(better, height[m], nearest)
            nearest_std = np.where(better, own[m], nearest_std)
    return Evidence(weighted / np.where(total > 0.0, total, 1.0), total)


def at_candidates(aside: Evidence, candidates: Candidates, knots: FloatArray) -> Evidence:
    """Evidence at the candidates, (C,): linear between the knots about each."""
    segment, near = candidates.segment, candidates.bin
    width = knots[near + 1] - knots[near]
    share = np.clip((candidates.r - knots[near]) / width, 0.0, 1.0)

    def between(table: FloatArray) -> FloatArray:
        low, high = table[segment, near], table[segment, near + 1]
        value: FloatArray = low + share * (high - low)
        return value

    return Evidence(between(aside.height), between(aside.precision))
