"""What latent length-scales are worth where the ground's smoothness changes, by exact heights."""

from __future__ import annotations

import itertools
import statistics
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from gp_ground_seg.evaluation.height_error import HeightError, height_error, pool_height_errors
from gp_ground_seg.experiments.ablation import open_segmenters
from gp_ground_seg.frame import BoolArray
from gp_ground_seg.parameters.config import Config
from gp_ground_seg.parameters.schema import ParameterValue
from gp_ground_seg.result import FitReport
from gp_ground_seg.simulation import HDL_64E, SCENES, Scene, simulate_scan

SCENE = 'road_then_rubble'
SENSOR_X = (0.0, 6.0, 12.0)
"""Where the sensor stands on the road [m]; the rubble begins at 14 to 20 m."""

STRETCHES = ('all', 'smooth', 'rubble')
"""All ground, the road before the rubble begins, and the rubble where it has its full height."""

_LEARNED: dict[str, ParameterValue] = {'learning.mode': 'every_frame', 'learning.scope': 'frame'}

METHODS: dict[str, dict[str, ParameterValue]] = {
    **{
        f'constant, {length:g} m': {
            'length_scale.model': 'constant',
            'length_scale.constant': length,
            **_LEARNED,
        }
        for length in (10.0, 5.0, 2.0, 1.0)
    },
    'line gradient': {'length_scale.model': 'line_gradient', **_LEARNED},
    'latent, not learned': {'length_scale.model': 'latent', 'learning.mode': 'fixed'},
    'latent': {'length_scale.model': 'latent', **_LEARNED},
}
"""Methods by title, each but one with its hyper-parameters learned over the whole frame. A
constant cannot be learned: several are given, so that the best of them is known in hindsight."""


@dataclass(frozen=True)
class ScanResult:
    """Height errors of one method on one simulated scan, by stretch.

    Attributes
    ----------
    seed : int
        Of the scene and of the noise.
    sensor_x : float
        Where the sensor stands [m].
    seconds : float
        Time of the segmentation.
    height : dict of str to HeightError
        By name in `STRETCHES`.
    """

    seed: int
    sensor_x: float
    seconds: float
    height: dict[str, HeightError]


@dataclass(frozen=True)
class SyntheticResult:
    """How one method did on all scans; `fit` is the report of its last one."""

    title: str
    scans: tuple[ScanResult, ...]
    fit: FitReport

    def height(self, stretch: str) -> HeightError:
        """Height error over all scans."""
        return pool_height_errors([scan.height[stretch] for scan in self.scans])

    @property
    def median_seconds(self) -> float:
        """Median time per scan."""
        return statistics.median(scan.seconds for scan in self.scans)


def ablate_synthetic(
    n_seeds: int,
    methods: Mapping[str, Mapping[str, ParameterValue]],
    config: Config,
    clock: Callable[[], float] = time.perf_counter,
    progress: Callable[[Sequence[tuple[int, float]]], Iterable[tuple[int, float]]] = iter,
) -> list[SyntheticResult]:
    """Run methods on simulated scans of a road that ends in rubble.

    Each seed is a scene of its own, seen by an HDL-64E from `SENSOR_X`. The error
    is that of the surface under every return from the terrain, against its exact height.

    Parameters
    ----------
    n_seeds : int
        Number of scenes.
    methods : mapping of str to mapping
        Changes of the configuration, by title of the method.
    config : Config
        The configuration that they change.
    clock : callable
        Source of seconds.
    progress : callable
        Wraps the pairs of seed and place to show how far it is, as tqdm does.

    Raises
    ------
    ConfigError
        As `open_segmenters`.
    """
    results: dict[str, list[ScanResult]] = {title: [] for title in methods}
    fits: dict[str, FitReport] = {}
    with open_segmenters(methods, config) as segmenters:
        for seed, sensor_x in progress(list(itertools.product(range(n_seeds), SENSOR_X))):
            scene = SCENES[SCENE](seed)
            scan = simulate_scan(scene, HDL_64E, np.random.default_rng(seed), x=sensor_x)
            ground_x = scan.points[:, 0] + scan.position[0]
            chosen = _stretches(scene, scan.is_ground, ground_x)
            for title, segmenter in segmenters.items():
                if not results[title]:
                    segmenter.segment(scan.points)  # compiling is not its speed
                segmenter.reset()
                started = clock()
                result = segmenter.segment(scan.points)
                seconds = clock() - started
                fits[title] = result.fit
                height = {
                    stretch: height_error(scan.ground_z[own], result.ground_z[own])
                    for stretch, own in chosen.items()
                }
                results[title].append(ScanResult(seed, sensor_x, seconds, height))
    return [SyntheticResult(title, tuple(found), fits[title]) for title, found in results.items()]


def _stretches(
    scene: Scene, is_ground: BoolArray, ground_x: npt.NDArray[np.floating]
) -> dict[str, BoolArray]:
    """Points of each stretch: the rubble's break lines lie across x."""
    begin, full = np.sort(scene.terrain.breaks()[:, 2])
    return {
        'all': is_ground,
        'smooth': is_ground & (ground_x < begin),
        'rubble': is_ground & (ground_x > full),
    }
