"""Scores on simulated scans, where labels and ground heights are exact."""

from __future__ import annotations

import itertools
import math
import statistics
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from gp_ground_seg.evaluation.height_error import HeightError, height_error, pool_height_errors
from gp_ground_seg.evaluation.methods import PatchworkppMethod
from gp_ground_seg.evaluation.scores import Confusion, count_confusion
from gp_ground_seg.frame import Label
from gp_ground_seg.parameters.config import Config
from gp_ground_seg.result import FitReport
from gp_ground_seg.segmenter import GroundSegmenter
from gp_ground_seg.simulation import SCENES, SENSORS, SimulatedScan, simulate_scan

SENSOR_X = (0.0, 6.0)
"""Where the sensor stands in each scene [m]."""


@dataclass(frozen=True)
class SceneScan:
    """One scan to simulate: `seed` is that of the scene and of the noise."""

    sensor: str
    scene: str
    seed: int
    x: float

    def simulate(self) -> SimulatedScan:
        """Scan the scene."""
        scene = SCENES[self.scene](self.seed)
        return simulate_scan(
            scene, SENSORS[self.sensor], np.random.default_rng(self.seed), x=self.x
        )


@dataclass(frozen=True)
class ScanScore:
    """How one method did on one scan.

    Attributes
    ----------
    scan : SceneScan
        Which.
    confusion : Confusion
        Against the exact labels: ground is what the ray hit of the terrain, all else
        is an obstacle, mirrored points below the ground as well.
    height : HeightError
        Of the surface under every return from the terrain, against its exact height.
    seconds : float
        Time of the segmentation.
    """

    scan: SceneScan
    confusion: Confusion
    height: HeightError
    seconds: float


@dataclass(frozen=True)
class SceneScore:
    """How one method did in one scene with one sensor."""

    sensor: str
    scene: str
    scans: tuple[ScanScore, ...]

    @property
    def pooled(self) -> Confusion:
        """Sum of the counts."""
        return sum((scan.confusion for scan in self.scans), Confusion())

    @property
    def height(self) -> HeightError:
        """Height error over all scans."""
        return pool_height_errors([scan.height for scan in self.scans])

    @property
    def share_without_model(self) -> float:
        """Share of the ground returns that have no surface under them."""
        height = self.height
        n_ground = height.n_points + height.n_without_model
        return height.n_without_model / n_ground if n_ground else math.nan

    @property
    def median_seconds(self) -> float:
        """Median time per scan."""
        return statistics.median(scan.seconds for scan in self.scans)


def scene_scans(sensors: Sequence[str], scenes: Sequence[str], n_seeds: int) -> list[SceneScan]:
    """Every scan of a table: sensors by scenes by seeds by `SENSOR_X`."""
    cases = itertools.product(sensors, scenes, range(n_seeds), SENSOR_X)
    return [SceneScan(*case) for case in cases]


def exact_labels(scan: SimulatedScan) -> npt.NDArray[np.uint8]:
    """Return the true `Label` of each point of a simulated scan, (N,) uint8."""
    return np.where(scan.is_ground, Label.GROUND, Label.OBSTACLE).astype(np.uint8)


def score_scenes(
    scans: Sequence[SceneScan],
    configs: Mapping[str, Config],
    with_peer: bool,
    clock: Callable[[], float] = time.perf_counter,
    progress: Callable[[Sequence[SceneScan]], Iterable[SceneScan]] = iter,
) -> tuple[list[SceneScore], list[SceneScore], FitReport]:
    """Segment simulated scans and compare with the truth.

    Parameters
    ----------
    scans : sequence of SceneScan
        At least one; each is segmented without a past.
    configs : mapping of str to Config
        Our parameters by name of the sensor.
    with_peer : bool
        Whether Patchwork++ runs on the same clouds, told the sensor's true height.
    clock : callable
        Source of seconds.
    progress : callable
        Wraps the scans to show how far it is, as tqdm does.

    Returns
    -------
    ours, peer : list of SceneScore
        By sensor and scene in the order of `scans`; the peer's is empty without it.
    fit : FitReport
        Of our last scan: backend and threads are in it.

    Raises
    ------
    MissingDependencyError
        If the peer is not installed.
    """
    ours: list[ScanScore] = []
    theirs: list[ScanScore] = []
    peers = {
        sensor: PatchworkppMethod(sensor_height=SENSORS[sensor].height)
        for sensor in (configs if with_peer else ())
    }
    with ExitStack() as stack:
        segmenters = {
            sensor: stack.enter_context(closing(GroundSegmenter(config)))
            for sensor, config in configs.items()
        }
        segmenters[scans[0].sensor].segment(scans[0].simulate().points)  # compiles
        for one in progress(scans):
            scan = one.simulate()
            truth, ground = exact_labels(scan), scan.is_ground
            segmenter = segmenters[one.sensor]
            segmenter.reset()
            started = clock()
            result = segmenter.segment(scan.points)
            seconds = clock() - started
            height = height_error(scan.ground_z[ground], result.ground_z[ground])
            ours.append(ScanScore(one, count_confusion(result.label, truth), height, seconds))
            if with_peer:
                peer = peers[one.sensor]
                peer.start_sequence()
                started = clock()
                peer.run(scan.points)
                seconds = clock() - started
                its_z = peer.ground_z(scan.points[ground])
                height = height_error(scan.ground_z[ground], its_z)
                theirs.append(
                    ScanScore(one, count_confusion(peer.label(), truth), height, seconds)
                )
    return _by_scene(ours), _by_scene(theirs), result.fit


def _by_scene(scores: Sequence[ScanScore]) -> list[SceneScore]:
    grouped: dict[tuple[str, str], list[ScanScore]] = {}
    for score in scores:
        grouped.setdefault((score.scan.sensor, score.scan.scene), []).append(score)
    return [SceneScore(*where, tuple(found)) for where, found in grouped.items()]
