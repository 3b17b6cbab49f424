"""What an unknown height and tilt of the sensor costs, on labelled and on simulated scans."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from gp_ground_seg.data.semantic_kitti import Frame
from gp_ground_seg.errors import PointCloudError
from gp_ground_seg.evaluation.evaluate import (
    ALL,
    KnownScan,
    MethodScore,
    Progress,
    load_kitti,
    pool,
)
from gp_ground_seg.evaluation.methods import MethodResult, OurMethod, Points
from gp_ground_seg.evaluation.metrics import GROUNDGRID, SENSOR_HEIGHT
from gp_ground_seg.evaluation.table import Cell, Column, Row, Table, percent
from gp_ground_seg.experiments.variants import (
    Report,
    SimulatedFrame,
    make_report,
    refuse_changed,
    score_variants,
    simulated_frames,
)
from gp_ground_seg.frame import FloatArray, Label
from gp_ground_seg.parameters.config import Config
from gp_ground_seg.parameters.schema import AUTO
from gp_ground_seg.pipeline.sensor_pose import SensorPose
from gp_ground_seg.simulation import SCENES, SENSORS, semantic_kitti_labels, simulate_scan

TOLD, LEVEL, FOUND = 'told', 'level', 'auto'
"""Ways to run: height and angles given as they are; the height given and the sensor taken to be
level; all three estimated."""

TILT = 3.0
"""Unit of the turns [degrees]."""
TURNS = ((0, 0), (1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (1, -1), (-1, 1), (-1, -1))
"""Roll and pitch that labelled frames are turned by."""
AXES_UP = {
    '-z': (180.0, 0.0),
    'y': (90.0, 0.0),
    '-y': (-90.0, 0.0),
    'x': (0.0, -90.0),
    '-x': (0.0, 90.0),
}
"""Roll and pitch [degrees] that leave another axis up, by its name."""

SIMULATED_SENSORS = ('hdl-64e', 'vlp-16', 'os1-128')
HEIGHTS = (0.4, 1.2, SENSOR_HEIGHT, 2.5)
SIMULATED_TURNS = ((0, 0), (1, -1))

Turn = tuple[int, int]


class Trial(NamedTuple):
    """Scans from one true height [m] under one turn (in units of `TILT`).

    `scores` are by way to run; where the turn is none, also by axis that is up.
    """

    height: float
    turn: Turn
    scores: dict[str, MethodScore]


class TurnedMethod(OurMethod):
    """Our method; a scan that it refuses has no ground and no pose.

    Where its name is one of `AXES_UP` it turns scans by those angles first.
    """

    def __init__(self, config: Config, name: str) -> None:
        super().__init__(config, name)
        self._rotation = rotation(AXES_UP.get(name, (0.0, 0.0)))
        self._n_refused: int | None = None

    def run(self, points: Points) -> None:
        """Segment a scan."""
        self._n_refused = None
        try:
            super().run(points @ self._rotation)
        except PointCloudError:
            self._n_refused = len(points)

    def result(self) -> MethodResult:
        """Return the result of the last scan."""
        if self._n_refused is None:
            return super().result()
        return MethodResult(np.full(self._n_refused, Label.UNKNOWN, dtype=np.uint8))


def score_poses(frames: Sequence[Frame], config: Config, progress: Progress = iter) -> Report:
    """Run labelled frames of KITTI's car, as they are and turned by `TURNS` and `AXES_UP`.

    Raises ConfigError if `config` sets the pose itself.
    """
    mounts = [(SENSOR_HEIGHT, turn) for turn in TURNS]
    return _report(frames, load_turned, mounts, config, progress)


def score_simulated_poses(
    n_seeds: int,
    config: Config,
    scenes: Sequence[str] = tuple(SCENES),
    sensors: Sequence[str] = SIMULATED_SENSORS,
    progress: Progress = iter,
) -> Report:
    """Run simulated scans from sensors at `HEIGHTS`, level and tilted; raises as `score_poses`."""
    frames = simulated_frames(sensors, scenes, n_seeds, (0.0,))
    mounts = list(itertools.product(HEIGHTS, SIMULATED_TURNS))
    return _report(frames, load_mounted, mounts, config, progress)


def angles(turn: Turn) -> tuple[float, float]:
    """Roll and pitch of a turn [degrees]."""
    return TILT * turn[0], TILT * turn[1]


def rotation(degrees: tuple[float, float]) -> FloatArray:
    """Matrix (3, 3) that turns points (N, 3) of a level sensor into one with roll and pitch."""
    roll, pitch = map(math.radians, degrees)
    return SensorPose(0.0, roll, pitch).rotation


def load_turned(_height: float, turn: Turn, frame: Frame) -> KnownScan:
    """Read a labelled frame as a turned sensor would see it; its height is what it is."""
    scan = load_kitti(frame)
    points = scan.points[:, :3].astype(np.float64) @ rotation(angles(turn))
    return dataclasses.replace(scan, points=points, semantic=None, parts={})


def load_mounted(height: float, turn: Turn, frame: SimulatedFrame) -> KnownScan:
    """Simulate a scan from a height [m] under a turn."""
    roll, pitch = map(math.radians, angles(turn))
    sensor = dataclasses.replace(SENSORS[frame.sensor], height=height, roll=roll, pitch=pitch)
    made = simulate_scan(
        SCENES[frame.scene](frame.seed), sensor, np.random.default_rng(frame.seed)
    )
    truth = GROUNDGRID.truth(semantic_kitti_labels(made.kind), made.points[:, 2])
    points = made.points[:, :3].astype(np.float64)
    group = f'{frame.sensor} {frame.scene}'
    return KnownScan(group, str(frame.seed), points, {GROUNDGRID.key: truth})


def _report(
    frames: Sequence[Any],
    load: Callable[[float, Turn, Any], KnownScan],
    mounts: Sequence[tuple[float, Turn]],
    config: Config,
    progress: Progress,
) -> Report:
    """Run frames from each height under each turn."""
    names = ('sensor.height', 'sensor.roll', 'sensor.pitch')
    refuse_changed(config, names)
    trials, named = [], []
    for height, turn in mounts:
        tilt = map(math.radians, angles(turn))
        poses = {TOLD: (height, *tilt), LEVEL: (height, 0.0, 0.0), FOUND: (AUTO, AUTO, AUTO)}
        variants = {
            way: config.replace(**dict(zip(names, pose, strict=True)))
            for way, pose in poses.items()
        }
        if turn == (0, 0):
            variants |= dict.fromkeys(AXES_UP, config)
        found = score_variants(
            frames, partial(load, height, turn), variants, make=TurnedMethod, progress=progress
        )  # fmt: skip
        trials.append(Trial(height, turn, {score.name: score for score in found}))
        named += [
            pool(f'{score.name} {height:g} m {turn_text(turn)}', [score])
            for score in found[: len(poses)]
        ]
    level = [trial for trial in trials if trial.turn == (0, 0)]
    turned = [trial for trial in trials if trial.turn != (0, 0)]
    tables = {
        'heights': height_table(level), 'turns': turn_table(turned), 'axes': axis_table(level),
    }  # fmt: skip
    return make_report(tables, named, config)


def _pooled(trials: Sequence[Trial], way: str, group: str | None = None) -> MethodScore:
    return pool(way, (trial.scores[way].of(group) for trial in trials))


def _change(trials: Sequence[Trial], group: str | None) -> float:
    """Return the IoU with the pose estimated over that with the pose given."""
    return _pooled(trials, FOUND, group).iou - _pooled(trials, TOLD, group).iou


def _n_levelled(found: MethodScore) -> int:
    return sum(scan.pose is not None and not scan.pose.is_level for scan in found.scans)


def _lean(pose: SensorPose | None) -> float:
    """Tilt that the scan shows [degrees]."""
    if pose is None or pose.measured is None:
        return 0.0
    measured = pose.measured
    return math.degrees(math.acos(math.cos(measured.roll) * math.cos(measured.pitch)))


def height_table(trials: Sequence[Trial]) -> Table:
    """Return the scores of scans as they are, by group, and over several groups."""
    groups = trials[0].scores[TOLD].sequences
    rows: list[Row] = []
    for group in (*groups, *([None] if len(groups) > 1 else [])):
        told, found = (_pooled(trials, way, group) for way in (TOLD, FOUND))
        errors = [
            scan.pose.height - trial.height
            for trial in trials
            for scan in trial.scores[FOUND].of(group).scans
            if scan.pose is not None
        ]
        changes = [_change([t], g) for t in trials for g in ([group] if group else groups)]
        poses = [scan.pose for scan in found.scans]
        n_silent = sum(pose is None or not pose.height_estimated for pose in poses)
        rows.append(
            [
                (Column('scans of'), group or ALL),
                (Column('scans', 'd'), len(poses)),
                (percent(TOLD), told.iou),
                (percent(FOUND), found.iou),
                (percent('change', form='+.2f'), found.iou - told.iou),
                (percent('worst', form='+.2f'), min(changes)),
                (Column('low', '+.2f'), min(errors, default=None)),
                (Column('high', '+.2f'), max(errors, default=None)),
                (Column('tilt', '.1f'), max(map(_lean, poses))),
                (Column('levelled', 'd'), _n_levelled(found)),
                (Column('silent', 'd'), n_silent),
            ]
        )
    title = (
        'Scans as they are: ground IoU [%] with the pose told and estimated (auto); the '
        'worst change of a sequence or height; lowest and highest error of the height [m]; the '
        'largest tilt measured [degrees]; how many were levelled, and how many do not show '
        'their height'
    )
    return Table.of(rows, title=title)


def turn_table(trials: Sequence[Trial]) -> Table:
    """Return the scores of turned scans, by turn where there are several, else by group."""
    groups = trials[0].scores[TOLD].sequences
    turns = list(dict.fromkeys(trial.turn for trial in trials))
    parts: list[tuple[str, Sequence[Trial], str | None]]
    if len(turns) > 1:
        first, what = 'turned by', ''
        parts = [(turn_text(turn), [t for t in trials if t.turn == turn], None) for turn in turns]
    else:
        first, what = 'scans of', f' by {turn_text(turns[0])}'
        parts = [(group, trials, group) for group in groups]
    rows: list[Row] = []
    for name, own, group in [*parts, (ALL, trials, None)]:
        told, level, found = (_pooled(own, way, group) for way in (TOLD, LEVEL, FOUND))
        changes = [_change(own, one) for one in ([group] if group else groups)]
        rows.append(
            [
                (Column(first), name),
                (Column('scans', 'd'), len(told.scans)),
                (percent(TOLD), told.iou),
                (percent(LEVEL), level.iou),
                (percent('change', 'change_level', '+.2f'), level.iou - told.iou),
                (percent(FOUND), found.iou),
                (percent('change', 'change_auto', '+.2f'), found.iou - told.iou),
                (percent('worst', form='+.2f'), min(changes)),
                (Column('levelled', 'd'), _n_levelled(found)),
            ]
        )
    title = (
        f'Scans turned{what}: ground IoU [%] with the turn told; with only the height '
        'told, taken to be level; and with all estimated (auto). Each with its change against '
        'told, the worst one that of a group; how many scans were levelled'
    )
    return Table.of(rows, title=title)


def turn_text(turn: Turn) -> str:
    """As in ``roll +3° pitch -3°``."""
    named = zip(('roll', 'pitch'), angles(turn), strict=True)
    return ' '.join(f'{name} {angle:+.0f}°' for name, angle in named if angle)


def axis_table(trials: Sequence[Trial]) -> Table:
    """How many scans were refused, by the axis that is up."""
    rows: list[list[Cell]] = []
    for up, way in (('z', FOUND), *zip(AXES_UP, AXES_UP, strict=True)):
        scans = _pooled(trials, way).scans
        rows.append([up, len(scans), sum(scan.pose is None for scan in scans)])
    columns = [Column('up'), Column('scans', 'd'), Column('refused', 'd')]
    return Table(columns, rows, 'Scans turned over: refused because z is not up')
