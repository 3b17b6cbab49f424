"""Rewrite config/*.yaml, the tables of parameters, and README's scores: `make generate`."""

from pathlib import Path

from gp_ground_seg.core.errors import DataError
from gp_ground_seg.core.parameters.config import parameter_specs
from gp_ground_seg.core.parameters.export import accepted_values, to_yaml, yaml_scalar
from gp_ground_seg.core.parameters.presets import PRESETS
from gp_ground_seg.core.parameters.removed import REMOVED

ROOT = Path(__file__).resolve().parent.parent
README = 'README.md'
PARAMETERS, SCORES = 'parameters', 'scores'
PAGE_HEAD = """\
# Parameters

`make generate` writes this page from `gp_ground_seg/core/parameters/config.py`. Most users set
only those in the table of the README. `gp-ground-seg config dump` writes all of them, with values
and ranges, as a parameter file. A symbol is that of the paper.

"""
REMOVED_HEAD = """
## Removed

A file or a command that has one of these ends with its line. The node and the launch file leave it
out, and warn. Topics begin with `~/`: a subscriber of one gets no message.

| Removed | Instead |
| --- | --- |
"""


def to_markdown_table(*, basic_only: bool = False) -> str:
    """Write the parameters as a Markdown table, one row each, in order of declaration."""
    rows = [
        ('Parameter', 'Default', 'Accepted', 'Unit', 'Symbol', 'Meaning'),
        ('---', '---', '---', '---', '---', '---'),
    ]
    for spec in parameter_specs():
        if spec.basic or not basic_only:
            name, default = f'`{spec.name}`', f'`{yaml_scalar(spec.default)}`'
            symbol = f'`{spec.symbol}`' if spec.symbol else ''
            rows.append(
                (name, default, accepted_values(spec), spec.unit, symbol, spec.description)
            )
    lines = ['| ' + ' | '.join(cell.replace('|', r'\|') for cell in row) + ' |' for row in rows]
    return '\n'.join(lines) + '\n'


def marks_of(name: str) -> tuple[str, str]:
    """Lines between which a table of the README is written."""
    return f'<!-- {name}:begin -->', f'<!-- {name}:end -->'


def with_table(readme: str, name: str, table: str) -> str:
    """Write a table between its marks; raise DataError if they are not there once, in order."""
    begin, end = marks_of(name)
    head, found, rest = readme.partition(begin)
    _, found_end, tail = rest.partition(end)
    if not found or not found_end or begin in rest or readme.count(end) > 1:
        raise DataError(
            f'must hold the lines {begin} and {end} once each, in this order; '
            'a table goes between them'
        )
    return f'{head}{begin}\n{table}{end}{tail}'


def rows_below(page: str, title: str) -> list[list[str]]:
    """Cells of the rows of the first table below a title of a page."""
    text = (ROOT / page).read_text(encoding='utf-8')
    below = text[text.index(f'\n{title}') :].partition('\n|')[2].partition('\n\n')[0]
    _, _, *rows = f'|{below}'.splitlines()
    return [[cell.strip() for cell in row.split('|')[1:-1]] for row in rows]


GAINS = {
    'all, GroundGrid convention': 'IoU, vegetation left out',
    'all, Patchwork convention': 'IoU, low vegetation counted as ground',
    '40-50 m': 'IoU at 40 to 50 m, vegetation left out',
}
OBJECTS = {'vehicles': ('vehicle',), 'persons and cyclists': ('person', 'cyclist')}
ROBOT = {
    1: 'low things: returns called ground',
    4: 'false cells of road',
    7: 'false cells of ground',
}
"""Rows of low things and false cells, by the column of what is counted."""
TIMES = {
    'learning': 'learning',
    'theta fixed': 'no learning',
    'learning, numpy': 'learning, without numba',
}
"""Rows of times, by the method."""
PERFORMANCE = 'docs/performance.md'


def to_scores_table() -> str:
    """Write a table of the scores of docs/accuracy.md and the times of docs/performance.md."""
    page = 'docs/accuracy.md'
    rows = [['Measure', 'gp_ground_seg', 'Patchwork++', 'Difference (95 % interval)'], ['---'] * 4]
    gains = {points: cells for points, *cells in rows_below(page, 'IoU minus that of ')}
    for points, title in GAINS.items():
        ours, peer, gain, interval = gains[points]
        rows.append([title, f'{ours} %', f'{peer} %', f'{gain} ({interval})'])
    *without, _ = rows_below(page, 'IoU without one sequence')
    left_out, ours, peer, gain = min(without, key=lambda row: float(row[3]))
    rows.insert(3, [f'the same without sequence {left_out}', f'{ours} %', f'{peer} %', gain])
    objects = [row for row in rows_below(page, 'Objects: ') if row[1] == 'all']
    for title, kinds in OBJECTS.items():
        counts = [map(int, row[6:9]) for row in objects if row[0] in kinds]
        number, ours, peer = (str(sum(column)) for column in zip(*counts, strict=True))
        rows.append([f'{title} lost, of {number}', ours, peer, ''])
    *_, pooled = rows_below(page, 'Low things and false cells')
    for k, title in ROBOT.items():
        number, ours, peer = pooled[k : k + 3]
        cells = ('-' if share == '-' else f'{share} %' for share in (ours, peer))
        rows.append([f'{title}, of {number}', *cells, ''])
    times = {method: cells for method, *cells in rows_below(PERFORMANCE, 'Time per frame')}
    baseline = f'{float(times["Patchwork++"][0]):.1f} ms'
    for name, title in TIMES.items():
        time, _, ratio, _ = map(float, times[name])
        cells = f'time per frame, {title}', f'{time:.3g} ms', baseline, f'{ratio:#.2g} times'
        rows.append([*cells])
    table = ''.join(f'| {" | ".join(row)} |\n' for row in rows)
    notes = (
        f'Times are medians on the machine of [{PERFORMANCE}]({PERFORMANCE}); the factor is the '
        'median of the ratios frame by frame.'
    )
    return f'{table}\n{notes}\n'


def generated_files(readme: str) -> dict[str, str]:
    """Text of every generated file of a checkout, by its path from the root.

    Of the text of README.md, `readme`, the tables between `marks_of` are replaced; raises
    DataError as `with_table`.
    """
    files = {
        f'config/{preset.name}.yaml': to_yaml(preset.config, preset.title, preset.reasons)
        for preset in PRESETS.values()
    }
    readme = with_table(readme, PARAMETERS, to_markdown_table(basic_only=True))
    files[README] = with_table(readme, SCORES, to_scores_table())
    removed = ''.join(f'| `{name}` | {instead} |\n' for name, instead in REMOVED.items())
    files['docs/parameters.md'] = PAGE_HEAD + to_markdown_table() + REMOVED_HEAD + removed
    return files


def main() -> None:
    """Write the files."""
    for name, text in generated_files((ROOT / README).read_text(encoding='utf-8')).items():
        (ROOT / name).write_text(text, encoding='utf-8')


if __name__ == '__main__':
    main()
