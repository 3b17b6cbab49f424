"""The paper's Table I: hyper-parameters, errors and times for segments of real frames.

P. Mehrabi and H. D. Taghirad, "A Novel Gaussian Process Based Ground Segmentation Algorithm with
Local-Smoothness Estimation", arXiv 2112.05847.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from gp_ground_seg.core.errors import DataError
from gp_ground_seg.core.frame import OUTSIDE, FloatArray
from gp_ground_seg.core.parameters.config import PRESETS, Config
from gp_ground_seg.core.result import Segmentation
from gp_ground_seg.data.semantic_kitti import Frame
from gp_ground_seg.lab.cluster import HERE, Runner
from gp_ground_seg.lab.scoring.evaluate import OurMethod, load_kitti, score_methods
from gp_ground_seg.lab.scoring.metrics import HEIGHT_MEASURES, height_sums
from gp_ground_seg.lab.scoring.report import Form, Report, Table, frame_of

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
HELD_OUT = 'held out n', 'held out Z-L', 'held out Z'
FORMS = {
    **dict.fromkeys((*VARIANCES, *ERRORS[:2], *HELD_OUT[1:]), '#.4g'),
    **dict.fromkeys(('n_PG', 'n_L', 'held out n'), '.0f'),
    **dict.fromkeys(ERRORS[2:], '.4f'),
}
"""Formats of the columns."""


def table1(items: Sequence[Frame], config: Config, runner: Runner = HERE) -> Report:
    """Measure the paper's Table I on segments of labelled frames, beside its printed values.

    With the parameters given (ours), and with the preset ``paper``. Each method runs on each frame
    of `CHOICES` once without counting, then `N_REPEATS` times, alternately.
    """
    frames = {(frame.sequence, frame.index): frame for frame in items}
    for sequence, index in CHOICES:
        if (sequence, index) not in frames:
            raise DataError(f'no frame {index} in sequence {sequence}')
    rows: list[dict[str, Any]] = []
    for by, own in {'ours': config, 'preset': PRESETS['paper'].config}.items():
        changes = {'learning.fixed': 'none'}
        methods = [
            OurMethod(own.replace(**{'length_scale.model': model}, **changes), name)
            for name, model in MODELS.items()
        ]
        for choice, segments in CHOICES.items():
            rows += ({'by': by, **row} for row in _rows(frames[choice], segments, methods, runner))
    printed = (
        {'segment': name, 'by': 'paper', **dict(zip((*VALUES, *ERRORS), row, strict=True))}
        for name, row in PRINTED.items()
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
    forms = {name: Form(name, form) for name, form in FORMS.items()}
    forms['held out n'] = Form('n', '.0f')
    columns = ['segment', 'by', *ERRORS[:2], *HELD_OUT, *ERRORS[2:]]
    tables = {
        'variances': Table(variances, every[['segment', 'by', *VALUES]], forms),
        'errors': Table(errors, every[columns], forms),
    }
    return Report(tables, rows, methods[0].last.fit.backend, config)


def _rows(
    frame: Frame, segments: Sequence[int], methods: Sequence[OurMethod], runner: Runner
) -> list[dict[str, Any]]:
    """Rows of a frame, by title of the column."""
    scan = load_kitti(frame)
    z = scan.points[:, 2].astype(np.float64)
    scores = score_methods([scan] * N_REPEATS, methods, lambda scan: scan, runner=runner)
    seconds = scores.scans.groupby('method', sort=False)['seconds'].median()
    # Grid, candidates and pseudo-inputs do not depend on the length-scale model.
    common = methods[0].last
    candidates = common.candidates
    # A candidate is the point at the same place.
    x, y, _ = common.pose.level(scan.points[:, :3]).T
    modelled = scan.is_ground & (common.grid.bin != OUTSIDE)
    rows = []
    for segment in segments:
        part = slice(*candidates.offsets[segment : segment + 2])
        held_out = modelled & (common.grid.segment == segment)
        held_out &= ~np.isin(x + 1j * y, candidates.x[part] + 1j * candidates.y[part])
        row: dict[str, Any] = {
            'segment': f'{frame.sequence}/{frame.index}:{segment}',
            'n_PG': int(part.stop - part.start),
            'n_L': int(np.diff(common.pseudo.offsets)[segment]),
            **dict(zip(VARIANCES, np.exp(2.0 * common.theta).tolist(), strict=False)),
            'held out n': int(held_out.sum()),
        }
        for method in methods:
            name, result = method.name, method.last
            # Of the process itself, as in the paper; not the corrected surface.
            estimate = z[held_out] - result.labelled.height[held_out]
            row[f'in sample {name}'] = _in_sample(result, segment)
            row[f'held out {name}'] = _smse(z[held_out], estimate)
            row[f't {name} [s]'] = seconds[name]
        rows.append(row)
    return rows


def _in_sample(result: Segmentation, segment: int) -> float:
    """Standardised mean squared error of the surface at the inliers of a segment."""
    candidates, surface = result.candidates, result.surface
    inlier = surface.inlier & (candidates.segment == segment)
    estimate = np.interp(candidates.r[inlier], surface.knots, surface.mean[segment])
    return _smse(candidates.z[inlier], estimate)


def _smse(truth: FloatArray, estimate: FloatArray) -> float:
    """Standardised mean squared error of heights, (n,) [m]."""
    return float(HEIGHT_MEASURES['smse'](height_sums(truth, estimate)))
