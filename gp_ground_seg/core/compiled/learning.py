"""Compiled twin of `gp_ground_seg.core.gp.learning`: a frame in one call."""

from __future__ import annotations

import numpy as np

from gp_ground_seg.core.compiled.evidence import set_low_seeds
from gp_ground_seg.core.compiled.ground import SegmentSurfaces, grow_inliers
from gp_ground_seg.core.compiled.latent import latent_log_length_scales
from gp_ground_seg.core.compiled.likelihood import log_likelihood
from gp_ground_seg.core.frame import FloatArray, Frame, Inliers
from gp_ground_seg.core.gp.learning import (
    ThetaSpace,
    maximise,
    set_likelihood,
)
from gp_ground_seg.core.jit import compiled_form, jit
from gp_ground_seg.core.parameters.config import GrowthConfig, LearningConfig, ObservationConfig

compiled_form(set_likelihood)(log_likelihood)


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
    length-scale, `odds` as of `grow_inliers`; `by_itself` has no knots, and the log length-scales
    at the candidates if these are given. Sets `outcome` (2,) to the objective and the place of the
    status in `STATUSES`, and returns the number of evaluations.
    """
    step, nothing = learning.segment_step, np.empty((2, 0, 0))
    has_latent = bool(space.free[2:].any())
    if is_latent:
        at_knots = by_itself.knot_log_length_scale
        latent_log_length_scales(frame, theta, step, by_itself.log_length_scale, at_knots)
    set_low_seeds(frame, growth, by_itself.seed)
    grow_inliers(frame, theta, observation, growth, odds, nothing, step, by_itself)
    inliers = _take_inliers(frame, step, has_latent, by_itself)
    most = learning.max_evaluations
    return maximise(space, inliers, observation, is_map, most, theta, outcome)


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
