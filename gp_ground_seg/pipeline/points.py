"""Checks of the points that come in."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from numpy.lib.stride_tricks import as_strided

from gp_ground_seg.compiled.workspace import Workspace
from gp_ground_seg.errors import PointCloudError
from gp_ground_seg.frame import FloatArray, PointArray

COMPUTED = (np.dtype(np.float32), np.dtype(np.float64))
"""Types that are computed with."""


def check_points(points: npt.ArrayLike) -> FloatArray:
    """Return a copy of x, y, z in double precision; parameters and errors of `take_points`."""
    return np.array(take_points(points), dtype=np.float64, order='F')


def take_points(points: npt.ArrayLike) -> PointArray:
    """Return x, y, z, as they lie in memory if their type is one that is computed with.

    Parameters
    ----------
    points : (N, >=3) float array
        Points; columns after the third are ignored.

    Returns
    -------
    xyz : (N, 3) float32 or float64
        Shares memory with `points`, if it can. Single precision for types of up to four
        bytes.

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
    if array.dtype in COMPUTED and array.flags.aligned:
        return array[:, :3]
    if not np.issubdtype(array.dtype, np.floating):
        raise PointCloudError(
            f'points of shape {array.shape} and type {array.dtype}: must be floating point'
        )
    dtype = np.dtype(np.float32 if array.dtype.itemsize <= 4 else np.float64)
    # Bytes from a sensor may be a signalling NaN, one more value that is not finite.
    with np.errstate(invalid='ignore'):
        return array[:, :3].astype(dtype, copy=not array.flags.aligned)


def in_columns(xyz: PointArray, workspace: Workspace) -> PointArray:
    """Return points (N, 3) in the one layout that compiled code is compiled for.

    Each coordinate by itself in a row (Fortran order) and read-only; a copy in
    `workspace` where they lie otherwise.
    """
    if xyz.flags.f_contiguous and xyz.flags.aligned:
        return as_read_only(xyz)
    columns: PointArray = workspace.take('columns', (3, len(xyz)), xyz.dtype)
    with np.errstate(invalid='ignore'):
        for k in range(3):
            columns[k] = xyz[:, k]
    return as_read_only(columns.T)


def single_precision(xyz: PointArray) -> PointArray:
    """Points (N, 3) as float32; `xyz` itself if it is. What is finite stays finite."""
    if xyz.dtype == np.float32:
        return xyz
    largest = np.finfo(np.float32).max
    with np.errstate(over='ignore', invalid='ignore'):
        single = xyz.astype(np.float32)
        too_large = np.isinf(single) & np.isfinite(xyz)
        single[too_large] = np.copysign(largest, xyz[too_large])
    return single


def flat_rows(xyz: PointArray) -> tuple[PointArray, int]:
    """View of the memory from the first x to the last z, and the numbers from row to row.

    Parameters
    ----------
    xyz : (N, 3) float32 or float64
        Points, aligned.

    Returns
    -------
    flat : (L,) float32 or float64
        Read-only; empty where the coordinates of a point do not lie side by side in
        order, or the points not one behind the other.
    step : int
        Coordinate k of point i is ``flat[i * step + k]``.
    """
    size = xyz.dtype.itemsize
    row, column = xyz.strides
    if len(xyz) == 0 or column != size or row < 3 * size or row % size != 0:
        return as_read_only(np.empty(0, dtype=xyz.dtype)), 0
    step = row // size
    length = (len(xyz) - 1) * step + 3
    owner = xyz.base
    if (
        isinstance(owner, np.ndarray)
        and owner.flags.c_contiguous
        and owner.dtype == xyz.dtype
        and owner.shape == (len(xyz), step)
        and np.may_share_memory(owner[:1, :1], xyz[:1, :1])
    ):
        # The first columns of a table: what `as_strided` gives, in a tenth of the time.
        return as_read_only(owner.reshape(-1)[:length]), step
    return as_strided(xyz, (length,), (size,), writeable=False), step


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
