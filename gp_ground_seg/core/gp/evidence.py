"""Stage 5: evidence of the ground from the segments beside a segment.

Where a car hides the ground of a segment, that segment by itself would take the car for ground.
Its neighbours see the ground at the same range, lower. Two sources of evidence are used: seeds
must not stand higher than seeds near them allow, and the surfaces of the segments beside decide
with a segment's own which candidates join.
"""

import math
from typing import NamedTuple

import numpy as np

from gp_ground_seg.core.frame import BoolArray, FloatArray, Frame, Values
from gp_ground_seg.core.gp.kernels import prior_variance
from gp_ground_seg.core.gp.model import SegmentSurfaces
from gp_ground_seg.core.jit import choose, shared
from gp_ground_seg.core.parameters.config import ObservationConfig

STEP = 4
"""One of how many segments shows its ground to those beside it: neighbours see much the same."""
CLEARLY = 2.0
"""Standard deviations over the evidence, or over other seeds, from which on a candidate stands on
something, and is neither a seed nor joins by a line."""
LEAST_STD = 1e-3
"""Standard deviation of a surface below which it counts as that [m]."""
LEAST_PRECISION = 1e-3
"""Precision below which a surface shows nothing [1/m^2]: rounding is left of the prior."""


class Evidence(NamedTuple):
    """Height of the ground at places of segments, by the segments beside them.

    Tables (M, K) at the knots; (0, 0) where none is used.
    """

    height: FloatArray  # about the prior mean [m]; 0 where there is no evidence
    precision: FloatArray  # inverse variance [1/m^2]; 0 where there is no evidence


@shared
def contradicts(height: Values, precision: Values, z: Values, noise: Values) -> Values:
    """Whether heights `z` [m] with variances `noise` stand clearly above the evidence.

    The first two are the evidence.
    """
    is_known = precision > 0.0
    spread = np.sqrt(1.0 / choose(is_known, precision, 1.0) + noise)
    return is_known & (z - height > CLEARLY * spread)


@shared
def combined(
    height: Values, variance: Values, neighbour_height: Values, neighbour_precision: Values
) -> tuple[Values, Values]:
    """Height and variance of an estimate together with the evidence of neighbours."""
    variance = np.maximum(variance, 0.0)
    share = 1.0 / (1.0 + variance * neighbour_precision)
    return share * height + (1.0 - share) * neighbour_height, share * variance


@shared
def combined_surface(
    mean: Values, std: Values, prior: Values, neighbour_height: Values, neighbour_precision: Values
) -> tuple[Values, Values]:
    """Height and standard deviation of a surface together with the evidence of neighbours [m].

    NaN where there is neither; `prior` is the variance where there is no surface.
    """
    has_surface = np.isfinite(std)
    least = np.maximum(std, LEAST_STD)
    height, variance = combined(
        choose(has_surface, mean, 0.0),
        choose(has_surface, least * least, prior),
        neighbour_height,
        neighbour_precision,
    )
    is_known = has_surface | (neighbour_precision > 0.0)
    return choose(is_known, height, np.nan), choose(is_known, np.sqrt(variance), np.nan)


@shared
def shown_by(mean: Values, std: Values, prior: Values) -> tuple[Values, Values]:
    """Height that a surface shows by its observations, and its standard deviation [m].

    The prior, of variance `prior`, is divided out, so that neighbours pass on observations only.
    0 and infinite where nothing is left.
    """
    least = np.maximum(std, LEAST_STD)
    square = least * least
    precision = 1.0 / square - 1.0 / prior
    is_known = precision > LEAST_PRECISION
    safe = choose(is_known, precision, 1.0)
    return (
        choose(is_known, mean / (square * safe), 0.0),
        choose(is_known, 1.0 / np.sqrt(safe), np.inf),
    )


@shared
def between_knots(r: Values, near: Values, far: Values, a: Values, b: Values) -> Values:
    """Value at range `r`, linear between `a` at the knot `near` and `b` at `far`."""
    share = np.minimum(np.maximum((r - near) / (far - near), 0.0), 1.0)
    return a + share * (b - a)


@shared
def is_on_object(z: Values, highest: Values, sigma_n: Values) -> Values:
    """Whether a candidate is higher than the `highest` ground and its noise explain."""
    return z > highest + sigma_n


def find_seeds(frame: Frame, theta: FloatArray, slope_std: float, seed: BoolArray) -> None:
    """Remove candidates that stand on others from `seed` (C,).

    Seeds are low and near (``growth.seed_height_tolerance``, ``growth.seed_range``). What stands
    higher over one of these than noise and prior slope explain stands on something. Distances are
    taken along ranges and arcs, between the near edges of bins: outwards and inwards, around, and
    outwards and inwards again.
    """
    if not seed.any():
        return
    candidates, n_segments = frame.candidates, frame.candidates.n_segments
    place, z = (candidates.segment[seed], candidates.bin[seed]), candidates.z[seed]
    table = np.full((n_segments, int(place[1].max()) + 1), np.inf)
    table[place] = z
    along = CLEARLY * slope_std * frame.knots[: table.shape[1], None]
    around = np.arange(3.0 * n_segments)[:, None] * (2.0 * math.pi / n_segments * along.T)
    table = _rising(table.T, along).T
    table = _rising(np.concatenate([table] * 3), around)[n_segments : 2 * n_segments]
    table = _rising(table.T, along).T
    seed[seed] = ~is_on_object(z, table[place], np.exp(theta[1]))


def _rising(table: FloatArray, place: FloatArray) -> FloatArray:
    """Least of all rows of a table, which rise from each on to either side with `place`."""
    onwards = np.minimum.accumulate(table - place) + place
    backwards = np.minimum.accumulate((table + place)[::-1])[::-1] - place
    return np.minimum(onwards, backwards)


def evidence_of_neighbours(
    mean: FloatArray,
    std: FloatArray,
    knots: FloatArray,
    theta: FloatArray,
    observation: ObservationConfig,
) -> Evidence:
    """Evidence at the knots of every segment from the surfaces of the others, (M, K).

    On either side the nearest segment that knows: the standard deviation of its evidence grows
    with the prior slope for each metre of arc. See `shown_by` for what a surface shows.

    Parameters
    ----------
    mean, std : (M, K) float64
        Height about the prior mean and standard deviation of the surface of each segment by
        itself [m]; NaN where there is none.
    knots : (K,) float64
        Ranges of the knots [m].
    theta : (T,) float64
        Hyper-parameters of the surfaces.
    observation : ObservationConfig
        Prior of the slope.
    """
    with np.errstate(invalid='ignore'):
        prior = prior_variance(np.exp(2.0 * theta[0]), observation, knots)
        height, deviation = shown_by(mean, std, prior)
    step = observation.slope_std * 2.0 * math.pi / len(mean) * knots
    total, weighted = np.zeros_like(height), np.zeros_like(height)
    for side in (1, -1):
        nearest, nearest_std = _of_nearest(height, deviation, step, side)
        weight = 1.0 / nearest_std**2
        total += weight
        weighted += weight * nearest
    return Evidence(weighted / np.where(total > 0.0, total, 1.0), total)


def _of_nearest(
    height: FloatArray, deviation: FloatArray, step: FloatArray, side: int
) -> tuple[FloatArray, FloatArray]:
    """Height and standard deviation (M, K) by the nearest segment before each, or after it.

    `side` is 1 or -1; the standard deviation grows by `step` (K,) for each segment on the way.
    """
    n, distance = len(height), np.arange(2 * len(height), dtype=np.int32)[:, None]
    # Twice around the ring; as seen from before the first one, the nearest is the least so far.
    seen = np.concatenate([deviation[::side]] * 2) - distance * step
    least = np.minimum.accumulate(seen)
    nearest = np.maximum.accumulate(np.where(seen == least, distance, 0))[n - 1 : -1] % n
    least = least[n - 1 : -1] + distance[n:] * step
    return np.take_along_axis(height[::side], nearest, axis=0)[::side], least[::side]


def at_candidates(from_neighbours: Evidence, frame: Frame) -> Evidence:
    """Evidence at the candidates, (C,): linear between the knots about each; 0 without any."""
    knots, candidates = frame.knots, frame.candidates
    r, segment, near = candidates.r, candidates.segment, candidates.bin
    if len(from_neighbours.height) == 0:
        return Evidence(*np.zeros((2, len(r))))
    far = near + 1
    height, precision = (
        between_knots(r, knots[near], knots[far], table[segment, near], table[segment, far])
        for table in from_neighbours
    )
    return Evidence(height, precision)


def join_evidence(
    found: SegmentSurfaces,
    from_neighbours: Evidence,
    knots: FloatArray,
    theta: FloatArray,
    observation: ObservationConfig,
) -> None:
    """Make the surface of each segment that of it and the evidence together."""
    mean, std, is_unknown = found.mean, found.std, np.isnan(found.knot_log_length_scale)
    prior = prior_variance(np.exp(2.0 * theta[0]), observation, knots)
    mean[:], std[:] = combined_surface(mean, std, prior, *from_neighbours)
    mean[is_unknown] = std[is_unknown] = np.nan
