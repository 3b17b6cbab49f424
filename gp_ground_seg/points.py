"""Checks of the points that come in."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from gp_ground_seg.errors import PointCloudError
from gp_ground_seg.polar_grid import FloatArray, PointArray
from gp_ground_seg.workspace import Workspace


def check_points(points: npt.ArrayLike) -> FloatArray:
    """Return a copy of x, y, z in double precision; parameters and errors of `take_points`."""
    return take_points(points, Workspace()).astype(np.float64)


def take_points(points: npt.ArrayLike, workspace: Workspace) -> PointArray:
    """Return x, y, z in the one layout that the compiled code is compiled for.

    Parameters
    ----------
    points : (N, >=3) float array
        Points; columns after the third are ignored.
    workspace : Workspace
        Where to put a copy, if one is needed.

    Returns
    -------
    xyz : (N, 3) float32 or float64
        Each coordinate by itself in a row (Fortran order) and read-only; may share
        memory with `points`. Single precision for types of up to four bytes.

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
    dtype = np.dtype(np.float32 if array.dtype.itemsize <= 4 else np.float64)
    fits = array.flags.f_contiguous and array.flags.aligned
    if fits and array.dtype == dtype and array.shape[1] == 3:
        return as_read_only(array)
    # Bytes from a sensor may be a signalling NaN, one more value that is not finite.
    with np.errstate(invalid='ignore'):
        columns = workspace.take('columns', (3, len(array)), dtype)
        for k in range(3):
            columns[k] = array[:, k]
    return as_read_only(columns.T)


def as_read_only(xyz: PointArray) -> PointArray:
    """View of the same memory; for compiled code what may be written to is another type."""
    view = xyz.view(np.ndarray)
    view.flags.writeable = False
    return view


def finite_points(xyz: FloatArray) -> npt.NDArray[np.bool_]:
    """Which points (N, 3) have three finite coordinates, (N,) bool."""
    # Column by column: a reduction along rows of three takes ten times as long.
    finite: npt.NDArray[np.bool_] = np.isfinite(xyz[:, 0])
    finite &= np.isfinite(xyz[:, 1])
    finite &= np.isfinite(xyz[:, 2])
    return finite
