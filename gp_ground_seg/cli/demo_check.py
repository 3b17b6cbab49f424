"""Whether what the node made of a scan is right: all points there, and how well labelled."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from gp_ground_seg.data.point_cloud2 import CloudMessage
from gp_ground_seg.errors import PointCloudError
from gp_ground_seg.evaluation.metrics import GROUNDGRID, Confusion, count_confusion
from gp_ground_seg.frame import Label

_NUMPY_TYPES = {6: '<u4', 7: '<f4'}
"""Those of `numbered_cloud`, by code of ``sensor_msgs/PointField``."""


@dataclass(frozen=True)
class ScanCheck:
    """A scan that went through the node.

    Attributes
    ----------
    n_points : int
        Finite points sent: each must come back once, in one of the two clouds.
    n_missing : int
        Those that came back in neither.
    n_repeated : int
        Those that came back more than once.
    n_altered : int
        Points that came back with another byte than they were sent with, or in a
        cloud with another header or layout.
    n_foreign : int
        Points that came back although they were not sent, or are not finite.
    label : (N,) uint8
        `Label` of each point sent, from the cloud it came back in.
    truth : (N,) uint8
        True `Label`, in the GroundGrid convention.
    points : (N, 4) float32
        x, y, z [m] and intensity of each point sent.
    """

    n_points: int
    n_missing: int
    n_repeated: int
    n_altered: int
    n_foreign: int
    label: npt.NDArray[np.uint8]
    truth: npt.NDArray[np.uint8]
    points: npt.NDArray[np.float32]

    @property
    def is_exact(self) -> bool:
        """Whether every point came back exactly once, unchanged."""
        return not (self.n_missing or self.n_repeated or self.n_altered or self.n_foreign)

    @property
    def confusion(self) -> Confusion:
        """Counts of right and wrong labels."""
        return count_confusion(self.label, self.truth)


def check_scan(sent: CloudMessage, ground: CloudMessage, obstacles: CloudMessage) -> ScanCheck:
    """Compare what was sent with what came back.

    Parameters
    ----------
    sent : CloudMessage
        As `numbered_cloud` makes it.
    ground, obstacles : CloudMessage
        What the node published of it.

    Raises
    ------
    PointCloudError
        If `sent` is no such cloud.
    """
    points = _records(sent)
    n = len(points)
    xyz = np.stack([points['x'], points['y'], points['z']], axis=1)
    finite = np.isfinite(xyz).all(axis=1)
    times_back = np.zeros(n, dtype=np.int64)
    label = np.full(n, Label.UNKNOWN, dtype=np.uint8)
    n_altered = n_foreign = 0
    for value, cloud in ((Label.GROUND, ground), (Label.OBSTACLE, obstacles)):
        if not _is_alike(sent, cloud):
            n_altered += cloud.height * cloud.width
            continue
        back = _records(cloud)
        known = back['index'] < n
        n_foreign += int(np.count_nonzero(~known))
        back = back[known]
        index = back['index']
        n_altered += _count_different(back, points[index])
        times_back += np.bincount(index, minlength=n)
        label[index] = value
    return ScanCheck(
        n_points=int(np.count_nonzero(finite)),
        n_missing=int(np.count_nonzero(finite & (times_back == 0))),
        n_repeated=int(np.count_nonzero(times_back > 1)),
        n_altered=n_altered,
        n_foreign=n_foreign + int(np.count_nonzero(~finite & (times_back > 0))),
        label=label,
        truth=GROUNDGRID.truth(points['label'], xyz[:, 2]),
        points=np.column_stack([xyz, points['intensity']]),
    )


def _is_alike(sent: CloudMessage, back: CloudMessage) -> bool:
    names = ('header', 'fields', 'point_step', 'is_bigendian')
    return all(getattr(sent, name) == getattr(back, name) for name in names) and (
        len(back.data) == back.height * back.width * back.point_step
    )


def _records(cloud: CloudMessage) -> npt.NDArray[Any]:
    """Points as a structured array, (N,)."""
    names = [field.name for field in cloud.fields]
    if cloud.is_bigendian or not {'x', 'y', 'z', 'intensity', 'label', 'index'} <= set(names):
        raise PointCloudError(f'a cloud of the demo must not have the fields {" ".join(names)}')
    dtype = np.dtype(
        {
            'names': names,
            'formats': [_NUMPY_TYPES[field.datatype] for field in cloud.fields],
            'offsets': [field.offset for field in cloud.fields],
            'itemsize': cloud.point_step,
        }
    )
    records: npt.NDArray[Any] = np.frombuffer(cloud.data, dtype=dtype)
    return records


def _count_different(one: npt.NDArray[Any], other: npt.NDArray[Any]) -> int:
    """Points with a byte that differs; floats compare as bytes, NaN with NaN too."""
    size = one.dtype.itemsize
    mine, yours = (np.frombuffer(side.tobytes(), np.uint8) for side in (one, other))
    return int(np.count_nonzero((mine != yours).reshape(-1, size).any(axis=1)))
