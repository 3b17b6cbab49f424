"""How the points of a ``.bin`` scan are stored, and whether its numbers can be points so read.

The files carry no description. Read in the wrong layout most of them still give numbers, and
numbers still give labels: a command checks them first.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from gp_ground_seg.core.parameters.config import find_spec

DTYPES = ('float32', 'float64')
MIN_COLUMNS = 3
MAX_SCAN_BYTES = 1 << 30  # of a file: 67 million points, a hundred times a dense scan
MAX_RANGE = find_spec('grid.r_max').maximum or 0.0  # what lies beyond is never segmented [m]

_Numbers = npt.NDArray[np.floating]
_MIN_POINTS = 100  # fewer are not judged
_N_JUDGED = 20_000  # numbers looked at in a larger file
_LEAST, _LARGEST = 1e-6, 1e6  # of a coordinate that can be measured [m]
_MAX_UNMEASURABLE = 0.4  # share of them; z may be zero in a whole scan
_COLUMNS = range(2, 9)  # numbers of columns that are tried; of two, a plane has x and y
_BLOCK = 840  # numbers: a whole number of points for each of these
# Spread within columns, over that in the layout given, from which on another number of columns
# fits better; that of a multiple is less by itself where lasers that look elsewhere alternate, and
# that of a divisor is never less: it is the same where the columns repeat within a point.
_BETTER, _BETTER_MULTIPLE, _SAME = 0.95, 0.65, 1.03
_BAGS = (b'#ROSBAG', b'\x89MCAP', b'SQLite format 3')


@dataclass(frozen=True)
class ScanLayout:
    """Layout of a ``.bin`` scan: x, y, z [m] first in each point, then intensity if there is more.

    Attributes
    ----------
    columns : numbers per point, at least 3
    dtype : ``'float32'`` or ``'float64'``, little-endian
    doubts : what to do where the numbers cannot be points so read: ``'ignore'``, ``'warn'`` or
        ``'raise'``
    origin : place of the sensor in the coordinates of the file [m], by default their origin
    """

    columns: int = 4
    dtype: str = 'float32'
    doubts: str = 'ignore'
    origin: tuple[float, float, float] | None = None

    @property
    def bytes_per_point(self) -> int:
        """Bytes of one point."""
        return self.columns * np.dtype(self.dtype).itemsize

    def __str__(self) -> str:
        """Columns and type in words."""
        return f'{self.columns} columns of {self.dtype}'

    def points(self, data: bytes) -> npt.NDArray[np.float32]:
        """Return x, y, z, intensity of a file, (N, 4); without a fourth column it is zero."""
        columns = self.view(data)[:, :4]
        points = np.zeros((len(columns), 4), dtype=np.float32)
        with np.errstate(over='ignore', invalid='ignore'):
            points[:, : columns.shape[1]] = columns
        return points

    def view(self, data: bytes) -> _Numbers:
        """Return the whole points of a file, (N, columns)."""
        n_points = len(data) // self.bytes_per_point
        numbers = np.frombuffer(data, f'<{np.dtype(self.dtype).str[1:]}', n_points * self.columns)
        return numbers.reshape(n_points, self.columns)


KITTI = ScanLayout()


def find_doubt(data: bytes, layout: ScanLayout) -> str:
    """Return why a file can be no scan in `layout`, and what it looks like; '' if it can."""
    if data.startswith(_BAGS):
        return 'begins as a bag does; `segment` and `bench` read bags'
    points = layout.view(data)
    with np.errstate(all='ignore'):
        problem = _objection(points) or _double_objection(points) or _column_objection(points)
        if not problem and len(data) % layout.bytes_per_point == 0:
            return ''
        other = _likely_layout(data, layout)
        guess = _guess(points) if other is None else _advice(other, layout)
    if problem:
        begin = ', '.join(f'{x:.4g}' for x in points[:3, 0])
        problem = f'read as {layout}, {problem} (x begins {begin})'
    return '; '.join(part for part in (problem, guess) if part)


def _advice(other: ScanLayout, layout: ScanLayout) -> str:
    names = [n for n in ('columns', 'dtype') if getattr(other, n) != getattr(layout, n)]
    words = ' '.join(f'--{name} {getattr(other, name)}' for name in names)
    return f'looks like {other}, which {words} reads'


def _objection(points: _Numbers) -> str:
    """Return what is wrong with x, y, z, or ''."""
    if not len(points):
        return ''
    xyz = _sample(points)
    if not len(xyz):
        return f'none of {len(points)} points is finite'
    if len(points) < _MIN_POINTS:
        return ''
    size = np.abs(xyz[(xyz != 0.0).any(axis=1)])
    if not len(size):
        return 'all points are at the origin'
    share = float(np.mean((size < _LEAST) | (size > _LARGEST)))
    if share > _MAX_UNMEASURABLE:
        return f'{share:.0%} of the coordinates are below 1e-6 m or above 1e6 m'
    middle = _middle(size)
    if middle > MAX_RANGE:
        return f'half of the points are farther than {middle:.0f} m'
    return ''


def find_objection(xyz: _Numbers) -> str:
    """Return why points of known type (N, 3) can be no scan, and what they look like, or ''."""
    with np.errstate(all='ignore'):
        problem = _objection(xyz)
        near = _sample(xyz)
        centre = np.median(near, axis=0) if len(near) else np.zeros(3)
        if problem and np.hypot(*centre[:2]) > MAX_RANGE > _middle(near - centre):
            place = ', '.join(f'{number:.1f}' for number in centre)
            return f'{problem}, about {place}; --origin X Y Z says where the sensor was'
        return '; '.join(part for part in (problem, problem and _guess(xyz)) if part)


def _double_objection(points: _Numbers) -> str:
    # The lower halves of doubles are no float32 that can be measured.
    if points.itemsize == 8 and len(points) >= _MIN_POINTS and not _objection(points.view('<f4')):
        return 'halves of its numbers are coordinates by themselves'
    return ''


def _sample(points: _Numbers) -> _Numbers:
    """Return x, y, z of some points, of those that are finite."""
    # Some drivers put rays without a return at the origin.
    xyz = points[:: 1 + points.size // _N_JUDGED, :3].astype(np.float64)
    if np.count_nonzero(np.isfinite(xyz) & (xyz != 0.0)) < 3 * _MIN_POINTS:
        xyz = points[:, :3].astype(np.float64)
    return xyz[np.isfinite(xyz).all(axis=1)]


def _middle(xyz: _Numbers) -> float:
    return float(np.median(np.linalg.norm(xyz, axis=1)))


def _spreads(numbers: _Numbers) -> dict[int, float]:
    """Return the mean difference of two numbers of a column, for each number of columns tried.

    It is least for the right one, whatever the order of the points, and larger where different
    quantities are mixed in a column: E|a - b| >= (E|a - a'| + E|b - b'|) / 2 (Szekely, Rizzo:
    Energy statistics, J. Stat. Plan. Inference 143, 2013).
    """
    n_blocks = len(numbers) // _BLOCK
    if n_blocks < 2:
        return {}
    chosen = np.linspace(0, n_blocks - 1, min(n_blocks, _N_JUDGED // _BLOCK)).astype(int)
    part = numbers[: n_blocks * _BLOCK].reshape(n_blocks, _BLOCK)[chosen]
    # So that no single quantity decides, as a time in nanoseconds.
    values = np.arcsinh(np.nan_to_num(part).clip(-1e9, 1e9))
    spreads = {}
    for n_columns in _COLUMNS:
        ordered = np.sort(values.reshape(-1, n_columns), axis=0)
        n = len(ordered)
        rank = 2.0 * np.arange(n) + 1.0 - n
        spreads[n_columns] = max(0.0, 2.0 * float(np.mean(rank @ ordered)) / n**2)
    return spreads


def _column_objection(points: _Numbers) -> str:
    """Return whether another number of columns fits better, or ''."""
    # Of many points without a return, at the origin, all columns are alike.
    returned = points[np.nan_to_num(points[:, :3]).any(axis=1)]
    own, spreads = points.shape[1], _spreads(returned.reshape(-1))
    if own not in spreads:
        return ''
    worth = {n: _BETTER if n % own else _BETTER_MULTIPLE for n in spreads if own % n}
    better = {n: spreads[n] for n in worth if spreads[n] < worth[n] * spreads[own]}
    same = {n: spreads[n] for n in spreads if own % n == 0 and n < own}
    better |= {n: same[n] for n in same if 0.0 < same[n] <= _SAME * spreads[own]}
    if not better:
        return ''
    n_columns = _fewest(better)
    words = ': x and y without z' if n_columns < MIN_COLUMNS else ''
    return f'its numbers repeat every {n_columns}, not every {own}{words}'


def _fewest(spreads: dict[int, float]) -> int:
    """Return the least number of columns among those that fit as well as any."""
    least = min(spreads.values())
    return min(n for n in spreads if spreads[n] <= _SAME * least)


def _likely_layout(data: bytes, layout: ScanLayout) -> ScanLayout | None:
    """Return the layout that makes points of all bytes, None if there is none."""
    for dtype in sorted(DTYPES, key=lambda name: name != layout.dtype):
        numbers = ScanLayout(1, dtype).view(data).reshape(-1)
        spreads = _spreads(numbers)
        other = ScanLayout(_fewest(spreads) if spreads else layout.columns, dtype)
        if other.columns < MIN_COLUMNS:
            continue
        is_whole = len(data) % other.bytes_per_point == 0
        is_other = str(other) != str(layout)
        points = other.view(data)
        if is_other and is_whole and not (_objection(points) or _double_objection(points)):
            return other
    return None


def _guess(points: _Numbers) -> str:
    """Return what points that have no likely layout look like, or ''."""
    xyz = _sample(points)
    xyz = xyz[(xyz != 0.0).any(axis=1)]
    middle = _middle(xyz) if len(xyz) else 0.0
    if 0.0 < middle < np.finfo(np.float32).tiny:
        return 'looks like whole numbers, as of a .label file'
    if MAX_RANGE < middle < 1000.0 * MAX_RANGE:
        return 'looks like millimetres, a scan is in metres'
    return ''
