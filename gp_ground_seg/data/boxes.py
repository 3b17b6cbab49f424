"""Boxes about the objects of a scan, an ``.npz`` file for each scan."""

from __future__ import annotations

import io
import zipfile
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from gp_ground_seg.core.errors import DataError
from gp_ground_seg.core.frame import FloatArray
from gp_ground_seg.data.semantic_kitti import Frame, read_bytes

ARRAYS = {'box_class': (), 'box_center': (3,), 'box_size': (3,), 'box_rotation': (3, 3)}
"""Arrays of a file, and what follows the number of boxes in the shape of each."""
_MAX_BYTES = 1 << 28  # a file may hold its scan too
# What numpy and zipfile raise; RuntimeError: encrypted, or of an unknown kind.
_UNREADABLE = (
    ValueError, OSError, EOFError, RuntimeError, zipfile.BadZipFile, zlib.error,
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
        paths.append(folder / f'{frame.index}.npz')
        if not paths[-1].exists():
            raise DataError(f'{paths[-1]}: no such file')
    return paths


def read_boxes(path: str | Path) -> Boxes:
    """Read the boxes of a scan; DataError says what is wrong with a file."""
    data = read_bytes(path, _MAX_BYTES)
    try:
        boxes = _read_npz(data)
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
