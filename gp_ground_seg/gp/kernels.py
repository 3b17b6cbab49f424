"""Covariance functions."""

from __future__ import annotations

import numpy as np

from gp_ground_seg.frame import FloatArray


def paciorek(
    r_a: FloatArray, l_a: FloatArray, r_b: FloatArray, l_b: FloatArray, sigma_f: float
) -> FloatArray:
    """Non-stationary covariance of Paciorek and Schervish in one dimension (paper, eq. 8).

    ``sigma_f^2 sqrt(2 l_a l_b / (l_a^2 + l_b^2)) exp(-(r_a - r_b)^2 / (l_a^2 + l_b^2))``

    Parameters
    ----------
    r_a, l_a : (A,) float64
        Ranges and length-scales [m].
    r_b, l_b : (B,) float64
        Ranges and length-scales [m].
    sigma_f : float
        Prior standard deviation [m].

    Returns
    -------
    (A, B) float64
        Covariances [m^2].
    """
    spread = l_a[:, None] ** 2 + l_b[None, :] ** 2
    ratio = 2.0 * l_a[:, None] * l_b[None, :] / spread
    distance = r_a[:, None] - r_b[None, :]
    return sigma_f**2 * np.sqrt(ratio) * np.exp(-(distance**2) / spread)


def squared_exponential(
    r_a: FloatArray, r_b: FloatArray, sigma_f: float, length_scale: float
) -> FloatArray:
    """Stationary covariance of the latent process (paper, eq. 12).

    ``sigma_f^2 exp(-(r_a - r_b)^2 / (2 length_scale^2))``

    Parameters
    ----------
    r_a : (A,) float64
        Ranges [m].
    r_b : (B,) float64
        Ranges [m].
    sigma_f : float
        Prior standard deviation, in the unit of the process.
    length_scale : float
        Length-scale [m].

    Returns
    -------
    (A, B) float64
        Covariances.
    """
    distance = r_a[:, None] - r_b[None, :]
    value: FloatArray = sigma_f**2 * np.exp(-(distance**2) / (2.0 * length_scale**2))
    return value
