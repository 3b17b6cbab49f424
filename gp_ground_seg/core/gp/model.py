"""Stage 5: what both backends are given, and what they find, as compiled code reads it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from gp_ground_seg.core.frame import BoolArray, FloatArray, Frame
from gp_ground_seg.core.gp.latent import given_log_length_scales
from gp_ground_seg.core.jit import shared
from gp_ground_seg.core.parameters.config import (
    Config,
    GrowthConfig,
    LearningConfig,
    ObservationConfig,
)
from gp_ground_seg.core.parameters.schema import numbers_of

_Observation = ObservationConfig.Numbers


class Model(NamedTuple):
    """Parameters of the two processes."""

    observation: ObservationConfig
    growth: GrowthConfig
    learning: LearningConfig
    is_latent: bool  # whether the latent process gives the length-scales
    is_map: bool  # whether the objective of the learning has priors
    by_roughness: bool  # whether inliers are weighed by the odds that they are obstacles
    uses_neighbours: bool  # whether segments are evidence for those beside them

    @classmethod
    def of(cls, frame: Frame, config: Config) -> Model:
        """Take them from the configuration."""
        # Without a prior slope a distance tells nothing.
        has_slope = config.observation.slope_std > 0.0 and len(frame.knots) > 0
        return cls(
            numbers_of(config.observation),
            numbers_of(config.growth),
            numbers_of(config.learning),
            config.length_scale.model == 'latent',
            config.learning.objective == 'map',
            config.label.rule == 'roughness',
            config.surface.look_aside and has_slope,
        )


@shared
def scaled(theta: FloatArray, model: Model, scale: float) -> tuple[FloatArray, Model]:
    """Theta and model with all standard deviations of the observation process scaled."""
    o = model.observation
    narrow = _Observation(o.sigma_f, o.sigma_n, scale * o.slope_std, scale * o.slope_drift)
    return np.append(theta[:2] + np.log(scale), theta[2:]), Model(narrow, *model[1:])


class SegmentSurfaces(NamedTuple):
    """The surface of each segment, and what it rests on."""

    log_length_scale: FloatArray  # (C,) at the candidates [log m]
    # (M, K) at the knots [log m]; NaN from the first knot on that is not wanted
    knot_log_length_scale: FloatArray
    seed: BoolArray  # (C,) candidates that start the inlier set
    inlier: BoolArray  # (C,) candidates that the surface rests on
    alike: FloatArray  # (C,) candidates close to each, itself as well, see `noise_among`
    doubt: FloatArray  # (C,) variance by which an inlier may be an obstacle [m^2]
    # (M, K) height about the prior mean and its standard deviation at the knots [m]; NaN where
    # there is none
    mean: FloatArray
    std: FloatArray

    @classmethod
    def to_be_set(cls, frame: Frame, config: Config) -> SegmentSurfaces:
        """Arrays for the surfaces of a frame, with seeds, and log length-scales unless latent."""
        u, knot_u = given_log_length_scales(frame, config.length_scale)
        candidates, growth = frame.candidates, config.growth
        seed: BoolArray = np.abs(candidates.z - frame.prior_mean) <= growth.seed_height_tolerance
        seed &= candidates.r <= growth.seed_range
        alike, doubt = np.empty((2, len(u)))
        mean, std = np.full((2, *knot_u.shape), np.nan)
        return cls(u, knot_u, seed, np.empty_like(seed), alike, doubt, mean, std)
