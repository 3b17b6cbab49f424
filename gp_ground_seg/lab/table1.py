"""The paper's Table I, measured on segments of labelled frames next to its printed values."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from gp_ground_seg.core.errors import DataError
from gp_ground_seg.core.frame import OUTSIDE, FloatArray, Label
from gp_ground_seg.core.parameters.config import Config, find_preset
from gp_ground_seg.data.semantic_kitti import Frame
from gp_ground_seg.lab.cluster import HERE, Runner
from gp_ground_seg.lab.scoring.evaluate import OurMethod, load_kitti, score_methods
from gp_ground_seg.lab.scoring.report import COUNT, Form, Report, Table, frame_of

COMPARED = {'Z-L': 'latent', 'Z': 'line_gradient'}
"""The paper's method and the one it is compared with, as values of ``length_scale.model``."""
CHOICES = {('10', '000000'): (157, 158), ('03', '000006'): (147, 148)}
"""Segments by sequence and frame: an adjacent pair that climbs a verge and a hill, 3 m over 30 m,
and one on uneven ground."""
N_REPEATS = 9
VARIANCES = ('sigma_f^2', 'sigma_n^2', 'sigma_f_bar^2', 'sigma_l_bar^2', 'sigma_n_bar^2')
"""Squares of the first entries of theta: in m^2; those of f_bar and n_bar without unit."""
SMSE, HELD_OUT, TIMES = (
    [f'{what}{name}{unit}' for name in COMPARED]
    for what, unit in (('in sample ', ''), ('held out ', ''), ('t ', ' [s]'))
)
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
"""n_PG, n_L, `VARIANCES`, `SMSE`, `TIMES` in the paper, of segments a to d of its Figure 1; it
names no frames."""


def table1(items: Sequence[Frame], config: Config, runner: Runner = HERE) -> Report:
    """Measure the paper's Table I on segments of labelled frames, next to its printed values.

    P. Mehrabi and H. D. Taghirad, "A Novel Gaussian Process Based Ground Segmentation Algorithm
    with Local-Smoothness Estimation", arXiv 2112.05847. With the parameters given (ours), and
    with the preset ``paper``. Each method runs on each frame once without counting, then nine
    times, alternately.
    """
    frames = {(frame.sequence, frame.index): frame for frame in items}
    for sequence, index in CHOICES.keys() - frames.keys():
        raise DataError(f'no frame {index} in sequence {sequence}')
    rows: list[dict[str, Any]] = []
    for by, own in {'ours': config, 'preset': find_preset('paper').config}.items():
        # As in the paper, all length-scales are learned too.
        methods = [
            OurMethod(own.replace(**{'length_scale.model': model, 'learning.fixed': 'none'}), name)
            for name, model in COMPARED.items()
        ]
        for choice, segments in CHOICES.items():
            rows += ({'by': by, **row} for row in _rows(frames[choice], segments, methods, runner))
    columns = ['n_PG', 'n_L', *VARIANCES, *SMSE, *TIMES]
    printed = (
        {'segment': name, 'by': 'paper', **dict(zip(columns, values, strict=True))}
        for name, values in PRINTED.items()
    )
    every = frame_of([*rows, *printed])
    variances = (
        'Variances learned over the frame by Z-L [m^2; of f_bar and n_bar without unit]; preset: '
        'the preset paper; paper: as printed, of its segments a to d'
    )
    errors = (
        'SMSE in sample (at the inliers) and held out (n points of labelled ground); seconds per '
        f'frame: median of {N_REPEATS} runs on the whole frame, reading left out'
    )
    forms = {name: Form(name, '#.4g') for name in (*VARIANCES, *SMSE, *HELD_OUT)}
    forms |= {name: Form(name, '.4f') for name in TIMES}
    forms |= {name: Form(name.split()[-1], *COUNT) for name in (*columns[:2], 'held out n')}
    shown = every[['segment', 'by', *SMSE, 'held out n', *HELD_OUT, *TIMES]]
    tables = {
        'variances': Table(variances, every[['segment', 'by', *columns[:7]]], forms),
        'errors': Table(errors, shown, forms),
    }
    return Report(tables, rows, methods[0].last.fit.backend, config)


def _rows(
    frame: Frame, segments: Sequence[int], methods: Sequence[OurMethod], runner: Runner
) -> list[dict[str, Any]]:
    """Rows of a frame, by title of the column."""
    scan = load_kitti(frame)
    scores = score_methods([scan] * N_REPEATS, methods, lambda scan: scan, runner=runner)
    seconds = scores.scans.groupby('method')['seconds'].median()
    # Grid, candidates and pseudo-inputs do not depend on the length-scale model.
    common = methods[0].last
    candidates, grid = common.candidates, common.grid
    # In double precision, which those of the labels are not in.
    x, y, z = common.pose.level(scan.points[:, :3]).T.astype(np.float64)
    # A candidate is the point at the same place.
    modelled = (scan.truth == Label.GROUND) & (grid.bin != OUTSIDE)
    modelled &= ~np.isin(x + 1j * y, candidates.x + 1j * candidates.y)
    rows = []
    for segment in segments:
        part = slice(*candidates.offsets[segment : segment + 2])
        held_out = np.flatnonzero(modelled & (grid.segment == segment))
        row: dict[str, Any] = {
            'segment': f'{frame.sequence}/{frame.index}:{segment}',
            'n_PG': int(part.stop - part.start),
            'n_L': int(np.diff(common.pseudo.offsets)[segment]),
            **dict(zip(VARIANCES, np.exp(2.0 * common.theta).tolist(), strict=False)),
            'held out n': len(held_out),
        }
        for k, method in enumerate(methods):
            # Of the process itself, as in the paper; not the corrected surface.
            result, surface = method.last, method.last.surface
            at = np.flatnonzero(surface.inlier[part]) + part.start
            known = surface.knots, surface.mean[segment]
            row[SMSE[k]] = _smse(candidates.z[at], np.interp(candidates.r[at], *known))
            relief = result.relief.at(x[held_out], y[held_out])
            ground = np.add(np.interp(grid.r[held_out], *known), relief)
            row[HELD_OUT[k]] = _smse(z[held_out], ground)
            row[TIMES[k]] = seconds[method.name]
        rows.append(row)
    return rows


def _smse(truth: FloatArray, estimate: FloatArray) -> float:
    """Standardised mean squared error of heights, (n,) [m], where there is a model."""
    known = np.isfinite(estimate)
    truth, estimate = truth[known], estimate[known]
    return float(np.mean((estimate - truth) ** 2) / np.var(truth))
