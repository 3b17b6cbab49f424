"""Checks of the points that come in."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from gp_ground_seg.errors import PointCloudError
from gp_ground_seg.polar_grid import FloatArray


def check_points(points: npt.ArrayLike) -> tuple[FloatArray, npt.NDArray[np.bool_]]:
    """Return x, y, z in double precision and which points are finite.

    Parameters
    ----------
    points : (N, >=3) float array
        Points; columns after the third are ignored.

    Returns
    -------
    xyz : (N, 3) float64
        A copy.
    finite : (N,) bool
        Whether x, y and z are all finite.

    Raises
    ------
    PointCloudError
        If the shape or type is another; the message holds both.
    """
    array = np.asarray(points)
    if array.ndim != 2 or array.shape[1] < 3:
        raise PointCloudError(
            f'points of shape {array.shape} and type {array.dtype}: must be (N, 3) or wider'
        )
    if not np.issubdtype(array.dtype, np.floating):
        raise PointCloudError(
            f'points of shape {array.shape} and type {array.dtype}: must be floating point'
        )
    # Bytes from a sensor may be a signalling NaN, one more value that is not finite.
    with np.errstate(invalid='ignore'):
        # In one order: compiled code is compiled for each.
        xyz = array[:, :3].astype(np.float64, order='C')
    # Column by column: a reduction along rows of three takes ten times as long.
    finite = np.isfinite(xyz[:, 0]) & np.isfinite(xyz[:, 1]) & np.isfinite(xyz[:, 2])
    return xyz, finite
