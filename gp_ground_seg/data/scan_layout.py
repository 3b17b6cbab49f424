"""Layout of ``.bin`` scans, and whether coordinates can be those of a scan.

A ``.bin`` file carries no description. Read in the wrong layout most files still give numbers,
and numbers still give labels: a command checks them first.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from gp_ground_seg.core.errors import DataError
from gp_ground_seg.core.parameters.config import find_spec
from gp_ground_seg.data.files import MAX_SCAN_BYTES, read_bytes

_LOGGER = logging.getLogger('gp_ground_seg')
DTYPES = ('float32', 'float64')
MIN_COLUMNS = 3
MAX_RANGE = find_spec('grid.r_max').maximum or 0.0  # what lies beyond is never segmented [m]

_MIN_POINTS = 100  # fewer are not judged
_N_JUDGED = 10_000  # points looked at in a larger scan
_SMALLEST, _LARGEST = 1e-6, 1e6  # of a coordinate that can be measured [m]
_MAX_UNMEASURABLE = 0.4  # share of them; z may be zero in a whole scan


@dataclass(frozen=True)
class ScanLayout:
    """Layout of a ``.bin`` scan: x, y, z [m] first in each point, then intensity if there is more.

    Attributes
    ----------
    columns : int
        Numbers per point, at least 3.
    dtype : str
        ``'float32'`` or ``'float64'``, little-endian.
    doubts : str
        What to do with coordinates that no scan has: ``'ignore'``, ``'warn'`` or ``'raise'``.
    origin : tuple of three floats or None
        Place of the sensor in the coordinates of the file [m], by default their origin.
    """

    columns: int = 4
    dtype: str = 'float32'
    doubts: str = 'ignore'
    origin: tuple[float, float, float] | None = None

    def __str__(self) -> str:
        """Columns and type in words."""
        return f'{self.columns} columns of {self.dtype}'


KITTI = ScanLayout()


def read_scan(path: str | Path, layout: ScanLayout) -> npt.NDArray[np.floating]:
    """Read a ``.bin`` file, (N, columns), not judged yet.

    Raises DataError if it cannot be read, is larger than `MAX_SCAN_BYTES`, or does not hold whole
    points.
    """
    data = read_bytes(path, MAX_SCAN_BYTES)
    dtype = np.dtype(layout.dtype).newbyteorder('<')
    if len(data) % (layout.columns * dtype.itemsize):
        raise DataError(
            f'{path}: {len(data)} bytes is not a whole number of points of {layout}: truncated? '
            '--columns and --dtype choose another layout'
        )
    numbers: npt.NDArray[np.floating] = np.frombuffer(data, dtype)
    return numbers.reshape(-1, layout.columns)


def four_columns(table: npt.NDArray[np.floating]) -> npt.NDArray[np.float32]:
    """Return x, y, z, intensity of a table (N, >= 3), (N, 4); a missing intensity is zero."""
    points = np.zeros((len(table), 4), dtype=np.float32)
    with np.errstate(over='ignore', invalid='ignore'):
        points[:, : table.shape[1]] = table[:, :4]
    return points


def check_scan(path: str | Path, xyz: npt.NDArray[np.floating], layout: ScanLayout) -> None:
    """Raise DataError, or warn, as `layout` asks for, where points (N, 3) can be no scan."""
    if layout.doubts == 'ignore':
        return
    with np.errstate(all='ignore'):
        problem = find_objection(xyz)
    if not problem:
        return
    if str(path).endswith('.bin'):
        problem += f'; read as {layout}: --columns and --dtype choose another layout'
    if layout.doubts == 'raise':
        raise DataError(f'{path}: {problem}; --force takes it as it is')
    _LOGGER.warning('%s: %s', path, problem)


def find_objection(xyz: npt.NDArray[np.floating]) -> str:
    """Return why points (N, 3) can be no scan, or ''."""
    finite = xyz[np.isfinite(xyz).all(axis=1)]
    if not len(finite):
        return f'none of {len(xyz)} points is finite' if len(xyz) else 'no points in it'
    if len(xyz) < _MIN_POINTS:
        return ''
    # Some drivers put rays without a return at the origin.
    returned = finite[(finite != 0.0).any(axis=1)]
    if not len(returned):
        return 'all points are at the origin'
    returned = returned[:: 1 + len(returned) // _N_JUDGED].astype(np.float64)
    size = np.abs(returned)
    share = float(np.mean((size < _SMALLEST) | (size > _LARGEST)))
    centre = np.median(returned, axis=0)
    is_compact = _median_range(returned - centre) < MAX_RANGE < np.hypot(*centre[:2])
    if share > _MAX_UNMEASURABLE and not is_compact:
        return f'{share:.0%} of the coordinates are below 1e-6 m or above 1e6 m'
    middle = _median_range(returned)
    if middle <= MAX_RANGE:
        return ''
    problem = f'half of the points are farther than {middle:.0f} m'
    if is_compact:
        place = ', '.join(f'{number:.1f}' for number in centre)
        return f'{problem}, about {place}; --origin X Y Z says where the sensor was'
    return f'{problem} (millimetres? a scan is in metres)'


def _median_range(xyz: npt.NDArray[np.floating]) -> float:
    return float(np.median(np.linalg.norm(xyz, axis=1)))
