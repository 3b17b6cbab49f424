"""Check of the input points, and the one layout that the stages work on."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from gp_ground_seg.core.errors import PointCloudError
from gp_ground_seg.core.frame import BoolArray, FloatArray, PointArray

COMPUTED = (np.dtype(np.float32), np.dtype(np.float64))
"""Types that are computed with."""
FARTHEST = 1e4
"""Range beyond which no sensor measures [m]."""
_MAX_BEYOND = 0.1  # share of the points that may lie there, as wrong returns
_N_JUDGED = 1000  # points looked at in a larger cloud
_MOST_ROWS, _LEAST_COLUMNS = 8, 65  # of an array that is taken for a transposed one


def take_points(points: npt.ArrayLike) -> PointArray:
    """Return x, y, z, as they lie in memory if their type is one that is computed with.

    Of `points` (N, >=3) columns after the third are ignored. The result (N, 3) shares memory with
    them, if it can; it is of single precision for types of up to four bytes. Raises a
    PointCloudError if the shape or type is another, the array is masked or transposed, or the
    points are farther away than `FARTHEST`.
    """
    if isinstance(points, np.ma.MaskedArray):
        raise PointCloudError('points are a masked array: pass points.filled(numpy.nan)')
    array = np.asarray(points)
    if array.ndim != 2 or array.shape[1] < 3:
        raise PointCloudError(
            f'points of shape {array.shape} and type {array.dtype}: must be (N, 3) or wider'
        )
    if array.shape[0] <= _MOST_ROWS and array.shape[1] >= _LEAST_COLUMNS:
        raise PointCloudError(
            f'points of shape {array.shape}: a point is a row; pass points.T, if they are columns'
        )
    if not np.issubdtype(array.dtype, np.floating):
        raise PointCloudError(
            f'points of shape {array.shape} and type {array.dtype}: must be floating point'
        )
    if problem := objection_to_ranges(array[:: 1 + len(array) // _N_JUDGED, :3]):
        raise PointCloudError(problem)
    if array.dtype in COMPUTED and array.flags.aligned:
        return array[:, :3]
    dtype = np.dtype(np.float32 if array.dtype.itemsize <= 4 else np.float64)
    # Bytes from a sensor may be a signalling NaN, one more value that is not finite.
    with np.errstate(invalid='ignore'):
        return array[:, :3].astype(dtype, copy=not array.flags.aligned)


@np.errstate(all='ignore')
def objection_to_ranges(xyz: PointArray) -> str:
    """Return what is wrong where points (N, 3) are farther away than a sensor measures, or ''."""
    x, y, z = np.abs(xyz).T
    is_beyond = finite_points(xyz) & ((x > FARTHEST) | (y > FARTHEST) | (z > FARTHEST))
    if is_beyond.sum() <= _MAX_BEYOND * len(xyz):
        return ''
    middle = ', '.join(f'{value:.1f}' for value in np.median(xyz[is_beyond], axis=0))
    return (
        f'{is_beyond.mean():.0%} of the points are beyond 10 km, about {middle}; scans are in '
        'metres about the sensor: of a map, subtract its place there in double precision, as in '
        "xyz = points[:, :3] - (X, Y, Z); numpy.save('near.npy', xyz.astype('float32'))"
    )


def check_points(points: npt.ArrayLike) -> FloatArray:
    """Return a copy of x, y, z in double precision; parameters and errors of `take_points`."""
    return np.array(take_points(points), dtype=np.float64, order='F')


def copy_points(xyz: PointArray, columns: PointArray) -> None:
    """Copy points (N, 3) to `columns` (3, N), of their type: the caller may change its array."""
    with np.errstate(invalid='ignore'):
        columns[...] = xyz.T


def points_in(columns: PointArray) -> PointArray:
    """Return points (N, 3), read-only, whose coordinates lie in `columns` (3, N)."""
    result: PointArray = columns.T
    # To compiled code, arrays that may be written to are another type.
    result.flags.writeable = False
    return result


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


def finite_points(xyz: PointArray) -> BoolArray:
    """Which points (N, 3) have three finite coordinates, (N,) bool."""
    # Column by column: a reduction along rows of three takes ten times as long.
    finite: BoolArray = np.isfinite(xyz[:, 0])
    finite &= np.isfinite(xyz[:, 1])
    finite &= np.isfinite(xyz[:, 2])
    return finite
