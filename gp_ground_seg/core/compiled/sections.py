"""Sections of the configuration as named tuples of their numbers, which compiled code reads.

Kernels are annotated with the dataclasses of the same names, whose fields they have: all numbers,
and no words.
"""

from __future__ import annotations

from collections import namedtuple
from dataclasses import fields
from functools import lru_cache
from typing import Any, TypeVar, cast

from gp_ground_seg.core.parameters import config

_Section = TypeVar('_Section')


def _tuple_type(section: type[Any]) -> type[Any]:
    names = [field.name for field in fields(section) if field.type in ('bool', 'int', 'float')]
    return namedtuple(section.__name__, names, module=__name__)


# numba pickles the type with the code it keeps, by module and name: each is an attribute here.
LinesConfig = _tuple_type(config.LinesConfig)
LengthScaleConfig = _tuple_type(config.LengthScaleConfig)
ObservationConfig = _tuple_type(config.ObservationConfig)
LatentConfig = _tuple_type(config.LatentConfig)
GrowthConfig = _tuple_type(config.GrowthConfig)
FacesConfig = _tuple_type(config.FacesConfig)
LabelConfig = _tuple_type(config.LabelConfig)

_TUPLE_TYPES = {
    config.LinesConfig: LinesConfig,
    config.LengthScaleConfig: LengthScaleConfig,
    config.ObservationConfig: ObservationConfig,
    config.LatentConfig: LatentConfig,
    config.GrowthConfig: GrowthConfig,
    config.FacesConfig: FacesConfig,
    config.LabelConfig: LabelConfig,
}


@lru_cache(maxsize=64)
def numbers_of(section: _Section) -> _Section:
    """Return the numbers of a section under the same names."""
    tuple_type = _TUPLE_TYPES[type(section)]
    values = [getattr(section, name) for name in tuple_type._fields]
    return cast(_Section, tuple_type(*values))
