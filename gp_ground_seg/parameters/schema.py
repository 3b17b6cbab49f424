"""Declarations of parameters: their form, the check of values, groups of them as one object."""

from __future__ import annotations

import dataclasses
import difflib
import functools
import numbers
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from gp_ground_seg.errors import ConfigError
from gp_ground_seg.parameters.yaml_io import read_parameters

if TYPE_CHECKING:
    from typing_extensions import Self

ParameterValue = bool | int | float | str

AUTO: Literal['auto'] = 'auto'
"""What a number may be instead where its declaration says so: estimated from the scan."""


@dataclass(frozen=True)
class ParameterSpec:
    """What is declared of one parameter."""

    name: str  # dotted, ``group.field``
    type: type  # bool, int, float or str; that of the number where it may be `AUTO`
    default: ParameterValue
    description: str
    unit: str  # SI; empty for a pure number
    symbol: str  # in the paper; empty if it has none
    minimum: float | None  # inclusive, of a number; None for other types
    maximum: float | None
    choices: tuple[str, ...]  # accepted strings; empty for other types, and for any name
    auto: bool  # whether a number may also be `AUTO`
    basic: bool  # whether it is one of the few that are set for a robot

    @property
    def accepted(self) -> str:
        """Accepted values in words."""
        if self.choices:
            return 'one of ' + ', '.join(self.choices)
        if self.type is bool:
            return 'true or false'
        if self.type is str:
            return 'a name'
        unit = f' {self.unit}' if self.unit else ''
        kind = 'an integer' if self.type is int else 'a number'
        auto = f'{AUTO} or ' if self.auto else ''
        return f'{auto}{kind} in [{self.minimum:g}, {self.maximum:g}]{unit}'

    def _is_name(self, value: str) -> bool:
        """Whether any name is accepted, and `value` is one: letters, digits and ``_-./``."""
        return not self.choices and re.fullmatch(r'[\w\-./]+', value, re.ASCII) is not None

    def check(self, value: object) -> ParameterValue:
        """Return `value` in the declared type; ConfigError if it is of another or out of range."""
        if self.auto and isinstance(value, str) and value == AUTO:
            return AUTO
        if self.type is bool:
            if isinstance(value, bool):
                return value
        elif self.type is str:
            if isinstance(value, str) and (value in self.choices or self._is_name(value)):
                return value
        elif isinstance(value, numbers.Real) and not isinstance(value, bool):
            assert self.minimum is not None
            assert self.maximum is not None
            # The bounds are finite: NaN and the infinities are never within.
            if value <= self.maximum and not value < self.minimum:
                if self.type is float:
                    return float(value)
                if isinstance(value, numbers.Integral):
                    return int(value)
        raise ConfigError(f'{self.name} = {value!r}: must be {self.accepted}')


def check_typed(spec: ParameterSpec, value: object) -> ParameterValue:
    """Return `value` as `ParameterSpec.check`, but refuse an integer for a number, as ROS does."""
    if spec.type is float and isinstance(value, int) and not isinstance(value, bool):
        raise ConfigError(
            f'{spec.name} = {value}: must be {spec.accepted}, with a decimal point as in {value}.0'
        )
    return spec.check(value)


def declare(
    default: ParameterValue,
    accepted: tuple[Any, ...],
    description: str,
    unit: str = '',
    symbol: str = '',
    *,
    basic: bool,
) -> Any:
    """Declare a parameter as a field of a frozen dataclass; see `ParameterSpec`.

    `accepted` holds the lowest and highest number, or the accepted strings; it is empty for a bool
    or any name. A number whose `default` is `AUTO` may be that too.
    """
    choices = accepted if accepted and isinstance(accepted[0], str) else ()
    auto = default == AUTO and not choices
    kind = float if auto else type(default)
    low, high = accepted if kind in (int, float) else (None, None)
    spec = ParameterSpec(
        '', kind, default, description, unit, symbol, low, high, choices, auto, basic
    )
    return field(default=default, metadata={'spec': spec})


basic = functools.partial(declare, basic=True)
"""Declares a parameter that is set for a robot."""
advanced = functools.partial(declare, basic=False)
"""Declares a parameter that is rarely set."""


@dataclass(frozen=True)
class ParameterGroups:
    """Base of a frozen dataclass of groups of declared parameters; checks all values."""

    @classmethod
    @functools.cache
    def specs(cls) -> dict[str, ParameterSpec]:
        """Every declared parameter by its dotted name, in order of declaration."""
        groups: dict[str, Any] = {group.name: group.default for group in dataclasses.fields(cls)}
        specs = (
            dataclasses.replace(entry.metadata['spec'], name=f'{name}.{entry.name}')
            for name, group in groups.items()
            for entry in dataclasses.fields(group)
        )
        return {spec.name: spec for spec in specs}

    @classmethod
    def find_spec(cls, name: str) -> ParameterSpec:
        """Return the declaration of one parameter; raises ConfigError with the nearest name."""
        specs = cls.specs()
        if name in specs:
            return specs[name]
        members = [known for known in specs if known.startswith(f'{name}.')]
        if members:
            raise ConfigError(f'{name!r} is a group of parameters: {", ".join(members)}')
        raise ConfigError(f'unknown parameter {name!r}{did_you_mean(name, specs)}')

    def __post_init__(self) -> None:
        """Check every value."""
        checked = {name: spec.check(self[name]) for name, spec in self.specs().items()}
        for group_name, values in _nest(checked).items():
            # A whole number given for a float becomes one, in a group of our own.
            group = dataclasses.replace(getattr(self, group_name), **values)
            object.__setattr__(self, group_name, group)

    def __getitem__(self, name: str) -> ParameterValue:
        """Value of the parameter with the dotted `name`."""
        group_name, field_name = self.find_spec(name).name.split('.')
        value: ParameterValue = getattr(getattr(self, group_name), field_name)
        return value

    def flat(self) -> dict[str, ParameterValue]:
        """Every value by its dotted name, in order of declaration."""
        return {name: self[name] for name in self.specs()}

    def nested(self) -> dict[str, dict[str, ParameterValue]]:
        """Every value as ``{group: {field: value}}``."""
        return _nest(self.flat())

    def replace(self, **changes: object) -> Self:
        """Copy with some values changed, given by dotted names (``**{'grid.r_max': 60.0}``).

        Raises ConfigError if a name is unknown or the changed configuration is invalid.
        """
        checked = {name: self.find_spec(name).check(value) for name, value in changes.items()}
        groups: dict[str, Any] = {
            group_name: dataclasses.replace(getattr(self, group_name), **values)
            for group_name, values in _nest(checked).items()
        }
        return dataclasses.replace(self, **groups)

    @classmethod
    def from_yaml(cls, path: str | Path, base: Self | None = None) -> Self:
        """Read a YAML file: ROS form (``/**: ros__parameters:``) or bare groups.

        Parameters not in the file are as in `base`, by default the defaults. Raises ConfigError,
        with the path, if the file cannot be read, a name is unknown, or a value is not accepted.
        """
        try:
            return (base or cls()).replace(**read_parameters(path).values)
        except ConfigError as error:
            raise ConfigError(f'{path}: {error}') from error


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """Return a hint at the known name nearest to `name`, empty if none is near."""
    near = difflib.get_close_matches(name, known, n=1, cutoff=0.5)
    return f'; did you mean {near[0]}?' if near else ''


def _nest(flat: Mapping[str, ParameterValue]) -> dict[str, dict[str, ParameterValue]]:
    """``{'group.field': value}`` as ``{group: {field: value}}``."""
    result: dict[str, dict[str, ParameterValue]] = {}
    for name, value in flat.items():
        group_name, field_name = name.split('.')
        result.setdefault(group_name, {})[field_name] = value
    return result
