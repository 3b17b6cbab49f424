"""What not knowing height and tilt of the sensor costs, on labelled and on simulated scans."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from gp_ground_seg.data.semantic_kitti import Frame, read_labels, read_points
from gp_ground_seg.errors import ConfigError, PointCloudError
from gp_ground_seg.evaluation.conventions import GROUNDGRID, SENSOR_HEIGHT
from gp_ground_seg.evaluation.scores import Confusion, count_confusion
from gp_ground_seg.frame import FloatArray
from gp_ground_seg.parameters.config import Config, find_spec
from gp_ground_seg.parameters.schema import AUTO
from gp_ground_seg.pipeline.sensor_pose import SensorPose
from gp_ground_seg.pipeline.tilt import rotation
from gp_ground_seg.segmenter import GroundSegmenter
from gp_ground_seg.simulation import (
    HDL_64E,
    OS1_128,
    SCENES,
    VLP_16,
    SensorModel,
    semantic_kitti_labels,
    simulate_scan,
)

TOLD, LEVEL, FOUND = 'told', 'level', 'auto'
"""Ways to run: height and angles given as they are; the height given and the sensor taken to be
level; all three found out."""

TILT = math.radians(3.0)
TURNS = ((0, 0), (1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (1, -1), (-1, 1), (-1, -1))
"""Roll and pitch that labelled frames are turned by, in units of `TILT`."""
UPRIGHT = 'z'
AXES_UP = {
    '-z': (math.pi, 0.0),
    'y': (math.pi / 2.0, 0.0),
    '-y': (-math.pi / 2.0, 0.0),
    'x': (0.0, -math.pi / 2.0),
    '-x': (0.0, math.pi / 2.0),
}
"""Roll and pitch that leave another axis up, by its name."""

SENSORS = (HDL_64E, VLP_16, OS1_128)
HEIGHTS = (0.4, 1.2, 1.73, 2.5)
SIMULATED_TURNS = ((0, 0), (1, -1))


@dataclass(frozen=True)
class PoseTrial:
    """One scan under one turn.

    Attributes
    ----------
    group : str
        Sequence, or sensor and scene.
    height : float
        True height of the sensor [m].
    turn : (int, int)
        True roll and pitch, in units of `TILT`.
    found : SensorPose or None
        What was found out; None if the scan was refused.
    confusions : dict of str to Confusion
        By way to run, GroundGrid convention; a refused scan has no ground.
    """

    group: str
    height: float
    turn: tuple[int, int]
    found: SensorPose | None
    confusions: dict[str, Confusion]


@dataclass(frozen=True)
class AxisTrial:
    """Scans of one group with another axis up: how many there were, how many were refused."""

    group: str
    up: str
    n_scans: int
    n_refused: int


@dataclass(frozen=True)
class _Scan:
    group: str
    height: float
    turn: tuple[int, int]
    xyz: FloatArray
    truth: npt.NDArray[np.uint8]


class PoseChecker:
    """Runs scans with the pose told and untold.

    Parameters
    ----------
    config : Config
        All other parameters.

    Raises
    ------
    ConfigError
        If `config` sets the pose itself.
    """

    def __init__(self, config: Config) -> None:
        for name in ('sensor.height', 'sensor.roll', 'sensor.pitch'):
            if config[name] != find_spec(name).default:
                raise ConfigError(f'{name} = {config[name]}: is what is compared, leave it out')
        self._config = config
        self._segmenter = GroundSegmenter(config)

    def close(self) -> None:
        """End the worker threads."""
        self._segmenter.close()

    def run(self, scan: _Scan) -> PoseTrial:
        """Segment one scan in every way."""
        roll, pitch = (TILT * steps for steps in scan.turn)
        poses: dict[str, dict[str, float | str]] = {
            TOLD: {'height': scan.height, 'roll': roll, 'pitch': pitch},
            LEVEL: {'height': scan.height, 'roll': 0.0, 'pitch': 0.0},
            FOUND: {'height': AUTO, 'roll': AUTO, 'pitch': AUTO},
        }
        found = None
        confusions = {}
        for way, pose in poses.items():
            changes = {f'sensor.{name}': value for name, value in pose.items()}
            self._segmenter.configure(self._config.replace(**changes))
            try:
                result = self._segmenter.segment(scan.xyz)
                label = result.label
                found = result.pose
            except PointCloudError:
                label = np.zeros(len(scan.xyz), dtype=np.uint8)
                found = None
            confusions[way] = count_confusion(label, scan.truth)
        return PoseTrial(scan.group, scan.height, scan.turn, found, confusions)

    def is_refused(self, xyz: FloatArray) -> bool:
        """Whether z is said not to be up."""
        self._segmenter.configure(self._config)
        try:
            self._segmenter.estimate_pose(xyz)
        except PointCloudError:
            return True
        return False


def check_frames(
    frames: Sequence[Frame],
    config: Config,
    progress: Callable[[Sequence[Frame]], Iterable[Frame]] = iter,
) -> tuple[list[PoseTrial], list[AxisTrial]]:
    """Run labelled frames of KITTI's car, as they are and turned by `TURNS` and `AXES_UP`.

    Parameters
    ----------
    frames : sequence of Frame
        Labelled frames.
    config : Config
        Parameters but for the pose.
    progress : callable
        Wraps the frames to show how far it is, as tqdm does.

    Raises
    ------
    ConfigError
        If `config` sets the pose itself.
    DataError
        If a file cannot be read or does not fit its frame.
    """
    trials: list[PoseTrial] = []
    axes: list[AxisTrial] = []
    with closing(PoseChecker(config)) as checker:
        for frame in progress(frames):
            points = read_points(frame.points_path)
            assert frame.labels_path is not None, 'labelled_frames gives only labelled ones'
            semantic = read_labels(frame.labels_path, len(points))
            truth = GROUNDGRID.truth(semantic, points[:, 2])
            xyz = points[:, :3].astype(np.float64)
            for turn in TURNS:
                turned = xyz @ rotation(TILT * turn[0], TILT * turn[1])
                scan = _Scan(frame.sequence, SENSOR_HEIGHT, turn, turned, truth)
                trials.append(checker.run(scan))
            axes += _turned_over(checker, frame.sequence, xyz)
    return trials, merge_axes(axes)


def check_simulated(
    n_seeds: int,
    config: Config,
    scenes: Sequence[str] = tuple(SCENES),
    sensors: Sequence[SensorModel] = SENSORS,
    progress: Callable[[Sequence[tuple[SensorModel, str]]], Iterable[tuple[SensorModel, str]]] = (
        iter
    ),
) -> tuple[list[PoseTrial], list[AxisTrial]]:
    """Run simulated scans from sensors at `HEIGHTS`, level and tilted.

    Parameters
    ----------
    n_seeds : int
        Scenes of each name.
    config, progress
        As for `check_frames`; here progress is over pairs of sensor and scene.
    scenes : sequence of str
        Names of scenes.
    sensors : sequence of SensorModel
        Sensors; their own heights and tilts do not matter.

    Raises
    ------
    ConfigError
        If `config` sets the pose itself, or there is no such scene.
    """
    for name in scenes:
        if name not in SCENES:
            raise ConfigError(f'no scene {name!r}; there are {", ".join(SCENES)}')
    trials: list[PoseTrial] = []
    axes: list[AxisTrial] = []
    with closing(PoseChecker(config)) as checker:
        for sensor, name in progress(list(itertools.product(sensors, scenes))):
            for scan in _simulated(sensor, name, n_seeds):
                trials.append(checker.run(scan))
                if scan.turn == (0, 0):
                    axes += _turned_over(checker, scan.group, scan.xyz)
    return trials, merge_axes(axes)


def _simulated(sensor: SensorModel, name: str, n_seeds: int) -> Iterator[_Scan]:
    for seed, height, turn in itertools.product(range(n_seeds), HEIGHTS, SIMULATED_TURNS):
        roll, pitch = (TILT * steps for steps in turn)
        mounted = dataclasses.replace(sensor, height=height, roll=roll, pitch=pitch)
        made = simulate_scan(SCENES[name](seed), mounted, np.random.default_rng(seed))
        truth = GROUNDGRID.truth(semantic_kitti_labels(made.kind), made.points[:, 2])
        xyz = made.points[:, :3].astype(np.float64)
        yield _Scan(f'{sensor.name} {name}', height, turn, xyz, truth)


def _turned_over(checker: PoseChecker, group: str, xyz: FloatArray) -> Iterator[AxisTrial]:
    yield AxisTrial(group, UPRIGHT, 1, int(checker.is_refused(xyz)))
    for up, angles in AXES_UP.items():
        yield AxisTrial(group, up, 1, int(checker.is_refused(xyz @ rotation(*angles))))


def merge_axes(trials: Iterable[AxisTrial]) -> list[AxisTrial]:
    """Sum up by group and axis."""
    counts: dict[tuple[str, str], tuple[int, int]] = {}
    for trial in trials:
        scans, refused = counts.get((trial.group, trial.up), (0, 0))
        counts[trial.group, trial.up] = scans + trial.n_scans, refused + trial.n_refused
    return [AxisTrial(group, up, *count) for (group, up), count in counts.items()]


def pooled(trials: Iterable[PoseTrial], way: str) -> Confusion:
    """Sum of the counts of one way to run."""
    return sum((trial.confusions[way] for trial in trials), Confusion())
