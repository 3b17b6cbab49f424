"""Simulated scans as a SemanticKITTI sequence."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterable
from pathlib import Path

from gp_ground_seg.errors import DataError
from gp_ground_seg.simulation.kinds import semantic_kitti_labels
from gp_ground_seg.simulation.scan import SimulatedScan


def write_semantic_kitti(scans: Iterable[SimulatedScan], root: str | Path, sequence: str) -> Path:
    """Write ``root/sequences/<sequence>/{velodyne/*.bin, labels/*.label, times.txt}``.

    The sequence appears whole or not at all: it is written beside its place and moved there.

    Parameters
    ----------
    scans : iterable of SimulatedScan
        Scans in order; a generator is consumed one by one.
    root : path
        Folder that holds ``sequences``; made if need be.
    sequence : str
        Name of the sequence's folder.

    Returns
    -------
    Path
        Folder of the sequence.

    Raises
    ------
    DataError
        If the name is not that of a folder, the sequence exists, there is no scan, or the
        folder cannot be written.
    """
    root = Path(root)
    if not sequence or sequence in ('.', '..') or Path(sequence).name != sequence:
        raise DataError(f'sequence {sequence!r}: must be the name of one folder')
    target = root / 'sequences' / sequence
    if target.exists() or target.is_symlink():
        raise DataError(f'{target}: exists; remove it or choose another sequence')
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        # Beside `sequences`, not in it: readers list what is there.
        partial = Path(tempfile.mkdtemp(prefix=f'.{sequence}-', dir=root))
        try:
            partial.chmod(target.parent.stat().st_mode)
            _write(scans, partial)
            os.rename(partial, target)
        except BaseException:
            shutil.rmtree(partial, ignore_errors=True)
            raise
    except OSError as error:
        raise DataError(f'{target}: {error.strerror or error}') from error
    return target


def _write(scans: Iterable[SimulatedScan], folder: Path) -> None:
    (folder / 'velodyne').mkdir()
    (folder / 'labels').mkdir()
    times = []
    for k, scan in enumerate(scans):
        points = scan.points.astype('<f4')
        labels = semantic_kitti_labels(scan.kind).astype('<u4')
        (folder / 'velodyne' / f'{k:06d}.bin').write_bytes(points.tobytes())
        (folder / 'labels' / f'{k:06d}.label').write_bytes(labels.tobytes())
        times.append(scan.time)
    if not times:
        raise DataError(f'sequence {folder.name}: no scan to write')
    text = ''.join(f'{time:e}\n' for time in times)
    (folder / 'times.txt').write_text(text, encoding='utf-8')
