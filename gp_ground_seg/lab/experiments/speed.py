"""Time per frame by stage, beside Patchwork++."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any

from gp_ground_seg.core.backend import make_backend
from gp_ground_seg.core.errors import in_thousands
from gp_ground_seg.core.parameters.config import Config
from gp_ground_seg.data.semantic_kitti import Frame, read_points
from gp_ground_seg.lab.cluster import HERE, Runner
from gp_ground_seg.lab.experiments.variants import refuse_changed
from gp_ground_seg.lab.scoring.evaluate import (
    PATCHWORKPP,
    KnownScan,
    Method,
    OurMethod,
    Scores,
    score_methods,
    title_of,
)
from gp_ground_seg.lab.scoring.peers import PatchworkppMethod
from gp_ground_seg.lab.scoring.report import Column, Report, Table
from gp_ground_seg.lab.scoring.tables import make_report

MODES = {'every_frame': 'learning', 'fixed': 'theta fixed'}
"""Values of ``learning.mode`` that are timed, and their titles."""
N_PASSES = 3
"""How often each frame is timed."""


def measure_speed(
    items: Sequence[Frame], config: Config, runner: Runner = HERE, *, with_peer: bool = True
) -> Report:
    """Time each frame by stage, beside Patchwork++ on the same frame.

    With theta learned in every frame and with theta fixed, by the backend of the parameters and
    by numpy. Each method takes one thread. Reading is left out. The ratio to Patchwork++ is taken
    frame by frame, so it holds although the speed of the machine drifts. Run nothing else
    meanwhile.
    """
    refuse_changed(config, ['learning.mode'], *({'learning.mode': mode} for mode in MODES))
    scores = time_methods(items, config, runner, with_peer=with_peer)
    stages = _stages(scores)
    return make_report({'times': _times(scores), 'stages': stages}, scores, config)


def time_methods(
    items: Sequence[Frame],
    config: Config,
    runner: Runner = HERE,
    *,
    with_peer: bool,
    clock: Callable[[], float] = time.perf_counter,
) -> Scores:
    """Run every method `N_PASSES` times on every frame, one after the other."""
    numpy = {'runtime.backend': 'numpy'}
    variants = {title: {'learning.mode': mode} for mode, title in MODES.items()}
    if make_backend(config.runtime).name != 'numpy':
        variants |= {f'{title}, numpy': own | numpy for title, own in variants.items()}
    methods: list[Method] = [
        OurMethod(config.replace(**changes), name) for name, changes in variants.items()
    ]
    if with_peer:
        methods.insert(len(MODES), PatchworkppMethod.of_sensor(config.sensor))
    return score_methods([*items] * N_PASSES, methods, _load, clock=clock, runner=runner)


def _load(frame: Frame) -> KnownScan:
    """Read the points alone: what is not scored leaves the caches as they are."""
    return KnownScan(
        frame.sequence, frame.index, read_points(frame.points_path, frame.columns), {}
    )


def _times(scores: Scores) -> Table:
    """Lay out medians and quantiles, and their ratios to Patchwork++ frame by frame."""
    scans = scores.scans
    runs = scans.assign(run=scans.groupby('method').cumcount())
    seconds = runs.pivot(index='run', columns='method', values='seconds')[scores.methods]
    median, p99 = seconds.median(), seconds.quantile(0.99)
    columns: dict[Column, Any] = {
        Column('method'): [title_of(name) for name in scores.methods],
        Column('median [ms]', '.2f', 'median', 1e3): median,
        Column('p99 [ms]', '.2f', 'p99', 1e3): p99,
    }
    if PATCHWORKPP in seconds:
        name = title_of(PATCHWORKPP)
        ratios = seconds.div(seconds[PATCHWORKPP], axis='index')
        columns[Column(f'/ {name}', '.2f', 'ratio')] = ratios.median()
        columns[Column(f'p99 / {name} median', '.2f', 'p99_ratio')] = p99 / median[PATCHWORKPP]
    frames = scans.drop_duplicates(['sequence', 'index'])
    points = map(in_thousands, (frames['points'].median(), frames['points'].max()))
    title = (
        f'Time per frame: {len(frames)} frames, {N_PASSES} passes, reading left out; '
        '{} points (median), at most {}'.format(*points)
    )
    return Table(columns, title)


def _stages(scores: Scores) -> Table:
    """Lay out the median of each stage of our methods, and of what is outside of them."""
    times = scores.times.drop(columns=['sequence', 'index'])
    # Rows of both frames are in the same order.
    seconds = scores.scans.loc[scores.scans['method'] != PATCHWORKPP, 'seconds'].to_numpy()
    times['rest'] = seconds - times.drop(columns='method').sum(axis='columns')
    medians = times.groupby('method', sort=False).median()
    columns: dict[Column, Any] = {Column('stage, median [ms]', key='method'): medians.index}
    for name in medians:
        columns[Column(str(name), '.2f', scale=1e3)] = medians[name]
    return Table(columns, 'Stages of a frame')
