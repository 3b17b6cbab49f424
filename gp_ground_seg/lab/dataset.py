"""Scans that are segmented into files, or a bag into a bag, and what has been done before."""

from __future__ import annotations

import itertools
import os
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

from gp_ground_seg.core.errors import DataError
from gp_ground_seg.core.frame import Label
from gp_ground_seg.core.parameters.config import Config
from gp_ground_seg.core.pipeline.sensor_pose import MeasuredPose
from gp_ground_seg.core.result import Segmentation
from gp_ground_seg.core.segmenter import GroundSegmenter
from gp_ground_seg.data.bags import POINT_CLOUD2, decode_cloud, encode_cloud, new_bag, storage_of
from gp_ground_seg.data.cloud_files import encode_output, format_for
from gp_ground_seg.data.files import changed_at, naming, read_bytes, remove_leftovers, write_file
from gp_ground_seg.data.inputs import Input, Inputs
from gp_ground_seg.data.point_cloud2 import read_xyz, select_points
from gp_ground_seg.lab.cluster import Progress

PARAMETERS = 'parameters.yaml'
"""File of an output folder that says how its files were made."""
TOPICS = {'/ground': Label.GROUND, '/obstacles': Label.OBSTACLE}
"""Of a bag that is written."""


class Outcome(NamedTuple):
    """What is kept of a segmented cloud, for a summary."""

    n_points: int
    n_ground: int
    seconds: float  # segmentation only
    measured: MeasuredPose | None  # what it shows of the sensor's pose
    contradictions: Sequence[str]  # of it and a parameter

    @classmethod
    def of(cls, result: Segmentation) -> Outcome:
        """Count a result."""
        label, pose = result.label, result.pose
        n_ground, seconds = int((label == Label.GROUND).sum()), result.timings['total']
        return cls(len(label), n_ground, seconds, pose.measured, pose.contradictions)


def output_of(folder: Path, form: str | None, scan: Input) -> Path:
    """File of a folder that a scan becomes, of a format or by default of its own."""
    return folder / f'{scan.name}.{format_for(scan.path, form)}'


def segment_scans(
    folder: Path, form: str | None, config: Config, scans: Iterable[Input], progress: Progress
) -> list[Outcome]:
    """Write the file of each scan into a folder, replacing others."""
    segmenter, found = GroundSegmenter(config), []
    for scan in progress(scans):
        cloud, path = scan.read(), output_of(folder, form, scan)
        with naming(scan.path):
            result = segmenter.segment(cloud.xyz)
        write_file(path, encode_output(path, cloud, result))
        found.append(Outcome.of(result))
    return found


def segment_bag(target: Path, config: Config, bag: Inputs, progress: Progress) -> list[Outcome]:
    """Write a bag of the ground and the obstacles of each cloud of a bag, replacing another.

    It is stored as its suffix says, else as the input. Raises DataError if a cloud cannot be read,
    or the bag cannot be written.
    """
    storage = storage_of(bag.path).replace('ros1', 'mcap')  # no ROS 1 bag is written
    topics = dict.fromkeys(TOPICS, POINT_CLOUD2)
    segmenter, found = GroundSegmenter(config), []
    with new_bag(target, topics, force=True, storage=storage) as write:
        for place, time, raw in progress(bag.messages()):
            with naming(place):
                cloud = decode_cloud(raw)
                result = segmenter.segment(read_xyz(cloud))
            for part, label in TOPICS.items():
                write(part, time, encode_cloud(select_points(cloud, result.label == label)))
            found.append(Outcome.of(result))
    return found


def find_left(
    scans: Inputs, outputs: Sequence[Path], folder: Path, parameters: str | None, *, force: bool
) -> Sequence[Input]:
    """Return the scans to segment: all with `force`, else those that are not finished.

    Output is finished that is newer than its input, and no older than `PARAMETERS`; of a bag all
    clouds are done again if one is not. Raises DataError if an output is an input, and without
    `force` if it was made with other parameters, or by no run with parameters.

    Parameters
    ----------
    outputs : sequence of Path
        The file that each scan becomes, or the one that all of them do.
    parameters : str or None
        What a run into a `folder` writes into `PARAMETERS`; None if the output is a single one.
    """
    sources = [scan.path for scan in scans.files] or [scans.path] * len(outputs)
    inputs = {place for path in map(Path.resolve, {*sources}) for place in (path, *path.parents)}
    for path in outputs:
        if path.resolve() in inputs:
            raise DataError(f'{path}: is the input, or has it in it; name another output')
    if parameters is not None:
        for parent in {path.parent for path in outputs}:
            remove_leftovers(parent)
    there = [path for path in outputs if os.path.lexists(path)]
    if force or not there:
        return scans if scans.topic else scans.files
    begun = changed_at(folder / PARAMETERS)
    if parameters is None or not begun:
        raise DataError(f'{there[0]}: exists already; --force replaces it')
    if said := find_difference(folder, parameters):
        raise DataError(f'{said}; give another output folder, or --force to start anew')
    is_left = [
        changed_at(path) <= changed_at(source) or changed_at(path) < begun
        for source, path in zip(sources, outputs, strict=True)
    ]
    return scans if scans.topic and any(is_left) else [*itertools.compress(scans.files, is_left)]


def find_difference(folder: Path, parameters: str) -> str:
    """Say where the `PARAMETERS` of a folder differ from these; empty if they do not."""
    path = folder / PARAMETERS
    before = read_bytes(path, 1 << 20).decode(errors='replace') if path.exists() else ''
    lines = itertools.zip_longest(before.splitlines(), parameters.splitlines(), fillvalue='')
    found = (f'{path}: says "{said}", now it is "{now}"' for said, now in lines if said != now)
    return next(found, '')
