"""From the paper to the defaults step by step; and what wrong hyper-parameters cost."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing

from gp_ground_seg.core.parameters.config import Config, find_spec
from gp_ground_seg.core.parameters.presets import find_preset
from gp_ground_seg.data.semantic_kitti import Frame
from gp_ground_seg.lab.experiments.interpolation import interpolation_method
from gp_ground_seg.lab.experiments.variants import make_report, refuse_changed, score_variants
from gp_ground_seg.lab.scale.cluster import HERE, Runner
from gp_ground_seg.lab.scoring import report as results
from gp_ground_seg.lab.scoring.evaluate import Method, load_kitti
from gp_ground_seg.lab.scoring.intervals import INTERVAL, interval_note, interval_text
from gp_ground_seg.lab.scoring.patchworkpp import PatchworkppMethod
from gp_ground_seg.lab.scoring.report import (
    Column,
    Report,
    Row,
    Table,
    changed_parameters,
    percent,
)

STEPS = {
    'vertical faces': ('faces.',),
    'labels by the predictive distribution': ('label.',),
    'sloping mean': ('observation.slope_std',),
    'segments look aside': ('surface.',),
    'gate and lines of the growth': ('growth.', 'lines.'),
    'all else: bins, learning, sensor pose': ('',),
}
"""Steps from the preset ``paper`` to the defaults: beginnings of the names that change."""

FACTORS = (0.1, 1 / 3, 3.0, 10.0)
GIVEN = {
    'sigma_f': ('observation.sigma_f',),
    'sigma_n': ('observation.sigma_n',),
    'both': ('observation.sigma_f', 'observation.sigma_n'),
}
"""Hyper-parameters that are given wrong by these factors."""


def paper_steps() -> dict[str, Config]:
    """Return configurations from the paper to the defaults, by what is new in each."""
    steps = {'the paper (preset paper)': find_preset('paper').config}
    for title, beginnings in STEPS.items():
        *_, last = steps.values()
        names = [name for name in changed_parameters(last) if name.startswith(beginnings)]
        steps[f'+ {title}'] = last.replace(**{name: find_spec(name).default for name in names})
    return steps


def score_steps(frames: Sequence[Frame], with_peer: bool, runner: Runner = HERE) -> Report:
    """Score `paper_steps`, and beside them an interpolation and Patchwork++."""
    steps = paper_steps()
    with closing(interpolation_method(Config())) as plain:
        peers: list[Method] = [plain, *([PatchworkppMethod()] if with_peer else [])]
        scores = score_variants(frames, load_kitti, steps, peers, runner=runner)
    rows: list[Row] = []
    for k, one in enumerate(scores):
        other = scores[min(max(k, 1), len(steps)) - 1]
        rows.append(
            [
                (Column('method'), one.title),
                (percent('IoU [%]', 'iou'), one.iou),
                (percent('difference', form='+.2f'), one.iou - other.iou if k else None),
                (INTERVAL, interval_text(one.parts(), other.parts()) if k else None),
                (results.centimetres('RMSE [cm]', 'rmse'), one.height.rmse),
            ]
        )
    n_sequences = len(scores[0].sequences)
    title = (
        f'{len(frames)} scans of {n_sequences} sequences, each by itself; difference to the row '
        'above, below the steps to the last of them; '
        f'{interval_note(f"{n_sequences} sequences")}; RMSE of the height under labelled ground'
    )
    return make_report({'steps': Table.of(rows, title=title)}, scores, Config())


def score_wrong_values(frames: Sequence[Frame], config: Config, runner: Runner = HERE) -> Report:
    """Give hyper-parameters wrong, with and without learning."""
    refuse_changed(config, [*GIVEN['both'], 'learning.mode'])
    wrong = {
        f'{title} times {factor:.2g}': {name: factor * float(config[name]) for name in names}
        for title, names in GIVEN.items()
        for factor in FACTORS
    }
    variants = {}
    for title, changes in {'the defaults': {}, **wrong}.items():
        variants[title] = config.replace(**changes)
        variants[f'{title}, fixed'] = config.replace(**changes, **{'learning.mode': 'fixed'})
    scores = score_variants(frames, load_kitti, variants, runner=runner)
    rows: list[Row] = [
        [
            (Column('given'), learned.name),
            (percent('as given', 'iou_fixed'), fixed.iou),
            (percent('learned', 'iou'), learned.iou),
            (percent('difference', form='+.2f'), learned.iou - fixed.iou),
            (INTERVAL, interval_text(learned.parts(), fixed.parts())),
            (results.centimetres('RMSE as given', 'rmse_fixed'), fixed.height.rmse),
            (results.centimetres('learned', 'rmse'), learned.height.rmse),
        ]
        for learned, fixed in zip(scores[::2], scores[1::2], strict=True)
    ]
    n_sequences = len(scores[0].sequences)
    title = (
        f'{len(frames)} scans of {n_sequences} sequences; IoU [%] with hyper-parameters given '
        f'wrong, as they are and learned from there; {interval_note(f"{n_sequences} sequences")}; '
        'RMSE of the height [cm]'
    )
    return make_report({'values': Table.of(rows, title=title)}, scores, config)
