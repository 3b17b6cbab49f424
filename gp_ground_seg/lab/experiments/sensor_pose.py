"""The cost of an unknown height and tilt of the sensor, on labelled and simulated scans."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np

from gp_ground_seg.core.parameters.config import Config
from gp_ground_seg.core.parameters.schema import AUTO
from gp_ground_seg.core.pipeline.sensor_pose import SensorPose
from gp_ground_seg.lab.experiments.variants import (
    SimulatedFrame,
    load_scan,
    refuse_changed,
    score_variants,
)
from gp_ground_seg.lab.scale.cluster import HERE, Runner
from gp_ground_seg.lab.scoring.comparison import interval_note, interval_text
from gp_ground_seg.lab.scoring.evaluate import ALL, KnownScan, MethodScore, pool
from gp_ground_seg.lab.scoring.metrics import GROUNDGRID, SENSOR_HEIGHT
from gp_ground_seg.lab.scoring.report import Column, Report, Row, Table, percent
from gp_ground_seg.lab.scoring.tables import make_report
from gp_ground_seg.lab.simulation import SCENES, SENSORS, semantic_kitti_labels, simulate_scan

Mount = tuple[float, tuple[float, float]]
"""Height of a sensor [m], and its roll and pitch [degrees]."""

NO_TURN = (0.0, 0.0)
TURNS = (NO_TURN, (3, 0), (-3, 0), (0, 3), (0, -3), (3, 3), (3, -3), (-3, 3), (-3, -3))
MOUNTS: tuple[Mount, ...] = tuple((SENSOR_HEIGHT, turn) for turn in TURNS)
"""Labelled frames of KITTI's car, as they are and turned."""
SIMULATED_MOUNTS: tuple[Mount, ...] = tuple(
    itertools.product((0.4, 1.2, SENSOR_HEIGHT, 2.5), (NO_TURN, (3.0, -3.0)))
)
"""Simulated sensors, level and turned."""
NAMES = ('sensor.height', 'sensor.roll', 'sensor.pitch')


def score_poses(items: Sequence[Any], config: Config, runner: Runner = HERE) -> Report:
    """Compare the segmentation with height and tilt of the sensor given and estimated.

    On labelled frames of KITTI's car as they are, and turned by 3 degrees; on simulated scans from
    four heights.
    """
    refuse_changed(config, NAMES)
    mounts = SIMULATED_MOUNTS if isinstance(items[0], SimulatedFrame) else MOUNTS
    trials: dict[str, list[MethodScore]] = {}
    rows: list[Row] = []
    worsts: list[float] = []
    for height, turn in mounts:
        variants, load = _variants(config, (height, turn)), partial(load_mounted, (height, turn))
        name = mount_text(height, turn)
        trials[name] = score_variants(items, variants, load=load, runner=runner)
        worsts.append(_worst(trials[name]))
        rows.append(_row(name, trials[name], [height] * len(items), worsts[-1]))
    pooled = [pool(found[0].name, found) for found in zip(*trials.values(), strict=True)]
    heights = [height for height, _ in mounts for _ in items]
    title = (
        'Ground IoU [%] with the pose given; with the height given, the sensor taken to be '
        'level; and with all estimated (auto). Change of auto against given, and the worst of a '
        'sequence under a mount; lowest and highest error of the height [m]; how many scans were '
        'levelled, and how many do not show their height'
    )
    rows.append(_row(ALL, pooled, heights, min(worsts)))
    table = Table(rows, title, _note(pooled), n_sums=1)
    scores = [
        MethodScore(f'{score.name} {name}', score.scans)
        for name, found in trials.items()
        for score in found
    ]
    return make_report({'poses': table}, scores, config)


def _worst(scores: Sequence[MethodScore]) -> float:
    """Lowest change of the IoU of a sequence by the estimate."""
    given, _, auto = scores
    return min(auto.of(name).iou - given.of(name).iou for name in given.sequences)


def _row(name: str, scores: Sequence[MethodScore], heights: Sequence[float], worst: float) -> Row:
    """Row of scans with the pose given, level and estimated; `heights` are the true ones [m]."""
    given, level, auto = scores
    poses = [scan.pose for scan in auto.scans if scan.pose is not None]
    errors = [pose.height - height for pose, height in zip(poses, heights, strict=True)]
    return [
        (Column('mount'), name),
        (Column('scans', 'd'), len(poses)),
        (percent('given', 'told'), given.iou),
        (percent('level'), level.iou),
        (percent('auto'), auto.iou),
        (percent('change', form='+.2f'), auto.iou - given.iou),
        (percent('worst', form='+.2f'), worst),
        (Column('low', '+.2f'), min(errors)),
        (Column('high', '+.2f'), max(errors)),
        (Column('levelled', 'd'), sum(not pose.is_level for pose in poses)),
        (Column('unknown', 'd', 'silent'), sum(not pose.height_estimated for pose in poses)),
    ]


def _note(scores: Sequence[MethodScore]) -> list[str]:
    """Say how sure the change by the estimate is, over all scans of several sequences."""
    given, _, auto = scores
    if len(given.sequences) < 2:
        return []
    interval = interval_text(auto, given)
    return [f'change by auto over all: {interval} [%] ({interval_note(given)})']


def mount_text(height: float, turn: tuple[float, float]) -> str:
    """As in ``1.73 m roll +3° pitch -3°``."""
    named = zip(('roll', 'pitch'), turn, strict=True)
    return ' '.join(
        [f'{height:g} m', *(f'{name} {angle:+.0f}°' for name, angle in named if angle)]
    )


def _variants(config: Config, mount: Mount) -> dict[str, Config]:
    """Return parameters with the pose given, taken to be level, and estimated."""
    height, turn = mount
    poses = {
        'given': (height, *map(math.radians, turn)),
        'level': (height, 0.0, 0.0),
        'auto': (AUTO, AUTO, AUTO),
    }
    return {
        name: config.replace(**dict(zip(NAMES, pose, strict=True))) for name, pose in poses.items()
    }


def load_mounted(mount: Mount, item: Any) -> KnownScan:
    """Simulate a scan under a mount, or read a labelled frame as a turned sensor would see it.

    The height of a labelled frame is what it is.
    """
    height, (roll, pitch) = mount[0], map(math.radians, mount[1])
    if isinstance(item, SimulatedFrame):
        sensor = dataclasses.replace(SENSORS[item.sensor], height=height, roll=roll, pitch=pitch)
        rng = np.random.default_rng(item.seed)
        made = simulate_scan(SCENES[item.scene](item.seed), sensor, rng)
        truth = GROUNDGRID.truth(semantic_kitti_labels(made.kind), made.points[:, 2])
        points = made.points[:, :3].astype(np.float64)
        return KnownScan(item.sequence, str(item.seed), points, {GROUNDGRID.key: truth})
    scan = load_scan(item)
    points = scan.points[:, :3].astype(np.float64) @ SensorPose(0.0, roll, pitch).rotation
    return dataclasses.replace(scan, points=points, semantic=None, ground_z=None)
