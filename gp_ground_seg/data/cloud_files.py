"""Point clouds in files, their format known by the suffix; what libraries raise, in one line."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from gp_ground_seg.core.errors import DataError, GroundSegError, PointCloudError
from gp_ground_seg.data.bag_files import in_one_line
from gp_ground_seg.data.clouds import Cloud, Columns, name_columns
from gp_ground_seg.data.files import MAX_SCAN_BYTES, AnyPath, read_bytes
from gp_ground_seg.data.numpy_files import encode_npy, encode_npz, read_numpy
from gp_ground_seg.data.pcd import encode_pcd, read_pcd
from gp_ground_seg.data.ply import encode_ply, read_ply
from gp_ground_seg.data.scan_layout import KITTI, ScanLayout, check_scan, four_columns, read_scan

NUSCENES_SUFFIX, NUSCENES_COLUMNS = '.pcd.bin', 5
_READERS: dict[str, Callable[[bytes], Cloud]] = {
    '.pcd': read_pcd,
    '.ply': read_ply,
    '.npy': read_numpy,
    '.npz': read_numpy,
}
_ENCODERS = {'.pcd': encode_pcd, '.ply': encode_ply, '.npy': encode_npy, '.npz': encode_npz}
SUFFIXES = ('.bin', *_READERS)
WRITABLE = tuple(_READERS)


def read_file(path: AnyPath, layout: ScanLayout = KITTI) -> Cloud:
    """Read a file; `layout` is that of ``.bin`` files, says what to do in doubt, and the origin.

    Raises DataError if it cannot be read, is larger than `MAX_SCAN_BYTES`, or, where the layout
    asks for that, can be no scan. nuScenes' ``.pcd.bin`` is known by its name.
    """
    suffix = path.suffix.lower()
    if suffix == '.bin':
        if path.name.endswith(NUSCENES_SUFFIX) and layout.columns == KITTI.columns:
            layout = replace(layout, columns=NUSCENES_COLUMNS)
        table = read_scan(path, layout)
        # Coordinates of a map need their double precision until the origin is subtracted.
        xyz = four_columns(table) if layout.origin is None else table
        cloud = Cloud(name_columns(table), xyz)
    else:
        data = read_bytes(path, MAX_SCAN_BYTES)
        with _named(path, 'cannot be read'), np.errstate(all='ignore'):
            cloud = _READERS[suffix](data)
    cloud = cloud.about(layout.origin)
    check_scan(path, cloud.xyz[:, :3], layout)
    return cloud


def encode_file(
    path: AnyPath, cloud: Cloud, label: npt.NDArray[np.uint8], results: Columns
) -> bytes:
    """File of a cloud with a `Label` and further values for each point; DataError if none can be.

    Its format is that of `path`, one of `WRITABLE`.
    """
    with _named(path, 'cannot be written'), np.errstate(all='ignore'):
        return _ENCODERS[path.suffix](cloud.join({'label': label, **results}))


@contextmanager
def _named(path: AnyPath, what: str) -> Iterator[None]:
    """Raise what goes wrong in the block as a DataError with the name of the file."""
    try:
        yield
    except PointCloudError as error:
        raise DataError(f'{path}: {error}') from error
    except GroundSegError:
        raise
    except Exception as error:  # Of many types: ValueError, struct.error, zlib.error, ...
        said = f'{type(error).__name__}: {in_one_line(error)}'
        raise DataError(f'{path}: {what} as {path.suffix} ({said})') from error
