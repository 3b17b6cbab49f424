"""What an unknown height and tilt of the sensor costs, on labelled and on simulated scans."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from gp_ground_seg.core.parameters.config import Config
from gp_ground_seg.core.parameters.schema import AUTO
from gp_ground_seg.core.pipeline.sensor_pose import SensorPose
from gp_ground_seg.data.semantic_kitti import Frame
from gp_ground_seg.lab.experiments import variants as engine
from gp_ground_seg.lab.experiments.variants import SimulatedFrame
from gp_ground_seg.lab.scale.cluster import HERE, Runner
from gp_ground_seg.lab.scoring import evaluate as methods
from gp_ground_seg.lab.scoring.evaluate import KnownScan, MethodScore, pool
from gp_ground_seg.lab.scoring.intervals import interval_note, interval_text
from gp_ground_seg.lab.scoring.metrics import GROUNDGRID, SENSOR_HEIGHT
from gp_ground_seg.lab.scoring.report import Column, Report, Row, Table, percent
from gp_ground_seg.lab.simulation import SCENES, SENSORS, semantic_kitti_labels, simulate_scan

Turn = tuple[float, float]
"""Roll and pitch [degrees]."""
Mount = tuple[float, Turn]
"""Height of a sensor [m], and how it is turned."""

NO_TURN = (0.0, 0.0)
TURNS = (NO_TURN, (3, 0), (-3, 0), (0, 3), (0, -3), (3, 3), (3, -3), (-3, 3), (-3, -3))
MOUNTS: tuple[Mount, ...] = tuple((SENSOR_HEIGHT, turn) for turn in TURNS)
"""Labelled frames of KITTI's car, as they are and turned."""
SIMULATED_MOUNTS: tuple[Mount, ...] = tuple(
    itertools.product((0.4, 1.2, SENSOR_HEIGHT, 2.5), (NO_TURN, (3.0, -3.0)))
)
"""Simulated sensors, level and turned."""


class Trial(NamedTuple):
    """Scans of a group, all under one mount, with the pose given and estimated."""

    group: str
    mount: Mount
    given: MethodScore  # height and angles as they are
    level: MethodScore  # the height, the sensor taken to be level
    auto: MethodScore  # all three estimated

    @property
    def change(self) -> float:
        """Change of the IoU by the estimate."""
        return self.auto.iou - self.given.iou


def score_poses(
    items: Sequence[Any],
    load: Callable[[Mount, Any], KnownScan],
    mounts: Sequence[Mount],
    config: Config,
    runner: Runner = HERE,
) -> Report:
    """Run scans under each mount; ConfigError if `config` sets the pose itself."""
    names = ('sensor.height', 'sensor.roll', 'sensor.pitch')
    engine.refuse_changed(config, names)
    trials, scores = [], []
    for mount in mounts:
        height, turn = mount
        poses = {
            'given': (height, *map(math.radians, turn)),
            'level': (height, 0.0, 0.0),
            'auto': (AUTO, AUTO, AUTO),
        }
        variants = {
            way: config.replace(**dict(zip(names, pose, strict=True)))
            for way, pose in poses.items()
        }
        found = engine.score_variants(items, partial(load, mount), variants, runner=runner)
        for group in found[0].sequences:
            trials.append(Trial(group, mount, *(score.of(group) for score in found)))
        scores += [pool(f'{one.name} {height:g} m {turn_text(turn)}', [one]) for one in found]
    tables = {
        'heights': height_table([trial for trial in trials if trial.mount[1] == NO_TURN]),
        'turns': turn_table([trial for trial in trials if trial.mount[1] != NO_TURN]),
    }
    return engine.make_report(tables, scores, config)


def load_turned(mount: Mount, frame: Frame) -> KnownScan:
    """Read a labelled frame as a turned sensor would see it; its height is what it is."""
    scan = methods.load_kitti(frame)
    roll, pitch = map(math.radians, mount[1])
    points = scan.points[:, :3].astype(np.float64) @ SensorPose(0.0, roll, pitch).rotation
    return dataclasses.replace(scan, points=points, semantic=None, ground_z=None)


def load_mounted(mount: Mount, frame: SimulatedFrame) -> KnownScan:
    """Simulate a scan under a mount."""
    height, (roll, pitch) = mount[0], map(math.radians, mount[1])
    sensor = dataclasses.replace(SENSORS[frame.sensor], height=height, roll=roll, pitch=pitch)
    rng = np.random.default_rng(frame.seed)
    made = simulate_scan(SCENES[frame.scene](frame.seed), sensor, rng)
    truth = GROUNDGRID.truth(semantic_kitti_labels(made.kind), made.points[:, 2])
    points = made.points[:, :3].astype(np.float64)
    return KnownScan(frame.sequence, str(frame.seed), points, {GROUNDGRID.key: truth})


def _parts(trials: Sequence[Trial], key: Callable[[Trial], str]) -> dict[str, list[Trial]]:
    """Trials by what `key` says of them, and all."""
    parts: dict[str, list[Trial]] = {}
    for trial in trials:
        parts.setdefault(key(trial), []).append(trial)
    return {**parts, methods.ALL: list(trials)}


def _pooled(trials: Sequence[Trial]) -> tuple[MethodScore, ...]:
    """Scores of some trials: given, level, auto."""
    return tuple(pool(one[0].name, one) for one in zip(*(t[2:] for t in trials), strict=True))


def _n_levelled(found: MethodScore) -> int:
    return sum(scan.pose is not None and not scan.pose.is_level for scan in found.scans)


def height_table(trials: Sequence[Trial]) -> Table:
    """Return the scores of scans as they are, by group, and over all groups."""
    rows: list[Row] = []
    for group, own in _parts(trials, lambda trial: trial.group).items():
        given, _, found = _pooled(own)
        poses = [(s.pose, t.mount[0]) for t in own for s in t.auto.scans if s.pose is not None]
        errors = [pose.height - height for pose, height in poses]
        n_unknown = sum(not pose.height_estimated for pose, _ in poses)
        rows.append(
            [
                (Column('scans of'), group),
                (Column('scans', 'd'), len(poses)),
                (percent('given', 'told'), given.iou),
                (percent('auto'), found.iou),
                (percent('change', form='+.2f'), found.iou - given.iou),
                (percent('worst', form='+.2f'), min(t.change for t in own)),
                (Column('low', '+.2f'), min(errors)),
                (Column('high', '+.2f'), max(errors)),
                (Column('tilt', '.1f'), max(_lean(pose) for pose, _ in poses)),
                (Column('levelled', 'd'), _n_levelled(found)),
                (Column('unknown', 'd', 'silent'), n_unknown),
            ]
        )
    title = (
        'Scans as they are: ground IoU [%] with the pose given and estimated (auto); the '
        'worst change of a sequence or height; lowest and highest error of the height [m]; the '
        'largest tilt measured [degrees]; how many were levelled, and how many do not show '
        'their height'
    )
    return Table.of(rows, title=title, notes=_note(trials))


def _lean(pose: SensorPose) -> float:
    """Tilt that the scan shows [degrees]."""
    if pose.measured is None:
        return 0.0
    return math.degrees(math.acos(math.cos(pose.measured.roll) * math.cos(pose.measured.pitch)))


def turn_table(trials: Sequence[Trial]) -> Table:
    """Return the scores of turned scans, by turn where there are several, else by group."""
    turns = {trial.mount[1] for trial in trials}
    first, what, key = 'turned by', '', lambda trial: turn_text(trial.mount[1])
    if len(turns) == 1:
        first, what, key = 'scans of', f' by {turn_text(*turns)}', lambda trial: trial.group
    rows: list[Row] = []
    for name, own in _parts(trials, key).items():
        given, level, found = _pooled(own)
        rows.append(
            [
                (Column(first), name),
                (Column('scans', 'd'), len(given.scans)),
                (percent('given', 'told'), given.iou),
                (percent('level'), level.iou),
                (percent('change', 'change_level', '+.2f'), level.iou - given.iou),
                (percent('auto'), found.iou),
                (percent('change', 'change_auto', '+.2f'), found.iou - given.iou),
                (percent('worst', form='+.2f'), min(t.change for t in own)),
                (Column('levelled', 'd'), _n_levelled(found)),
            ]
        )
    title = (
        f'Scans turned{what}: ground IoU [%] with the turn given; with only the height '
        'given, taken to be level; and with all estimated (auto). Each with its change against '
        'given, the worst one that of a sequence, turn or height; how many scans were levelled'
    )
    return Table.of(rows, title=title, notes=_note(trials))


def _note(trials: Sequence[Trial]) -> list[str]:
    """Say how sure the change by the estimate is, over all scans."""
    given, _, found = _pooled(trials)
    interval = interval_text(found.parts(), given.parts())
    if interval is None:
        return []
    clusters = f'{len(given.sequences)} groups of scans'
    return [f'change by auto over all: {interval} [%] ({interval_note(clusters)})']


def turn_text(turn: Turn) -> str:
    """As in ``roll +3° pitch -3°``."""
    named = zip(('roll', 'pitch'), turn, strict=True)
    return ' '.join(f'{name} {angle:+.0f}°' for name, angle in named if angle)
