"""Points: check of the input, the one layout that the stages work on, and turning by angles."""

import math
from collections.abc import Sequence
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from gp_ground_seg.core.errors import PointCloudError
from gp_ground_seg.core.frame import BoolArray, FloatArray, IntArray, PointArray

Direction = tuple[float, float, float]

COMPUTED = (np.dtype(np.float32), np.dtype(np.float64))
"""Types that are computed with."""
FARTHEST = 1e4
"""Range beyond which no sensor measures [m]."""
ENOUGH_POINTS = 20000
"""Points that show well enough which way is up."""
LARGEST = 1e38
"""Coordinates beyond this are taken to be this [m]: sums of three fit single precision."""
SINGLE = 2.0**-23
"""Rounding of single precision, in parts of a number."""
_MAX_BEYOND = 0.1  # share of the points that may lie there, as wrong returns
_N_JUDGED = 1000  # points looked at in a larger cloud
_MANY, _MANY_SHARE = 1000, 0.03  # points, and share of all, that repeat one place: no returns do
_FARTHEST_MOUNT = 5.0  # distance of such a place from the origin of a vehicle's cloud [m]
_N_ALIKE = 10  # points of a sample of `_N_JUDGED` that show such a place
# Where a sample is taken, as shares of the number of points: in steps of the golden ratio, which
# fall on all rings and columns alike.
_SAMPLE = np.arange(_N_JUDGED) * ((math.sqrt(5.0) - 1.0) / 2.0) % 1.0
_MOST_ROWS, _LEAST_COLUMNS = 8, 65  # of an array that is taken for a transposed one
_Float = TypeVar('_Float', np.float32, np.float64)


def take_points(points: npt.ArrayLike, origin: Direction | None = None) -> PointArray:
    """Return x, y, z, as they lie in memory if their type is one that is computed with.

    Of `points` (N, >=3) columns after the third are ignored. The result (N, 3) shares memory with
    them, if it can; it is of single precision for types of up to four bytes. With the `origin` of
    the sensor [m] it is a copy, each coordinate contiguous, and points that are no returns are NaN
    in it: see `leave_out_empty_rays`.
    Raises a PointCloudError if the shape or type is another, the array is masked or transposed,
    or the points are farther away than `FARTHEST`.
    """
    if isinstance(points, np.ma.MaskedArray):
        raise PointCloudError('points are a masked array: pass points.filled(numpy.nan)')
    array = np.asarray(points)
    if array.ndim != 2 or array.shape[1] < 3:
        raise PointCloudError(
            f'points of shape {array.shape} and type {array.dtype}: must be (N, 3) or wider'
            f'{hint_of_table(array)}'
        )
    if array.shape[0] <= _MOST_ROWS and array.shape[1] >= _LEAST_COLUMNS:
        raise PointCloudError(
            f'points of shape {array.shape}: a point is a row; pass points.T, if they are columns'
        )
    if not np.issubdtype(array.dtype, np.floating):
        hint = '; pass points.astype(float)' if array.dtype.kind in 'iuO' else ''
        raise PointCloudError(
            f'points of shape {array.shape} and type {array.dtype}: must be floating point{hint}'
        )
    xyz = array[:, :3]
    # Bytes from a sensor may be a signalling NaN, one more value that is not finite.
    with np.errstate(invalid='ignore', over='ignore'):
        if array.dtype not in COMPUTED or not array.flags.aligned:
            dtype = np.dtype(np.float32 if array.dtype.itemsize <= 4 else np.float64)
            xyz = xyz.astype(dtype, copy=not array.flags.aligned)
        if origin is not None:
            xyz = np.array(xyz, order='F')
            leave_out_empty_rays(xyz, origin, array.dtype)
    if problem := objection_to_ranges(xyz[:: 1 + len(xyz) // _N_JUDGED]):
        raise PointCloudError(problem)
    return xyz


def hint_of_table(array: npt.NDArray[Any]) -> str:
    """Return how an array becomes a table of points: a structured or flat one, or an image."""
    shape = array.shape
    first, last = (shape[0], shape[-1]) if len(shape) > 2 else (0, 0)
    hints = {
        "numpy.stack([points[name] for name in 'xyz'], axis=1)": bool(array.dtype.names),
        '.reshape(-1, COLUMNS)': len(shape) == 1,
        f'.reshape(-1, {last})': 3 <= last <= _MOST_ROWS,
        f'.reshape({first}, -1).T': 3 <= first <= _MOST_ROWS,
    }
    return next((f'; it is a table after {how}' for how, helps in hints.items() if helps), '')


def leave_out_empty_rays(xyz: PointArray, origin: Direction, written: np.dtype[Any]) -> None:
    """Set the points (N, 3) at the sensor to NaN.

    Drivers send rays without a return as (0, 0, 0), which a change of frame moves to the `origin`
    of the sensor [m]. It is compared as rounded to the type `written`, or to single precision if
    that has more digits: coordinates mostly were of single precision once. Where nobody has given
    the origin, it is a place that many points share; so are those of several sensors.
    """
    rounding = SINGLE if written.itemsize >= 4 else float(np.finfo(written).eps)
    empty = [_points_at(place, xyz, rounding) for place in {(0.0, 0.0, 0.0), origin}]
    for place in _shared_places(xyz):
        alike = _points_at(place, xyz, 0.0)
        empty += [alike] if len(alike) >= max(_MANY, _MANY_SHARE * len(xyz)) else []
    for indices in empty:
        xyz[indices] = np.nan


def _points_at(place: Direction, xyz: PointArray, rounding: float) -> IntArray:
    """Return the points (N, 3) that are at `place` but for `rounding`."""
    tolerance, x = rounding * max(map(abs, place)), xyz[:, 0]
    # Few points have this x, mostly none, and only those are looked at further.
    near = np.flatnonzero(np.abs(x - place[0]) <= tolerance if tolerance else x == place[0])
    for axis in (1, 2):
        near = near[np.abs(xyz[near, axis] - place[axis]) <= tolerance]
    return near


def _shared_places(xyz: PointArray) -> list[Direction]:
    """Return where sensors may be: what several of the points (N, 3) are."""
    if len(xyz) < _MANY:
        return []
    sample = (_SAMPLE * len(xyz)).astype(np.int64)
    ordered = np.sort(xyz[sample, 0])
    if not (ordered[_N_ALIKE - 1 :] == ordered[: 1 - _N_ALIKE]).any():
        return []
    rows, number = np.unique(xyz[sample], axis=0, return_counts=True)
    places = [(a, b, c) for a, b, c in rows[number >= _N_ALIKE].tolist()]
    return [place for place in places if math.hypot(*place) <= _FARTHEST_MOUNT]


@np.errstate(invalid='ignore', over='ignore')
def without_box(
    xyz: PointArray, box: Sequence[float], frame: tuple[FloatArray, FloatArray] | None
) -> PointArray:
    """Return points (N, 3) with NaN in place of those in a box, or `xyz` if none is in it.

    The `box` ends at the least and the greatest x, y and z [m], and has these. `frame` is the
    rotation (3, 3) and translation (3,) [m] into the frame of the box; None if it is that of the
    points.
    """
    columns: PointArray = xyz.T
    if frame is not None:
        turn, move = frame
        columns = rotate(xyz, turn).T + move[:, None]
    inside = np.ones(len(xyz), dtype=np.bool_)
    for values, low, high in zip(columns, box[::2], box[1::2], strict=True):
        inside &= (values >= low) & (values <= high)
    if not inside.any():
        return xyz
    xyz = np.array(xyz, order='F')
    xyz[inside] = np.nan
    return xyz


@np.errstate(all='ignore')
def objection_to_ranges(xyz: PointArray) -> str:
    """Return what is wrong where points (N, 3) are farther away than a sensor measures, or ''."""
    is_beyond = (np.abs(xyz) > FARTHEST).any(axis=1)
    if not is_beyond.any():
        return ''
    is_beyond &= finite_points(xyz)
    if is_beyond.sum() <= _MAX_BEYOND * len(xyz):
        return ''
    middle = ', '.join(f'{value:.1f}' for value in np.median(xyz[is_beyond], axis=0))
    return (
        f'{is_beyond.mean():.0%} of the points are beyond 10 km, about {middle}; scans are in '
        'metres about the sensor: of a map, subtract its place there in double precision, as in '
        "xyz = points[:, :3] - (X, Y, Z); numpy.save('near.npy', xyz.astype('float32'))"
    )


@np.errstate(invalid='ignore', over='ignore')
def moved(xyz: PointArray, origin: Direction) -> PointArray:
    """Points (N, 3) about `origin`, in their own precision; `xyz` itself if that is theirs."""
    return (xyz - np.array(origin)).astype(xyz.dtype) if any(origin) else xyz


def in_columns(xyz: PointArray) -> PointArray:
    """Points (N, 3), read-only, with each coordinate contiguous; a copy if they are not."""
    result: PointArray = np.ascontiguousarray(xyz.T).T
    # To compiled code, arrays that may be written to are another type.
    result.flags.writeable = False
    return result


def single_precision(xyz: PointArray) -> PointArray:
    """Points (N, 3) as float32; `xyz` itself if it is. What is finite stays finite."""
    if xyz.dtype == np.float32:
        return xyz
    largest = np.finfo(np.float32).max
    with np.errstate(invalid='ignore'):
        nearest = np.where(np.isinf(xyz), xyz, np.clip(xyz, -largest, largest))
        return nearest.astype(np.float32)


def finite_points(xyz: PointArray) -> BoolArray:
    """Which points (N, 3) have three finite coordinates, (N,) bool."""
    # Column by column: a reduction along rows of three takes ten times as long.
    finite: BoolArray = np.logical_and.reduce([np.isfinite(column) for column in xyz.T])
    return finite


def rotation(roll: float, pitch: float) -> FloatArray:
    """Matrix (3, 3) that turns vectors of a sensor with these angles [rad] into the level frame.

    Sines and cosines of quarter turns are exact: axes swapped stay points swapped.
    """
    parts = math.sin(roll), math.cos(roll), math.sin(pitch), math.cos(pitch)
    sr, cr, sp, cp = (0.0 if abs(part) < 1e-12 else part for part in parts)
    return np.array([[cp, sp * sr, sp * cr], [0.0, cr, -sr], [-sp, cp * sr, cp * cr]])


def rotate(xyz: npt.NDArray[_Float], matrix: FloatArray) -> npt.NDArray[_Float]:
    """Points (N, 3) turned by a rotation (3, 3), in their own precision.

    Finite ones stay finite, others become NaN. It is computed in double precision; rounded to
    single, a point 100 m away moves by 4 um.
    """
    x, y, z = np.clip(xyz, -LARGEST, LARGEST).T.astype(np.float64)
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


def rounded(value: float) -> float:
    """Round to 5 digits: below what a scan tells, above how backends and orders of sums differ."""
    return round(value, 5) + 0.0
