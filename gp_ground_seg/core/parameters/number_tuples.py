"""Groups of parameters as named tuples of their numbers, which compiled code reads.

Kernels are annotated with the dataclasses of the same names, whose fields they have. A new number
of these groups is there by its declaration.
"""

from __future__ import annotations

from collections import namedtuple
from dataclasses import fields
from functools import lru_cache
from typing import Any, TypeVar, cast

from gp_ground_seg.core.parameters import config

_Group = TypeVar('_Group')


@lru_cache
def tuple_type(group: type[Any]) -> type[Any]:
    """Named tuple type of the numbers of a group.

    Words, declared as ``str``, are left out: they choose between kernels, which never see them.
    Raises TypeError if a field is neither a number nor a word.
    """
    names = []
    for field in fields(group):
        if field.type in ('bool', 'int', 'float'):
            names.append(field.name)
        elif field.type != 'str':
            raise TypeError(
                f'{group.__name__}.{field.name}: {field.type}, which compiled code cannot read; '
                'must be bool, int, float or str'
            )
    return namedtuple(group.__name__, names, module=__name__)


# numba pickles a type with the code it keeps, by module and name: each is there under its own.
LinesConfig = tuple_type(config.LinesConfig)
LengthScaleConfig = tuple_type(config.LengthScaleConfig)
ObservationConfig = tuple_type(config.ObservationConfig)
LatentConfig = tuple_type(config.LatentConfig)
GrowthConfig = tuple_type(config.GrowthConfig)
LearningConfig = tuple_type(config.LearningConfig)
FacesConfig = tuple_type(config.FacesConfig)
LabelConfig = tuple_type(config.LabelConfig)


@lru_cache(maxsize=64)
def numbers_of(group: _Group) -> _Group:
    """Return the numbers of a group under the same names."""
    kind = tuple_type(type(group))  # type: ignore[arg-type]
    values = [getattr(group, name) for name in kind._fields]
    return cast(_Group, kind(*values))
