"""How the time per frame grows with the size of the problem."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import closing
from dataclasses import dataclass
from itertools import groupby

import numpy as np
import numpy.typing as npt

from gp_ground_seg.errors import ConfigError
from gp_ground_seg.evaluation.bench import BenchFrame
from gp_ground_seg.parameters.config import Config
from gp_ground_seg.result import Segmentation
from gp_ground_seg.segmenter import GroundSegmenter

Points = npt.NDArray[np.float32]

N_MERGED = 4
"""Successive frames that make a merged cloud."""

MODES = ('fixed', 'every_frame')
"""Values of ``learning.mode`` that are timed."""

SIZES: dict[str, Callable[[Segmentation], int]] = {
    'points': lambda result: len(result.label),
    'segments': lambda result: result.grid.n_segments,
    'bins': lambda result: len(result.grid.edges) - 1,
    'pseudo_inputs': lambda result: result.fit.n_pseudo_inputs,
}
"""What each series counts."""

_SHARES = (0.125, 0.25, 0.5, 1.0, 2.0, 4.0)
_FACTORS = (0.25, 0.5, 1.0, 2.0, 4.0)
# Most first: many candidates for each pseudo-input leave few of them.
_CANDIDATES_PER_PSEUDO_INPUT = (12.0, 6.0, 3.0, 1.5, 1.0)
_N_FRAMES = 6
_N_RUNS = 3


@dataclass(frozen=True)
class Merged:
    """Clouds of four frames beside the frames they are made of, theta fixed, one thread.

    Attributes
    ----------
    n_points : tuple of int
        Points of each merged cloud.
    seconds : tuple of float
        Time of each.
    single_seconds : tuple of float
        Mean time of its four frames, measured right before and after it.
    """

    n_points: tuple[int, ...]
    seconds: tuple[float, ...]
    single_seconds: tuple[float, ...]


@dataclass(frozen=True)
class Variant:
    """One size of one series: changed parameters, or a share of the points of a frame."""

    series: str
    changes: dict[str, float | int]
    share: float = 1.0


@dataclass(frozen=True)
class ScalingPoint:
    """What a variant took on one thread.

    Attributes
    ----------
    size : float
        Its size, see `SIZES`; median over the frames.
    seconds : dict of str to float
        Median time by ``learning.mode``.
    ratio : dict of str to float
        Median of the time over that of the frame as it is, measured right before.
    """

    size: float
    seconds: dict[str, float]
    ratio: dict[str, float]


def spread(n_available: int, n_wanted: int) -> list[int]:
    """Return the indices of `n_wanted` items, or of all there are, spread evenly."""
    n = min(n_available, n_wanted)
    return [(2 * k + 1) * n_available // (2 * n) for k in range(n)]


def merged_groups(frames: Sequence[BenchFrame]) -> list[list[BenchFrame]]:
    """Group `N_MERGED` successive frames of a sequence each; a rest is left out."""
    groups = []
    for _, sequence in groupby(frames, key=lambda frame: frame.sequence):
        own = list(sequence)
        groups += [own[k : k + N_MERGED] for k in range(0, len(own) - N_MERGED + 1, N_MERGED)]
    return groups


def time_merged(
    frames: Sequence[BenchFrame],
    config: Config,
    clock: Callable[[], float] = time.perf_counter,
) -> Merged | None:
    """Time clouds of four successive frames laid over one another, unregistered.

    Returns
    -------
    Merged or None
        None where no sequence has that many frames.
    """
    groups = merged_groups(frames)
    if not groups:
        return None
    single = config.replace(**{'learning.mode': 'fixed', 'runtime.n_threads': 1})
    n_points, seconds, single_seconds = [], [], []
    with closing(GroundSegmenter(single)) as segmenter:
        segmenter.segment(groups[0][0].points)
        for group in groups:
            cloud = np.concatenate([frame.points for frame in group])
            around = [_time(segmenter, frame.points, clock)[0] for frame in group[:2]]
            seconds.append(_time(segmenter, cloud, clock)[0])
            around += [_time(segmenter, frame.points, clock)[0] for frame in group[2:]]
            single_seconds.append(statistics.fmean(around))
            n_points.append(len(cloud))
    return Merged(tuple(n_points), tuple(seconds), tuple(single_seconds))


def variants_of(config: Config) -> list[Variant]:
    """Sizes to time: factors of the parameters given, as far as they are accepted."""
    return [
        *(Variant('points', {}, share) for share in _SHARES),
        *_scaled('segments', 'grid.n_segments', config),
        *_scaled('bins', 'grid.n_bins', config),
        *(
            Variant('pseudo_inputs', {'latent.candidates_per_pseudo_input': number})
            for number in _CANDIDATES_PER_PSEUDO_INPUT
        ),
    ]


def _scaled(series: str, name: str, config: Config) -> list[Variant]:
    given = config[name]
    assert isinstance(given, int)
    variants = (Variant(series, {name: round(factor * given)}) for factor in _FACTORS)
    return [variant for variant in variants if _is_accepted(variant, config)]


def _is_accepted(variant: Variant, config: Config) -> bool:
    try:
        config.replace(**variant.changes)
    except ConfigError:
        return False
    return True


def time_scaling(
    frames: Sequence[BenchFrame],
    config: Config,
    clock: Callable[[], float] = time.perf_counter,
    progress: Callable[[Sequence[Variant]], Iterable[Variant]] = iter,
) -> dict[str, list[ScalingPoint]]:
    """Time one size after the other, each beside the frame as it is, on one thread.

    Parameters
    ----------
    frames : sequence of BenchFrame
        At least one; the first of up to six groups are used, spread evenly.
    config : Config
        Parameters to vary.
    clock : callable
        Source of seconds.
    progress : callable
        Wraps the variants to show how far it is.

    Returns
    -------
    dict of str to list of ScalingPoint
        One list for each of `SIZES`; sizes that need more frames than there are left out.
    """
    groups = merged_groups(frames) or [[frame] for frame in frames]
    chosen = [groups[k] for k in spread(len(groups), _N_FRAMES)]
    result: dict[str, list[ScalingPoint]] = {series: [] for series in SIZES}
    for variant in progress(variants_of(config)):
        if variant.share <= min(len(group) for group in chosen):
            clouds = [(_share_of(group, variant.share), group[0].points) for group in chosen]
            result[variant.series].append(_time_variant(clouds, config, variant, clock))
    return result


def _share_of(group: Sequence[BenchFrame], share: float) -> Points:
    """So many times the points of the first frame, by random rows or further frames."""
    if share >= 1.0:
        return np.concatenate([frame.points for frame in group[: round(share)]])
    points = group[0].points
    rows = np.random.default_rng(0).permutation(len(points))[: round(share * len(points))]
    return points[np.sort(rows)]


def _time_variant(
    clouds: Sequence[tuple[Points, Points]],
    config: Config,
    variant: Variant,
    clock: Callable[[], float],
) -> ScalingPoint:
    seconds, ratio = {}, {}
    sizes: list[int] = []
    for mode in MODES:
        as_is = config.replace(**{'learning.mode': mode, 'runtime.n_threads': 1})
        times, ratios = [], []
        with (
            closing(GroundSegmenter(as_is)) as baseline,
            closing(GroundSegmenter(as_is.replace(**variant.changes))) as changed,
        ):
            for segmenter in (baseline, changed):
                segmenter.segment(clouds[0][0])
            for cloud, whole in clouds:
                for _ in range(_N_RUNS):
                    base, _ = _time(baseline, whole, clock)
                    own, result = _time(changed, cloud, clock)
                    times.append(own)
                    ratios.append(own / base)
                    sizes.append(SIZES[variant.series](result))
        seconds[mode] = statistics.median(times)
        ratio[mode] = statistics.median(ratios)
    return ScalingPoint(statistics.median(sizes), seconds, ratio)


def _time(
    segmenter: GroundSegmenter, points: Points, clock: Callable[[], float]
) -> tuple[float, Segmentation]:
    start = clock()
    result = segmenter.segment(points)
    return clock() - start, result
