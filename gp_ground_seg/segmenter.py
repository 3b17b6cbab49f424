"""Ground segmentation of one LiDAR scan: the paper's Algorithm 2."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from gp_ground_seg.config import Config
from gp_ground_seg.gp.fit import choose_backend, fit_surface
from gp_ground_seg.labelling import label_points
from gp_ground_seg.length_scale import candidate_log_length_scale, interpolate_along_segments
from gp_ground_seg.line_extraction import extract_lines
from gp_ground_seg.parallel import RowPool
from gp_ground_seg.points import check_points
from gp_ground_seg.polar_grid import build_polar_grid, lowest_points
from gp_ground_seg.segmentation import FitReport, Segmentation
from gp_ground_seg.surface import GroundSurface, fuse_neighbours
from gp_ground_seg.timing import StageTimer


class GroundSegmenter:
    """Splits scans into ground and obstacles.

    Parameters
    ----------
    config : Config
        Parameters; `configure` changes them between scans.
    clock : callable
        Source of the seconds in ``Segmentation.timings``.

    Raises
    ------
    MissingDependencyError
        If ``runtime.backend`` is numba and numba is not installed.
    """

    def __init__(
        self, config: Config | None = None, clock: Callable[[], float] = time.perf_counter
    ) -> None:
        self._clock = clock
        self._config = config if config is not None else Config()
        self._backend = choose_backend(self._config.runtime.backend)
        self._pool = RowPool(self._config.runtime.n_threads)

    @property
    def config(self) -> Config:
        """Parameters of the next scan."""
        return self._config

    def configure(self, config: Config) -> None:
        """Use `config` from the next scan on."""
        self._backend = choose_backend(config.runtime.backend)
        if config.runtime.n_threads != self._config.runtime.n_threads:
            self._pool.close()
            self._pool = RowPool(config.runtime.n_threads)
        self._config = config

    def close(self) -> None:
        """End the worker threads; the segmenter is of no use afterwards."""
        self._pool.close()

    def segment(self, points: npt.ArrayLike) -> Segmentation:
        """Label every point of a scan.

        Parameters
        ----------
        points : (N, >=3) float array
            x forward, y left, z up in the sensor frame [m]; never written to.

        Raises
        ------
        PointCloudError
            If the array has another shape or type.
        """
        config = self._config
        timer = StageTimer(self._clock)
        xyz, finite = check_points(points)
        z = xyz[:, 2]
        grid = build_polar_grid(xyz, finite, config.grid)
        timer.mark('grid')

        candidates = lowest_points(grid, z)
        timer.mark('candidates')

        # Heights are centred on the expected ground: a zero mean would pull it to the sensor.
        expected_ground = -config.sensor.height
        height = candidates.z - expected_ground
        lines = extract_lines(candidates, config.lines)
        log_length_scale = candidate_log_length_scale(candidates, lines, config.length_scale)
        knots = grid.edges
        knot_log_length_scale = interpolate_along_segments(candidates, log_length_scale, knots)
        timer.mark('length_scale')

        seed = (candidates.r <= config.growth.seed_range) & (
            np.abs(height) <= config.growth.seed_height_tolerance
        )
        inlier, mean, std = fit_surface(
            candidates, height, np.exp(log_length_scale), seed,
            knots, np.exp(knot_log_length_scale), config, self._backend, self._pool,
        )  # fmt: skip
        mean, std = fuse_neighbours(
            mean, std, knots, config.surface.n_neighbours, config.observation.slope_std
        )
        surface = GroundSurface(knots, mean + expected_ground, std, inlier)
        timer.mark('surface')

        ground_z, ground_std = surface.at(grid)
        label = label_points(z - ground_z, grid, surface, config.label)
        timer.mark('label')

        fit = FitReport(
            mode=config.learning.mode,
            sigma_f=config.observation.sigma_f,
            sigma_n=config.observation.sigma_n,
            n_segments=int(np.isfinite(mean[:, 0]).sum()),
            n_candidates=len(candidates.r),
            n_inliers=int(inlier.sum()),
            n_lines=len(lines.slope),
            backend=self._backend,
            n_threads=self._pool.n_threads,
        )
        return Segmentation(
            label, ground_z, ground_std, timer.seconds, fit, grid, candidates, surface
        )
