"""What segmenting a scan gives back."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from gp_ground_seg.polar_grid import Candidates, FloatArray, PolarGrid
from gp_ground_seg.surface import GroundSurface


@dataclass(frozen=True)
class FitReport:
    """What the learning and the inlier growth did.

    Attributes
    ----------
    mode : str
        ``learning.mode`` of the frame.
    sigma_f, sigma_n : float
        Hyper-parameters used [m].
    n_segments : int
        Segments with a ground model.
    n_candidates, n_inliers, n_lines : int
        Ground candidates, those the surface rests on, and lines among them.
    backend : str
        ``numba`` or ``numpy``.
    n_threads : int
        Threads used.
    """

    mode: str
    sigma_f: float
    sigma_n: float
    n_segments: int
    n_candidates: int
    n_inliers: int
    n_lines: int
    backend: str
    n_threads: int


@dataclass(frozen=True)
class Segmentation:
    """A segmented scan; per-point arrays are in input order.

    Attributes
    ----------
    label : (N,) uint8
        `gp_ground_seg.Label` of each point. Finite points are GROUND or
        OBSTACLE; where there is no model nothing speaks for ground, and they
        are OBSTACLE. Points that are not finite are UNKNOWN.
    ground_z : (N,) float64
        Surface height under each point, sensor frame [m]; NaN where there is no model.
    ground_std : (N,) float64
        Its standard deviation [m]; NaN where there is no model.
    timings : dict of str to float
        Seconds per stage, and ``total``.
    fit : FitReport
        What the learning did.
    grid, candidates, surface
        Intermediate results, for plots and diagnostics.
    """

    label: npt.NDArray[np.uint8]
    ground_z: FloatArray
    ground_std: FloatArray
    timings: dict[str, float]
    fit: FitReport
    grid: PolarGrid
    candidates: Candidates
    surface: GroundSurface
