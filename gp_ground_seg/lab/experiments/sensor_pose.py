"""The cost of an unknown height and tilt of the sensor, on labelled frames."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from functools import partial

import numpy as np

from gp_ground_seg.core.parameters.config import Config
from gp_ground_seg.core.parameters.schema import AUTO
from gp_ground_seg.core.pipeline.sensor_pose import SensorPose
from gp_ground_seg.data.semantic_kitti import Frame
from gp_ground_seg.lab.experiments.variants import refuse_changed, score_variants
from gp_ground_seg.lab.scale.cluster import HERE, Runner
from gp_ground_seg.lab.scoring.comparison import interval_note, interval_text
from gp_ground_seg.lab.scoring.evaluate import ALL, KnownScan, MethodScore, load_kitti, pool
from gp_ground_seg.lab.scoring.metrics import SENSOR_HEIGHT
from gp_ground_seg.lab.scoring.report import Column, Report, Row, Table, percent
from gp_ground_seg.lab.scoring.tables import make_report

Turn = tuple[float, float]
"""Roll and pitch of a sensor [degrees]."""

TURNS: tuple[Turn, ...] = (
    (0, 0), (3, 0), (-3, 0), (0, 3), (0, -3), (3, 3), (3, -3), (-3, 3), (-3, -3),
)  # fmt: skip
"""How the frames are seen."""
NAMES = ('sensor.height', 'sensor.roll', 'sensor.pitch')


def score_poses(items: Sequence[Frame], config: Config, runner: Runner = HERE) -> Report:
    """Compare the segmentation with height and tilt of the sensor given and estimated.

    On labelled frames of KITTI's car as they are, and turned by 3 degrees.
    """
    refuse_changed(config, NAMES)
    trials: dict[str, list[MethodScore]] = {}
    rows: list[Row] = []
    worsts: list[float] = []
    for turn in TURNS:
        variants, load = _variants(config, turn), partial(load_turned, turn)
        name = turn_text(turn)
        trials[name] = score_variants(items, variants, load=load, runner=runner)
        worsts.append(_worst(trials[name]))
        rows.append(_row(name, trials[name], worsts[-1]))
    pooled = [pool(found[0].name, found) for found in zip(*trials.values(), strict=True)]
    title = (
        'Ground IoU [%] with the pose given; with the height given, the sensor taken to be '
        'level; and with all estimated (auto). Change of auto against given, and the worst of a '
        'sequence under a turn; lowest and highest error of the height [m]; how many scans were '
        'levelled, and how many do not show their height'
    )
    rows.append(_row(ALL, pooled, min(worsts)))
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


def _row(name: str, scores: Sequence[MethodScore], worst: float) -> Row:
    """Row of scans with the pose given, level and estimated."""
    given, level, auto = scores
    poses = [scan.pose for scan in auto.scans if scan.pose is not None]
    errors = [pose.height - SENSOR_HEIGHT for pose in poses]
    return [
        (Column('turn'), name),
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


def turn_text(turn: Turn) -> str:
    """As in ``roll +3° pitch -3°``."""
    named = zip(('roll', 'pitch'), turn, strict=True)
    return ' '.join(f'{name} {angle:+.0f}°' for name, angle in named if angle) or 'none'


def _variants(config: Config, turn: Turn) -> dict[str, Config]:
    """Return parameters with the pose given, taken to be level, and estimated."""
    poses = {
        'given': (SENSOR_HEIGHT, *map(math.radians, turn)),
        'level': (SENSOR_HEIGHT, 0.0, 0.0),
        'auto': (AUTO, AUTO, AUTO),
    }
    return {
        name: config.replace(**dict(zip(NAMES, pose, strict=True))) for name, pose in poses.items()
    }


def load_turned(turn: Turn, frame: Frame) -> KnownScan:
    """Read a labelled frame as a turned sensor would see it."""
    scan, (roll, pitch) = load_kitti(frame), map(math.radians, turn)
    points = scan.points[:, :3].astype(np.float64) @ SensorPose(0.0, roll, pitch).rotation
    return dataclasses.replace(scan, points=points, semantic=None, ground_z=None)
