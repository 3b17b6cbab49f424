"""Learning of the hyper-parameters by maximum a posteriori."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.optimize import minimize

from gp_ground_seg.frame import FloatArray
from gp_ground_seg.gp.theta import ThetaSpace

Objective = Callable[[FloatArray], tuple[float, FloatArray]]

_AT_BOUND = 1e-6


@dataclass(frozen=True)
class Learned:
    """Outcome of one learning.

    Attributes
    ----------
    theta : (T,) float64
        Best hyper-parameters met, log space.
    objective : float
        Objective there, with the priors if any.
    n_evaluations : int
        Evaluations of objective and gradient.
    status : str
        ``converged``, ``budget`` or ``failed`` (no finite objective met).
    at_bound : (T,) bool
        Free entries that ended at a bound.
    """

    theta: FloatArray
    objective: float
    n_evaluations: int
    status: str
    at_bound: npt.NDArray[np.bool_]


class _BudgetSpentError(Exception):
    pass


def learn(
    objective: Objective,
    space: ThetaSpace,
    start: FloatArray,
    n_data: int,
    *,
    use_priors: bool,
    max_evaluations: int,
    out_of_time: Callable[[], bool],
) -> Learned:
    """Maximise objective plus log priors from `start`, within bounds and budget.

    The variables are scaled by the priors' width and the objective by the number
    of data, so that the first step is of a sensible size (the paper's scaled
    gradient-based optimisation).

    Parameters
    ----------
    objective : callable
        theta -> log marginal likelihood and its gradient; ``-inf`` is allowed.
    space : ThetaSpace
        Bounds, priors, and which entries are free.
    start : (T,) float64
        Where to begin, log space.
    n_data : int
        Number of inliers.
    use_priors : bool
        Whether the log-normal priors are added.
    max_evaluations : int
        Budget; the best theta so far is returned when it is spent.
    out_of_time : callable
        Asked before each evaluation after the first; True ends the learning.
    """
    free, scale = space.free, space.prior_std
    begin = np.clip(start, space.lower, space.upper)
    best_theta, best_value, n_evaluations = begin, -np.inf, 0

    def negative(x: FloatArray) -> tuple[float, FloatArray]:
        nonlocal best_theta, best_value, n_evaluations
        if n_evaluations >= max_evaluations or (n_evaluations > 0 and out_of_time()):
            raise _BudgetSpentError
        theta = begin.copy()
        theta[free] = x * scale
        value, gradient = objective(theta)
        n_evaluations += 1
        if use_priors:
            deviation = (theta - space.centre)[free] / scale
            value -= 0.5 * float(deviation @ deviation)
            gradient = gradient.copy()
            gradient[free] -= deviation / scale
        if value > best_value:
            best_theta, best_value = theta, value
        if not np.isfinite(value):
            # A step into the void: large and level, so that the line search turns back.
            return 1e10, np.zeros(len(x))
        return -value / n_data, -gradient[free] * scale / n_data

    status = 'converged'
    if free.any() and n_data > 0:
        try:
            result = minimize(
                negative,
                begin[free] / scale,
                jac=True,
                method='L-BFGS-B',
                bounds=list(
                    zip(space.lower[free] / scale, space.upper[free] / scale, strict=True)
                ),
                options={'ftol': 1e-6, 'gtol': 1e-5},
            )
            status = 'converged' if result.success else 'budget'
        except _BudgetSpentError:
            status = 'budget'
        if not np.isfinite(best_value):
            status = 'failed'
    near_lower = best_theta <= space.lower + _AT_BOUND
    near_upper = best_theta >= space.upper - _AT_BOUND
    return Learned(best_theta, best_value, n_evaluations, status, free & (near_lower | near_upper))
