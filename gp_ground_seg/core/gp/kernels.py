"""Covariance functions, of many segments at once."""

from __future__ import annotations

import numpy as np

from gp_ground_seg.core.frame import FloatArray


def paciorek(
    r_a: FloatArray, l_a: FloatArray, r_b: FloatArray, l_b: FloatArray, sigma_f: FloatArray
) -> FloatArray:
    """Non-stationary covariance of Paciorek and Schervish in one dimension (paper, eq. 8).

    ``sigma_f^2 sqrt(2 l_a l_b / (l_a^2 + l_b^2)) exp(-(r_a - r_b)^2 / (l_a^2 + l_b^2))``

    Of ranges and length-scales (S, A) and (S, B) [m], and the prior standard deviation `sigma_f`
    of each segment, (S,) [m]; returns (S, A, B) [m^2].
    """
    inverse = 1.0 / (l_a[:, :, None] ** 2 + l_b[:, None, :] ** 2)
    exponent: FloatArray = r_a[:, :, None] - r_b[:, None, :]
    exponent *= exponent
    exponent *= inverse
    np.negative(exponent, out=exponent)
    result: FloatArray = np.exp(exponent, out=exponent)
    inverse *= l_a[:, :, None]
    inverse *= 2.0 * l_b[:, None, :]
    result *= np.sqrt(inverse, out=inverse)
    result *= sigma_f[:, None, None] ** 2
    return result


def squared_exponential(
    r_a: FloatArray, r_b: FloatArray, sigma_f: FloatArray, length_scale: FloatArray
) -> FloatArray:
    """Stationary covariance of the latent process (paper, eq. 12).

    ``sigma_f^2 exp(-(r_a - r_b)^2 / (2 length_scale^2))``

    Of ranges (S, A) and (S, B) [m], with a prior standard deviation `sigma_f`, (S,), in the unit
    of the process, and a `length_scale`, (S,) [m]; returns (S, A, B).
    """
    result: FloatArray = r_a[:, :, None] - r_b[:, None, :]
    result *= result
    result *= -0.5 / length_scale[:, None, None] ** 2
    np.exp(result, out=result)
    result *= sigma_f[:, None, None] ** 2
    return result
