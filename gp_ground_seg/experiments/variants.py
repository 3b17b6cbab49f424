"""The engine of the experiments: named configurations scored over frames, real or simulated."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from gp_ground_seg.errors import ConfigError
from gp_ground_seg.evaluation.environment import changed_parameters
from gp_ground_seg.evaluation.evaluate import (
    ALL,
    KnownScan,
    MethodScore,
    Progress,
    score_methods,
)
from gp_ground_seg.evaluation.methods import Method, OurMethod
from gp_ground_seg.evaluation.table import Cell, Column, Table
from gp_ground_seg.frame import Label
from gp_ground_seg.parameters.config import Config, find_spec
from gp_ground_seg.parameters.schema import ParameterValue
from gp_ground_seg.result import FitReport
from gp_ground_seg.simulation import SCENES, SENSORS, simulate_scan

Changes = Mapping[str, ParameterValue]
"""Values of parameters, by dotted name."""


@dataclass(frozen=True)
class SimulatedFrame:
    """A scan to simulate: `seed` is that of the scene and of the noise, `x` a place [m]."""

    sensor: str
    scene: str
    seed: int
    x: float


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
    return KnownScan(
        group, index, made.points, {'exact': truth}, None, made.ground_z, {ALL: made.is_ground}
    )


def simulated_frames(
    sensors: Sequence[str], scenes: Sequence[str], n_seeds: int, places: Sequence[float]
) -> list[SimulatedFrame]:
    """Sensors by scenes by seeds by places."""
    cases = itertools.product(sensors, scenes, range(n_seeds), places)
    return [SimulatedFrame(*case) for case in cases]


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
    tables: dict[str, Table], scores: Sequence[MethodScore], config: Config, **facts: Any
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
    progress: Progress = iter,
) -> list[MethodScore]:
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
    progress : callable
        Wraps the items, as tqdm does.

    Returns
    -------
    list of MethodScore
        In the order of `variants` and `peers`; errors as `score_methods`.
    """
    with ExitStack() as stack:
        ours = [stack.enter_context(closing(make(c, name))) for name, c in variants.items()]
        return score_methods(items, load, [*ours, *peers], each_alone=True, progress=progress)


def scan_table(scores: Sequence[MethodScore]) -> Table:
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
