"""Rewrite config/*.yaml, the page of parameters, and README's scores: `make generate`."""

from pathlib import Path

from gp_ground_seg.core.errors import DataError
from gp_ground_seg.core.parameters.config import PRESETS, parameter_specs
from gp_ground_seg.core.parameters.schema import yaml_scalar

ROOT = Path(__file__).resolve().parent.parent
README = 'README.md'
SCORES = 'scores'
PAGE_HEAD = """\
# Parameters

`make generate` writes this page. Symbols in brackets are those of the paper.

## Those that people set

"""
ALL_PARAMETERS = """
## All of them

[config/default.yaml](../config/default.yaml) has every parameter with its meaning, range and unit.

```{literalinclude} ../config/default.yaml
:language: yaml
```
"""


def to_markdown_table() -> str:
    """Write the parameters that people set, one row each, in their order."""
    rows = [
        ('Parameter', 'Default', 'Accepted', 'Meaning'),
        ('---', '---', '---', '---'),
    ]
    for spec in parameter_specs():
        if spec.basic:
            name, default = f'`{spec.name}`', f'`{yaml_scalar(spec.default)}`'
            symbol = f' (`{spec.symbol}`)' if spec.symbol else ''
            rows.append((name, default, spec.accepted, f'{spec.description}{symbol}'))
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
    '40-50 m': 'IoU at 40 to 50 m',
}
"""Rows of the IoU, by the points that count."""
PERFORMANCE = 'docs/performance.md'


def to_scores_table() -> str:
    """Write a table of the scores of docs/accuracy.md and the times of docs/performance.md."""
    page = 'docs/accuracy.md'
    rows = [['Measure', 'gp_ground_seg', 'Patchwork++', 'Difference (95 % interval)'], ['---'] * 4]
    gains = {points: cells for points, *cells in rows_below(page, 'IoU minus that of ')}
    for points, title in GAINS.items():
        ours, peer, gain, interval = gains[points]
        rows.append([title, f'{ours} %', f'{peer} %', f'{gain} ({interval})'])
    objects = rows_below(page, 'Objects: ')
    ((*_, number, ours, peer),) = (row for row in objects if row[:2] == ['vehicle', 'all'])
    rows.append([f'vehicles lost, of {number}', ours, peer, ''])
    *_, (_, number, ours, peer, *_) = rows_below(page, 'Low things and false cells')
    title = f'low things: returns called ground, of {number}'
    rows.append([title, f'{ours} %', f'{peer} %', ''])
    times = {method: cells for method, *cells in rows_below(PERFORMANCE, 'Time per frame')}
    (ours, _, ratio, _), (peer, *_) = times['learning'], times['Patchwork++']
    rows.append(['time per frame, median', f'{ours} ms', f'{peer} ms', f'{ratio} times'])
    return ''.join(f'| {" | ".join(row)} |\n' for row in rows)


def generated_files(readme: str) -> dict[str, str]:
    """Text of every generated file of a checkout, by its path from the root.

    Of the text of README.md, `readme`, the tables between `marks_of` are replaced; raises
    DataError as `with_table`.
    """
    files = {
        f'config/{preset.name}.yaml': preset.to_yaml(preset.config) for preset in PRESETS.values()
    }
    files[README] = with_table(readme, SCORES, to_scores_table())
    files['docs/parameters.md'] = PAGE_HEAD + to_markdown_table() + ALL_PARAMETERS
    return files


def main() -> None:
    """Write the files."""
    for name, text in generated_files((ROOT / README).read_text(encoding='utf-8')).items():
        (ROOT / name).write_text(text, encoding='utf-8')


if __name__ == '__main__':
    main()
