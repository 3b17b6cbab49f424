"""Named sets of parameters, with reasons; the files in ``config/`` are generated from here."""

from __future__ import annotations

from dataclasses import dataclass, field

from gp_ground_seg.errors import ConfigError
from gp_ground_seg.parameters.config import Config
from gp_ground_seg.parameters.schema import ParameterValue, did_you_mean


@dataclass(frozen=True)
class Preset:
    """A named set of parameters; `name` is that of its file in ``config/`` too."""

    name: str
    purpose: str
    overrides: dict[str, tuple[ParameterValue, str]] = field(default_factory=dict)
    """Values that differ from the defaults, each with the reason, by name."""

    @property
    def config(self) -> Config:
        """The defaults with the overrides."""
        return Config().replace(**{name: value for name, (value, _) in self.overrides.items()})

    @property
    def title(self) -> str:
        """First line of its file."""
        return f'Preset {self.name}: {self.purpose}'

    @property
    def reasons(self) -> dict[str, str]:
        """Reason of each override by the name of its parameter."""
        return {name: reason for name, (_, reason) in self.overrides.items()}


_FIRST_RING = (
    'the lowest beam meets level ground at {} m, and {} downhill {} m below the foot of the '
    'sensor: near the default, and no seed lies beyond the tolerance'
)
_PRESETS = (
    Preset('default', 'Chosen on labelled KITTI frames: HDL-64E on the roof of a car.'),
    Preset(
        'paper',
        'What arXiv 2112.05847 prints, and none of our departures from it '
        '(docs/algorithm.md); what it leaves open is as in the defaults.',
        {
            'sensor.height': (1.73, "of KITTI's sensor, the paper's data"),
            'sensor.roll': (0.0, 'nothing is levelled'),
            'sensor.pitch': (0.0, 'nothing is levelled'),
            'grid.n_segments': (180, 'M in section IV'),
            'grid.n_bins': (120, 'N in section IV'),
            'grid.bin_growth': (1.0, 'bins of equal width'),
            'lines.slope_tolerance': (0.02, 'zeta_m in section IV'),
            'lines.offset_tolerance': (0.15, 'zeta_b in section IV'),
            'length_scale.model': ('latent', 'section III-B'),
            'observation.slope_std': (0.0, 'the equations have a level mean'),
            'surface.look_aside': (False, 'each segment has a surface of its own'),
            'growth.max_standardised_residual': (2.0, 'a gate alike above and below'),
            'growth.max_standardised_depth': (2.0, 'a gate alike above and below'),
            'growth.max_line_slope': (0.0, 'the gate alone decides'),
            'growth.min_bend_extent': (1000.0, 'the gate alone decides'),
            'faces.max_normal_z': (0.0, 'no faces'),
            'faces.max_foot_distance': (0.0, 'no faces'),
            'label.ground_tolerance': (0.2, 'zeta_g, not printed: one for all'),
            'label.rule': ('tolerance', 'one zeta_g for all (Algorithm 2)'),
            'learning.objective': ('paper', 'section III-E as printed'),
            'learning.scope': ('frame', 'one theta for the whole frame, section III-E'),
            'learning.fixed': ('none', 'all hyper-parameters are learned, section III-E'),
            'learning.max_evaluations': (20, 'for six hyper-parameters, two of them unbounded'),
            'learning.segment_step': (1, 'theta is learned from every segment, section III-E'),
        },
    ),
    Preset('hdl64', 'Velodyne HDL-64E on the roof of a car; the defaults are for this sensor.'),
    Preset(
        'hdl32',
        'Velodyne HDL-32E on the roof of a car.',
        {
            'grid.r_max': (100.0, "the maker's range"),
            'growth.seed_height_tolerance': (0.6, _FIRST_RING.format('3.1', '10 %', '0.38')),
        },
    ),
    Preset(
        'vlp16',
        'Velodyne VLP-16 on a field robot.',
        {
            'grid.n_segments': (120, '16 rings leave few points in a segment: 15 firings of each'),
            'grid.n_bins': (50, 'level ground has 8 rings, at 3 m to 46 m: finer bins are empty'),
            'lines.max_gap': (6.0, 'beams 2 degrees apart: 2 m from ring to ring at 7 m'),
            'lines.max_gap_growth': (0.6, 'and 6 m at 9 m, 30 m at 15 m, on level ground'),
        },
    ),
    Preset(
        'os1_128',
        'Ouster OS1-128 on the roof of a car.',
        {
            'grid.r_max': (120.0, "the maker's range; 128 beams hit the ground that far"),
            'growth.seed_height_tolerance': (0.6, _FIRST_RING.format('4.3', '8 %', '0.43')),
        },
    ),
    Preset(
        'mid360',
        'Livox Mid-360 on a small robot.',
        {
            'grid.n_segments': (120, '20 000 points a scan, most of them above the ground'),
            'grid.n_bins': (40, 'as grid.n_segments'),
            'grid.r_max': (60.0, 'beyond it hardly a return meets the ground at 0.5 m'),
            'growth.seed_height_tolerance': (0.6, _FIRST_RING.format('4.1', '6 %', '0.48')),
        },
    ),
)
PRESETS = {preset.name: preset for preset in _PRESETS}
"""Every preset by its name."""


def find_preset(name: str) -> Preset:
    """Return the preset `name`; raises ConfigError with the nearest one and all others."""
    preset = PRESETS.get(name)
    if preset is None:
        hint = did_you_mean(name, PRESETS)
        raise ConfigError(f'unknown preset {name!r}{hint} (there are {", ".join(PRESETS)})')
    return preset
