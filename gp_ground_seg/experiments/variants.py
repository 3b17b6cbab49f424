"""The engine of the experiments: named configurations scored over frames, real or simulated."""

from __future__ import annotations

import functools
import itertools
import operator
import statistics
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from gp_ground_seg.data.semantic_kitti import Frame
from gp_ground_seg.errors import ConfigError
from gp_ground_seg.evaluation.calibration import Calibration, count_calibration
from gp_ground_seg.evaluation.environment import changed_parameters
from gp_ground_seg.evaluation.evaluate import load_labelled
from gp_ground_seg.evaluation.methods import Method, OurMethod, Progress, run_methods
from gp_ground_seg.evaluation.metrics import (
    GROUNDGRID,
    Confusion,
    HeightError,
    count_confusion,
    height_error,
    pool_height_errors,
)
from gp_ground_seg.evaluation.table import Cell, Column, Table
from gp_ground_seg.frame import BoolArray, Label
from gp_ground_seg.parameters.config import Config, find_spec
from gp_ground_seg.parameters.schema import ParameterValue
from gp_ground_seg.pipeline.sensor_pose import SensorPose
from gp_ground_seg.result import FitReport
from gp_ground_seg.simulation import SCENES, SENSORS, simulate_scan

Changes = Mapping[str, ParameterValue]
"""Values of parameters, by dotted name."""
ALL = 'all'


@dataclass(frozen=True)
class KnownScan:
    """A scan of N points whose labels and ground heights are known.

    Attributes
    ----------
    sequence, index : str
        Group of scans that it is scored with, and its name there.
    points : (N, >=3) float
        x, y, z [m], and intensity.
    truth : (N,) uint8
        True `Label`; UNKNOWN where the point does not count.
    ground_z : (N,) float
        True height of the ground [m], where `parts` has the point.
    parts : dict of str to (N,) bool
        Points under which the surface is compared with `ground_z`, by name of the part.
    """

    sequence: str
    index: str
    points: npt.NDArray[Any]
    truth: npt.NDArray[np.uint8]
    ground_z: npt.NDArray[np.floating]
    parts: dict[str, BoolArray]


@dataclass(frozen=True)
class SimulatedFrame:
    """A scan to simulate: `seed` is that of the scene and of the noise, `x` a place [m]."""

    sensor: str
    scene: str
    seed: int
    x: float


def load_kitti(frame: Frame) -> KnownScan:
    """Read a labelled frame: GroundGrid convention, heights of the points labelled ground."""
    scan = load_labelled(frame)
    z = scan.points[:, 2].astype(np.float64)
    truth = GROUNDGRID.truth(scan.semantic, z)
    is_ground = truth == Label.GROUND
    return KnownScan(scan.sequence, scan.index, scan.points, truth, z, {ALL: is_ground})


def load_simulated(frame: SimulatedFrame) -> KnownScan:
    """Simulate a scan: what the ray hit of the terrain is ground, all else is an obstacle."""
    made = simulate_scan(
        SCENES[frame.scene](frame.seed),
        SENSORS[frame.sensor],
        np.random.default_rng(frame.seed),
        x=frame.x,
    )
    truth = np.where(made.is_ground, Label.GROUND, Label.OBSTACLE).astype(np.uint8)
    group, index = f'{frame.sensor} {frame.scene}', f'{frame.seed}/{frame.x:g}'
    return KnownScan(group, index, made.points, truth, made.ground_z, {ALL: made.is_ground})


def simulated_frames(
    sensors: Sequence[str], scenes: Sequence[str], n_seeds: int, places: Sequence[float]
) -> list[SimulatedFrame]:
    """Sensors by scenes by seeds by places."""
    cases = itertools.product(sensors, scenes, range(n_seeds), places)
    return [SimulatedFrame(*case) for case in cases]


@dataclass(frozen=True)
class ScanScore:
    """How one variant did on one scan.

    Attributes
    ----------
    sequence, index : str
        Which scan.
    seconds : float
        Time of the segmentation alone.
    confusion : Confusion
        Right and wrong labels.
    heights : dict of str to HeightError
        Of the surface, by part of the ground.
    calibration : Calibration or None
        Of the probabilities, if there are any.
    pose : SensorPose or None
        Pose that was used, if there is one.
    """

    sequence: str
    index: str
    seconds: float
    confusion: Confusion
    heights: dict[str, HeightError]
    calibration: Calibration | None = None
    pose: SensorPose | None = None


@dataclass(frozen=True)
class VariantScore:
    """How one variant did on all scans; `fit` is the report of its last one."""

    name: str
    scans: tuple[ScanScore, ...]
    fit: FitReport | None = None

    @property
    def sequences(self) -> list[str]:
        """Names of the sequences, in order."""
        return list(dict.fromkeys(scan.sequence for scan in self.scans))

    def of(self, *sequences: str) -> VariantScore:
        """Return the part of some sequences."""
        return VariantScore(self.name, tuple(s for s in self.scans if s.sequence in sequences))

    @property
    def confusion(self) -> Confusion:
        """Sum of the counts."""
        return sum((scan.confusion for scan in self.scans), Confusion())

    @property
    def iou(self) -> float:
        """Intersection over union of the pooled counts."""
        return self.confusion.iou

    @property
    def ece(self) -> float:
        """Expected calibration error of the pooled probabilities."""
        found = [one.calibration for one in self.scans if one.calibration is not None]
        return functools.reduce(operator.add, found).ece

    @property
    def worst_sequence(self) -> str:
        """Name of the sequence with the lowest IoU."""
        return min(self.sequences, key=lambda name: self.of(name).iou)

    def height(self, part: str = ALL) -> HeightError:
        """Pooled height error."""
        return pool_height_errors([scan.heights[part] for scan in self.scans])

    @property
    def median_seconds(self) -> float:
        """Median time per scan."""
        return statistics.median(scan.seconds for scan in self.scans)


def pool(name: str, scores: Iterable[VariantScore]) -> VariantScore:
    """Put the scans of several scores together; the fit report is that of the last one."""
    found = list(scores)
    return VariantScore(name, tuple(scan for one in found for scan in one.scans), found[-1].fit)


@dataclass(frozen=True)
class Report:
    """Outcome of an experiment.

    Attributes
    ----------
    tables : dict of str to Table
        What is shown, by name in JSON.
    rows : Table
        Every number, one row for each scan of each variant or the like: for CSV and JSON.
    fit : FitReport
        Of some frame: backend and threads are in it.
    facts : dict
        What else is written to JSON: parameters changed from their defaults, by variant.
    rows_name : str
        Name of `rows` in JSON.
    """

    tables: dict[str, Table]
    rows: Table
    fit: FitReport
    facts: dict[str, Any] = field(default_factory=dict)
    rows_name: str = 'by_scan'


def make_report(
    tables: dict[str, Table], scores: Sequence[VariantScore], config: Config, **facts: Any
) -> Report:
    """Report of scored variants; `config` is what they change, the first has a fit report."""
    fit = scores[0].fit
    assert fit is not None
    facts['config_changes'] = changed_parameters(config)
    return Report(tables, scan_table(scores), fit, facts)


def refuse_changed(config: Config, names: Iterable[str]) -> None:
    """Raise ConfigError if `config` changes what an experiment compares."""
    for name in sorted(names):
        if config[name] != find_spec(name).default:
            raise ConfigError(f'{name} = {config[name]}: the experiment sets it, leave it out')


def score_variants(
    items: Sequence[Any],
    load: Callable[[Any], KnownScan],
    variants: Mapping[str, Config],
    peers: Sequence[Method] = (),
    *,
    make: type[OurMethod] = OurMethod,
    clock: Callable[[], float] = time.perf_counter,
    progress: Progress[Any] = iter,
) -> list[VariantScore]:
    """Run every variant once on every scan, alternately, each scan without a past.

    Parameters
    ----------
    items : sequence
        What is loaded, at least one.
    load : callable
        Loads or simulates an item.
    variants : mapping of str to Config
        Configurations by name.
    peers : sequence of Method
        Other methods to run on the same scans.
    make : type
        Makes the method of a configuration.
    clock, progress : callable
        As `run_methods`, which errors are also like.

    Returns
    -------
    list of VariantScore
        In the order of `variants` and `peers`.
    """
    with ExitStack() as stack:
        ours = [stack.enter_context(closing(make(c, name))) for name, c in variants.items()]
        scores = run_methods(
            items, load, [*ours, *peers], _score, each_alone=True, clock=clock, progress=progress
        )
        fits = {method.name: method.result().fit for method in ours}
    return [VariantScore(name, tuple(s), fits.get(name)) for name, s in scores.items()]


def _score(scan: KnownScan, method: Method, seconds: float) -> ScanScore:
    result, estimate = method.result(), method.ground_z()
    return ScanScore(
        scan.sequence,
        scan.index,
        seconds,
        count_confusion(result.label, scan.truth),
        {
            part: height_error(scan.ground_z[own], estimate[own])
            for part, own in scan.parts.items()
        },
        None if result.p_ground is None else count_calibration(result.p_ground, scan.truth),
        result.pose,
    )


def scan_table(scores: Sequence[VariantScore]) -> Table:
    """Every number: one row for each scan of each variant; heights in metres."""
    parts = list(scores[0].scans[0].heights)
    names = ['variant', 'sequence', 'index', 'seconds', 'tp', 'fp', 'fn', 'tn', 'ece']
    of_height = ('n_points', 'n_without_model', 'rmse', 'median_absolute', 'bias', 'smse')
    names += [f'{name}_{part}' for part in parts for name in of_height]
    rows: list[list[Cell]] = []
    for score in scores:
        for one in score.scans:
            row: list[Cell] = [score.name, one.sequence, one.index, one.seconds]
            row += [getattr(one.confusion, name) for name in ('tp', 'fp', 'fn', 'tn')]
            row.append(None if one.calibration is None else one.calibration.ece)
            row += [getattr(one.heights[part], name) for part in parts for name in of_height]
            rows.append(row)
    return Table([Column(name) for name in names], rows)
