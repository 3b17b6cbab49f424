"""Parameters in other forms: ROS parameter files, tables; and what is wrong with a file."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping
from pathlib import Path

import yaml

from gp_ground_seg.errors import ConfigError, DataError
from gp_ground_seg.parameters.config import Config, find_spec, parameter_specs
from gp_ground_seg.parameters.presets import PRESETS
from gp_ground_seg.parameters.schema import (
    AUTO,
    ROS_NODE_KEY,
    ROS_PARAMETERS_KEY,
    ParameterSpec,
    ParameterValue,
    read_parameters,
)

README_PATH = 'README.md'
README_BEGIN, README_END = '<!-- parameters:begin -->', '<!-- parameters:end -->'

_PAGE_HEAD = """\
# Parameters

`make generate` writes this page from gp_ground_seg/parameters/config.py. Most users set only those
in the table of the README. `gp-ground-seg config dump` writes all of them, with their values and
ranges, as a parameter file. A symbol is that of the paper.

"""
_WIDTH = 99
_INDENT = '  '
_NBSP = '\xa0'  # textwrap does not break here


def to_yaml(config: Config, purpose: str = '', reasons: Mapping[str, str] | None = None) -> str:
    """Write a ROS parameter file with a comment on each parameter.

    ``Config.from_yaml`` of it gives `config` again, and so does a ROS node. `purpose`, what the
    file is for, is written at its top, and the reason of a value, by name, above it.
    """
    reasons = reasons or {}
    lines = [
        *_comment(purpose, 0),
        '# Parameters of gp_ground_seg, as written by `gp-ground-seg config dump`. To use a copy:',
        '#   ros2 run gp_ground_seg ground_segmentation_node --ros-args --params-file my.yaml',
        '#   gp-ground-seg segment --config my.yaml ...',
        f'{ROS_NODE_KEY}:',
        f'{_INDENT}{ROS_PARAMETERS_KEY}:',
    ]
    for k, (group_name, values) in enumerate(config.nested().items()):
        about = (type(getattr(config, group_name)).__doc__ or '').strip()
        lines += [*([''] if k else []), *_comment(about, 2), f'{2 * _INDENT}{group_name}:']
        for field_name, value in values.items():
            spec = find_spec(f'{group_name}.{field_name}')
            facts = _accepted(spec) + (f' {spec.unit}' if spec.unit else '')
            facts += f'; {spec.symbol} in the paper' if spec.symbol else ''
            # The facts stay on one line.
            lines += _comment(f'{spec.description} ' + f'[{facts}]'.replace(' ', _NBSP), 3)
            if spec.name in reasons:
                default = f'(default {yaml_scalar(spec.default)})'.replace(' ', _NBSP)
                lines += _comment(f'Here: {reasons[spec.name]} {default}', 3)
            lines.append(f'{3 * _INDENT}{field_name}: {yaml_scalar(value)}')
    return '\n'.join(lines) + '\n'


def _comment(text: str, depth: int) -> list[str]:
    prefix = depth * _INDENT + '# '
    lines = textwrap.wrap(text, _WIDTH - len(prefix), break_on_hyphens=False)
    return [prefix + line.replace(_NBSP, ' ') for line in lines]


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
            rows.append((name, default, _accepted(spec), spec.unit, symbol, spec.description))
    lines = ['| ' + ' | '.join(cell.replace('|', r'\|') for cell in row) + ' |' for row in rows]
    return '\n'.join(lines) + '\n'


def yaml_scalar(value: ParameterValue) -> str:
    """Write a value the way it is written in a parameter file, quoted where needed."""
    text: str = yaml.safe_dump({'x': value})
    return text.strip().removeprefix('x: ')


def _accepted(spec: ParameterSpec) -> str:
    if spec.choices:
        return ' or '.join(spec.choices)
    if spec.type is bool:
        return 'true or false'
    if spec.type is str:
        return 'a name'
    auto = f'{AUTO} or ' if spec.auto else ''
    return f'{auto}{spec.minimum:.10g} to {spec.maximum:.10g}'


def generated_files(readme: str) -> dict[str, str]:
    """Text of every generated file of a checkout, by its path from the root.

    The table of the basic parameters goes between the markers of `readme`, the text of README.md;
    raises DataError if the two are not there once each, in order.
    """
    head, begin, rest = readme.partition(README_BEGIN)
    _, end, tail = rest.partition(README_END)
    if not end or README_BEGIN in rest or readme.count(README_END) > 1:
        raise DataError(
            f'must hold the lines {README_BEGIN} and {README_END} once each, in this order; '
            'the parameter table goes between them'
        )
    files = {
        f'config/{preset.name}.yaml': to_yaml(preset.config, preset.title, preset.reasons)
        for preset in PRESETS.values()
    }
    table = to_markdown_table(basic_only=True)
    files[README_PATH] = f'{head}{begin}\n\n{table}\n{end}{tail}'
    files['docs/parameters.md'] = _PAGE_HEAD + to_markdown_table()
    return files


def file_problems(path: str | Path) -> list[str]:
    """Everything wrong with a parameter file, one line each; none if it can be used.

    Rules between parameters are checked where each value by itself is accepted.
    """
    try:
        file = read_parameters(path)
    except ConfigError as error:
        return [str(error)]
    problems = []
    for name, value in file.values.items():
        try:
            find_spec(name).check(value)
        except ConfigError as error:
            problems.append(str(error))
    if problems:
        return problems
    try:
        Config().replace(**file.values)
    except ConfigError as error:
        return [str(error)]
    return []


def differences(
    first: Config, second: Config
) -> list[tuple[ParameterSpec, ParameterValue, ParameterValue]]:
    """Parameters that differ, with both values, in order of declaration."""
    return [
        (spec, first[spec.name], second[spec.name])
        for spec in parameter_specs()
        if first[spec.name] != second[spec.name]
    ]
