"""The estimated ground by itself: its height at any place, without the scan it came from."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from gp_ground_seg.errors import PointCloudError
from gp_ground_seg.polar_grid import FloatArray
from gp_ground_seg.segmentation import Segmentation
from gp_ground_seg.sensor_pose import LEAST_COSINE, SensorPose

SLOPE_STEPS = 4
"""Steps from the plane of the pose to the surface along a tilted axis: each leaves the slope's
share of the distance, a tenth or so."""


@dataclass(frozen=True)
class GroundModel:
    """Ground height over range in each angular segment.

    Attributes
    ----------
    knots : (K,) float64
        Horizontal ranges, near to far [m].
    height : (M, K) float64
        Ground height at the knots of each segment, in the frame of the scan [m]; NaN
        where there is no model. Segments go counter-clockwise from -x, those of a
        tilted sensor (``Segmentation.pose``) about its own z axis.
    std : (M, K) float64
        Its standard deviation [m]; NaN where there is no model.
    length_scale : (M, K) float64
        Over how far the ground is smooth there [m]; NaN in segments without a ground
        candidate of their own.
    """

    knots: FloatArray
    height: FloatArray
    std: FloatArray
    length_scale: FloatArray

    @classmethod
    def of(cls, segmentation: Segmentation) -> GroundModel:
        """Take the model out of a segmented scan."""
        surface = segmentation.surface
        with np.errstate(over='ignore'):
            length_scale = np.exp(segmentation.log_length_scale)
        model = cls(surface.knots, surface.mean, surface.std, length_scale)
        pose = segmentation.pose
        return model if pose.is_level else model._in_sensor_frame(pose)

    def _in_sensor_frame(self, pose: SensorPose) -> GroundModel:
        """Turn a model in the level frame into one over the sensor's own x and y."""
        points = self.knot_points()
        # Start on the plane that the level frame is level with: a few steps are enough.
        up = pose.rotation[2]
        z = np.full(self.height.shape, np.nan)
        if abs(up[2]) >= LEAST_COSINE:
            z = -(pose.height + points[..., 0] * up[0] + points[..., 1] * up[1]) / up[2]
        for _ in range(SLOPE_STEPS):
            points[..., 2] = z
            level = pose.level(points.reshape(-1, 3)).reshape(points.shape)
            height, std = self.at(level[..., 0], level[..., 1])
            z = pose.ground_z(z, level[..., 2] - height)
        return GroundModel(self.knots, z, std, self.length_scale)

    @property
    def azimuth(self) -> FloatArray:
        """Middle of each segment, (M,) [rad], from -pi on."""
        n_segments = len(self.height)
        middle = (np.arange(n_segments) + 0.5) / n_segments
        return np.asarray(2.0 * np.pi * middle - np.pi, dtype=np.float64)

    def knot_points(self) -> FloatArray:
        """Place of every knot in the middle of its segment, (M, K, 3) [m].

        x and y are always finite; z is NaN where there is no model.
        """
        azimuth = self.azimuth[:, None]
        return np.stack(
            [self.knots * np.cos(azimuth), self.knots * np.sin(azimuth), self.height], axis=-1
        )

    @classmethod
    def from_knot_points(
        cls, points: FloatArray, std: FloatArray, length_scale: FloatArray
    ) -> GroundModel:
        """Model from what `knot_points` gave, rounded or not.

        Parameters
        ----------
        points : (M, K, 3) float array
            Knots of all segments [m].
        std, length_scale : (M, K) float array
            As in the attributes.

        Raises
        ------
        PointCloudError
            If the knots of the segments do not lie on common circles, near to far,
            in the middle of equal segments.
        """
        n_segments, n_knots = points.shape[:2]
        if n_segments < 1 or n_knots < 2:
            raise PointCloudError(
                f'ground model of {n_segments} segments and {n_knots} knots: '
                'must have at least 1 segment and 2 knots'
            )
        points = points.astype(np.float64)
        ranges = np.hypot(points[..., 0], points[..., 1])
        knots: FloatArray = np.median(ranges, axis=0)
        model = cls(
            knots,
            points[..., 2],
            np.asarray(std, dtype=np.float64),
            np.asarray(length_scale, dtype=np.float64),
        )
        strays = np.abs(points[..., :2] - model.knot_points()[..., :2])
        # Not below: NaN is no circle either.
        if not (np.all(np.diff(knots) > 0.0) and np.all(strays <= 1e-6 * (1.0 + knots[:, None]))):
            raise PointCloudError(
                'ground model: points are no grid of segments and ranges about the sensor; '
                'was the cloud transformed or filtered?'
            )
        return model

    def at(self, x: npt.ArrayLike, y: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Ground height and its standard deviation at any place.

        Linear in range between the knots of the segment that the place lies in; nearer
        than the first knot it is the first knot's. The same rule gives
        ``Segmentation.ground_z`` and ``ground_std``.

        Parameters
        ----------
        x, y : array_like of float, broadcast against each other
            Place in the frame of the scan [m].

        Returns
        -------
        height, std : float64 arrays of the broadcast shape
            [m]; NaN beyond the last knot, where there is no model, and for places that
            are not finite.
        """
        x, y = np.broadcast_arrays(np.asarray(x, np.float64), np.asarray(y, np.float64))
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
                known, table[segment, left] * (1.0 - weight) + table[segment, left + 1] * weight,
                np.nan,
            )
            for table in (self.height, self.std)
        )  # fmt: skip
        return height, std
