"""The one declaration of every parameter.

YAML files, ROS parameter descriptors, command-line ``--set`` options and the
README table are derived from the dataclasses below.
"""

from __future__ import annotations

import dataclasses
import difflib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from gp_ground_seg.errors import ConfigError
from gp_ground_seg.parameters.schema import AUTO, ParameterSpec, ParameterValue, parameter
from gp_ground_seg.parameters.yaml_io import read_parameters


@dataclass(frozen=True)
class SensorConfig:
    """Where the sensor is; auto = found out from every scan (docs/pose.md)."""

    height: float | Literal['auto'] = parameter(
        AUTO,
        'height of the sensor above the ground it stands on',
        unit='m',
        low=0.05,
        high=20.0,
        auto=True,
        basic=True,
    )
    roll: float | Literal['auto'] = parameter(
        AUTO,
        'roll of the sensor, positive with its left side up; auto = none unless it is clear',
        unit='rad',
        low=-3.15,
        high=3.15,
        auto=True,
        basic=True,
    )
    pitch: float | Literal['auto'] = parameter(
        AUTO,
        'pitch of the sensor, positive with its nose down; auto = none unless it is clear',
        unit='rad',
        low=-1.58,
        high=1.58,
        auto=True,
        basic=True,
    )


@dataclass(frozen=True)
class FrameConfig:
    """Where the tilt of the sensor is taken from; the node only."""

    level: str = parameter(
        'sensor',
        'where the tilt of the sensor is taken from: sensor.roll and sensor.pitch, or TF',
        choices=('sensor', 'tf'),
        basic=True,
    )
    base: str = parameter(
        'base_link',
        'frame that is level to TF, with frame.level = tf',
        basic=True,
    )


@dataclass(frozen=True)
class GridConfig:
    """Radial grid map."""

    n_segments: int = parameter(
        180,
        'angular segments of the radial grid',
        symbol='M',
        low=4,
        high=2048,
        basic=True,
    )
    n_bins: int = parameter(80, 'radial bins of each segment', symbol='N', low=4, high=1024)
    r_min: float = parameter(
        2.0,
        'horizontal range where the first bin starts; nearer points belong to that bin',
        unit='m',
        low=0.0,
        high=50.0,
    )
    r_max: float = parameter(
        90.0,
        'horizontal range where the last bin ends; beyond it there is no model',
        unit='m',
        low=1.0,
        high=500.0,
        basic=True,
    )
    bin_growth: float = parameter(
        1.5,
        'exponent of the bin edges over range: 1 = equal bins, more = finer bins near the sensor',
        low=1.0,
        high=4.0,
    )


@dataclass(frozen=True)
class LinesConfig:
    """Line extraction over the ground candidates of a segment."""

    slope_tolerance: float = parameter(
        0.1,
        'change of slope that ends a line',
        unit='rad',
        symbol='zeta_m',
        low=0.001,
        high=1.0,
    )
    offset_tolerance: float = parameter(
        0.15,
        "change of the line's height at the new point that ends a line",
        unit='m',
        symbol='zeta_b',
        low=0.005,
        high=5.0,
    )
    max_line_distance: float = parameter(
        0.10,
        'distance of a point to the line that ends it',
        unit='m',
        symbol='delta',
        low=0.005,
        high=5.0,
    )
    max_gap: float = parameter(
        1.5,
        'horizontal gap to the next candidate that ends a line, next to the sensor',
        unit='m',
        low=0.05,
        high=50.0,
    )
    max_gap_growth: float = parameter(
        0.15,
        'growth of the largest gap with range',
        unit='m/m',
        low=0.0,
        high=2.0,
    )
    max_density_ratio: float = parameter(
        8.0,
        'ratio of the vertical densities of two successive bins that ends a line',
        low=1.0,
        high=1e6,
    )
    min_density_extent: float = parameter(
        0.05,
        'least height of a bin in its vertical density',
        unit='m',
        low=0.001,
        high=1.0,
    )
    error_ratio: float = parameter(
        1.0,
        'variance of the height error over that of the range error in the line regression',
        symbol='lambda',
        low=0.0001,
        high=1e6,
    )


@dataclass(frozen=True)
class LengthScaleConfig:
    """Length-scale of the observation process along a segment."""

    model: str = parameter(
        'latent',
        'where the length-scales come from: the latent process, the slopes of the extracted '
        'lines, or one constant',
        choices=('latent', 'line_gradient', 'constant'),
    )
    constant: float = parameter(
        10.0, 'length-scale of the constant model', unit='m', low=0.05, high=200.0
    )
    gradient_gain: float = parameter(
        2.0,
        'a in l = a log(1/|slope|)',
        unit='m',
        symbol='a',
        low=0.05,
        high=100.0,
    )
    flat_gradient: float = parameter(
        0.1,
        'slope below which a line counts as flat',
        symbol='g_def',
        low=0.0001,
        high=0.9,
    )
    min: float = parameter(1.0, 'smallest length-scale', unit='m', low=0.05, high=200.0)
    max: float = parameter(50.0, 'largest length-scale', unit='m', low=0.05, high=500.0)


@dataclass(frozen=True)
class ObservationConfig:
    """Hyper-parameters of the observation process GP_z."""

    sigma_f: float = parameter(
        0.3,
        'prior standard deviation of the ground height about its mean line',
        unit='m',
        symbol='sigma_f',
        low=0.001,
        high=10.0,
    )
    sigma_n: float = parameter(
        0.05,
        'standard deviation of the height noise of a ground candidate',
        unit='m',
        symbol='sigma_n',
        low=0.001,
        high=5.0,
    )
    slope_std: float = parameter(
        0.05,
        "prior standard deviation of the mean line's slope; 0 = a level mean",
        low=0.0,
        high=2.0,
    )


@dataclass(frozen=True)
class LatentConfig:
    """Latent process GP_l over log length-scale, and its pseudo-inputs."""

    sigma_f_bar: float = parameter(
        0.9,
        'prior standard deviation of the log length-scale about its mean',
        symbol='sigma_f_bar',
        low=0.01,
        high=100.0,
    )
    sigma_l_bar: float = parameter(
        2.0,
        'length-scale of the latent process',
        unit='m',
        symbol='sigma_l_bar',
        low=0.1,
        high=500.0,
    )
    sigma_n_bar: float = parameter(
        0.25,
        'standard deviation of the noise of the log length-scale',
        symbol='sigma_n_bar',
        low=0.01,
        high=100.0,
    )
    candidates_per_pseudo_input: float = parameter(
        3.0,
        'ground candidates of a line for each pseudo-input: more = faster, less precise',
        low=1.0,
        high=100.0,
    )
    sloped_gradient: float = parameter(
        0.1, 'slope from which a line counts as sloped', low=0.001, high=10.0
    )
    steep_gradient: float = parameter(
        0.4, 'slope from which a line counts as steep', low=0.001, high=100.0
    )
    medium_extent: float = parameter(
        1.5, 'extent from which a line counts as medium', unit='m', low=0.01, high=200.0
    )
    long_extent: float = parameter(
        5.0, 'extent from which a line counts as long', unit='m', low=0.01, high=200.0
    )


@dataclass(frozen=True)
class GrowthConfig:
    """Iterative growth of the inlier set (outlier rejection)."""

    seed_range: float = parameter(
        20.0,
        'horizontal range within which low candidates start the inlier set',
        unit='m',
        low=0.5,
        high=200.0,
    )
    seed_height_tolerance: float = parameter(
        0.45,
        'largest height of a seed above or below the expected ground',
        unit='m',
        low=0.01,
        high=5.0,
        basic=True,
    )
    max_std: float = parameter(
        0.4,
        'predictive standard deviation above which a candidate has to wait',
        unit='m',
        low=0.001,
        high=10.0,
    )
    max_standardised_residual: float = parameter(
        2.0,
        'residual over predictive standard deviation above which a candidate is an outlier',
        low=0.1,
        high=50.0,
    )
    max_standardised_depth: float = parameter(
        7.0,
        'the same for a candidate below the prediction; obstacles lie only above',
        low=0.1,
        high=200.0,
    )
    max_line_slope: float = parameter(
        1.0,
        'slope of a line of candidates up to which those that continue it from inliers join',
        low=0.0,
        high=10.0,
    )
    min_line_size: int = parameter(
        4, 'candidates that such a line needs at least', low=2, high=10000
    )
    min_bend_extent: float = parameter(
        10.0,
        'length of a line from which on it joins where the line before it bends into it: longer '
        'than what stands on the ground',
        unit='m',
        low=0.1,
        high=1000.0,
    )


@dataclass(frozen=True)
class SurfaceConfig:
    """From the segments' surfaces to the surface of the frame."""

    n_neighbours: int = parameter(
        2,
        "segments on either side whose surfaces are fused with a segment's own; 0 = none",
        low=0,
        high=16,
    )


@dataclass(frozen=True)
class FacesConfig:
    """Upright faces, whose feet lie within the tolerance of ground."""

    cell_size: float = parameter(
        0.5,
        'side of the square tiles whose returns are judged together',
        unit='m',
        low=0.05,
        high=10.0,
    )
    min_height: float = parameter(
        0.5,
        'height of the returns of a tile above its lowest from which it may be a face',
        unit='m',
        low=0.05,
        high=100.0,
    )
    max_normal_z: float = parameter(
        0.45,
        'vertical part of the unit normal up to which the returns of a tile are an upright face',
        low=0.0,
        high=1.0,
    )
    tolerance: float = parameter(
        0.1,
        'largest height of a ground point above the foot of a face',
        unit='m',
        low=0.001,
        high=100.0,
    )
    max_foot_distance: float = parameter(
        0.06,
        'distance (root mean square) of the lowest returns of a face from its plane up to which '
        'they are its own and no ground before it is seen; 0 = some is always seen',
        unit='m',
        low=0.0,
        high=10.0,
    )
    max_foot_density: float = parameter(
        3.0,
        'density over height of those returns, in multiples of that above them, up to which '
        "they are the face's own: ground would pile up at one height",
        low=0.0,
        high=1000.0,
    )


@dataclass(frozen=True)
class LabelConfig:
    """Labels from the distance to the surface."""

    ground_tolerance: float = parameter(
        0.1,
        'largest height of a ground point above a smooth surface',
        unit='m',
        symbol='zeta_g',
        low=0.001,
        high=5.0,
        basic=True,
    )
    roughness_gain: float = parameter(
        3.0,
        'growth of that height in multiples of the local roughness',
        low=0.0,
        high=20.0,
    )
    below_tolerance: float = parameter(
        1.0,
        'largest depth of a ground point below the surface; obstacles lie only above',
        unit='m',
        low=0.001,
        high=50.0,
        basic=True,
    )
    obstacle_tolerance: float = parameter(
        0.05,
        'largest height of a ground point above a smooth surface beside an obstacle (in its bin)',
        unit='m',
        low=0.001,
        high=5.0,
    )
    obstacle_roughness_gain: float = parameter(
        1.0,
        'growth of that height in multiples of the local roughness',
        low=0.0,
        high=20.0,
    )
    obstacle_min_height: float = parameter(
        0.5,
        'height above the surface from which a return is an obstacle however rough the ground',
        unit='m',
        low=0.01,
        high=10.0,
    )
    obstacle_max_height: float = parameter(
        2.0,
        'height above the surface up to which a return shows an obstacle; higher ones overhang',
        unit='m',
        low=0.02,
        high=50.0,
    )


@dataclass(frozen=True)
class LearningConfig:
    """Learning of the hyper-parameters."""

    mode: str = parameter(
        'every_frame',
        'when the hyper-parameters are learned; fixed = never, the values given here are used',
        choices=('every_frame', 'every_k', 'first_frame', 'fixed'),
        basic=True,
    )
    period: int = parameter(
        10, 'frames from one learning to the next in the mode every_k', low=1, high=10000
    )
    scope: str = parameter(
        'frame',
        'frame = one set of hyper-parameters for the whole frame; segment = one for each '
        'segment (slow, for comparison)',
        choices=('frame', 'segment'),
    )
    segment_step: int = parameter(
        3,
        'for the scope frame: every how many segments one speaks for the frame; neighbouring '
        'segments see much the same ground',
        low=1,
        high=60,
    )
    objective: str = parameter(
        'map',
        'map = likelihood of the heights and priors; paper = as printed, which has no upper bound',
        choices=('map', 'paper'),
    )
    warm_start: bool = parameter(
        False,
        'start from the frame before: fewer evaluations, but the labels depend on the past',
    )
    max_evaluations: int = parameter(
        4, 'evaluations of the objective per frame; the best so far is used', low=1, high=1000
    )
    max_time: float = parameter(
        0.0,
        'time for the learning of a frame, after which the best so far is used; 0 = no limit; '
        'the labels then depend on the speed of the machine',
        unit='s',
        low=0.0,
        high=60.0,
    )
    prior_std: float = parameter(
        1.0,
        'standard deviation of the log-normal priors about the values given here',
        low=0.01,
        high=10.0,
    )
    bound_factor: float = parameter(
        20.0,
        'largest factor by which a hyper-parameter may leave the value given here',
        low=1.01,
        high=1e6,
    )
    fixed: str = parameter(
        'none',
        'hyper-parameters that are not learned',
        choices=('none', 'sigma_f_bar', 'latent', 'length_scales'),
    )


@dataclass(frozen=True)
class RuntimeConfig:
    """How the work is done; nothing here changes a label."""

    n_threads: int = parameter(
        0,
        'threads of the compiled code; 0 = all cores, at most 4',
        low=0,
        high=256,
        basic=True,
    )
    backend: str = parameter(
        'auto',
        'auto = compiled code where numba is installed, numpy otherwise; or either by name',
        choices=('auto', 'numba', 'numpy'),
    )


@dataclass(frozen=True)
class DiagnosticsConfig:
    """What the node says of itself on /diagnostics."""

    period: float = parameter(
        1.0, 'time between two diagnostics messages', unit='s', low=0.1, high=60.0
    )
    stale_after: float = parameter(
        2.0,
        'time without any cloud after which the input is reported STALE',
        unit='s',
        low=0.1,
        high=600.0,
    )
    max_latency: float = parameter(
        0.1,
        'median time from arrival to publication above which processing is reported WARN',
        unit='s',
        low=0.001,
        high=10.0,
    )
    max_load: float = parameter(
        0.95,
        'median time per cloud, over the time between two clouds sent, above which processing '
        'is reported WARN',
        low=0.01,
        high=100.0,
    )
    max_drop_ratio: float = parameter(
        0.0,
        'share of the clouds sent since the last report that may be dropped before processing is '
        'reported WARN',
        low=0.0,
        high=1.0,
    )
    max_refused_ratio: float = parameter(
        0.0,
        'share of the clouds since the last report that may be refused with a WARN; above it, and '
        'always when all are, the input is reported ERROR',
        low=0.0,
        high=1.0,
    )
    min_quality: float = parameter(
        0.2,
        'frame_quality of the newest cloud below which the model is reported WARN',
        low=0.0,
        high=1.0,
    )
    recover_after: float = parameter(
        3.0,
        'time that a level stays reported after its cause has gone',
        unit='s',
        low=0.0,
        high=600.0,
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
    frame: FrameConfig = FrameConfig()
    grid: GridConfig = GridConfig()
    lines: LinesConfig = LinesConfig()
    length_scale: LengthScaleConfig = LengthScaleConfig()
    observation: ObservationConfig = ObservationConfig()
    latent: LatentConfig = LatentConfig()
    growth: GrowthConfig = GrowthConfig()
    surface: SurfaceConfig = SurfaceConfig()
    faces: FacesConfig = FacesConfig()
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
    def from_yaml(cls, path: str | Path, base: Config | None = None) -> Config:
        """Read a YAML file: ROS form (``/**: ros__parameters:``) or bare groups.

        Parameters not in the file are as in `base`, by default the defaults.

        Raises
        ------
        ConfigError
            If the file cannot be read or parsed, a name is unknown, or a value
            is not accepted. The message starts with the path.
        """
        try:
            return (base or cls()).replace(**read_parameters(path).values)
        except ConfigError as error:
            raise ConfigError(f'{path}: {error}') from error


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
                    type=float if entry.metadata['auto'] else type(default),
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
