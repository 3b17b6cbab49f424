"""The one declaration of every parameter.

YAML files, ROS parameter descriptors, command-line ``--set`` options and the
README table are derived from the dataclasses below.
"""

from __future__ import annotations

import dataclasses
import difflib
import numbers
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from gp_ground_seg.errors import ConfigError

ParameterValue = bool | int | float | str

ROS_NODE_KEY = '/**'
ROS_PARAMETERS_KEY = 'ros__parameters'


@dataclass(frozen=True)
class ParameterSpec:
    """What is declared of one parameter.

    Attributes
    ----------
    name : str
        Dotted name, ``group.field``.
    type : type
        ``bool``, ``int``, ``float`` or ``str``.
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
        Accepted values of a string; empty for other types.
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

    @property
    def accepted(self) -> str:
        """Accepted values in words."""
        if self.choices:
            return 'one of ' + ', '.join(self.choices)
        if self.type is bool:
            return 'true or false'
        unit = f' {self.unit}' if self.unit else ''
        kind = 'an integer' if self.type is int else 'a number'
        return f'{kind} in [{self.minimum:g}, {self.maximum:g}]{unit}'

    def check(self, value: object) -> ParameterValue:
        """Return `value` in the declared type.

        Raises
        ------
        ConfigError
            If the type is wrong or the value is out of range.
        """
        if self.type is bool:
            if isinstance(value, bool):
                return value
        elif self.type is str:
            if isinstance(value, str) and value in self.choices:
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


def _parameter(
    default: ParameterValue,
    description: str,
    *,
    unit: str = '',
    symbol: str = '',
    low: float | None = None,
    high: float | None = None,
    choices: tuple[str, ...] = (),
) -> Any:
    metadata = {
        'description': description,
        'unit': unit,
        'symbol': symbol,
        'minimum': low,
        'maximum': high,
        'choices': choices,
    }
    return field(default=default, metadata=metadata)


@dataclass(frozen=True)
class SensorConfig:
    """Where the sensor is."""

    height: float = _parameter(
        1.73,
        'height of the sensor above the ground it stands on',
        unit='m',
        low=0.05,
        high=20.0,
    )


@dataclass(frozen=True)
class GridConfig:
    """Radial grid map."""

    n_segments: int = _parameter(
        180, 'angular segments of the radial grid', symbol='M', low=4, high=2048
    )
    n_bins: int = _parameter(80, 'radial bins of each segment', symbol='N', low=4, high=1024)
    r_min: float = _parameter(
        2.0,
        'horizontal range where the first bin starts; nearer points belong to that bin',
        unit='m',
        low=0.0,
        high=50.0,
    )
    r_max: float = _parameter(
        90.0,
        'horizontal range where the last bin ends; beyond it there is no model',
        unit='m',
        low=1.0,
        high=500.0,
    )
    bin_growth: float = _parameter(
        1.5,
        'exponent of the bin edges over range: 1 = equal bins, more = finer bins near the sensor',
        low=1.0,
        high=4.0,
    )


@dataclass(frozen=True)
class LinesConfig:
    """Line extraction over the ground candidates of a segment."""

    slope_tolerance: float = _parameter(
        0.1,
        'change of slope that ends a line',
        unit='rad',
        symbol='zeta_m',
        low=0.001,
        high=1.0,
    )
    offset_tolerance: float = _parameter(
        0.15,
        "change of the line's height at the new point that ends a line",
        unit='m',
        symbol='zeta_b',
        low=0.005,
        high=5.0,
    )
    max_line_distance: float = _parameter(
        0.10,
        'distance of a point to the line that ends it',
        unit='m',
        symbol='delta',
        low=0.005,
        high=5.0,
    )
    max_gap: float = _parameter(
        1.5,
        'horizontal gap to the next candidate that ends a line, next to the sensor',
        unit='m',
        low=0.05,
        high=50.0,
    )
    max_gap_growth: float = _parameter(
        0.15,
        'growth of the largest gap with range',
        unit='m/m',
        low=0.0,
        high=2.0,
    )
    max_density_ratio: float = _parameter(
        8.0,
        'ratio of the vertical densities of two successive bins that ends a line',
        low=1.0,
        high=1e6,
    )
    min_density_extent: float = _parameter(
        0.05,
        'least height of a bin in its vertical density',
        unit='m',
        low=0.001,
        high=1.0,
    )
    error_ratio: float = _parameter(
        1.0,
        'variance of the height error over that of the range error in the line regression',
        symbol='lambda',
        low=0.0001,
        high=1e6,
    )


@dataclass(frozen=True)
class LengthScaleConfig:
    """Length-scale of the observation process along a segment."""

    model: str = _parameter(
        'latent',
        'where the length-scales come from: the latent process, the slopes of the extracted '
        'lines, or one constant',
        choices=('latent', 'line_gradient', 'constant'),
    )
    constant: float = _parameter(
        10.0, 'length-scale of the constant model', unit='m', low=0.05, high=200.0
    )
    gradient_gain: float = _parameter(
        2.0,
        'a in l = a log(1/|slope|)',
        unit='m',
        symbol='a',
        low=0.05,
        high=100.0,
    )
    flat_gradient: float = _parameter(
        0.1,
        'slope below which a line counts as flat',
        symbol='g_def',
        low=0.0001,
        high=0.9,
    )
    min: float = _parameter(1.0, 'smallest length-scale', unit='m', low=0.05, high=200.0)
    max: float = _parameter(50.0, 'largest length-scale', unit='m', low=0.05, high=500.0)


@dataclass(frozen=True)
class ObservationConfig:
    """Hyper-parameters of the observation process GP_z."""

    sigma_f: float = _parameter(
        0.3,
        'prior standard deviation of the ground height about its mean line',
        unit='m',
        symbol='sigma_f',
        low=0.001,
        high=10.0,
    )
    sigma_n: float = _parameter(
        0.04,
        'standard deviation of the height noise of a ground candidate',
        unit='m',
        symbol='sigma_n',
        low=0.001,
        high=5.0,
    )
    slope_std: float = _parameter(
        0.05,
        "prior standard deviation of the mean line's slope; 0 = a level mean",
        low=0.0,
        high=2.0,
    )


@dataclass(frozen=True)
class LatentConfig:
    """Latent process GP_l over log length-scale, and its pseudo-inputs."""

    sigma_f_bar: float = _parameter(
        0.9,
        'prior standard deviation of the log length-scale about its mean',
        symbol='sigma_f_bar',
        low=0.01,
        high=100.0,
    )
    sigma_l_bar: float = _parameter(
        2.0,
        'length-scale of the latent process',
        unit='m',
        symbol='sigma_l_bar',
        low=0.1,
        high=500.0,
    )
    sigma_n_bar: float = _parameter(
        0.25,
        'standard deviation of the noise of the log length-scale',
        symbol='sigma_n_bar',
        low=0.01,
        high=100.0,
    )
    candidates_per_pseudo_input: float = _parameter(
        3.0,
        'ground candidates of a line for each pseudo-input: more = faster, less precise',
        low=1.0,
        high=100.0,
    )
    sloped_gradient: float = _parameter(
        0.1, 'slope from which a line counts as sloped', low=0.001, high=10.0
    )
    steep_gradient: float = _parameter(
        0.4, 'slope from which a line counts as steep', low=0.001, high=100.0
    )
    medium_extent: float = _parameter(
        1.5, 'extent from which a line counts as medium', unit='m', low=0.01, high=200.0
    )
    long_extent: float = _parameter(
        5.0, 'extent from which a line counts as long', unit='m', low=0.01, high=200.0
    )


@dataclass(frozen=True)
class GrowthConfig:
    """Iterative growth of the inlier set (outlier rejection)."""

    seed_range: float = _parameter(
        20.0,
        'horizontal range within which low candidates start the inlier set',
        unit='m',
        low=0.5,
        high=200.0,
    )
    seed_height_tolerance: float = _parameter(
        0.45,
        'largest height of a seed above or below the expected ground',
        unit='m',
        low=0.01,
        high=5.0,
    )
    max_std: float = _parameter(
        0.4,
        'predictive standard deviation above which a candidate has to wait',
        unit='m',
        low=0.001,
        high=10.0,
    )
    max_standardised_residual: float = _parameter(
        2.2,
        'residual over predictive standard deviation above which a candidate is an outlier',
        low=0.1,
        high=50.0,
    )


@dataclass(frozen=True)
class SurfaceConfig:
    """From the segments' surfaces to the surface of the frame."""

    n_neighbours: int = _parameter(
        2,
        "segments on either side whose surfaces are fused with a segment's own; 0 = none",
        low=0,
        high=16,
    )


@dataclass(frozen=True)
class LabelConfig:
    """Labels from the distance to the surface."""

    ground_tolerance: float = _parameter(
        0.2,
        'largest distance of a ground point from the surface, above or below',
        unit='m',
        symbol='zeta_g',
        low=0.001,
        high=5.0,
    )
    slope_allowance: float = _parameter(
        1.0,
        'widening of the tolerance in multiples of the rise of the surface across the bin',
        low=0.0,
        high=10.0,
    )
    obstacle_tolerance: float = _parameter(
        0.1,
        'largest height of a ground point above the surface in a bin that an obstacle stands in',
        unit='m',
        low=0.001,
        high=5.0,
    )
    obstacle_min_height: float = _parameter(
        0.5,
        'height above the surface from which a return shows that an obstacle stands in its bin',
        unit='m',
        low=0.01,
        high=10.0,
    )
    obstacle_max_height: float = _parameter(
        2.0,
        'height above the surface up to which a return shows that; higher ones overhang',
        unit='m',
        low=0.02,
        high=50.0,
    )


@dataclass(frozen=True)
class LearningConfig:
    """Learning of the hyper-parameters."""

    mode: str = _parameter(
        'every_frame',
        'when the hyper-parameters are learned; fixed = never, the values given here are used',
        choices=('every_frame', 'every_k', 'first_frame', 'fixed'),
    )
    period: int = _parameter(
        10, 'frames from one learning to the next in the mode every_k', low=1, high=10000
    )
    scope: str = _parameter(
        'frame',
        'frame = one set of hyper-parameters for the whole frame; segment = one for each '
        'segment (slow, for comparison)',
        choices=('frame', 'segment'),
    )
    objective: str = _parameter(
        'map',
        'map = likelihood of the heights and priors; paper = as printed, which has no upper bound',
        choices=('map', 'paper'),
    )
    warm_start: bool = _parameter(
        False,
        'start from the frame before: fewer evaluations, but the labels depend on the past',
    )
    max_evaluations: int = _parameter(
        5, 'evaluations of the objective per frame; the best so far is used', low=1, high=1000
    )
    max_time: float = _parameter(
        0.0,
        'time for the learning of a frame, after which the best so far is used; 0 = no limit; '
        'the labels then depend on the speed of the machine',
        unit='s',
        low=0.0,
        high=60.0,
    )
    prior_std: float = _parameter(
        1.0,
        'standard deviation of the log-normal priors about the values given here',
        low=0.01,
        high=10.0,
    )
    bound_factor: float = _parameter(
        20.0,
        'largest factor by which a hyper-parameter may leave the value given here',
        low=1.01,
        high=1e6,
    )
    fixed: str = _parameter(
        'none',
        'hyper-parameters that are not learned',
        choices=('none', 'sigma_f_bar', 'latent', 'length_scales'),
    )


@dataclass(frozen=True)
class RuntimeConfig:
    """How the work is done; nothing here changes a label."""

    n_threads: int = _parameter(0, 'threads of the compiled code; 0 = all cores', low=0, high=256)
    backend: str = _parameter(
        'auto',
        'auto = compiled code where numba is installed, numpy otherwise; or either by name',
        choices=('auto', 'numba', 'numpy'),
    )


@dataclass(frozen=True)
class DiagnosticsConfig:
    """What the node says of itself on /diagnostics."""

    period: float = _parameter(
        1.0, 'time between two diagnostics messages', unit='s', low=0.1, high=60.0
    )
    stale_after: float = _parameter(
        2.0,
        'time without any cloud after which the input is reported STALE',
        unit='s',
        low=0.1,
        high=600.0,
    )
    max_latency: float = _parameter(
        0.1,
        'median time from arrival to publication above which processing is reported WARN',
        unit='s',
        low=0.001,
        high=10.0,
    )


@dataclass(frozen=True)
class Config:
    """All parameters, immutable and valid by construction.

    Raises
    ------
    ConfigError
        If a value has the wrong type, is out of range, or contradicts another.
    """

    sensor: SensorConfig = SensorConfig()
    grid: GridConfig = GridConfig()
    lines: LinesConfig = LinesConfig()
    length_scale: LengthScaleConfig = LengthScaleConfig()
    observation: ObservationConfig = ObservationConfig()
    latent: LatentConfig = LatentConfig()
    growth: GrowthConfig = GrowthConfig()
    surface: SurfaceConfig = SurfaceConfig()
    label: LabelConfig = LabelConfig()
    learning: LearningConfig = LearningConfig()
    runtime: RuntimeConfig = RuntimeConfig()
    diagnostics: DiagnosticsConfig = DiagnosticsConfig()

    def __post_init__(self) -> None:
        """Check every value, then the rules between values."""
        checked = {spec.name: spec.check(self[spec.name]) for spec in parameter_specs()}
        for group_name, values in _nest(checked).items():
            # A whole number given for a float becomes one, in a group of our own.
            group = dataclasses.replace(getattr(self, group_name), **values)
            object.__setattr__(self, group_name, group)
        _require_order(self, 'grid.r_min', 'grid.r_max')
        _require_order(self, 'length_scale.min', 'length_scale.max')
        _require_order(self, 'latent.sloped_gradient', 'latent.steep_gradient')
        _require_order(self, 'latent.medium_extent', 'latent.long_extent')
        _require_order(self, 'label.obstacle_min_height', 'label.obstacle_max_height')
        if 2 * self.surface.n_neighbours >= self.grid.n_segments:
            raise ConfigError(
                f'surface.n_neighbours = {self.surface.n_neighbours}: must be below half of '
                f'grid.n_segments = {self.grid.n_segments}'
            )

    def __getitem__(self, name: str) -> ParameterValue:
        """Value of the parameter with the dotted `name`."""
        spec = find_spec(name)
        group_name, field_name = spec.name.split('.')
        value: ParameterValue = getattr(getattr(self, group_name), field_name)
        return value

    def flat(self) -> dict[str, ParameterValue]:
        """Every value by its dotted name, in order of declaration."""
        return {spec.name: self[spec.name] for spec in parameter_specs()}

    def nested(self) -> dict[str, dict[str, ParameterValue]]:
        """Every value as ``{group: {field: value}}``."""
        return _nest(self.flat())

    def replace(self, **changes: object) -> Config:
        """Copy with some values changed.

        Parameters
        ----------
        **changes
            Dotted name -> value, as in
            ``config.replace(**{'label.ground_tolerance': 0.15})``.

        Raises
        ------
        ConfigError
            If a name is unknown or the changed configuration is invalid.
        """
        checked = {name: find_spec(name).check(value) for name, value in changes.items()}
        groups: dict[str, Any] = {
            group_name: dataclasses.replace(getattr(self, group_name), **values)
            for group_name, values in _nest(checked).items()
        }
        return dataclasses.replace(self, **groups)

    @classmethod
    def from_flat(cls, values: Mapping[str, object]) -> Config:
        """Defaults with the given dotted names replaced (see `replace`)."""
        return cls().replace(**values)

    @classmethod
    def from_yaml(cls, path: str | Path) -> Config:
        """Read a YAML file: ROS form (``/**: ros__parameters:``) or bare groups.

        Parameters not in the file keep their defaults.

        Raises
        ------
        ConfigError
            If the file cannot be read or parsed, a name is unknown, or a value
            is not accepted. The message starts with the path.
        """
        try:
            document = load_yaml(Path(path).read_text(encoding='utf-8'))
            values: dict[str, object] = {}
            for name, value in _flatten(_unwrap_ros(document)):
                if name in values:
                    raise ConfigError(f'{name}: given twice')
                values[name] = value
            return cls.from_flat(values)
        except OSError as error:
            raise ConfigError(f'{path}: {error.strerror or error}') from error
        except UnicodeDecodeError as error:
            raise ConfigError(f'{path}: not a text file') from error
        except ConfigError as error:
            raise ConfigError(f'{path}: {error}') from error
        except (yaml.YAMLError, ValueError, RecursionError) as error:
            # ValueError: what looks like a date or a number and is none, as in 2011-99-99.
            problem = ' '.join(str(error).split())
            raise ConfigError(f'{path}: not valid YAML: {problem}') from error


class _Loader(yaml.SafeLoader):
    """PyYAML's safe loader, without two of its surprises (see `load_yaml`)."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        """Refuse a key that is there twice; the last would win silently."""
        keys = [key.value for key, _ in node.value if isinstance(key, yaml.ScalarNode)]
        for key in keys:
            if key != '<<' and keys.count(key) > 1:
                raise ConfigError(f'{key}: given twice, from line {node.start_mark.line + 1} on')
        return super().construct_mapping(node, deep)


_Loader.add_implicit_resolver(
    'tag:yaml.org,2002:float',
    re.compile(r'^[-+]?([0-9]+\.?[0-9]*|\.[0-9]+)[eE][-+]?[0-9]+$'),
    list('-+.0123456789'),
)


def load_yaml(text: str) -> object:
    """Read YAML, keys given twice refused and 1e-3 a number as it is to ROS.

    Raises
    ------
    ConfigError
        If a key is given twice.
    yaml.YAMLError
        If it is not YAML.
    """
    document: object = yaml.load(text, Loader=_Loader)
    return document


def _nest(flat: Mapping[str, ParameterValue]) -> dict[str, dict[str, ParameterValue]]:
    """``{'group.field': value}`` as ``{group: {field: value}}``."""
    result: dict[str, dict[str, ParameterValue]] = {}
    for name, value in flat.items():
        group_name, field_name = name.split('.')
        result.setdefault(group_name, {})[field_name] = value
    return result


def _require_order(config: Config, lower: str, upper: str) -> None:
    low, high = config[lower], config[upper]
    assert isinstance(low, float)
    assert isinstance(high, float)
    if not low < high:
        raise ConfigError(f'{lower} = {low:g}: must be below {upper} = {high:g}')


def _unwrap_ros(document: object) -> Mapping[str, object]:
    """Parameters of a ROS parameter file, or of a file of bare groups."""
    if document is None:
        return {}
    if not isinstance(document, Mapping):
        raise ConfigError('must be a mapping of parameter groups')
    if not any(str(key).startswith('/') or _is_ros_node(document[key]) for key in document):
        return document
    if len(document) != 1:
        raise ConfigError(f'parameters of {len(document)} nodes; keep one, keyed {ROS_NODE_KEY}')
    (node,) = document.values()
    if not isinstance(node, Mapping) or not isinstance(node.get(ROS_PARAMETERS_KEY), Mapping):
        raise ConfigError(f'no mapping {ROS_PARAMETERS_KEY} below the node name')
    parameters: Mapping[str, object] = node[ROS_PARAMETERS_KEY]
    # Names that every ROS node has; they say nothing of the segmentation.
    return {
        key: value
        for key, value in parameters.items()
        if key != 'use_sim_time' and not str(key).startswith('qos_overrides')
    }


def _is_ros_node(value: object) -> bool:
    return isinstance(value, Mapping) and ROS_PARAMETERS_KEY in value


def _flatten(tree: Mapping[str, object], prefix: str = '') -> Iterator[tuple[str, object]]:
    for key, value in tree.items():
        name = f'{prefix}{key}'
        if isinstance(value, Mapping):
            yield from _flatten(value, f'{name}.')
        else:
            yield name, value


def _build_specs() -> tuple[ParameterSpec, ...]:
    specs = []
    for group in dataclasses.fields(Config):
        default_group = group.default
        assert dataclasses.is_dataclass(default_group)
        for entry in dataclasses.fields(default_group):
            default: ParameterValue = getattr(default_group, entry.name)
            specs.append(
                ParameterSpec(
                    name=f'{group.name}.{entry.name}',
                    type=type(default),
                    default=default,
                    **entry.metadata,
                )
            )
    return tuple(specs)


_SPECS = _build_specs()
_SPEC_BY_NAME = {spec.name: spec for spec in _SPECS}


def parameter_specs() -> tuple[ParameterSpec, ...]:
    """Return every declared parameter, in order of declaration."""
    return _SPECS


def find_spec(name: str) -> ParameterSpec:
    """Return the declaration of one parameter.

    Raises
    ------
    ConfigError
        If there is none; the message names the nearest one.
    """
    spec = _SPEC_BY_NAME.get(name)
    if spec is None:
        members = [known for known in _SPEC_BY_NAME if known.startswith(f'{name}.')]
        if members:
            raise ConfigError(f'{name!r} is a group of parameters: {", ".join(members)}')
        near = difflib.get_close_matches(name, _SPEC_BY_NAME, n=1, cutoff=0.5)
        hint = f'; did you mean {near[0]}?' if near else ''
        raise ConfigError(f'unknown parameter {name!r}{hint}')
    return spec
