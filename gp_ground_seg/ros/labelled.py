"""``~/labeled``: the input cloud with what was found out about every point."""

from __future__ import annotations

from array import array
from collections.abc import Iterable

import numpy as np
import numpy.typing as npt
from sensor_msgs.msg import PointCloud2, PointField

from gp_ground_seg.data.point_cloud2 import append_columns
from gp_ground_seg.result import Segmentation
from gp_ground_seg.ros.point_cloud2 import read_xyz

FIELDS = ('label', 'height', 'ground_z', 'ground_std', 'p_ground')
"""Fields that are added: uint8 `Label`, then float32, [m] but for the probability."""
PREFIX = 'gp_'


def free_names(taken: Iterable[str]) -> dict[str, str]:
    """Name that each of `FIELDS` gets in a cloud whose fields are `taken`.

    A field of the input keeps its name; ours is put behind as many ``gp_`` as needed.
    """
    used = set(taken)
    names = {}
    for field in FIELDS:
        name = field
        while name in used:
            name = PREFIX + name
        used.add(name)
        names[field] = name
    return names


def labelled_cloud(cloud: PointCloud2, segmentation: Segmentation) -> PointCloud2:
    """`cloud` with the fields of `FIELDS` added to every point.

    Header, order and shape are the input's, and so is every byte of every point;
    padding of the rows is left out. ``is_dense`` says whether the coordinates and all
    that was added are finite.
    """
    names = free_names(field.name for field in cloud.fields)
    columns: dict[str, npt.NDArray[np.uint8] | npt.NDArray[np.float32]] = {}
    is_dense = bool(np.isfinite(read_xyz(cloud)).all())
    for field in FIELDS:
        values = getattr(segmentation, field)
        if field != 'label':
            with np.errstate(over='ignore'):
                values = values.astype(np.float32, copy=False)
            is_dense = is_dense and bool(np.isfinite(values).all())
        columns[names[field]] = values
    wide = append_columns(cloud, columns)
    data = array('B')
    data.frombytes(wide.data.data)
    message = PointCloud2(
        header=cloud.header,
        height=cloud.height,
        width=cloud.width,
        fields=[
            *cloud.fields,
            *(
                PointField(name=name, offset=offset, datatype=datatype, count=1)
                for name, offset, datatype in wide.columns
            ),
        ],
        is_bigendian=cloud.is_bigendian,
        point_step=wide.point_step,
        row_step=cloud.width * wide.point_step,
        is_dense=is_dense,
    )
    message.data = data
    return message
