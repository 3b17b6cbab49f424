"""Parameters chosen on all sequences but one and scored on that one."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

from gp_ground_seg.data.semantic_kitti import Frame
from gp_ground_seg.errors import DataError
from gp_ground_seg.evaluation.evaluate import ALL, MethodScore, Progress, load_kitti, pool
from gp_ground_seg.evaluation.table import Column, Row, Table, percent
from gp_ground_seg.experiments.variants import Report, make_report, score_variants
from gp_ground_seg.parameters.config import Config
from gp_ground_seg.parameters.schema import ParameterValue

Choice = dict[str, ParameterValue]
"""A value for each parameter that is searched, by dotted name."""
Grid = Mapping[str, Sequence[ParameterValue]]


def coordinate_search(grid: Grid, start: Choice, worth: Callable[[Choice], float]) -> Choice:
    """Improve one parameter after the other until none can be.

    `grid` has the values to try; `worth` is maximised, of equal choices the earlier one stays.
    """
    best, highest = dict(start), worth(start)
    better = True
    while better:
        better = False
        for name, values in grid.items():
            for value in values:
                trial = {**best, name: value}
                if (found := worth(trial)) > highest:
                    best, highest, better = trial, found, True
    return best


def cross_validate(
    frames: Sequence[Frame], base: Config, grid: Grid, progress: Progress = iter
) -> Report:
    """Choose values by pooled IoU, once on all sequences and once without each.

    Each configuration segments every frame once, however many searches need it. `grid` has the
    values to try beside those of `base`, where each search starts.

    Raises
    ------
    ConfigError
        If a value is not accepted; before any frame is read, unless it takes two
        parameters to see.
    DataError
        If there are fewer than two sequences or a file cannot be read.
    """
    sequences = list(dict.fromkeys(frame.sequence for frame in frames))
    if len(sequences) < 2:
        raise DataError('cross-validation: needs at least two sequences')
    # As the configuration holds them: 1 and 1.0 are one value.
    tried = {name: [base.replace(**{name: v})[name] for v in grid[name]] for name in grid}
    start: Choice = {name: base[name] for name in grid}
    known: dict[tuple[ParameterValue, ...], MethodScore] = {}

    def score(choice: Choice) -> MethodScore:
        key = tuple(choice[name] for name in grid)
        if key not in known:
            variant = {str(len(known)): base.replace(**choice)}
            (known[key],) = score_variants(frames, load_kitti, variant, progress=progress)
        return known[key]

    def choose(names: Sequence[str]) -> Choice:
        return coordinate_search(tried, start, lambda choice: score(choice).of(*names).iou)

    choices = {'given': start, 'tuned': choose(sequences)}
    for left_out in sequences:
        choices[f'- {left_out}'] = choose([name for name in sequences if name != left_out])
    scores = [pool(name, [score(choices[name])]) for name in ('given', 'tuned')]
    own = (score(choices[f'- {name}']).of(name) for name in sequences)
    scores.append(pool('left out', own))
    tables = {
        'scores': _score_table(scores, len(known)),
        'choices': _choice_table(choices),
    }
    return make_report(tables, scores, base, n_configurations=len(known), tried=tried)


def _score_table(scores: Sequence[MethodScore], n_configurations: int) -> Table:
    rows: list[Row] = []
    for name in (*scores[0].sequences, None):
        own = [one.of(name) for one in scores]
        rows.append([(Column('sequence'), name or ALL)])
        rows[-1] += [(percent(f'IoU {o.name} [%]', f'iou {o.name}'), o.iou) for o in own]
        rows[-1] += [(Column(f'ECE {o.name}', '.4f'), o.ece) for o in own]
    title = (
        'IoU and expected calibration error, GroundGrid convention: as given; with the values '
        f'best on all {len(rows) - 1} sequences (tuned); each sequence with the values best on '
        f'the others (left out). {n_configurations} configurations scored.'
    )
    return Table.of(rows, title=title, n_sums=1)


def _choice_table(choices: dict[str, Choice]) -> Table:
    """Values chosen: a row for each parameter, a column for each search."""
    rows: list[Row] = []
    for name in choices['given']:
        rows.append([(Column('parameter'), name)])
        rows[-1] += [(Column(title, 's'), _shown(own[name])) for title, own in choices.items()]
    return Table.of(rows, title='Values chosen; - 00: without sequence 00')


def _shown(value: ParameterValue) -> str:
    return f'{value:g}' if isinstance(value, float) else str(value).lower()
