"""Quasi-Newton search for a maximum, one step at a time: plain loops, also compiled.

The caller evaluates the objective at `Search.trial` and gives the outcome to `take_outcome`; then
`propose` sets the next trial. Steps are those of BFGS. Divided by the number of data, the
curvature in the logarithm of a standard deviation is about one: the first step is of a sensible
size (the paper's scaled gradient-based optimisation). SciPy's L-BFGS-B takes longer between two
evaluations than most evaluations take.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from gp_ground_seg.core.frame import FloatArray
from gp_ground_seg.core.jit import shared

LEVEL = 1e-3
"""Gradient below which the objective counts as level."""
NO_GAIN = 1e-7
"""Gain below which a step was the last."""
LONGEST_STEP = 1.0
SHRINK = 0.3
"""Factor on a step that made things worse."""
SHORTEST = SHRINK**3
"""Factor on a step below which the search goes along the slope instead."""


class Search(NamedTuple):
    """Where a search in d dimensions is; its functions change the arrays."""

    lower: FloatArray  # (d,) bounds
    upper: FloatArray
    x: FloatArray  # (d,) the best place so far
    gradient: FloatArray  # (d,) there
    trial: FloatArray  # (d,) where the objective is wanted
    turned: FloatArray  # (d,) working space
    inverse: FloatArray  # (d, d) of the negative curvature
    value: FloatArray  # (2,) at the best place; factor on the next step


@shared
def search_from(x: FloatArray, lower: FloatArray, upper: FloatArray) -> Search:
    """Begin at `x`, within the bounds: the first trial."""
    d, best, trial = len(x), x.copy(), x.copy()
    value = np.array([-math.inf, 1.0])
    return Search(lower, upper, best, np.zeros(d), trial, np.empty(d), np.eye(d), value)


@shared
def take_outcome(search: Search, value: float, gradient: FloatArray) -> bool:
    """Take value and gradient of the objective at the trial; return whether that was the last.

    A value of ``-inf`` or NaN is worse than any.
    """
    x, inverse, trial, turned = search.x, search.inverse, search.trial, search.turned
    d, bent = len(x), search.gradient
    gain = value - search.value[0]
    if not gain > 0.0:
        search.value[1] *= SHRINK
        if search.value[1] < SHORTEST:
            search.value[1] = 1.0
            for i in range(d):
                for j in range(d):
                    inverse[i, j] = SHORTEST if i == j else 0.0
        return False
    for i in range(d):
        bent[i] -= gradient[i]
    along = across = 0.0
    for i in range(d):
        along += (trial[i] - x[i]) * bent[i]
        turned[i] = 0.0
        for j in range(d):
            turned[i] += inverse[i, j] * bent[j]
        across += bent[i] * turned[i]
    if along > 0.0:
        for i in range(d):
            moved = trial[i] - x[i]
            for j in range(d):
                beside = trial[j] - x[j]
                inverse[i, j] += (along + across) / (along * along) * moved * beside
                inverse[i, j] -= (turned[i] * beside + moved * turned[j]) / along
    for i in range(d):
        x[i], search.gradient[i] = trial[i], gradient[i]
    search.value[0], search.value[1] = value, 1.0
    return bool(gain < NO_GAIN)


@shared
def propose(search: Search) -> bool:
    """Set the next trial; return False where the objective is level, up to the bounds."""
    x, gradient, trial, d = search.x, search.gradient, search.trial, len(search.x)
    is_held, steepest, longest = np.zeros(d, np.bool_), 0.0, 0.0
    for i in range(d):
        is_held[i] = (x[i] <= search.lower[i] and gradient[i] < 0.0) or (
            x[i] >= search.upper[i] and gradient[i] > 0.0
        )
        if not is_held[i]:
            steepest = max(steepest, abs(gradient[i]))
    if steepest < LEVEL:
        return False
    for i in range(d):
        trial[i] = 0.0
        for j in range(d):
            if not (is_held[i] or is_held[j]):
                trial[i] += search.inverse[i, j] * gradient[j]
        longest = max(longest, abs(trial[i]))
    factor = search.value[1] * min(1.0, LONGEST_STEP / longest)
    for i in range(d):
        trial[i] = min(max(x[i] + factor * trial[i], search.lower[i]), search.upper[i])
    return True
