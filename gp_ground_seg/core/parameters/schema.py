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
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal, TypeVar, cast

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
MAX_LENGTH = 1 << 18  # of a file: twenty times the largest of config/
MAX_VALUES = 500  # of a file: five times those there are
YAML_SUFFIXES = ('.yaml', '.yml')
FORM_OF_ROS = (
    'the node needs; from bare groups: gp-ground-seg config dump --config FILE > ros.yaml'
)
EMPTY_LIST = 'ROS does not read an empty list; write none'
_WIDTH, _INDENT = 99, '  '  # of the lines of a file that is written
_NBSP = '\xa0'  # textwrap does not break here
OF_EVERY_NODE = ('use_sim_time', 'start_type_description_service', 'qos_overrides.')
"""Parameters that every ROS node has, or how their names begin."""


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
            return 'a name that does not begin with /'
        bounds = f'in [{self.minimum:g}, {self.maximum:g}] {self.unit}'.rstrip()
        if self.type is tuple:
            return f'{NO_BOX} or six numbers {bounds}, in ascending pairs'
        kind = 'an integer' if self.type is int else 'a number'
        auto = f'{AUTO} or ' if self.auto else ''
        return f'{auto}{kind} {bounds}'

    def check(self, value: object) -> ParameterValue:
        """Return `value` in the declared type; ConfigError if it is of another or out of range."""
        checked: ParameterValue | None = None
        if self.type is bool:
            checked = value if isinstance(value, bool) else None
        elif self.auto and isinstance(value, str) and value == AUTO:
            checked = AUTO
        elif self.type is str:
            # Letters, digits and ``_-./``; tf2 refuses a frame that begins with /.
            known = self.choices or re.findall(r'\A(?!/)[\w\-./]+\Z', str(value), re.ASCII)
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
    return cast(_Group, kind(*map(vars(group).get, kind._fields)))


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
        if members := [known for known in specs if known.startswith(f'{name}.')]:
            raise ConfigError(f'{name!r} is a group of parameters: {", ".join(members)}')
        raise ConfigError(f'unknown parameter {name!r}{did_you_mean(name, specs)}')

    def __post_init__(self) -> None:
        """Check every value; a group may be a mapping of some of its values."""
        for group in dataclasses.fields(self):
            kind: Any = type(group.default)
            given = getattr(self, group.name)
            values = vars(given) if isinstance(given, kind) else given
            if not isinstance(values, Mapping):
                raise ConfigError(f'{group.name} = {given!r}: must be a mapping of its parameters')
            # A whole number given for a float becomes one, in a group of our own.
            checked = {
                name: self.find_spec(f'{group.name}.{name}').check(value)
                for name, value in {**vars(group.default), **values}.items()
            }
            object.__setattr__(self, group.name, kind(**checked))

    def __getitem__(self, name: str) -> Any:
        """Value of the parameter with the dotted `name`, in its declared type."""
        group_name, field_name = self.find_spec(name).name.split('.')
        return getattr(getattr(self, group_name), field_name)

    def nested(self) -> dict[str, dict[str, ParameterValue]]:
        """Every value as ``{group: {field: value}}``."""
        return dataclasses.asdict(self)

    def replace(self, **changes: object) -> Self:
        """Copy with some values changed, by dotted name (``**{'grid.r_max': 60.0}``) or in groups.

        Raises ConfigError if a name is unknown or the changed configuration is invalid.
        """
        nested: dict[str, Any] = self.nested()
        for name, given in changes.items():
            if isinstance(given, Mapping) and not given and name not in nested:
                self.find_spec(name)  # no group is called so
        for name, value in flatten(changes).items():
            group_name, field_name = self.find_spec(name).name.split('.')
            nested[group_name][field_name] = value
        return type(self)(**nested)

    @classmethod
    def from_yaml(cls, path: str | Path, base: Self | None = None) -> Self:
        """Read a YAML file: ROS form (``/**: ros__parameters:``) or bare groups.

        Parameters not in the file are as in `base`, by default the defaults. Raises ConfigError,
        with the path, if the file cannot be read, a name is unknown, or a value is not accepted.
        """
        try:
            values = parameters_of(read_yaml(path))
            if not values:
                LOGGER.warning('%s: no parameters of the segmentation in it', path)
            return (base or cls()).replace(**values)
        except ConfigError as error:
            raise ConfigError(f'{path}: {error}') from error

    @classmethod
    def problems_of_file(cls, path: str | Path) -> list[str]:
        """Everything wrong with a parameter file, one line each; none if it can be used.

        Rules between parameters are checked where each value by itself is accepted.
        """
        problems: list[str] = []
        try:
            for _, values in nodes_of(read_yaml(path)):
                n_before = len(problems)
                for name, value in values.items():
                    try:
                        cls.find_spec(name).check(value)
                    except ConfigError as error:
                        problems.append(str(error))
                if len(problems) == n_before:
                    cls().replace(**values)
        except ConfigError as error:
            problems.append(str(error))
        return [*dict.fromkeys(problems)]

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
    """Reads values as ROS's own parser, rcl_yaml_param_parser, does: of tags it heeds !!str only.

    YAML 1.1 has more: ``1_80`` and ``1:20`` are integers there, ``2026-11-28`` is a date.
    """

    bool_values: ClassVar[Any] = {**yaml.SafeLoader.bool_values, 'y': True, 'n': False}

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        """Refuse aliases, as ROS does: a kilobyte of them can stand for gigabytes."""
        if self.check_event(yaml.AliasEvent):
            raise ConfigError(f'line {self.line + 1}: aliases (*name) are not accepted')
        node = super().compose_node(parent, index)
        if node is not None and node.tag != self.DEFAULT_SCALAR_TAG:
            is_plain = getattr(node, 'style', None) not in ('"', "'")
            node.tag = self.resolve(type(node), node.value, (is_plain, False))  # type: ignore
        return node

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        """Refuse a key that is there twice; the last would win silently."""
        for name, n_times in Counter(str(key.value) for key, _ in node.value).items():
            if n_times > 1:
                raise ConfigError(f'{name}: given twice, line {node.start_mark.line + 1}')
        return super().construct_mapping(node, deep)

    def construct_yaml_float(self, node: yaml.ScalarNode) -> float:
        """Read also what C reads as hexadecimal, such as 0x1p-3."""
        is_hex = 'x' in node.value.lower()
        return float.fromhex(node.value) if is_hex else super().construct_yaml_float(node)


_HEX = r'0[xX]([0-9a-fA-F]+\.?[0-9a-fA-F]*|\.[0-9a-fA-F]+)([pP][-+]?[0-9]+)?'
_WORDS = {
    'null': '',
    'bool': '|'.join(f'{w}|{w.capitalize()}|{w.upper()}' for w in _Loader.bool_values),
    'int': '[-+]?(0[0-7]*|[1-9][0-9]{,17}|0x[0-9a-fA-F]{1,15})',
    'float': rf'[-+]?(([0-9]+\.?[0-9]*|\.[0-9]+)([eE][-+]?[0-9]+)?|{_HEX}|\.?(?i:inf|nan))',
}
_Loader.yaml_implicit_resolvers = {}
for _kind, _form in _WORDS.items():
    _Loader.add_implicit_resolver(f'tag:yaml.org,2002:{_kind}', re.compile(rf'({_form})\Z'), None)
_Loader.add_constructor('tag:yaml.org,2002:float', _Loader.construct_yaml_float)


def read_yaml(path: str | Path) -> object:
    """Read a YAML file as `load_yaml`; ConfigError also if it cannot be read or is too large."""
    try:
        with open(path, encoding='utf-8') as file:
            text = file.read(MAX_LENGTH + 1)
    except OSError as error:
        raise ConfigError(reason_of(error)) from error
    except UnicodeDecodeError as error:
        raise ConfigError('not a text file') from error
    if len(text) > MAX_LENGTH:
        raise ConfigError(f'too large for a parameter file, accepted are {MAX_LENGTH} characters')
    return load_yaml(text)


def load_yaml(text: str) -> object:
    """Read YAML, with the values that ROS reads.

    Raises ConfigError if it is none, has aliases or a key twice, or cannot be of parameters.
    """
    try:
        return yaml.load(text, Loader=_Loader)
    except ConfigError:
        raise
    except yaml.MarkedYAMLError as error:
        place = f'line {error.problem_mark.line + 1}' if error.problem_mark else ''
        said = ', '.join(filter(None, (error.context, error.problem, place)))
        raise ConfigError(f'not valid YAML: {said}') from error
    except Exception as error:  # of many types: nested too deep, a list as a key, ...
        raise ConfigError(f'not valid YAML: {in_one_line(error)}') from error


def is_ours(node: str) -> bool:
    """Whether commands, and a node of our name, use the values of a key; '' is of bare groups."""
    return node.split('/')[-1] in ('', '*', '**', NODE_NAME)


def parameters_of(document: object) -> dict[str, object]:
    """Return the values of a parameter file that commands use; ConfigError if of several nodes."""
    (node, values), *others = nodes_of(document)
    if others or not is_ours(node):
        names = ', '.join([node, *(other for other, _ in others)])
        wanted = f'{ROS_NODE_KEY} or {NODE_NAME} alone'
        raise ConfigError(f'parameters of node {names}; must be of {wanted}')
    return values


def nodes_of(document: object) -> list[tuple[str, dict[str, object]]]:
    """Return the nodes that a parameter file is for, and the values of each, unchecked.

    Its keys of any node are for each of ours; bare groups are of the node ''. ConfigError if it
    cannot be a parameter file, or our node would not start with it.
    """
    document = {} if document is None else document
    if not isinstance(document, Mapping):
        raise ConfigError('must be a mapping of parameter groups')
    sections = sections_of(document)
    if not sections:
        if any(str(key).startswith('/') for key in document):
            raise ConfigError(f'no mapping {ROS_PARAMETERS_KEY} below the node name')
        return [('', flatten(document))]
    ours = [section for section in sections if is_ours(section[0])] or sections
    names = dict.fromkeys(node for node, _ in ours if '*' not in node) or [ours[0][0]]
    nodes = []
    for name in names:
        parts = [values for node, values in ours if node == name or '*' in node]
        given = {key: value for part in parts for key, value in part.items()}
        if not isinstance(given.get('use_sim_time', False), bool):
            raise ConfigError(f'use_sim_time = {given["use_sim_time"]!r}: must be true or false')
        if empty := [key for key, value in given.items() if value == []]:
            raise ConfigError(f'{empty[0]} = []: {EMPTY_LIST}')
        own = {key: given[key] for key in given if not key.startswith(OF_EVERY_NODE)}
        nodes.append((name, own))
    return nodes


def sections_of(document: object, above: str = '') -> list[tuple[str, dict[str, object]]]:
    """Return the keys of nodes, with nested namespaces, and the values of each; none if bare.

    ConfigError where ROS cannot read a section.
    """
    found: list[tuple[str, dict[str, object]]] = []
    groups: Mapping[object, Any] = document if isinstance(document, Mapping) else {}
    for key, below in groups.items():
        if key != ROS_PARAMETERS_KEY:
            found += sections_of(below, f'{above}/{key}' if above else str(key))
            continue
        if not isinstance(below, Mapping):
            raise ConfigError(f'no mapping {ROS_PARAMETERS_KEY} below the node name')
        if len(groups) > 1:
            raise ConfigError(f'values beside {ROS_PARAMETERS_KEY}, which ROS refuses')
        values = flatten(below)
        found.append((above, values))
        for name, value in values.items():
            kinds = [type(one) for one in value] if isinstance(value, list) else []
            if list in kinds or len({*kinds}) > 1:
                hint = f': write {value[kinds.index(int)]}.0' if {*kinds} == {int, float} else ''
                raise ConfigError(f'{name} = {value}: must have one type for ROS{hint}')
    return found


def flatten(tree: Mapping[str, Any], prefix: str = '') -> dict[str, Any]:
    """Return the values of nested groups by dotted names; ConfigError if one is given twice."""
    values: dict[str, Any] = {}
    for key, value in tree.items():
        name = f'{prefix}{key}'
        found = flatten(value, f'{name}.') if isinstance(value, Mapping) else {name: value}
        if twice := values.keys() & found.keys():
            raise ConfigError(f'{min(twice)}: given twice')
        values |= found
    if len(values) > MAX_VALUES:
        raise ConfigError(f'more than {MAX_VALUES} values, too many for a parameter file')
    return values
