"""LiDARs, spinning or without rings: ray directions, range limits, noise."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from gp_ground_seg.errors import ConfigError
from gp_ground_seg.frame import FloatArray

# Multiples of these fill the unit square evenly: the powers of the plastic number, the
# two-dimensional counterpart of the golden ratio.
_PLASTIC = 1.32471795724474602596
_STRIDES = np.array([1.0 / _PLASTIC, 1.0 / _PLASTIC**2])


@dataclass(frozen=True)
class SensorModel:
    """A spinning LiDAR and how it is mounted; ConfigError if a value is out of range."""

    name: str
    elevations: tuple[float, ...]
    """Elevation of each beam [rad], highest first; the index is the ring."""
    n_columns: int
    """Firings per turn."""
    min_range: float
    max_range: float
    """Ranges outside of these are not reported [m]."""
    range_std: float
    """Standard deviation of the range noise, along the ray [m]."""
    height: float
    """Height above the ground under the sensor [m]."""
    dropout: float = 0.02
    """Probability that a return is lost."""
    roll: float = 0.0
    pitch: float = 0.0
    """Tilt against the level vehicle [rad]: positive roll lowers the right side, positive pitch
    the nose (REP-103)."""

    def __post_init__(self) -> None:
        """Check every value."""
        beams, half = np.asarray(self.elevations), math.pi / 2.0
        in_order = beams.size > 0 and (np.abs(beams) < half).all() and (np.diff(beams) < 0).all()
        self._require(bool(in_order), 'elevations', 'given, within (-pi/2, pi/2), highest first')
        self._require(self.n_columns >= 1, 'n_columns', 'at least 1')
        self._require(0.0 <= self.min_range < self.max_range, 'min_range', '>= 0, < max_range')
        self._require(self.max_range < math.inf, 'max_range', 'finite')
        self._require(0.0 <= self.range_std < math.inf, 'range_std', '>= 0 m, finite')
        self._require(0.0 <= self.dropout <= 1.0, 'dropout', 'in [0, 1]')
        self._require(0.0 < self.height < math.inf, 'height', '> 0 m, finite')
        self._require(abs(self.roll) < half, 'roll', 'within (-pi/2, pi/2) rad')
        self._require(abs(self.pitch) < half, 'pitch', 'within (-pi/2, pi/2) rad')

    def _require(self, condition: bool, name: str, wanted: str) -> None:
        if not condition:
            raise ConfigError(
                f'sensor {self.name}: {name} = {getattr(self, name)}: must be {wanted}'
            )

    @property
    def n_rays(self) -> int:
        """Rays of one turn."""
        return len(self.elevations) * self.n_columns

    def rings(self) -> npt.NDArray[np.uint16]:
        """Ring of each ray, (R,) uint16, in the order of `directions`."""
        return np.repeat(np.arange(len(self.elevations), dtype=np.uint16), self.n_columns)

    def directions(self, phase: float = 0.0) -> FloatArray:
        """Return the unit vectors of all rays in the sensor frame, (R, 3).

        Ring by ring from the highest beam down; within a ring counter-clockwise from the
        azimuth `phase` [rad], 0 = straight ahead, as in KITTI's files.
        """
        azimuth = phase + np.arange(self.n_columns) * (2.0 * math.pi / self.n_columns)
        elevation = np.asarray(self.elevations)[:, None]
        horizontal = np.cos(elevation)
        rays = np.empty((len(self.elevations), self.n_columns, 3))
        rays[..., 0] = horizontal * np.cos(azimuth)
        rays[..., 1] = horizontal * np.sin(azimuth)
        rays[..., 2] = np.sin(elevation)
        return rays.reshape(-1, 3)

    def rotation(self, yaw: float = 0.0) -> FloatArray:
        """Matrix (3, 3) from the sensor frame to the world, for a vehicle that heads to `yaw`."""
        angles = [yaw, self.pitch, self.roll]
        matrix: FloatArray = Rotation.from_euler('ZYX', angles).as_matrix()
        return matrix


@dataclass(frozen=True)
class ScatterModel(SensorModel):
    """A LiDAR whose rays fill its field of view evenly, in another pattern for each scan.

    Takes the place of the prisms of a Livox: what matters to a segmentation is that
    there are no rings. `elevations` holds the ends of the field of view, highest first,
    and `n_columns` is 1.
    """

    n_points: int = 20_000
    """Rays of one scan."""

    def __post_init__(self) -> None:
        """Check every value."""
        super().__post_init__()
        self._require(len(self.elevations) == 2, 'elevations', 'the two ends')
        self._require(self.n_columns == 1, 'n_columns', '1')
        self._require(self.n_points >= 1, 'n_points', 'at least 1')

    @property
    def n_rays(self) -> int:
        """Rays of one scan."""
        return self.n_points

    def rings(self) -> npt.NDArray[np.uint16]:
        """Zeros, (n_points,) uint16: there are no rings."""
        return np.zeros(self.n_points, dtype=np.uint16)

    def directions(self, phase: float = 0.0) -> FloatArray:
        """Return the unit vectors of all rays, (n_points, 3); `phase` changes all of them."""
        turns = phase / (2.0 * math.pi)
        spread = (np.arange(self.n_points)[:, None] * _STRIDES + [turns, 7.0 * turns]) % 1.0
        azimuth = 2.0 * math.pi * spread[:, 0]
        high, low = np.sin(self.elevations)
        # Evenly over the sphere, not over the angle.
        up = high + (low - high) * spread[:, 1]
        flat = np.sqrt(1.0 - up**2)
        rays: FloatArray = np.column_stack([flat * np.cos(azimuth), flat * np.sin(azimuth), up])
        return rays


def _beams(*blocks: tuple[float, float, int]) -> tuple[float, ...]:
    """Elevations [rad] of blocks of evenly spaced beams: (highest, lowest [deg], number)."""
    degrees = np.concatenate([np.linspace(high, low, n) for high, low, n in blocks])
    return tuple(np.radians(degrees).tolist())


# Fields of view, ranges and accuracies are those of the makers' data sheets, columns those at
# 10 turns a second. Heights are typical mounts: KITTI's car for the HDL-64E, nuScenes' roof for
# the HDL-32E, field robots for the VLP-16 and the Mid-360.
HDL_64E, HDL_32E, VLP_16, OS1_128 = (
    SensorModel(name, _beams(*blocks), n_columns, nearest, farthest, range_std, height)
    for name, blocks, n_columns, nearest, farthest, range_std, height in (
        ('hdl-64e', ((2.0, -8.33, 32), (-8.83, -24.33, 32)), 2000, 0.9, 120.0, 0.02, 1.73),
        ('hdl-32e', ((10.67, -30.67, 32),), 2170, 0.9, 100.0, 0.02, 1.84),
        ('vlp-16', ((15.0, -15.0, 16),), 1800, 0.5, 100.0, 0.03, 0.8),
        ('os1-128', ((22.5, -22.5, 128),), 1024, 0.8, 120.0, 0.015, 1.8),
    )
)
MID_360 = ScatterModel(
    'mid-360', (math.radians(52.0), math.radians(-7.0)), 1, 0.1, 40.0, range_std=0.02, height=0.5
)
SENSORS = {sensor.name: sensor for sensor in (HDL_64E, HDL_32E, VLP_16, OS1_128, MID_360)}
"""The preset sensors by name."""
