"""Roll and pitch: between angles, rotations and the direction that is up."""

from __future__ import annotations

import math
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from gp_ground_seg.core.frame import FloatArray
from gp_ground_seg.core.pipeline.points import finite_points

Direction = tuple[float, float, float]

ENOUGH_POINTS = 20000
"""Points that show well enough which way is up."""
LARGEST = {4: 1e38, 8: 1e300}
"""By bytes: coordinates beyond this are taken to be this [m]: sums of three still are numbers."""
_Float = TypeVar('_Float', np.float32, np.float64)


def rotation(roll: float, pitch: float) -> FloatArray:
    """Matrix (3, 3) that turns vectors of a sensor with these angles [rad] into the level frame.

    Sines and cosines of quarter turns are exact: axes swapped stay points swapped.
    """
    (sr, cr), (sp, cp) = (_sine_cosine(angle) for angle in (roll, pitch))
    return np.array([[cp, sp * sr, sp * cr], [0.0, cr, -sr], [-sp, cp * sr, cp * cr]])


def _sine_cosine(angle: float) -> tuple[float, float]:
    sine, cosine = math.sin(angle), math.cos(angle)
    return (0.0 if abs(sine) < 1e-12 else sine), (0.0 if abs(cosine) < 1e-12 else cosine)


def vertical(roll: float, pitch: float) -> Direction:
    """Last row of `rotation`: the direction that is up, in the frame of the sensor."""
    (sr, cr), (sp, cp) = _sine_cosine(roll), _sine_cosine(pitch)
    return -sp, cp * sr, cp * cr


def rotate(xyz: npt.NDArray[_Float], matrix: FloatArray) -> npt.NDArray[_Float]:
    """Points (N, 3) turned by a rotation (3, 3), in their own precision.

    Finite ones stay finite, others become NaN. It is computed in double precision; rounded to
    single, a point 100 m away moves by 4 um.
    """
    largest = LARGEST[xyz.dtype.itemsize]
    x, y, z = np.clip(xyz, -largest, largest).T.astype(np.float64)
    columns = np.empty((3, len(xyz)), dtype=xyz.dtype)
    with np.errstate(invalid='ignore'):
        # Not a matrix product: BLAS would wake its threads, which spin long after.
        for i, (a, b, c) in enumerate(matrix.tolist()):
            columns[i] = a * x + b * y + c * z
    columns[:, ~finite_points(xyz)] = np.nan
    result: npt.NDArray[_Float] = columns.T
    return result


def angles_of(up: FloatArray | Direction) -> tuple[float, float]:
    """Roll and pitch [rad] of a sensor in whose frame the unit vector `up` (3,) points up.

    Where rounding would decide it, the roll is 0 (x points up or down) or half a turn to the left.
    """
    across = math.hypot(up[1], up[2])
    roll = rounded(math.atan2(up[1], up[2])) if across > 1e-4 else 0.0
    return roll if roll > -rounded(math.pi) else -roll, rounded(math.atan2(-up[0], across))


def turned_back(direction: Direction, matrix: FloatArray) -> Direction:
    """Direction in the frame that the rotation `matrix` (3, 3) starts from."""
    x, y, z = (matrix.T @ direction).tolist()
    return x, y, z


def rounded(value: float) -> float:
    """Round to 5 digits: below what a scan tells, above how backends and orders of sums differ."""
    return round(value, 5) + 0.0
