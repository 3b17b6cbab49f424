"""The estimated ground by itself: its height at any place, without the scan it came from."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from gp_ground_seg.core.errors import PointCloudError
from gp_ground_seg.core.frame import FloatArray, IntArray, PointArray, usual_errors
from gp_ground_seg.core.pipeline.points import Direction, rotation
from gp_ground_seg.core.result import Segmentation

N_ITERATIONS = 12
"""Steps along the z axis of a tilted frame to the ground: each reduces the error by slope times
tangent of the tilt."""
STEEPEST = 0.1
"""Cosine of the tilt below which the z axis is not taken to meet the ground."""


def segment_of(x: PointArray, y: PointArray, n_segments: int) -> IntArray:
    """Which of `n_segments` equal segments, counter-clockwise from -x, finite places lie in."""
    turn = np.arctan2(y, x) / (2.0 * np.pi) + 0.5
    return (turn * n_segments).astype(np.int64) % n_segments


@dataclass(frozen=True, eq=False)
class GroundModel:
    """Ground height over range in each angular segment, about the sensor's vertical."""

    knots: FloatArray  #: (K,) horizontal ranges, near to far [m]
    #: (M, K) height of the ground over the sensor at the knots of each segment [m], so mostly
    #: negative; NaN where there is no model. Segments go counter-clockwise from -x.
    height: FloatArray
    #: (M, K) standard deviation of the height [m], as in ``Segmentation.ground_std``; NaN where
    #: there is no model
    std: FloatArray
    #: (M, K) distance over which the height of the ground is similar [m]; NaN in segments without
    #: a ground candidate of their own
    length_scale: FloatArray
    roll: float = 0.0  #: tilt of the frame of the scan (angles that make it level) [rad]
    pitch: float = 0.0  #: the same [rad]
    origin: Direction = (0.0, 0.0, 0.0)  #: place of the sensor in the frame of the scan [m]

    @classmethod
    @usual_errors()
    def of(cls, segmentation: Segmentation) -> GroundModel:
        """Take the corrected surface out of a segmented scan."""
        surface, pose = segmentation.corrected, segmentation.pose
        with np.errstate(over='ignore'):
            length_scale = np.exp(segmentation.log_length_scale)
        tables = surface.knots, surface.mean, surface.std, length_scale
        return cls(*tables, pose.roll, pose.pitch, pose.origin)

    @usual_errors()
    def knot_points(self) -> FloatArray:
        """Place of every knot in the middle of its segment, frame of the scan, (M, K, 3) [m].

        NaN where there is no model.
        """
        n_segments = len(self.height)
        middle = (np.arange(n_segments)[:, None] + 0.5) / n_segments
        azimuth = 2.0 * np.pi * middle - np.pi
        along = (self.knots * np.cos(azimuth), self.knots * np.sin(azimuth), self.height)
        level = np.where(np.isfinite(self.height)[..., None], np.stack(along, axis=-1), np.nan)
        return np.asarray(level @ rotation(self.roll, self.pitch) + self.origin)

    @classmethod
    @usual_errors()
    def from_columns(cls, columns: Mapping[str, npt.NDArray[np.floating]]) -> GroundModel:
        """Model from the columns, (M, K) each, of a cloud of ``~/ground_model``, rounded or not.

        Raises
        ------
        PointCloudError
            If the knots of the segments do not lie at their ranges in the middle of
            equal segments.
        """
        points = np.stack([columns[axis] for axis in 'xyz'], axis=-1)
        n_segments, n_knots = points.shape[:2]
        if n_segments < 1 or n_knots < 2:
            raise PointCloudError(
                f'ground model of {n_segments} segments and {n_knots} knots: '
                'must have at least 1 segment and 2 knots'
            )
        numbers = {name: column.astype(np.float64) for name, column in columns.items()}
        roll, pitch, x, y, z = (
            float(numbers[name][0, 0])
            for name in ('roll', 'pitch', 'origin_x', 'origin_y', 'origin_z')
        )
        with np.errstate(invalid='ignore'):
            height = ((points.astype(np.float64) - (x, y, z)) @ rotation(roll, pitch).T)[..., 2]
            knots, rest = numbers['range'][0], (numbers['std'], numbers['length_scale'])
            model = cls(knots, height, *rest, roll, pitch, (x, y, z))
            strays = np.abs(points - model.knot_points()).max(axis=-1)
        # Where x and y are NaN and z is not, so is the distance, and the knot is no near one.
        near = (strays <= 1e-5 * (1.0 + knots)) | np.isnan(height)
        if not (np.all(np.diff(knots) > 0.0) and near.all()):
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
        finite = np.isfinite(x) & np.isfinite(y)
        shift_x, shift_y, lift = self.origin
        x, y = np.where(finite, x - shift_x, np.nan), np.where(finite, y - shift_y, np.nan)
        matrix, z, std = rotation(self.roll, self.pitch), *np.full((2, *x.shape), np.nan)
        if abs(matrix[2, 2]) < STEEPEST:
            return z, std
        known = self.height[np.isfinite(self.height)]
        start = float(np.median(known)) if len(known) else 0.0
        z = (start - matrix[2, 0] * x - matrix[2, 1] * y) / matrix[2, 2]
        for _ in range(N_ITERATIONS if self.roll or self.pitch else 1):
            level = np.stack([x, y, z], axis=-1) @ matrix.T
            height, std = self._over_level(level[..., 0], level[..., 1])
            z = z + (height - level[..., 2]) / matrix[2, 2]
        return z + lift, std

    def _over_level(self, x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Height and standard deviation at places of the level frame; NaN for those of NaN."""
        r = np.hypot(x, y)
        known = r < self.knots[-1]
        r, x, y = (np.where(known, values, 0.0) for values in (r, x, y))
        segment = segment_of(x, y, len(self.height))
        left = np.clip(np.searchsorted(self.knots, r, side='right') - 1, 0, len(self.knots) - 2)
        near, far = self.knots[left], self.knots[left + 1]
        weight = np.clip((r - near) / (far - near), 0.0, 1.0)
        height, std = (
            table[segment, left] * (1.0 - weight) + table[segment, left + 1] * weight
            for table in (self.height, self.std)
        )
        return np.where(known, height, np.nan), np.where(known, std, np.nan)
