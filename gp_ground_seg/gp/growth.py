"""Inlier growth and the surface of every segment, said plainly.

`gp_ground_seg.compiled.growth_compiled` does the same, to rounding, without factoring anew.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gp_ground_seg.frame import BoolArray, Candidates, FloatArray, IntArray
from gp_ground_seg.gp.observation import posterior
from gp_ground_seg.parameters.config import GrowthConfig, ObservationConfig


@dataclass(frozen=True)
class GrowthTask:
    """What `grow_surface_reference` works on, all but the length-scales; and how to fuse.

    Attributes
    ----------
    candidates : Candidates
        Ground candidates.
    prior_mean : float
        Prior mean of the ground's height [m].
    follows : (C,) bool
        See `grow_surface_reference`.
    knots : (K,) float64
        Ranges where the surface is wanted [m].
    theta : (M, 5 + K) float64
        Hyper-parameters of each segment (see `gp_ground_seg.gp.objective`).
    observation : ObservationConfig
        Prior slope, and noise.
    growth : GrowthConfig
        Where seeds are, and bounds for joining.
    segment_step : int
        There are seeds in every n-th segment.
    n_neighbours : int
        See `gp_ground_seg.pipeline.surface.fuse_neighbours`.
    """

    candidates: Candidates
    prior_mean: float
    follows: BoolArray
    knots: FloatArray
    theta: FloatArray
    observation: ObservationConfig
    growth: GrowthConfig
    segment_step: int
    n_neighbours: int

    @property
    def height(self) -> FloatArray:
        """Heights of the candidates about the prior mean, (C,) float64 [m]."""
        return self.candidates.z - self.prior_mean

    @property
    def seed(self) -> BoolArray:
        """Low, near candidates, that inliers grow from, (C,) bool."""
        is_seed: BoolArray = self.candidates.r <= self.growth.seed_range
        is_seed &= np.abs(self.height) <= self.growth.seed_height_tolerance
        if self.segment_step > 1:
            is_seed &= self.candidates.segment % self.segment_step == 0
        return is_seed

    @property
    def gate_noise(self) -> FloatArray:
        """Standard deviation of the noise that residuals are standardised with, (M,) [m].

        Learned on inliers the noise comes out small, and the gate must not shut for that.
        """
        noise: FloatArray = np.maximum(np.exp(self.theta[:, 1]), self.observation.sigma_n)
        return noise

    @property
    def n_knots(self) -> IntArray:
        """Number of knots up to the bin of the last candidate, (M,) int64."""
        return np.minimum(self.candidates.n_edges, len(self.knots))


def grow_surface_reference(
    offsets: IntArray,
    r: FloatArray,
    z: FloatArray,
    length_scale: FloatArray,
    seed: BoolArray,
    follows: BoolArray,
    knots: FloatArray,
    knot_length_scale: FloatArray,
    sigma_f: FloatArray,
    sigma_n: FloatArray,
    gate_noise: FloatArray,
    slope_std: float,
    growth: GrowthConfig,
) -> tuple[BoolArray, FloatArray, FloatArray]:
    """Grow the inliers of each segment from its seeds and predict the surface.

    A candidate joins when the predictive standard deviation is at most
    ``growth.max_std`` and its standardised residual is at most
    ``growth.max_standardised_residual`` above the prediction, or
    ``growth.max_standardised_depth`` below; repeated until none joins (GP-INSAC of
    Chen et al. 2014; the paper's outlier rejection). The gate is lopsided because
    obstacles lie only above the ground.

    Parameters
    ----------
    offsets : (M + 1,) int64
        Candidates of segment m are ``offsets[m]:offsets[m + 1]``.
    r, z, length_scale : (C,) float64
        Range, height about the prior mean, and length-scale of the candidates [m].
    seed : (C,) bool
        Candidates that start the inlier set.
    follows : (C,) bool
        Candidates that join if the one before them has: they continue its line.
    knots : (K,) float64
        Ranges where the surface is wanted [m].
    knot_length_scale : (M, K) float64
        Length-scale there [m]; NaN from the first knot on that is not wanted.
    sigma_f, sigma_n : (M,) float64
        Standard deviations of process and noise in each segment [m].
    gate_noise : (M,) float64
        Standard deviation of the noise that the residuals are standardised with [m].
    slope_std : float
        Prior standard deviation of the mean line's slope.
    growth : GrowthConfig
        Bounds for joining.

    Returns
    -------
    inlier : (C,) bool
        Candidates that made the surface.
    mean, std : (M, K) float64
        Height about the prior mean and its standard deviation [m]; NaN at knots that
        are not wanted and in segments without an inlier.
    """
    n_segments = len(offsets) - 1
    inlier = seed.copy()
    mean = np.full((n_segments, len(knots)), np.nan)
    std = np.full((n_segments, len(knots)), np.nan)
    for m in range(n_segments):
        own = slice(offsets[m], offsets[m + 1])
        r_own, z_own, l_own, chosen = r[own], z[own], length_scale[own], inlier[own]
        if not chosen.any():
            continue
        while True:
            height, variance = posterior(
                r_own[chosen],
                z_own[chosen],
                l_own[chosen],
                r_own,
                l_own,
                sigma_f[m],
                sigma_n[m],
                slope_std,
            )
            residual = (z_own - height) / np.sqrt(variance + gate_noise[m] ** 2)
            joining = (
                ~chosen
                & (variance <= growth.max_std**2)
                & (residual <= growth.max_standardised_residual)
                & (residual >= -growth.max_standardised_depth)
            )
            following = follows[own].copy()
            following[1:] &= chosen[:-1]
            joining |= following & ~chosen
            if not joining.any():
                break
            chosen |= joining
        wanted = np.isfinite(knot_length_scale[m])
        mean[m, wanted], variance = posterior(
            r_own[chosen],
            z_own[chosen],
            l_own[chosen],
            knots[wanted],
            knot_length_scale[m, wanted],
            sigma_f[m],
            sigma_n[m],
            slope_std,
        )
        std[m, wanted] = np.sqrt(variance)
    return inlier, mean, std
