"""Scans in, label files out."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path

import numpy as np
import numpy.typing as npt

from gp_ground_seg.cli.output import SegmentationTally, note_leftovers, progress_bar
from gp_ground_seg.data.atomic_output import staged_file, staged_files
from gp_ground_seg.data.semantic_kitti import read_points
from gp_ground_seg.errors import DataError, PointCloudError
from gp_ground_seg.frame import Label
from gp_ground_seg.parameters.config import Config
from gp_ground_seg.segmenter import GroundSegmenter

SEMANTIC_KITTI_CODE = {Label.UNKNOWN: 0, Label.GROUND: 40, Label.OBSTACLE: 99}
"""unlabelled, road, other-object."""

_SCAN_FOLDERS = ('.', 'velodyne', 'velodyne_points/data')


def find_scans(source: Path) -> list[Path]:
    """Return the .bin files that `source` stands for, in order.

    Parameters
    ----------
    source : Path
        A .bin file, a folder of them, a SemanticKITTI sequence, or a KITTI raw drive.

    Raises
    ------
    DataError
        If there is none; the message says what was expected.
    """
    if source.is_file():
        if source.suffix != '.bin':
            raise DataError(
                f'{source}: not a scan or bag; accepted are .bin, .bag, .mcap and .db3 files, '
                'folders of .bin files and rosbag2 folders'
            )
        return [source]
    for name in _SCAN_FOLDERS:
        scans = sorted((source / name).glob('*.bin'))
        if scans:
            return scans
    sequences = sorted(path.parent.name for path in source.glob('sequences/*/velodyne'))
    hint = ''
    if sequences:
        first = source / 'sequences' / sequences[0]
        hint = f'; give one of its sequences ({", ".join(sequences)}), as in {first}'
    raise DataError(f'{source}: no .bin file in it, and not a rosbag2 folder{hint}')


def segment_scans(
    source: Path, scans: Sequence[Path], arguments: argparse.Namespace, config: Config
) -> int:
    """Write one label file per scan."""
    values = {int(label): label.value if arguments.raw else SEMANTIC_KITTI_CODE[label]
              for label in Label}  # fmt: skip
    code = np.array([values[k] for k in range(len(values))], dtype='<u4')
    target = Path(arguments.output) if arguments.output else default_output(source)
    if not arguments.quiet:
        note_leftovers(target)
    tally = SegmentationTally()
    with (
        closing(GroundSegmenter(config)) as segmenter,
        _label_files(source, scans, target, force=arguments.force) as label_paths,
        progress_bar(len(scans), quiet=arguments.quiet, title='segment') as bar,
    ):
        for scan, label_path in zip(scans, label_paths, strict=True):
            try:
                result = segmenter.segment(read_points(scan))
            except PointCloudError as error:
                raise PointCloudError(f'{scan}: {error}') from error
            _write_labels(label_path, code[result.label])
            tally.add(result)
            bar.update()
    print(tally.summary(target))
    return 0


def default_output(source: Path) -> Path:
    """Folder beside the input, named after it."""
    named = source if source.name not in ('', '..') else source.resolve()
    return named.with_name(f'{named.stem if named.is_file() else named.name}_ground')


@contextmanager
def _label_files(
    source: Path, scans: Sequence[Path], target: Path, *, force: bool
) -> Iterator[list[Path]]:
    """Where to write the labels of each scan; all take their names at the end."""
    if target.suffix == '.label':
        if source.is_dir():
            raise DataError(f'{target}: must be a folder, {source} is one')
        with staged_file(target, force=force) as path:
            yield [path]
        return
    names = [f'{scan.stem}.label' for scan in scans]
    with staged_files(target, names, force=force) as folder:
        yield [folder / name for name in names]


def _write_labels(path: Path, labels: npt.NDArray[np.uint32]) -> None:
    path.write_bytes(labels.tobytes())
