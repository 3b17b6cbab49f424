"""LiDARs that scan without rings and never twice the same."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from gp_ground_seg.simulation.sensor import FloatArray, SensorModel

# Multiples of these fill the unit square evenly: the powers of the plastic number, the
# two-dimensional counterpart of the golden ratio.
_PLASTIC = 1.32471795724474602596
_STRIDES = np.array([1.0 / _PLASTIC, 1.0 / _PLASTIC**2])


@dataclass(frozen=True)
class ScatterModel(SensorModel):
    """A LiDAR whose rays fill its field of view evenly, in another pattern for each scan.

    Takes the place of the prisms of a Livox: what matters to a segmentation is that
    there are no rings. `elevations` holds the ends of the field of view, highest first,
    and `n_columns` is 1.

    Attributes
    ----------
    n_points : int
        Rays of one scan.
    """

    n_points: int = 20_000

    def __post_init__(self) -> None:
        """Check every value."""
        super().__post_init__()
        self._require(len(self.elevations) == 2, 'elevations: must be the two ends')
        self._require(self.n_columns == 1, f'n_columns = {self.n_columns}: must be 1')
        self._require(self.n_points >= 1, f'n_points = {self.n_points}: must be at least 1')

    @property
    def n_rays(self) -> int:
        """Rays of one scan."""
        return self.n_points

    def rings(self) -> npt.NDArray[np.uint16]:
        """Zeros, (n_points,) uint16: there are no rings."""
        return np.zeros(self.n_points, dtype=np.uint16)

    def directions(self, phase: float = 0.0) -> FloatArray:
        """Return the unit vectors of all rays in the sensor frame, (n_points, 3).

        Parameters
        ----------
        phase : float
            Azimuth of the first ray [rad]; decides on the elevations too.
        """
        turns = phase / (2.0 * math.pi)
        spread = (np.arange(self.n_points)[:, None] * _STRIDES + [turns, 7.0 * turns]) % 1.0
        azimuth = 2.0 * math.pi * spread[:, 0]
        high, low = np.sin(self.elevations)
        # Evenly over the sphere, not over the angle.
        up = high + (low - high) * spread[:, 1]
        flat = np.sqrt(1.0 - up**2)
        rays: FloatArray = np.column_stack([flat * np.cos(azimuth), flat * np.sin(azimuth), up])
        return rays


# Field of view, rate, range and accuracy of the maker's data sheet; on a field robot.
MID_360 = ScatterModel(
    name='mid-360',
    elevations=(math.radians(52.0), math.radians(-7.0)),
    n_columns=1,
    min_range=0.1,
    max_range=40.0,
    range_std=0.02,
    dropout=0.02,
    height=0.5,
    n_points=20_000,
)
