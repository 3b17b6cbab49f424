"""Observation process GP_z: ground height over range in one segment."""

from __future__ import annotations

import numpy as np

from gp_ground_seg.frame import FloatArray
from gp_ground_seg.gp import dense
from gp_ground_seg.gp.kernels import paciorek


def posterior(
    r: FloatArray,
    z: FloatArray,
    length_scale: FloatArray,
    r_star: FloatArray,
    length_scale_star: FloatArray,
    sigma_f: float,
    sigma_n: float,
    slope_std: float = 0.0,
) -> tuple[FloatArray, FloatArray]:
    """Mean and variance of the ground height at `r_star` (paper, eqs. 6 and 7).

    Parameters
    ----------
    r, z, length_scale : (n,) float64
        Ranges, heights about the prior mean, and length-scales of the inliers [m].
    r_star, length_scale_star : (k,) float64
        Ranges wanted and the length-scales there [m].
    sigma_f, sigma_n : float
        Standard deviations of the process and of the noise [m].
    slope_std : float
        Prior standard deviation of the slope of the mean line through the sensor's
        foot. The line is marginalised, which adds ``slope_std^2 r r'`` to the
        kernel (Rasmussen and Williams 2006, section 2.7).

    Returns
    -------
    mean : (k,) float64
        Height about the prior mean [m].
    variance : (k,) float64
        Variance of the height, without the noise [m^2].
    """
    covariance = paciorek(r, length_scale, r, length_scale, sigma_f)
    covariance += slope_std**2 * np.outer(r, r)
    covariance[np.diag_indices_from(covariance)] += sigma_n**2
    cross = paciorek(r, length_scale, r_star, length_scale_star, sigma_f)
    cross += slope_std**2 * np.outer(r, r_star)
    prior = sigma_f**2 + slope_std**2 * r_star**2
    factor = dense.factorise(covariance)
    mean = cross.T @ dense.solve(factor, z)
    whitened = dense.whiten(factor, cross)
    variance = np.maximum(prior - np.sum(whitened**2, axis=0), 0.0)
    return mean, variance
