"""The estimated ground by itself: its height at any place, without the scan it came from."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from gp_ground_seg.core.errors import PointCloudError
from gp_ground_seg.core.frame import FloatArray, usual_errors
from gp_ground_seg.core.pipeline.points import rotation
from gp_ground_seg.core.result import Segmentation

N_ITERATIONS = 12
"""Steps along the z axis of a tilted frame to the ground; each leaves slope times tangent of
the tilt of the error before."""
STEEPEST = 0.1
"""Cosine of the tilt from which on the z axis is taken to meet the ground."""


@dataclass(frozen=True, eq=False)
class GroundModel:
    """Ground height over range in each angular segment, about the sensor's vertical.

    Attributes
    ----------
    knots : (K,) float64
        Horizontal ranges, near to far [m].
    height : (M, K) float64
        Height of the ground over the sensor at the knots of each segment [m], so mostly
        negative; NaN where there is no model. Segments go counter-clockwise from -x.
    std : (M, K) float64
        Standard deviation of the height [m], as in ``Segmentation.ground_std``; NaN where there
        is no model.
    length_scale : (M, K) float64
        Distance over which the height of the ground is similar [m]; NaN in segments without
        a ground candidate of their own.
    roll, pitch : float
        Tilt of the frame of the scan: angles that make it level [rad].
    """

    knots: FloatArray
    height: FloatArray
    std: FloatArray
    length_scale: FloatArray
    roll: float = 0.0
    pitch: float = 0.0

    @classmethod
    @usual_errors()
    def of(cls, segmentation: Segmentation) -> GroundModel:
        """Take the corrected surface out of a segmented scan."""
        surface, pose = segmentation.corrected, segmentation.pose
        with np.errstate(over='ignore'):
            length_scale = np.exp(segmentation.log_length_scale)
        return cls(surface.knots, surface.mean, surface.std, length_scale, pose.roll, pose.pitch)

    @property
    def azimuth(self) -> FloatArray:
        """Middle of each segment, (M,) [rad], from -pi on."""
        n_segments = len(self.height)
        middle = (np.arange(n_segments) + 0.5) / n_segments
        return np.asarray(2.0 * np.pi * middle - np.pi, dtype=np.float64)

    @property
    def is_level(self) -> bool:
        """Whether z of the scan's frame is up."""
        return self.roll == 0.0 and self.pitch == 0.0

    @usual_errors()
    def knot_points(self, n_std: float = 0.0) -> FloatArray:
        """Place of every knot in the middle of its segment, frame of the scan, (M, K, 3) [m].

        NaN where there is no model.

        Parameters
        ----------
        n_std : float
            Standard deviations above the ground, upright.
        """
        azimuth = self.azimuth[:, None]
        height = self.height + n_std * self.std
        known = np.isfinite(height)
        level = np.stack(
            [
                np.where(known, self.knots * np.cos(azimuth), np.nan),
                np.where(known, self.knots * np.sin(azimuth), np.nan),
                height,
            ],
            axis=-1,
        )
        if self.is_level:
            return level
        points: FloatArray = level @ rotation(self.roll, self.pitch)
        return points

    @classmethod
    @usual_errors()
    def from_knot_points(
        cls,
        points: FloatArray,
        knots: FloatArray,
        std: FloatArray,
        length_scale: FloatArray,
        roll: float,
        pitch: float,
    ) -> GroundModel:
        """Model from what `knot_points` gave, rounded or not.

        Parameters
        ----------
        points : (M, K, 3) float array
            Knots of all segments [m].
        knots, std, length_scale, roll, pitch
            As in the attributes.

        Raises
        ------
        PointCloudError
            If the knots of the segments do not lie at their ranges in the middle of
            equal segments.
        """
        n_segments, n_knots = points.shape[:2]
        if n_segments < 1 or n_knots < 2:
            raise PointCloudError(
                f'ground model of {n_segments} segments and {n_knots} knots: '
                'must have at least 1 segment and 2 knots'
            )
        with np.errstate(invalid='ignore'):
            level = points.astype(np.float64) @ rotation(roll, pitch).T
        model = cls(
            knots.astype(np.float64),
            level[..., 2],
            np.asarray(std, dtype=np.float64),
            np.asarray(length_scale, dtype=np.float64),
            roll,
            pitch,
        )
        with np.errstate(invalid='ignore'):
            strays = np.abs(points - model.knot_points()).max(axis=-1)
        # Not above: where x and y are NaN and z is not, so is the distance.
        near = (strays <= 1e-5 * (1.0 + model.knots)) | np.isnan(level[..., 2])
        if not (np.all(np.diff(model.knots) > 0.0) and near.all()):
            raise PointCloudError(
                'ground model: points are no grid of segments and ranges about the sensor; '
                'was the cloud transformed or filtered?'
            )
        return model

    @usual_errors()
    def at(self, x: npt.ArrayLike, y: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Height of the ground along the z axis, and its standard deviation, at any place.

        Linear in range between the knots of the segment that the place lies in; nearer
        than the first knot it is the first knot's. The same rule gives ``ground_std`` of a
        `Segmentation`, and its ``ground_z`` but for the relief: that is here the one in the
        middle of the segment, there that at each point. In a tilted frame this is where the
        line through the place along z meets the ground, on any slope.

        Parameters
        ----------
        x, y : array_like of float, broadcast against each other
            Place in the frame of the scan [m].

        Returns
        -------
        height, std : float64 arrays of the broadcast shape
            z in the frame of the scan, and the (upright) standard deviation [m]; NaN beyond
            the last knot, where there is no model, and for places that are not finite.
        """
        x, y = np.broadcast_arrays(np.asarray(x, np.float64), np.asarray(y, np.float64))
        if self.is_level:
            return self._over_level(x, y)
        matrix = rotation(self.roll, self.pitch)
        if abs(matrix[2, 2]) < STEEPEST:
            nothing = np.full(x.shape, np.nan)
            return nothing, nothing.copy()
        finite = np.isfinite(x) & np.isfinite(y)
        x, y = np.where(finite, x, np.nan), np.where(finite, y, np.nan)
        known = self.height[np.isfinite(self.height)]
        start = float(np.median(known)) if len(known) else 0.0
        z = (start - matrix[2, 0] * x - matrix[2, 1] * y) / matrix[2, 2]
        std = np.full(x.shape, np.nan)
        for _ in range(N_ITERATIONS):
            level = np.stack([x, y, z], axis=-1) @ matrix.T
            height, std = self._over_level(level[..., 0], level[..., 1])
            z = z + (height - level[..., 2]) / matrix[2, 2]
        return z, std

    def _over_level(self, x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Height and standard deviation at places of the level frame."""
        finite = np.isfinite(x) & np.isfinite(y)
        x, y = np.where(finite, x, 0.0), np.where(finite, y, 0.0)
        n_segments, n_knots = self.height.shape
        turn = np.arctan2(y, x) / (2.0 * np.pi) + 0.5
        segment = (turn * n_segments).astype(np.int64) % n_segments
        r = np.hypot(x, y)
        left = np.clip(np.searchsorted(self.knots, r, side='right') - 1, 0, n_knots - 2)
        near, far = self.knots[left], self.knots[left + 1]
        weight = np.clip((r - near) / (far - near), 0.0, 1.0)
        known = finite & (r < self.knots[-1])
        height, std = (
            np.where(
                known,
                table[segment, left] * (1.0 - weight) + table[segment, left + 1] * weight,
                np.nan,
            )
            for table in (self.height, self.std)
        )
        return height, std
