"""Parameters: their declarations, the check of values, groups as one object, and their files."""

from __future__ import annotations

import contextlib
import dataclasses
import difflib
import functools
import numbers
import re
import textwrap
from collections import Counter, namedtuple
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal, NamedTuple, TypeVar, cast

import yaml

from gp_ground_seg.core.errors import LOGGER, ConfigError, in_one_line, reason_of

if TYPE_CHECKING:
    from typing_extensions import Self

ParameterValue = bool | int | float | str | tuple[float, ...]

AUTO: Literal['auto'] = 'auto'
"""Value instead of a number that is estimated from the scan, where the declaration allows it."""
NO_BOX: Literal['none'] = 'none'
"""Value instead of the six bounds of a box: ROS does not read an empty list."""
ROS_NODE_KEY = '/**'
NODE_NAME = 'ground_segmentation_node'
ROS_PARAMETERS_KEY = 'ros__parameters'
MAX_FILE_BYTES = 1 << 18  # twenty times the largest of config/
MAX_VALUES = 500  # of a file: five times those there are
MAX_DIGITS = 100  # of an integer; Python cannot print one of more than 4,300
YAML_SUFFIXES = ('.yaml', '.yml')
NO_VALUES = 'no parameters of the segmentation in it'
_WIDTH, _INDENT = 99, '  '  # of the lines of a file that is written
_NBSP = '\xa0'  # textwrap does not break here
OF_EVERY_NODE = ('use_sim_time', 'start_type_description_service')
"""Parameters that every ROS node has."""


@dataclass(frozen=True)
class ParameterSpec:
    """Declaration of one parameter."""

    name: str  # dotted, ``group.field``
    # bool, int, float or str; tuple of a box; that of the number where it may be `AUTO`
    type: type
    default: Any  # a `ParameterValue`
    description: str
    unit: str  # SI; empty for a pure number
    symbol: str  # in the paper; empty if it has none
    minimum: Any  # inclusive, of a number and of those of a box; None for other types
    maximum: Any
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
        if self.type is tuple:
            return (
                f'{NO_BOX} or six numbers in [{self.minimum:g}, {self.maximum:g}]{unit}, '
                'in ascending pairs'
            )
        kind = 'an integer' if self.type is int else 'a number'
        auto = f'{AUTO} or ' if self.auto else ''
        return f'{auto}{kind} in [{self.minimum:g}, {self.maximum:g}]{unit}'

    def check(self, value: object) -> ParameterValue:
        """Return `value` in the declared type; ConfigError if it is of another or out of range."""
        checked: ParameterValue | None = None
        if self.type is bool:
            checked = value if isinstance(value, bool) else None
        elif self.auto and isinstance(value, str) and value == AUTO:
            checked = AUTO
        elif self.type is str:
            # A name is letters, digits and ``_-./``.
            known = self.choices or re.findall(r'\A[\w\-./]+\Z', str(value), re.ASCII)
            checked = value if isinstance(value, str) and value in known else None
        else:
            checked = self._box(value) if self.type is tuple else self._number(value)
        if checked is None:
            given = repr(value) if len(repr(value)) <= 100 else f'{repr(value)[:100]} ...'
            raise ConfigError(f'{self.name} = {given}: must be {self.accepted}')
        return checked

    def _number(self, value: Any) -> int | float | None:
        """Return a number within the bounds in the declared type, else None."""
        is_number = isinstance(value, numbers.Real) and not isinstance(value, bool)
        # The bounds are finite: NaN and the infinities are never within.
        if not is_number or not self.minimum <= value <= self.maximum:
            return None
        if self.type is int:
            return int(value) if isinstance(value, numbers.Integral) else None
        return float(value)

    def _box(self, value: object) -> ParameterValue | None:
        """Return the six bounds, or `NO_BOX`, that `value` stands for; None if for neither."""
        if isinstance(value, str):
            # ``ros2 param set`` sends a list as text if only some of its numbers have a point.
            with contextlib.suppress(ConfigError):
                value = load_yaml(value)
        if isinstance(value, str):
            return NO_BOX if value == NO_BOX else None
        given = list(value) if isinstance(value, Iterable) else [value]
        bounds = [bound for bound in map(self._number, given) if bound is not None]
        pairs = zip(bounds[::2], bounds[1::2], strict=False)
        if len(bounds) == len(given) == 6 and all(low < high for low, high in pairs):
            return tuple(bounds)
        return None if given else NO_BOX


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
    or any name. A number whose `default` is `AUTO` may be that too; the lowest and highest number
    of a `default` of `NO_BOX` are those of the bounds of a box.
    """
    choices = accepted if accepted and isinstance(accepted[0], str) else ()
    auto = default == AUTO and not choices
    is_box = default == NO_BOX and bool(accepted) and not choices
    kind = tuple if is_box else float if auto else type(default)
    low, high = accepted if kind in (int, float, tuple) else (None, None)
    spec = ParameterSpec(
        '', kind, default, description, unit, symbol, low, high, choices, auto, basic
    )
    return field(default=default, metadata={'spec': spec})


basic = functools.partial(declare, basic=True)
advanced = functools.partial(declare, basic=False)


class ParameterGroup:
    """Base of a frozen dataclass of declared parameters, whose numbers compiled code reads."""

    Numbers: ClassVar[Any]
    """Named tuple of the numbers; words choose between kernels, which never see them."""

    def __init_subclass__(cls) -> None:
        """Derive the named tuple from the declaration."""
        kinds = cls.__annotations__.items()
        names = [name for name, kind in kinds if kind in ('bool', 'int', 'float')]
        make: Any = namedtuple
        numbers = make('Numbers', names, module=cls.__module__)
        # numba pickles a type with the code it keeps, by this name.
        numbers.__qualname__ = f'{cls.__qualname__}.Numbers'
        cls.Numbers = numbers


_Group = TypeVar('_Group')


def numbers_of(group: _Group) -> _Group:
    """Return the numbers of a group under the same names, for compiled code."""
    kind = type(group).Numbers  # type: ignore[attr-defined]
    return cast(_Group, kind(*(getattr(group, name) for name in kind._fields)))


@dataclass(frozen=True)
class ParameterGroups:
    """Base of a frozen dataclass of groups of declared parameters."""

    @classmethod
    @functools.cache
    def specs(cls) -> dict[str, ParameterSpec]:
        """Every declared parameter by its dotted name, in order of declaration."""
        specs = {}
        for group in dataclasses.fields(cls):
            for entry in dataclasses.fields(group.default):  # type: ignore[arg-type]
                name = f'{group.name}.{entry.name}'
                specs[name] = dataclasses.replace(entry.metadata['spec'], name=name)
        return specs

    @classmethod
    def find_spec(cls, name: str) -> ParameterSpec:
        """Return the declaration of one parameter; ConfigError with the nearest name if none."""
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
        # A whole number given for a float becomes one, in a group of our own.
        for group_name, group in self._groups(checked).items():
            object.__setattr__(self, group_name, group)

    def _groups(self, values: Mapping[str, object]) -> dict[str, Any]:
        """Return groups with some values changed, by name."""
        nested: dict[str, dict[str, Any]] = {}
        for name, value in values.items():
            group_name, field_name = name.split('.')
            nested.setdefault(group_name, {})[field_name] = value
        return {
            name: dataclasses.replace(getattr(self, name), **group)
            for name, group in nested.items()
        }

    def __getitem__(self, name: str) -> Any:
        """Value of the parameter with the dotted `name`, in its declared type."""
        group_name, field_name = self.find_spec(name).name.split('.')
        return getattr(getattr(self, group_name), field_name)

    def flat(self) -> dict[str, ParameterValue]:
        """Every value by its dotted name, in order of declaration."""
        return {name: self[name] for name in self.specs()}

    def nested(self) -> dict[str, dict[str, ParameterValue]]:
        """Every value as ``{group: {field: value}}``."""
        return dataclasses.asdict(self)

    def replace(self, **changes: object) -> Self:
        """Copy with some values changed, given by dotted names (``**{'grid.r_max': 60.0}``).

        Raises ConfigError if a name is unknown or the changed configuration is invalid.
        """
        values = {self.find_spec(name).name: value for name, value in changes.items()}
        return dataclasses.replace(self, **self._groups(values))

    @classmethod
    def from_yaml(cls, path: str | Path, base: Self | None = None) -> Self:
        """Read a YAML file: ROS form (``/**: ros__parameters:``) or bare groups.

        Parameters not in the file are as in `base`, by default the defaults. Raises ConfigError,
        with the path, if the file cannot be read, a name is unknown, or a value is not accepted.
        """
        try:
            file = read_parameters(path)
            if not file.is_ours:
                raise ConfigError(
                    f'parameters of node {file.node}; must be of {ROS_NODE_KEY} or {NODE_NAME}'
                )
            if not file.values:
                LOGGER.warning('%s: %s', path, NO_VALUES)
            return (base or cls()).replace(**file.values)
        except ConfigError as error:
            raise ConfigError(f'{path}: {error}') from error

    @classmethod
    def problems_of_file(cls, path: str | Path) -> list[str]:
        """Everything wrong with a parameter file, one line each; none if it can be used.

        Rules between parameters are checked where each value by itself is accepted.
        """
        problems = []
        try:
            values = read_parameters(path).values
            for name, value in values.items():
                try:
                    cls.find_spec(name).check(value)
                except ConfigError as error:
                    problems.append(str(error))
            if not problems:
                cls().replace(**values)
        except ConfigError as error:
            problems.append(str(error))
        return problems

    def differences(self, other: Self) -> list[tuple[ParameterSpec, Any, Any]]:
        """Parameters that differ, with the value here and in `other`, in order of declaration."""
        pairs = ((spec, self[name], other[name]) for name, spec in self.specs().items())
        return [(spec, own, value) for spec, own, value in pairs if own != value]

    def to_yaml(self, purpose: str = '', reasons: Mapping[str, str] | None = None) -> str:
        """Write a ROS parameter file with a comment on each parameter.

        `from_yaml` of it gives the same again, and so does a ROS node. `purpose`, what the file is
        for, is written at its top, and the reason of a value, by name, above it.
        """
        reasons = reasons or {}
        lines = [
            *_comment(purpose, 0),
            '# Parameters of gp_ground_seg, as written by `gp-ground-seg config dump`. To use a '
            'copy:',
            '#   ros2 run gp_ground_seg ground_segmentation_node --ros-args --params-file my.yaml',
            '#   gp-ground-seg segment --config my.yaml ...',
            f'{ROS_NODE_KEY}:',
            f'{_INDENT}{ROS_PARAMETERS_KEY}:',
        ]
        for k, (group_name, values) in enumerate(self.nested().items()):
            about = (type(getattr(self, group_name)).__doc__ or '').strip()
            lines += [*([''] if k else []), *_comment(about, 2), f'{2 * _INDENT}{group_name}:']
            for field_name, value in values.items():
                spec = self.find_spec(f'{group_name}.{field_name}')
                facts = spec.accepted + (f'; {spec.symbol} in the paper' if spec.symbol else '')
                # The facts stay on one line.
                lines += _comment(f'{spec.description} ' + f'({facts})'.replace(' ', _NBSP), 3)
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


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """Return a hint at the known name nearest to `name`, empty if none is near."""
    near = difflib.get_close_matches(name, known, n=1, cutoff=0.5)
    return f'; did you mean {near[0]}?' if near else ''


class _Loader(yaml.SafeLoader):
    """PyYAML's safe loader, without some of its surprises (see `load_yaml`)."""

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        """Refuse aliases, as ROS does: a kilobyte of them can stand for gigabytes."""
        if self.check_event(yaml.AliasEvent):
            raise ConfigError(f'line {self.line + 1}: aliases (*name) are not accepted')
        return super().compose_node(parent, index)

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        """Refuse a key that is there twice; the last would win silently."""
        keys = (key.value for key, _ in node.value if isinstance(key, yaml.ScalarNode))
        _refuse_repeated(keys, f', from line {node.start_mark.line + 1} on')
        return super().construct_mapping(node, deep)


def _refuse_repeated(names: Iterable[str], where: str = '') -> None:
    if twice := [name for name, n_times in Counter(names).items() if n_times > 1]:
        raise ConfigError(f'{twice[0]}: given twice{where}')


def _construct_int(loader: _Loader, node: yaml.ScalarNode) -> int:
    if len(node.value) > MAX_DIGITS:
        raise ConfigError(f'line {node.start_mark.line + 1}: a number of {len(node.value)} digits')
    return loader.construct_yaml_int(node)


_Loader.add_constructor('tag:yaml.org,2002:int', _construct_int)
# What launch_ros writes for a list, which rcl reads as one.
_Loader.add_constructor(
    'tag:yaml.org,2002:python/tuple',
    _Loader.construct_sequence,  # type: ignore[type-var]
)
_Loader.add_implicit_resolver(
    'tag:yaml.org,2002:float',
    re.compile(r'^[-+]?([0-9]+\.?[0-9]*|\.[0-9]+)[eE][-+]?[0-9]+$'),
    list('-+.0123456789'),
)


def read_yaml(path: str | Path) -> object:
    """Read a YAML file as `load_yaml`; ConfigError also if it cannot be read or is too large."""
    try:
        with open(path, 'rb') as file:
            data = file.read(MAX_FILE_BYTES + 1)
    except OSError as error:
        raise ConfigError(reason_of(error)) from error
    if len(data) > MAX_FILE_BYTES:
        raise ConfigError(f'too large for a parameter file, accepted are {MAX_FILE_BYTES} bytes')
    try:
        return load_yaml(data.decode('utf-8'))
    except UnicodeDecodeError as error:
        raise ConfigError('not a text file') from error


def load_yaml(text: str) -> object:
    """Read YAML, with 1e-3 a number as in ROS.

    Raises ConfigError if it is none, has aliases or a key twice, or cannot be of parameters.
    """
    try:
        return yaml.load(text, Loader=_Loader)
    except ConfigError:
        raise
    except Exception as error:  # of many types: 2011-99-99, `!!int x`, `!!bool x`, ...
        raise ConfigError(f'not valid YAML: {in_one_line(error)}') from error


class ParameterFile(NamedTuple):
    """Values of a parameter file by dotted names, unchecked."""

    values: dict[str, object]
    node: str  # whose they are, in the form of ROS; '' for bare groups

    @property
    def is_ours(self) -> bool:
        """Whether a node of our name, and commands, use it."""
        return self.node.split('/')[-1] in ('', '*', '**', NODE_NAME)


def read_parameters(path: str | Path) -> ParameterFile:
    """Read a parameter file; ConfigError if it cannot be read or parsed, or gives a name twice."""
    groups, node = _unwrap_ros(read_yaml(path))
    given = list(_flatten(groups))
    if len(given) > MAX_VALUES:
        raise ConfigError(f'more than {MAX_VALUES} values, too many for a parameter file')
    _refuse_repeated(name for name, _ in given)
    return ParameterFile(dict(given), node)


def _unwrap_ros(document: object) -> tuple[Mapping[str, object], str]:
    """Return groups of parameters, and the node that a file names; '' if it names none."""
    if document is None:
        return {}, ''
    if not isinstance(document, Mapping):
        raise ConfigError('must be a mapping of parameter groups')
    if not any(
        str(key).startswith('/') or (isinstance(value, Mapping) and ROS_PARAMETERS_KEY in value)
        for key, value in document.items()
    ):
        return document, ''  # bare groups
    if len(document) != 1:
        raise ConfigError(f'parameters of {len(document)} nodes; keep one, keyed {ROS_NODE_KEY}')
    ((node, below),) = document.items()
    if not isinstance(below, Mapping) or not isinstance(below.get(ROS_PARAMETERS_KEY), Mapping):
        raise ConfigError(f'no mapping {ROS_PARAMETERS_KEY} below the node name')
    if len(below) > 1:
        raise ConfigError(f'values beside {ROS_PARAMETERS_KEY}, which ROS refuses')
    # Names that every ROS node has are no parameters of the segmentation.
    return {
        key: value
        for key, value in below[ROS_PARAMETERS_KEY].items()
        if key not in OF_EVERY_NODE and not str(key).startswith('qos_overrides')
    }, str(node)


def _flatten(tree: Mapping[str, object], prefix: str = '') -> Iterator[tuple[str, object]]:
    for key, value in tree.items():
        name = f'{prefix}{key}'
        if isinstance(value, Mapping):
            yield from _flatten(value, f'{name}.')
        else:
            yield name, value
