"""Labels and heights of a scan against the truth, as sums; ratios of sums.

Sums add up over scans. A measure is a function of sums by name: of a mapping of numbers, or of a
frame of pandas, whose rows are scans or groups of them. Ratios over nothing are NaN.
"""

import itertools
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

from gp_ground_seg.core.frame import Label, PointArray
from gp_ground_seg.data.semantic_kitti import GROUND_CLASSES, OUTLIER, UNLABELLED, VEGETATION

Labels = npt.NDArray[np.uint8]

COUNTS = ('tp', 'fp', 'fn', 'tn')
"""Points by true and given label, ground being positive."""


RING_EDGES = (0.0, 10.0, 20.0, 30.0, 40.0, 50.0, math.inf)
"""Edges of the rings of horizontal range [m]; each holds its inner edge, not its outer one."""
RING_TITLES = (
    *(f'{low:g}-{high:g} m' for low, high in itertools.pairwise(RING_EDGES[:-1])),
    f'> {RING_EDGES[-2]:g} m',
)


def true_labels(semantic: npt.NDArray[np.integer]) -> Labels:
    """Return the true `Label` (N,) by SemanticKITTI class; UNKNOWN does not count.

    Vegetation is left out, as by Steinke et al., "GroundGrid: LiDAR Point Cloud Ground
    Segmentation and Terrain Estimation", RA-L 2024.
    """
    is_ground = np.isin(semantic, GROUND_CLASSES)
    truth = np.where(is_ground, Label.GROUND, Label.OBSTACLE).astype(np.uint8)
    truth[np.isin(semantic, (UNLABELLED, OUTLIER, VEGETATION))] = Label.UNKNOWN
    return truth


def ratio(part: Any, whole: Any) -> Any:
    """Return `part` / `whole` of numbers or columns, NaN where `whole` is zero."""
    with np.errstate(invalid='ignore'):
        return np.true_divide(part * (whole != 0), whole)


Measure = Callable[[Any], Any]
"""A function of sums by name."""


def share(part: str, whole: str) -> Measure:
    """Return the measure that divides one sum by another."""
    return lambda sums: ratio(sums[part], sums[whole])


LABEL_MEASURES: dict[str, Measure] = {
    'precision': lambda s: ratio(s['tp'], s['tp'] + s['fp']),
    'recall': lambda s: ratio(s['tp'], s['tp'] + s['fn']),
    'iou': lambda s: ratio(s['tp'], s['tp'] + s['fp'] + s['fn']),
}
"""Measures of `COUNTS`."""
HEIGHT_MEASURES: dict[str, Measure] = {
    'without_model': lambda s: ratio(s['n_without_model'], s['n_points'] + s['n_without_model']),
    'bias': share('error', 'n_points'),
    'rmse': lambda s: np.sqrt(ratio(s['square'], s['n_points'])),
    'within_1': share('n_within_1', 'n_with_std'),
    'within_2': share('n_within_2', 'n_with_std'),
}
"""Measures of `height_sums`; lengths in metres.

The share of the points under which the surface has no height; bias, the mean error; RMSE; the
shares within one and two standard deviations, of a normal distribution 0.683 and 0.954.
"""


def label_ratios(sums: Any) -> dict[str, Any]:
    """Return `LABEL_MEASURES` of sums, by name."""
    return {name: measure(sums) for name, measure in LABEL_MEASURES.items()}


def count_labels(label: Labels, truth: Labels) -> dict[str, int]:
    """Compare given with true labels, (N,) each; return `COUNTS`.

    A given UNKNOWN counts as not ground; where the truth is UNKNOWN the point does not count.
    """
    counted = (truth == Label.GROUND) | (truth == Label.OBSTACLE)
    code = 2 * (label != Label.GROUND) + (truth != Label.GROUND)
    # In the order of the codes: true and false positives, false and true negatives.
    counts = np.bincount(code[counted], minlength=len(COUNTS))
    return dict(zip(COUNTS, counts.tolist(), strict=True))


def count_rings(label: Labels, truth: Labels, points: PointArray) -> list[dict[str, Any]]:
    """Compare by horizontal range of `points` (N, >=2) [m], one row for each ring."""
    x, y = points[:, :2].astype(np.float64).T
    reach = np.hypot(x, y)
    ring = np.digitize(reach, RING_EDGES[1:])  # without a finite range: one more
    return [
        {'range': title, **count_labels(label[ring == k], truth[ring == k])}
        for k, title in enumerate(RING_TITLES)
    ]


def height_sums(
    truth: PointArray, estimate: PointArray, std: PointArray | None = None
) -> dict[str, Any]:
    """Compare true with estimated heights of the ground in a frame, (n,) [m].

    Points whose estimate is NaN, because there is no model, are in `n_without_model` only. `std`
    are the standard deviations of the differences, (n,) [m], if there are any. The error is
    estimate minus truth. `median_absolute` is no sum.
    """
    known = np.isfinite(estimate)
    error = estimate[known] - truth[known].astype(np.float64)
    spread = np.full(len(error), np.nan) if std is None else std[known]
    return {
        'n_points': len(error),
        'n_without_model': len(truth) - len(error),
        'error': float(error.sum()),  # [m]
        # Of a product of vectors the last digits depend on the number of threads.
        'square': float(np.square(error).sum()),  # [m^2]
        'n_with_std': int(np.isfinite(spread).sum()),
        'n_within_1': int((np.abs(error) <= spread).sum()),
        'n_within_2': int((np.abs(error) <= 2.0 * spread).sum()),
        'median_absolute': float(np.median(np.abs(error))) if len(error) else math.nan,
    }
