"""Point clouds in files, their format known by the suffix; numpy's and ``.bin`` are read here.

``.npy`` is one table or structured array, ``.npz`` has an array for each field, or one table. A
``.bin`` carries no description. Read with another number of columns most files still give numbers,
and numbers still give labels: whether they can be those of a scan is checked first.
"""

from __future__ import annotations

import io
import re
import textwrap
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from gp_ground_seg.core.errors import DataError, PointCloudError
from gp_ground_seg.core.pipeline.points import finite_points, hint_of_table, objection_to_ranges
from gp_ground_seg.data import clouds
from gp_ground_seg.data.files import MAX_SCAN_BYTES, naming, read_bytes
from gp_ground_seg.data.pcd import encode_pcd, read_pcd
from gp_ground_seg.data.ply import encode_ply, read_ply

if TYPE_CHECKING:
    from gp_ground_seg.core.result import Segmentation

NUSCENES_SUFFIX, NUSCENES_COLUMNS = '.pcd.bin', 5
KITTI_COLUMNS = 4
MIN_COLUMNS = 3
_OTHER_COLUMNS = range(MIN_COLUMNS, 11)  # that are tried

_MIN_POINTS = 100  # fewer are not judged
_N_JUDGED = 10_000  # points of a larger scan that are judged
_SMALLEST = 1e-6  # coordinate that can be measured [m]
_MAX_UNMEASURABLE = 0.4  # share of them; z may be zero in a whole scan
# What a number is says something about its column if the columns are right, and otherwise less:
# z is low, an intensity positive. Points need not be in any order for that.
_PERIOD = 2520  # a multiple of all `_OTHER_COLUMNS`
_N_PERIODS = 34  # of a larger file that are judged
_FEWEST = 1680  # numbers of a file that is judged
_N_CLASSES = 16  # of equally many numbers
_MUCH_MORE, _CHANCE = 1.25, 0.05  # times as much, and by so much [nat]
_TRANSPOSED = 20  # columns from which on a table of fewer rows is
TABLE = 'points'  # array of an .npz that is a table (N, >= 3), beside fields (N, ...)
_BESIDE = re.compile('colo|rgb|normal|label|feat|flow|pose|transf|calib|face|box', re.IGNORECASE)


def _read_numpy(data: bytes) -> tuple[clouds.Fields, clouds.Columns]:
    """Read a table x, y, z, intensity, ..., a structured array, or arrays by name.

    Arrays of another length than that of the points are what the file has beside them.
    """
    if not data.startswith((b'\x93NUMPY', b'PK')):
        raise PointCloudError(f'is no file of numpy; it begins with {data[:20]!r}')
    found = np.load(io.BytesIO(data), allow_pickle=False)
    arrays: clouds.Columns = {TABLE: found} if isinstance(found, np.ndarray) else dict(found)
    if clouds.coordinate_names(arrays)[0] not in arrays:
        table = arrays.pop(_table_of(arrays))
        arrays = {**clouds.scatter(_points_of(table)), **arrays}
    x = arrays.get(clouds.coordinate_names(arrays)[0], next(iter(arrays.values())))
    fields = {name: v for name, v in arrays.items() if v.shape[:1] == x.shape[:1]}
    return clouds.gather(fields), {name: v for name, v in arrays.items() if name not in fields}


def _table_of(arrays: clouds.Columns) -> str:
    """Name of the table of coordinates: of most rows, and not called as something else."""
    if TABLE in arrays:
        return TABLE
    tables = {
        name: len(v)
        for name, v in arrays.items()
        if v.dtype.names or (v.ndim > 1 and v.shape[-1] >= 3 and not _BESIDE.search(name))
    }
    most = [name for name, n_rows in tables.items() if n_rows == max(tables.values())]
    if len(most) != 1:
        found = ', '.join(f'{name} {values.shape}' for name, values in arrays.items()) or 'none'
        found = textwrap.shorten(found, 200, placeholder=' ...')
        wanted = f'x, y, z, or one (N, 3) or wider; call it {TABLE}'
        raise PointCloudError(f'arrays {found}: must be {wanted}')
    return most[0]


def _points_of(table: npt.NDArray[Any]) -> clouds.Fields:
    """Structured array of a table, or of one that is structured."""
    if table.dtype.names:
        return table.ravel()
    if table.ndim != 2 or table.shape[1] < 3:
        hint = hint_of_table(table)
        raise PointCloudError(f'array of shape {table.shape}: must be (N, 3) or wider{hint}')
    if 0 < table.shape[0] < table.shape[1] >= _TRANSPOSED:
        problem = 'is transposed, or an image of ranges; a point is a row: save its .T'
        raise PointCloudError(f'array of shape {table.shape}: {problem}')
    return clouds.name_columns(table)


def _encode_npy(cloud: clouds.Cloud) -> bytes:
    """File of a structured array."""
    file = io.BytesIO()
    # Of numpy 1.17: names may be beyond ASCII.
    np.lib.format.write_array(file, cloud.fields, (3, 0), allow_pickle=False)
    return file.getvalue()


def _encode_npz(cloud: clouds.Cloud) -> bytes:
    """File of an array for each field, and of arrays of another length."""
    file = io.BytesIO()
    others = cloud.header if isinstance(cloud.header, dict) else {}
    arrays: dict[str, Any] = {**others, **clouds.scatter(cloud.fields)}
    np.savez(file, **arrays)
    return file.getvalue()


# Each returns the points, and what the file has beside them.
_READERS: dict[str, Callable[[bytes], tuple[clouds.Fields, Any]]] = {
    '.pcd': read_pcd,
    '.ply': read_ply,
    '.npy': _read_numpy,
    '.npz': _read_numpy,
}
_ENCODERS = {'.pcd': encode_pcd, '.ply': encode_ply, '.npy': _encode_npy, '.npz': _encode_npz}
SUFFIXES = ('.bin', *_READERS)
WRITABLE = tuple(_ENCODERS)
LABELS = 'label'
FORMATS = (LABELS, *(suffix[1:] for suffix in WRITABLE))
SEMANTIC_KITTI_CODE = np.array([0, 40, 99], '<u4')  # by `Label`: unlabelled, road, other-object
_VALUES = ('height', 'ground_z', 'ground_std', 'p_ground')


def read_file(path: Path, columns: int = KITTI_COLUMNS) -> clouds.Cloud:
    """Read a file; `columns` are the numbers of a point in a ``.bin``.

    Raises DataError if it cannot be read, is larger than `MAX_SCAN_BYTES`, does not hold whole
    points, or can be no scan. nuScenes' ``.pcd.bin`` is known by its name.
    """
    data, is_bin = read_bytes(path, MAX_SCAN_BYTES), path.suffix.lower() == '.bin'
    if path.name.endswith(NUSCENES_SUFFIX) and columns == KITTI_COLUMNS:
        columns = NUSCENES_COLUMNS
    cloud = _read_bin(path, data, columns) if is_bin else decode_file(path, data)
    with np.errstate(all='ignore'):
        problem = find_objection(cloud.xyz[:, :3])
    if problem:
        more = '; a .bin holds float32: --columns chooses their number' if is_bin else ''
        raise DataError(f'{path}: {problem}{more}')
    return cloud


def decode_file(path: Path, data: bytes) -> clouds.Cloud:
    """Cloud of the data of a file, of the format of `path`; DataError if it cannot be read."""
    with naming(path, f'cannot be read as {path.suffix}; is it whole?'), np.errstate(all='ignore'):
        fields, header = _READERS[path.suffix.lower()](data)
        clouds.check_numbers(clouds.count_numbers(fields.dtype))
        return clouds.cloud_of(fields, header)


def encode_file(path: Path, cloud: clouds.Cloud, columns: clouds.Columns) -> bytes:
    """File of a cloud with further values for each point; DataError if none can be.

    Its format is that of `path`, one of `WRITABLE`.
    """
    with naming(path, f'cannot be written as {path.suffix}'), np.errstate(all='ignore'):
        return _ENCODERS[path.suffix](cloud.join(columns))


def encode_output(path: Path, cloud: clouds.Cloud, result: Segmentation) -> bytes:
    """File of a cloud with its labels, of the format of `path`; DataError if none can be.

    A ``.label`` has a uint32 for each point, SemanticKITTI's code. Other files have every field of
    the cloud, label and values of each point.
    """
    if path.suffix[1:] == LABELS:
        return SEMANTIC_KITTI_CODE[result.label].tobytes()
    values = {name: getattr(result, name).astype(np.float32) for name in _VALUES}
    return encode_file(path, cloud, {'label': result.label, **values})


def _read_bin(path: Path, data: bytes, columns: int) -> clouds.Cloud:
    """Cloud of float32, x, y, z [m] first in each point; a missing intensity is zero."""
    if len(data) % (4 * columns):
        raise DataError(
            f'{path}: {len(data)} bytes is not a whole number of points of {columns} float32: '
            'truncated? --columns chooses another number'
        )
    numbers = np.frombuffer(data, '<f4').astype(np.float32)
    if better := find_columns(numbers, columns):
        raise DataError(
            f'{path}: read with {columns} columns each is a mixture; the points have {better} '
            f'numbers each: use --columns {better}'
        )
    table = numbers.reshape(-1, columns)
    points = np.zeros((len(table), 4), dtype=np.float32)
    points[:, :columns] = table[:, :4]
    return clouds.Cloud(clouds.name_columns(table), points)


def find_columns(numbers: npt.NDArray[np.float32], columns: int) -> int:
    """Return the number of columns by which the numbers differ much more; 0 if there is none."""
    if len(numbers) < _FEWEST:
        return 0
    n_whole = len(numbers) // _PERIOD * _PERIOD or len(numbers)
    whole = numbers[:n_whole].reshape(-1, min(_PERIOD, n_whole))
    sample = np.nan_to_num(whole[:: 1 + len(whole) // _N_PERIODS]).ravel()
    edges = np.unique(np.quantile(sample, np.linspace(0.0, 1.0, _N_CLASSES + 1)[1:-1]))
    classes = np.searchsorted(edges, sample, side='right')
    told = {n: _information(classes, n) for n in {*_OTHER_COLUMNS, columns}}
    fitting = {n: told[n] for n in _OTHER_COLUMNS if len(numbers) % n == 0}
    most = max(fitting.values(), default=0.0)
    if most < _MUCH_MORE * told[columns] + _CHANCE:
        return 0
    best = next(n for n in fitting if _MUCH_MORE * fitting[n] > most)  # not a multiple of it
    return 0 if find_objection(numbers.reshape(-1, best)[:, :3]) else best


def _information(classes: npt.NDArray[np.intp], n: int) -> float:
    """Mutual information [nat] of the column and the class of numbers in `n` columns."""
    from scipy.special import entr

    rows = classes[: len(classes) // n * n].reshape(-1, n)
    counts = np.array([np.bincount(column, minlength=_N_CLASSES) for column in rows.T])
    share = counts / counts.sum()
    return float(np.log(n) + entr(share.sum(axis=0)).sum() - entr(share).sum())


def find_objection(xyz: npt.NDArray[np.floating]) -> str:
    """Return why points (N, 3) can be no scan, or ''."""
    # All are looked at where some of them raise a doubt.
    if len(xyz) > _N_JUDGED and not find_objection(xyz[:: 1 + len(xyz) // _N_JUDGED]):
        return ''
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
