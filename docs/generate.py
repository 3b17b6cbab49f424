"""Rewrite config/*.yaml, the page of parameters, and README's scores: `make generate`."""

from pathlib import Path
from statistics import fmean

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


def rows_below(page: str, title: str) -> dict[str, dict[str, str]]:
    """Rows of the first table below a title of a page, by their first cell, by title of column."""
    text = (ROOT / page).read_text(encoding='utf-8')
    below = text[text.index(f'\n{title}') :].partition('\n|')[2].partition('\n\n')[0]
    titles, _, *rows = ([cell.strip() for cell in line.split('|')] for line in below.splitlines())
    return {row[1]: dict(zip(titles, row[1:-1], strict=False)) for row in rows}


def judged(ours: str, peer: str) -> str:
    """Difference of two errors, with what it means where ours is the larger."""
    n_digits = len(ours.partition('.')[2])
    difference = f'{float(ours) - float(peer):+.{n_digits}f}'
    return f'{difference}: worse' if float(ours) > float(peer) else difference


def to_scores_table() -> str:
    """Write a table of the scores of docs/accuracy.md and the times of docs/performance.md."""
    page = 'docs/accuracy.md'
    rows = [['Measure', 'gp_ground_seg', 'Patchwork++', 'Difference (95 % interval)'], ['---'] * 4]
    row = rows_below(page, 'IoU minus that of ')['all']
    gain = f'{row["difference"]} ({row["95 % interval"]})'
    rows.append(['IoU, vegetation left out', f'{row["IoU"]} %', f'{row["peer IoU"]} %', gain])
    sensors = [row for row in rows_below(page, '## Other sensors').values() if row['IoU'] != '-']
    iou, theirs = (fmean(float(row[title]) for row in sensors) for title in ('IoU', 'peer IoU'))
    title = f'IoU, mean of {len(sensors)} other sensors'
    rows.append([title, f'{iou:.2f} %', f'{theirs:.2f} %', f'{iou - theirs:+.2f}'])
    classes = rows_below(page, 'Objects: ')
    row = classes['vehicle']
    lost = row['lost'], row['peer lost']
    rows.append([f'vehicles lost, of {row["objects"]}', *lost, judged(*lost)])
    low = rows_below(page, 'Low objects and false cells')['all']
    for title, row in {
        f'low objects: called ground, of {low["low returns"]}': low,
        f'vegetation: called ground, of {classes["vegetation"]["returns"]}': classes['vegetation'],
    }.items():
        shares = row['as ground'], row['peer as ground']
        rows.append([title, *(f'{share} %' for share in shares), judged(*shares)])
    times = rows_below('docs/performance.md', 'Time per frame')
    ours, peer = times['learning'], times['Patchwork++']
    title, ratio = 'time per frame, median', f'{ours["/ Patchwork++"]} times'
    rows.append([title, f'{ours["median [ms]"]} ms', f'{peer["median [ms]"]} ms', ratio])
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
