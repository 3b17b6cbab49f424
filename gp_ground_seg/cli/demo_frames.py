"""What the demo plays: labelled scans, simulated or of KITTI."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from gp_ground_seg.data.bags import BagWriter, cloud_topic
from gp_ground_seg.data.point_cloud2 import CloudMessage, cloud_from_columns, encode_cloud
from gp_ground_seg.data.semantic_kitti import FRAME_PERIOD, read_labels, read_points
from gp_ground_seg.evaluation.evaluate import labelled_frames
from gp_ground_seg.simulation import HDL_64E, SCENES, SEMANTIC_KITTI_CLASS, Kind, simulate_drive

TOPIC = '/points'
"""What the node listens to without any remapping."""
FRAME_ID = 'lidar'
EPOCH = 1_700_000_000
"""Second at which every drive starts: the same drive gives the same bag."""
SCENE = 'urban'
SPEED = 8.0
"""Of the simulated drive [m/s]."""


@dataclass(frozen=True)
class Drive:
    """Labelled scans, made one by one.

    Attributes
    ----------
    name, description : str
        What it is, in a word and in some more.
    truth : str
        Whose labels it has.
    n_frames : int
        How many scans.
    scans : iterator
        Points (N, 4) float32, semantic class of each point (N,), time [s] since the start.
    """

    name: str
    description: str
    truth: str
    n_frames: int
    scans: Iterator[tuple[npt.NDArray[np.float32], npt.NDArray[np.integer], float]]


def simulated_drive(n_frames: int, seed: int) -> Drive:
    """Drive along a street that an HDL-64E sees."""
    class_of_kind = np.array([SEMANTIC_KITTI_CLASS[kind] for kind in Kind])
    scans = simulate_drive(SCENES[SCENE](seed), HDL_64E, n_frames, SPEED, seed)
    return Drive(
        'Simulated street',
        'a simulated street as a Velodyne HDL-64E sees it',
        'the truth, which the simulator knows',
        n_frames,
        ((scan.points, class_of_kind[scan.kind], scan.time) for scan in scans),
    )


def kitti_drive(root: str | Path, sequence: str, n_frames: int) -> Drive:
    """First labelled scans of a KITTI sequence, as many as there are.

    Raises
    ------
    DataError
        If the sequence is not there, or has no labels.
    """
    frames = labelled_frames(root, [sequence])[:n_frames]

    def scans() -> Iterator[tuple[npt.NDArray[np.float32], npt.NDArray[np.integer], float]]:
        for frame in frames:
            points = read_points(frame.points_path)
            assert frame.labels_path is not None, 'labelled_frames gives only labelled ones'
            yield points, read_labels(frame.labels_path, len(points)), frame.time

    name = f'KITTI sequence {sequence}'
    return Drive(name, name, 'the labels of SemanticKITTI', len(frames), scans())


@dataclass(frozen=True)
class WrittenDrive:
    """What a drive came to.

    Attributes
    ----------
    n_points, n_bytes : int
        Points in it; size of the bag.
    period : float
        Time between two scans, on average [s].
    """

    n_points: int
    n_bytes: int
    period: float


def write_drive(drive: Drive, path: Path, progress: Callable[[], object]) -> WrittenDrive:
    """Write a drive as a bag with the topic `TOPIC`.

    Parameters
    ----------
    drive : Drive
        What to write.
    path : Path
        Bag to make.
    progress : callable
        Called after each scan.
    """
    n_points = 0
    times = []
    with BagWriter(path) as bag:
        bag.add_topic(cloud_topic(TOPIC))
        for points, semantic, time in drive.scans:
            stamp = EPOCH * 10**9 + round(time * 1e9)
            bag.write(TOPIC, stamp, encode_cloud(numbered_cloud(points, semantic, stamp)))
            n_points += len(points)
            times.append(time)
            progress()
    period = (times[-1] - times[0]) / (len(times) - 1) if len(times) > 1 else FRAME_PERIOD
    return WrittenDrive(n_points, path.stat().st_size, period)


def numbered_cloud(
    points: npt.NDArray[np.float32], semantic: npt.NDArray[np.integer], stamp: int
) -> CloudMessage:
    """Cloud whose points carry their truth and their number.

    The node keeps every field: they come back with whatever becomes of the point.

    Parameters
    ----------
    points : (N, 4) float32
        x, y, z [m], intensity.
    semantic : (N,) int
        SemanticKITTI classes: field ``label``.
    stamp : int
        Time of the header [ns].
    """
    columns = {name: points[:, k] for k, name in enumerate(('x', 'y', 'z', 'intensity'))}
    return cloud_from_columns(
        divmod(stamp, 10**9),
        FRAME_ID,
        {
            **columns,
            'label': semantic.astype(np.uint32),
            'index': np.arange(len(points), dtype=np.uint32),
        },
    )
