"""Hyper-parameters as a vector in log space: names, start, bounds, priors, fixed mask."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from gp_ground_seg.frame import FloatArray
from gp_ground_seg.gp.objective import N_SCALARS
from gp_ground_seg.parameters.config import Config

SCALAR_NAMES = ('sigma_f', 'sigma_n', 'sigma_f_bar', 'sigma_l_bar', 'sigma_n_bar')


def theta_names(size: int) -> list[str]:
    """Names of the entries of a theta of the given size."""
    return [*SCALAR_NAMES, *(f'length_scale_bar_{k}' for k in range(size - N_SCALARS))]


@dataclass(frozen=True)
class ThetaSpace:
    """Where the hyper-parameters may be, all in log space.

    Attributes
    ----------
    centre : (T,) float64
        Values given by the configuration and the first guess; centres of the priors.
    lower, upper : (T,) float64
        Bounds.
    free : (T,) bool
        Entries that are learned.
    prior_std : float
        Standard deviation of the priors.
    """

    centre: FloatArray
    lower: FloatArray
    upper: FloatArray
    free: npt.NDArray[np.bool_]
    prior_std: float


def theta_centre(config: Config, first_guess: FloatArray) -> FloatArray:
    """Values given by the configuration and the first guess, (5 + K,), in log space.

    Parameters
    ----------
    config : Config
        Values, and bounds of the length-scale.
    first_guess : (K,) float64
        First guess of the surface classes' log length-scales [log m].
    """
    observation, latent, limits = config.observation, config.latent, config.length_scale
    # Every frame begins with this: numpy would take as long for each of seven logarithms.
    values = (
        observation.sigma_f,
        observation.sigma_n,
        latent.sigma_f_bar,
        latent.sigma_l_bar,
        latent.sigma_n_bar,
    )
    shortest, longest = math.log(limits.min), math.log(limits.max)
    guessed = [min(max(guess, shortest), longest) for guess in first_guess.tolist()]
    centre = np.array([*map(math.log, values), *guessed])
    return centre


def theta_space(config: Config, first_guess: FloatArray) -> ThetaSpace:
    """Space of theta for a frame; parameters are those of `theta_centre`."""
    learning = config.learning
    centre = theta_centre(config, first_guess)
    width = np.log(learning.bound_factor)
    lower, upper = centre - width, centre + width
    lower[N_SCALARS:] = np.log(config.length_scale.min)
    upper[N_SCALARS:] = np.log(config.length_scale.max)
    free = np.ones(len(centre), dtype=np.bool_)
    if config.length_scale.model != 'latent' or learning.fixed == 'length_scales':
        free[2:] = False
    elif learning.fixed == 'latent':
        free[2:N_SCALARS] = False
    elif learning.fixed == 'sigma_f_bar':
        free[2] = False
    return ThetaSpace(centre, lower, upper, free, learning.prior_std)
