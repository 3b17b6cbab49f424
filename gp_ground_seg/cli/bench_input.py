"""Frames to time, from whatever holds scans."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import numpy.typing as npt

from gp_ground_seg.cli.segment_scans import find_scans
from gp_ground_seg.data.bag_files import is_bag
from gp_ground_seg.data.bags import open_bag
from gp_ground_seg.data.point_cloud2 import decode_cloud, read_xyz
from gp_ground_seg.data.semantic_kitti import list_frames, list_sequences, read_points
from gp_ground_seg.errors import DataError, PointCloudError
from gp_ground_seg.evaluation.bench import BenchFrame
from gp_ground_seg.evaluation.bench_scaling import spread

RUN_LENGTH = 10
"""Successive frames that are taken together where there are more than wanted."""

Points = npt.NDArray[np.float32]


def load_frames(source: Path, n_frames: int, topic: str | None = None) -> list[BenchFrame]:
    """Read at most about `n_frames` frames into memory, in runs spread over all there are.

    Parameters
    ----------
    source : Path
        A folder with sequences/*/velodyne below it, a scan, a folder of scans, or a bag.
    n_frames : int
        Frames wanted.
    topic : str, optional
        Topic of a bag.

    Raises
    ------
    DataError
        If there is nothing to read there, or no point in it.
    """
    if not source.exists():
        raise DataError(f'{source}: no such file or folder')
    if is_bag(source):
        frames = _bag_frames(source, n_frames, topic)
    elif topic is not None:
        raise DataError(f'--topic: is for bags, which {source} is not')
    elif any(source.glob('sequences/*/velodyne')):
        names = list_sequences(source)
        frames = []
        for name in names:
            paths = [frame.points_path for frame in list_frames(source, name)]
            frames += _scan_frames(name, paths, max(n_frames // len(names), 1))
    else:
        frames = _scan_frames(source.stem, find_scans(source), n_frames)
    if not any(len(frame.points) for frame in frames):
        raise DataError(f'{source}: no point in any of {len(frames)} frames')
    return frames


def runs(n_available: int, n_wanted: int) -> list[range]:
    """Index ranges of runs of `RUN_LENGTH`, spread evenly; all in one if there are no more."""
    if n_available <= n_wanted:
        return [range(n_available)]
    length = min(RUN_LENGTH, n_wanted)
    starts = spread(n_available // length, n_wanted // length)
    return [range(length * k, length * (k + 1)) for k in starts]


def _scan_frames(name: str, paths: list[Path], n_frames: int) -> list[BenchFrame]:
    return _frames(name, len(paths), n_frames, lambda k: (paths[k].stem, read_points(paths[k])))


def _bag_frames(source: Path, n_frames: int, topic: str | None) -> list[BenchFrame]:
    with open_bag(source) as bag:
        name = bag.pick_point_cloud_topic(topic)
        n_messages = bag.n_messages(name)
        wanted = {k for run in runs(n_messages, n_frames) for k in run}
        found: dict[int, tuple[str, Points]] = {}
        for k, (_, time, raw) in enumerate(bag.messages([name])):
            if k in wanted:
                try:
                    found[k] = str(time), _with_intensity(read_xyz(decode_cloud(raw)))
                except PointCloudError as error:
                    raise DataError(f'{source}: message {k} of topic {name}: {error}') from error
        return _frames(name, n_messages, n_frames, found.__getitem__)


def _frames(
    name: str, n_available: int, n_wanted: int, load: Callable[[int], tuple[str, Points]]
) -> list[BenchFrame]:
    chosen = runs(n_available, n_wanted)
    return [
        # Each run is a sequence: what is temporal must not reach over the hole before it.
        BenchFrame(name if len(chosen) == 1 else f'{name}:{run.start}', *load(k))
        for run in chosen
        for k in run
    ]


def _with_intensity(xyz: npt.NDArray[np.floating]) -> Points:
    """Points as the yardstick takes them; full intensity, so that it drops none as noise."""
    points = np.ones((len(xyz), 4), dtype=np.float32)
    points[:, :3] = xyz
    return points
