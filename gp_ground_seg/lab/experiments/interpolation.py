"""A surface without a Gaussian process: lowest points joined by straight lines."""

from __future__ import annotations

from typing import Any

import numpy as np

from gp_ground_seg.core.backend import Backend, make_backend
from gp_ground_seg.core.frame import FloatArray, Frame, GroundSurface
from gp_ground_seg.core.parameters.config import Config
from gp_ground_seg.lab.scoring.evaluate import OurMethod

TITLE = 'interpolation, our labels'
MAX_SLOPE, TOLERANCE = 0.15, 0.1
"""A lowest point is ground up to this slope from the one before, and this much more [m]; the best
of six pairs on a third of the labelled frames."""


def interpolation_method(config: Config) -> OurMethod:
    """Return our method with this surface in place of the model's, and nothing learned."""
    return InterpolationMethod(config.replace(**{'learning.mode': 'fixed'}))


class InterpolationMethod(OurMethod):
    """Our method with the backend of the parameters, but for the surface."""

    def __init__(self, config: Config, name: str = TITLE) -> None:
        backend: Any = InterpolatingBackend(make_backend(config.runtime))
        super().__init__(config, name, backend)


class InterpolatingBackend:
    """The stages of another backend, but for the heights of the surface."""

    def __init__(self, backend: Backend) -> None:
        self._backend = backend

    def __getattr__(self, name: str) -> Any:
        """Return a stage of the other backend."""
        return getattr(self._backend, name)

    def estimate_surface(
        self, frame: Frame, theta: FloatArray, config: Config
    ) -> tuple[GroundSurface, FloatArray, FloatArray]:
        """Interpolate `ground_points` of each segment; take the median of three segments.

        Standard deviation and end of the surface are those of the other backend.
        """
        surface, *scales = self._backend.estimate_surface(frame, theta, config)
        lines = np.empty_like(surface.mean)
        for segment, line in enumerate(lines):
            part = slice(*frame.candidates.offsets[segment : segment + 2])
            r, z = frame.candidates.r[part], frame.candidates.z[part]
            line[:] = np.interp(frame.knots, *ground_points(r, z, frame.prior_mean))
        mean = np.median([np.roll(lines, k, axis=0) for k in (-1, 0, 1)], axis=0)
        mean[np.isnan(surface.mean)] = np.nan
        return surface._replace(mean=mean), scales[0], scales[1]


def ground_points(r: FloatArray, z: FloatArray, start: float) -> tuple[list[float], list[float]]:
    """Ranges and heights of the ground point at range 0, `start`, and of those that follow it."""
    ranges, heights = [0.0], [start]
    for r_k, z_k in zip(r.tolist(), z.tolist(), strict=True):
        if abs(z_k - heights[-1]) <= MAX_SLOPE * (r_k - ranges[-1]) + TOLERANCE:
            ranges.append(r_k)
            heights.append(z_k)
    return ranges, heights
