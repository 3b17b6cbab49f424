"""All that is wrong with a parameter file, and what two sets of parameters differ in."""

from __future__ import annotations

from pathlib import Path

from gp_ground_seg.errors import ConfigError
from gp_ground_seg.parameters.config import Config, find_spec, parameter_specs
from gp_ground_seg.parameters.schema import ParameterSpec, ParameterValue
from gp_ground_seg.parameters.yaml_io import read_parameters


def check_typed(spec: ParameterSpec, value: object) -> ParameterValue:
    """Return `value` if ROS takes it: a ROS parameter keeps its type, an integer is no double.

    Raises
    ------
    ConfigError
        If the type is another or the value out of range.
    """
    if spec.type is float and isinstance(value, int) and not isinstance(value, bool):
        raise ConfigError(
            f'{spec.name} = {value}: must be {spec.accepted}, with a decimal point as in {value}.0'
        )
    return spec.check(value)


def file_problems(path: str | Path) -> list[str]:
    """Everything wrong with a parameter file, one line each; none if it can be used.

    A file in the form of ROS is held to the strict types of ROS parameters. Rules between
    parameters are checked where each value by itself is accepted.
    """
    try:
        file = read_parameters(path)
    except ConfigError as error:
        return [str(error)]
    problems = []
    for name, value in file.values.items():
        try:
            spec = find_spec(name)
            check_typed(spec, value) if file.is_ros else spec.check(value)
        except ConfigError as error:
            problems.append(str(error))
    if not problems:
        try:
            Config.from_flat(file.values)
        except ConfigError as error:
            problems.append(str(error))
    return problems


def differences(
    first: Config, second: Config
) -> list[tuple[ParameterSpec, ParameterValue, ParameterValue]]:
    """Parameters that differ, with both values, in order of declaration."""
    return [
        (spec, first[spec.name], second[spec.name])
        for spec in parameter_specs()
        if first[spec.name] != second[spec.name]
    ]
