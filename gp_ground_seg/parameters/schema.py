"""What is declared of a parameter, and the check of a value against it."""

from __future__ import annotations

import numbers
import re
from dataclasses import dataclass, field
from typing import Any, Literal

from gp_ground_seg.errors import ConfigError

ParameterValue = bool | int | float | str

AUTO: Literal['auto'] = 'auto'
"""What a number may be instead where its declaration says so: found out from the scan."""


@dataclass(frozen=True)
class ParameterSpec:
    """What is declared of one parameter.

    Attributes
    ----------
    name : str
        Dotted name, ``group.field``.
    type : type
        ``bool``, ``int``, ``float`` or ``str``; that of the number where it may be ``auto``.
    default : bool, int, float or str
        Value used when nothing else is given.
    description : str
        One line on what it does.
    unit : str
        SI unit; empty for a pure number.
    symbol : str
        The paper's symbol, empty if it has none.
    minimum, maximum : float or None
        Inclusive bounds of a number; ``None`` for other types.
    choices : tuple of str
        Accepted values of a string; empty for other types, and for names of the user's.
    auto : bool
        Whether a number may also be `AUTO`.
    basic : bool
        Whether it is one of the few that are set for a robot; the others are advanced.
    """

    name: str
    type: type
    default: ParameterValue
    description: str
    unit: str
    symbol: str
    minimum: float | None
    maximum: float | None
    choices: tuple[str, ...]
    auto: bool = False
    basic: bool = False

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
        """Return `value` in the declared type.

        Raises
        ------
        ConfigError
            If the type is wrong or the value is out of range.
        """
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


def parameter(
    default: ParameterValue,
    description: str,
    *,
    unit: str = '',
    symbol: str = '',
    low: float | None = None,
    high: float | None = None,
    choices: tuple[str, ...] = (),
    auto: bool = False,
    basic: bool = False,
) -> Any:
    """Declare a parameter as a dataclass field; the words are those of `ParameterSpec`."""
    metadata = {
        'description': description,
        'unit': unit,
        'symbol': symbol,
        'minimum': low,
        'maximum': high,
        'choices': choices,
        'auto': auto,
        'basic': basic,
    }
    return field(default=default, metadata=metadata)
