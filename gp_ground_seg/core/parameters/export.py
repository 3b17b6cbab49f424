"""Parameter files: written, compared, and what is wrong with one."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping
from pathlib import Path

import yaml

from gp_ground_seg.core.errors import ConfigError
from gp_ground_seg.core.parameters.config import Config, find_spec, parameter_specs
from gp_ground_seg.core.parameters.schema import (
    AUTO,
    NO_BOX,
    ROS_NODE_KEY,
    ROS_PARAMETERS_KEY,
    ParameterSpec,
    ParameterValue,
    load_yaml,
    read_parameters,
)

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
            facts = accepted_values(spec) + (f' {spec.unit}' if spec.unit else '')
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


def yaml_scalar(value: ParameterValue) -> str:
    """Write a value the way it is written in a parameter file, quoted where needed."""
    if isinstance(value, tuple):
        return f'[{", ".join(map(yaml_scalar, value))}]'
    text: str = yaml.safe_dump({'x': value}).strip().removeprefix('x: ')
    # PyYAML writes a frame named 1e5 without quotes: a number, for us as for ROS.
    return text if load_yaml(text) == value else f"'{value}'"


def accepted_values(spec: ParameterSpec) -> str:
    """Say which values are accepted, without their unit."""
    if spec.choices:
        return ' or '.join(spec.choices)
    if spec.type is bool:
        return 'true or false'
    if spec.type is str:
        return 'a name'
    if spec.type is tuple:
        return f'{NO_BOX} or six numbers, {spec.minimum:.10g} to {spec.maximum:.10g}'
    auto = f'{AUTO} or ' if spec.auto else ''
    return f'{auto}{spec.minimum:.10g} to {spec.maximum:.10g}'


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
