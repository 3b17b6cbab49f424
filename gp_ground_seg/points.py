"""Checks of the points that come in."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from gp_ground_seg.errors import PointCloudError
from gp_ground_seg.polar_grid import FloatArray
from gp_ground_seg.workspace import Workspace


def check_points(points: npt.ArrayLike, workspace: Workspace | None = None) -> FloatArray:
    """Return x, y, z in double precision.

    Parameters
    ----------
    points : (N, >=3) float array
        Points; columns after the third are ignored.
    workspace : Workspace, optional
        Where to put the copy; by default in a new array.

    Returns
    -------
    xyz : (N, 3) float64
        A copy.

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
        shape = len(array), 3
        xyz = np.empty(shape) if workspace is None else workspace.take('xyz', shape, np.float64)
        # Column by column: rows of three are too short for the loop within numpy.
        for k in range(3):
            xyz[:, k] = array[:, k]
    return xyz


def finite_points(xyz: FloatArray) -> npt.NDArray[np.bool_]:
    """Which points (N, 3) have three finite coordinates, (N,) bool."""
    # Column by column: a reduction along rows of three takes ten times as long.
    finite: npt.NDArray[np.bool_] = np.isfinite(xyz[:, 0])
    finite &= np.isfinite(xyz[:, 1])
    finite &= np.isfinite(xyz[:, 2])
    return finite
