"""Covariance functions, of arrays or of numbers."""

from __future__ import annotations

import numpy as np

from gp_ground_seg.core.frame import Values
from gp_ground_seg.core.jit import shared

LARGEST_EXPONENT = 300.0
"""Largest x of which ``exp(-x)`` is computed: 5e-131, as good as nothing. Numbers below 1e-308,
which a square of this is not, lose digits and take numpy tens of times as long."""


def exp_neg(x: Values) -> Values:
    """``exp(-x)``; of numbers in compiled code, see `gp_ground_seg.core.compiled.numerics`."""
    return np.exp(-np.minimum(x, LARGEST_EXPONENT))


@shared
def paciorek(r_a: Values, l_a: Values, r_b: Values, l_b: Values, variance: Values) -> Values:
    """Non-stationary covariance of Paciorek and Schervish in one dimension (paper, eq. 8) [m^2].

    ``sigma_f^2 sqrt(2 l_a l_b / (l_a^2 + l_b^2)) exp(-(r_a - r_b)^2 / (l_a^2 + l_b^2))``

    Of ranges and length-scales [m], and the prior variance ``sigma_f^2`` [m^2]. As precise as
    these: there is no constant, which in compiled code would be of double precision.
    """
    spread, product = l_a * l_a + l_b * l_b, l_a * l_b
    distance = r_a - r_b
    root = np.sqrt((product + product) / spread)
    return variance * root * exp_neg(distance * distance / spread)


@shared
def squared_exponential(r_a: Values, r_b: Values, variance: Values, sharpness: Values) -> Values:
    """Stationary covariance of the latent process (paper, eq. 12).

    ``sigma_f^2 exp(-(r_a - r_b)^2 / (2 length_scale^2))``

    Of ranges [m], the prior variance ``sigma_f^2``, in the squared unit of the process, and the
    sharpness ``1 / (2 length_scale^2)`` [1/m^2].
    """
    distance = r_a - r_b
    return variance * exp_neg(sharpness * distance * distance)


@shared
def prior_variance(sill: Values, slope_std: float, r: Values) -> Values:
    """Prior variance of the ground's height at ranges [m^2]: of the process, and of its slope."""
    return sill + slope_std * slope_std * r * r
