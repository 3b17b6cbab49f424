"""Spinning LiDARs: beam directions, range limits, noise."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from gp_ground_seg.errors import ConfigError

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True)
class SensorModel:
    """A spinning LiDAR and how it is mounted.

    Attributes
    ----------
    name : str
        Name of the model.
    elevations : tuple of float
        Elevation of each beam [rad], highest first; the index is the ring.
    n_columns : int
        Firings per turn.
    min_range, max_range : float
        Ranges outside of these are not reported [m].
    range_std : float
        Standard deviation of the range noise, along the ray [m].
    dropout : float
        Probability that a return is lost.
    height : float
        Height above the ground under the sensor [m].
    roll, pitch : float
        Tilt of the sensor against the level vehicle [rad], REP-103: positive
        roll lowers the right side, positive pitch lowers the nose.

    Raises
    ------
    ConfigError
        If a value is out of range.
    """

    name: str
    elevations: tuple[float, ...]
    n_columns: int
    min_range: float
    max_range: float
    range_std: float
    dropout: float
    height: float
    roll: float = 0.0
    pitch: float = 0.0

    def __post_init__(self) -> None:
        """Check every value."""
        beams = np.asarray(self.elevations)
        self._require(
            beams.size > 0
            and bool((np.abs(beams) < math.pi / 2).all() and (np.diff(beams) < 0).all()),
            'elevations: must be given, within (-pi/2, pi/2) rad, highest first',
        )
        self._require(self.n_columns >= 1, f'n_columns = {self.n_columns}: must be at least 1')
        self._require(
            0.0 <= self.min_range < self.max_range < math.inf,
            f'min_range = {self.min_range}, max_range = {self.max_range}: '
            'must be 0 <= min_range < max_range, finite',
        )
        self._require(
            0.0 <= self.range_std < math.inf, f'range_std = {self.range_std}: must be >= 0 m'
        )
        self._require(0.0 <= self.dropout <= 1.0, f'dropout = {self.dropout}: must be in [0, 1]')
        self._require(0.0 < self.height < math.inf, f'height = {self.height}: must be > 0 m')
        for name in ('roll', 'pitch'):
            angle = getattr(self, name)
            self._require(
                abs(angle) < math.pi / 2, f'{name} = {angle}: must be within (-pi/2, pi/2) rad'
            )

    def _require(self, condition: bool, problem: str) -> None:
        if not condition:
            raise ConfigError(f'sensor {self.name}: {problem}')

    @property
    def n_rays(self) -> int:
        """Rays of one turn."""
        return len(self.elevations) * self.n_columns

    def rings(self) -> npt.NDArray[np.uint16]:
        """Ring of each ray, (R,) uint16, in the order of `directions`."""
        return np.repeat(np.arange(len(self.elevations), dtype=np.uint16), self.n_columns)

    def directions(self, phase: float = 0.0) -> FloatArray:
        """Return the unit vectors of all rays in the sensor frame.

        Parameters
        ----------
        phase : float
            Azimuth of the first firing [rad].

        Returns
        -------
        (R, 3) float64
            Ring by ring from the highest beam down; within a ring counter-clockwise
            from straight ahead, as in KITTI's files.
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


def _beams(*blocks: tuple[float, float, int]) -> tuple[float, ...]:
    """Elevations [rad] of blocks of evenly spaced beams: (highest, lowest [deg], number)."""
    degrees = np.concatenate([np.linspace(high, low, n) for high, low, n in blocks])
    return tuple(np.radians(degrees).tolist())


# Fields of view, ranges and accuracies are those of the makers' data sheets, columns those at
# 10 turns a second. Heights are typical mounts: KITTI's car for the HDL-64E, nuScenes' roof for
# the HDL-32E, a field robot for the VLP-16.
HDL_64E = SensorModel(
    name='hdl-64e',
    elevations=_beams((2.0, -8.33, 32), (-8.83, -24.33, 32)),
    n_columns=2000,
    min_range=0.9,
    max_range=120.0,
    range_std=0.02,
    dropout=0.02,
    height=1.73,
)
HDL_32E = SensorModel(
    name='hdl-32e',
    elevations=_beams((10.67, -30.67, 32)),
    n_columns=2170,
    min_range=0.9,
    max_range=100.0,
    range_std=0.02,
    dropout=0.02,
    height=1.84,
)
VLP_16 = SensorModel(
    name='vlp-16',
    elevations=_beams((15.0, -15.0, 16)),
    n_columns=1800,
    min_range=0.5,
    max_range=100.0,
    range_std=0.03,
    dropout=0.02,
    height=0.8,
)
OS1_128 = SensorModel(
    name='os1-128',
    elevations=_beams((22.5, -22.5, 128)),
    n_columns=1024,
    min_range=0.8,
    max_range=120.0,
    range_std=0.015,
    dropout=0.02,
    height=1.8,
)
