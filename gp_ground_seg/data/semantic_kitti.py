"""SemanticKITTI folders: frames, labels, times."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from gp_ground_seg.core.errors import LOGGER, DataError
from gp_ground_seg.core.frame import BoolArray
from gp_ground_seg.data.cloud_files import KITTI_COLUMNS, read_file
from gp_ground_seg.data.files import naming, read_bytes

UNLABELLED, OUTLIER, VEGETATION = 0, 1, 70  # classes that are neither ground nor obstacle
GROUND_CLASSES = (40, 44, 48, 49, 60, 72)
"""Road, parking, sidewalk, other ground, lane marking, terrain."""
FRAME_PERIOD = 0.1  # time between frames [s] where a sequence has no times.txt
_MAX_TIMES_BYTES = 1 << 24
Entries = npt.NDArray[np.uint32]  # of a ``.label`` file, (N,)


@dataclass(frozen=True)
class Frame:
    """One scan on disk."""

    sequence: str  # name of the sequence folder
    index: str  # name of the file without its ending
    points_path: Path  # the ``.bin`` file
    labels_path: Path | None  # the ``.label`` file, if there is one
    time: float  # since the start of the sequence [s]
    columns: int = KITTI_COLUMNS  # of the ``.bin`` file

    def __str__(self) -> str:
        """Sequence and index."""
        return f'{self.sequence}/{self.index}'

    @property
    def points(self) -> npt.NDArray[np.floating]:
        """Points x, y, z [m], intensity, (N, 4) float32; raises DataError as `read_file`."""
        return read_file(self.points_path, self.columns).xyz

    @property
    def entries(self) -> Entries:
        """Entry of each point, as `read_entries`; DataError without a file of labels that fits."""
        if self.labels_path is None:
            raise DataError(f'{self.points_path}: has no labels')
        n_points = self.points_path.stat().st_size // (4 * self.columns)
        return read_entries(self.labels_path, n_points)

    @property
    def semantic(self) -> npt.NDArray[np.uint16]:
        """Class of each point, (N,); DataError as `entries`."""
        return (self.entries & 0xFFFF).astype(np.uint16)

    @property
    def is_ground(self) -> BoolArray:
        """Whether each point is labelled as ground, (N,): `GROUND_CLASSES`."""
        return np.isin(self.semantic, GROUND_CLASSES)

    @property
    def is_scored(self) -> BoolArray:
        """Whether the label of each point counts, (N,): not without one, outlier, vegetation.

        The convention of GroundGrid (Steinke et al., RA-L 2024), as `evaluate` has it first.
        """
        return ~np.isin(self.semantic, (UNLABELLED, OUTLIER, VEGETATION))


def frames(root: str | Path, *sequences: str) -> list[Frame]:
    """Frames of the named sequences ('02', ...), or of all, in order; DataError without any.

    Points and labels of a frame are read each time they are asked for, and not kept.
    """
    chosen = sequences or list_sequences(root)
    return [frame for name in chosen for frame in list_frames(root, name)]


def is_root(folder: Path) -> bool:
    """Whether a folder has sequences, as `list_sequences` finds them."""
    return any(folder.glob('sequences/*/velodyne'))


def list_sequences(root: str | Path) -> list[str]:
    """Names of the sequences below ``root/sequences``; raises DataError if there is none."""
    folder = Path(root, 'sequences')
    names = sorted(path.parent.name for path in folder.glob('*/velodyne') if path.is_dir())
    if not names:
        raise DataError(f'{root}: no sequences/*/velodyne folder below it (SemanticKITTI layout)')
    return names


def list_frames(root: str | Path, sequence: str, columns: int = KITTI_COLUMNS) -> list[Frame]:
    """Frames of one sequence, in order; DataError if there are none, or times.txt does not fit."""
    folder = Path(root, 'sequences', sequence)
    if not (paths := sorted(folder.glob('velodyne/*.bin'))):
        known = ', '.join(list_sequences(root))
        raise DataError(f'{folder}: no velodyne/*.bin in it; sequences here: {known}')
    labels = {path.stem: path for path in (folder / 'labels').glob('*.label')}
    pairs = zip(paths, _read_times(folder / 'times.txt', paths), strict=True)
    return [
        Frame(sequence, path.stem, path, labels.get(path.stem), time, columns)
        for path, time in pairs
    ]


def labelled_frames(
    root: str | Path,
    sequences: Sequence[str] | None = None,
    columns: int = KITTI_COLUMNS,
    step: int = 1,
) -> list[Frame]:
    """Frames of the named sequences, or of all that have labels, in order; each `step`-th of one.

    Sequences of SemanticKITTI's test set have none; a note says which are left out. Raises
    DataError if a sequence is not there, a named one or a single frame has no labels, or all.
    """
    frames, left_out = [], []
    for name in list_sequences(root) if sequences is None else dict.fromkeys(sequences):
        listed = list_frames(root, name, columns)
        bare = [frame.index for frame in listed if frame.labels_path is None]
        if sequences is None and len(bare) == len(listed):
            left_out.append(name)
        elif bare:
            raise DataError(f'{root}: frames of sequence {name} have no labels, as {bare[0]}')
        else:
            frames += listed[::step]
    if not frames:
        raise DataError(f'{root}: no sequence has labels, of {", ".join(list_sequences(root))}')
    if left_out:
        LOGGER.info('sequences without labels left out: %s', ', '.join(left_out))
    return frames


def _read_times(path: Path, frames: Sequence[Path]) -> list[float]:
    """Time of each frame: line k of times.txt belongs to the file numbered k."""
    if not path.exists():
        return [FRAME_PERIOD * k for k in range(len(frames))]
    data = read_bytes(path, _MAX_TIMES_BYTES)
    with naming(path, 'cannot be read as the times of these frames'):
        lines = np.array(data.split(), np.float64)
        times = lines[[int(frame.stem) for frame in frames]]
    if not (np.isfinite(times).all() and (np.diff(times) > 0.0).all()):
        raise DataError(f'{path}: times must be numbers that increase')
    return [float(time) for time in times]


def read_entries(path: str | Path, n_points: int) -> Entries:
    """Entries of a ``.label`` file, (n_points,): class below, instance in the upper 16 bits.

    DataError if it cannot be read, or has another number.
    """
    expected = f'expected {4 * n_points} for {n_points} points'
    data = read_bytes(path, 4 * n_points, expected)
    if len(data) != 4 * n_points:
        raise DataError(f'{path}: {len(data)} bytes, {expected}')
    return np.frombuffer(data, dtype='<u4').astype(np.uint32)
