"""Rewrite config/*.yaml and the tables of parameters in README.md and docs/: `make generate`."""

from pathlib import Path

from gp_ground_seg.core.errors import DataError
from gp_ground_seg.core.parameters.config import parameter_specs
from gp_ground_seg.core.parameters.export import accepted_values, to_yaml, yaml_scalar
from gp_ground_seg.core.parameters.presets import PRESETS

ROOT = Path(__file__).resolve().parent.parent
README = 'README.md'
BEGIN, END = '<!-- parameters:begin -->', '<!-- parameters:end -->'
PAGE_HEAD = """\
# Parameters

`make generate` writes this page from `gp_ground_seg/core/parameters/config.py`. Most users set
only those in the table of the README. `gp-ground-seg config dump` writes all of them, with values
and ranges, as a parameter file. A symbol is that of the paper.

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


def generated_files(readme: str) -> dict[str, str]:
    """Text of every generated file of a checkout, by its path from the root.

    The table of the basic parameters goes between the markers of `readme`, the text of README.md;
    raises DataError if the two are not there once each, in order.
    """
    head, begin, rest = readme.partition(BEGIN)
    _, end, tail = rest.partition(END)
    if not end or BEGIN in rest or readme.count(END) > 1:
        raise DataError(
            f'must hold the lines {BEGIN} and {END} once each, in this order; '
            'the parameter table goes between them'
        )
    files = {
        f'config/{preset.name}.yaml': to_yaml(preset.config, preset.title, preset.reasons)
        for preset in PRESETS.values()
    }
    table = to_markdown_table(basic_only=True)
    files[README] = f'{head}{begin}\n\n{table}\n{end}{tail}'
    files['docs/parameters.md'] = PAGE_HEAD + to_markdown_table()
    return files


def main() -> None:
    """Write the files."""
    for name, text in generated_files((ROOT / README).read_text(encoding='utf-8')).items():
        (ROOT / name).write_text(text, encoding='utf-8')


if __name__ == '__main__':
    main()
