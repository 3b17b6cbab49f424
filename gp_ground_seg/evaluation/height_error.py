"""How far the estimated surface is from where the ground is."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt


@dataclass(frozen=True)
class HeightError:
    """Errors of the surface under points whose ground height is known.

    A ratio or mean over no points is NaN.

    Attributes
    ----------
    n_points : int
        Points with a model, those that count.
    n_without_model : int
        Points left out, because there is no surface where they are.
    sum_error : float
        Sum of estimate minus truth [m].
    sum_squared_error : float
        Sum of its squares [m^2].
    sum_squared_deviation : float
        Sum of the squared deviations of the true heights from their mean [m^2];
        pooled, from the mean of each frame.
    median_absolute : float
        Median distance of the estimate from the truth [m]; pooled, the median
        over the frames of theirs.
    """

    n_points: int
    n_without_model: int
    sum_error: float
    sum_squared_error: float
    sum_squared_deviation: float
    median_absolute: float

    @property
    def rmse(self) -> float:
        """Root mean squared error [m]."""
        return math.sqrt(_ratio(self.sum_squared_error, self.n_points))

    @property
    def bias(self) -> float:
        """Mean error [m]; negative where the surface is too low."""
        return _ratio(self.sum_error, self.n_points)

    @property
    def smse(self) -> float:
        """Standardised mean squared error, mean((y - mu)^2) / var(y) (paper, section IV)."""
        return _ratio(self.sum_squared_error, self.sum_squared_deviation)


def _ratio(part: float, whole: float) -> float:
    return part / whole if whole else math.nan


def height_error(
    truth: npt.NDArray[np.floating], estimate: npt.NDArray[np.floating]
) -> HeightError:
    """Compare heights.

    Parameters
    ----------
    truth : (n,) float
        True heights of the ground [m].
    estimate : (n,) float
        Estimated ones [m]; NaN where there is no model.
    """
    known = np.isfinite(estimate)
    y = truth[known].astype(np.float64)
    error = estimate[known] - y
    return HeightError(
        n_points=len(y),
        n_without_model=len(truth) - len(y),
        sum_error=float(error.sum()),
        sum_squared_error=float(error @ error),
        sum_squared_deviation=float(np.sum((y - y.mean()) ** 2)) if len(y) else 0.0,
        median_absolute=float(np.median(np.abs(error))) if len(y) else math.nan,
    )


def pool_height_errors(errors: Sequence[HeightError]) -> HeightError:
    """Sum up the errors of several frames."""
    medians = [one.median_absolute for one in errors if one.n_points]
    return HeightError(
        n_points=sum(one.n_points for one in errors),
        n_without_model=sum(one.n_without_model for one in errors),
        sum_error=math.fsum(one.sum_error for one in errors),
        sum_squared_error=math.fsum(one.sum_squared_error for one in errors),
        sum_squared_deviation=math.fsum(one.sum_squared_deviation for one in errors),
        median_absolute=float(np.median(medians)) if medians else math.nan,
    )
