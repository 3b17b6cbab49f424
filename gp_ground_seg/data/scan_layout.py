"""``.bin`` scans, and whether coordinates can be those of a scan.

A ``.bin`` file carries no description. Read with another number of columns most files still give
numbers, and numbers still give labels: they are checked first.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt

from gp_ground_seg.core.errors import DataError
from gp_ground_seg.core.pipeline.points import finite_points, objection_to_ranges
from gp_ground_seg.data.files import MAX_SCAN_BYTES, read_bytes

KITTI_COLUMNS = 4
MIN_COLUMNS = 3
_OTHER_COLUMNS = range(MIN_COLUMNS, 9)  # that are looked at in doubt

_MIN_POINTS = 100  # fewer are not judged
_N_JUDGED = 10_000  # points looked at in a larger scan
_N_DISTANCES = 2_000  # of successive points, that are looked at
_SMALLEST = 1e-6  # of a coordinate that can be measured [m]
_MAX_UNMEASURABLE = 0.4  # share of them; z may be zero in a whole scan
# Three quarters of the points of the other number are that much nearer to the next one than the
# median of the given number. Beams that fire in turns are far from each other, and every second
# point of them is near to the next: multiples of the given number are not compared.
_MUCH_NEARER = 4.0


def read_scan(path: str | Path, columns: int = KITTI_COLUMNS) -> npt.NDArray[np.float32]:
    """Read a ``.bin`` file of float32, x, y, z [m] first in each point: (N, columns).

    Raises DataError if it cannot be read, is larger than `MAX_SCAN_BYTES`, does not hold whole
    points, or can be no scan.
    """
    data = read_bytes(path, MAX_SCAN_BYTES)
    if len(data) % (4 * columns):
        raise DataError(
            f'{path}: {len(data)} bytes is not a whole number of points of {columns} float32: '
            'truncated? --columns chooses another number'
        )
    numbers = np.frombuffer(data, '<f4').astype(np.float32)
    table = numbers.reshape(-1, columns)
    if better := find_columns(numbers, columns):
        raise DataError(
            f'{path}: read with {columns} columns its successive points lie far apart, with '
            f'{better} close together: use --columns {better}'
        )
    check_scan(path, table)
    return table


def find_columns(numbers: npt.NDArray[np.float32], columns: int) -> int:
    """Return the number of columns with which this is a scan of much nearer points; 0 if none."""
    if len(numbers) < _MIN_POINTS * columns:
        return 0
    fitting = [n for n in _OTHER_COLUMNS if len(numbers) % n == 0 and columns % n and n % columns]
    distances = {n: _distance(numbers, n, 0.75) for n in fitting}
    best = min(distances, key=distances.__getitem__, default=0)
    given = _distance(numbers, columns, 0.5)
    if not best or _MUCH_NEARER * distances[best] >= given:
        return 0
    return 0 if find_objection(numbers.reshape(-1, best)[:, :3]) else best


def _distance(numbers: npt.NDArray[np.float32], columns: int, share: float) -> float:
    """Distance [m] that this share of successive finite points is not beyond; or infinity."""
    xyz = numbers.reshape(-1, columns)[:, :3]
    first = np.arange(0, len(xyz) - 1, 1 + len(xyz) // _N_DISTANCES)
    with np.errstate(all='ignore'):
        distance = np.linalg.norm(xyz[first + 1].astype(np.float64) - xyz[first], axis=1)
    distance = distance[np.isfinite(distance)]
    return float(np.quantile(distance, share)) if len(distance) else np.inf


def four_columns(table: npt.NDArray[np.floating]) -> npt.NDArray[np.float32]:
    """Return x, y, z, intensity of a table (N, >= 3), (N, 4); a missing intensity is zero."""
    points = np.zeros((len(table), 4), dtype=np.float32)
    points[:, : table.shape[1]] = table[:, :4]
    return points


def check_scan(place: str | Path, xyz: npt.NDArray[np.floating]) -> None:
    """Raise DataError, with the file or message, where points (N, >= 3) can be no scan."""
    with np.errstate(all='ignore'):
        problem = find_objection(xyz[:, :3])
    if problem:
        is_bin = str(place).endswith('.bin')
        more = '; a .bin holds float32: --columns chooses their number' if is_bin else ''
        raise DataError(f'{place}: {problem}{more}')


def find_objection(xyz: npt.NDArray[np.floating]) -> str:
    """Return why points (N, 3) can be no scan, or ''."""
    # All are looked at where some of them raise a doubt.
    return _objection(xyz[:: 1 + len(xyz) // _N_JUDGED]) and _objection(xyz)


def _objection(xyz: npt.NDArray[np.floating]) -> str:
    finite = xyz[finite_points(xyz)]
    if not len(finite):
        return f'none of {len(xyz)} points is finite' if len(xyz) else 'no points in it'
    if problem := objection_to_ranges(finite):
        return problem
    if len(xyz) < _MIN_POINTS:
        return ''
    # Some drivers put rays without a return at the origin.
    returned = finite[(finite != 0.0).any(axis=1)]
    if not len(returned):
        return 'all points are at the origin'
    share = float(np.mean(np.abs(returned) < _SMALLEST))
    return f'{share:.0%} of the coordinates are below 1e-6 m' if share > _MAX_UNMEASURABLE else ''
