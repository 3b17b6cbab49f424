"""Boxes about the objects of a scan, a file for each scan: ``.npz`` or ``.csv``."""

from __future__ import annotations

import csv
import io
import zipfile
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from gp_ground_seg.data.semantic_kitti import Frame, read_bytes
from gp_ground_seg.errors import DataError
from gp_ground_seg.frame import FloatArray

ARRAYS = {'box_class': (), 'box_center': (3,), 'box_size': (3,), 'box_rotation': (3, 3)}
"""Arrays of an ``.npz`` file, and what follows the number of boxes in the shape of each."""
COLUMNS = ('class', 'x', 'y', 'z', 'length', 'width', 'height', 'yaw')
"""Columns of a ``.csv`` file: centre and size [m], `yaw` about z, from x towards y [rad]."""
_MAX_BYTES = 1 << 28  # a file may hold its scan too
# What numpy, zipfile and csv raise; RuntimeError: encrypted, or of an unknown kind.
_UNREADABLE = (
    ValueError, OSError, EOFError, RuntimeError, zipfile.BadZipFile, zlib.error, csv.Error,
)  # fmt: skip
_MAX_SKEW = 1e-3  # of the axes of a box, which are orthonormal


class Boxes(NamedTuple):
    """K boxes in the frame of their cloud; the rows of `rotation` are the axes of a box in it."""

    names: list[str]  # (K,) classes, in any words
    center: FloatArray  # (K, 3) [m]
    size: FloatArray  # (K, 3) along its axes: length, width, height [m]
    rotation: FloatArray  # (K, 3, 3)


def find_boxes(where: str | Path, frames: Sequence[Frame]) -> list[Path]:
    """Return the file of each frame: `where` itself for one, or in that folder by its name.

    The files of a sequence may lie in a folder of its name, and those of several must.
    """
    where, sequences = Path(where), {frame.sequence for frame in frames}
    if not where.is_dir():
        names = [frame.index for frame in frames]
        if not where.exists():
            raise DataError(f'{where}: no such file or folder')
        if names != [where.stem]:
            wanted = 'a folder with a file for each' if len(names) > 1 else f'those of {names[0]}'
            raise DataError(f'{where}: boxes of one scan, {where.stem}; give {wanted}')
        return [where]
    paths = []
    for frame in frames:
        own = where / frame.sequence
        folder = own if own.is_dir() or len(sequences) > 1 else where
        names = [f'{frame.index}{suffix}' for suffix in ('.npz', '.csv')]
        found = [path for name in names if (path := folder / name).exists()]
        if len(found) != 1:
            both = 'both there, delete one' if found else 'not there, one must be'
            raise DataError(f'{folder}: {" and ".join(names)} are {both}')
        paths += found
    return paths


def read_boxes(path: str | Path) -> Boxes:
    """Read the boxes of a scan; DataError says what is wrong with a file."""
    data, suffix = read_bytes(path, _MAX_BYTES), Path(path).suffix
    if suffix not in ('.npz', '.csv'):
        raise DataError(f'{path}: boxes are read from .npz and .csv files')
    try:
        boxes = _read_npz(data) if suffix == '.npz' else _read_csv(data)
        _check(boxes)
    except _UNREADABLE as error:
        raise DataError(f'{path}: {" ".join(str(error).split())}') from error
    return boxes


def _read_npz(data: bytes) -> Boxes:
    if not data.startswith(b'PK'):
        raise ValueError('not an .npz file')
    with np.load(io.BytesIO(data), allow_pickle=False) as file:
        if missing := [name for name in ARRAYS if name not in file]:
            raise ValueError(f'no array {", ".join(missing)} in it')
        arrays = {name: np.asarray(file[name]) for name in ARRAYS}
    n_boxes = len(arrays['box_class']) if arrays['box_class'].ndim else 0
    for name, rest in ARRAYS.items():
        if arrays[name].shape != (n_boxes, *rest):
            raise ValueError(f'{name} of shape {arrays[name].shape}: must be {(n_boxes, *rest)}')
    numbers = [arrays[name].astype(np.float64) for name in ARRAYS if name != 'box_class']
    return Boxes([str(word) for word in arrays['box_class']], *numbers)


def _read_csv(data: bytes) -> Boxes:
    rows = csv.DictReader(io.StringIO(data.decode('utf-8-sig')), skipinitialspace=True)
    given = rows.fieldnames or ()
    if missing := [name for name in COLUMNS if name not in given]:
        raise ValueError(
            f'no column {", ".join(missing)}; the first line names {",".join(COLUMNS)}'
        )
    names, numbers = [], []
    for row in rows:
        names.append(row['class'])
        try:
            numbers.append([float(row[name]) for name in COLUMNS[1:]])
        except (TypeError, ValueError) as error:
            raise ValueError(f'line {rows.line_num}: {error}') from error
    values = np.array(numbers, dtype=np.float64).reshape(-1, len(COLUMNS) - 1)
    cos, sin = np.cos(values[:, 6]), np.sin(values[:, 6])
    rotation = np.zeros((len(names), 3, 3))
    rotation[:, 0, 0], rotation[:, 0, 1] = cos, sin
    rotation[:, 1, 0], rotation[:, 1, 1] = -sin, cos
    rotation[:, 2, 2] = 1.0
    return Boxes(names, values[:, :3], values[:, 3:6], rotation)


def _check(boxes: Boxes) -> None:
    """Raise a ValueError where the numbers can be no boxes."""
    for k, (name, *numbers) in enumerate(zip(*boxes, strict=True), 1):
        _, size, axes = numbers
        problem = ''
        if not all(np.isfinite(values).all() for values in numbers):
            problem = 'a number is not finite'
        elif not (size > 0.0).all():
            problem = f'size {", ".join(f"{x:g}" for x in size)}: must be above 0'
        elif not (np.abs(axes @ axes.T - np.eye(3)) < _MAX_SKEW).all():
            problem = 'the rows of its rotation are no orthonormal axes'
        if problem:
            raise ValueError(f'box {k} ({name}): {problem}')
