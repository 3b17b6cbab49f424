"""A point cloud of any format: every field of its file, and the coordinates to segment."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from gp_ground_seg.errors import PointCloudError

COLUMNS = ('x', 'y', 'z', 'intensity')
"""Names of the first columns of a table without names; the others are column_5, ..."""


@dataclass(frozen=True)
class Cloud:
    """Points of one scan.

    Attributes
    ----------
    fields : (N,) structured array
        Every field of the file under its own name and in its own type; x, y, z [m] among them.
    xyz : (N, 3) or wider float32 or float64 array
        What `GroundSegmenter.segment` takes: x, y, z [m], the sensor at the origin; of a ``.bin``
        scan (N, 4), with the intensity.
    header : opaque
        What the format needs to write the cloud as it was read, None if nothing.
    """

    fields: npt.NDArray[np.void]
    xyz: npt.NDArray[np.floating]
    header: Any = None


def cloud_of(fields: npt.NDArray[np.void], header: Any = None) -> Cloud:
    """Cloud of the points of a structured array; PointCloudError if x, y, z are not numbers."""
    names = fields.dtype.names or ()
    for name in 'xyz':
        if names.count(name) != 1 or fields[name].dtype.kind not in 'fiu' or fields[name].ndim > 1:
            known = ', '.join(names) or 'none'
            raise PointCloudError(f'no field {name} of one number per point; fields: {known}')
    columns = [fields[name] for name in 'xyz']
    # Integers, as of the grid of a LAS file, are exact in double precision only.
    is_single = all(column.dtype == np.float32 for column in columns)
    with np.errstate(invalid='ignore'):
        xyz = np.stack(columns, axis=1, dtype=np.float32 if is_single else np.float64)
    return Cloud(fields, xyz, header)


def name_columns(table: npt.NDArray[Any]) -> npt.NDArray[np.void]:
    """Structured array (N,) of a table (N, columns), which it shares memory with."""
    names = [*COLUMNS, *(f'column_{k}' for k in range(5, table.shape[1] + 1))]
    dtype = np.dtype([(name, table.dtype) for name in names[: table.shape[1]]])
    fields: npt.NDArray[np.void] = np.ascontiguousarray(table).view(dtype).reshape(len(table))
    return fields
