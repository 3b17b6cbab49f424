"""The engine of the experiments: named configurations scored over frames, real or simulated."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack, closing
from typing import Any, NamedTuple

import numpy as np

from gp_ground_seg.errors import ConfigError
from gp_ground_seg.evaluation.evaluate import ALL, KnownScan, MethodScore, Progress, score_methods
from gp_ground_seg.evaluation.methods import Method, OurMethod
from gp_ground_seg.evaluation.metrics import RATIOS, class_errors, class_name
from gp_ground_seg.evaluation.report import Report, Table, changed_parameters
from gp_ground_seg.frame import Label
from gp_ground_seg.parameters.config import Config, find_spec
from gp_ground_seg.parameters.schema import ParameterValue
from gp_ground_seg.simulation import SCENES, SENSORS, simulate_scan

Changes = Mapping[str, ParameterValue]
"""Values of parameters, by dotted name."""


class SimulatedFrame(NamedTuple):
    """A scan to simulate: `seed` is that of the scene and of the noise, `x` a place [m]."""

    sensor: str
    scene: str
    seed: int
    x: float

    @property
    def sequence(self) -> str:
        """Scans of one sensor in one kind of scene belong together."""
        return f'{self.sensor} {self.scene}'


def load_simulated(frame: SimulatedFrame) -> KnownScan:
    """Simulate a scan: what the ray hit of the terrain is ground, all else is an obstacle."""
    made = simulate_scan(
        SCENES[frame.scene](frame.seed),
        SENSORS[frame.sensor],
        np.random.default_rng(frame.seed),
        x=frame.x,
    )
    truth = np.where(made.is_ground, Label.GROUND, Label.OBSTACLE).astype(np.uint8)
    return KnownScan(
        frame.sequence, f'{frame.seed}/{frame.x:g}', made.points, {'exact': truth},
        ground_z=made.ground_z, parts={ALL: made.is_ground},
    )  # fmt: skip


def simulated_frames(
    sensors: Sequence[str], scenes: Sequence[str], n_seeds: int, places: Sequence[float]
) -> list[SimulatedFrame]:
    """Sensors by scenes by seeds by places."""
    cases = itertools.product(sensors, scenes, range(n_seeds), places)
    return [SimulatedFrame(*case) for case in cases]


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
    progress: Progress = iter,
) -> list[MethodScore]:
    """Run every variant once on every scan, alternately, each scan without a past.

    `items` are loaded one by one, as by `score_methods`; `peers` are other methods to run on
    the same scans, whose scores come last.
    """
    with ExitStack() as stack:
        ours = [stack.enter_context(closing(OurMethod(c, name))) for name, c in variants.items()]
        return score_methods(items, load, [*ours, *peers], each_alone=True, progress=progress)


def make_report(
    tables: dict[str, Table], scores: Sequence[MethodScore], config: Config, **facts: Any
) -> Report:
    """Report of scored variants; `config` is what they change, the first is of our method."""
    fit = scores[0].scans[-1].fit
    assert fit is not None
    facts = {'config_changes': changed_parameters(config), 'config': config.nested(), **facts}
    return Report(tables, scan_rows(scores), fit, facts)


def scan_rows(scores: Sequence[MethodScore]) -> list[dict[str, Any]]:
    """Every number of each scan of each method; heights in metres, angles in radians."""
    rows = []
    scans = [(score.name, scan) for score in scores for scan in score.scans]
    of_height = ('n_points', 'n_without_model', 'rmse', 'median_absolute', 'bias', 'smse')
    for method, scan in scans:
        row: dict[str, Any] = {'method': method, 'sequence': scan.sequence}
        row |= {'index': scan.index, 'seconds': scan.seconds}
        for key, confusion in scan.confusions.items():
            for name in ('tp', 'fp', 'fn', 'tn', *RATIOS):
                row[f'{key}_{name}'] = getattr(confusion, name)
        for part, height in scan.heights.items():
            row |= {f'{name}_{part}': getattr(height, name) for name in of_height}
        if scan.calibration is not None:
            row['ece'] = scan.calibration.ece
        if scan.classes:
            main = class_errors(scan.classes)[0]
            row['points'] = sum(count.n_points for count in scan.classes.values())
            row['main_error_class'] = class_name(main.number) if main.errors else ''
        if scan.fit is not None and scan.pose is not None:
            pose = scan.pose
            row |= {'status': scan.fit.status, 'n_segments': scan.fit.n_segments}
            row |= {'sensor_height': pose.height, 'sensor_height_estimated': pose.height_estimated}
            row |= {'sensor_roll': pose.roll, 'sensor_pitch': pose.pitch}
        rows.append(row)
    return rows
