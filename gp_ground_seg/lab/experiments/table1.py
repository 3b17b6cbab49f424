"""The paper's Table I: hyper-parameters, errors and times for segments of real frames.

P. Mehrabi and H. D. Taghirad, "A Novel Gaussian Process Based Ground Segmentation Algorithm with
Local-Smoothness Estimation", arXiv 2112.05847.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

from gp_ground_seg.core.errors import ConfigError, DataError
from gp_ground_seg.core.frame import OUTSIDE, FloatArray
from gp_ground_seg.core.parameters.config import PRESETS, Config
from gp_ground_seg.core.result import Segmentation
from gp_ground_seg.data.semantic_kitti import Frame
from gp_ground_seg.lab.cluster import HERE, Progress, Runner
from gp_ground_seg.lab.experiments.variants import refuse_changed
from gp_ground_seg.lab.scoring.evaluate import OurMethod, as_it_is, load_kitti, score_methods
from gp_ground_seg.lab.scoring.metrics import height_ratios, height_sums
from gp_ground_seg.lab.scoring.report import Column, Report, Table, changed_parameters

MODELS = {'Z-L': 'latent', 'Z': 'line_gradient'}
"""The paper's method and the one it is compared with, as values of ``length_scale.model``."""
VARIANCES = ('sigma_f^2', 'sigma_n^2', 'sigma_f_bar^2', 'sigma_l_bar^2', 'sigma_n_bar^2')
"""Squares of the first entries of theta: in m^2; those of f_bar and n_bar without unit."""

CHOICES = {('10', '000000'): (157, 158), ('03', '000006'): (147, 148)}
"""Segments by sequence and frame: an adjacent pair that climbs a verge and a hill, 3 m over 30 m,
and one on uneven ground."""
N_REPEATS = 9
PRINTED = {
    'a': (36, 23, 0.3663, 0.8607, 1.415e6, 2.250e6, 1.187e6,
          2.4258e-27, 1.4978e-23, 0.5432, 0.2335),
    'b': (52, 30, 0.3117, 0.7207, 4.729e6, 1.347e6, 2.058e6,
          1.2466e-28, 1.1231e-23, 1.0045, 0.4356),
    'c': (68, 16, 0.4896, 1.1544, 1.381e6, 3.881e6, 4.501e6,
          2.7561e-26, 1.4102e-21, 0.3283, 0.1963),
    'd': (81, 14, 0.1103, 1.6487, 4.588e6, 3.521e6, 4.402e6,
          4.2903e-19, 8.6733e-22, 0.2732, 0.3412),
}  # fmt: skip
"""Rows of the paper's Table I, of segments a to d of its Figure 1; it names no frames."""
VALUES = 'n_PG', 'n_L', *VARIANCES
ERRORS = 'in sample Z-L', 'in sample Z', 't Z-L [s]', 't Z [s]'
"""Columns of `PRINTED`."""


def table1(items: Sequence[Frame], config: Config, runner: Runner = HERE) -> Report:
    """Measure the paper's Table I on segments of labelled frames, beside its printed values.

    With the parameters given (ours), and with the preset ``paper``. Each method runs on each frame
    of `CHOICES` once without counting, then `N_REPEATS` times, alternately.
    """
    refuse_changed(config, ['length_scale.model', 'learning.fixed'], {'learning.fixed': 'none'})
    if config.learning.mode == 'fixed':
        raise ConfigError('learning.mode = fixed: the table is of what is learned, leave it out')
    last = config.grid.n_segments - 1
    for segment in itertools.chain(*CHOICES.values()):
        if not 0 <= segment <= last:
            raise ConfigError(f'segment {segment}: must be in [0, {last}]')
    frames = {(frame.sequence, frame.index): frame for frame in items}
    for sequence, index in CHOICES:
        if (sequence, index) not in frames:
            raise DataError(f'no frame {index} in sequence {sequence}')
    ((rows, backend),) = runner.run(partial(_measure, config, frames), [*CHOICES])
    printed = [
        {'segment': name, 'by': 'paper', **dict(zip((*VALUES, *ERRORS), row, strict=True))}
        for name, row in PRINTED.items()
    ]
    known = {'segment', 'by', *VALUES, *(name for name in rows[0] if 'inliers' in name)}
    variances = (
        'Variances learned over the frame by Z-L  [m^2; of f_bar and n_bar without unit]; preset: '
        'the preset paper; paper: as printed, of its segments a to d'
    )
    errors = (
        'SMSE in sample (at the inliers) and held out (n points of labelled ground); seconds per '
        'frame: '
        f'median of {N_REPEATS} runs on the whole frame, reading left out'
    )
    tables = {
        'variances': _table([*rows, *printed], VALUES, variances),
        'errors': _table([*rows, *printed], [n for n in rows[0] if n not in known], errors),
    }
    facts = {'config_changes': changed_parameters(config), 'config': config.nested()}
    return Report(tables, rows, backend, facts)


def _measure(
    config: Config,
    frames: Mapping[tuple[str, str], Frame],
    choices: Sequence[tuple[str, str]],
    progress: Progress,
) -> tuple[list[dict[str, Any]], str]:
    """Rows of the segments chosen, and the backend."""
    fixed = {'learning.fixed': 'none'}
    methods = {
        by: [
            OurMethod(own.replace(**{'length_scale.model': model}, **fixed), name)
            for name, model in MODELS.items()
        ]
        for by, own in {'ours': config, 'preset': PRESETS['paper'].config}.items()
    }
    rows: dict[str, list[dict[str, Any]]] = {by: [] for by in methods}
    for choice in progress(choices):
        for by, own in methods.items():
            found = _rows(frames[choice], CHOICES[choice], own)
            rows[by] += ({'by': by, **row} for row in found)
    return [*itertools.chain(*rows.values())], methods['ours'][0].last.fit.backend


def _table(rows: Sequence[dict[str, Any]], names: Sequence[str], title: str) -> Table:
    columns = {Column(name): [row[name] for row in rows] for name in ('segment', 'by')}
    for name in names:
        number = '.4f' if name.startswith('t ') else '#.4g'
        form = 'd' if isinstance(rows[0][name], int) else number
        column = Column(name.replace('held out n', 'n'), form, key=name)
        columns[column] = [row.get(name) for row in rows]
    return Table(columns, title)


def _rows(
    frame: Frame, segments: Sequence[int], methods: Sequence[OurMethod]
) -> list[dict[str, Any]]:
    """Rows of a frame, by title of the column."""
    scan = load_kitti(frame)
    z = scan.points[:, 2].astype(np.float64)
    scores = score_methods([scan] * N_REPEATS, methods, as_it_is, each_alone=True)
    seconds = scores.scans.groupby('method', sort=False)['seconds'].median()
    results = {method.name: method.last for method in methods}
    # Grid, candidates and pseudo-inputs do not depend on the length-scale model.
    common = results['Z-L']
    candidates = common.candidates
    # A candidate is the point at the same place.
    x, y, _ = common.pose.level(scan.points[:, :3]).T
    modelled = scan.is_ground & (common.grid.bin != OUTSIDE)
    rows = []
    for segment in segments:
        part = slice(*candidates.offsets[segment : segment + 2])
        held_out = modelled & (common.grid.segment == segment)
        held_out &= ~np.isin(x + 1j * y, candidates.x[part] + 1j * candidates.y[part])
        variances = np.exp(2.0 * common.theta[: len(VARIANCES)])
        in_sample = {name: _in_sample(result, segment) for name, result in results.items()}
        rows.append(
            {
                'segment': f'{frame.sequence}/{frame.index}:{segment}',
                'n_PG': int(part.stop - part.start),
                'n_L': int(np.diff(common.pseudo.offsets)[segment]),
                **dict(zip(VARIANCES, variances.tolist(), strict=True)),
                **{f'inliers {name}': n for name, (n, _) in in_sample.items()},
                **{f'in sample {name}': smse for name, (_, smse) in in_sample.items()},
                'held out n': int(held_out.sum()),
                **{
                    # Of the process itself, as in the paper; not the corrected surface.
                    f'held out {name}': _smse(
                        z[held_out], z[held_out] - result.labelled.height[held_out]
                    )
                    for name, result in results.items()
                },
                **{f't {name} [s]': own for name, own in seconds.items()},
            }
        )
    return rows


def _in_sample(result: Segmentation, segment: int) -> tuple[int, float]:
    """Inliers of a segment, and the standardised mean squared error of the surface there."""
    candidates, surface = result.candidates, result.surface
    inlier = surface.inlier & (candidates.segment == segment)
    estimate = np.interp(candidates.r[inlier], surface.knots, surface.mean[segment])
    return int(inlier.sum()), _smse(candidates.z[inlier], estimate)


def _smse(truth: FloatArray, estimate: FloatArray) -> float:
    """Standardised mean squared error of heights, (n,) [m]."""
    return float(height_ratios(height_sums(truth, estimate))['smse'])
