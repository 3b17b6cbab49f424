"""Whether the ground lies where it is said to: errors against their standard deviations."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from gp_ground_seg.core.parameters.config import Config
from gp_ground_seg.core.result import FitReport, Segmentation
from gp_ground_seg.core.segmenter import GroundSegmenter
from gp_ground_seg.lab.scale.cluster import HERE, Progress, Runner
from gp_ground_seg.lab.scoring import evaluate as methods
from gp_ground_seg.lab.scoring import report as results
from gp_ground_seg.lab.scoring.evaluate import KnownScan
from gp_ground_seg.lab.scoring.metrics import (
    RING_EDGES,
    RING_TITLES,
    Calibration,
    HeightError,
    count_calibration,
    height_error,
    pool_height_errors,
)
from gp_ground_seg.lab.scoring.report import Column, Report, Row, Table, percent


@dataclass(frozen=True)
class RingCoverage:
    """A scan, or a sum of scans, in one ring of horizontal range."""

    sequence: str
    index: str
    ring: str  # of `RING_TITLES`
    height: HeightError
    calibration: Calibration  # of p_ground


class Kind(NamedTuple):
    """What errors of the ground's height are held against, and the tables of it."""

    std: str  # attribute of `Segmentation`
    against: str
    groups: tuple[str, ...]  # words of `RingCoverage.sequence`, by which there are tables


LABELLED = Kind('return_std', 'labelled ground returns', ('sequence',))
SIMULATED = Kind('ground_std', 'exact heights under ground returns', ('sensor', 'scene'))


def compare_coverage(
    items: Sequence[Any],
    load: Callable[[Any], KnownScan],
    config: Config,
    kind: Kind,
    runner: Runner = HERE,
) -> Report:
    """Segment each scan, without a past."""
    facts = {'config_changes': results.changed_parameters(config), 'config': config.nested()}
    parts = runner.run(partial(_cover, load, config, kind.std), items)
    rings = [one for own, _ in parts for one in own]
    return Report(
        {name: _table(rings, name, kind) for name in (*kind.groups, 'range')},
        [_row_of(one) for one in rings],
        parts[-1][1],
        {'std': kind.std, **facts},
    )


def _cover(
    load: Callable[[Any], KnownScan],
    config: Config,
    std: str,
    items: Sequence[Any],
    progress: Progress,
) -> tuple[list[RingCoverage], FitReport]:
    """Coverage of some scans, and the fit of the last."""
    rings: list[RingCoverage] = []
    with closing(GroundSegmenter(config)) as segmenter:
        for item in progress(items):
            segmenter.reset()
            scan = load(item)
            found = segmenter.segment(scan.points)
            rings += ring_coverages(scan, found, std)
    return rings, found.fit


def ring_coverages(scan: KnownScan, found: Segmentation, std: str) -> list[RingCoverage]:
    """Compare a segmented scan with the truth in each ring; `std` as in `Kind`."""
    assert scan.ground_z is not None and scan.is_ground is not None
    truth = next(iter(scan.truths.values()))
    heights = scan.ground_z, found.ground_z, getattr(found, std)
    x, y = scan.points[:, :2].astype(np.float64).T
    ring = np.digitize(np.hypot(x, y), RING_EDGES[1:-1])
    result = []
    for k, title in enumerate(RING_TITLES):
        own = ring == k
        ground = own & scan.is_ground
        height = height_error(*(values[ground] for values in heights))
        probabilities = count_calibration(found.p_ground[own], truth[own])
        result.append(RingCoverage(scan.sequence, scan.index, title, height, probabilities))
    return result


def _table(rings: Sequence[RingCoverage], name: str, kind: Kind) -> Table:
    """Table by one of `Kind.groups` or by range, and the sum of all."""
    groups: dict[str, list[RingCoverage]] = {}
    for one in rings:
        words = one.sequence.split(maxsplit=len(kind.groups) - 1)
        own_names = dict(zip((*kind.groups, 'range'), (*words, one.ring), strict=True))
        groups.setdefault(own_names[name], []).append(one)
    rows: list[Row] = []
    for group, own in {**groups, methods.ALL: list(rings)}.items():
        pooled = pool_height_errors([one.height for one in own])
        probabilities = [one.calibration for one in own]
        ece = sum(probabilities[1:], probabilities[0]).ece
        rows.append(
            [
                (Column(name), group),
                (Column('points', '_d'), pooled.n_points),
                (percent('1 std', 'within_1', '.1f'), pooled.within_1),
                (percent('2 std', 'within_2', '.1f'), pooled.within_2),
                (Column('NLPD', '.2f', 'nlpd'), pooled.nlpd),
                (results.centimetres('bias'), pooled.bias),
                (results.centimetres('RMSE', 'rmse'), pooled.rmse),
                (Column('ECE', '.4f', 'ece'), ece),
            ]
        )
    title = (
        f'ground_z and {kind.std} against {kind.against}, by {name}: points within 1 and 2 '
        'standard deviations [%] (68.3 and 95.4 of a normal distribution), mean negative log '
        'predictive density, bias and RMSE [cm]; expected calibration error of p_ground'
    )
    return Table.of(rows, title=title, n_sums=1)


def _row_of(one: RingCoverage) -> dict[str, Any]:
    """Every number of a scan in a ring; lengths in metres."""
    names = ('n_points', 'within_1', 'within_2', 'nlpd', 'bias', 'rmse')
    row: dict[str, Any] = {'sequence': one.sequence, 'index': one.index, 'ring': one.ring}
    row |= {name: getattr(one.height, name) for name in names}
    return row | {'ece': one.calibration.ece, 'n_probabilities': one.calibration.n_total}
