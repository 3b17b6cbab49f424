"""The one declaration of every parameter, and the named sets of them.

YAML files, ROS parameter descriptors, command-line ``--set`` options and the tables of
docs/parameters.md are derived from the dataclasses below. Why not pydantic or
`generate_parameter_library`: one has no ROS descriptors, the other needs ROS to build.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from gp_ground_seg.core.errors import ConfigError
from gp_ground_seg.core.parameters import schema
from gp_ground_seg.core.parameters.schema import ParameterGroup, ParameterGroups, advanced, basic

NO_FRAME = 'none'
SENSOR_HEIGHTS = -5.0, 20.0
"""Lowest and highest origin of a cloud over the ground near it [m]."""
ANY_HEIGHT = 100.0
"""``output.max_height`` that means no limit [m]; ``output.min_height`` has it with a minus."""

# Default, accepted values, description, unit, symbol in the paper. `basic` are those that are
# set for a robot: its sensor and frames, the range and height of what is ground to it, its CPU.
# fmt: off


@dataclass(frozen=True)
class SensorConfig(ParameterGroup):
    """Pose of the sensor; auto = estimated from every scan (docs/pose.md)."""

    height: float | Literal['auto'] = basic(schema.AUTO, SENSOR_HEIGHTS,
        "height of the cloud's origin above the ground; 0 = that of a vehicle frame on the ground",
        'm')
    roll: float | Literal['auto'] = basic(schema.AUTO, (-3.15, 3.15),
        'roll of the sensor, positive with its left side up; auto = none unless it is clear',
        'rad')
    pitch: float | Literal['auto'] = basic(schema.AUTO, (-1.58, 1.58),
        'pitch of the sensor, positive with its nose down; auto = none unless it is clear', 'rad')
    origin_x: float = advanced(0.0, (-50.0, 50.0),
        "sensor position in the cloud's frame, x; needed if clouds are in a vehicle frame", 'm')
    origin_y: float = advanced(0.0, (-50.0, 50.0), 'the same, y', 'm')
    origin_z: float = advanced(0.0, (-50.0, 50.0), 'the same, z', 'm')


@dataclass(frozen=True)
class FrameConfig(ParameterGroup):
    """Source of the tilt and the position of the sensor; the node only."""

    level: str = basic('sensor', ('sensor', 'tf', 'imu'),
        'source of the tilt: sensor = sensor.roll and sensor.pitch, tf = TF, '
        'imu = the orientation on topic imu')
    base: str = basic('base_link', (), 'frame that is level to TF, with frame.level = tf')
    sensor: str = advanced(NO_FRAME, (),
        'frame of the sensor, to look up its position by TF; none = sensor.origin_x, origin_y '
        'and origin_z are used')


@dataclass(frozen=True)
class InputConfig(ParameterGroup):
    """What is taken of the input."""

    crop_box: tuple[float, ...] | Literal['none'] = basic(schema.NO_BOX, (-100.0, 100.0),
        "box about the robot's own body, whose points are no returns: x min, x max, y min, y max, "
        'z min, z max in the frame of the cloud, or of frame.base with frame.level = tf', 'm')
    lazy: bool = advanced(False, (),
        'the node subscribes to clouds only while an output has a subscriber; looked at every '
        'second')


@dataclass(frozen=True)
class OutputConfig(ParameterGroup):
    """The clouds ground and obstacles, scan and occupancy; the node only."""

    min_height: float = advanced(-ANY_HEIGHT, (-ANY_HEIGHT, ANY_HEIGHT),
        'least height over the ground of an obstacle; -100 = any', 'm')
    max_height: float = advanced(ANY_HEIGHT, (-ANY_HEIGHT, ANY_HEIGHT),
        'greatest height over the ground of an obstacle; 100 = any', 'm')
    cell_size: float = advanced(0.1, (0.05, 5.0), 'side of a cell of occupancy', 'm')
    grid_size: float = advanced(40.0, (1.0, 100.0), 'side of the square of occupancy', 'm')
    max_step_down: float = advanced(0.0, (0.0, 10.0),
        'step down between two rings from which scan ends at its edge and occupancy has the edge '
        'as an obstacle, up to 20 m; 0 = none', 'm')


@dataclass(frozen=True)
class GridConfig(ParameterGroup):
    """Radial grid map."""

    n_segments: int = basic(180, (4, 2048), 'angular segments of the radial grid', symbol='M')
    n_bins: int = advanced(80, (4, 1024),
        'radial bins of each segment; if r_min is below 2 m, from there on', symbol='N')
    r_min: float = advanced(2.0, (0.0, 50.0),
        'horizontal range where the first bin starts; nearer points belong to that bin', 'm')
    r_max: float = basic(120.0, (1.0, 500.0),
        'horizontal range where the last bin ends; beyond it there is no model', 'm')
    bin_growth: float = advanced(1.5, (1.0, 3.0),
        'exponent of the bin edges over range: 1 = equal bins, more = finer bins near the sensor')

    @property
    def start(self) -> float:
        """Range from which bins grow [m]; nearer ones are as wide as the first beyond it."""
        return float(max(self.r_min, min(2.0, 0.5 * self.r_max)))

    @property
    def first_width(self) -> float:
        """Width of the first bin from `start` on, the narrowest of those beyond [m]."""
        return float((self.r_max - self.start) / float(self.n_bins) ** self.bin_growth)

    @property
    def n_near(self) -> int:
        """Bins nearer than `start`, at most as many as beyond."""
        return min(math.ceil((self.start - self.r_min) / self.first_width), self.n_bins)


@dataclass(frozen=True)
class LinesConfig(ParameterGroup):
    """Line extraction over the ground candidates of a segment."""

    slope_tolerance: float = advanced(0.1, (0.001, 1.0),
        'change of slope that ends a line', 'rad', 'zeta_m')
    offset_tolerance: float = advanced(0.15, (0.005, 5.0),
        "change of the line's height at the new point that ends a line", 'm', 'zeta_b')
    max_line_distance: float = advanced(0.10, (0.005, 5.0),
        'distance of a point to the line that ends it', 'm', 'delta')
    max_gap: float = advanced(1.5, (0.05, 50.0),
        'horizontal gap to the next candidate that ends a line, next to the sensor', 'm')
    max_gap_growth: float = advanced(0.6, (0.0, 2.0),
        'growth of the largest gap with range', 'm/m')
    max_density_ratio: float = advanced(8.0, (1.0, 1e6),
        'ratio of the vertical densities of two successive bins that ends a line')
    min_density_extent: float = advanced(0.05, (0.001, 1.0),
        'least height of a bin in its vertical density', 'm')
    error_ratio: float = advanced(1.0, (0.0001, 1e6),
        'variance of the height error over that of the range error in the line regression',
        symbol='lambda')


@dataclass(frozen=True)
class LengthScaleConfig(ParameterGroup):
    """Length-scale of the observation process along a segment."""

    model: str = advanced('latent', ('latent', 'line_gradient', 'constant'),
        'source of the length-scales: the latent process, the slopes of the lines, or one '
        'constant')
    constant: float = advanced(10.0, (0.05, 200.0), 'length-scale of the constant model', 'm')
    gradient_gain: float = advanced(2.0, (0.05, 100.0), 'a in l = a log(1/|slope|)', 'm', 'a')
    flat_gradient: float = advanced(0.1, (0.0001, 0.9),
        'slope below which a line counts as flat', symbol='g_def')
    min: float = advanced(1.0, (0.05, 200.0), 'smallest length-scale', 'm')
    max: float = advanced(50.0, (0.05, 500.0), 'largest length-scale', 'm')


@dataclass(frozen=True)
class ObservationConfig(ParameterGroup):
    """Hyper-parameters of the observation process GP_z."""

    sigma_f: float = advanced(0.2, (0.001, 10.0),
        'prior standard deviation of the ground height about its mean line', 'm', 'sigma_f')
    sigma_n: float = advanced(0.05, (0.001, 5.0),
        'standard deviation of the height noise of a ground candidate', 'm', 'sigma_n')
    slope_std: float = advanced(0.05, (0.0, 2.0),
        "prior standard deviation of the mean line's slope; 0 = a level mean")
    slope_drift: float = advanced(0.003, (0.0, 1.0),
        "standard deviation that the mean line's slope gains over a metre, and over others with "
        'the square root of the distance; less for a sensor below 1 m; 0 = a straight line')


@dataclass(frozen=True)
class LatentConfig(ParameterGroup):
    """Latent process GP_l over log length-scale, and its pseudo-inputs."""

    sigma_f_bar: float = advanced(0.9, (0.01, 100.0),
        'prior standard deviation of the log length-scale about its mean', symbol='sigma_f_bar')
    sigma_l_bar: float = advanced(2.0, (0.1, 500.0),
        'length-scale of the latent process', 'm', 'sigma_l_bar')
    sigma_n_bar: float = advanced(0.25, (0.01, 100.0),
        'standard deviation of the noise of the log length-scale', symbol='sigma_n_bar')
    candidates_per_pseudo_input: float = advanced(3.0, (1.0, 100.0),
        'ground candidates of a line for each pseudo-input: more = faster, less precise')


@dataclass(frozen=True)
class GrowthConfig(ParameterGroup):
    """Iterative growth of the inlier set (outlier rejection)."""

    seed_range: float = advanced(20.0, (0.5, 200.0),
        'horizontal range within which low candidates start the inlier set', 'm')
    seed_height_tolerance: float = basic(0.45, (0.01, 5.0),
        'largest height of a seed above or below the expected ground; in proportion to the height '
        'of a sensor below 1 m; larger: a ramp near the sensor can be ground, and so can a low '
        'object', 'm')
    max_std: float = advanced(0.23, (0.001, 10.0),
        'predictive standard deviation above which a candidate is not decided yet, unless it is '
        'as near the prediction; in proportion to the height of a sensor below 1 m', 'm')
    max_standardised_residual: float = advanced(3.0, (0.1, 50.0),
        'residual over predictive standard deviation above which a candidate is an outlier')
    max_slope: float = advanced(0.2, (0.0, 10.0),
        'largest slope with which the ground goes on from an inlier to a candidate that the gate '
        'rejects; 0 = the gate alone decides')
    min_rise_extent: float = advanced(3.0, (0.1, 1000.0),
        'distance over which ground that rises so must rise on', 'm')


@dataclass(frozen=True)
class SurfaceConfig(ParameterGroup):
    """From the segments' surfaces to the surface of the frame."""

    look_aside: bool = advanced(True, (),
        'whether neighbouring segments are evidence for the ground of a segment, and show the '
        'relief of the terrain; false = each segment by itself')


@dataclass(frozen=True)
class FacesConfig(ParameterGroup):
    """Vertical faces, whose bases lie within the tolerance of ground."""

    cell_size: float = advanced(0.5, (0.1, 10.0),
        'side of the square tiles whose returns are judged together', 'm')
    max_normal_z: float = advanced(0.45, (0.0, 1.0),
        'vertical part of the unit normal below which a tile is a vertical face; 0 = none is')
    max_foot_distance: float = advanced(0.06, (0.0, 10.0),
        "if the lowest returns are this close to the face's plane (RMS), its base counts as "
        'hidden; 0 = never', 'm')


@dataclass(frozen=True)
class LabelConfig(ParameterGroup):
    """Labels from the distance to the surface."""

    rule: str = advanced('roughness', ('roughness', 'tolerance'),
        'roughness = ground up to ground_tolerance, or higher where the ground about it is rough; '
        'returns at one height then vote; tolerance = ground_tolerance alone, above and below')
    ground_tolerance: float = basic(0.1, (0.001, 5.0),
        'height above the surface up to which a return is ground; in proportion to the height of '
        'a sensor below 1 m; larger: kerbs and grass become ground, low objects too, and other '
        'returns count as vertical faces', 'm', 'zeta_g')
    obstacle_min_height: float = advanced(0.2, (0.01, 10.0),
        'least height over the ground of an obstacle that matters: on rough ground, a vertical '
        'face that stands so much higher than ground_tolerance is one; in proportion to the '
        'height of a sensor below 1 m', 'm')
    obstacle_max_height: float = advanced(1.0, (0.02, 50.0),
        'height above the lowest return of a tile up to which returns belong to a vertical face '
        '(higher ones overhang), and depth below the surface down to which a return is ground',
        'm')


@dataclass(frozen=True)
class LearningConfig(ParameterGroup):
    """Learning of the hyper-parameters."""

    mode: str = basic('every_frame', ('every_frame', 'fixed'),
        'when the hyper-parameters are learned; fixed = never, the values given here are used')
    segment_step: int = advanced(30, (1, 60),
        'learn from every n-th segment; neighbours see similar ground')
    objective: str = advanced('map', ('map', 'paper'),
        'map = likelihood of the heights and priors; paper = as printed, which has no upper bound')
    max_evaluations: int = advanced(5, (1, 1000),
        'evaluations of the objective per frame; the best so far is used')
    prior_std: float = advanced(1.0, (0.01, 10.0),
        'standard deviation of the log-normal priors about the values given here')
    length_scale: str = advanced('factor', ('factor', 'classes'),
        'what the segments share of L_bar: one factor on the lengths of lines, or a value for '
        'each of nine classes of lines', symbol='L_bar')
    fixed: str = advanced('length_scales', ('none', 'sigma_f_bar', 'latent', 'length_scales'),
        'hyper-parameters that are not learned')


@dataclass(frozen=True)
class RuntimeConfig(ParameterGroup):
    """How the work is done; nothing here changes a label."""

    backend: str = advanced('auto', ('auto', 'numba', 'numpy'),
        'auto = numba if it is installed, else numpy')


@dataclass(frozen=True)
class DiagnosticsConfig(ParameterGroup):
    """Diagnostics of the node on /diagnostics."""

    period: float = advanced(1.0, (0.1, 60.0), 'time between two diagnostics messages', 's')
    stale_after: float = advanced(2.0, (0.1, 600.0),
        'time without any cloud after which the input is reported STALE', 's')
    max_latency: float = advanced(0.1, (0.001, 10.0),
        'median time from arrival to publication above which processing is reported WARN', 's')
# fmt: on


_ASCENDING = (
    ('grid.r_min', 'grid.r_max'),
    ('length_scale.min', 'length_scale.max'),
    ('label.obstacle_min_height', 'label.obstacle_max_height'),
    ('output.min_height', 'output.max_height'),
)
"""Pairs of which the first must be below the second."""
NARROWEST_BIN = 1e-3
"""Least width of a bin [m]: no sensor measures ranges as finely, single precision does."""


@dataclass(frozen=True)
class Config(ParameterGroups):
    """All parameters, immutable; ConfigError if a value is not accepted or contradicts another."""

    sensor: SensorConfig = SensorConfig()
    frame: FrameConfig = FrameConfig()
    input: InputConfig = InputConfig()
    output: OutputConfig = OutputConfig()
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
        super().__post_init__()
        for lower, upper in _ASCENDING:
            low, high = float(self[lower]), float(self[upper])
            if not low < high:
                raise ConfigError(f'{lower} = {low:g}: must be below {upper} = {high:g}')
        grid, width = self.grid, self.grid.first_width
        if width < NARROWEST_BIN:
            raise ConfigError(
                f'grid.n_bins = {grid.n_bins}, grid.bin_growth = {grid.bin_growth:g} between '
                f'grid.r_min = {grid.r_min:g} and grid.r_max = {grid.r_max:g}: the first bin '
                f'would be {width:.2g} m wide; must be at least {NARROWEST_BIN:g} m'
            )

    @classmethod
    def preset(cls, name: str) -> Config:
        """Return the preset `name`, ``default`` or ``paper``; ConfigError for another."""
        return find_preset(name).config


def parameter_specs() -> tuple[schema.ParameterSpec, ...]:
    """Return every declared parameter, in order of declaration."""
    return tuple(Config.specs().values())


@dataclass(frozen=True)
class Preset:
    """A named set of parameters; `name` is that of its file in ``config/`` too."""

    name: str
    purpose: str
    overrides: dict[str, tuple[schema.ParameterValue, str]] = field(default_factory=dict)
    """Values that differ from the defaults, each with the reason, by name."""

    @property
    def config(self) -> Config:
        """The defaults with the overrides."""
        return Config().replace(**{name: value for name, (value, _) in self.overrides.items()})

    def to_yaml(self, config: Config) -> str:
        """Write a parameter file of `config`, with the reasons of values that are the preset's."""
        title = f'Preset {self.name}: {self.purpose}' if config == self.config else ''
        given = self.overrides.items()
        reasons = {name: reason for name, (value, reason) in given if config[name] == value}
        return config.to_yaml(title, reasons)


_PRESETS = (
    Preset('default', 'For all sensors; chosen on labelled KITTI frames and simulated scans.'),
    Preset(
        'paper',
        'What arXiv 2112.05847 prints, learned until it converges. Of our departures '
        '(docs/algorithm.md) it has the four without a switch: mirror images on a wet road are '
        'raised, latent values are centred on their mean in each segment, heights between bin '
        'edges are linear, and points without a model are obstacles. What the paper leaves open '
        'is as in the defaults.',
        {
            'sensor.height': (1.73, "of KITTI's sensor, the paper's data"),
            'sensor.roll': (0.0, 'nothing is levelled'),
            'sensor.pitch': (0.0, 'nothing is levelled'),
            'grid.n_segments': (180, 'M in section IV'),
            'grid.n_bins': (120, 'N in section IV'),
            'grid.r_max': (90.0, 'not printed: 120 bins of 0.73 m'),
            'grid.bin_growth': (1.0, 'bins of equal width'),
            'lines.slope_tolerance': (0.02, 'zeta_m in section IV'),
            'lines.offset_tolerance': (0.15, 'zeta_b in section IV'),
            'lines.max_gap_growth': (0.15, "not printed; chosen for the rings of KITTI's sensor"),
            'length_scale.model': ('latent', 'section III-B'),
            'observation.slope_std': (0.0, 'the equations have a level mean'),
            'observation.slope_drift': (0.0, 'the equations have a level mean'),
            'surface.look_aside': (False, 'each segment has a surface of its own'),
            'observation.sigma_f': (0.5, 'about what is learned on the frames of the tables'),
            'growth.max_std': (0.6, 'not printed; chosen for segments by themselves'),
            'growth.max_standardised_residual': (2.0, 'not printed; chosen as above'),
            'growth.max_slope': (0.0, 'the gate alone decides'),
            'faces.max_normal_z': (0.0, 'no faces'),
            'faces.max_foot_distance': (0.0, 'no faces'),
            'label.ground_tolerance': (0.2, 'zeta_g, not printed: one for all'),
            'label.rule': ('tolerance', 'one zeta_g for all (Algorithm 2)'),
            'learning.objective': ('paper', 'section III-E as printed'),
            'learning.fixed': ('none', 'all hyper-parameters are learned, section III-E'),
            'learning.length_scale': ('classes', 'all segments share L_bar, section III-E'),
            'learning.max_evaluations': (1000, 'learning ends by itself before'),
            'learning.segment_step': (1, 'theta is learned from every segment, section III-E'),
        },
    ),
)
PRESETS = {preset.name: preset for preset in _PRESETS}
"""Every preset by its name."""


def find_preset(name: str) -> Preset:
    """Return the preset `name`; raises ConfigError with the nearest one and all others."""
    if name not in PRESETS:
        hint = schema.did_you_mean(name, PRESETS)
        raise ConfigError(f'unknown preset {name!r}{hint} (there are {", ".join(PRESETS)})')
    return PRESETS[name]


def config_of(given: Config | str | Path | Mapping[str, Any] | None, **values: Any) -> Config:
    """Return parameters by whatever names them.

    Parameters
    ----------
    given : Config, str, Path, dict or None
        Parameters themselves; the name of a preset; a YAML file, as a word with its suffix too;
        values by dotted name, or in groups as in such a file; or None for the defaults.
    **values
        Further values, by name with ``_`` in place of the dot: ``sensor_height=1.73``.

    Raises
    ------
    ConfigError
        If a name is unknown, a value is not accepted, or the file cannot be read.
    """
    if isinstance(given, Config):
        config = given
    elif given is None or isinstance(given, Mapping):
        config = Config().replace(**schema.parameters_of(given))
    elif isinstance(given, Path) or str(given).endswith(schema.YAML_SUFFIXES):
        config = Config.from_yaml(given)
    else:
        config = find_preset(str(given)).config
    names = {spec.name.replace('.', '_'): spec.name for spec in parameter_specs()}
    if unknown := [name for name in values if name not in names]:
        raise ConfigError(
            f'unknown parameter {unknown[0]}{schema.did_you_mean(unknown[0], names)}'
        )
    return config.replace(**{names[name]: value for name, value in values.items()})
